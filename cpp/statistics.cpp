// What the halves of a render and its sample variance show of its noise.
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "checks.hpp"
#include "core.hpp"

namespace tungsten_dip {
namespace {

constexpr double unknown = std::numeric_limits<double>::quiet_NaN();

// --- The correlation of the halves' errors
//
// Immerkaer's stencil (1996, "Fast Noise Variance Estimation") cancels constant and linear signal, so what it
// leaves of A + B and of A - B is mostly noise. Their energies S and D differ by the halves' covariance
// alone: correlation = (S - D) / (S + D). Signal that is left raises S, and fireflies dominate every mean, so
// the ratio is taken in tiles, where it is bounded, and the median is taken over the calmer half of the
// tiles. Calm means a small S + D, which prefers no sign of the correlation.
constexpr int tile_size = 8;
constexpr std::array<double, 3> stencil{1, -2, 1};  // along both axes

// Where D is below this part of the tile's energy the halves agree up to the rounding of half floats (noise
// of less than about 0.05% of the radiance), which shows nothing.
constexpr double rounding = 5e-6;

// The standard deviation of one tile's ratio; 0.18 to 0.21 was measured on path-traced images of 4 to 32 spp.
constexpr double tile_spread = 0.3;

// Rendered independently, ten images of five scenes stay within 0.02; Tungsten's Sobol sampler gives -0.18.
constexpr double tolerated_correlation = 0.05;

struct Tile {
    double sum = 0;         // S
    double difference = 0;  // D
    double energy = 0;      // of A + B itself
    int values = 0;

