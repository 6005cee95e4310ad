// tungsten_hair: a strand of hair seen from afar, as a cylinder of dielectric that absorbs.
// d'Eon et al., "An Energy-Conserving Hair Reflectance Model", EGSR 2011: three lobes (reflected,
// transmitted, reflected once inside), each a longitudinal function times an azimuthal one, which is
// integrated over the width of the strand once and tabulated.
//
//   roughness      float: of the reflection, in [0, 1]
//   scale_angle    float: tilt of the cuticle's scales, in degrees
//   sigma_a        rgb: absorption per radius of the strand
//   faces_viewer   boolean: the azimuth is counted from the viewer, and not from the normal of the curve
#include <array>
#include <numbers>
#include <vector>

#include "tungsten_bsdf.hpp"

namespace mitsuba {
namespace {

constexpr float hair_ior = 1.55f;

float cosine_of(float sine) { return std::sqrt(std::max(1.f - sine * sine, 0.f)); }

// Logarithm of the modified Bessel function of order 0.
float log_bessel_i0(float x) {
    if (x > 12.f) return x + 0.5f * (std::log(1.f / (two_pi * x)) + 1.f / (8.f * x));
    float sum = 1.f;
    float term = 1.f;
    for (int i = 1; i <= 10; ++i) {
        term *= x * x / (4.f * static_cast<float>(i) * static_cast<float>(i));
        sum += term;
    }
    return std::log(sum);
}

// Longitudinal scattering of variance v (equation 7).
float longitudinal(float v, float sin_i, float sin_o, float cos_i, float cos_o) {
    const float a = cos_i * cos_o / v;
    const float b = sin_i * sin_o / v;
    if (v < 0.1f)
        return std::exp(-b + log_bessel_i0(a) - 1.f / v + std::numbers::ln2_v<float> +
                        std::log(1.f / (2.f * v)));
    return std::exp(-b + log_bessel_i0(a)) / (2.f * v * std::sinh(1.f / v));
}

// Sine of the outgoing inclination (d'Eon et al., "Importance Sampling for Physically-Based Hair Fiber
// Models", SIGGRAPH Asia 2013 sketches).
float sample_longitudinal(float v, float sin_i, float cos_i, float u1, float u2) {
    const float cosine = 1.f + v * std::log(u1 + (1.f - u1) * std::exp(-2.f / v));
    return -cosine * sin_i + cosine_of(cosine) * std::cos(two_pi * u2) * cos_i;
}

// Sum of the Gaussians of deviation beta about all multiples of 2 pi.
float wrapped_gaussian(float beta, float phi) {
    const auto gaussian = [beta](float x) {
        return std::exp(-x * x / (2.f * beta * beta)) / (std::sqrt(two_pi) * beta);
    };
    float sum = 0.f;
    for (float shift = 0.f;; shift += two_pi) {
        const float terms = gaussian(phi + shift) + gaussian(phi - shift - two_pi);
        sum += terms;
        if (!(terms > 1e-4f)) return sum;
    }
}

// Abscissas and weights of Gauss and Legendre on [-1, 1], by Newton's method.
template <int count>
std::array<std::pair<float, float>, count> gauss_legendre() {
    std::array<std::pair<float, float>, count> rule;
    for (int i = 0; i < count; ++i) {
        double x = std::cos(std::numbers::pi * (i + 0.75) / (count + 0.5));
        double slope = 0.0;
        for (int step = 0; step < 20; ++step) {
            double before = 1.0;
            double value = x;
            for (int k = 2; k <= count; ++k) {
                const double next = ((2 * k - 1) * x * value - (k - 1) * before) / k;
                before = value;
                value = next;
            }
            slope = count * (x * value - before) / (x * x - 1.0);
            x -= value / slope;
        }
        rule[static_cast<size_t>(i)] = {static_cast<float>(x),
                                        static_cast<float>(2.0 / ((1.0 - x * x) * slope * slope))};
    }
    return rule;
}

// The azimuthal function of one lobe over (azimuth, cosine of half the difference of inclinations).
class AzimuthalLobe {
  public:
    static constexpr int size = 64;
    static constexpr size_t texels = size_t{size} * size;

    explicit AzimuthalLobe(std::vector<Rgb> values) : values_(std::move(values)), shares_(texels) {
        std::vector<float> weights(values_.size());
        for (int y = 0; y < size; ++y)
            for (int x = 0; x < size; ++x) {
                // The largest of a texel and its neighbours, so that what lies between them is sampled too.
                float& weight = weights[at(x, y)];
                for (int dy = -1; dy <= 1; ++dy)
                    for (int dx = -1; dx <= 1; ++dx)
                        if (x + dx >= 0 && x + dx < size && y + dy >= 0 && y + dy < size)
                            weight = std::max(weight, dr::max(values_[at(x + dx, y + dy)]));
            }
        for (int y = 0; y < size; ++y) {
            float sum = 0.f;
            for (int x = 0; x < size; ++x) sum += weights[at(x, y)];
            sums_[static_cast<size_t>(y)] = sum;
            for (int x = 0; x < size; ++x)
                shares_[at(x, y)] = sum < 1e-4f ? 1.f / size : weights[at(x, y)] / sum;
        }
    }

