// Local first-order regression: the pilots from which the fit composes its image.
//
// A tile of pixels is carried through all offsets of the window together, so that every sum of the normal
// equations is one vectorised loop over a row, and the sums of a tile stay in the cache.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <stdexcept>
#include <vector>

#include "core.hpp"
#include "exp_minus.hpp"
#include "fastest.hpp"
#include "padded_planes.hpp"

namespace tungsten_dip {
namespace {

constexpr int tile_width = 64;
constexpr int tile_height = 8;
constexpr int tile_pixels = tile_width * tile_height;
constexpr int colors = 3;
constexpr int max_features = 16;

// Distances of the guide below this are equal whatever its variance says.
constexpr float least_variance = 1e-8F;
constexpr float least_weight_sum = 1e-20F;

struct Tile {
    int y;
    int x;
    int height;
    int width;
};

struct Offset {
    int y;
    int x;
};

// distance += the noise-corrected squared difference of one row of the guide to another, in units of its
// noise (Rousselle et al. 2012, equation 2).
TUNGSTEN_DIP_FASTEST void add_guide_distance(const float* p, const float* q, const float* variance_p,
                                             const float* variance_q, float k_squared, float scale, int count,
                                             float* distance) {
    for (int i = 0; i < count; ++i) {
        const float difference = p[i] - q[i];
        const float noise = variance_p[i] + std::min(variance_p[i], variance_q[i]);
        distance[i] += scale * (difference * difference - noise) /
                       (least_variance + k_squared * (variance_p[i] + variance_q[i]));
    }
}

// sums[i] = the mean of `count_of_terms` values that lie `step` apart, starting at values[i].
TUNGSTEN_DIP_FASTEST void sliding_mean(const float* values, int count_of_terms, std::ptrdiff_t step,
                                       int count, float* sums) {
    const float scale = 1.0F / static_cast<float>(count_of_terms);
    std::fill_n(sums, count, 0.0F);
    for (int term = 0; term < count_of_terms; ++term) {
        for (int i = 0; i < count; ++i) sums[i] += scale * values[i + term * step];
    }
}

TUNGSTEN_DIP_FASTEST void add_feature_distance(const float* p, const float* q, float penalty, int count,
                                               float* distance) {
    for (int i = 0; i < count; ++i) distance[i] += penalty * (p[i] - q[i]) * (p[i] - q[i]);
}

TUNGSTEN_DIP_FASTEST void weights_from_distances(int count, float* values) {
    for (int i = 0; i < count; ++i) values[i] = exp_minus(std::max(values[i], 0.0F));
}

// Adds one row of neighbours to the normal equations: the sums of w, w f, w f f' (upper triangle), and per
// colour of w y and w y f.
TUNGSTEN_DIP_FASTEST void add_to_normal_equations(const float* weights,
                                                  const std::array<const float*, max_features>& features_p,
                                                  const std::array<const float*, max_features>& features_q,
                                                  const std::array<const float*, colors>& target_q,
                                                  int feature_count, int count, float* sums) {
    std::array<std::array<float, tile_width>, max_features> centred;  // NOLINT: filled below
    std::array<float, tile_width> weighted;                           // NOLINT: filled below
    const auto add = [&](const float* a, const float* b) {
        for (int i = 0; i < count; ++i) sums[i] += a[i] * b[i];
        sums += tile_pixels;
    };
    const auto n = static_cast<std::size_t>(feature_count);
    for (std::size_t f = 0; f < n; ++f) {
        for (int i = 0; i < count; ++i)
            centred[f][static_cast<std::size_t>(i)] = features_q[f][i] - features_p[f][i];
    }
    for (int i = 0; i < count; ++i) sums[i] += weights[i];
    sums += tile_pixels;
    for (std::size_t f = 0; f < n; ++f) add(weights, centred[f].data());
    for (std::size_t f = 0; f < n; ++f) {
        for (int i = 0; i < count; ++i)
            weighted[static_cast<std::size_t>(i)] = weights[i] * centred[f][static_cast<std::size_t>(i)];
        for (std::size_t g = f; g < n; ++g) add(weighted.data(), centred[g].data());
    }
    for (std::size_t c = 0; c < colors; ++c) {
        for (int i = 0; i < count; ++i) weighted[static_cast<std::size_t>(i)] = weights[i] * target_q[c][i];
        for (int i = 0; i < count; ++i) sums[i] += weighted[static_cast<std::size_t>(i)];
        sums += tile_pixels;
        for (std::size_t f = 0; f < n; ++f) add(weighted.data(), centred[f].data());
    }
}

// sums[c] += w (constant_c + slope_c . (f(p) - f(q))): what the fits around q predict at p.
TUNGSTEN_DIP_FASTEST void add_predictions(const float* weights,
                                          const std::array<const float*, max_features>& features_p,
                                          const std::array<const float*, max_features>& features_q,
                                          const float* const* coefficients, int feature_count, int count,
                                          float* sums) {
    std::array<float, tile_width> prediction;  // NOLINT: filled below
    const auto n = static_cast<std::size_t>(feature_count);
    for (int c = 0; c < colors; ++c, sums += tile_pixels) {
        const float* constant = *coefficients++;
        for (int i = 0; i < count; ++i) prediction[static_cast<std::size_t>(i)] = constant[i];
        for (std::size_t f = 0; f < n; ++f) {
            const float* slope = *coefficients++;
            const float* p = features_p[f];
            const float* q = features_q[f];
            for (int i = 0; i < count; ++i)
                prediction[static_cast<std::size_t>(i)] += slope[i] * (p[i] - q[i]);
        }
        for (int i = 0; i < count; ++i) sums[i] += weights[i] * prediction[static_cast<std::size_t>(i)];
    }
    for (int i = 0; i < count; ++i) sums[i] += weights[i];
}

using Matrix = std::array<std::array<double, max_features>, max_features>;
using Vector = std::array<double, max_features>;

// Factors a symmetric positive definite matrix in place, A = L L'.
void cholesky(std::size_t n, Matrix& a) {
    for (std::size_t i = 0; i < n; ++i) {
        for (std::size_t j = 0; j <= i; ++j) {
            double sum = a[i][j];
            for (std::size_t m = 0; m < j; ++m) sum -= a[i][m] * a[j][m];
            // Rounding can leave a pivot of 0 where features repeat one another; the ridge is its true size.
            a[i][j] = i == j ? std::sqrt(std::max(sum, 1e-12)) : sum / a[j][j];
        }
    }
}

void solve_cholesky(std::size_t n, const Matrix& l, Vector& b) {
    for (std::size_t i = 0; i < n; ++i) {
        for (std::size_t m = 0; m < i; ++m) b[i] -= l[i][m] * b[m];
        b[i] /= l[i][i];
    }
    for (std::size_t i = n; i-- > 0;) {
        for (std::size_t m = i + 1; m < n; ++m) b[i] -= l[m][i] * b[m];
        b[i] /= l[i][i];
    }
}

class Regression {
  public:
    Regression(ConstImage target, ConstImage features, const float* penalty, ConstImage guide,
               ConstImage guide_variance, const RegressionWindow& window, int threads)
        : window_(window),
          penalty_(penalty, penalty + features.channels),
          threads_(threads),
          guided_(guide.known()),
          target_(target, window.radius, threads),
          features_(features, window.radius, threads),
          guide_(guided_ ? PaddedPlanes(guide, window.radius + window.patch_radius, threads)
                         : PaddedPlanes(0, 0, 0, 0)),
          guide_variance_(guided_ ? PaddedPlanes(guide_variance, window.radius + window.patch_radius, threads)
                                  : PaddedPlanes(0, 0, 0, 0)),
          coefficients_(colors * (features.channels + 1), target.height, target.width, window.radius) {}

