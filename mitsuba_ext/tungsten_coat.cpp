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
            if (auto* bsdf = prop.try_get<BSDF>()) m_substrate = bsdf;
        if (!m_substrate) Throw("Expected a nested BSDF under the coat");
        m_ior = props.get<float>("ior", 1.3f);
        m_sigma_a = props.get<Color3f>("sigma_a", Color3f(0.f));
        m_absorbs = dr::max(m_sigma_a) > 0.f;
        m_mean_transmittance = std::exp(-2.f * dr::mean(m_sigma_a));
        if (props.has_property("roughness")) {
            m_roughness = props.get_texture<Texture>("roughness", 0.02f);
            m_distribution =
                RoughReflection::distribution_from_name(props.get<std::string>("distribution", "ggx"));
        }
        Base::add_component((m_roughness ? BSDFFlags::GlossyReflection : BSDFFlags::DeltaReflection) |
                            BSDFFlags::FrontSide);
        for (size_t i = 0; i < m_substrate->component_count(); ++i)
            Base::add_component(m_substrate->flags(i));
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& context, const SurfaceInteraction3f& si,
                                             Float sample1, const Point2f& sample2,
                                             Mask active) const override {
        const Vector3f& wi = si.wi;
        if (!active || wi.z() <= 0.f) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        const FresnelTerm in = dielectric_fresnel(1.f / m_ior, wi.z());
        const Float probability = specular_probability(in.reflectance);
        if (sample1 < probability) {
            if (m_roughness)
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
        auto [bs, weight] = m_substrate->sample(context, below, reused, sample2, true);
        if (dr::all(weight == 0.f) || bs.wo.z() <= 0.f) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        const Float cos_below = bs.wo.z();
        const FresnelTerm out = dielectric_fresnel(m_ior, cos_below);
        if (out.reflectance == 1.f) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        bs.wo = Vector3f(bs.wo.x() * m_ior, bs.wo.y() * m_ior, out.cos_t);
        bs.sampled_component += 1;
        weight *= (1.f - in.reflectance) * (1.f - out.reflectance);
        if (m_absorbs) weight *= dr::exp(-m_sigma_a * (1.f / cos_below + 1.f / in.cos_t));
        // Tungsten's rough coat has this factor when it samples its substrate and lacks it when it evaluates.
        if (m_roughness) weight *= wi.z() / in.cos_t;

        // A rough coat weighs even a single direction against the density of its own.
        if (has_flag(bs.sampled_type, BSDFFlags::Delta) && !m_roughness) {
            bs.pdf *= 1.f - probability;
            return {bs, weight / (1.f - probability)};
        }
        Float density = bs.pdf * squared(1.f / m_ior) * out.cos_t / cos_below;
        if (!m_roughness) {
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
        const FresnelTerm in = dielectric_fresnel(1.f / m_ior, wi.z());
        const FresnelTerm out = dielectric_fresnel(1.f / m_ior, wo.z());
        const Float probability = specular_probability(in.reflectance);

        Spectrum value(0.f);
        Float density = 0.f;
        if (in.reflectance < 1.f && out.reflectance < 1.f) {
            SurfaceInteraction3f below = si;
            below.wi = refracted(wi, in.cos_t);
            const Float compression = squared(1.f / m_ior) * wo.z() / out.cos_t;
            const auto [value_below, density_below] =
                m_substrate->eval_pdf(BSDFContext(), below, refracted(wo, out.cos_t), true);
            value = value_below * (compression * (1.f - in.reflectance) * (1.f - out.reflectance));
            if (m_absorbs) value *= dr::exp(-m_sigma_a * (1.f / out.cos_t + 1.f / in.cos_t));
            density = (1.f - probability) * density_below * compression;
        }
        if (m_roughness) {
            const RoughReflection reflection = layer(si);
            value += reflection.eval(wi, wo);
            density += probability * reflection.pdf(wi, wo);
        }
        return {value, density};
    }

  private:
    Vector3f refracted(const Vector3f& w, Float cos_below) const {
        return Vector3f(w.x() / m_ior, w.y() / m_ior, cos_below);
    }

    Float specular_probability(Float reflectance) const {
        return reflectance / (reflectance + m_mean_transmittance * (1.f - reflectance));
    }

    RoughReflection layer(const SurfaceInteraction3f& si) const {
        return {m_distribution, m_roughness->eval_1(si), m_ior};
    }

    ref<BSDF> m_substrate;
    ref<Texture> m_roughness;
    RoughReflection::Distribution m_distribution = RoughReflection::Distribution::Ggx;
    float m_ior;
    Color3f m_sigma_a;
    bool m_absorbs;
    float m_mean_transmittance;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Coat)
