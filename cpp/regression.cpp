// Local first-order regression: the pilots from which the fit composes its image.
//
// Both of its sums, those of the normal equations and those of the predictions, are weighted sums of terms
// that depend on the neighbour alone: products of its features and colour, or the coefficients of its fit. A
// tile computes the terms once, and the weights of a row of neighbours together, so that a sum stays in a
// register while it runs over that row. Features are counted from an origin within the tile: sums of squares
// of large values would lose the small differences.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdlib>
#include <iterator>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "checks.hpp"
#include "core.hpp"
#include "exp_minus.hpp"
#include "fastest.hpp"
#include "non_local_means.hpp"
#include "padded_planes.hpp"

namespace tungsten_dip {
namespace {

constexpr int tile_width = 64;
constexpr int tile_height = 8;
constexpr int colors = 3;
constexpr int max_features = 16;

// The floor of squared differences' unit: where a guide has no variance, values that differ by less than 3e-5
// or so are equal.
constexpr float least_unit = 1e-8F;
// A pixel's own weight alone is more; beyond the image, where lanes compute in vain, sums may be 0.
constexpr float least_weight_sum = 1e-20F;

// The guide is compared in patches of this radius.
constexpr int patch_radius = 1;
constexpr int patch_size = 2 * patch_radius + 1;

// Added to the variance of every feature: keeps flat ones from explaining noise. As a float has it.
constexpr double ridge = 1e-3F;

struct Tile {
    int y;
    int x;
    int height;
    int width;
};

// One row of every feature.
using FeatureRows = std::array<const float*, max_features>;
using FeatureValues = std::array<float, max_features>;

constexpr int terms_at_once = 8;
using Lanes [[gnu::vector_size(lanes * sizeof(float))]] = float;
using LanesInMemory [[gnu::aligned(alignof(float)), gnu::may_alias]] = Lanes;

// distances = those of one row of the guide from another, averaged over channels, whose planes lie
// `plane_size` apart.
TUNGSTEN_DIP_FASTEST void compare_rows(const float* p, const float* q, const float* variance_p,
                                       const float* variance_q, std::ptrdiff_t plane_size, int channels,
                                       float k_squared, int count, float* distances) {
    std::fill_n(distances, count, 0.0F);
    const float scale = 1.0F / static_cast<float>(channels);
    for (int c = 0; c < channels; ++c) {
        for (int x = 0; x < count; ++x) {
            const float difference = p[x] - q[x];
            const float noise = expected_squared_difference(variance_p[x], variance_q[x]);
            distances[x] += scale * (difference * difference - noise) /
                            unit_of_squared_difference(variance_p[x], variance_q[x], k_squared, least_unit);
        }
        p += plane_size;
        q += plane_size;
        variance_p += plane_size;
        variance_q += plane_size;
    }
}

// means[x] = the mean of the patch of distances from distances[x] on, but never negative. Leaves sums of
// columns in the first row of the distances.
TUNGSTEN_DIP_FASTEST void average_patches(float* distances, int columns, int count, float* means) {
    for (int row = 1; row < patch_size; ++row) {
        for (int x = 0; x < columns; ++x) distances[x] += distances[row * columns + x];
    }
    std::fill_n(means, count, 0.0F);
    for (int column = 0; column < patch_size; ++column) {
        for (int x = 0; x < count; ++x) means[x] += distances[x + column];
    }
    const float scale = 1.0F / static_cast<float>(patch_size * patch_size);
    for (int x = 0; x < count; ++x) means[x] = std::max(scale * means[x], 0.0F);
}

// weights = share * exp(-distance), to which the features from (y, x) on add their distance from those at an
// offset.
TUNGSTEN_DIP_FASTEST void weigh_row(const PaddedPlanes& features, int y, int x, int dy, int dx,
                                    const FeatureValues& penalty, float share, int count, float* weights) {
    for (int f = 0; f < features.channels(); ++f) {
        const float scale = penalty[static_cast<std::size_t>(f)];
        if (scale <= 0) continue;
        const float* p = features.row(f, y) + x;
        const float* q = features.row(f, y + dy) + x + dx;
        for (int i = 0; i < count; ++i) weights[i] += scale * (p[i] - q[i]) * (p[i] - q[i]);
    }
    for (int i = 0; i < count; ++i) weights[i] = share * exp_minus(std::max(weights[i], 0.0F));
}

// The terms that a row of neighbours adds to the normal equations: 1, f, f f' (upper triangle), and per
// colour y and y f. Each is a row, `stride` after the one before.
TUNGSTEN_DIP_FASTEST void carry_products(const FeatureRows& features, const FeatureValues& origin, int n,
                                         const std::array<const float*, colors>& target, int count,
                                         int stride, float* terms) {
    std::fill_n(terms, count, 1.0F);
    const float* const centred = terms += stride;
    for (int f = 0; f < n; ++f, terms += stride) {
        const auto i = static_cast<std::size_t>(f);
        for (int x = 0; x < count; ++x) terms[x] = features[i][x] - origin[i];
    }
    for (int f = 0; f < n; ++f) {
        const float* a = centred + static_cast<std::ptrdiff_t>(f) * stride;
        for (int g = f; g < n; ++g, terms += stride) {
            const float* b = centred + static_cast<std::ptrdiff_t>(g) * stride;
            for (int x = 0; x < count; ++x) terms[x] = a[x] * b[x];
        }
    }
    for (const float* y : target) {
        std::copy_n(y, count, terms);
        terms += stride;
        for (int f = 0; f < n; ++f, terms += stride) {
            const float* a = centred + static_cast<std::ptrdiff_t>(f) * stride;
            for (int x = 0; x < count; ++x) terms[x] = y[x] * a[x];
        }
    }
}

// The terms that a row of neighbours adds to the predictions: per colour what its fit says at the origin and
// its slopes, and 1. Each is a row, `stride` after the one before.
TUNGSTEN_DIP_FASTEST void carry_coefficients(const FeatureRows& features, const FeatureValues& origin, int n,
                                             const float* const* coefficients, int count, int stride,
                                             float* terms) {
    for (int c = 0; c < colors; ++c) {
        float* constant = terms;
        std::copy_n(*coefficients++, count, constant);
        terms += stride;
        for (int f = 0; f < n; ++f, terms += stride) {
            const auto i = static_cast<std::size_t>(f);
            std::copy_n(*coefficients++, count, terms);
            for (int x = 0; x < count; ++x) constant[x] -= terms[x] * (features[i][x] - origin[i]);
        }
    }
    std::fill_n(terms, count, 1.0F);
}

// Adds to a row of every sum the row of its term, weighted, at `offset_count` neighbours in a row, `step`
// pixels apart.
TUNGSTEN_DIP_FASTEST void add_weighted(const float* weights, int offset_count, int step, const float* terms,
                                       std::ptrdiff_t stride, int term_count, int count, float* sums) {
    for (int first = 0; first < term_count; first += terms_at_once, terms += terms_at_once * stride) {
        for (int x = 0; x < count; x += lanes) {
            std::array<Lanes, terms_at_once> sum_of_term{};
            const float* weight = weights + x;
            const float* neighbour = terms + x;
            for (int k = 0; k < offset_count; ++k, weight += tile_width, neighbour += step) {
                const float* value = neighbour;
#pragma GCC unroll terms_at_once
                for (Lanes& sum : sum_of_term) {
                    sum += reinterpret_cast<const LanesInMemory&>(*weight) *
                           reinterpret_cast<const LanesInMemory&>(*value);
                    value += stride;
                }
            }
            float* to = sums + x;
#pragma GCC unroll terms_at_once
            for (const Lanes& sum : sum_of_term) {
                reinterpret_cast<LanesInMemory&>(*to) += sum;
                to += tile_width;
            }
        }
        sums += std::ptrdiff_t{terms_at_once} * tile_width;
    }
}

// Pixels whose normal equations are solved together.
constexpr int systems = 4;
using Systems [[gnu::vector_size(systems * sizeof(double))]] = double;

// The lower triangle of the features' covariances, and below it a row per colour: its covariances with the
// features, which become its slopes.
using Equations = std::array<std::array<Systems, max_features>, max_features + colors>;

// Solves by Cholesky's factors, A = L L'. The factorisation takes the rows of the colours through the
// forward substitution as if they belonged to the matrix.
TUNGSTEN_DIP_FASTEST void solve(std::size_t n, Equations& a) {
    for (std::size_t m = 0; m < n; ++m) {
        Systems& pivot = a[m][m];
        // No pivot is less than the ridge, but for rounding.
        for (int s = 0; s < systems; ++s) pivot[s] = 1 / std::sqrt(std::max(pivot[s], ridge));
        for (std::size_t i = m + 1; i < n + colors; ++i) a[i][m] *= pivot;
        for (std::size_t j = m + 1; j < n; ++j) {
            for (std::size_t i = j; i < n + colors; ++i) a[i][j] -= a[i][m] * a[j][m];
        }
    }
    for (std::size_t c = n; c < n + colors; ++c) {
        for (std::size_t m = n; m-- > 0;) {
            for (std::size_t i = m + 1; i < n; ++i) a[c][m] -= a[i][m] * a[c][i];
            a[c][m] *= a[m][m];
        }
    }
}

// Fits `count` pixels, `systems` at most, from their sums of the terms of `carry_products`, which lie
// tile_width apart. Writes, in planes that lie `plane_size` apart, what the fit says at the pixel itself and
// its slopes, for every colour.
TUNGSTEN_DIP_FASTEST void fit_pixels(const float* sums, const FeatureRows& features,
                                     const FeatureValues& origin, std::size_t n, int count,
                                     float* coefficients, std::ptrdiff_t plane_size) {
    Equations a;                             // NOLINT(*-member-init): filled below
    std::array<Systems, max_features> mean;  // NOLINT(*-member-init)
    Systems scale;                           // NOLINT(*-member-init)
    for (int s = 0; s < systems; ++s) scale[s] = 1.0 / std::max(sums[s], least_weight_sum);
    const auto next = [&](Systems& values) {
        sums += tile_width;
        for (int s = 0; s < systems; ++s) values[s] = static_cast<double>(sums[s]);
        values *= scale;
    };
    for (std::size_t f = 0; f < n; ++f) next(mean[f]);
    for (std::size_t f = 0; f < n; ++f) {
        for (std::size_t g = f; g < n; ++g) {
            next(a[g][f]);
            a[g][f] -= mean[f] * mean[g];
        }
        for (int s = 0; s < systems; ++s) a[f][f][s] = std::max(a[f][f][s], 0.0) + ridge;
    }
    std::array<Systems, colors> constant;  // NOLINT(*-member-init)
    for (std::size_t c = 0; c < colors; ++c) {
        next(constant[c]);
        for (std::size_t f = 0; f < n; ++f) {
            next(a[n + c][f]);
            a[n + c][f] -= mean[f] * constant[c];
        }
    }
    solve(n, a);
    const auto write = [&](const Systems& values) {
        for (int s = 0; s < count; ++s) coefficients[s] = static_cast<float>(values[s]);
        coefficients += plane_size;
    };
    for (std::size_t f = 0; f < n; ++f) {
        for (int s = 0; s < systems; ++s) mean[f][s] -= static_cast<double>(features[f][s] - origin[f]);
    }
    for (std::size_t c = 0; c < colors; ++c) {
        for (std::size_t f = 0; f < n; ++f) constant[c] -= a[n + c][f] * mean[f];
        write(constant[c]);
        for (std::size_t f = 0; f < n; ++f) write(a[n + c][f]);
    }
}

// colors[c] = (constant_c + slope_c . (f - origin)) / weight, from the sums of the terms of
// `carry_coefficients`, which lie tile_width apart.
TUNGSTEN_DIP_FASTEST void predict_row(const float* sums, const FeatureRows& features,
                                      const FeatureValues& origin, int n, int count, float* predictions) {
    const float* weight = sums + std::ptrdiff_t{colors} * (n + 1) * tile_width;
    for (int c = 0; c < colors; ++c, predictions += tile_width) {
        std::copy_n(sums, count, predictions);
        sums += tile_width;
        for (int f = 0; f < n; ++f, sums += tile_width) {
            const auto i = static_cast<std::size_t>(f);
            for (int x = 0; x < count; ++x) predictions[x] += sums[x] * (features[i][x] - origin[i]);
        }
        for (int x = 0; x < count; ++x) predictions[x] /= std::max(weight[x], least_weight_sum);
    }
}

class Regression {
  public:
    Regression(ConstImage target, ConstImage features, std::span<const float> penalty,
               const std::optional<Guide>& guide, SearchWindow window, int threads)
        : window_(window),
          threads_(threads),
          target_(target, window.radius, threads),
          features_(features, window.radius, threads),
          coefficients_(colors * (features.channels + 1), target.height, target.width, window.radius) {
        std::ranges::copy(penalty, penalty_.begin());
        if (guide) {
            const int margin = window.radius + patch_radius;
            guide_ = PaddedGuide{.image = {guide->image, margin, threads},
                                 .variance = {guide->variance, margin, threads},
                                 .k_squared = guide->k * guide->k};
        }
    }