    void run(Image out) {
        for_all_tiles([&](const Tile& tile, Scratch& scratch) { fit(tile, scratch); });
        for_all_tiles([&](const Tile& tile, Scratch& scratch) { gather(tile, scratch, out); });
    }

  private:
    struct Scratch {
        std::vector<float> sums;
        std::vector<float> distances;
        std::vector<float> row_means;
        std::array<float, tile_pixels> weights{};
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

    // Calls body(offset), with scratch.weights set, for every step-th offset of the window, the pixel itself
    // among them, at which the tile has a neighbour.
    template <typename Body>
    void for_all_offsets(const Tile& tile, int step, Scratch& scratch, const Body& body) const {
        const int reach = window_.radius / step * step;
        for (int dy = -reach; dy <= reach; dy += step) {
            for (int dx = -reach; dx <= reach; dx += step) {
                const bool any_row = tile.y + tile.height > -dy && tile.y + dy < target_.height();
                const bool any_column = tile.x + tile.width > -dx && tile.x + dx < target_.width();
                if (!any_row || !any_column) continue;
                weigh(tile, {.y = dy, .x = dx}, scratch);
                body(Offset{.y = dy, .x = dx});
            }
        }
    }

    void weigh(const Tile& tile, Offset offset, Scratch& scratch) const {
        const auto row_of = [&](int i) {
            return scratch.weights.data() + static_cast<std::ptrdiff_t>(i) * tile_width;
        };
        if (guided_) {
            compare_guide(tile, offset, scratch);
        } else {
            scratch.weights.fill(0);
        }
        for (int i = 0; i < tile.height; ++i) {
            const int y = tile.y + i;
            const int neighbour_y = y + offset.y;
            float* weights = row_of(i);
            if (neighbour_y < 0 || neighbour_y >= target_.height()) {
                std::fill_n(weights, tile_width, 0.0F);
                continue;
            }
            for (int f = 0; f < features_.channels(); ++f) {
                const float penalty = penalty_[static_cast<std::size_t>(f)];
                if (penalty <= 0) continue;
                add_feature_distance(features_.row(f, y) + tile.x,
                                     features_.row(f, neighbour_y) + tile.x + offset.x, penalty, tile.width,
                                     weights);
            }
            weights_from_distances(tile.width, weights);
            const int first = std::clamp(-offset.x - tile.x, 0, tile.width);
            const int last = std::clamp(target_.width() - offset.x - tile.x, 0, tile.width);
            std::fill(weights, weights + first, 0.0F);
            std::fill(weights + last, weights + tile.width, 0.0F);
        }
    }

