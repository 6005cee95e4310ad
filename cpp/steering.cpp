// Smoothing along the edges of features, with Gaussians that the structure tensor steers: few samples saw how
// much of a pixel each surface covers, and those of its neighbours along the edge add to it.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "checks.hpp"
#include "core.hpp"
#include "exp_minus.hpp"
#include "fastest.hpp"
#include "padded_planes.hpp"

namespace tungsten_dip {
namespace {

// In pixels, of the Gaussian whose derivatives are taken, and of the one that smooths their products; and
// where the kernels end.
constexpr float derivative_sigma = 0.7F;
constexpr int derivative_radius = 3;
constexpr float tensor_sigma = 2.0F;
constexpr int tensor_radius = 6;

// Standard deviations beyond which neighbours are not looked at.
constexpr float reach = 2.0F;
// Narrower Gaussians leave nothing of any neighbour either, but their squares may be 0.
constexpr float least_sigma = 0.01F;
constexpr float largest_sigma = max_radius / reach;

// Keeps what is divided by a tensor's trace finite where there is no edge.
constexpr float least_trace = 1e-12F;

// Neighbours whose weight is below exp(-this), against 1 of the pixel itself, do not change a float's sum.
constexpr float negligible = 25.0F;
// Neighbouring columns for which an offset is left out together.
constexpr int block_width = 32;

// Penalty of the squared relative difference between the structure tensors of two pixels.
constexpr float other_edge_penalty = 1.5F;

template <int radius>
using Kernel = std::array<float, 2 * std::size_t{radius} + 1>;

template <int radius>
Kernel<radius> gaussian(float sigma) {
    Kernel<radius> kernel{};
    float sum = 0;
    for (std::size_t i = 0; i < kernel.size(); ++i) {
        const float x = (static_cast<float>(i) - radius) / sigma;
        sum += kernel[i] = std::exp(-0.5F * x * x);
    }
    for (float& value : kernel) value /= sum;
    return kernel;
}

template <int radius>
Kernel<radius> gaussian_derivative(float sigma) {
    Kernel<radius> kernel = gaussian<radius>(sigma);
    for (std::size_t i = 0; i < kernel.size(); ++i) {
        kernel[i] *= (static_cast<float>(i) - radius) / (sigma * sigma);
    }
    return kernel;
}

TUNGSTEN_DIP_FASTEST void add_weighted(const float* weights, const float* values, int count, float* sums) {
    for (int x = 0; x < count; ++x) sums[x] += weights[x] * values[x];
}

TUNGSTEN_DIP_FASTEST void add_scaled(const float* values, float scale, std::size_t count, float* sums) {
    for (std::size_t x = 0; x < count; ++x) sums[x] += scale * values[x];
}

// A row of a channel, convolved along columns; `radius` pixels more at both ends.
template <int radius>
void convolve_columns(const PaddedPlanes& in, int channel, int y, const Kernel<radius>& kernel,
                      std::vector<float>& out) {
    out.assign(static_cast<std::size_t>(in.width()) + 2 * std::size_t{radius}, 0);
    int from = y - radius;
    for (const float weight : kernel)
        add_scaled(in.row(channel, from++) - radius, weight, out.size(), out.data());
}

// out = what `convolve_columns` gives, convolved along the row.
template <int radius>
void convolve_row(const std::vector<float>& in, const Kernel<radius>& kernel, std::vector<float>& out) {
    out.assign(in.size() - 2 * std::size_t{radius}, 0);
    const float* from = in.data();
    for (const float weight : kernel) add_scaled(from++, weight, out.size(), out.data());
}

struct TensorRow {
    const float* xx;
    const float* yy;
    const float* xy;

    TensorRow(const PaddedPlanes& tensor, int y, int dx)
        : xx(tensor.row(0, y) + dx), yy(tensor.row(1, y) + dx), xy(tensor.row(2, y) + dx) {}
};

// What the Gaussians of some pixels in a row are made of: the unit vectors across the edges, 1 / (2 sigma^2)
// along them, and the penalty of differences between tensors. No weight further away than `columns` and
// `rows` pixels, a radius at most, counts.
struct Gaussians {
    int count;
    int columns = 0;
    int rows = 0;
    std::array<float, block_width> normal_x{};
    std::array<float, block_width> normal_y{};
    std::array<float, block_width> along{};
    std::array<float, block_width> penalty{};

