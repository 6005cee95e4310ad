// tungsten_diffuse_transmission: scatters diffusely, half to each side.
//
//   albedo   texture
#include "tungsten_bsdf.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class DiffuseTransmission final : public TungstenBsdf<Float, Spectrum> {
  public:
    using Base = TungstenBsdf<Float, Spectrum>;
    MI_IMPORT_TYPES(Texture)

    explicit DiffuseTransmission(const Properties& props) : Base(props) {
        albedo_ = props.get_texture<Texture>("albedo", 1.f);
        Base::add_component(BSDFFlags::DiffuseReflection | BSDFFlags::FrontSide | BSDFFlags::BackSide);
        Base::add_component(BSDFFlags::DiffuseTransmission | BSDFFlags::FrontSide | BSDFFlags::BackSide);
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& /*unused*/, const SurfaceInteraction3f& si,
                                             Float sample1, const Point2f& sample2,
                                             Mask active) const override {
        if (!active) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        const bool transmit = sample1 < 0.5f;
        Vector3f wo = warp::square_to_cosine_hemisphere(sample2);
        if (transmit == (si.wi.z() > 0.f)) wo.z() = -wo.z();
        BSDFSample3f bs = transmit ? Base::sample_of(wo, BSDFFlags::DiffuseTransmission, 1)
                                   : Base::sample_of(wo, BSDFFlags::DiffuseReflection, 0);
        // Tungsten forgets here that only a share of the directions goes to this side; as it weighs its light
        // samples by the right density, its picture is somewhat too bright.
        bs.pdf = inv_pi * std::abs(wo.z());
        return {bs, albedo_->eval(si)};
    }

    MI_DECLARE_CLASS(DiffuseTransmission)

  protected:
    std::pair<Spectrum, Float> evaluate(const SurfaceInteraction3f& si, const Vector3f& wo) const override {
        const Float density = 0.5f * inv_pi * std::abs(wo.z());
        return {albedo_->eval(si) * density, density};
    }

  private:
    ref<Texture> albedo_;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(DiffuseTransmission<float, Rgb>)