    [[nodiscard]] Rgb eval(float phi, float cos_half) const {
        const float u = (size - 1) * phi / two_pi;
        const Row row(cos_half);
        const int x = std::clamp(static_cast<int>(u), 0, size - 2);
        const float t = std::clamp(u - static_cast<float>(x), 0.f, 1.f);
        const auto along = [&](int y) { return values_[at(x, y)] * (1.f - t) + values_[at(x + 1, y)] * t; };
        return along(row.low) * (1.f - row.part) + along(row.high) * row.part;
    }

    [[nodiscard]] float pdf(float phi, float cos_half) const {
        const int x = std::clamp(static_cast<int>((size - 1) * phi / two_pi), 0, size - 1);
        return share(x, Row(cos_half)) * size / two_pi;
    }

    [[nodiscard]] float sample(float cos_half, float u) const {
        const Row row(cos_half);
        for (int x = 0; x < size; ++x) {
            const float here = share(x, row);
            if (u < here || x == size - 1)
                return two_pi * (static_cast<float>(x) + std::clamp(u / here, 0.f, 1.f)) / size;
            u -= here;
        }
        return 0.f;
    }

    [[nodiscard]] float weight(float cos_i) const {
        const Row row(cos_i);
        return (sums_[static_cast<size_t>(row.low)] * (1.f - row.part) +
                sums_[static_cast<size_t>(row.high)] * row.part) *
               two_pi / size;
    }

  private:
    struct Row {
        explicit Row(float cosine)
            : low(std::clamp(static_cast<int>((size - 1) * cosine), 0, size - 1)),
              high(std::min(low + 1, size - 1)),
              part(std::clamp((size - 1) * cosine - static_cast<float>(low), 0.f, 1.f)) {}
        int low, high;
        float part;
    };

    static size_t at(int x, int y) { return static_cast<size_t>(y) * size + static_cast<size_t>(x); }

    [[nodiscard]] float share(int x, const Row& row) const {
        return shares_[at(x, row.low)] * (1.f - row.part) + shares_[at(x, row.high)] * row.part;
    }

    std::vector<Rgb> values_;
    std::vector<float> shares_;
    std::array<float, size> sums_{};
};

// The lobes R, TT and TRT of a strand. Tungsten smooths all three by the roughness of the first.
std::vector<AzimuthalLobe> azimuthal_lobes(float beta, const Rgb& sigma_a) {
    constexpr int size = AzimuthalLobe::size;
    constexpr int points = 140;
    constexpr int samples = 2048;
    const auto rule = gauss_legendre<points>();
    std::vector<float> detector(samples);
    for (int i = 0; i < samples; ++i)
        detector[static_cast<size_t>(i)] =
            wrapped_gaussian(beta, static_cast<float>(i) / (samples - 1) * two_pi);
    const auto detected = [&](float phi) {
        const float u = std::abs(phi / two_pi * (samples - 1));
        const auto x = static_cast<size_t>(u);
        const float t = u - static_cast<float>(x);
        return detector[x % samples] * (1.f - t) + detector[(x + 1) % samples] * t;
    };

    std::array<std::vector<Rgb>, 3> tables;
    for (auto& table : tables) table.assign(AzimuthalLobe::texels, Rgb(0.f));
    for (int y = 0; y < size; ++y) {
        const float cos_half = static_cast<float>(y) / (size - 1);
        const float sin_squared = 1.f - cos_half * cos_half;
        const float bent_ior = std::sqrt(hair_ior * hair_ior - sin_squared) / cos_half;
        const Rgb absorption = sigma_a / std::sqrt(1.f - sin_squared / (hair_ior * hair_ior));
        for (const auto& [h, weight] : rule) {
            const float gamma_i = std::asin(std::clamp(h, -1.f, 1.f));
            const float gamma_t = std::asin(std::clamp(h / bent_ior, -1.f, 1.f));
            const float reflected =
                dielectric_fresnel(1.f / hair_ior, cos_half * std::cos(gamma_i)).reflectance;
            const Rgb crossing = dr::exp(-absorption * (2.f * std::cos(gamma_t)));
            const Rgb transmitted = squared(1.f - reflected) * crossing;
            const std::array<Rgb, 3> attenuation = {Rgb(reflected), transmitted,
                                                    transmitted * reflected * crossing};
            for (int x = 0; x < size; ++x) {
                const float phi = two_pi * static_cast<float>(x) / (size - 1);
                for (size_t p = 0; p < 3; ++p) {
                    const float exit = static_cast<float>(p) * (2.f * gamma_t + pi) - 2.f * gamma_i;
                    tables[p][static_cast<size_t>(y) * size + static_cast<size_t>(x)] +=
                        0.5f * weight * detected(phi - exit) * attenuation[p];
                }
            }
        }
    }
    std::vector<AzimuthalLobe> lobes;
    lobes.reserve(tables.size());
    for (auto& table : tables) lobes.emplace_back(std::move(table));
    return lobes;
}

}  // namespace

template <typename Float, typename Spectrum>
class Hair final : public TungstenBsdf<Float, Spectrum> {
  public:
    using Base = TungstenBsdf<Float, Spectrum>;
    MI_IMPORT_TYPES()

