// The integrator "tungsten_path": radiance and feature buffers with the meaning that Tungsten's path tracer
// gives them, from the same camera rays. Variant scalar_rgb only.
//
//   quantities                     what to record, of color albedo normal depth visibility (all)
//   min_bounces, max_bounces       light counts on paths of min_bounces to max_bounces - 1 bounces,
//                                  crossings of transparent surfaces included (0, 64)
//   enable_light_sampling          sample emitters from surfaces (true)
//   enable_volume_light_sampling   sample emitters from media (true)
//   enable_consistency_checks      drop directions on which shading and geometry disagree (false)
//   low_order_scattering           light that a medium scattered once counts (true)
//   include_surfaces               light that no medium scattered counts (true)
//   reconstruction_filter          Tungsten's name of the filter that distributes the samples ("tent")
//   pixel_center                   where in the pixel the filter is centred (0.5)
//   lens_blades, lens_angle        corners of the thin lens's aperture (0: a disk) and where the first is (0)
//   diaphragm_distance             how far behind the lens a second diaphragm of lens_radius is (0: none)
//   threads                        number of threads, the calling one included (1)
//   albedo_<id>                    texture: the albedo of the BSDF of that id, one for each that is seen
//
// render() returns a tensor of shape (height, width, channels): for every quantity, in the order of
// `quantities`, the mean of its even samples (half A), of its odd ones (half B) and the summed squared
// deviations from the mean of all, each with the channels of the quantity, and then the number of samples. A
// camera ray need not have a sample of every quantity. The parameter "progress" is the fraction done and may
// be read meanwhile. cancel() holds for every later render too, so that it cannot come too early.
//
// The result depends on the seed alone, not on the number of threads: every pixel has a random stream of its
// own.

#include <drjit/random.h>
#include <mitsuba/core/random.h>
#include <mitsuba/render/bsdf.h>
#include <mitsuba/render/emitter.h>
#include <mitsuba/render/film.h>
#include <mitsuba/render/integrator.h>
#include <mitsuba/render/medium.h>
#include <mitsuba/render/phase.h>
#include <mitsuba/render/scene.h>
#include <mitsuba/render/sensor.h>
#include <mitsuba/render/shape.h>
#include <mitsuba/render/texture.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <map>
#include <optional>
#include <sstream>
#include <string>
#include <string_view>
#include <vector>

#include "core.hpp"
#include "tungsten_lens.hpp"
#include "tungsten_lights.hpp"
#include "tungsten_plugin.hpp"

namespace mitsuba {
namespace {

using Variant = RenderAliases<float, Rgb>;
using Vector2 = Vector<float, 2>;
using Vector3 = Vector<float, 3>;
using Point2 = Point<float, 2>;
using Point3 = Point<float, 3>;
using Ray3 = Variant::Ray3f;
using SurfaceHit = Variant::SurfaceInteraction3f;
using MediumHit = Variant::MediumInteraction3f;
using Vertex = Variant::Interaction3f;

// Mitsuba's types are laid out for the instruction set that the wheel was compiled for.
#ifdef __x86_64__
static_assert(sizeof(Point3) == 16, "compile for x86-64-v3, as Mitsuba's wheel is");
#endif

constexpr uint32_t tile_size = 16;

class Random {
  public:
    Random(uint32_t seed, uint32_t pixel) : generator_(1, sample_tea_64(seed, pixel), pixel) {}

    float next() { return generator_.next_float32(); }
    Point2 next_2d() {
        const float x = next();
        return {x, next()};
    }

