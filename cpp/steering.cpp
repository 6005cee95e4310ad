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

// What one row's Gaussians are made of: the unit vectors across the edges, 1 / (2 sigma^2) along them, and
// the penalty of differences between tensors.
struct Gaussians {
    std::vector<float> normal_x;
    std::vector<float> normal_y;
    std::vector<float> along;
    std::vector<float> penalty;

    explicit Gaussians(std::size_t count) : normal_x(count), normal_y(count), along(count), penalty(count) {}
};

// Where there is no single direction, as at corners, the Gaussian shrinks to the width that it has across.
void find_gaussians(const PaddedPlanes& tensor, int y, float along, float across, Gaussians& out) {
    for (int x = 0; x < tensor.width(); ++x) {
        const float xx = tensor.row(0, y)[x];
        const float yy = tensor.row(1, y)[x];
        const float xy = tensor.row(2, y)[x];
        const float angle = 0.5F * std::atan2(2 * xy, xx - yy);
        const float trace = std::max(xx + yy, least_trace);
        const float coherence = std::sqrt((xx - yy) * (xx - yy) + 4 * xy * xy) / trace;
        const float sigma = std::max(along * coherence * coherence, across);
        const auto i = static_cast<std::size_t>(x);
        out.normal_x[i] = std::cos(angle);
        out.normal_y[i] = std::sin(angle);
        out.along[i] = 0.5F / (sigma * sigma);
        out.penalty[i] = other_edge_penalty / (trace * trace);
    }
}

// The line that an edge follows goes on where the edge itself ends: the difference of the tensors tells.
TUNGSTEN_DIP_FASTEST void weigh_offset(const Gaussians& gaussians, const TensorRow& tensor,
                                       const TensorRow& other, float dx, float dy, float across,
                                       float* weights) {
    const float across_scale = 0.5F / (across * across);
    const float distance = dx * dx + dy * dy;
    const std::size_t count = gaussians.along.size();
    for (std::size_t x = 0; x < count; ++x) {
        const float v = gaussians.normal_x[x] * dx + gaussians.normal_y[x] * dy;
        const float xx = tensor.xx[x] - other.xx[x];
        const float yy = tensor.yy[x] - other.yy[x];
        const float xy = tensor.xy[x] - other.xy[x];
        weights[x] =
            exp_minus(std::max((distance - v * v) * gaussians.along[x], 0.0F) + v * v * across_scale +
                      (xx * xx + yy * yy + 2 * xy * xy) * gaussians.penalty[x]);
    }
}

TUNGSTEN_DIP_FASTEST void add_weighted(const float* weights, const float* values, int count, float* sums) {
    for (int x = 0; x < count; ++x) sums[x] += weights[x] * values[x];
}

}  // namespace

void smooth_along_edges(ConstImage image, ConstImage features, float along, float across, Image out,
                        int threads) {
    if (!(along > 0) || !(across > 0)) throw std::invalid_argument("along and across must be above 0");
    if (image.size() == 0) return;
    const int radius = static_cast<int>(std::ceil(reach * std::max(along, across)));
    const PaddedPlanes tensor = structure_tensor(features, radius, threads);
    const PaddedPlanes planes(image, radius, threads);
    const int width = image.width;
    parallel_for(image.height, threads, [&](int y) {
        const auto columns = static_cast<std::size_t>(width);
        Gaussians gaussians(columns);
        std::vector<float> weights(columns);
        // Of every channel, and of the weights.
        std::vector<std::vector<float>> sums(static_cast<std::size_t>(image.channels) + 1,
                                             std::vector<float>(columns));
        const std::vector<float> ones(columns, 1.0F);
        find_gaussians(tensor, y, along, across, gaussians);
        for (int dy = -radius; dy <= radius; ++dy) {
            for (int dx = -radius; dx <= radius; ++dx) {
                weigh_offset(gaussians, TensorRow(tensor, y, 0), TensorRow(tensor, y + dy, dx),
                             static_cast<float>(dx), static_cast<float>(dy), across, weights.data());
                for (int c = 0; c < image.channels; ++c) {
                    add_weighted(weights.data(), planes.row(c, y + dy) + dx, width,
                                 sums[static_cast<std::size_t>(c)].data());
                }
                add_weighted(weights.data(), ones.data(), width, sums.back().data());
            }
        }
        for (int x = 0; x < width; ++x) {
            for (int c = 0; c < image.channels; ++c) {
                const auto i = static_cast<std::size_t>(x);
                out.at(y, x, c) = sums[static_cast<std::size_t>(c)][i] / sums.back()[i];
            }
        }
    });
}

}  // namespace tungsten_dip
