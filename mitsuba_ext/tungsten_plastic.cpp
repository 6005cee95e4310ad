// tungsten_plastic: a diffuse base under a dielectric layer, smooth or rough, that may absorb.
//
//   albedo         texture: colour of the base
//   ior            float: index of refraction of the layer
//   sigma_a        rgb: absorption in the layer times its thickness
//   roughness      texture: of the layer; absent where it is smooth
//   distribution   beckmann, phong or ggx: of the rough layer's facets
#include "tungsten_bsdf.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class Plastic final : public TungstenBsdf<Float, Spectrum> {
  public:
    using Base = TungstenBsdf<Float, Spectrum>;
    MI_IMPORT_TYPES(Texture)

    explicit Plastic(const Properties& props) : Base(props) {
        m_albedo = props.get_texture<Texture>("albedo", 1.f);
        m_ior = props.get<float>("ior", 1.5f);
        m_sigma_a = props.get<Color3f>("sigma_a", Color3f(0.f));
        m_absorbs = dr::max(m_sigma_a) > 0.f;
        m_diffuse_fresnel = diffuse_fresnel_inside(m_ior);
        m_base_weight = std::exp(-2.f * dr::mean(m_sigma_a));
        if (props.has_property("roughness")) {
            m_roughness = props.get_texture<Texture>("roughness", 0.02f);
            m_distribution =
                RoughReflection::distribution_from_name(props.get<std::string>("distribution", "ggx"));
            m_base_weight *= m_albedo->mean();
        }
        Base::add_component((m_roughness ? BSDFFlags::GlossyReflection : BSDFFlags::DeltaReflection) |
                            BSDFFlags::FrontSide);
        Base::add_component(BSDFFlags::DiffuseReflection | BSDFFlags::FrontSide);
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& /*unused*/, const SurfaceInteraction3f& si,
                                             Float sample1, const Point2f& sample2,
                                             Mask active) const override {
        const Vector3f& wi = si.wi;
        if (!active || wi.z() <= 0.f) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        const Float reflectance = dielectric_fresnel(1.f / m_ior, wi.z()).reflectance;
        const Float probability = specular_probability(reflectance);
        if (sample1 >= probability)
            return Base::weighted(
                Base::sample_of(warp::square_to_cosine_hemisphere(sample2), BSDFFlags::DiffuseReflection, 1),
                si);
        if (m_roughness)
            return Base::weighted(
                Base::sample_of(layer(si).sample(wi, sample2), BSDFFlags::GlossyReflection, 0), si);
        BSDFSample3f bs = Base::sample_of(Vector3f(-wi.x(), -wi.y(), wi.z()), BSDFFlags::DeltaReflection, 0);
        bs.pdf = probability;
        return {bs, Spectrum(reflectance / probability)};
    }

    MI_DECLARE_CLASS(Plastic)

  protected:
    std::pair<Spectrum, Float> evaluate(const SurfaceInteraction3f& si, const Vector3f& wo) const override {
        const Vector3f& wi = si.wi;
        if (wi.z() <= 0.f || wo.z() <= 0.f) return {Spectrum(0.f), 0.f};
        const Float reflectance_i = dielectric_fresnel(1.f / m_ior, wi.z()).reflectance;
        const Float reflectance_o = dielectric_fresnel(1.f / m_ior, wo.z()).reflectance;
        const Float probability = specular_probability(reflectance_i);

        const Spectrum albedo = m_albedo->eval(si);
        Spectrum value = albedo / (1.f - albedo * m_diffuse_fresnel) *
                         ((1.f - reflectance_i) * (1.f - reflectance_o) * wo.z() * kInvPi / squared(m_ior));
        if (m_absorbs) value *= dr::exp(-m_sigma_a * (1.f / wo.z() + 1.f / wi.z()));
        Float density = (1.f - probability) * wo.z() * kInvPi;
        if (m_roughness) {
            const RoughReflection reflection = layer(si);
            value += reflection.eval(wi, wo);
            density += probability * reflection.pdf(wi, wo);
        }
        return {value, density};
    }

  private:
    Float specular_probability(Float reflectance) const {
        return reflectance / (reflectance + m_base_weight * (1.f - reflectance));
    }

    RoughReflection layer(const SurfaceInteraction3f& si) const {
        return {m_distribution, m_roughness->eval_1(si), m_ior};
    }

    ref<Texture> m_albedo;
    ref<Texture> m_roughness;
    RoughReflection::Distribution m_distribution = RoughReflection::Distribution::Ggx;
    float m_ior;
    Color3f m_sigma_a;
    bool m_absorbs;
    float m_diffuse_fresnel;
    float m_base_weight;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Plastic)
