// What Tungsten's thin lens has beyond Mitsuba's: a polygon for an aperture, and a second diaphragm that
// cuts off what comes in at an angle, so that highlights towards the edge of the picture look like a cat's
// eye.
#pragma once

#include <mitsuba/core/warp.h>
#include <mitsuba/render/sensor.h>

#include <algorithm>
#include <cmath>

#include "tungsten_plugin.hpp"

namespace mitsuba {

// Positions on the lens are in the camera's frame as Mitsuba has it, in which x points to the left.
class TungstenLens {
  public:
    using Variant = RenderAliases<float, Rgb>;

    explicit TungstenLens(const Properties& properties)
        : blades_(properties.get<int>("lens_blades", 0)),
          angle_(properties.get<float>("lens_angle", 0.f)),
          radius_(properties.get<float>("lens_radius", 0.f)),
          diaphragm_distance_(properties.get<float>("diaphragm_distance", 0.f)) {}

    // The random numbers for which Mitsuba's thin lens chooses a point of the aperture, each as likely.
    [[nodiscard]] Point<float, 2> aperture_sample(Point<float, 2> uniform) const {
        if (blades_ == 0) return uniform;
        const float scaled = uniform.x() * static_cast<float>(blades_);
        const float blade = std::min(std::floor(scaled), static_cast<float>(blades_ - 1));
        // A point of the triangle between the middle and two corners.
        const float from_middle = std::sqrt(scaled - blade);
        const auto corner = [&](float index) {
            const float phi = angle_ + index * two_pi / static_cast<float>(blades_);
            return Point<float, 2>(-std::cos(phi), std::sin(phi));
        };
        const Point<float, 2> position =
            from_middle * (uniform.y() * corner(blade) + (1.f - uniform.y()) * corner(blade + 1.f));
        return warp::uniform_disk_to_square_concentric(position);
    }

    // Whether a ray from the lens has come through the diaphragm behind it.
    [[nodiscard]] bool lets_through(const Variant::Sensor& camera, const Variant::Ray3f& ray) const {
        if (diaphragm_distance_ == 0.f) return true;
        const auto local_from_world = camera.world_transform().inverse();
        const auto origin = local_from_world * ray.o;
        const auto direction = local_from_world * ray.d;
        const float back = diaphragm_distance_ / direction.z();
        const float x = origin.x() - back * direction.x();
        const float y = origin.y() - back * direction.y();
        return x * x + y * y <= radius_ * radius_;
    }

  private:
    int blades_;
    float angle_;
    float radius_;
    float diaphragm_distance_;
};

}  // namespace mitsuba
