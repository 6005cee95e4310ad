// Pre-filtering of features by cross-filtered non-local means.
//
// The weights of all pixels for one offset of the search window are computed together: squared differences,
// summed over patches by a box filter, so that the cost per pixel and offset does not depend on the size of a
// patch.
#include <algorithm>
#include <array>
#include <cstdint>
#include <vector>

#include "core.hpp"
#include "exp_minus.hpp"
#include "fastest.hpp"

namespace tungsten_dip {
namespace {

// Bitterli et al. 2016, section 5.1, and the denoiser that its authors released with Tungsten.
constexpr int patch_radius = 3;
constexpr std::size_t patch_size = 2 * std::size_t{patch_radius} + 1;

// Keeps distances finite where there is no variance: there, values that differ by less than 1e-4 or so are
// equal.
constexpr float epsilon = 1e-7F;
// From here on a weight is 0 whatever the rest of the patch says; keeps the sums far from overflow.
constexpr float largest_distance = 1e4F;

// The standard deviation, relative to the feature, from which on a pixel has noise worth filtering.
constexpr float least_noise = 1e-3F;

constexpr int tile_size = 48;
constexpr int padded_size = tile_size + 2 * patch_radius;

// An image's channels one after the other: [channel][y][x].
struct Planes {
    int height;
    int width;
    int channels;
    std::vector<float> pixels;

    Planes(ConstImage image, int threads)
        : height(image.height),
          width(image.width),
          channels(image.channels),
          pixels(static_cast<std::size_t>(image.size())) {
        parallel_for(height, threads, [&](int y) {
            for (int c = 0; c < channels; ++c) {
                float* to = pixels.data() + offset(c, y);
                for (int x = 0; x < width; ++x) to[x] = image.at(y, x, c);
            }
        });
    }
    [[nodiscard]] const float* row(int c, int y) const { return pixels.data() + offset(c, y); }

  private:
    [[nodiscard]] std::ptrdiff_t offset(int c, int y) const {
        return (static_cast<std::ptrdiff_t>(c) * height + y) * width;
    }
};

struct Feature {
    Planes a;
    Planes b;
    Planes variance;  // of one half

    [[nodiscard]] bool noisy(int y, int x) const {
        float squared = 0;
        float noise = 0;
        for (int c = 0; c < a.channels; ++c) {
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

    [[nodiscard]] Range clipped(Range to) const {
        return {.begin = std::max(begin, to.begin), .end = std::min(end, to.end)};
    }
    [[nodiscard]] Range grown(int by) const { return {.begin = begin - by, .end = end + by}; }
};

// The pixels of an axis that have a partner at the offset within the image.
Range paired(int size, int offset) {
    return {.begin = std::max(0, -offset), .end = std::min(size, size - offset)};
}

// The same quantity of both halves.
template <int size>
struct HalvesRow {
    std::array<float, size> a{};
    std::array<float, size> b{};
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
        : height_(feature.a.height),
          width_(feature.a.width),
          own_(static_cast<std::size_t>(height_) * static_cast<std::size_t>(width_)) {
        parallel_for(height_, threads, [&](int y) {
            for (int x = 0; x < width_; ++x) own_[index(y, x)] = feature.noisy(y, x) ? 1 : 0;
        });
    }

    [[nodiscard]] bool at(int y, int x) const {
        for (int v = std::max(y - 1, 0); v <= std::min(y + 1, height_ - 1); ++v) {
            for (int u = std::max(x - 1, 0); u <= std::min(x + 1, width_ - 1); ++u) {
                if (own_[index(v, u)] != 0) return true;
            }
        }
        return false;
    }

    // The part of a tile that holds them all.
    [[nodiscard]] Rectangle within(Rectangle tile) const {
        Rectangle part{.rows = {.begin = tile.rows.end, .end = tile.rows.begin},
                       .columns = {.begin = tile.columns.end, .end = tile.columns.begin}};
        for (int y = tile.rows.begin; y < tile.rows.end; ++y) {
            for (int x = tile.columns.begin; x < tile.columns.end; ++x) {
                if (!at(y, x)) continue;
                part.rows = {.begin = std::min(part.rows.begin, y), .end = y + 1};
                part.columns = {.begin = std::min(part.columns.begin, x),
                                .end = std::max(part.columns.end, x + 1)};
            }
        }
        return part;
    }

  private:
    int height_;
    int width_;
    std::vector<std::uint8_t> own_;

    [[nodiscard]] std::size_t index(int y, int x) const {
        return static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) + static_cast<std::size_t>(x);
    }
};

// Filters one tile of a feature, or a part of it. Rows and columns of the scratch memory are relative to the
// tile or, where they are padded, to the tile grown by a patch's radius.
class TileFilter {
  public:
    TileFilter(const Feature& feature, SearchWindow window, Rectangle tile)
        : feature_(feature),
          k_squared_(window.k * window.k),
          rows_(tile.rows),
          columns_(tile.columns),
          sums_(static_cast<std::size_t>(feature.a.channels * tile_size)),
          weights_(tile_size),
          patch_rows_(padded_size) {
        for (int dy = -window.radius; dy <= window.radius; ++dy) {
            for (int dx = -window.radius; dx <= window.radius; ++dx) add_offset(dy, dx);
        }
    }

