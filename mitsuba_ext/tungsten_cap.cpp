// tungsten_cap: Tungsten's infinite_sphere_cap, a round light infinitely far away, such as the sun.
//
//   direction    vector: towards the middle of the light
//   cap_angle    float: from there to its edge, in radians
//   radiance     texture; the radiance is its value at UV (0, 0)
//
// Small angles keep their digits: 1 - cos is computed as 2 sin^2 of half the angle throughout.
#include <mitsuba/core/frame.h>
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/scene.h>
#include <mitsuba/render/texture.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <utility>

#include "tungsten_plugin.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class Cap final : public Emitter<Float, Spectrum> {
  public:
    MI_IMPORT_BASE(Emitter, m_flags)
    MI_IMPORT_TYPES(Scene, Texture)

    explicit Cap(const Properties& props)
        : Base(props),
          frame_(dr::normalize(props.get<ScalarVector3f>("direction"))),
          height_(2.f * squared(std::sin(0.5f * props.get<ScalarFloat>("cap_angle")))),
          radiance_(props.get_unbounded_texture<Texture>("radiance")) {
        m_flags = +EmitterFlags::Infinite;
    }

    void set_scene(const Scene* scene) override {
        if (scene->bbox().valid()) sphere_ = scene->bbox().bounding_sphere();
    }

    Spectrum eval(const SurfaceInteraction3f& si, Mask active) const override {
        return covers(-si.wi) ? radiance(active) : Spectrum(0.f);
    }

    std::pair<DirectionSample3f, Spectrum> sample_direction(const Interaction3f& it, const Point2f& sample,
                                                            Mask active) const override {
        const Float drop = sample.x() * height_;
        const Float sine = std::sqrt(std::max(drop * (2.f - drop), 0.f));
        const Float phi = two_pi * sample.y();
        auto direction = dr::zeros<DirectionSample3f>();
        direction.d = frame_.to_world(Vector3f(sine * std::cos(phi), sine * std::sin(phi), 1.f - drop));
        direction.dist = 2.f * std::max(sphere_.radius, dr::norm(it.p - sphere_.center));
        direction.p = it.p + direction.d * direction.dist;
        direction.n = -direction.d;
        direction.time = it.time;
        direction.pdf = density();
        direction.emitter = this;
        return {direction, radiance(active) / direction.pdf};
    }

    Float pdf_direction(const Interaction3f& /*it*/, const DirectionSample3f& direction,
                        Mask /*active*/) const override {
        return covers(direction.d) ? density() : 0.f;
    }

    Spectrum eval_direction(const Interaction3f& /*it*/, const DirectionSample3f& direction,
                            Mask active) const override {
        return covers(direction.d) ? radiance(active) : Spectrum(0.f);
    }

    ScalarBoundingBox3f bbox() const override { return {}; }

    [[nodiscard]] std::string to_string() const override { return "Cap[]"; }

    MI_DECLARE_CLASS(Cap)

  private:
    // |d - axis|^2 = 2 (1 - cos), of unit vectors.
    [[nodiscard]] bool covers(const Vector3f& d) const {
        return dr::squared_norm(d - Vector3f(frame_.n)) <= 2.f * height_;
    }

    [[nodiscard]] Float density() const { return 1.f / (two_pi * height_); }

    [[nodiscard]] Spectrum radiance(Mask active) const {
        return radiance_->eval(dr::zeros<SurfaceInteraction3f>(), active);
    }

    Frame<ScalarFloat> frame_;
    ScalarFloat height_;  // of the cap, on a sphere of radius 1
    ref<Texture> radiance_;
    ScalarBoundingSphere3f sphere_{ScalarPoint3f(0.f), 1.f};
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Cap<float, Rgb>)
