// Smoothing along edges: what it must leave alone, on which side of an edge it stays, and sizes that are no
// multiple of its blocks. (test_core.py compares it with a plain implementation.)
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <vector>

#include "check.hpp"
#include "core.hpp"
#include "exp_minus.hpp"
#include "pixels.hpp"

using namespace tungsten_dip;

namespace {

// Around one block of 32 columns, and smaller than the kernel.
constexpr std::array sizes{Size{.height = 1, .width = 1},  Size{.height = 1, .width = 33},
                           Size{.height = 33, .width = 1}, Size{.height = 7, .width = 5},
                           Size{.height = 9, .width = 32}, Size{.height = 20, .width = 70}};

Pixels smoothed(Pixels& image, Pixels& features, int threads = 2) {
    Pixels out(image.height, image.width, image.channels, -1.0F);
    Pixels tensor(image.height, image.width, 3);
    structure_tensor(features.view(), tensor.view(), threads);
    smooth_along_edges(image.view(), tensor.view(), 6, 0.3F, out.view(), threads);
    return out;
}

void a_constant_stays_and_nothing_leaves_the_range() {
    for (const Size size : sizes) {
        for (const int channels : {0, 1, 7}) {
            Pixels features = noise(size, channels, 1);
            Pixels flat(size.height, size.width, 3, 2.5F);
            for (const float value : smoothed(flat, features).values) CHECK_NEAR(value, 2.5, 1e-5);
            Pixels image = noise(size, 3, 2);
            const auto [least, most] = std::ranges::minmax(image.values);
            for (const float value : smoothed(image, features).values) {
                CHECK_BELOW(least - 1e-5F, value);
                CHECK_BELOW(value, most + 1e-5F);
            }
        }
    }
}

void threads_make_no_difference() {
    for (const Size size : sizes) {
        Pixels features = noise(size, 4, 3);
        Pixels image = noise(size, 3, 4);
        CHECK(smoothed(image, features, 1).values == smoothed(image, features, 5).values);
    }
}

// Along a straight edge noise is averaged, and nothing passes from one side to the other.
void an_edge_is_kept() {
    constexpr Size size{.height = 40, .width = 40};
    Pixels features(size.height, size.width, 1);
    Pixels image = noise(size, 3, 5, 0.3);
    for (int y = 0; y < size.height; ++y) {
        for (int x = size.width / 2; x < size.width; ++x) {
            features.at(y, x) = 1;
            for (int c = 0; c < 3; ++c) image.at(y, x, c) += 4;
        }
    }
    Pixels out = smoothed(image, features);
    double before = 0;
    double after = 0;
    for (int y = 10; y < 30; ++y) {
        for (const int x : {size.width / 2 - 1, size.width / 2}) {
            const float level = x < size.width / 2 ? 0.0F : 4.0F;
            before += std::pow(image.at(y, x) - level, 2);
            after += std::pow(out.at(y, x) - level, 2);
            CHECK_NEAR(out.at(y, x), level, 0.5);
        }
    }
    CHECK(before > 0);
    CHECK_BELOW(after, 0.3 * before);
}

void nothing_is_no_error() {
    Pixels none(0, 5, 3);
    Pixels features(0, 5, 2);
    smoothed(none, features);
}

// A tensor whose squares overflow leads no further than the radius.
void steep_edges_are_no_error() {
    Pixels image(4, 5, 3, 1.0F);
    Pixels tensor(4, 5, 3);
    for (int y = 0; y < 4; ++y) {
        for (int x = 0; x < 5; ++x) tensor.at(y, x, 0) = 1e25F;
    }
    Pixels out(4, 5, 3);
    smooth_along_edges(image.view(), tensor.view(), 3, 0.3F, out.view(), 2);
    for (const float value : out.values) CHECK_NEAR(value, 1, 1e-5);
}

void the_exponential_is_close() {
    for (int i = 0; i < 6000; ++i) {
        const float x = 0.013F * static_cast<float>(i);
        CHECK_NEAR(exp_minus(x), std::exp(-x), 1e-5 * std::exp(-x) + 2e-18);
    }
}

// Not even with values as small as 1e-10: many processors compute with denormals a hundred times as slowly.
void no_weight_makes_denormal_products() {
    for (int i = 0; i < 20000; ++i) {
        const float weight = exp_minus(0.013F * static_cast<float>(i));
        CHECK(weight == 0 || std::fpclassify(weight * 1e-10F) == FP_NORMAL);
    }
    CHECK_EQUAL(exp_minus(42), 0);
    CHECK_EQUAL(exp_minus(1e30F), 0);
}

}  // namespace

int main() {
    a_constant_stays_and_nothing_leaves_the_range();
    threads_make_no_difference();
    an_edge_is_kept();
    nothing_is_no_error();
    steep_edges_are_no_error();
    the_exponential_is_close();
    no_weight_makes_denormal_products();
    return failed_checks();
}
