// Smoothing along edges: what remains to be done where few samples saw which surface covers a pixel.
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

constexpr float derivative_sigma = 0.7F;
constexpr int derivative_radius = 3;
constexpr float tensor_sigma = 2.0F;
constexpr int tensor_radius = 6;

// Standard deviations beyond which neighbours are not looked at.
constexpr float reach = 2.5F;

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

// out = in, convolved with one kernel along rows and with another along columns.
template <int radius>
void convolve(const PaddedPlanes& in, int channel, const Kernel<radius>& along_rows,
              const Kernel<radius>& along_columns, int threads, std::vector<float>& out) {
    const auto width = static_cast<std::size_t>(in.width());
    out.resize(static_cast<std::size_t>(in.height()) * width);
    parallel_for(in.height(), threads, [&](int y) {
        std::vector<float> columns(width + 2 * std::size_t{radius}, 0.0F);
        int from = y - radius;
        for (const float weight : along_columns) {
            const float* row = in.row(channel, from++) - radius;
            for (std::size_t x = 0; x < columns.size(); ++x) columns[x] += weight * row[x];
        }
        float* to = out.data() + static_cast<std::size_t>(y) * width;
        std::fill_n(to, width, 0.0F);
        for (std::size_t dx = 0; dx < along_rows.size(); ++dx) {
            for (std::size_t x = 0; x < width; ++x) to[x] += along_rows[dx] * columns[x + dx];
        }
    });
}

// The products of the features' gradients, summed over features and smoothed: channels xx, yy, xy (Foerstner
// and Guelch 1987). Padded by `edge` pixels.
PaddedPlanes structure_tensor(ConstImage features, int edge, int threads) {
    const PaddedPlanes planes(features, derivative_radius, threads);
    const auto smooth = gaussian<derivative_radius>(derivative_sigma);
    const auto derivative = gaussian_derivative<derivative_radius>(derivative_sigma);
    std::vector<float> products(static_cast<std::size_t>(features.height) *
                                static_cast<std::size_t>(features.width) * 3);
    std::vector<float> dx;
    std::vector<float> dy;
    for (int c = 0; c < features.channels; ++c) {
        convolve<derivative_radius>(planes, c, derivative, smooth, threads, dx);
        convolve<derivative_radius>(planes, c, smooth, derivative, threads, dy);
        for (std::size_t i = 0; i < dx.size(); ++i) {
            products[3 * i] += dx[i] * dx[i];
            products[3 * i + 1] += dy[i] * dy[i];
            products[3 * i + 2] += dx[i] * dy[i];
        }
    }
    const ConstImage image{
        .data = products.data(), .height = features.height, .width = features.width, .channels = 3};
    const PaddedPlanes padded(image, tensor_radius, threads);
    const auto window = gaussian<tensor_radius>(tensor_sigma);
    std::vector<float> tensor(products.size());
    std::vector<float> smoothed;
    for (std::size_t c = 0; c < 3; ++c) {
        convolve<tensor_radius>(padded, static_cast<int>(c), window, window, threads, smoothed);
        for (std::size_t i = 0; i < smoothed.size(); ++i) tensor[3 * i + c] = smoothed[i];
    }
    const ConstImage joined{
        .data = tensor.data(), .height = features.height, .width = features.width, .channels = 3};
    return {joined, edge, threads};
}

struct TensorRow {
    const float* xx;
    const float* yy;
    const float* xy;

    TensorRow(const PaddedPlanes& tensor, int y, int dx)
        : xx(tensor.row(0, y) + dx), yy(tensor.row(1, y) + dx), xy(tensor.row(2, y) + dx) {}
};

// What the Gaussians of some pixels in a row are made of: the unit vectors across the edges, 1 / (2 sigma^2)
// along them, and the penalty of differences between tensors.
struct Gaussians {
    int count;
    std::array<float, block_width> normal_x{};
    std::array<float, block_width> normal_y{};
    std::array<float, block_width> along{};
    std::array<float, block_width> penalty{};

    // Where there is no single direction, as at corners, a Gaussian shrinks to the width that it has across.
    Gaussians(const TensorRow& tensor, int pixels, float along_sigma, float across_sigma) : count(pixels) {
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
        }
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
// of the tensors tells.
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

TUNGSTEN_DIP_FASTEST void add_weighted(const float* weights, const float* values, int count, float* sums) {
    for (int x = 0; x < count; ++x) sums[x] += weights[x] * values[x];
}

// Whether no pixel up to `radius` around a block holds anything, as is so of emitted light in most places.
bool empty_around(const PaddedPlanes& planes, int y, int first, int count, int radius) {
    for (int c = 0; c < planes.channels(); ++c) {
        for (int row = y - radius; row <= y + radius; ++row) {
            const float* values = planes.row(c, row) + first;
            if (!std::all_of(values - radius, values + count + radius, [](float v) { return v == 0; }))
                return false;
        }
    }
    return true;
}

}  // namespace

void smooth_along_edges(ConstImage image, ConstImage features, float along, float across, Image out,
                        int threads) {
    if (!(along > 0) || !(across > 0)) throw std::invalid_argument("along and across must be above 0");
    if (image.size() == 0) return;
    const int radius = static_cast<int>(std::ceil(reach * std::max(along, across)));
    const PaddedPlanes tensor = structure_tensor(features, radius, threads);
    const PaddedPlanes planes(image, radius, threads);
    const auto smooth_block = [&](int y, int first, int count) {
        const TensorRow here(tensor, y, first);
        const Gaussians gaussians(here, count, along, across);
        std::array<float, block_width> weights{};
        // Of every channel, and of the weights.
        std::vector<std::array<float, block_width>> sums(static_cast<std::size_t>(image.channels) + 1);
        for (int dy = -radius; dy <= radius; ++dy) {
            for (int dx = -radius; dx <= radius; ++dx) {
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
            if (empty_around(planes, y, first, count, radius)) {
                std::fill_n(&out.at(y, first, 0), std::ptrdiff_t{count} * image.channels, 0.0F);
            } else {
                smooth_block(y, first, count);
            }
        }
    });
}

}  // namespace tungsten_dip
