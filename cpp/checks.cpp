// What the core asks of its arguments.
#include "checks.hpp"

#include <cmath>
#include <initializer_list>
#include <string>
#include <string_view>
#include <utility>

#include "core.hpp"

namespace tungsten_dip {
namespace {

std::string tuple_of(std::initializer_list<int> numbers) {
    std::string text;
    for (const int number : numbers) text += (text.empty() ? "(" : ", ") + std::to_string(number);
    return text + ")";
}

std::string size_of(ConstImage image) { return tuple_of({image.height, image.width}); }
std::string shape_of(ConstImage image) { return tuple_of({image.height, image.width, image.channels}); }

bool same_size(ConstImage a, ConstImage b) { return a.height == b.height && a.width == b.width; }

}  // namespace

void check_same_size(std::string_view name, ConstImage got, const std::string& model_name, ConstImage model) {
    if (same_size(got, model)) return;
    refuse(name, "the height and width of " + model_name + ", " + size_of(model), size_of(got));
}

void check_same_shape(std::string_view name, ConstImage got, const std::string& model_name,
                      ConstImage model) {
    if (same_size(got, model) && got.channels == model.channels) return;
    refuse(name, "the shape of " + model_name + ", " + shape_of(model), shape_of(got));
}

void check_channels(std::string_view name, ConstImage image, int expected) {
    if (image.channels != expected) refuse(name, std::to_string(expected) + " channels", image.channels);
}

void check_buffer(const ConstBuffer& buffer) {
    for (const auto& [name, image] : {std::pair{"half_a", buffer.half_a}, std::pair{"half_b", buffer.half_b},
                                      std::pair{"variance", buffer.variance}}) {
        if (image.known()) check_same_shape(name, image, "mean", buffer.mean);
    }
}

void check_window(SearchWindow window) {
    const std::string largest = std::to_string(max_radius);
    if (window.step < 1 || window.step > max_radius) refuse("step", "1 to " + largest, window.step);
    if (window.radius < 0 || window.radius > max_radius || window.radius % window.step != 0) {
        refuse("radius", "0 to " + largest + ", a multiple of the step " + std::to_string(window.step),
               window.radius);
    }
}

void check_k(float k) {
    // Differences are measured in units of k^2.
    if (!(k > 0) || !std::isfinite(k * k)) refuse("k", "a number above 0 with a finite square", k);
}

}  // namespace tungsten_dip
