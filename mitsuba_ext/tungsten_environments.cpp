// tungsten_environments: several lights that surround the scene, such as a sky and the sun in it.
//
//   light_0, light_1, ...       the emitters, each of which surrounds the scene
//   cap_0, cap_1, ...           bool: the light leaves the others visible where it is never sampled
//   sampled_0, sampled_1, ...   bool: the light lights surfaces even where a later one hides it
//
// As in Tungsten, a ray that leaves the scene sees the last light in its direction alone; surfaces are lit by
// all that are sampled, and by what their rays see.
#include <mitsuba/render/emitter.h>

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "tungsten_plugin.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class Environments final : public Emitter<Float, Spectrum> {
  public:
    MI_IMPORT_BASE(Emitter, m_flags)
    MI_IMPORT_TYPES(Scene)

    explicit Environments(const Properties& props) : Base(props) {
        for (size_t i = 0; props.has_property("light_" + std::to_string(i)); ++i) {
            auto nested = props.get<ref<Object>>("light_" + std::to_string(i));
            auto* emitter = dynamic_cast<Base*>(nested.get());
            if (emitter == nullptr || !emitter->is_environment())
                Throw("Expected emitters that surround the scene");
            lights_.push_back({emitter, props.get<bool>("cap_" + std::to_string(i), false),
                               props.get<bool>("sampled_" + std::to_string(i), true)});
        }
        if (lights_.empty()) Throw("Expected nested emitters");
        m_flags = +EmitterFlags::Infinite;
    }

    void set_scene(const Scene* scene) override {
        for (Light& light : lights_) light.emitter->set_scene(scene);
    }

    // What a ray sees.
    Spectrum eval(const SurfaceInteraction3f& si, Mask active) const override {
        auto direction = dr::zeros<DirectionSample3f>();
        direction.d = -si.wi;
        const Light* seen = last_towards(direction);
        return seen != nullptr ? Spectrum(seen->emitter->eval(si, active)) : Spectrum(0.f);
    }

    std::pair<DirectionSample3f, Spectrum> sample_direction(const Interaction3f& it, const Point2f& sample,
                                                            Mask active) const override {
        // One of the lights, each as often; the sample is stretched to be used again.
        const auto count = static_cast<float>(lights_.size());
        const float chosen = std::min(std::floor(sample.x() * count), count - 1.f);
        const Point2f reused(sample.x() * count - chosen, sample.y());
        const Light& light = lights_[static_cast<size_t>(chosen)];
        auto [direction, weight] = light.emitter->sample_direction(it, reused, active);
        if (!(direction.pdf > 0.f)) return {direction, Spectrum(0.f)};
        // What the light itself says of its sample is exact; asked for the same direction, it may round.
        const Light* seen = last_towards(direction);
        Spectrum value = lights_up(light, seen) ? weight * direction.pdf : Spectrum(0.f);
        for (const Light& other : lights_) {
            if (&other == &light) continue;
            if (lights_up(other, seen)) value += other.emitter->eval(seen_in(direction), active);
            direction.pdf += other.emitter->pdf_direction(it, direction, active);
        }
        direction.pdf /= count;
        direction.emitter = this;
        return {direction, value / direction.pdf};
    }

    Float pdf_direction(const Interaction3f& it, const DirectionSample3f& direction,
                        Mask active) const override {
        Float sum = 0.f;
        for (const Light& light : lights_) sum += light.emitter->pdf_direction(it, direction, active);
        return sum / static_cast<float>(lights_.size());
    }

    // What comes from a direction in all.
    Spectrum eval_direction(const Interaction3f& /*it*/, const DirectionSample3f& direction,
                            Mask active) const override {
        const Light* seen = last_towards(direction);
        Spectrum sum(0.f);
        for (const Light& light : lights_)
            if (lights_up(light, seen)) sum += light.emitter->eval(seen_in(direction), active);
        return sum;
    }

    ScalarBoundingBox3f bbox() const override { return {}; }

    [[nodiscard]] std::string to_string() const override { return "Environments[]"; }

    MI_DECLARE_CLASS(Environments)

  private:
    struct Light {
        ref<Base> emitter;
        bool is_cap;
        bool is_sampled;
    };

    // The light that a ray sees, if any.
    const Light* last_towards(const DirectionSample3f& direction) const {
        const auto it = dr::zeros<Interaction3f>();
        const auto light = std::find_if(lights_.rbegin(), lights_.rend(), [&](const Light& candidate) {
            return !candidate.is_cap || candidate.emitter->pdf_direction(it, direction, true) > 0.f;
        });
        return light != lights_.rend() ? &*light : nullptr;
    }

    // Whether surfaces receive what a light sends from a direction in which rays see `seen`.
    static bool lights_up(const Light& light, const Light* seen) {
        return light.is_sampled || &light == seen;
    }

    // Lights around the scene want a ray that hit nothing; their `eval_direction` wants coordinates in a map.
    static SurfaceInteraction3f seen_in(const DirectionSample3f& direction) {
        auto si = dr::zeros<SurfaceInteraction3f>();
        si.wi = -direction.d;
        return si;
    }

    std::vector<Light> lights_;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Environments<float, Rgb>)