    // Where there is no single direction, as at corners, a Gaussian shrinks to the width that it has across.
    Gaussians(const TensorRow& tensor, int pixels, float along_sigma, float across_sigma, int radius)
        : count(pixels) {
        float squared_columns = 0;
        float squared_rows = 0;
        for (int x = 0; x < count; ++x) {
            const float xx = tensor.xx[x];
            const float yy = tensor.yy[x];
            const float xy = tensor.xy[x];
            const float angle = 0.5F * std::atan2(2 * xy, xx - yy);
            const float trace = std::max(xx + yy, least_trace);
            const float coherence = std::sqrt((xx - yy) * (xx - yy) + 4 * xy * xy) / trace;
            const float sigma = std::max(along_sigma * coherence * coherence, across_sigma);
            const auto i = static_cast<std::size_t>(x);
            normal_x[i] = std::cos(angle);
            normal_y[i] = std::sin(angle);
            along[i] = 0.5F / (sigma * sigma);
            penalty[i] = other_edge_penalty / (trace * trace);
            // Half the sides of the rectangle around the ellipse on which weights become negligible.
            const float long_axis = 2 * negligible * sigma * sigma;
            const float short_axis = 2 * negligible * across_sigma * across_sigma;
            const float cosine = normal_x[i] * normal_x[i];
            squared_columns = std::max(squared_columns, short_axis * cosine + long_axis * (1 - cosine));
            squared_rows = std::max(squared_rows, short_axis * (1 - cosine) + long_axis * cosine);
        }
        // Infinite where the tensor's squares are.
        const auto within_radius = [&](float length) {
            return static_cast<int>(std::min(std::ceil(length), static_cast<float>(radius)));
        };
        columns = within_radius(std::sqrt(squared_columns));
        rows = within_radius(std::sqrt(squared_rows));
    }
};

// Minus the logarithms of the weights at an offset, but for the tensors. Returns how many are not negligible.
TUNGSTEN_DIP_FASTEST int measure_offset(const Gaussians& gaussians, float dx, float dy, float across,
                                        float* distances) {
    const float across_scale = 0.5F / (across * across);
    const float squared = dx * dx + dy * dy;
    int near = 0;
    for (int i = 0; i < gaussians.count; ++i) {
        const auto x = static_cast<std::size_t>(i);
        const float v = gaussians.normal_x[x] * dx + gaussians.normal_y[x] * dy;
        const float distance = std::max((squared - v * v) * gaussians.along[x], 0.0F) + v * v * across_scale;
        near += distance < negligible ? 1 : 0;
        distances[x] = distance;
    }
    return near;
}

// weights = exp(-distance). The line that an edge follows goes on where the edge itself ends: the difference
// of the tensors shows that.
TUNGSTEN_DIP_FASTEST void weigh_offset(const Gaussians& gaussians, const TensorRow& tensor,
                                       const TensorRow& other, float* weights) {
    for (int i = 0; i < gaussians.count; ++i) {
        const float xx = tensor.xx[i] - other.xx[i];
        const float yy = tensor.yy[i] - other.yy[i];
        const float xy = tensor.xy[i] - other.xy[i];
        const float difference = xx * xx + yy * yy + 2 * xy * xy;
        weights[i] = exp_minus(weights[i] + difference * gaussians.penalty[static_cast<std::size_t>(i)]);
    }
}

// Which blocks of columns hold anything up to `radius` pixels around: emitted light is 0 in most places.
class LitBlocks {
  public:
    LitBlocks(const PaddedPlanes& planes, int radius, int threads)
        : height_(planes.height()),
          blocks_((planes.width() + block_width - 1) / block_width),
          radius_(radius),
          lit_(static_cast<std::size_t>(height_) * static_cast<std::size_t>(blocks_)) {
        parallel_for(height_, threads, [&](int y) {
            for (int block = 0; block < blocks_; ++block) {
                const int first = block * block_width - radius;
                const int end = std::min((block + 1) * block_width, planes.width()) + radius;
                for (int c = 0; c < planes.channels(); ++c) {
                    const float* row = planes.row(c, y);
                    if (std::any_of(row + first, row + end, [](float value) { return value != 0; }))
                        lit_[index(y, block)] = 1;
                }
            }
        });
    }

    [[nodiscard]] bool around(int y, int block) const {
        const int end = std::min(y + radius_ + 1, height_);
        for (int row = std::max(y - radius_, 0); row < end; ++row) {
            if (lit_[index(row, block)] != 0) return true;
        }
        return false;
    }

  private:
    int height_;
    int blocks_;
    int radius_;
    std::vector<std::uint8_t> lit_;