    // Leaves in scratch.weights the guide's distances, averaged over patches and never negative.
    void compare_guide(const Tile& tile, Offset offset, Scratch& scratch) const {
        const int r = window_.patch_radius;
        const int rows = tile.height + 2 * r;
        const int columns = tile.width + 2 * r;
        scratch.distances.assign(static_cast<std::size_t>(rows) * static_cast<std::size_t>(columns), 0);
        scratch.row_means.resize(static_cast<std::size_t>(rows) * tile_width);
        const float scale = 1.0F / static_cast<float>(guide_.channels());
        for (int i = 0; i < rows; ++i) {
            const int y = tile.y - r + i;
            // Rows beyond the margin belong to neighbours outside of the image, whose weight becomes 0.
            const int neighbour_y = std::clamp(y + offset.y, -r, target_.height() - 1 + r);
            float* distances = scratch.distances.data() + static_cast<std::ptrdiff_t>(i) * columns;
            for (int c = 0; c < guide_.channels(); ++c) {
                const std::ptrdiff_t p = tile.x - r;
                const std::ptrdiff_t q = p + offset.x;
                add_guide_distance(guide_.row(c, y) + p, guide_.row(c, neighbour_y) + q,
                                   guide_variance_.row(c, y) + p, guide_variance_.row(c, neighbour_y) + q,
                                   window_.k * window_.k, scale, columns, distances);
            }
            sliding_mean(distances, 2 * r + 1, 1, tile.width,
                         scratch.row_means.data() + static_cast<std::ptrdiff_t>(i) * tile_width);
        }
        for (int i = 0; i < tile.height; ++i) {
            float* distances = scratch.weights.data() + static_cast<std::ptrdiff_t>(i) * tile_width;
            sliding_mean(scratch.row_means.data() + static_cast<std::ptrdiff_t>(i) * tile_width, 2 * r + 1,
                         tile_width, tile.width, distances);
            for (int j = 0; j < tile.width; ++j) distances[j] = std::max(distances[j], 0.0F);
        }
    }

    [[nodiscard]] std::array<const float*, max_features> feature_rows(int y, int x) const {
        std::array<const float*, max_features> rows{};
        for (int f = 0; f < features_.channels(); ++f)
            rows[static_cast<std::size_t>(f)] = features_.row(f, y) + x;
        return rows;
    }

    void fit(const Tile& tile, Scratch& scratch) {
        const int n = features_.channels();
        const int sum_count = (n + 1) * (n + 2) / 2 + colors * (n + 1);
        scratch.sums.assign(static_cast<std::size_t>(sum_count) * tile_pixels, 0);
        for_all_offsets(tile, window_.step, scratch, [&](Offset offset) {
            for (int i = 0; i < tile.height; ++i) {
                const int y = tile.y + i;
                const int neighbour_y = y + offset.y;
                if (neighbour_y < 0 || neighbour_y >= target_.height()) continue;
                const int neighbour_x = tile.x + offset.x;
                const std::array<const float*, colors> target{target_.row(0, neighbour_y) + neighbour_x,
                                                              target_.row(1, neighbour_y) + neighbour_x,
                                                              target_.row(2, neighbour_y) + neighbour_x};
                const std::ptrdiff_t first = static_cast<std::ptrdiff_t>(i) * tile_width;
                add_to_normal_equations(scratch.weights.data() + first, feature_rows(y, tile.x),
                                        feature_rows(neighbour_y, neighbour_x), target, n, tile.width,
                                        scratch.sums.data() + first);
            }
        });
        for (int i = 0; i < tile.height; ++i) {
            for (int j = 0; j < tile.width; ++j) {
                solve(scratch.sums.data() + static_cast<std::ptrdiff_t>(i) * tile_width + j, tile.y + i,
                      tile.x + j);
            }
        }
    }

