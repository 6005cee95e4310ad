// tungsten_thinsheet: a film that reflects like a mirror and lets the rest through unbent. Reflections within
// the film are summed, per polarisation, or interfere by its thickness and the wavelength.
//
//   ior            float
//   interference   boolean; thickness is then in units of 500 nm
//   thickness      texture
//   sigma_a        rgb: absorption per thickness
#include "tungsten_bsdf.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class ThinSheet final : public TungstenBsdf<Float, Spectrum> {
  public:
    using Base = TungstenBsdf<Float, Spectrum>;
    MI_IMPORT_TYPES(Texture)

    explicit ThinSheet(const Properties& props) : Base(props) {
        ior_ = props.get<float>("ior", 1.5f);
        interference_ = props.get<bool>("interference", false);
        thickness_ = props.get_texture<Texture>("thickness", 0.5f);
        sigma_a_ = props.get<Color3f>("sigma_a", Color3f(0.f));
        Base::add_component(BSDFFlags::DeltaReflection | BSDFFlags::FrontSide | BSDFFlags::BackSide);
        Base::add_component(BSDFFlags::Null | BSDFFlags::FrontSide | BSDFFlags::BackSide);
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& /*unused*/, const SurfaceInteraction3f& si,
                                             Float sample1, const Point2f& /*unused*/,
                                             Mask active) const override {
        if (!active) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        const auto [reflectance, transmittance] = split(si);
        const Float probability = dr::mean(transmittance);
        if (sample1 < probability) {
            BSDFSample3f bs = Base::sample_of(-si.wi, BSDFFlags::Null, 1);
            bs.pdf = probability;
            return {bs, transmittance / probability};
        }
        BSDFSample3f bs =
            Base::sample_of(Vector3f(-si.wi.x(), -si.wi.y(), si.wi.z()), BSDFFlags::DeltaReflection, 0);
        bs.pdf = 1.f - probability;
        return {bs, reflectance / (1.f - probability)};
    }

    Spectrum eval_null_transmission(const SurfaceInteraction3f& si, Mask /*unused*/) const override {
        return split(si).second;
    }

    MI_DECLARE_CLASS(ThinSheet)

  protected:
    std::pair<Spectrum, Float> evaluate(const SurfaceInteraction3f& /*unused*/,
                                        const Vector3f& /*unused*/) const override {
        return {Spectrum(0.f), 0.f};
    }

  private:
    // Reflectance and transmittance of the film as a whole.
    std::pair<Spectrum, Spectrum> split(const SurfaceInteraction3f& si) const {
        const Float eta = 1.f / ior_;
        const Float cos_i = std::abs(si.wi.z());
        const Float sin_t_squared = eta * eta * (1.f - cos_i * cos_i);
        if (sin_t_squared > 1.f) return {Spectrum(1.f), Spectrum(0.f)};
        const Float cos_t = std::sqrt(1.f - sin_t_squared);
        const Float thickness = thickness_->eval_1(si);
        const Spectrum reflectance =
            interference_ ? interfering(eta, cos_i, cos_t, 500.f * thickness) : summed(eta, cos_i, cos_t);
        Spectrum transmittance = 1.f - reflectance;
        if (dr::max(sigma_a_) > 0.f && cos_t > 0.f)
            transmittance *= dr::exp(-sigma_a_ * (2.f * thickness / cos_t));
        return {reflectance, transmittance};
    }

    static Spectrum summed(Float eta, Float cos_i, Float cos_t) {
        const Float r_s = squared((eta * cos_i - cos_t) / (eta * cos_i + cos_t));
        const Float r_p = squared((eta * cos_t - cos_i) / (eta * cos_t + cos_i));
        return Spectrum(1.f - 0.5f * ((1.f - r_s) / (1.f + r_s) + (1.f - r_p) / (1.f + r_p)));
    }

    // Airy's formula at 650, 510 and 475 nm; the thickness is in nanometres.
    Spectrum interfering(Float eta, Float cos_i, Float cos_t, Float thickness) const {
        const Float t_s = 4.f * eta * cos_i * cos_t / squared(eta * cos_i + cos_t);
        const Float t_p = 4.f * eta * cos_i * cos_t / squared(eta * cos_t + cos_i);
        const Float r_s = 1.f - t_s;
        const Float r_p = 1.f - t_p;
        const Spectrum wavelengths(650.f, 510.f, 475.f);
        const Spectrum cos_phase = dr::cos(2.f * two_pi * thickness * cos_t * ior_ / wavelengths);
        const auto through = [&](Float t, Float r) {
            return Spectrum(squared(t) / (squared(r) + 1.f - 2.f * r * cos_phase));
        };
        return 1.f - 0.5f * (through(t_s, r_s) + through(t_p, r_p));
    }

    ref<Texture> thickness_;
    Color3f sigma_a_;
    float ior_;
    bool interference_;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(ThinSheet<float, Rgb>)
