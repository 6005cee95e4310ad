// Batch norm and leaky ReLU: against their definition in double precision, gradients against differences.
#include <algorithm>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <type_traits>
#include <vector>

#include "check.hpp"
#include "core.hpp"
#include "pixels.hpp"

using namespace tungsten_dip;

namespace {

constexpr float epsilon = 1e-5F;
constexpr float slope = 0.2F;

double value_of(BFloat16 bits) { return std::bit_cast<float>(static_cast<std::uint32_t>(bits) << 16U); }

std::vector<BFloat16> random_bits(Size size, int channels, unsigned seed) {
    std::vector<BFloat16> bits;
    for (const float value : noise(size, channels, seed, 3).values)
        bits.push_back(static_cast<BFloat16>(std::bit_cast<std::uint32_t>(value) >> 16U));
    return bits;
}

// An image, what came of it, and a loss: the sum of the outputs times `gradient`.
struct Example {
    std::size_t channels;
    std::vector<BFloat16> x;
    std::vector<BFloat16> gradient;
    std::vector<float> weight;
    std::vector<float> bias;
    std::vector<BFloat16> y;
    std::vector<float> mean;
    std::vector<float> scale;

    Example(Size size, int channel_count)
        : channels(static_cast<std::size_t>(channel_count)),
          x(random_bits(size, channel_count, 1)),
          gradient(random_bits(size, channel_count, 2)),
          weight(noise({.height = 1, .width = 1}, channel_count, 3).values),
          bias(noise({.height = 1, .width = 1}, channel_count, 4).values),
          y(x.size()),
          mean(channels),
          scale(channels) {}

    [[nodiscard]] NormAct norm() const {
        return {.pixels = x.size() / channels,
                .channels = channels,
                .weight = weight.data(),
                .bias = bias.data(),
                .epsilon = epsilon,
                .slope = slope};
    }
    void run() { norm_act(norm(), x.data(), y.data(), mean.data(), scale.data()); }
};

double loss(const Example& example, const std::vector<double>& x, std::vector<double>& y) {
    const std::size_t channels = example.channels;
    const double pixels = static_cast<double>(x.size()) / static_cast<double>(channels);
    double sum = 0;
    for (std::size_t c = 0; c < channels; ++c) {
        double mean = 0;
        double variance = 0;
        for (std::size_t i = c; i < x.size(); i += channels) mean += x[i] / pixels;
        for (std::size_t i = c; i < x.size(); i += channels) variance += std::pow(x[i] - mean, 2) / pixels;
        for (std::size_t i = c; i < x.size(); i += channels) {
            const double normed =
                (x[i] - mean) / std::sqrt(variance + epsilon) * example.weight[c] + example.bias[c];
            y[i] = normed > 0 ? normed : slope * normed;
            sum += y[i] * value_of(example.gradient[i]);
        }
    }
    return sum;
}

void values_and_gradients_are_those_of_the_definition(Size size, int channels) {
    Example example(size, channels);
    example.run();
    std::vector<BFloat16> by_x(example.x.size());
    std::vector<float> by_weight(example.channels);
    std::vector<float> by_bias(example.channels);
    const Normed normed{.x = example.x.data(),
                        .y = example.y.data(),
                        .mean = example.mean.data(),
                        .scale = example.scale.data()};
    norm_act_gradient(example.gradient.data(), example.norm(), normed,
                      {.x = by_x.data(), .weight = by_weight.data(), .bias = by_bias.data()});

    std::vector<double> x(example.x.size());
    std::ranges::transform(example.x, x.begin(), value_of);
    std::vector<double> expected(x.size());
    std::vector<double> unused(x.size());
    loss(example, x, expected);
    const auto difference = [&](auto& variable, double step) {
        const auto before = variable;
        variable = static_cast<std::remove_reference_t<decltype(variable)>>(before + step);
        const double above = loss(example, x, unused);
        variable = static_cast<std::remove_reference_t<decltype(variable)>>(before - step);
        const double below = loss(example, x, unused);
        variable = before;
        return (above - below) / (2 * step);
    };
    for (std::size_t i = 0; i < x.size(); ++i) {
        CHECK_NEAR(value_of(example.y[i]), expected[i], 1e-5 + std::abs(expected[i]) / 256);
        const double by_this = difference(x[i], 1e-5);
        CHECK_NEAR(value_of(by_x[i]), by_this, 1e-3 + std::abs(by_this) / 128);
    }
    constexpr double step = 1. / 65536;  // which a float of this size can take
    for (std::size_t c = 0; c < example.channels; ++c) {
        CHECK_NEAR(by_weight[c], difference(example.weight[c], step), 0.01);
        CHECK_NEAR(by_bias[c], difference(example.bias[c], step), 0.01);
    }
}

}  // namespace

int main() {
    values_and_gradients_are_those_of_the_definition({.height = 1, .width = 2}, 1);
    values_and_gradients_are_those_of_the_definition({.height = 5, .width = 7}, 3);
    values_and_gradients_are_those_of_the_definition({.height = 6, .width = 4}, 8);
    values_and_gradients_are_those_of_the_definition({.height = 3, .width = 3}, 70);
    return failed_checks();
}
