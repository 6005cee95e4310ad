// One scene rendered by Tungsten, and what is in its camera's output buffers. Knows neither Python nor
// Tungsten; what includes Tungsten's headers is compiled as Tungsten was, and meets the rest only here.
#pragma once

#include <chrono>
#include <cstdint>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

namespace tungsten_dip {

// How to render, and what the stock command's flags override in the scene file; what is unset or empty stays
// as the scene has it.
struct RenderOptions {
    int threads;
    std::uint64_t max_pixels;
    std::optional<std::uint32_t> spp;
    std::optional<std::uint32_t> seed;
    std::string input_directory;
    std::string output_directory;
    std::string output_file;
    std::string hdr_output_file;
};

// One quantity of the image, row 0 at the top, `channels` floats per pixel. `variance` is that of the mean.
// The halves and the variance are null where the integrator mixes samples in a way that keeps no independent
// halves.
struct QuantityPlanes {
    const char* name;
    int channels;
    float* mean;
    float* half_a = nullptr;
    float* half_b = nullptr;
    float* variance = nullptr;
};

// What is known of a render. `memory` owns every array; `spp` is null where every pixel has `uniform_spp`
// samples.
struct RenderBuffers {
    int width;
    int height;
    std::vector<QuantityPlanes> quantities;
    float* spp;
    float uniform_spp;
    std::shared_ptr<void> memory;
};

// What a driver needs to know of the scene file, after the overrides. The name of the picture is absolute;
// empty: not asked for.
struct RenderPlan {
    std::string integrator;
    std::string tonemap;
    std::string output_file;
    double checkpoint_interval_s;
    double timeout_s;
    bool resume;           // the scene asks for it and the integrator can do it
    bool writes_features;  // the integrator fills albedo, normal, depth and visibility
    std::uint32_t seed;
};

struct PictureTooLarge : std::runtime_error {
    using std::runtime_error::runtime_error;
};

// A loaded scene that asks for the buffers a fit needs: independent sampler, halves and variance of every
// quantity the integrator writes. The scene's own buffer files are still written as the scene asks. One at a
// time per process. Every method throws std::runtime_error (or what Tungsten throws) with a message in words;
// the constructor PictureTooLarge with the size of an image of more than `max_pixels`.
class Render {
  public:
    Render(const std::string& scene, const RenderOptions& options);
    ~Render();
    Render(const Render&) = delete;
    Render& operator=(const Render&) = delete;

    [[nodiscard]] const RenderPlan& plan() const;
    [[nodiscard]] std::uint32_t current_spp() const;
    [[nodiscard]] std::uint32_t total_spp() const;
    [[nodiscard]] bool done() const;

    // Continues from the state that an earlier render saved; false where there is none that fits.
    bool resume();

    // Renders one pass (`spp_step` samples per pixel): start it, then wait until wait_for_pass returns true.
    void start_pass();
    bool wait_for_pass(std::chrono::milliseconds at_most);

    void save_checkpoint();
    void save_outputs();

    // A copy of what is known so far; the render may go on.
    [[nodiscard]] RenderBuffers buffers() const;
    // The buffers themselves, without a copy (only the means are computed). The scene is freed; the render is
    // over.
    RenderBuffers take_buffers();

  private:
    struct Impl;
    std::unique_ptr<Impl> impl_;
};

// The version of the Tungsten that was found.
const char* tungsten_version();

// The stock command, compiled from the found checkout. Returns 1 where a scene could not be rendered, else 0.
int run_stock(int argc, const char** argv);

}  // namespace tungsten_dip