    void run(Image out) {
        for_all_tiles([&](const Tile& tile, Scratch& scratch) { fit(tile, scratch); });
        for_all_tiles([&](const Tile& tile, Scratch& scratch) { gather(tile, scratch, out); });
    }

  private:
    struct PaddedGuide {
        PaddedPlanes image;
        PaddedPlanes variance;
        float k_squared;
    };

    struct Scratch {
        std::vector<float> terms;      // [row][term][column], of the tile and the windows of its pixels
        std::vector<float> weights;    // [row of the tile][offset in a row][column]
        std::vector<float> sums;       // [row of the tile][term][column]
        std::vector<float> distances;  // [row][column], of the tile and its patches

        [[nodiscard]] float* sums_of_row(int i) {
            return sums.data() + static_cast<std::ptrdiff_t>(i) * (std::ssize(sums) / tile_height);
        }
    };

    template <typename Body>
    void for_all_tiles(const Body& body) {
        const int columns = (target_.width() + tile_width - 1) / tile_width;
        const int rows = (target_.height() + tile_height - 1) / tile_height;
        parallel_for(rows, threads_, [&](int row) {
            Scratch scratch;
            const int y = row * tile_height;
            for (int column = 0; column < columns; ++column) {
                const int x = column * tile_width;
                body(Tile{.y = y,
                          .x = x,
                          .height = std::min(tile_height, target_.height() - y),
                          .width = std::min(tile_width, target_.width() - x)},
                     scratch);
            }
        });
    }

