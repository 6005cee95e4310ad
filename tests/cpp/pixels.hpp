// Images that own their pixels, and seeded noise, for the tests.
#pragma once

#include <random>
#include <vector>

#include "core.hpp"

struct Pixels {
    int height;
    int width;
    int channels;
    std::vector<float> values;

    Pixels(int rows, int columns, int channel_count, float value = 0)
        : height(rows),
          width(columns),
          channels(channel_count),
          values(static_cast<std::size_t>(rows) * static_cast<std::size_t>(columns) *
                     static_cast<std::size_t>(channel_count),
                 value) {}

    tungsten_dip::Image view() {
        return {.data = values.data(), .height = height, .width = width, .channels = channels};
    }
    float& at(int y, int x, int c = 0) { return view().at(y, x, c); }
    bool operator==(const Pixels&) const = default;
};

struct Size {
    int height;
    int width;
};

inline Pixels noise(Size size, int channels, unsigned seed, double sigma = 1) {
    std::mt19937 generator(seed);  // NOLINT(misc-const-correctness): the distribution changes it
    std::normal_distribution<double> normal(0, sigma);
    Pixels image(size.height, size.width, channels);
    for (float& value : image.values) value = static_cast<float>(normal(generator));
    return image;
}

// What a renderer writes of a flat image of radiance 1 whose samples draw(generator) deviate from it.
struct Render {
    Pixels mean, half_a, half_b, variance;

    template <typename Draw>
    Render(int height, int width, int spp, unsigned seed, Draw draw)
        : mean(height, width, 1), half_a(mean), half_b(mean), variance(mean) {
        std::mt19937 generator(seed);  // NOLINT(misc-const-correctness): draw() changes it
        std::vector<double> samples(static_cast<std::size_t>(spp));
        for (int y = 0; y < height; ++y) {
            for (int x = 0; x < width; ++x) {
                double sum_a = 0;
                double sum_b = 0;
                for (std::size_t i = 0; i < samples.size(); ++i) {
                    samples[i] = 1 + draw(generator);
                    (i % 2 == 0 ? sum_a : sum_b) += samples[i];
                }
                const double average = (sum_a + sum_b) / spp;
                double squares = 0;
                for (const double sample : samples) squares += (sample - average) * (sample - average);
                mean.at(y, x) = static_cast<float>(average);
                half_a.at(y, x) = static_cast<float>(2 * sum_a / spp);
                half_b.at(y, x) = static_cast<float>(2 * sum_b / spp);
                variance.at(y, x) = static_cast<float>(squares / (spp - 1) / spp);
            }
        }
    }

    tungsten_dip::Buffer buffer() {
        return {.mean = mean.view(),
                .half_a = half_a.view(),
                .half_b = half_b.view(),
                .variance = variance.view()};
    }
};
