// tungsten_conductor: a smooth metal that reflects on both sides. Behind it the cosine in Fresnel's formula
// is negative, as in Tungsten, so that it returns more light than it gets.
//
//   albedo   texture: colours the reflection
//   eta, k   rgb: the index of refraction; a mirror has 0 and 1
#include "tungsten_bsdf.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class Conductor final : public TungstenBsdf<Float, Spectrum> {
  public:
    using Base = TungstenBsdf<Float, Spectrum>;
    MI_IMPORT_TYPES(Texture)

    explicit Conductor(const Properties& props) : Base(props) {
        albedo_ = props.get_texture<Texture>("albedo", 1.f);
        eta_ = props.get<Color3f>("eta", Color3f(0.f));
        k_ = props.get<Color3f>("k", Color3f(1.f));
        Base::add_component(BSDFFlags::DeltaReflection | BSDFFlags::FrontSide | BSDFFlags::BackSide);
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& /*unused*/, const SurfaceInteraction3f& si,
                                             Float /*unused*/, const Point2f& /*unused*/,
                                             Mask active) const override {
        if (!active || si.wi.z() == 0.f) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        BSDFSample3f bs =
            Base::sample_of(Vector3f(-si.wi.x(), -si.wi.y(), si.wi.z()), BSDFFlags::DeltaReflection, 0);
        bs.pdf = 1.f;
        return {bs, albedo_->eval(si) * reflectance(si.wi.z())};
    }

    MI_DECLARE_CLASS(Conductor)

  protected:
    std::pair<Spectrum, Float> evaluate(const SurfaceInteraction3f& /*unused*/,
                                        const Vector3f& /*unused*/) const override {
        return {Spectrum(0.f), 0.f};
    }

  private:
    // Shirley, "Physically Based Lighting Calculations for Computer Graphics", 1991.
    [[nodiscard]] Spectrum reflectance(Float cos_i) const {
        const Float cos_squared = cos_i * cos_i;
        const Float sin_squared = std::max(1.f - cos_squared, 0.f);
        const Spectrum inner = squared(eta_) - squared(k_) - sin_squared;
        const Spectrum length = dr::sqrt(squared(inner) + 4.f * squared(eta_ * k_));
        const Spectrum twice = 2.f * cos_i * dr::sqrt(dr::maximum(0.5f * (length + inner), 0.f));
        const Spectrum s = length + cos_squared;
        const Spectrum p = cos_squared * length + squared(sin_squared);
        const Spectrum r_s = (s - twice) / (s + twice);
        const Spectrum r_p = r_s * (p - twice * sin_squared) / (p + twice * sin_squared);
        return 0.5f * (r_s + r_p);
    }

    ref<Texture> albedo_;
    Color3f eta_;
    Color3f k_;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Conductor<float, Rgb>)
