// What the BSDF plugins share. Mitsuba has no counterpart of these models, so they are written here from
// Tungsten's formulas; where Tungsten's `sample` and `eval` disagree, so do these, because its picture is
// what must come out. All are for the variant scalar_rgb, one-sided, and ignore the component mask of the
// context; wi and wo are in the shading frame, and values include the cosine of wo.
#pragma once

#include <mitsuba/core/warp.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/texture.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <string>
#include <utility>

#include "tungsten_plugin.hpp"

namespace mitsuba {

struct FresnelTerm {
    float reflectance;
    float cos_t;  // cosine beyond the interface, 0 where light is totally reflected
};

// Fresnel's reflectance of a dielectric interface; `eta` is the index on this side over the one beyond.
inline FresnelTerm dielectric_fresnel(float eta, float cos_i) {
    const float sin_t_squared = eta * eta * (1.f - cos_i * cos_i);
    if (sin_t_squared > 1.f) return {.reflectance = 1.f, .cos_t = 0.f};
    const float cos_t = std::sqrt(std::max(1.f - sin_t_squared, 0.f));
    const float r_s = (eta * cos_i - cos_t) / (eta * cos_i + cos_t);
    const float r_p = (eta * cos_t - cos_i) / (eta * cos_t + cos_i);
    return {.reflectance = 0.5f * (r_s * r_s + r_p * r_p), .cos_t = cos_t};
}

// The cosine-weighted mean over the hemisphere of the reflectance inside a medium of index `ior`.
inline float diffuse_fresnel_inside(float ior) {
    constexpr int steps = 20000;
    double sum = 0;
    for (int i = 0; i < steps; ++i) {
        const double cos_squared = (i + 0.5) / steps;
        sum += dielectric_fresnel(ior, static_cast<float>(std::sqrt(cos_squared))).reflectance;
    }
    return static_cast<float>(sum / steps);
}

// Reflection by the microfacets of a dielectric surface (Walter et al., "Microfacet Models for Refraction
// through Rough Surfaces", EGSR 2007), with their three distributions.
struct RoughReflection {
    enum class Distribution : std::uint8_t { Beckmann, Phong, Ggx };

    Distribution distribution = Distribution::Ggx;
    float roughness = 0.1f;
    float ior = 1.5f;

    static Distribution distribution_from_name(const std::string& name) {
        if (name == "beckmann") return Distribution::Beckmann;
        if (name == "phong") return Distribution::Phong;
        if (name == "ggx") return Distribution::Ggx;
        Throw("Expected the distribution beckmann, phong or ggx, got \"%s\"", name);
    }

    // The parameter of the distribution; Phong's is an exponent. Tungsten has no smoother surface than 1e-3.
    [[nodiscard]] float alpha(float of_roughness) const {
        const float clamped = std::max(of_roughness, 1e-3f);
        return distribution == Distribution::Phong ? 2.f / (clamped * clamped) - 2.f : clamped;
    }

    // Wider than the surface at grazing angles, which keeps the weights small (Walter et al., section 5.3).
    [[nodiscard]] float sampling_alpha(float cos_i) const {
        return alpha((1.2f - 0.2f * std::sqrt(std::abs(cos_i))) * roughness);
    }

    [[nodiscard]] float density(float alpha, float cos_m) const {
        if (cos_m <= 0.f) return 0.f;
        const float cos_squared = cos_m * cos_m;
        const float tan_squared = std::max(1.f - cos_squared, 0.f) / cos_squared;
        switch (distribution) {
            case Distribution::Beckmann:
                return inv_pi * std::exp(-tan_squared / squared(alpha)) / squared(alpha * cos_squared);
            case Distribution::Phong:
                return (alpha + 2.f) / two_pi * static_cast<float>(std::pow(double{cos_m}, double{alpha}));
            default:
                return inv_pi * squared(alpha / (cos_squared * (squared(alpha) + tan_squared)));
        }
    }

    [[nodiscard]] float shadowing(float alpha, float cos_v) const {
        if (cos_v <= 0.f) return 0.f;
        const float tangent = std::sqrt(std::max(1.f - cos_v * cos_v, 0.f)) / cos_v;
        if (tangent == 0.f) return 1.f;
        if (distribution == Distribution::Ggx) return 2.f / (1.f + std::sqrt(1.f + squared(alpha * tangent)));
        const float a = distribution == Distribution::Phong ? std::sqrt(0.5f * alpha + 1.f) / tangent
                                                            : 1.f / (alpha * tangent);
        if (a >= 1.6f) return 1.f;
        return (3.535f * a + 2.181f * a * a) / (1.f + 2.276f * a + 2.577f * a * a);
    }

