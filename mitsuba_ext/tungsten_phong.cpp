// tungsten_phong: a lobe cos^exponent about the mirror direction, and a diffuse one.
//
//   albedo          texture; colours both lobes
//   exponent        float
//   diffuse_ratio   float in [0, 1]: the weight of the diffuse lobe
#include <mitsuba/core/frame.h>

#include "tungsten_bsdf.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class Phong final : public TungstenBsdf<Float, Spectrum> {
  public:
    using Base = TungstenBsdf<Float, Spectrum>;
    MI_IMPORT_TYPES(Texture)

    explicit Phong(const Properties& props) : Base(props) {
        albedo_ = props.get_texture<Texture>("albedo", 1.f);
        exponent_ = props.get<float>("exponent", 64.f);
        diffuse_ratio_ = props.get<float>("diffuse_ratio", 0.2f);
        Base::add_component(BSDFFlags::GlossyReflection | BSDFFlags::FrontSide);
        Base::add_component(BSDFFlags::DiffuseReflection | BSDFFlags::FrontSide);
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& /*unused*/, const SurfaceInteraction3f& si,
                                             Float sample1, const Point2f& sample2,
                                             Mask active) const override {
        if (!active || si.wi.z() <= 0.f) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        if (sample1 < diffuse_ratio_)
            return Base::weighted(
                Base::sample_of(warp::square_to_cosine_hemisphere(sample2), BSDFFlags::DiffuseReflection, 1),
                si);
        const Float cos_theta = std::pow(sample2.y(), 1.f / (1.f + exponent_));
        const Float sin_theta = std::sqrt(std::max(1.f - squared(cos_theta), 0.f));
        const Float phi = two_pi * sample2.x();
        const Frame3f lobe(Vector3f(-si.wi.x(), -si.wi.y(), si.wi.z()));
        const Vector3f wo =
            lobe.to_world(Vector3f(std::cos(phi) * sin_theta, std::sin(phi) * sin_theta, cos_theta));
        return Base::weighted(Base::sample_of(wo, BSDFFlags::GlossyReflection, 0), si);
    }

    MI_DECLARE_CLASS(Phong)

  protected:
    std::pair<Spectrum, Float> evaluate(const SurfaceInteraction3f& si, const Vector3f& wo) const override {
        if (si.wi.z() <= 0.f || wo.z() <= 0.f) return {Spectrum(0.f), 0.f};
        const Float cos_lobe = si.wi.z() * wo.z() - si.wi.x() * wo.x() - si.wi.y() * wo.y();
        const Float power = cos_lobe > 0.f ? std::pow(cos_lobe, exponent_) * (1.f - diffuse_ratio_) : 0.f;
        const Float diffuse = diffuse_ratio_ * inv_pi;
        const Float value = diffuse + power * (exponent_ + 2.f) / two_pi;
        return {albedo_->eval(si) * (value * wo.z()), diffuse * wo.z() + power * (exponent_ + 1.f) / two_pi};
    }

  private:
    ref<Texture> albedo_;
    float exponent_;
    float diffuse_ratio_;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Phong<float, Rgb>)