  private:
    dr::PCG32<uint32_t> generator_;
};

// Distributes samples by Tungsten's tabulated reconstruction filter: 31 bins per half, each as likely as the
// filter is high at the lower end of the bin *before* it. Negative lobes are lost: the sum of the bins passes
// 1 before it falls back to 1, and a sample takes the first bin at which the sum exceeds its number.
class FilterTable {
  public:
    explicit FilterTable(std::string_view name) {
        if (name == "box" || name == "dirac") {
            box_width_ = name == "box" ? 1.f : 0.f;
            return;
        }
        const auto [function, width] = find(name);
        bin_width_ = width / bin_count;
        std::array<float, bin_count> heights{};
        float sum = 0.f;
        for (size_t i = 0; i < bin_count; ++i) {
            heights[i] = function(static_cast<float>(i) * width / bin_count);
            sum += heights[i];
        }
        for (size_t i = 1; i < bin_count; ++i) sums_[i] = sums_[i - 1] + heights[i - 1] / sum;
    }

    // The offset from the centre of the pixel, in pixels.
    [[nodiscard]] Vector2 sample(Point2 uniform) const {
        if (bin_width_ == 0.f) return {(uniform.x() - 0.5f) * box_width_, (uniform.y() - 0.5f) * box_width_};
        return {sample(uniform.x()), sample(uniform.y())};
    }

  private:
    using Function = float (*)(float);
    static constexpr size_t bin_count = 31;

    [[nodiscard]] float sample(float uniform) const {
        const float sign = uniform < 0.5f ? -1.f : 1.f;
        const float target = 2.f * (uniform < 0.5f ? uniform : uniform - 0.5f);
        size_t bin = 1;
        while (bin < bin_count - 1 && target >= sums_[bin]) ++bin;
        const float within = (target - sums_[bin - 1]) / (sums_[bin] - sums_[bin - 1]);
        return sign * bin_width_ * (static_cast<float>(bin) + within);
    }

    // The filter at a distance of x >= 0 pixels, and its radius.
    static std::pair<Function, float> find(std::string_view name) {
        if (name == "tent") return {[](float x) { return 1.f - x; }, 1.f};
        if (name == "gaussian")
            return {[](float x) { return std::max(std::exp(-2.f * x * x) - std::exp(-8.f), 0.f); }, 2.f};
        if (name == "mitchell_netravali")
            return {[](float x) { return cubic(x, 1.f / 3.f, 1.f / 3.f); }, 2.f};
        if (name == "catmull_rom") return {[](float x) { return cubic(x, 0.f, 0.5f); }, 2.f};
        if (name == "lanczos")
            return {[](float x) {
                        return x == 0.f ? 1.f
                                        : 2.f * std::sin(pi * x) * std::sin(pi * x / 2.f) / (pi * pi * x * x);
                    },
                    2.f};
        Throw("reconstruction_filter: unknown filter \"%s\"", name);
    }

    // Mitchell and Netravali, "Reconstruction Filters in Computer Graphics", SIGGRAPH 1988, equation 8.
    static float cubic(float x, float b, float c) {
        if (x < 1.f)
            return ((12.f - 9.f * b - 6.f * c) * x * x * x + (-18.f + 12.f * b + 6.f * c) * x * x + 6.f -
                    2.f * b) /
                   6.f;
        return ((-b - 6.f * c) * x * x * x + (6.f * b + 30.f * c) * x * x + (-12.f * b - 48.f * c) * x +
                8.f * b + 24.f * c) /
               6.f;
    }

    float box_width_ = 0.f;
    float bin_width_ = 0.f;
    std::array<float, bin_count> sums_{};
};

using tungsten_dip::Quantity;
using enum Quantity;

// A value for every quantity.
template <typename T>
class ByQuantity {
  public:
    T& operator[](Quantity quantity) { return values_[static_cast<size_t>(quantity)]; }
    const T& operator[](Quantity quantity) const { return values_[static_cast<size_t>(quantity)]; }

  private:
    std::array<T, tungsten_dip::quantity_names.size()> values_{};
};

// What one camera ray records: a quantity that it says nothing of stays empty and is not averaged.
class Sample {
  public:
    void set(Quantity quantity, const Vector3& value) {
        values_[quantity] = {value.x(), value.y(), value.z()};
    }
    void set(Quantity quantity, const Rgb& value) { values_[quantity] = {value.r(), value.g(), value.b()}; }
    void set(Quantity quantity, float value) { values_[quantity] = {value, value, value}; }
    [[nodiscard]] const std::optional<std::array<float, 3>>& get(Quantity quantity) const {
        return values_[quantity];
    }

