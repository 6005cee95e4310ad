// Statistics against analytic values, and the test of independence against samplers whose answer is known.
#include <cmath>
#include <limits>
#include <random>
#include <utility>

#include "check.hpp"
#include "core.hpp"
#include "pixels.hpp"

using namespace tungsten_dip;

namespace {

using Generator = std::mt19937;

double normal(Generator& generator) { return std::normal_distribution<>()(generator); }

// Most samples are small, one in fifty is huge: the fireflies of a caustic.
double firefly(Generator& generator) {
    const double sample = std::exponential_distribution<>()(generator);
    return std::uniform_real_distribution<>()(generator) < 0.02 ? 1000 * sample : sample;
}

// Every second sample mirrors the one before it in part, as low-discrepancy points do.
auto mirrored(double strength) {
    return [strength, last = 0.0, odd = false](Generator& generator) mutable {
        const double fresh = normal(generator);
        const double sample = odd ? -strength * last + std::sqrt(1 - strength * strength) * fresh : fresh;
        last = fresh;
        odd = !odd;
        return sample;
    };
}

void halves_variance_is_that_of_the_mean() {
    Render render(64, 65, 8, 1, [](Generator& generator) { return 3 * normal(generator); });
    Pixels out(64, 65, 1);
    halves_variance(render.half_a.view(), render.half_b.view(), out.view(), 2);
    CHECK_NEAR(out.at(1, 2), std::pow(render.half_a.at(1, 2) - render.half_b.at(1, 2), 2) / 4, 1e-6);
    double sum = 0;
    for (const float value : out.values) sum += value;
    const auto count = static_cast<double>(out.values.size());
    // The variance of 8 samples' mean is 9/8; the standard error of its estimate is sqrt(2 / count) of that.
    CHECK_NEAR(sum / count, 9.0 / 8, 4 * 9.0 / 8 * std::sqrt(2 / count));
}

HalvesTest compare(Render& render, bool with_variance) {
    return compare_halves(render.half_a.view(), render.half_b.view(),
                          with_variance ? render.variance.view() : Image{}, 2);
}

void independent_halves_pass() {
    Render plain(100, 99, 16, 3, normal);
    Render heavy_tailed(100, 99, 16, 4, firefly);
    for (Render* render : {&plain, &heavy_tailed}) {
        for (const bool with_variance : {true, false}) {
            const HalvesTest test = compare(*render, with_variance);
            CHECK(test.independent);
            CHECK_NEAR(test.correlation, 0, 0.1);
        }
    }
}

void mirrored_halves_fail() {
    for (const double strength : {0.2, 0.6}) {
        Render render(128, 130, 16, 5, mirrored(strength));
        const HalvesTest test = compare(render, true);
        CHECK_NEAR(test.correlation, -strength, 0.1);
        CHECK(!test.independent);
        CHECK(!compare(render, false).independent);
    }
}

void shared_samples_fail() {
    Render render(100, 99, 16, 6, mirrored(-0.5));
    CHECK_NEAR(compare(render, true).correlation, 0.5, 0.1);
    CHECK(!compare(render, true).independent);

    Render same(100, 99, 16, 7, normal);
    same.half_b = same.half_a;
    for (const bool with_variance : {true, false}) {
        CHECK_EQUAL(compare(same, with_variance).correlation, 1);
        CHECK(!compare(same, with_variance).independent);
    }
}

// A variance of one sample is as many times too large as there are samples.
void foreign_variances_are_found() {
    for (const auto& render : {Render(100, 99, 16, 3, normal), Render(100, 99, 16, 4, firefly),
                               Render(100, 99, 16, 6, mirrored(-0.5))}) {
        for (const double factor : {1.0 / 16, 1.0, 2.0, 16.0}) {
            Render scaled = render;
            for (float& value : scaled.variance.values) value *= static_cast<float>(factor);
            const HalvesTest test = compare(scaled, true);
            CHECK_NEAR(test.variance_ratio * factor, compare(scaled, false).correlation > 0.3 ? 0.5 : 1, 0.1);
            CHECK(test.variance_fits == (factor == 1 || factor == 2));
        }
    }
    // Halves that are nearly the same tell of their shared samples, not of the variance.
    Render same(100, 99, 16, 7, mirrored(-0.95));
    CHECK(compare(same, true).variance_ratio < 0.2);
    CHECK(compare(same, true).variance_fits);
    CHECK(std::isnan(compare(same, false).variance_ratio));
    CHECK(compare(same, false).variance_fits);
}

void unknown_values_are_left_out() {
    Render render(100, 99, 16, 8, mirrored(0.4));
    const HalvesTest all = compare(render, true);
    for (int y = 0; y < 30; ++y) {
        for (int x = 0; x < 99; ++x) render.half_a.at(y, x) = std::numeric_limits<float>::quiet_NaN();
    }
    const HalvesTest most = compare(render, true);
    CHECK_NEAR(most.correlation, all.correlation, 0.1);
    CHECK_NEAR(most.variance_ratio, all.variance_ratio, 0.1);
    CHECK(!most.independent);
    for (int y = 0; y < 100; ++y) {
        for (int x = y % 2; x < 99; x += 2) render.half_b.at(y, x) = std::numeric_limits<float>::quiet_NaN();
    }
    CHECK(std::isnan(compare(render, true).correlation));
}

// Few tiles tell the correlation badly: what chance explains is no evidence.
void few_pixels_accuse_nobody() {
    for (unsigned seed = 20; seed < 60; ++seed) {
        Render render(40, 40, 16, seed, normal);
        for (const bool with_variance : {true, false}) CHECK(compare(render, with_variance).independent);
    }
}

// Adds the same detail to both halves, in the columns from `first` on.
void add_texture(Render& render, double contrast, int first = 0) {
    Generator generator(9);  // NOLINT(bugprone-random-generator-seed): tests repeat
    for (int y = 0; y < render.mean.height; ++y) {
        for (int x = first; x < render.mean.width; ++x) {
            const auto detail = static_cast<float>(contrast * std::abs(normal(generator)));
            render.half_a.at(y, x) += detail;
            render.half_b.at(y, x) += detail;
        }
    }
}

void texture_is_no_correlation() {
    Render render(100, 99, 16, 8, normal);
    add_texture(render, 10);
    const HalvesTest test = compare(render, true);
    CHECK(test.correlation > 0.9);
    CHECK(test.independent);
    CHECK(compare(render, false).independent);
}

void textured_tiles_are_left_aside() {
    Render render(128, 130, 16, 13, normal);
    add_texture(render, 10, 73);
    CHECK_NEAR(compare(render, false).correlation, 0, 0.1);
    CHECK(compare(render, false).independent);
}

// Halves that differ by the rounding of half floats alone are as alike as their texture.
void rounding_is_no_noise() {
    Render render(128, 130, 16, 14, normal);
    Generator generator(15);  // NOLINT(bugprone-random-generator-seed): tests repeat
    for (int y = 0; y < 128; ++y) {
        for (int x = 0; x < 89; ++x) {
            const double value = 1 + 0.02 * normal(generator);
            for (Pixels* half : {&render.half_a, &render.half_b})
                half->at(y, x) = static_cast<float>(value + 0x1p-12 * normal(generator) / 2);
        }
    }
    CHECK_NEAR(compare(render, false).correlation, 0, 0.2);
    CHECK(compare(render, false).independent);
}

// A half float that holds few of its smallest steps is off by a large part of itself.
void variances_of_few_steps_tell_nothing() {
    Render render(100, 99, 16, 16, normal);
    add_texture(render, 10);
    const double dark = std::sqrt(0.55 * 0x1p-24 * 16);  // its variance, 0.55 steps in the mean, becomes 1
    for (int y = 0; y < 100; ++y) {
        for (int x = 0; x < 90; ++x) {
            for (Pixels* half : {&render.half_a, &render.half_b})
                half->at(y, x) = static_cast<float>(dark * half->at(y, x));
            const double steps = std::round(dark * dark * render.variance.at(y, x) / 0x1p-24);
            render.variance.at(y, x) = static_cast<float>(steps * 0x1p-24);
        }
    }
    CHECK(compare(render, true).independent);  // which the variance of the other pixels shows
}

void nothing_to_see_is_not_independent() {
    for (const auto& [height, width] : {std::pair{1, 1}, std::pair{1, 50}, std::pair{50, 1}, std::pair{0, 0},
                                        std::pair{0, 5}, std::pair{5, 0}, std::pair{3, 3}}) {
        Render render(height, width, 4, 10, normal);
        const HalvesTest test = compare(render, true);
        CHECK(!test.independent);
        CHECK(std::isnan(test.correlation));
    }
    Render flat(50, 50, 4, 11, [](Generator&) { return 0.0; });
    CHECK(!compare(flat, true).independent);
}

void threads_do_not_matter() {
    Render render(67, 43, 8, 12, firefly);
    const auto run = [&](int threads) {
        return compare_halves(render.half_a.view(), render.half_b.view(), render.variance.view(), threads);
    };
    CHECK_EQUAL(run(1).correlation, run(5).correlation);
    CHECK(run(1).independent == run(5).independent);
}

}  // namespace

int main() {
    halves_variance_is_that_of_the_mean();
    independent_halves_pass();
    mirrored_halves_fail();
    shared_samples_fail();
    foreign_variances_are_found();
    unknown_values_are_left_out();
    few_pixels_accuse_nobody();
    texture_is_no_correlation();
    textured_tiles_are_left_aside();
    rounding_is_no_noise();
    variances_of_few_steps_tell_nothing();
    nothing_to_see_is_not_independent();
    threads_do_not_matter();
    return failed_checks();
}
