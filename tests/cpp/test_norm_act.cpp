// Batch norm and leaky ReLU against their definition in double precision, gradients against differences.
#include <algorithm>
#include <array>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "check.hpp"
#include "core.hpp"
#include "pixels.hpp"

using namespace tungsten_dip;

namespace {

constexpr float epsilon = 1e-5F;
constexpr float slope = 0.2F;

double value_of(BFloat16 bits) { return std::bit_cast<float>(static_cast<std::uint32_t>(bits) << 16U); }

std::vector<BFloat16> bits_of(const Pixels& image) {
    std::vector<BFloat16> bits;
    for (const float value : image.values)
        bits.push_back(static_cast<BFloat16>(std::bit_cast<std::uint32_t>(value) >> 16U));
    return bits;
}

struct Image8 {
    std::vector<BFloat16> x, gradient;
    std::vector<float> weight, bias;
    NormAct norm;

    Image8(int height, int width, int channels)
        : x(bits_of(noise({height, width}, channels, 1, 3))),
          gradient(bits_of(noise({height, width}, channels, 2))) {
        for (int c = 0; c < channels; ++c) {
            weight.push_back(0.5F + 0.1F * static_cast<float>(c));
            bias.push_back(0.3F * static_cast<float>(c % 3 - 1));
        }
        norm = {height * width, channels, weight.data(), bias.data(), epsilon, slope};
    }
};

// The loss is the sum of the outputs times `gradient`; returns it and the outputs.
double loss(const Image8& image, const std::vector<double>& x, std::vector<double>& y) {
    const auto channels = static_cast<std::size_t>(image.norm.channels);
    const auto pixels = x.size() / channels;
    double sum = 0;
    for (std::size_t c = 0; c < channels; ++c) {
        double mean = 0;
        double variance = 0;
        for (std::size_t p = 0; p < pixels; ++p) mean += x[p * channels + c] / static_cast<double>(pixels);
        for (std::size_t p = 0; p < pixels; ++p)
            variance += std::pow(x[p * channels + c] - mean, 2) / static_cast<double>(pixels);
        for (std::size_t p = 0; p < pixels; ++p) {
            const std::size_t i = p * channels + c;
            const double normed =
                (x[i] - mean) / std::sqrt(variance + epsilon) * image.weight[c] + image.bias[c];
            y[i] = normed > 0 ? normed : slope * normed;
            sum += y[i] * value_of(image.gradient[i]);
        }
    }
    return sum;
}

void values_and_gradients_are_those_of_the_definition() {
    for (const auto& [height, width, channels] :
         {std::array{1, 2, 1}, std::array{5, 7, 3}, std::array{6, 4, 8}, std::array{3, 3, 70}}) {
        const Image8 image(height, width, channels);
        std::vector<BFloat16> y(image.x.size());
        std::vector<BFloat16> by_x(image.x.size());
        std::vector<float> mean(channels), scale(channels), by_weight(channels), by_bias(channels);
        norm_act(image.norm, image.x.data(), y.data(), mean.data(), scale.data(), 2);
        norm_act_gradient(image.norm, image.x.data(), y.data(), mean.data(), scale.data(),
                          image.gradient.data(), by_x.data(), by_weight.data(), by_bias.data(), 2);

        std::vector<double> x;
        for (const BFloat16 bits : image.x) x.push_back(value_of(bits));
        std::vector<double> expected(x.size());
        std::vector<double> unused(x.size());
        loss(image, x, expected);
        for (std::size_t i = 0; i < x.size(); ++i) {
            CHECK(near(value_of(y[i]), expected[i], 1e-5 + std::abs(expected[i]) / 256));
            constexpr double step = 1e-5;
            const double before = x[i];
            x[i] = before + step;
            const double above = loss(image, x, unused);
            x[i] = before - step;
            const double slope_here = (above - loss(image, x, unused)) / (2 * step);
            x[i] = before;
            CHECK(near(value_of(by_x[i]), slope_here, 1e-4 + std::abs(slope_here) / 128));
        }
    }
}

void threads_make_no_difference() {
    const Image8 image(90, 101, 8);  // several chunks
    std::vector<BFloat16> first(image.x.size());
    std::vector<BFloat16> second(image.x.size());
    std::vector<float> moments(16), others(16);
    norm_act(image.norm, image.x.data(), first.data(), moments.data(), moments.data() + 8, 1);
    norm_act(image.norm, image.x.data(), second.data(), others.data(), others.data() + 8, 5);
    CHECK(first == second);
    CHECK(moments == others);
}

}  // namespace

int main() {
    values_and_gradients_are_those_of_the_definition();
    threads_make_no_difference();
    return failed_checks();
}