  private:
    ByQuantity<std::optional<std::array<float, 3>>> values_;
};

// The statistics of one quantity of one pixel. Samples that are not finite are left out.
class Accumulator {
  public:
    void add(const std::array<float, 3>& sample) {
        if (!std::ranges::all_of(sample, [](float x) { return std::isfinite(x); })) return;
        const size_t half = count_ & 1U;
        ++count_;
        for (size_t c = 0; c < 3; ++c) {
            const double value = sample[c];
            half_sums_[half][c] += value;
            const double delta = value - means_[c];  // Welford, Technometrics 4 (1962)
            means_[c] += delta / count_;
            squared_deviations_[c] += delta * (value - means_[c]);
        }
    }

    void store(size_t channels, float* out) const {
        const double count_a = std::max((count_ + 1) / 2, 1U);
        const double count_b = std::max(count_ / 2, 1U);
        for (size_t c = 0; c < channels; ++c) {
            out[c] = static_cast<float>(half_sums_[0][c] / count_a);
            out[channels + c] = static_cast<float>(half_sums_[1][c] / count_b);
            out[2 * channels + c] = static_cast<float>(squared_deviations_[c]);
        }
        out[3 * channels] = static_cast<float>(count_);
    }

  private:
    uint32_t count_ = 0;
    std::array<std::array<double, 3>, 2> half_sums_{};
    std::array<double, 3> means_{};
    std::array<double, 3> squared_deviations_{};
};

float power_heuristic(float pdf, float other) {
    const float squared = pdf * pdf;
    return squared > 0.f ? squared / (squared + other * other) : 0.f;
}

bool is_black(const Rgb& value) { return !(dr::max(value) > 0.f); }

// A path on its way from the camera.
struct Path {  // NOLINT(clang-analyzer-optin.performance.Padding): fields in the order of their meaning
    Ray3 ray;
    const Variant::Medium* medium;
    SurfaceHit hit;  // what the ray meets
    Sample* sample;
    bool is_recorded;  // whether the features are settled
    Rgb radiance{0.f};
    Rgb throughput{1.f};
    int bounce = 0;
    int medium_bounces = 0;
    float distance = 0.f;  // to the last surface, along the path
    Point3 segment_start;
    bool was_specular = true;
    // The last vertex that scattered, the pdf of the direction it chose, and whether emitters were sampled
    // there.
    Vertex vertex = dr::zeros<Vertex>();
    float direction_pdf = 0.f;
    bool samples_lights = false;
};

// How a path goes on from a surface.
struct Scattering {
    enum Kind : uint8_t { none, forward, specular, smooth };
    Kind kind = none;
    Vector3 local_direction;
    Rgb weight;
    float pdf = 0.f;
};

class TungstenPath final : public Variant::Integrator {
  public:
    using Base = Variant::Integrator;
    using Scene = Variant::Scene;
    using Sensor = Variant::Sensor;
    using Medium = Variant::Medium;
    using Emitter = Variant::Emitter;
    using Texture = Variant::Texture;
    using Base::TensorXf;

    explicit TungstenPath(const Properties& properties)
        : Base(properties),
          min_bounces_(properties.get<int>("min_bounces", 0)),
          max_bounces_(properties.get<int>("max_bounces", 64)),
          light_sampling_(properties.get<bool>("enable_light_sampling", true)),
          volume_light_sampling_(properties.get<bool>("enable_volume_light_sampling", true)),
          consistency_checks_(properties.get<bool>("enable_consistency_checks", false)),
          low_order_scattering_(properties.get<bool>("low_order_scattering", true)),
          include_surfaces_(properties.get<bool>("include_surfaces", true)),
          filter_(properties.get<std::string_view>("reconstruction_filter", "tent")),
          pixel_center_(properties.get<float>("pixel_center", 0.5f)),
          lens_(properties),
          threads_(properties.get<uint32_t>("threads", 1)) {
        std::istringstream names{std::string(
            properties.get<std::string_view>("quantities", "color albedo normal depth visibility"))};
        for (std::string name; names >> name;) {
            const auto quantity = tungsten_dip::quantity_from_name(name);
            if (!quantity) Throw("quantities: unknown quantity \"%s\"", name);
            quantities_.push_back(*quantity);
        }
        constexpr std::string_view prefix = "albedo_";
        for (const auto& property : properties)
            if (property.name().starts_with(prefix))
                albedos_.emplace(property.name().substr(prefix.size()),
                                 properties.get_unbounded_texture<Texture>(property.name()));
        records_features_ =
            std::ranges::any_of(quantities_, [](Quantity quantity) { return quantity != color; });
    }