    // The pixels that a window's fit skips must not be skipped again when predictions are gathered, or the
    // image would fall apart into grids that know nothing of each other.
    [[nodiscard]] int gather_step() const { return window_.step == 1 ? 1 : window_.step + 1; }

    // Leaves in scratch.sums, for every pixel of the tile, the weighted sums of `term_count` terms over
    // every step-th row and column of its window, the pixel itself among them. `carry(y, x, count, stride,
    // terms)` writes the terms of the neighbours in row y from column x on.
    template <typename Carry>
    void sum_windows(const Tile& tile, int step, int term_count, Scratch& scratch, const Carry& carry) const {
        const int reach = window_.radius / step * step;
        const int offset_count = 2 * reach / step + 1;
        const int padded_count = rounded_up(term_count, terms_at_once);
        const int stride = tile_width + 2 * reach;
        const int first_row = std::max(tile.y - reach, 0);
        const int end_row = std::min(tile.y + tile.height + reach, target_.height());
        const std::ptrdiff_t size_of_row = std::ptrdiff_t{padded_count} * stride;
        const std::ptrdiff_t weights_of_row = std::ptrdiff_t{offset_count} * tile_width;
        scratch.terms.resize(static_cast<std::size_t>((end_row - first_row) * size_of_row));
        scratch.weights.resize(static_cast<std::size_t>(tile_height * weights_of_row));
        scratch.sums.assign(std::size_t{tile_height} * static_cast<std::size_t>(padded_count) * tile_width,
                            0);
        for (int y = first_row; y < end_row; ++y) {
            carry(y, tile.x - reach, tile.width + 2 * reach, stride,
                  scratch.terms.data() + (y - first_row) * size_of_row);
        }
        for (int dy = -reach; dy <= reach; dy += step) {
            const int first = std::max(tile.y, -dy);
            const int end = std::min(tile.y + tile.height, target_.height() - dy);
            if (first >= end) continue;
            for (int k = 0; k < offset_count; ++k) {
                const int dx = k * step - reach;
                weigh(tile, dy, dx, share(dy, reach, step) * share(dx, reach, step), scratch,
                      scratch.weights.data() + std::ptrdiff_t{k} * tile_width, weights_of_row);
            }
            for (int y = first; y < end; ++y) {
                add_weighted(scratch.weights.data() + (y - tile.y) * weights_of_row, offset_count, step,
                             scratch.terms.data() + (y + dy - first_row) * size_of_row, stride, padded_count,
                             rounded_up(tile.width, lanes), scratch.sums_of_row(y - tile.y));
            }
        }
    }