    [[nodiscard]] double correlation() const { return (sum - difference) / (sum + difference); }
    [[nodiscard]] double calmness() const { return (sum + difference) / energy; }
};

Tile measure_tile(ConstImage a, ConstImage b, int top, int left) {
    Tile tile;
    for (int y = top; y < std::min(top + tile_size, a.height - 1); ++y) {
        for (int x = left; x < std::min(left + tile_size, a.width - 1); ++x) {
            for (int c = 0; c < a.channels; ++c) {
                double high_a = 0;
                double high_b = 0;
                for (std::size_t i = 0; i < stencil.size(); ++i) {
                    for (std::size_t j = 0; j < stencil.size(); ++j) {
                        const double weight = stencil[i] * stencil[j];
                        const int row = y - 1 + static_cast<int>(i);
                        const int column = x - 1 + static_cast<int>(j);
                        high_a += weight * a.at(row, column, c);
                        high_b += weight * b.at(row, column, c);
                    }
                }
                if (std::isnan(high_a + high_b)) continue;
                const double total = static_cast<double>(a.at(y, x, c)) + b.at(y, x, c);
                tile.sum += (high_a + high_b) * (high_a + high_b);
                tile.difference += (high_a - high_b) * (high_a - high_b);
                tile.energy += total * total;
                ++tile.values;
            }
        }
    }
    return tile;
}

double median(std::vector<double>& values) {
    const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
    std::nth_element(values.begin(), middle, values.end());
    return *middle;
}

struct Correlation {
    double value = unknown;
    double standard_error = unknown;
};

Correlation measure_correlation(ConstImage a, ConstImage b, int threads) {
    const int tile_rows = std::max(a.height - 2 + tile_size - 1, 0) / tile_size;
    const int tile_columns = std::max(a.width - 2 + tile_size - 1, 0) / tile_size;
    std::vector<Tile> tiles(static_cast<std::size_t>(tile_rows) * static_cast<std::size_t>(tile_columns));
    parallel_for(tile_rows, threads, [&](int row) {
        for (int column = 0; column < tile_columns; ++column) {
            tiles[static_cast<std::size_t>(row) * static_cast<std::size_t>(tile_columns) +
                  static_cast<std::size_t>(column)] =
                measure_tile(a, b, 1 + row * tile_size, 1 + column * tile_size);
        }
    });
    // Slivers at the borders, and tiles full of unknown values, hold too few for a ratio.
    const int enough = tile_size * tile_size / 2 * a.channels;
    std::erase_if(tiles, [enough](const Tile& tile) { return tile.values < enough; });

    const bool signal = std::ranges::any_of(tiles, [](const Tile& tile) { return tile.sum > 0; });
    std::erase_if(tiles, [](const Tile& tile) { return !(tile.difference > rounding * tile.energy); });
    if (tiles.empty()) {
        if (!signal) return {};
        return {.value = 1, .standard_error = 0};  // the halves are one image
    }

    const auto calm_end = tiles.begin() + static_cast<std::ptrdiff_t>((tiles.size() + 1) / 2);
    std::nth_element(tiles.begin(), calm_end - 1, tiles.end(),
                     [](const Tile& p, const Tile& q) { return p.calmness() < q.calmness(); });
    tiles.erase(calm_end, tiles.end());

    std::vector<double> ratios(tiles.size());
    std::ranges::transform(tiles, ratios.begin(), &Tile::correlation);
    // 1.25 = sqrt(pi / 2): the standard error of a median of normal values over that of their mean.
    return {.value = median(ratios),
            .standard_error = 1.25 * tile_spread / std::sqrt(static_cast<double>(tiles.size()))};
}

// --- The halves' variance over the sample variance
//
// However heavy-tailed the samples are: if they are independent, dealing them to A and B is a random split,
// and the mean of ((A - B) / 2)^2 over all splits *is* the sample variance of the mean. So its ratio to the
// sample variance has expectation 1 in every pixel and is bounded, and a plain mean over pixels is safe.

// Below sixteen of half floats' smallest steps, and where noise is under 2^-9 of the radiance (the step is
// 2^-11), rounding distorts the ratio by more than a percent. What is no multiple of the smallest step was
// not rounded to it.
constexpr double smallest_half = 0x1p-24;
constexpr double smallest_deviation = 0x1p-9;

bool rounded_to_few_digits(double variance) {
    const double steps = variance / smallest_half;
    return steps <= 16 && steps == std::floor(steps);
}

// The ratio's standard deviation; at most 1.4 (that of a chi-squared variable), 0.8 to 1.2 was measured.
constexpr double ratio_spread = 1.4;

// Ten images of five scenes rendered independently stay within 0.99 and 1.01; halves that share a fifth of
// their samples give 0.8.
constexpr double smallest_ratio = 0.8;

// The variance of one sample, or one in other units, is wrong by a larger factor. Fifty renders of 4 spp and
// more have ratios of 0.98 to 1.02; Tungsten's Sobol sampler gives 0.93.
constexpr double foreign_factor = 3;

struct Ratio {
    double value = unknown;
    double standard_error = unknown;
};

Ratio measure_ratio(ConstImage a, ConstImage b, ConstImage variance, int threads) {
    struct Sum {
        double ratio = 0;
        std::int64_t count = 0;
    };
    std::vector<Sum> rows(static_cast<std::size_t>(a.height));
    parallel_for(a.height, threads, [&](int y) {
        Sum sum;
        for (std::ptrdiff_t i = 0; i < a.row_size(); ++i) {
            const double value_a = a.row(y)[i];
            const double value_b = b.row(y)[i];
            const double sample_variance = variance.row(y)[i];
            const double floor = smallest_deviation * (value_a + value_b) / 2;
            if (!(sample_variance > floor * floor) || rounded_to_few_digits(sample_variance)) continue;
            sum.ratio += (value_a - value_b) * (value_a - value_b) / 4 / sample_variance;
            ++sum.count;
        }
        rows[static_cast<std::size_t>(y)] = sum;
    });
    Sum total;
    for (const Sum& sum : rows) {
        total.ratio += sum.ratio;
        total.count += sum.count;
    }
    if (total.count == 0) return {};
    // The channels of a pixel share their noise.
    const double pixels = std::max(static_cast<double>(total.count) / a.channels, 1.0);
    return {.value = total.ratio / static_cast<double>(total.count),
            .standard_error = ratio_spread / std::sqrt(pixels)};
}

}  // namespace

void halves_variance(ConstImage half_a, ConstImage half_b, Image out, int threads) {
    check_same_shape("half_b", half_b, "half_a", half_a);
    check_same_shape("out", out, "half_a", half_a);
    parallel_for(out.height, threads, [&](int y) {
        for (std::ptrdiff_t i = 0; i < out.row_size(); ++i) {
            const float difference = half_a.row(y)[i] - half_b.row(y)[i];
            out.row(y)[i] = difference * difference / 4;
        }
    });
}

HalvesTest compare_halves(ConstImage half_a, ConstImage half_b, ConstImage variance, int threads) {
    check_same_shape("half_b", half_b, "half_a", half_a);
    if (variance.known()) check_same_shape("variance", variance, "half_a", half_a);
    const Correlation correlation = measure_correlation(half_a, half_b, threads);
    const Ratio ratio = variance.known() ? measure_ratio(half_a, half_b, variance, threads) : Ratio{};

    // Only what exceeds the limits by two standard errors counts as evidence against independence.
    const double margin = 2 * correlation.standard_error;
    const bool mirrored = correlation.value + margin < -tolerated_correlation;
    const bool alike = correlation.value - margin > tolerated_correlation;
    // Texture makes independent halves look alike; that their variance is as large as the samples' clears
    // them. Without a sample variance nobody can tell, and only copies are shared for certain: with shared
    // samples noise stays in the image, whereas drawn halves would take fine texture for noise.
    const bool shared = std::isnan(ratio.value) ? correlation.value >= 1
                                                : ratio.value + 2 * ratio.standard_error < smallest_ratio;

    // Halves that share samples differ by less, by the part 1 - correlation. Texture raises the correlation,
    // and clears a variance, too.
    const double ratio_margin = 2 * ratio.standard_error;
    const bool too_large = foreign_factor * (ratio.value + ratio_margin) < 1 - correlation.value;
    const bool too_small = !mirrored && ratio.value - ratio_margin > foreign_factor;
    return {.correlation = correlation.value,
            .variance_ratio = ratio.value,
            .variance_fits = !too_large && !too_small,
            .independent = !std::isnan(correlation.value) && !mirrored && !(alike && shared)};
}

}  // namespace tungsten_dip