    // Python reads it while threads store it: a float in memory is the old one or the new one.
    void traverse(TraversalCallback* callback) override {
        callback->put("progress", progress_, ParamFlags::NonDifferentiable);
    }

    TensorXf render(Scene* scene, Sensor* sensor, uint32_t seed, uint32_t spp, bool /*develop*/,
                    bool /*evaluate*/) override {
        m_render_timer.reset();
        sees_through_ = has_transparency(*scene);
        lights_.prepare(*scene);
        surrounded_by_several_ =
            scene->environment() != nullptr && scene->environment()->class_name() == "Environments";
        const auto size = sensor->film()->crop_size();
        const size_t channels = pixel_channels();
        std::vector<float> image(static_cast<size_t>(size.x()) * size.y() * channels);

        const uint32_t tiles_x = (size.x() + tile_size - 1) / tile_size;
        const uint32_t tiles = tiles_x * ((size.y() + tile_size - 1) / tile_size);
        std::atomic<uint32_t> tiles_done = 0;
        std::atomic_ref(progress_).store(0.f);
        // Not by drjit's pool of threads, whose destruction now and then waits for ever.
        tungsten_dip::parallel_for(static_cast<int>(tiles), static_cast<int>(threads_), [&](int index) {
            const auto tile = static_cast<uint32_t>(index);
            const uint32_t x0 = tile % tiles_x * tile_size;
            const uint32_t y0 = tile / tiles_x * tile_size;
            for (uint32_t y = y0; y < std::min(y0 + tile_size, size.y()); ++y)
                for (uint32_t x = x0; x < std::min(x0 + tile_size, size.x()); ++x) {
                    const uint32_t pixel = y * size.x() + x;
                    render_pixel(*scene, *sensor, {x, y}, size, {seed, pixel}, spp, &image[pixel * channels]);
                }
            std::atomic_ref(progress_).store(static_cast<float>(++tiles_done) / static_cast<float>(tiles));
        });
        const std::array<size_t, 3> shape{size.y(), size.x(), channels};
        return {image.data(), shape.size(), shape.data()};
    }

    std::string to_string() const override {
        return "TungstenPath[max_bounces=" + std::to_string(max_bounces_) + "]";
    }

    MI_DECLARE_CLASS(TungstenPath)

  private:
    [[nodiscard]] size_t pixel_channels() const {
        size_t channels = 0;
        for (const Quantity quantity : quantities_) channels += 3 * channel_count(quantity) + 1;
        return channels;
    }

    // Whether a shadow ray can be anything but blocked or free.
    static bool has_transparency(const Scene& scene) {
        if ((scene.shape_types() & +ShapeType::Instance) != 0) return true;  // what is in it is not listed
        return std::ranges::any_of(scene.shapes(), [](const auto& shape) {
            return shape->is_medium_transition() ||
                   (shape->bsdf() && has_flag(shape->bsdf()->flags(), BSDFFlags::Null));
        });
    }

