// Pre-filtering against the definition of non-local means, and on edges with and without noise.
#include <algorithm>
#include <cmath>
#include <random>
#include <utility>

#include "check.hpp"
#include "core.hpp"
#include "pixels.hpp"

using namespace tungsten_dip;

namespace {

// Where values are looked for, and how many standard deviations apart they are alike.
struct Search {
    SearchWindow window{.radius = 5, .step = 1};
    float k = 0.5F;
};

struct Output {
    Pixels mean, half_a, half_b, variance;

    Output(Render& render, int threads, bool with_variance = true, Search search = {})
        : mean(render.mean), half_a(mean), half_b(mean), variance(mean) {
        Buffer in = render.buffer();
        if (!with_variance) in.variance = {};
        prefilter_feature(in,
                          {.mean = mean.view(),
                           .half_a = half_a.view(),
                           .half_b = half_b.view(),
                           .variance = variance.view()},
                          search.window, search.k, threads);
    }
    bool operator==(const Output&) const = default;
};

float edge(int x, int width) { return x < width / 2 ? 0.0F : 1.0F; }

Render noisy_edge(int height, int width, unsigned seed) {
    Render render(height, width, 16, seed,
                  [](std::mt19937& generator) { return 0.4 * std::normal_distribution<>()(generator); });
    for (Pixels* plane : {&render.mean, &render.half_a, &render.half_b}) {
        for (int y = 0; y < height; ++y) {
            for (int x = 0; x < width; ++x) plane->at(y, x) += edge(x, width);
        }
    }
    return render;
}

// One value of half a, straight from the definition in double precision.
double nl_means(Render& render, Search search, int y, int x) {
    const int height = render.mean.height;
    const int width = render.mean.width;
    const auto inside = [&](int row, int column) {
        return row >= 0 && row < height && column >= 0 && column < width;
    };
    const auto repeated = [&](Pixels& image, int row, int column) {
        return image.at(std::clamp(row, 0, height - 1), std::clamp(column, 0, width - 1));
    };
    double sum = 0;
    double weights = 0;
    const auto [window, k] = search;
    for (int dy = -window.radius; dy <= window.radius; dy += window.step) {
        for (int dx = -window.radius; dx <= window.radius; dx += window.step) {
            if (!inside(y + dy, x + dx)) continue;
            double distance = 0;
            for (int py = y - 3; py <= y + 3; ++py) {
                for (int px = x - 3; px <= x + 3; ++px) {
                    // Patches see the border of the image repeated outwards.
                    const double here = 2.0 * repeated(render.variance, py, px);
                    const double there = 2.0 * repeated(render.variance, py + dy, px + dx);
                    const double difference = static_cast<double>(repeated(render.half_b, py, px)) -
                                              repeated(render.half_b, py + dy, px + dx);
                    distance += std::min((difference * difference - here - std::min(here, there)) /
                                             (k * k * (here + there) + 1e-7),
                                         1e4);
                }
            }
            const double weight = std::exp(-std::max(distance / 49, 0.0));
            sum += weight * render.half_a.at(y + dy, x + dx);
            weights += weight;
        }
    }
    return sum / weights;
}

void agrees_with_the_definition() {
    for (const auto& [height, width] :
         {std::pair{13, 11}, std::pair{70, 67}, std::pair{1, 9}, std::pair{9, 1}}) {
        for (const Search search : {Search{},
                                    {.window = {.radius = 2, .step = 1}, .k = 0.9F},
                                    {.window = {.radius = 6, .step = 3}}}) {
            Render render = noisy_edge(height, width, 1);
            Output out(render, 2, true, search);
            double worst = 0;
            for (int y = 0; y < height; y += 3) {
                for (int x = 0; x < width; x += 2) {
                    worst = std::max(worst, std::abs(out.half_a.at(y, x) - nl_means(render, search, y, x)));
                }
            }
            CHECK_BELOW(worst, 1e-5);
        }
    }
}

double squared_error(Pixels& image) {
    double sum = 0;
    for (int y = 0; y < image.height; ++y) {
        for (int x = 0; x < image.width; ++x) {
            sum += std::pow(image.at(y, x) - 1 - edge(x, image.width), 2);
        }
    }
    return sum / static_cast<double>(image.values.size());
}

void removes_noise_and_keeps_edges() {
    for (const bool with_variance : {true, false}) {
        Render render = noisy_edge(40, 51, 2);
        Output out(render, 2, with_variance);
        CHECK_BELOW(squared_error(out.mean), 0.2 * squared_error(render.mean));
        CHECK_NEAR(out.mean.at(20, 24), 1, 0.15);
        CHECK_NEAR(out.mean.at(20, 25), 2, 0.15);
        double remaining = 0;
        for (const float value : out.variance.values) remaining += value;
        remaining /= static_cast<double>(out.variance.values.size());
        CHECK(remaining > 0);
        CHECK_BELOW(remaining, 0.2 * 0.16 / 16);
    }
}

void leaves_clean_values_alone() {
    Render render(70, 30, 4, 3, [](auto&) { return 0.0; });
    for (int y = 0; y < 70; ++y) {
        for (int x = 0; x < 30; ++x) {
            const float value = std::sin(static_cast<float>(3 * y + x));
            for (Pixels* plane : {&render.mean, &render.half_a, &render.half_b}) plane->at(y, x) = value;
        }
    }
    const Output clean(render, 1);
    CHECK(clean.mean == render.mean);
    CHECK(clean.half_a == render.half_a);
    CHECK(clean.half_b == render.half_b);
    CHECK(clean.variance == Pixels(70, 30, 1));

    // Noise below a thousandth of a value is none.
    for (int y = 0; y < 70; ++y) {
        for (int x = 0; x < 30; ++x) render.half_a.at(y, x) *= 1 + 4e-4F * static_cast<float>(x % 2);
    }
    const Output nearly_clean(render, 1);
    CHECK(nearly_clean.mean == render.mean);
    CHECK(nearly_clean.half_a == render.half_a);

    render.half_a.at(2, 2) += 0.1F;  // noise elsewhere changes nothing here
    render.variance.at(2, 2) = 0.0025F;
    Output one_noisy(render, 1);
    CHECK_EQUAL(one_noisy.mean.at(2, 3), render.mean.at(2, 3));
    CHECK_EQUAL(one_noisy.mean.at(60, 3), render.mean.at(60, 3));
}

void every_size_and_thread_count_works() {
    for (const auto& [height, width] : {std::pair{1, 1}, std::pair{1, 80}, std::pair{80, 1},
                                        std::pair{65, 129}, std::pair{0, 3}, std::pair{3, 0}}) {
        Render render = noisy_edge(height, width, 4);
        const Output one(render, 1);
        const Output many(render, 5);
        CHECK(one == many);
        CHECK(std::ranges::all_of(one.mean.values, [](float value) { return std::isfinite(value); }));
    }
}

}  // namespace

int main() {
    agrees_with_the_definition();
    removes_noise_and_keeps_edges();
    leaves_clean_values_alone();
    every_size_and_thread_count_works();
    return failed_checks();
}