    // The ends of a window that skips pixels count half (trapezoidal rule). If they counted in full, the two
    // sums together would give every second or third pixel more weight than its neighbours: a grid would
    // show.
    [[nodiscard]] static float share(int offset, int reach, int step) {
        return step > 1 && std::abs(offset) == reach ? 0.5F : 1.0F;
    }

    // The weights of the tile's neighbours at one offset; 0 outside of the image, but for whole rows of them.
    void weigh(const Tile& tile, int dy, int dx, float share, Scratch& scratch, float* weights,
               std::ptrdiff_t weights_of_row) const {
        if (guide_) compare_guide(*guide_, tile, dy, dx, scratch, weights, weights_of_row);
        for (int i = 0; i < tile.height; ++i, weights += weights_of_row) {
            const int y = tile.y + i;
            if (y + dy < 0 || y + dy >= target_.height()) continue;
            if (!guide_) std::fill_n(weights, tile_width, 0.0F);
            weigh_row(features_, y, tile.x, dy, dx, penalty_, share, rounded_up(tile.width, lanes), weights);
            drop_outside_partners(tile.x, dx, target_.width(), tile.width, weights);
        }
    }

    // The guide's distances at one offset, averaged over patches.
    static void compare_guide(const PaddedGuide& guide, const Tile& tile, int dy, int dx, Scratch& scratch,
                              float* distances, std::ptrdiff_t distances_of_row) {
        const int rows = tile.height + 2 * patch_radius;
        const int columns = rounded_up(tile.width + 2 * patch_radius, lanes);
        scratch.distances.resize(static_cast<std::size_t>(rows) * static_cast<std::size_t>(columns));
        float* row = scratch.distances.data();
        for (int y = tile.y - patch_radius; y < tile.y + tile.height + patch_radius; ++y, row += columns) {
            const std::ptrdiff_t p = tile.x - patch_radius;
            const std::ptrdiff_t q = p + dx;
            compare_rows(guide.image.row(0, y) + p, guide.image.row(0, y + dy) + q,
                         guide.variance.row(0, y) + p, guide.variance.row(0, y + dy) + q,
                         guide.image.plane_size(), guide.image.channels(), guide.k_squared, columns, row);
        }
        for (int i = 0; i < tile.height; ++i) {
            average_patches(scratch.distances.data() + static_cast<std::ptrdiff_t>(i) * columns, columns,
                            tile.width, distances + i * distances_of_row);
        }
    }