    void render_pixel(const Scene& scene, const Sensor& sensor, Vector<uint32_t, 2> position,
                      Vector<uint32_t, 2> size, Random random, uint32_t spp, float* out) const {
        ByQuantity<Accumulator> accumulators;
        for (uint32_t i = 0; i < spp && !should_stop(); ++i) {
            const Vector2 offset = filter_.sample(random.next_2d());
            const Point2 film((static_cast<float>(position.x()) + pixel_center_ + offset.x()) /
                                  static_cast<float>(size.x()),
                              (static_cast<float>(position.y()) + pixel_center_ + offset.y()) /
                                  static_cast<float>(size.y()));
            const Point2 lens =
                sensor.needs_aperture_sample() ? lens_.aperture_sample(random.next_2d()) : Point2(0.5f);
            auto [ray, weight] = sensor.sample_ray(0.f, 0.f, film, lens);
            undo_clipping(sensor, ray);
            Sample sample;
            sample.set(color, lens_.lets_through(sensor, ray)
                                  ? weight * radiance(scene, sensor.medium(), ray, random, sample)
                                  : Rgb(0.f));
            for (const Quantity quantity : quantities_)
                if (const auto& value = sample.get(quantity)) accumulators[quantity].add(*value);
        }
        for (const Quantity quantity : quantities_) {
            const size_t channels = channel_count(quantity);
            accumulators[quantity].store(channels, out);
            out += 3 * channels + 1;
        }
    }

    // Tungsten's rays begin at the lens and have no end; Mitsuba's lie between its two clipping planes.
    static void undo_clipping(const Sensor& sensor, Ray3& ray) {
        const auto* camera = dynamic_cast<const Variant::ProjectiveCamera*>(&sensor);
        if (camera == nullptr) return;
        const Vector3 forward = camera->world_transform() * Vector3(0.f, 0.f, 1.f);
        ray.o -= ray.d * (camera->near_clip() / dr::dot(ray.d, forward));
        ray.maxt = dr::Largest<float>;
    }

    // Follows one path. Features are recorded at the first surface where it does not go on specularly or
    // straight ahead; a path that a medium or chance ends before says nothing of them.
    Rgb radiance(const Scene& scene, const Medium* medium, const Ray3& ray, Random& random,
                 Sample& sample) const {
        Path path{.ray = ray,
                  .medium = medium,
                  .hit = scene.ray_intersect(ray),
                  .sample = &sample,
                  .is_recorded = !records_features_,
                  .segment_start = ray.o};
        while ((path.hit.is_valid() || path.medium != nullptr) && path.bounce < max_bounces_) {
            if (should_stop()) return path.radiance;
            auto medium_hit = dr::zeros<MediumHit>();
            const bool in_medium = path.medium != nullptr && scatters(*path.medium, path.ray, path.hit.t,
                                                                      random, path.throughput, medium_hit);
            // No light comes from endlessly far within a medium, and nothing is seen there.
            if (!in_medium && !path.hit.is_valid()) return path.radiance;
            const bool goes_on =
                in_medium ? pass_medium(scene, medium_hit, random, path) : pass_surface(scene, random, path);
            if (!goes_on) return path.radiance;
            if (is_black(path.throughput)) break;
            // Tungsten's Russian roulette.
            const float survival = dr::max(path.throughput);
            if (path.bounce > 2 && survival < 0.1f) {
                if (random.next() >= survival) return path.radiance;
                path.throughput /= survival;
            }
            ++path.bounce;
            if (path.bounce < max_bounces_) path.hit = scene.ray_intersect(path.ray);
        }
        leave(scene, path);
        return path.radiance;
    }

    // Scatters in the medium; returns whether the path goes on.
    bool pass_medium(const Scene& scene, const MediumHit& hit, Random& random, Path& path) const {
        ++path.medium_bounces;
        path.samples_lights = volume_light_sampling_ && (path.medium_bounces > 1 || low_order_scattering_);
        path.was_specular = !path.samples_lights;
        const Variant::PhaseFunctionContext context(nullptr);
        const auto* phase = path.medium->phase_function();
        if (path.samples_lights && path.bounce < max_bounces_ - 1) {
            const LightSample light = sample_light(hit, random);
            const auto [value, pdf] = phase->eval_pdf(context, hit, light.direction.d);
            light_from(scene, hit, light, value, pdf, path.medium, path);
        }
        const float lobe = random.next();
        const auto [direction, weight, pdf] = phase->sample(context, hit, lobe, random.next_2d());
        if (!(pdf > 0.f)) return false;
        path.throughput *= weight;
        path.vertex = hit;
        path.direction_pdf = pdf;
        path.segment_start = hit.p;
        path.ray = hit.spawn_ray(direction);
        return true;
    }