    template <typename Vector3f>
    [[nodiscard]] float eval(const Vector3f& wi, const Vector3f& wo) const {
        const Vector3f m = dr::normalize(wi + wo);
        const float a = alpha(roughness);
        const float reflectance = dielectric_fresnel(1.f / ior, dr::dot(wi, m)).reflectance;
        return reflectance * density(a, m.z()) * shadowing(a, wi.z()) * shadowing(a, wo.z()) * 0.25f / wi.z();
    }

    template <typename Vector3f>
    [[nodiscard]] float pdf(const Vector3f& wi, const Vector3f& wo) const {
        const Vector3f m = dr::normalize(wi + wo);
        return density(sampling_alpha(wi.z()), m.z()) * m.z() * 0.25f / std::abs(dr::dot(wi, m));
    }

    // A direction of reflection; it may point below the surface.
    template <typename Vector3f, typename Point2f>
    [[nodiscard]] Vector3f sample(const Vector3f& wi, const Point2f& u) const {
        const float a = sampling_alpha(wi.z());
        float cos_m;
        switch (distribution) {
            case Distribution::Beckmann:
                cos_m = 1.f / std::sqrt(1.f - squared(a) * std::log(1.f - u.x()));
                break;
            case Distribution::Phong:
                cos_m = static_cast<float>(std::pow(double{u.x()}, 1.0 / (double{a} + 2.0)));
                break;
            default:
                cos_m = 1.f / std::sqrt(1.f + squared(a) * u.x() / (1.f - u.x()));
        }
        const float sin_m = std::sqrt(std::max(1.f - cos_m * cos_m, 0.f));
        const Vector3f m(std::cos(two_pi * u.y()) * sin_m, std::sin(two_pi * u.y()) * sin_m, cos_m);
        return 2.f * dr::dot(wi, m) * m - wi;
    }
};

// A BSDF whose value and density are computed together, by `evaluate`.
template <typename Float, typename Spectrum>
class TungstenBsdf : public BSDF<Float, Spectrum> {
  public:
    MI_IMPORT_BASE(BSDF, m_flags, m_components)
    MI_IMPORT_TYPES(Texture)

    using Base::Base;

    Spectrum eval(const BSDFContext& /*context*/, const SurfaceInteraction3f& si, const Vector3f& wo,
                  Mask active) const override {
        return active ? evaluate(si, wo).first : Spectrum(0.f);
    }

    Float pdf(const BSDFContext& /*context*/, const SurfaceInteraction3f& si, const Vector3f& wo,
              Mask active) const override {
        return active ? evaluate(si, wo).second : 0.f;
    }

    std::pair<Spectrum, Float> eval_pdf(const BSDFContext& /*context*/, const SurfaceInteraction3f& si,
                                        const Vector3f& wo, Mask active) const override {
        return active ? evaluate(si, wo) : std::pair<Spectrum, Float>(0.f, 0.f);
    }

    [[nodiscard]] std::string to_string() const override { return std::string(this->class_name()) + "[]"; }

  protected:
    virtual std::pair<Spectrum, Float> evaluate(const SurfaceInteraction3f& si, const Vector3f& wo) const = 0;

    void add_component(uint32_t lobe_and_sides) {
        m_components.push_back(lobe_and_sides);
        m_flags = m_flags | lobe_and_sides;
    }

    // A sample of a lobe; its density is filled in by the caller.
    static BSDFSample3f sample_of(const Vector3f& wo, BSDFFlags lobe, uint32_t component) {
        auto bs = dr::zeros<BSDFSample3f>();
        bs.wo = wo;
        bs.eta = 1.f;
        bs.sampled_type = +lobe;
        bs.sampled_component = component;
        return bs;
    }

    // A sample of smooth lobes alone, weighted with what `evaluate` says of it.
    std::pair<BSDFSample3f, Spectrum> weighted(BSDFSample3f bs, const SurfaceInteraction3f& si) const {
        const auto [value, density] = evaluate(si, bs.wo);
        bs.pdf = density;
        if (density <= 0.f) return {bs, Spectrum(0.f)};
        return {bs, value / density};
    }
};

}  // namespace mitsuba