    // Solves one pixel's normal equations, whose sums lie tile_pixels apart, and keeps its coefficients.
    void solve(const float* sums, int y, int x) {
        const auto n = static_cast<std::size_t>(features_.channels());
        const double scale = 1.0 / std::max(*sums, least_weight_sum);
        const auto next = [&] {
            sums += tile_pixels;
            return scale * static_cast<double>(*sums);
        };
        Vector mean{};
        Matrix covariance{};
        for (std::size_t f = 0; f < n; ++f) mean[f] = next();
        for (std::size_t f = 0; f < n; ++f) {
            for (std::size_t g = f; g < n; ++g) covariance[g][f] = next() - mean[f] * mean[g];
            covariance[f][f] = std::max(covariance[f][f], 0.0) + static_cast<double>(window_.ridge);
        }
        cholesky(n, covariance);
        int plane = 0;
        for (int c = 0; c < colors; ++c) {
            const double mean_color = next();
            Vector slope{};
            for (std::size_t f = 0; f < n; ++f) slope[f] = next() - mean[f] * mean_color;
            solve_cholesky(n, covariance, slope);
            double constant = mean_color;
            for (std::size_t f = 0; f < n; ++f) constant -= slope[f] * mean[f];
            coefficients_.row(plane++, y)[x] = static_cast<float>(constant);
            for (std::size_t f = 0; f < n; ++f)
                coefficients_.row(plane++, y)[x] = static_cast<float>(slope[f]);
        }
    }

    void gather(const Tile& tile, Scratch& scratch, Image out) const {
        const int n = features_.channels();
        scratch.sums.assign(std::size_t{colors + 1} * tile_pixels, 0);
        std::vector<const float*> coefficients(static_cast<std::size_t>(coefficients_.channels()));
        for_all_offsets(tile, gather_step(), scratch, [&](Offset offset) {
            for (int i = 0; i < tile.height; ++i) {
                const int y = tile.y + i;
                const int neighbour_y = y + offset.y;
                if (neighbour_y < 0 || neighbour_y >= target_.height()) continue;
                const int neighbour_x = tile.x + offset.x;
                for (int plane = 0; plane < coefficients_.channels(); ++plane) {
                    coefficients[static_cast<std::size_t>(plane)] =
                        coefficients_.row(plane, neighbour_y) + neighbour_x;
                }
                const std::ptrdiff_t first = static_cast<std::ptrdiff_t>(i) * tile_width;
                add_predictions(scratch.weights.data() + first, feature_rows(y, tile.x),
                                feature_rows(neighbour_y, neighbour_x), coefficients.data(), n, tile.width,
                                scratch.sums.data() + first);
            }
        });
        for (int i = 0; i < tile.height; ++i) {
            for (int j = 0; j < tile.width; ++j) {
                const float* sums = scratch.sums.data() + static_cast<std::ptrdiff_t>(i) * tile_width + j;
                const float weight = std::max(sums[std::ptrdiff_t{colors} * tile_pixels], least_weight_sum);
                for (int c = 0; c < colors; ++c) {
                    out.at(tile.y + i, tile.x + j, c) =
                        sums[static_cast<std::ptrdiff_t>(c) * tile_pixels] / weight;
                }
            }
        }
    }

    RegressionWindow window_;
    std::vector<float> penalty_;
    int threads_;
    bool guided_;
    PaddedPlanes target_;
    PaddedPlanes features_;
    PaddedPlanes guide_;
    PaddedPlanes guide_variance_;
    PaddedPlanes coefficients_;
};

}  // namespace

void regress(ConstImage target, ConstImage features, const float* penalty, ConstImage guide,
             ConstImage guide_variance, const RegressionWindow& window, Image out, int threads) {
    if (features.channels > max_features) throw std::invalid_argument("at most 16 features");
    if (target.channels != colors) throw std::invalid_argument("the target must have 3 channels");
    if (window.radius < 0 || window.step < 1 || window.radius % window.step != 0 || window.patch_radius < 0) {
        throw std::invalid_argument(
            "the window's radius must be a multiple of its step, and no radius negative");
    }
    if (target.size() == 0) return;
    Regression(target, features, penalty, guide, guide_variance, window, threads).run(out);
}

}  // namespace tungsten_dip