    // Scatters at the surface, or passes it; returns whether the path goes on.
    bool pass_surface(const Scene& scene, Random& random, Path& path) const {
        const SurfaceHit& hit = path.hit;
        path.distance += dr::norm(hit.p - path.segment_start);
        if (path.medium_bounces == 1 && !low_order_scattering_) return false;
        const auto& bsdf = *hit.bsdf();
        const bool has_smooth_lobe = has_flag(bsdf.flags(), BSDFFlags::Smooth);
        const Emitter* emitter = hit.shape->emitter();
        const Scattering next = scatter(bsdf, hit, random);
        const Vector3 direction = hit.to_world(next.local_direction);
        bool goes_on = next.kind != Scattering::none;
        // Even where the path goes straight on: the value of a partly transparent BSDF includes how rarely it
        // does not.
        const bool samples_lights =
            light_sampling_ && (path.medium_bounces > 0 || include_surfaces_) && has_smooth_lobe;
        std::optional<float> light_visibility;
        if (samples_lights && path.bounce < max_bounces_ - 1)
            light_visibility = light_from_surface(scene, bsdf, random, path);
        // Light that is weighed against light samples counts on the way through as well: those do not ask how
        // the path goes on from here.
        const bool is_lit_by =
            next.kind != Scattering::forward || (!path.was_specular && path.samples_lights);
        if (emitter != nullptr && path.bounce >= min_bounces_ && is_lit_by)
            path.radiance += path.throughput * emitted(scene, hit, *emitter, path);
        if (next.kind != Scattering::forward) {
            goes_on = goes_on && is_consistent(bsdf, hit, direction);
            if (goes_on) {
                path.was_specular = next.kind == Scattering::specular;
                path.vertex = hit;
                path.direction_pdf = next.pdf;
                path.samples_lights = samples_lights;
            }
        }
        if (path.medium_bounces == 0 && !include_surfaces_ && has_smooth_lobe) return false;

        if (!path.is_recorded && (!path.was_specular || !goes_on)) {
            path.is_recorded = true;
            path.sample->set(depth, path.distance);
            path.sample->set(normal, Vector3(hit.sh_frame.n));
            path.sample->set(
                albedo, surface_albedo(bsdf, hit) + (emitter != nullptr ? emitter->eval(hit) : Rgb(0.f)));
            if (light_visibility) path.sample->set(visibility, *light_visibility);
        }
        if (!goes_on) return false;
        path.throughput *= next.weight;
        if (hit.is_medium_transition()) path.medium = hit.target_medium(direction);
        path.segment_start = hit.p;
        path.ray = hit.spawn_ray(direction);
        return true;
    }

    // Ends a path that no surface stopped.
    void leave(const Scene& scene, Path& path) const {
        const Emitter* sky =
            path.bounce >= min_bounces_ && path.bounce < max_bounces_ ? scene.environment() : nullptr;
        auto hit = dr::zeros<SurfaceHit>();
        hit.t = dr::Infinity<float>;
        hit.wi = -path.ray.d;
        if (sky != nullptr) path.radiance += path.throughput * emitted(scene, hit, *sky, path);
        if (path.is_recorded) return;
        if (path.bounce == 0) path.sample->set(depth, 0.f);
        path.sample->set(normal, -path.ray.d);
        if (sky != nullptr) path.sample->set(albedo, Rgb(sky->eval(hit)));
    }

