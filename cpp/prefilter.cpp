// Pre-filtering of features by cross-filtered non-local means.
//
// The weights of all pixels for one offset of the search window are computed together: squared differences,
// summed over patches by a box filter, so that the cost per pixel and offset does not depend on the size of a
// patch.
#include <algorithm>
#include <array>
#include <cstdint>
#include <stdexcept>
#include <utility>
#include <vector>

#include "checks.hpp"
#include "core.hpp"
#include "exp_minus.hpp"
#include "fastest.hpp"
#include "non_local_means.hpp"
#include "padded_planes.hpp"

namespace tungsten_dip {
namespace {

// Bitterli et al. 2016, section 5.1, and the denoiser that its authors released with Tungsten.
constexpr int patch_radius = 3;
constexpr std::size_t patch_size = 2 * std::size_t{patch_radius} + 1;

// The floor of squared differences' unit: where there is no variance, values that differ by less than 1e-4 or
// so are equal.
constexpr float least_unit = 1e-7F;
// From here on a weight is 0 whatever the rest of the patch says; keeps the sums far from overflow.
constexpr float largest_distance = 1e4F;

// The standard deviation, relative to the feature, from which on a pixel has noise worth filtering.
constexpr float least_noise = 1e-3F;

constexpr int tile_size = 48;
constexpr int padded_size = rounded_up(tile_size + 2 * patch_radius, lanes);

struct Feature {
    PaddedPlanes a;
    PaddedPlanes b;
    PaddedPlanes variance;  // of one half

    [[nodiscard]] bool noisy(int y, int x) const {
        float squared = 0;
        float noise = 0;
        for (int c = 0; c < a.channels(); ++c) {
            const float value_a = a.row(c, y)[x];
            const float value_b = b.row(c, y)[x];
            const float difference = value_a - value_b;
            squared += value_a * value_a + value_b * value_b;
            noise += variance.row(c, y)[x] + difference * difference;
        }
        return noise > least_noise * least_noise * squared;
    }
};

struct Range {
    int begin;
    int end;  // one past the last

    [[nodiscard]] int size() const { return end - begin; }
};

// A row of the same quantity of both halves.
template <int size>
struct HalvesRow {
    std::array<float, size> a;
    std::array<float, size> b;
};

struct Rectangle {
    Range rows;
    Range columns;

    [[nodiscard]] bool empty() const { return rows.begin >= rows.end || columns.begin >= columns.end; }
};

// Which pixels are noisy, or next to one that is: a few samples can agree by chance on one side of an edge.
class NoisyPixels {
  public:
    NoisyPixels(const Feature& feature, int threads)
        : height_(feature.a.height()),
          width_(feature.a.width()),
          noisy_(static_cast<std::size_t>(height_) * static_cast<std::size_t>(width_)) {
        std::vector<std::uint8_t> alone(noisy_.size());
        parallel_for(height_, threads, [&](int y) {
            for (int x = 0; x < width_; ++x) alone[index(y, x)] = feature.noisy(y, x) ? 1 : 0;
        });
        parallel_for(height_, threads, [&](int y) {
            for (int v = std::max(y - 1, 0); v <= std::min(y + 1, height_ - 1); ++v) {
                for (int x = 0; x < width_; ++x) {
                    for (int u = std::max(x - 1, 0); u <= std::min(x + 1, width_ - 1); ++u)
                        noisy_[index(y, x)] |= alone[index(v, u)];
                }
            }
        });
    }

    [[nodiscard]] bool at(int y, int x) const { return noisy_[index(y, x)] != 0; }

    // The part of a tile that holds them all.
    [[nodiscard]] Rectangle within(Rectangle tile) const {
        Rectangle bounds{.rows = {.begin = tile.rows.end, .end = tile.rows.begin},
                         .columns = {.begin = tile.columns.end, .end = tile.columns.begin}};
        for (int y = tile.rows.begin; y < tile.rows.end; ++y) {
            for (int x = tile.columns.begin; x < tile.columns.end; ++x) {
                if (!at(y, x)) continue;
                bounds.rows = {.begin = std::min(bounds.rows.begin, y), .end = y + 1};
                bounds.columns = {.begin = std::min(bounds.columns.begin, x),
                                  .end = std::max(bounds.columns.end, x + 1)};
            }
        }
        return bounds;
    }

  private:
    int height_;
    int width_;
    std::vector<std::uint8_t> noisy_;

    [[nodiscard]] std::size_t index(int y, int x) const {
        return static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x);
    }
};

// Filters one tile of a feature, or a part of it. Rows and columns of the scratch memory are relative to the
// tile or, where they are padded, to the tile grown by a patch's radius. Patches see the image's border
// repeated outwards.
class TileFilter {
  public:
    TileFilter(const Feature& feature, float k, Rectangle tile)
        : feature_(feature),
          k_squared_(k * k),
          rows_(tile.rows),
          columns_(tile.columns),
          sums_(static_cast<std::size_t>(feature.a.channels() * tile_size)),
          weights_(tile_size),
          patch_rows_(padded_size) {}

