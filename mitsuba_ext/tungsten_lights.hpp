// Chooses one of the scene's lights, each about as often as it contributes to the light at a point: by the
// irradiance there of a surface that faces it with nothing in the way. Tungsten does much the same for most
// kinds of lights.
//
// The `sampling_weight` of an emitter must be about its mean radiance; of a point light its intensity; of
// what surrounds the scene that irradiance itself.
#pragma once

#include <drjit/packet.h>
#include <mitsuba/core/qmc.h>
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/scene.h>
#include <mitsuba/render/shape.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "tungsten_plugin.hpp"

namespace mitsuba {

class LightChooser {
  public:
    using Variant = RenderAliases<float, Rgb>;
    using Emitter = Variant::Emitter;
    using Shape = Variant::Shape;
    using Point3 = Point<float, 3>;
    using Vector3 = Vector<float, 3>;

    struct Choice {
        const Emitter* emitter;  // null: there is no light
        float probability;
    };

    // To be called before threads use it.
    void prepare(const Variant::Scene& scene) {
        static std::atomic<uint64_t> preparations = 0;
        preparation_ = ++preparations;
        lights_.clear();
        for (const auto& emitter : scene.emitters()) lights_.emplace_back(*emitter);
    }

    [[nodiscard]] Choice choose(const Point3& at, float uniform) const {
        const auto& shares = shares_at(at);
        Choice choice{.emitter = nullptr, .probability = 0.f};
        for (size_t i = 0; i < lights_.size(); ++i) {
            if (!(shares[i] > 0.f)) continue;
            choice = {.emitter = lights_[i].emitter(), .probability = shares[i]};
            if (uniform < shares[i]) break;
            uniform -= shares[i];
        }
        return choice;
    }

    [[nodiscard]] float probability(const Point3& at, const Emitter& emitter) const {
        const auto& shares = shares_at(at);
        const auto light = std::ranges::find(lights_, &emitter, &Light::emitter);
        return light != lights_.end() ? shares[static_cast<size_t>(light - lights_.begin())] : 0.f;
    }

  private:
    class Light {
      public:
        explicit Light(const Emitter& emitter) : emitter_(&emitter), weight_(emitter.sampling_weight()) {
            if (has_flag(emitter.flags(), EmitterFlags::Infinite)) return;
            if (const auto* shape = emitter.shape()) {
                extent_ = Extent::patches;
                divide(*shape);
            } else {
                extent_ = Extent::point;
            }
            middle_ = emitter.bbox().center();
        }

        [[nodiscard]] const Emitter* emitter() const { return emitter_; }

        // About the irradiance of a surface there that faces the light.
        [[nodiscard]] float irradiance(const Point3& at) const {
            if (extent_ == Extent::everywhere) return weight_;
            const Vector3 off = at - middle_;
            const float off2 = dr::squared_norm(off);
            if (extent_ == Extent::point) return weight_ / off2;
            if (off2 > far2_)
                return weight_ * area_ / off2 *
                       (is_flat_ ? std::max(dr::dot(off, normal_) / std::sqrt(off2), least_cosine)
                                 : convex_cosine);
            const Vector<Lanes, 3> away = Point<Lanes, 3>(at) - positions_;
            const Lanes distance2 = dr::squared_norm(away);
            const Lanes cosine = dr::maximum(dr::dot(away, normals_) * dr::rsqrt(distance2), least_cosine);
            // On its axis, a disk brings exactly that.
            const float patch_area = area_ / patch_count;
            return weight_ * patch_area * dr::sum(cosine / (distance2 + patch_area * inv_pi));
        }

      private:
        enum class Extent : uint8_t { everywhere, point, patches };
        static constexpr uint32_t patch_count = 8;
        using Lanes = dr::Packet<float, patch_count>;
        // A patch stands for a part of the shape, of which some may face where its middle does not.
        static constexpr float least_cosine = 1.f / 16.f;
        // In radii of the shape: from there, it is as if all of it were in its middle.
        static constexpr float far = 5.f;
        // On average over all sides, a convex shape shows a quarter of its surface.
        static constexpr float convex_cosine = 0.25f;

        void divide(const Shape& shape) {
            area_ = shape.surface_area();
            far2_ = squared(far) * dr::squared_norm(0.5f * shape.bbox().extents());
            for (uint32_t i = 0; i < patch_count; ++i) {
                // Hammersley's points. A mesh takes its triangle by the second coordinate.
                const Point<float, 2> uniform(radical_inverse_2<uint32_t, float>(i),
                                              (static_cast<float>(i) + 0.5f) / patch_count);
                const auto sample = shape.sample_position(0.f, uniform);
                for (size_t axis = 0; axis < 3; ++axis) {
                    positions_.entry(axis).entry(i) = sample.p.entry(axis);
                    normals_.entry(axis).entry(i) = sample.n.entry(axis);
                }
                if (i == 0) normal_ = sample.n;
                is_flat_ = is_flat_ && dr::dot(sample.n, normal_) > 0.999f;
            }
        }

        const Emitter* emitter_;
        float weight_;
        Extent extent_ = Extent::everywhere;
        Point3 middle_{0.f};
        float area_ = 0.f;
        float far2_ = 0.f;
        bool is_flat_ = true;
        Vector3 normal_{0.f};
        Point<Lanes, 3> positions_{0.f};
        Normal<Lanes, 3> normals_{0.f};
    };

    struct Shares {
        uint64_t preparation = 0;
        Point3 at{0.f};
        std::vector<float> values;
    };

    // The probability of every light. What a light sample was chosen by is asked for again, next in this
    // thread, where the path itself meets a light.
    [[nodiscard]] const std::vector<float>& shares_at(const Point3& at) const {
        thread_local Shares shares;
        if (shares.preparation == preparation_ && dr::all(shares.at == at)) return shares.values;
        shares.preparation = preparation_;
        shares.at = at;
        shares.values.assign(lights_.size(), 1.f);
        if (lights_.size() < 2) return shares.values;
        float sum = 0.f;
        for (size_t i = 0; i < lights_.size(); ++i) {
            const float irradiance = lights_[i].irradiance(at);
            // A flattened lamp has no normals.
            shares.values[i] = std::isfinite(irradiance) ? irradiance : 0.f;
            sum += shares.values[i];
        }
        const float alike = 1.f / static_cast<float>(lights_.size());
        const bool is_known = sum > 0.f && std::isfinite(sum);
        for (float& share : shares.values)
            share = shared_alike * alike + (1.f - shared_alike) * (is_known ? share / sum : alike);
        return shares.values;
    }

    // The part of the samples that all lights get alike: where the others are hidden, a faint one is all
    // there is.
    static constexpr float shared_alike = 0.1f;

    uint64_t preparation_ = 0;  // tells what one thread remembers of this scene from what it does of others
    std::vector<Light> lights_;
};

}  // namespace mitsuba
