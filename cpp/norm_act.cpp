// Batch norm and leaky ReLU, forward and backward, each in as few passes over memory as there can be.
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "core.hpp"
#include "fastest.hpp"

namespace tungsten_dip {
namespace {

// So many numbers are summed in single precision, the sums of these chunks in double precision. A chunk stays
// in the processor's cache.
constexpr std::size_t chunk_numbers = 32768;

// A loop goes over so many numbers at least, the channels several times: it fills the registers.
constexpr std::size_t least_lanes = 64;

using Sums = std::vector<std::vector<double>>;  // of each kind, for each channel

inline float float_from(BFloat16 value) {
    return std::bit_cast<float>(static_cast<std::uint32_t>(value) << 16U);
}

// Rounds to nearest, ties to even.
inline BFloat16 bfloat16_from(float value) {
    const auto bits = std::bit_cast<std::uint32_t>(value);
    const bool nan = (bits & 0x7FFFFFFFU) > 0x7F800000U;
    return static_cast<BFloat16>(nan ? 0x7FC0U : (bits + 0x7FFFU + ((bits >> 16U) & 1U)) >> 16U);
}

// How an image's numbers are gone through: `lanes` at a time, some pixels with all channels.
class Traversal {
  public:
    explicit Traversal(const NormAct& norm)
        : channels_(norm.channels),
          lanes_(norm.channels * std::max<std::size_t>(1, least_lanes / norm.channels)),
          numbers_(norm.pixels * norm.channels),
          chunk_(std::max<std::size_t>(chunk_numbers / lanes_, 1) * lanes_) {}

    [[nodiscard]] std::size_t lanes() const { return lanes_; }

    // One value for each lane, of one for each channel.
    template <typename Value>
    [[nodiscard]] std::vector<float> spread(const Value& of_channel) const {
        std::vector<float> values(lanes_);
        for (std::size_t lane = 0; lane < lanes_; ++lane)
            values[lane] = static_cast<float>(of_channel(lane % channels_));
        return values;
    }

    // Calls body(first number, count) for every chunk.
    template <typename Body>
    void for_chunks(const Body& body) const {
        for (std::size_t first = 0; first < numbers_; first += chunk_)
            body(first, std::min(numbers_ - first, chunk_));
    }

    // Adds up what body(first number, count, sums) leaves in the lanes of `kinds` sums.
    template <typename Body>
    [[nodiscard]] Sums sums(std::size_t kinds, const Body& body) const {
        Sums totals(kinds, std::vector<double>(channels_));
        std::vector<float> of_chunk(kinds * lanes_);
        for_chunks([&](std::size_t first, std::size_t count) {
            std::ranges::fill(of_chunk, 0.0F);
            body(first, count, of_chunk.data());
            for (std::size_t i = 0; i < of_chunk.size(); ++i)
                totals[i / lanes_][i % lanes_ % channels_] += of_chunk[i];
        });
        return totals;
    }

