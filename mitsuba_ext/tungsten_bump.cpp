// tungsten_bump: another BSDF on a surface whose shading normal a height map bends, as Tungsten bends it: by
// the differences of texels, however far apart these are on the surface.
//
//   (nested)   the BSDF
//   slopes     bitmap of three channels, repeated and not interpolated, over Tungsten's UV: what the height
//              gains from the texel on the left of one to that on its right, and from the one above to the
//              one below; the third is not used
//   shape      mesh, cube or quad: which tangents Tungsten bends
#include <string>

#include "tungsten_bsdf.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class Bump final : public TungstenBsdf<Float, Spectrum> {
  public:
    using Base = TungstenBsdf<Float, Spectrum>;
    MI_IMPORT_TYPES(Texture, BSDF)

    explicit Bump(const Properties& props) : Base(props) {
        for (const auto& prop : props.objects())
            if (auto* bsdf = prop.try_get<BSDF>()) nested_ = bsdf;
        if (!nested_) Throw("Expected a nested BSDF on the bent surface");
        slopes_ = props.get_texture<Texture>("slopes", 0.f);
        const auto shape = props.get<std::string>("shape");
        if (shape != "mesh" && shape != "cube" && shape != "quad")
            Throw("Expected the shape mesh, cube or quad, got \"%s\"", shape);
        unit_ = shape != "quad";
        mirrors_ = shape == "mesh";
        for (size_t i = 0; i < nested_->component_count(); ++i) Base::add_component(nested_->flags(i));
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& context, const SurfaceInteraction3f& si,
                                             Float sample1, const Point2f& sample2,
                                             Mask active) const override {
        const SurfaceInteraction3f bent = bent_interaction(si);
        auto [bs, weight] = nested_->sample(context, bent, sample1, sample2, active);
        bs.wo = si.to_local(bent.to_world(bs.wo));
        return {bs, weight};
    }

    Spectrum eval_null_transmission(const SurfaceInteraction3f& si, Mask active) const override {
        return nested_->eval_null_transmission(bent_interaction(si), active);
    }

    Frame3f sh_frame(const SurfaceInteraction3f& si, Mask /*active*/) const override {
        return bent_interaction(si).sh_frame;
    }

    MI_DECLARE_CLASS(Bump)

  protected:
    std::pair<Spectrum, Float> evaluate(const SurfaceInteraction3f& si, const Vector3f& wo) const override {
        const SurfaceInteraction3f bent = bent_interaction(si);
        return nested_->eval_pdf(BSDFContext(), bent, bent.to_local(si.to_world(wo)), true);
    }

  private:
    // Tungsten rounds the coordinates of texels towards 0. Where they are negative (from the centre of the
    // first texel to the left, or upwards) it extrapolates from the next two.
    Color3f interpolated_slope(SurfaceInteraction3f si) const {
        const Vector2f size(slopes_->resolution());
        const Point2f place(si.uv.x() * size.x() - 0.5f, (1.f - si.uv.y()) * size.y() - 0.5f);
        const Point2f first = dr::trunc(place);
        const Vector2f weight = place - first;
        const auto texel = [&](Float right, Float below) {
            si.uv =
                Point2f((first.x() + right + 0.5f) / size.x(), 1.f - (first.y() + below + 0.5f) / size.y());
            return slopes_->eval_3(si, true);
        };
        return dr::lerp(dr::lerp(texel(0.f, 0.f), texel(1.f, 0.f), weight.x()),
                        dr::lerp(texel(0.f, 1.f), texel(1.f, 1.f), weight.x()), weight.y());
    }

    SurfaceInteraction3f bent_interaction(const SurfaceInteraction3f& si) const {
        const Vector3f n(si.sh_frame.n);
        Vector3f tangent = si.dp_du;
        Vector3f bitangent = si.dp_dv;
        if (unit_) {
            tangent = dr::normalize(tangent);
            bitangent = dr::normalize(bitangent);
        }
        if (mirrors_ && dr::dot(dr::cross(tangent, bitangent), Vector3f(si.n)) < 0.f) {
            tangent = -tangent;
            bitangent = -bitangent;
        }
        const Color3f slope = interpolated_slope(si);
        tangent += n * (slope.x() - dr::dot(n, tangent));
        bitangent += n * (slope.y() - dr::dot(n, bitangent));
        Vector3f bent_n = dr::cross(tangent, bitangent);
        SurfaceInteraction3f bent = si;
        if (!(dr::squared_norm(bent_n) > 0.f)) return bent;
        bent_n = dr::normalize(dr::dot(bent_n, n) < 0.f ? -bent_n : bent_n);
        tangent -= bent_n * dr::dot(bent_n, tangent);
        if (!(dr::squared_norm(tangent) > 0.f)) return bent;
        bent.sh_frame.n = Normal3f(bent_n);
        bent.sh_frame.s = dr::normalize(tangent);
        bent.sh_frame.t = dr::cross(bent_n, bent.sh_frame.s);
        bent.wi = bent.to_local(si.to_world(si.wi));
        return bent;
    }

    ref<BSDF> nested_;
    ref<Texture> slopes_;
    bool unit_;     // tangents have length 1, not that of the quad's edges
    bool mirrors_;  // tangents point the other way where the texture is mirrored
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Bump<float, Rgb>)
