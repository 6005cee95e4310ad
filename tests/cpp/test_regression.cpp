// The local regression: what it must leave alone, how much noise it takes away, and sizes that are no
// multiple of its tiles. (test_regression.py compares it with a plain implementation.)
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdlib>
#include <map>
#include <optional>
#include <vector>

#include "check.hpp"
#include "core.hpp"
#include "pixels.hpp"

using namespace tungsten_dip;

namespace {

// Around one tile of 8x64 pixels, and far from it.
constexpr std::array sizes{Size{.height = 1, .width = 1},  Size{.height = 1, .width = 65},
                           Size{.height = 9, .width = 1},  Size{.height = 7, .width = 5},
                           Size{.height = 8, .width = 64}, Size{.height = 9, .width = 130}};

Pixels regressed(Pixels& target, Pixels& features, SearchWindow window, float penalty = 0.1F) {
    const std::vector<float> penalties(static_cast<std::size_t>(features.channels), penalty);
    Pixels out(target.height, target.width, 3, -1.0F);
    regress(target.view(), features.view(), penalties, {}, window, out.view(), 2);
    return out;
}

Pixels regressed(Pixels& target, Pixels& features, Pixels& guide, Pixels& guide_variance, SearchWindow window,
                 int threads = 2) {
    const std::vector<float> penalty(static_cast<std::size_t>(features.channels), 0.0F);
    Pixels out(target.height, target.width, 3, -1.0F);
    regress(target.view(), features.view(), penalty,
            Guide{.image = guide.view(), .variance = guide_variance.view(), .k = 1}, window, out.view(),
            threads);
    return out;
}

double largest_difference(const Pixels& a, const Pixels& b) {
    double largest = 0;
    for (std::size_t i = 0; i < a.values.size(); ++i)
        largest = std::max(largest, std::abs(static_cast<double>(a.values[i]) - b.values[i]));
    return largest;
}

void linear_colors_stay() {
    constexpr float scale = 100;  // beside which the ridge explains nothing
    for (const Size size : sizes) {
        Pixels features = noise(size, 2, 1, scale);
        Pixels target(size.height, size.width, 3);
        for (int y = 0; y < size.height; ++y) {
            for (int x = 0; x < size.width; ++x) {
                const float f = features.at(y, x, 0) / scale;
                const float g = features.at(y, x, 1) / scale;
                target.at(y, x, 0) = 1 + 2 * f;
                target.at(y, x, 1) = 3 - f + 0.5F * g;
                target.at(y, x, 2) = 4;
            }
        }
        const SearchWindow window{.radius = 6, .step = 2};
        const float penalty = 0.1F / (scale * scale);
        CHECK_BELOW(largest_difference(regressed(target, features, window, penalty), target), 1e-3);
        Pixels guide = noise(size, 3, 2);
        Pixels variance(size.height, size.width, 3, 0.5F);
        CHECK_BELOW(largest_difference(regressed(target, features, guide, variance, window), target), 1e-3);
    }
}

void constants_stay() {
    for (const Size size : sizes) {
        for (const int radius : {0, 1, 40}) {
            for (const float level : {0.0F, 1e-6F, 0.7F, 1e6F}) {
                Pixels target(size.height, size.width, 3, level);
                Pixels features = noise(size, 16, 3);
                CHECK(largest_difference(regressed(target, features, {.radius = radius, .step = 1}),
                                         target) <= 2e-4 * level);
            }
        }
    }
}

// Of a mean over every `step`th pixel of a mean over every `next`th one, along one axis. The ends of a window
// that skips pixels count half.
double variance_of_two_means(int radius, int step, int next) {
    std::map<int, double> weights;
    double sum = 0;
    const auto share = [radius](int i, int stride) {
        return stride > 1 && std::abs(i) == radius / stride ? 0.5 : 1.0;
    };
    for (int i = -(radius / step); i <= radius / step; ++i) {
        for (int j = -(radius / next); j <= radius / next; ++j) {
            const double weight = share(i, step) * share(j, next);
            weights[i * step + j * next] += weight;
            sum += weight;
        }
    }
    double squares = 0;
    for (const auto& [offset, weight] : weights) squares += weight * weight;
    return squares / (sum * sum);
}

void noise_falls_by_the_size_of_the_window() {
    constexpr int radius = 6;
    constexpr int border = 2 * radius;
    for (const int step : {1, 2}) {
        Pixels target = noise({.height = 220, .width = 230}, 3, 4);
        Pixels features(target.height, target.width, 0);
        Pixels out = regressed(target, features, {.radius = radius, .step = step});
        double squares = 0;
        int count = 0;
        for (int y = border; y < out.height - border; ++y) {
            for (int x = border; x < out.width - border; ++x) {
                for (int c = 0; c < 3; ++c, ++count) {
                    squares += static_cast<double>(out.at(y, x, c)) * out.at(y, x, c);
                }
            }
        }
        const double expected = std::pow(variance_of_two_means(radius, step, step == 1 ? 1 : step + 1), 2);
        CHECK_NEAR(squares / count, expected, 0.15 * expected);
    }
}

void threads_do_not_change_the_bits() {
    const Size size{.height = 35, .width = 71};
    Pixels target = noise(size, 3, 5);
    Pixels features = noise(size, 5, 6);
    Pixels guide = noise(size, 3, 7);
    Pixels variance(size.height, size.width, 3, 0.3F);
    const SearchWindow window{.radius = 4, .step = 1};
    const Pixels one = regressed(target, features, guide, variance, window, 1);
    CHECK(one == regressed(target, features, guide, variance, window, 5));
}

void nothing_is_done_to_nothing() {
    for (const Size size : {Size{.height = 0, .width = 4}, Size{.height = 4, .width = 0}}) {
        Pixels target(size.height, size.width, 3);
        Pixels features(size.height, size.width, 2);
        CHECK(regressed(target, features, {.radius = 3, .step = 1}).values.empty());
    }
}

}  // namespace

int main() {
    linear_colors_stay();
    constants_stay();
    noise_falls_by_the_size_of_the_window();
    threads_do_not_change_the_bits();
    nothing_is_done_to_nothing();
    return failed_checks();
}