    [[nodiscard]] FeatureRows feature_rows(int y, int x) const {
        FeatureRows rows{};
        for (int f = 0; f < features_.channels(); ++f)
            rows[static_cast<std::size_t>(f)] = features_.row(f, y) + x;
        return rows;
    }

    // The features of the tile's middle.
    [[nodiscard]] FeatureValues origin_of(const Tile& tile) const {
        FeatureValues origin{};
        for (int f = 0; f < features_.channels(); ++f) {
            origin[static_cast<std::size_t>(f)] =
                features_.row(f, tile.y + tile.height / 2)[tile.x + tile.width / 2];
        }
        return origin;
    }

    void fit(const Tile& tile, Scratch& scratch) {
        const int n = features_.channels();
        const FeatureValues origin = origin_of(tile);
        sum_windows(tile, window_.step, (n + 1) * (n + 2) / 2 + colors * (n + 1), scratch,
                    [&](int y, int x, int count, int stride, float* terms) {
                        carry_products(feature_rows(y, x), origin, n,
                                       {target_.row(0, y) + x, target_.row(1, y) + x, target_.row(2, y) + x},
                                       count, stride, terms);
                    });
        for (int i = 0; i < tile.height; ++i) {
            for (int j = 0; j < tile.width; j += systems) {
                const int y = tile.y + i;
                const int x = tile.x + j;
                fit_pixels(scratch.sums_of_row(i) + j, feature_rows(y, x), origin,
                           static_cast<std::size_t>(n), std::min(systems, tile.width - j),
                           coefficients_.row(0, y) + x, coefficients_.plane_size());
            }
        }
    }