    void run(SearchWindow window) {
        for (int dy = -window.radius; dy <= window.radius; dy += window.step) {
            for (int dx = -window.radius; dx <= window.radius; dx += window.step) add_offset(dy, dx);
        }
    }

    void write(const NoisyPixels& noisy, Image half_a, Image half_b) const {
        for (int y = rows_.begin; y < rows_.end; ++y) {
            const auto& weight = weights_[tile_row(y)];
            for (int c = 0; c < feature_.a.channels(); ++c) {
                const auto& sum = sums_[sum_row(c, y)];
                for (int x = columns_.begin; x < columns_.end; ++x) {
                    const auto i = static_cast<std::size_t>(x - columns_.begin);
                    if (!noisy.at(y, x)) continue;
                    half_a.at(y, x, c) = feature_.a.row(c, y)[x] + sum.a[i] / weight.a[i];
                    half_b.at(y, x, c) = feature_.b.row(c, y)[x] + sum.b[i] / weight.b[i];
                }
            }
        }
    }

  private:
    const Feature& feature_;
    float k_squared_;
    Range rows_;
    Range columns_;
    std::vector<HalvesRow<tile_size>> sums_;        // [channel][row] weight * (value at the offset - value)
    std::vector<HalvesRow<tile_size>> weights_;     // [row] sum of the weights, half a's from b's patches
    std::vector<HalvesRow<tile_size>> patch_rows_;  // [padded row] distances summed over a patch's columns

    [[nodiscard]] std::size_t count() const {
        return static_cast<std::size_t>(rounded_up(columns_.size(), lanes));
    }
    [[nodiscard]] std::size_t tile_row(int y) const { return static_cast<std::size_t>(y - rows_.begin); }
    [[nodiscard]] std::size_t sum_row(int c, int y) const {
        return static_cast<std::size_t>(c) * tile_size + tile_row(y);
    }

    void add_offset(int dy, int dx) {
        const int height = feature_.a.height();
        const int first = std::max(rows_.begin, -dy);
        const int end = std::min(rows_.end, height - dy);
        if (first >= end) return;
        for (int y = first - patch_radius; y < end + patch_radius; ++y)
            measure_row(y, dy, dx, patch_rows_[tile_row(y + patch_radius)]);
        for (int y = first; y < end; ++y) add_row(y, dy, dx);
    }

    // The distances of a row's pixels to their partners, summed over the columns of patches.
    TUNGSTEN_DIP_FASTEST void measure_row(int y, int dy, int dx, HalvesRow<tile_size>& out) const {
        HalvesRow<padded_size> distances;  // NOLINT(*-member-init): the first channel sets them
        const auto padded_count =
            static_cast<std::size_t>(rounded_up(columns_.size() + 2 * patch_radius, lanes));
        const int x = columns_.begin - patch_radius;
        const float share = 1.0F / static_cast<float>(feature_.a.channels());
        for (int c = 0; c < feature_.a.channels(); ++c) {
            const float* a = feature_.a.row(c, y) + x;
            const float* b = feature_.b.row(c, y) + x;
            const float* variance = feature_.variance.row(c, y) + x;
            const float* a_there = feature_.a.row(c, y + dy) + x + dx;
            const float* b_there = feature_.b.row(c, y + dy) + x + dx;
            const float* variance_there = feature_.variance.row(c, y + dy) + x + dx;
            for (std::size_t i = 0; i < padded_count; ++i) {
                const float noise = expected_squared_difference(variance[i], variance_there[i]);
                const float scale = share / unit_of_squared_difference(variance[i], variance_there[i],
                                                                       k_squared_, least_unit);
                const float difference_a = a[i] - a_there[i];
                const float difference_b = b[i] - b_there[i];
                const float sum_a = c == 0 ? 0 : distances.a[i];
                const float sum_b = c == 0 ? 0 : distances.b[i];
                distances.a[i] =
                    sum_a + std::min((difference_a * difference_a - noise) * scale, largest_distance);
                distances.b[i] =
                    sum_b + std::min((difference_b * difference_b - noise) * scale, largest_distance);
            }
        }
        for (std::size_t i = 0; i < count(); ++i) {
            float sum_a = 0;
            float sum_b = 0;
            for (std::size_t tap = 0; tap < patch_size; ++tap) {
                sum_a += distances.a[i + tap];
                sum_b += distances.b[i + tap];
            }
            out.a[i] = sum_a;
            out.b[i] = sum_b;
        }
    }

