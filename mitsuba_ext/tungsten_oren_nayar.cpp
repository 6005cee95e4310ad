// tungsten_oren_nayar: rough diffuse reflection with interreflection between the facets.
// Oren and Nayar, "Generalization of Lambert's Reflectance Model", SIGGRAPH 1994, equations 30 to 32.
//
//   albedo      texture
//   roughness   texture; the standard deviation of the facets' slope is roughness / sqrt(2)
#include "tungsten_bsdf.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class OrenNayar final : public TungstenBsdf<Float, Spectrum> {
  public:
    using Base = TungstenBsdf<Float, Spectrum>;
    MI_IMPORT_TYPES(Texture)

    explicit OrenNayar(const Properties& props) : Base(props) {
        albedo_ = props.get_texture<Texture>("albedo", 1.f);
        roughness_ = props.get_texture<Texture>("roughness", 1.f);
        Base::add_component(BSDFFlags::DiffuseReflection | BSDFFlags::FrontSide);
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& /*unused*/, const SurfaceInteraction3f& si,
                                             Float sample1, const Point2f& sample2,
                                             Mask active) const override {
        if (!active || si.wi.z() <= 0.f) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        const Vector3f wo = sample1 < uniform_share(si) ? warp::square_to_uniform_hemisphere(sample2)
                                                        : warp::square_to_cosine_hemisphere(sample2);
        return Base::weighted(Base::sample_of(wo, BSDFFlags::DiffuseReflection, 0), si);
    }

    MI_DECLARE_CLASS(OrenNayar)

  protected:
    std::pair<Spectrum, Float> evaluate(const SurfaceInteraction3f& si, const Vector3f& wo) const override {
        const Vector3f& wi = si.wi;
        if (wi.z() <= 0.f || wo.z() <= 0.f) return {Spectrum(0.f), 0.f};

        const Float theta_o = std::acos(std::min(wo.z(), 1.f));
        const Float theta_i = std::acos(std::min(wi.z(), 1.f));
        const Float alpha = std::max(theta_o, theta_i);
        const Float beta = std::min(theta_o, theta_i);
        const Float radii = squared(wi.x()) + squared(wi.y());
        const Float radii_o = squared(wo.x()) + squared(wo.y());
        const Float norm = std::sqrt(radii * radii_o);
        const Float cos_phi = norm == 0.f ? 1.f : (wi.x() * wo.x() + wi.y() * wo.y()) / norm;

        const Float variance = 0.5f * squared(roughness_->eval_1(si));
        const Float c1 = 1.f - 0.5f * variance / (variance + 0.33f);
        const Float beta_of_right = 2.f * inv_pi * beta;
        const Float bend = cos_phi >= 0.f ? 0.f : beta_of_right * beta_of_right * beta_of_right;
        const Float c2 = 0.45f * variance / (variance + 0.09f) * (std::sin(alpha) - bend);
        const Float c3 =
            0.125f * variance / (variance + 0.09f) * squared(4.f * squared(inv_pi) * alpha * beta);
        const Float direct = c1 + cos_phi * c2 * std::tan(beta) +
                             (1.f - std::abs(cos_phi)) * c3 * std::tan(0.5f * (alpha + beta));
        const Float interreflected =
            0.17f * variance / (variance + 0.13f) * (1.f - cos_phi * squared(beta_of_right));

        const Spectrum albedo = albedo_->eval(si);
        const Float share = uniform_share(si);
        return {(albedo * direct + albedo * albedo * interreflected) * (wo.z() * inv_pi),
                share / two_pi + (1.f - share) * wo.z() * inv_pi};
    }

  private:
    // How often directions are drawn uniformly and not by the cosine.
    Float uniform_share(const SurfaceInteraction3f& si) const {
        return std::clamp(roughness_->eval_1(si), 0.01f, 1.f);
    }

    ref<Texture> albedo_;
    ref<Texture> roughness_;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(OrenNayar<float, Rgb>)
