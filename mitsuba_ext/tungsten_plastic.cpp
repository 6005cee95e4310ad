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
        albedo_ = props.get_texture<Texture>("albedo", 1.f);
        ior_ = props.get<float>("ior", 1.5f);
        sigma_a_ = props.get<Color3f>("sigma_a", Color3f(0.f));
        absorbs_ = dr::max(sigma_a_) > 0.f;
        diffuse_fresnel_ = diffuse_fresnel_inside(ior_);
        base_weight_ = std::exp(-2.f * dr::mean(sigma_a_));
        if (props.has_property("roughness")) {
            roughness_ = props.get_texture<Texture>("roughness", 0.02f);
            distribution_ =
                RoughReflection::distribution_from_name(props.get<std::string>("distribution", "ggx"));
            base_weight_ *= albedo_->mean();
        }
        Base::add_component((roughness_ ? BSDFFlags::GlossyReflection : BSDFFlags::DeltaReflection) |
                            BSDFFlags::FrontSide);
        Base::add_component(BSDFFlags::DiffuseReflection | BSDFFlags::FrontSide);
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& /*unused*/, const SurfaceInteraction3f& si,
                                             Float sample1, const Point2f& sample2,
                                             Mask active) const override {
        const Vector3f& wi = si.wi;
        if (!active || wi.z() <= 0.f) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        const Float reflectance = dielectric_fresnel(1.f / ior_, wi.z()).reflectance;
        const Float probability = specular_probability(reflectance);
        if (sample1 >= probability)
            return Base::weighted(
                Base::sample_of(warp::square_to_cosine_hemisphere(sample2), BSDFFlags::DiffuseReflection, 1),
                si);
        if (roughness_)
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
        const Float reflectance_i = dielectric_fresnel(1.f / ior_, wi.z()).reflectance;
        const Float reflectance_o = dielectric_fresnel(1.f / ior_, wo.z()).reflectance;
        const Float probability = specular_probability(reflectance_i);

        const Spectrum albedo = albedo_->eval(si);
        Spectrum value = albedo / (1.f - albedo * diffuse_fresnel_) *
                         ((1.f - reflectance_i) * (1.f - reflectance_o) * wo.z() * inv_pi / squared(ior_));
        if (absorbs_) value *= dr::exp(-sigma_a_ * (1.f / wo.z() + 1.f / wi.z()));
        Float density = (1.f - probability) * wo.z() * inv_pi;
        if (roughness_) {
            const RoughReflection reflection = layer(si);
            value += reflection.eval(wi, wo);
            density += probability * reflection.pdf(wi, wo);
        }
        return {value, density};
    }

  private:
    Float specular_probability(Float reflectance) const {
        return reflectance / (reflectance + base_weight_ * (1.f - reflectance));
    }

    RoughReflection layer(const SurfaceInteraction3f& si) const {
        return {distribution_, roughness_->eval_1(si), ior_};
    }

    ref<Texture> albedo_;
    ref<Texture> roughness_;
    RoughReflection::Distribution distribution_ = RoughReflection::Distribution::Ggx;
    float ior_;
    Color3f sigma_a_;
    bool absorbs_;
    float diffuse_fresnel_;
    float base_weight_;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Plastic<float, Rgb>)