    [[nodiscard]] std::size_t index(int y, int block) const {
        return static_cast<std::size_t>(y) * static_cast<std::size_t>(blocks_) +
               static_cast<std::size_t>(block);
    }
};

}  // namespace

void structure_tensor(ConstImage features, Image out, int threads) {
    check_same_size("out", out, "features", features);
    check_channels("out", out, 3);
    if (out.size() == 0) return;
    const PaddedPlanes planes(features, derivative_radius, threads);
    const auto smooth = gaussian<derivative_radius>(derivative_sigma);
    const auto derivative = gaussian_derivative<derivative_radius>(derivative_sigma);
    PaddedPlanes products(3, features.height, features.width, tensor_radius);
    parallel_for(features.height, threads, [&](int y) {
        std::vector<float> columns;
        std::vector<float> dx;
        std::vector<float> dy;
        for (int c = 0; c < features.channels; ++c) {
            convolve_columns<derivative_radius>(planes, c, y, smooth, columns);
            convolve_row<derivative_radius>(columns, derivative, dx);
            convolve_columns<derivative_radius>(planes, c, y, derivative, columns);
            convolve_row<derivative_radius>(columns, smooth, dy);
            add_weighted(dx.data(), dx.data(), features.width, products.row(0, y));
            add_weighted(dy.data(), dy.data(), features.width, products.row(1, y));
            add_weighted(dx.data(), dy.data(), features.width, products.row(2, y));
        }
    });
    products.repeat_border();
    const auto window = gaussian<tensor_radius>(tensor_sigma);
    parallel_for(features.height, threads, [&](int y) {
        std::vector<float> columns;
        std::vector<float> smoothed;
        for (int c = 0; c < 3; ++c) {
            convolve_columns<tensor_radius>(products, c, y, window, columns);
            convolve_row<tensor_radius>(columns, window, smoothed);
            for (int x = 0; x < out.width; ++x) out.at(y, x, c) = smoothed[static_cast<std::size_t>(x)];
        }
    });
}

void smooth_along_edges(ConstImage image, ConstImage tensor_image, float along, float across, Image out,
                        int threads) {
    for (const float sigma : {along, across}) {
        if (sigma >= least_sigma && sigma <= largest_sigma) continue;
        refuse("along and across",
               std::to_string(least_sigma) + " to " + std::to_string(largest_sigma) + " pixels", sigma);
    }
    check_same_size("tensor", tensor_image, "image", image);
    check_channels("tensor", tensor_image, 3);
    check_same_shape("out", out, "image", image);
    if (image.size() == 0) return;
    const int radius = static_cast<int>(std::ceil(reach * std::max(along, across)));
    const PaddedPlanes tensor(tensor_image, radius, threads);
    const PaddedPlanes planes(image, radius, threads);
    const LitBlocks lit(planes, radius, threads);
    const auto smooth_block = [&](int y, int first, int count) {
        const TensorRow here(tensor, y, first);
        const Gaussians gaussians(here, count, along, across, radius);
        std::array<float, block_width> weights{};
        // Of every channel, and of the weights.
        std::vector<std::array<float, block_width>> sums(static_cast<std::size_t>(image.channels) + 1);
        for (int dy = -gaussians.rows; dy <= gaussians.rows; ++dy) {
            for (int dx = -gaussians.columns; dx <= gaussians.columns; ++dx) {
                const int near = measure_offset(gaussians, static_cast<float>(dx), static_cast<float>(dy),
                                                across, weights.data());
                if (near == 0) continue;
                weigh_offset(gaussians, here, TensorRow(tensor, y + dy, first + dx), weights.data());
                for (int c = 0; c < image.channels; ++c) {
                    add_weighted(weights.data(), planes.row(c, y + dy) + first + dx, count,
                                 sums[static_cast<std::size_t>(c)].data());
                }
                for (std::size_t x = 0; x < block_width; ++x) sums.back()[x] += weights[x];
            }
        }
        for (int x = 0; x < count; ++x) {
            for (int c = 0; c < image.channels; ++c) {
                const auto i = static_cast<std::size_t>(x);
                out.at(y, first + x, c) = sums[static_cast<std::size_t>(c)][i] / sums.back()[i];
            }
        }
    };
    parallel_for(image.height, threads, [&](int y) {
        for (int first = 0; first < image.width; first += block_width) {
            const int count = std::min(block_width, image.width - first);
            if (lit.around(y, first / block_width)) {
                smooth_block(y, first, count);
            } else {
                std::fill_n(&out.at(y, first, 0), std::ptrdiff_t{count} * image.channels, 0.0F);
            }
        }
    });
}

}  // namespace tungsten_dip