    // What an emitter sends back along the ray, weighted against the sampling of emitters at the vertex
    // before.
    [[nodiscard]] Rgb emitted(const Scene& scene, const SurfaceHit& hit, const Emitter& emitter,
                              const Path& path) const {
        const Rgb seen = emitter.eval(hit);
        if (path.was_specular || !path.samples_lights) return seen;
        Variant::DirectionSample3f towards(&scene, hit, path.vertex);
        towards.n = hit.n;  // of the face, by which lights are sampled
        // Of several lights around the scene a ray sees one, but all light a surface. (The others' own
        // `eval_direction` wants coordinates in their map, which only their samples have.)
        const bool all_light = surrounded_by_several_ && &emitter == scene.environment();
        const Rgb emission = all_light ? Rgb(emitter.eval_direction(path.vertex, towards)) : seen;
        if (is_black(emission)) return emission;
        return emission *
               power_heuristic(path.direction_pdf, lights_.probability(path.vertex.p, emitter) *
                                                       emitter.pdf_direction(path.vertex, towards, true));
    }

    static Scattering scatter(const Variant::BSDF& bsdf, const SurfaceHit& hit, Random& random) {
        const float lobe = random.next();
        const auto [sample, weight] = bsdf.sample(BSDFContext(), hit, lobe, random.next_2d());
        Scattering result{
            .kind = Scattering::none, .local_direction = sample.wo, .weight = weight, .pdf = sample.pdf};
        if (!(sample.pdf > 0.f)) return result;
        if (has_flag(sample.sampled_type, BSDFFlags::Null))
            result.kind = Scattering::forward;
        else if (has_flag(sample.sampled_type, BSDFFlags::Delta))
            result.kind = Scattering::specular;
        else
            result.kind = Scattering::smooth;
        return result;
    }

    [[nodiscard]] bool is_consistent(const Variant::BSDF& bsdf, const SurfaceHit& hit,
                                     const Vector3& direction) const {
        return !consistency_checks_ ||
               (dr::dot(hit.n, direction) < 0.f) == (dr::dot(bsdf.sh_frame(hit, true).n, direction) < 0.f);
    }

    [[nodiscard]] Rgb surface_albedo(const Variant::BSDF& bsdf, const SurfaceHit& hit) const {
        const auto found = albedos_.find(bsdf.id());
        if (found == albedos_.end()) Throw("no texture \"albedo_%s\" for the BSDF of that id", bsdf.id());
        return found->second->eval(hit);
    }

    // Decides whether a medium scatters before the surface at distance `surface_t`, and weighs the
    // throughput.
    static bool scatters(const Medium& medium, Ray3 ray, float surface_t, Random& random, Rgb& throughput,
                         MediumHit& hit) {
        const auto [sigma_s, sigma_n, sigma_t] = medium.get_scattering_coefficients(hit);
        if (is_black(sigma_s)) {
            throughput *= dr::exp(-surface_t * sigma_t);
            return false;
        }
        // The channel that picks the distance is random; the balance heuristic over all three keeps colour
        // noise low.
        const auto channel = static_cast<uint32_t>(3.f * random.next());
        hit = medium.sample_interaction(ray, random.next(), std::min(channel, 2U), true);
        auto surface = dr::zeros<SurfaceHit>();
        surface.t = surface_t;
        const auto [transmittance, pdf] = medium.transmittance_eval_pdf(hit, surface, true);
        const float mean_pdf = dr::mean(pdf);
        throughput *= mean_pdf > 0.f ? transmittance / mean_pdf : Rgb(0.f);
        if (!hit.is_valid() || hit.t >= surface_t) return false;
        throughput *= hit.sigma_s;
        return true;
    }

    struct LightSample {
        Variant::DirectionSample3f direction;
        Rgb weight;  // radiance over pdf, unless something is in the way
    };

    template <typename Hit>
    LightSample sample_light(const Hit& from, Random& random) const {
        const auto [emitter, probability] = lights_.choose(from.p, random.next());
        if (emitter == nullptr)
            return {.direction = dr::zeros<Variant::DirectionSample3f>(), .weight = Rgb(0.f)};
        auto [direction, weight] = emitter->sample_direction(from, random.next_2d(), true);
        direction.pdf *= probability;
        return {.direction = direction, .weight = weight / probability};
    }