    explicit Hair(const Properties& props) : Base(props) {
        // The smallest roughness that the tables can hold.
        const float beta = std::max(pi / 2 * props.get<float>("roughness", 0.1f), 0.04f);
        const float tilt = props.get<float>("scale_angle", 2.f) * pi / 180.f;
        variances_ = {squared(beta), squared(0.5f * beta), squared(2.f * beta)};
        shifts_ = {-2.f * tilt, tilt, 4.f * tilt};
        lobes_ = azimuthal_lobes(beta, props.get<Color3f>("sigma_a", Color3f(0.f)));
        faces_viewer_ = props.get<bool>("faces_viewer", true);
        Base::add_component(BSDFFlags::GlossyReflection | BSDFFlags::FrontSide | BSDFFlags::BackSide);
        Base::add_component(BSDFFlags::GlossyTransmission | BSDFFlags::FrontSide | BSDFFlags::BackSide);
    }

    std::pair<BSDFSample3f, Spectrum> sample(const BSDFContext& /*unused*/, const SurfaceInteraction3f& si,
                                             Float sample1, const Point2f& sample2,
                                             Mask active) const override {
        if (!active) return {dr::zeros<BSDFSample3f>(), Spectrum(0.f)};
        const Frame3f strand = strand_frame(si);
        const Inclination in(strand.to_local(si.wi));

        std::array<Float, 3> weights;
        Float total = 0.f;
        for (size_t p = 0; p < 3; ++p) total += weights[p] = lobes_[p].weight(in.cosine);
        size_t p = 0;
        Float left = sample1 * total;
        while (p < 2 && left >= weights[p]) left -= weights[p++];
        const Float reused = std::clamp(left / weights[p], 0.f, 1.f - 1e-6f);

        const Float theta = in.angle + shifts_[p];
        const Float sin_o =
            sample_longitudinal(variances_[p], std::sin(theta), std::cos(theta), reused, sample2.y());
        const Float cos_o = cosine_of(sin_o);
        const Float angle_o = std::asin(std::clamp(sin_o, -1.f, 1.f));
        const Float phi = lobes_[p].sample(std::cos(0.5f * (angle_o - in.angle)), sample2.x());
        const Vector3f wo = strand.to_world(Vector3f(std::sin(phi) * cos_o, sin_o, std::cos(phi) * cos_o));
        return Base::weighted(Base::sample_of(wo, BSDFFlags::GlossyReflection, 0), si);
    }

    MI_DECLARE_CLASS(Hair)

  protected:
    std::pair<Spectrum, Float> evaluate(const SurfaceInteraction3f& si, const Vector3f& wo) const override {
        const Frame3f strand = strand_frame(si);
        const Vector3f local = strand.to_local(wo);
        const Inclination in(strand.to_local(si.wi));
        const Inclination out(local);
        const Float cos_half = std::cos(0.5f * (out.angle - in.angle));
        Float phi = std::atan2(local.x(), local.z());
        if (phi < 0.f) phi += two_pi;

        Spectrum value(0.f);
        Float density = 0.f;
        Float total = 0.f;
        for (size_t p = 0; p < 3; ++p) {
            const Float theta = in.angle + shifts_[p];
            const Float along =
                longitudinal(variances_[p], std::sin(theta), out.sine, std::cos(theta), out.cosine);
            const Float weight = lobes_[p].weight(in.cosine);
            value += along * lobes_[p].eval(phi, cos_half);
            density += weight * along * lobes_[p].pdf(phi, cos_half);
            total += weight;
        }
        return {value, density / total};
    }

  private:
    struct Inclination {
        explicit Inclination(const Vector3f& w)
            : sine(w.y()), cosine(cosine_of(w.y())), angle(std::asin(std::clamp(w.y(), -1.f, 1.f))) {}
        Float sine, cosine, angle;
    };

    // In the shading frame: y along the strand, z where the azimuth starts.
    Frame3f strand_frame(const SurfaceInteraction3f& si) const {
        const Vector3f along = dr::normalize(si.to_local(si.dp_dv));
        const Vector3f towards = faces_viewer_ ? Vector3f(si.wi) : Vector3f(0.f, 0.f, 1.f);
        const Vector3f z = dr::normalize(towards - along * dr::dot(along, towards));
        Frame3f frame;
        frame.s = dr::cross(along, z);
        frame.t = along;
        frame.n = z;
        return frame;
    }

    std::vector<AzimuthalLobe> lobes_;
    std::array<float, 3> variances_;
    std::array<float, 3> shifts_;
    bool faces_viewer_;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Hair<float, Rgb>)
