// tungsten_area: a shape that shines, on the side of its faces whatever its shading normals, sampled by area
// whatever its texture.
//
// Mitsuba's area light goes by shading normals and samples the texels of its texture, which needs UV that
// cover the shape once.
//
//   radiance   texture
//   (nested)   the same shape with the normals of its faces, where it has others
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/shape.h>
#include <mitsuba/render/texture.h>

#include <string>
#include <utility>

#include "tungsten_plugin.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class Area final : public Emitter<Float, Spectrum> {
  public:
    MI_IMPORT_BASE(Emitter, m_flags, m_shape)
    MI_IMPORT_TYPES(Shape, Texture)

    explicit Area(const Properties& props)
        : Base(props), radiance_(props.get_unbounded_texture<Texture>("radiance")) {
        for (const auto& prop : props.objects())
            if (auto* shape = prop.try_get<Shape>()) faces_ = shape;
        // Mitsuba makes a mesh's table of areas when it is first asked for, which threads must not do at
        // once.
        if (faces_) faces_->surface_area();
        m_flags = +EmitterFlags::Surface;
    }

    Spectrum eval(const SurfaceInteraction3f& si, Mask active) const override {
        return dr::dot(si.to_world(si.wi), si.n) > 0.f ? radiance_->eval(si, active) : Spectrum(0.f);
    }

    std::pair<DirectionSample3f, Spectrum> sample_direction(const Interaction3f& it, const Point2f& sample,
                                                            Mask active) const override {
        DirectionSample3f direction = sampled_shape().sample_direction(it, sample, active);
        direction.emitter = this;
        if (!(direction.pdf > 0.f) || !shines_against(direction)) return {direction, Spectrum(0.f)};
        const SurfaceInteraction3f si(direction, it.wavelengths);
        return {direction, radiance_->eval(si, active) / direction.pdf};
    }

    // The normal of `direction` must be that of the face.
    Float pdf_direction(const Interaction3f& it, const DirectionSample3f& direction,
                        Mask active) const override {
        return shines_against(direction) ? sampled_shape().pdf_direction(it, direction, active) : 0.f;
    }

    ScalarBoundingBox3f bbox() const override { return m_shape->bbox(); }

    [[nodiscard]] std::string to_string() const override { return "Area[]"; }

    MI_DECLARE_CLASS(Area)

  private:
    static bool shines_against(const DirectionSample3f& direction) {
        return dr::dot(direction.d, direction.n) < 0.f;
    }

    [[nodiscard]] const Shape& sampled_shape() const { return faces_ ? *faces_ : *m_shape; }

    ref<Texture> radiance_;
    ref<Shape> faces_;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Area<float, Rgb>)