  private:
    std::size_t channels_;
    std::size_t lanes_;
    std::size_t numbers_;
    std::size_t chunk_;
};

// The loops below go over one chunk, a whole number of pixels.

TUNGSTEN_DIP_FASTEST void add(const BFloat16* x, std::size_t count, std::size_t lanes,
                              float* __restrict sum) {
    for (std::size_t i = 0; i < count; i += lanes) {
        const std::size_t width = std::min(lanes, count - i);
        for (std::size_t lane = 0; lane < width; ++lane) sum[lane] += float_from(x[i + lane]);
    }
}

TUNGSTEN_DIP_FASTEST void add_squares(const BFloat16* x, std::size_t count, std::size_t lanes,
                                      const float* mean, float* __restrict sum) {
    for (std::size_t i = 0; i < count; i += lanes) {
        const std::size_t width = std::min(lanes, count - i);
        for (std::size_t lane = 0; lane < width; ++lane) {
            const float offset = float_from(x[i + lane]) - mean[lane];
            sum[lane] += offset * offset;
        }
    }
}

TUNGSTEN_DIP_FASTEST void write_output(const BFloat16* x, std::size_t count, std::size_t lanes,
                                       const float* mean, const float* factor, const float* bias, float slope,
                                       BFloat16* __restrict y) {
    for (std::size_t i = 0; i < count; i += lanes) {
        const std::size_t width = std::min(lanes, count - i);
        for (std::size_t lane = 0; lane < width; ++lane) {
            const float normed = (float_from(x[i + lane]) - mean[lane]) * factor[lane] + bias[lane];
            y[i + lane] = bfloat16_from(normed > 0 ? normed : normed * slope);
        }
    }
}

// The gradient before the leaky ReLU, whose output has the sign of its input.
inline float before_relu(BFloat16 gradient, BFloat16 y, float slope) {
    return float_from(gradient) * (float_from(y) > 0 ? 1.0F : slope);
}

TUNGSTEN_DIP_FASTEST void add_gradients(const BFloat16* x, const BFloat16* y, const BFloat16* gradient,
                                        std::size_t count, std::size_t lanes, const float* mean, float slope,
                                        float* __restrict sum, float* __restrict product) {
    for (std::size_t i = 0; i < count; i += lanes) {
        const std::size_t width = std::min(lanes, count - i);
        for (std::size_t lane = 0; lane < width; ++lane) {
            const float by_normed = before_relu(gradient[i + lane], y[i + lane], slope);
            sum[lane] += by_normed;
            product[lane] += by_normed * (float_from(x[i + lane]) - mean[lane]);
        }
    }
}

TUNGSTEN_DIP_FASTEST void write_gradient(const BFloat16* x, const BFloat16* y, const BFloat16* gradient,
                                         std::size_t count, std::size_t lanes, const float* mean, float slope,
                                         const float* factor, const float* constant, const float* linear,
                                         BFloat16* __restrict out) {
    for (std::size_t i = 0; i < count; i += lanes) {
        const std::size_t width = std::min(lanes, count - i);
        for (std::size_t lane = 0; lane < width; ++lane) {
            const float by_normed = before_relu(gradient[i + lane], y[i + lane], slope);
            const float offset = float_from(x[i + lane]) - mean[lane];
            out[i + lane] = bfloat16_from(by_normed * factor[lane] + constant[lane] + linear[lane] * offset);
        }
    }
}

}  // namespace

void norm_act(const NormAct& norm, const BFloat16* x, BFloat16* y, float* mean, float* scale) {
    const Traversal traversal(norm);
    const std::size_t lanes = traversal.lanes();
    const auto pixels = static_cast<double>(norm.pixels);
    const Sums sums = traversal.sums(
        1, [&](std::size_t first, std::size_t count, float* sum) { add(x + first, count, lanes, sum); });
    for (std::size_t c = 0; c < norm.channels; ++c) mean[c] = static_cast<float>(sums[0][c] / pixels);
    const std::vector<float> means = traversal.spread([&](std::size_t c) { return mean[c]; });
    const Sums squares = traversal.sums(1, [&](std::size_t first, std::size_t count, float* sum) {
        add_squares(x + first, count, lanes, means.data(), sum);
    });
    for (std::size_t c = 0; c < norm.channels; ++c) {
        scale[c] = static_cast<float>(1 / std::sqrt(squares[0][c] / pixels + norm.epsilon));
    }
    const std::vector<float> factors =
        traversal.spread([&](std::size_t c) { return norm.weight[c] * scale[c]; });
    const std::vector<float> biases = traversal.spread([&](std::size_t c) { return norm.bias[c]; });
    traversal.for_chunks([&](std::size_t first, std::size_t count) {
        write_output(x + first, count, lanes, means.data(), factors.data(), biases.data(), norm.slope,
                     y + first);
    });
}

void norm_act_gradient(const BFloat16* gradient, const NormAct& norm, const Normed& normed,
                       const NormActGradients& out) {
    const Traversal traversal(norm);
    const std::size_t lanes = traversal.lanes();
    const auto pixels = static_cast<double>(norm.pixels);
    const std::vector<float> means = traversal.spread([&](std::size_t c) { return normed.mean[c]; });
    const Sums sums = traversal.sums(2, [&](std::size_t first, std::size_t count, float* sum) {
        add_gradients(normed.x + first, normed.y + first, gradient + first, count, lanes, means.data(),
                      norm.slope, sum, sum + lanes);
    });
    for (std::size_t c = 0; c < norm.channels; ++c) {
        out.bias[c] = static_cast<float>(sums[0][c]);
        out.weight[c] = static_cast<float>(sums[1][c] * normed.scale[c]);
    }
    const auto factor = [&](std::size_t c) { return static_cast<double>(norm.weight[c]) * normed.scale[c]; };
    const auto factors = traversal.spread(factor);
    const auto constants = traversal.spread([&](std::size_t c) { return -factor(c) * sums[0][c] / pixels; });
    const auto linears = traversal.spread(
        [&](std::size_t c) { return -factor(c) * normed.scale[c] * normed.scale[c] * sums[1][c] / pixels; });
    traversal.for_chunks([&](std::size_t first, std::size_t count) {
        write_gradient(normed.x + first, normed.y + first, gradient + first, count, lanes, means.data(),
                       norm.slope, factors.data(), constants.data(), linears.data(), out.x + first);
    });
}

}  // namespace tungsten_dip