    void write(const NoisyPixels& noisy, Image half_a, Image half_b) const {
        for (int y = rows_.begin; y < rows_.end; ++y) {
            const auto& weight = weights_[tile_row(y)];
            for (int c = 0; c < feature_.a.channels; ++c) {
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

    [[nodiscard]] std::size_t tile_row(int y) const { return static_cast<std::size_t>(y - rows_.begin); }
    [[nodiscard]] std::size_t padded_row(int y) const { return tile_row(y) + patch_radius; }
    [[nodiscard]] std::size_t sum_row(int c, int y) const {
        return static_cast<std::size_t>(c) * tile_size + tile_row(y);
    }

    void add_offset(int dy, int dx) {
        const Range valid_rows = paired(feature_.a.height, dy);
        const Range valid_columns = paired(feature_.a.width, dx);
        const Range rows = rows_.clipped(valid_rows);
        const Range columns = columns_.clipped(valid_columns);
        if (rows.begin >= rows.end || columns.begin >= columns.end) return;

        // Patches are clipped where they or their partners leave the image: the distance is a mean over the
        // rest.
        std::array<float, tile_size> patch_width{};
        for (int x = columns.begin; x < columns.end; ++x) {
            const Range patch = Range{.begin = x, .end = x + 1}.grown(patch_radius).clipped(valid_columns);
            patch_width[static_cast<std::size_t>(x - columns_.begin)] =
                static_cast<float>(patch.end - patch.begin);
        }
        const Range padded_rows = rows_.grown(patch_radius).clipped(valid_rows);
        const Range padded_columns = columns_.grown(patch_radius).clipped(valid_columns);
        for (int y = padded_rows.begin; y < padded_rows.end; ++y) {
            measure_row(y, dy, dx, padded_columns, patch_rows_[padded_row(y)]);
        }
        for (int y = rows.begin; y < rows.end; ++y) {
            add_row(y, dy, dx, columns,
                    Range{.begin = y, .end = y + 1}.grown(patch_radius).clipped(valid_rows), patch_width);
        }
    }

    // The distances of a row's pixels to their partners, after Rousselle et al. 2012: squared differences
    // less what noise alone makes of them, over the variance, averaged over channels, then summed over the
    // columns of patches.
    TUNGSTEN_DIP_FASTEST void measure_row(int y, int dy, int dx, Range columns,
                                          HalvesRow<tile_size>& out) const {
        HalvesRow<padded_size> distances;
        const int first = columns.begin;
        const auto begin = static_cast<std::size_t>(columns.begin - columns_.begin) + patch_radius;
        const auto end = static_cast<std::size_t>(columns.end - columns_.begin) + patch_radius;
        const float share = 1.0F / static_cast<float>(feature_.a.channels);
        for (int c = 0; c < feature_.a.channels; ++c) {
            const float* a = feature_.a.row(c, y) + first;
            const float* b = feature_.b.row(c, y) + first;
            const float* variance = feature_.variance.row(c, y) + first;
            const float* a_there = feature_.a.row(c, y + dy) + first + dx;
            const float* b_there = feature_.b.row(c, y + dy) + first + dx;
            const float* variance_there = feature_.variance.row(c, y + dy) + first + dx;
            for (std::size_t i = begin; i < end; ++i) {
                const std::size_t j = i - begin;
                const float noise = variance[j] + std::min(variance[j], variance_there[j]);
                const float scale = share / (k_squared_ * (variance[j] + variance_there[j]) + epsilon);
                const float difference_a = a[j] - a_there[j];
                const float difference_b = b[j] - b_there[j];
                distances.a[i] += std::min((difference_a * difference_a - noise) * scale, largest_distance);
                distances.b[i] += std::min((difference_b * difference_b - noise) * scale, largest_distance);
            }
        }
        out = {};
        for (std::size_t tap = 0; tap < patch_size; ++tap) {
            for (std::size_t i = 0; i < tile_size; ++i) out.a[i] += distances.a[i + tap];
            for (std::size_t i = 0; i < tile_size; ++i) out.b[i] += distances.b[i + tap];
        }
    }

    TUNGSTEN_DIP_FASTEST void add_row(int y, int dy, int dx, Range columns, Range patch,
                                      const std::array<float, tile_size>& patch_width) {
        HalvesRow<tile_size> weight;
        for (int row = patch.begin; row < patch.end; ++row) {
            const auto& distance = patch_rows_[padded_row(row)];
            for (std::size_t i = 0; i < tile_size; ++i) weight.a[i] += distance.b[i];
            for (std::size_t i = 0; i < tile_size; ++i) weight.b[i] += distance.a[i];
        }
        const int first = columns.begin;
        const auto begin = static_cast<std::size_t>(columns.begin - columns_.begin);
        const auto end = static_cast<std::size_t>(columns.end - columns_.begin);
        const auto patch_height = static_cast<float>(patch.end - patch.begin);
        auto& total = weights_[tile_row(y)];
        for (std::size_t i = begin; i < end; ++i) {
            const float values = patch_height * patch_width[i];
            weight.a[i] = exp_minus(std::max(weight.a[i] / values, 0.0F));
            weight.b[i] = exp_minus(std::max(weight.b[i] / values, 0.0F));
            total.a[i] += weight.a[i];
            total.b[i] += weight.b[i];
        }
        for (int c = 0; c < feature_.a.channels; ++c) {
            auto& sum = sums_[sum_row(c, y)];
            const float* a = feature_.a.row(c, y) + first;
            const float* b = feature_.b.row(c, y) + first;
            const float* a_there = feature_.a.row(c, y + dy) + first + dx;
            const float* b_there = feature_.b.row(c, y + dy) + first + dx;
            for (std::size_t i = begin; i < end; ++i) {
                const std::size_t j = i - begin;
                // Differences, not values: what is equal all around comes out unchanged to the bit.
                sum.a[i] += weight.a[i] * (a_there[j] - a[j]);
                sum.b[i] += weight.b[i] * (b_there[j] - b[j]);
            }
        }
    }
};

// The variance of one half: twice that of the mean, which the halves tell roughly where it is not known.
void estimate_variance_of_half(const Buffer& in, Image out, int threads) {
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

void prefilter_feature(const Buffer& in, const Buffer& out, SearchWindow window, int threads) {
    estimate_variance_of_half(in, out.variance, threads);
    const Feature feature{
        .a = {in.half_a, threads}, .b = {in.half_b, threads}, .variance = {out.variance, threads}};
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
        if (!part.empty()) TileFilter(feature, window, part).write(noisy, out.half_a, out.half_b);
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