    void gather(const Tile& tile, Scratch& scratch, Image out) const {
        const int n = features_.channels();
        const FeatureValues origin = origin_of(tile);
        std::vector<const float*> coefficients(static_cast<std::size_t>(coefficients_.channels()));
        sum_windows(tile, gather_step(), coefficients_.channels() + 1, scratch,
                    [&](int y, int x, int count, int stride, float* terms) {
                        for (int plane = 0; plane < coefficients_.channels(); ++plane)
                            coefficients[static_cast<std::size_t>(plane)] = coefficients_.row(plane, y) + x;
                        carry_coefficients(feature_rows(y, x), origin, n, coefficients.data(), count, stride,
                                           terms);
                    });
        std::array<float, std::size_t{colors} * tile_width> predictions{};
        for (int i = 0; i < tile.height; ++i) {
            const int y = tile.y + i;
            predict_row(scratch.sums_of_row(i), feature_rows(y, tile.x), origin, n, tile.width,
                        predictions.data());
            for (int j = 0; j < tile.width; ++j) {
                for (int c = 0; c < colors; ++c) {
                    out.at(y, tile.x + j, c) =
                        predictions[static_cast<std::size_t>(c) * tile_width + static_cast<std::size_t>(j)];
                }
            }
        }
    }

    SearchWindow window_;
    FeatureValues penalty_{};
    int threads_;
    PaddedPlanes target_;
    PaddedPlanes features_;
    std::optional<PaddedGuide> guide_;
    PaddedPlanes coefficients_;
};

}  // namespace

void regress(ConstImage target, ConstImage features, std::span<const float> penalty,
             const std::optional<Guide>& guide, SearchWindow window, Image out, int threads) {
    check_channels("target", target, colors);
    check_same_size("features", features, "target", target);
    check_same_shape("out", out, "target", target);
    if (features.channels > max_features)
        refuse("features", "up to " + std::to_string(max_features) + " channels", features.channels);
    if (std::ssize(penalty) != features.channels)
        refuse("penalty", "one value per feature, " + std::to_string(features.channels), penalty.size());
    for (const float value : penalty) {
        if (!(value >= 0) || !std::isfinite(value)) refuse("penalty", "finite numbers from 0 on", value);
    }
    if (guide) {
        check_same_size("guide", guide->image, "target", target);
        check_same_shape("guide_variance", guide->variance, "guide", guide->image);
        if (guide->image.channels == 0) refuse("guide", "1 channel or more", 0);
        check_k(guide->k);
    }
    check_window(window);
    if (target.size() == 0) return;
    Regression(target, features, penalty, guide, window, threads).run(out);
}

}  // namespace tungsten_dip
