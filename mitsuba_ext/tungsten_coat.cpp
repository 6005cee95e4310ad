// tungsten_coat: another BSDF under a dielectric layer, smooth or rough, that bends light and may absorb.
//
//   (nested)       the BSDF below, which must not transmit
//   ior            float: index of refraction of the layer
//   sigma_a        rgb: absorption in the layer times its thickness
//   roughness      texture: of the layer; absent where it is smooth
//   distribution   beckmann, phong or ggx: of the rough layer's facets
#include "tungsten_bsdf.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class Coat final : public TungstenBsdf<Float, Spectrum> {
  public:
    using Base = TungstenBsdf<Float, Spectrum>;
    MI_IMPORT_TYPES(Texture, BSDF)

    explicit Coat(const Properties& props) : Base(props) {
        for (const auto& prop : props.objects())
            if (auto* bsdf = prop.try_get<BSDF>()) substrate_ = bsdf;
        if (!substrate_) Throw("Expected a nested BSDF under the coat");
        ior_ = props.get<float>("ior", 1.3f);
        sigma_a_ = props.get<Color3f>("sigma_a", Color3f(0.f));
        absorbs_ = dr::max(sigma_a_) > 0.f;
        mean_transmittance_ = std::exp(-2.f * dr::mean(sigma_a_));
        if (props.has_property("roughness")) {
            roughness_ = props.get_texture<Texture>("roughness", 0.02f);
            distribution_ =
                RoughReflection::distribution_from_name(props.get<std::string>("distribution", "ggx"));
        }
        Base::add_component((roughness_ ? BSDFFlags::GlossyReflection : BSDFFlags::DeltaReflection) |
                            BSDFFlags::FrontSide);
        for (size_t i = 0; i < substrate_->component_count(); ++i) Base::add_component(substrate_->flags(i));
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& context, const SurfaceInteraction3f& si,
                                             Float sample1, const Point2f& sample2,
                                             Mask active) const override {
        const Vector3f& wi = si.wi;
        if (!active || wi.z() <= 0.f) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        const FresnelTerm in = dielectric_fresnel(1.f / ior_, wi.z());
        const Float probability = specular_probability(in.reflectance);
        if (sample1 < probability) {
            if (roughness_)
                return Base::weighted(
                    Base::sample_of(layer(si).sample(wi, sample2), BSDFFlags::GlossyReflection, 0), si);
            BSDFSample3f bs =
                Base::sample_of(Vector3f(-wi.x(), -wi.y(), wi.z()), BSDFFlags::DeltaReflection, 0);
            bs.pdf = probability;
            return {bs, Spectrum(in.reflectance / probability)};
        }

        SurfaceInteraction3f below = si;
        below.wi = refracted(wi, in.cos_t);
        const Float reused = (sample1 - probability) / (1.f - probability);
        auto [bs, weight] = substrate_->sample(context, below, reused, sample2, true);
        if (dr::all(weight == 0.f) || bs.wo.z() <= 0.f) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        const Float cos_below = bs.wo.z();
        const FresnelTerm out = dielectric_fresnel(ior_, cos_below);
        if (out.reflectance == 1.f) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        bs.wo = Vector3f(bs.wo.x() * ior_, bs.wo.y() * ior_, out.cos_t);
        bs.sampled_component += 1;
        weight *= (1.f - in.reflectance) * (1.f - out.reflectance);
        if (absorbs_) weight *= dr::exp(-sigma_a_ * (1.f / cos_below + 1.f / in.cos_t));
        // Tungsten's rough coat has this factor when it samples its substrate and lacks it when it evaluates.
        if (roughness_) weight *= wi.z() / in.cos_t;

        // A rough coat weighs even a single direction against the density of its own.
        if (has_flag(bs.sampled_type, BSDFFlags::Delta) && !roughness_) {
            bs.pdf *= 1.f - probability;
            return {bs, weight / (1.f - probability)};
        }
        Float density = bs.pdf * squared(1.f / ior_) * out.cos_t / cos_below;
        if (!roughness_) {
            bs.pdf = density * (1.f - probability);
            return {bs, weight / (1.f - probability)};
        }
        const RoughReflection reflection = layer(si);
        const Spectrum value = weight * density + reflection.eval(wi, bs.wo);
        density = density * (1.f - probability) + reflection.pdf(wi, bs.wo) * probability;
        bs.pdf = density;
        return {bs, density > 0.f ? value / density : Spectrum(0.f)};
    }

    MI_DECLARE_CLASS(Coat)

  protected:
    std::pair<Spectrum, Float> evaluate(const SurfaceInteraction3f& si, const Vector3f& wo) const override {
        const Vector3f& wi = si.wi;
        if (wi.z() <= 0.f || wo.z() <= 0.f) return {Spectrum(0.f), 0.f};
        const FresnelTerm in = dielectric_fresnel(1.f / ior_, wi.z());
        const FresnelTerm out = dielectric_fresnel(1.f / ior_, wo.z());
        const Float probability = specular_probability(in.reflectance);

        Spectrum value(0.f);
        Float density = 0.f;
        if (in.reflectance < 1.f && out.reflectance < 1.f) {
            SurfaceInteraction3f below = si;
            below.wi = refracted(wi, in.cos_t);
            const Float compression = squared(1.f / ior_) * wo.z() / out.cos_t;
            const auto [value_below, density_below] =
                substrate_->eval_pdf(BSDFContext(), below, refracted(wo, out.cos_t), true);
            value = value_below * (compression * (1.f - in.reflectance) * (1.f - out.reflectance));
            if (absorbs_) value *= dr::exp(-sigma_a_ * (1.f / out.cos_t + 1.f / in.cos_t));
            density = (1.f - probability) * density_below * compression;
        }
        if (roughness_) {
            const RoughReflection reflection = layer(si);
            value += reflection.eval(wi, wo);
            density += probability * reflection.pdf(wi, wo);
        }
        return {value, density};
    }

  private:
    Vector3f refracted(const Vector3f& w, Float cos_below) const {
        return Vector3f(w.x() / ior_, w.y() / ior_, cos_below);
    }

    Float specular_probability(Float reflectance) const {
        return reflectance / (reflectance + mean_transmittance_ * (1.f - reflectance));
    }

    RoughReflection layer(const SurfaceInteraction3f& si) const {
        return {distribution_, roughness_->eval_1(si), ior_};
    }

    ref<BSDF> substrate_;
    ref<Texture> roughness_;
    RoughReflection::Distribution distribution_ = RoughReflection::Distribution::Ggx;
    float ior_;
    Color3f sigma_a_;
    bool absorbs_;
    float mean_transmittance_;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Coat<float, Rgb>)