    TUNGSTEN_DIP_FASTEST void add_row(int y, int dy, int dx) {
        // Each half has the weights of the other.
        HalvesRow<tile_size> weight;  // NOLINT(*-member-init): filled below
        const HalvesRow<tile_size>* patches = &patch_rows_[tile_row(y)];
        const std::size_t size = count();
        constexpr float scale = 1.0F / (patch_size * patch_size);
        for (std::size_t i = 0; i < size; ++i) {
            float sum_a = 0;
            float sum_b = 0;
            for (std::size_t tap = 0; tap < patch_size; ++tap) {
                sum_a += patches[tap].b[i];
                sum_b += patches[tap].a[i];
            }
            weight.a[i] = exp_minus(std::max(scale * sum_a, 0.0F));
            weight.b[i] = exp_minus(std::max(scale * sum_b, 0.0F));
        }
        for (float* weights : {weight.a.data(), weight.b.data()})
            drop_outside_partners(columns_.begin, dx, feature_.a.width(), columns_.size(), weights);

        auto& total = weights_[tile_row(y)];
        for (std::size_t i = 0; i < size; ++i) {
            total.a[i] += weight.a[i];
            total.b[i] += weight.b[i];
        }
        const int x = columns_.begin;
        for (int c = 0; c < feature_.a.channels(); ++c) {
            auto& sum = sums_[sum_row(c, y)];
            const float* a = feature_.a.row(c, y) + x;
            const float* b = feature_.b.row(c, y) + x;
            const float* a_there = feature_.a.row(c, y + dy) + x + dx;
            const float* b_there = feature_.b.row(c, y + dy) + x + dx;
            for (std::size_t i = 0; i < size; ++i) {
                // Differences, not values: what is equal all around comes out unchanged to the bit.
                sum.a[i] += weight.a[i] * (a_there[i] - a[i]);
                sum.b[i] += weight.b[i] * (b_there[i] - b[i]);
            }
        }
    }
};

// The variance of one half: twice that of the mean, which the halves estimate roughly where it is not known.
void estimate_variance_of_half(const ConstBuffer& in, Image out, int threads) {
    ConstImage of_mean = in.variance;
    if (!of_mean.known()) {
        std::vector<float> pixels(static_cast<std::size_t>(out.size()));
        const Image noisy{
            .data = pixels.data(), .height = out.height, .width = out.width, .channels = out.channels};
        halves_variance(in.half_a, in.half_b, noisy, threads);
        box_mean(noisy, 1, out, threads);
        of_mean = out;
    }
    for (std::ptrdiff_t i = 0; i < out.size(); ++i) out.data[i] = 2 * of_mean.data[i];
}

}  // namespace

void prefilter_feature(const ConstBuffer& in, const Buffer& out, SearchWindow window, float k, int threads) {
    check_window(window);
    check_k(k);
    check_buffer(in);
    for (const auto& [name, image] :
         {std::pair{"out.mean", out.mean}, std::pair{"out.half_a", out.half_a},
          std::pair{"out.half_b", out.half_b}, std::pair{"out.variance", out.variance}}) {
        check_same_shape(name, image, "mean", in.mean);
    }
    if (in.mean.size() == 0) return;
    if (!in.has_halves()) throw std::invalid_argument("half_a and half_b: expected both, got one or none");
    estimate_variance_of_half(in, out.variance, threads);
    const int margin = window.radius + patch_radius;
    const Feature feature{.a = {in.half_a, margin, threads},
                          .b = {in.half_b, margin, threads},
                          .variance = {out.variance, margin, threads}};
    const NoisyPixels noisy(feature, threads);
    std::copy_n(in.half_a.data, in.half_a.size(), out.half_a.data);
    std::copy_n(in.half_b.data, in.half_b.size(), out.half_b.data);

    const int tile_rows = (in.mean.height + tile_size - 1) / tile_size;
    const int tile_columns = (in.mean.width + tile_size - 1) / tile_size;
    parallel_for(tile_rows * tile_columns, threads, [&](int tile) {
        const int top = tile / tile_columns * tile_size;
        const int left = tile % tile_columns * tile_size;
        const Rectangle part =
            noisy.within({.rows = {.begin = top, .end = std::min(top + tile_size, in.mean.height)},
                          .columns = {.begin = left, .end = std::min(left + tile_size, in.mean.width)}});
        if (part.empty()) return;
        TileFilter filter(feature, k, part);
        filter.run(window);
        filter.write(noisy, out.half_a, out.half_b);
    });

    halves_variance(out.half_a, out.half_b, out.mean, threads);
    box_mean(out.mean, 1, out.variance, threads);
    for (std::ptrdiff_t i = 0; i < out.mean.size(); ++i) {
        const float change =
            (out.half_a.data[i] - in.half_a.data[i]) + (out.half_b.data[i] - in.half_b.data[i]);
        out.mean.data[i] = in.mean.data[i] + change / 2;
    }
}

}  // namespace tungsten_dip
