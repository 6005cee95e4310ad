// What the core asks of its arguments. A check throws std::invalid_argument, which says the argument, what
// was expected and what came.
#pragma once

#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>

#include "core.hpp"

namespace tungsten_dip {

template <typename Got>
[[noreturn]] void refuse(std::string_view name, const std::string& expected, const Got& got) {
    std::ostringstream message;
    message << name << ": expected " << expected << ", got " << got;
    throw std::invalid_argument(message.str());
}

// The height and width of another argument.
void check_same_size(std::string_view name, ConstImage got, const std::string& model_name, ConstImage model);

// The height, width and channels of another argument.
void check_same_shape(std::string_view name, ConstImage got, const std::string& model_name, ConstImage model);

void check_channels(std::string_view name, ConstImage image, int expected);

// All known images of a buffer in the shape of its mean.
void check_buffer(const ConstBuffer& buffer);

void check_window(SearchWindow window);

// How many standard deviations of their noise apart pixels may be.
void check_k(float k);

}  // namespace tungsten_dip