    // Adds the light that `from`, of this value and pdf, passes on from a sampled emitter through a medium.
    // Returns how much of it arrives, or nothing if it was not asked.
    template <typename Hit>
    std::optional<float> light_from(const Scene& scene, const Hit& from, const LightSample& light,
                                    const Rgb& value, float pdf, const Medium* medium, Path& path) const {
        if (!(light.direction.pdf > 0.f) || is_black(value)) return {};
        const Point3& target = light.direction.p;
        const bool is_endless = has_flag(light.direction.emitter->flags(), EmitterFlags::Infinite);
        const Rgb passed =
            transmittance(scene, from.spawn_ray_to(target), target, is_endless, medium, path.bounce + 1);
        const float weight = light.direction.delta ? 1.f : power_heuristic(light.direction.pdf, pdf);
        path.radiance += path.throughput * value * light.weight * passed * weight;
        return dr::mean(passed);
    }

    std::optional<float> light_from_surface(const Scene& scene, const Variant::BSDF& bsdf, Random& random,
                                            Path& path) const {
        const SurfaceHit& hit = path.hit;
        const LightSample light = sample_light(hit, random);
        const Vector3 local = hit.to_local(light.direction.d);
        if (!is_consistent(bsdf, hit, light.direction.d)) return {};
        const auto [value, pdf] = bsdf.eval_pdf(BSDFContext(), hit, local);
        const Medium* medium =
            hit.is_medium_transition() ? hit.target_medium(light.direction.d) : path.medium;
        return light_from(scene, hit, light, value, pdf, medium, path);
    }

    // What of the light reaches `target` along a ray; every transparent surface on the way is a bounce. No
    // medium lets through what comes from endlessly far.
    Rgb transmittance(const Scene& scene, Ray3 ray, const Point3& target, bool is_endless,
                      const Medium* medium, int bounce) const {
        if (!sees_through_ && medium == nullptr)
            return {bounce < min_bounces_ || scene.ray_test(ray) ? 0.f : 1.f};
        for (Rgb result(1.f);;) {
            auto preliminary = scene.ray_intersect_preliminary(ray);
            const bool is_hit = preliminary.is_valid();
            // Within an instance the shape is not known yet; what is opaque there lets nothing through below.
            if (is_hit && preliminary.instance == nullptr &&
                !has_flag(preliminary.shape->bsdf()->flags(), BSDFFlags::Null))
                return {0.f};
            const float distance = is_hit ? preliminary.t : ray.maxt;
            if (medium != nullptr) {
                if (!is_hit && is_endless) return {0.f};
                result *= dr::exp(-distance * medium->get_majorant(dr::zeros<MediumHit>()));
            }
            if (!is_hit) return bounce >= min_bounces_ ? result : Rgb(0.f);
            const SurfaceHit hit = preliminary.compute_surface_interaction(ray);
            result *= hit.bsdf()->eval_null_transmission(hit);
            if (is_black(result) || ++bounce >= max_bounces_ || should_stop()) return {0.f};
            if (hit.is_medium_transition()) medium = hit.target_medium(ray.d);
            ray = hit.spawn_ray_to(target);
        }
    }

    int min_bounces_;
    int max_bounces_;
    bool light_sampling_;
    bool volume_light_sampling_;
    bool consistency_checks_;
    bool low_order_scattering_;
    bool include_surfaces_;
    FilterTable filter_;
    float pixel_center_;
    TungstenLens lens_;
    LightChooser lights_;
    uint32_t threads_;
    std::vector<Quantity> quantities_;
    std::map<std::string, ref<Texture>, std::less<>> albedos_;
    bool records_features_ = false;
    bool sees_through_ = true;
    bool surrounded_by_several_ = false;  // by lights of the plugin tungsten_environments
    float progress_ = 0.f;
};

}  // namespace
}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(TungstenPath)
