// exp(-x) as plain arithmetic that compilers vectorise.
#pragma once

#include <algorithm>
#include <bit>
#include <cstdint>
#include <numbers>

namespace tungsten_dip {

// exp(-x) to a relative error below 1e-5, less 1e-18, but never negative: the whole part of the binary
// logarithm becomes the exponent's bits, and a polynomial gives 2^fraction.
inline float exp_minus(float x) {
    // Sums of smaller weights are denormal, with which many processors compute a hundred times as slowly.
    constexpr float negligible = 1e-18F;
    const float log2 = std::max(-std::numbers::log2e_v<float> * x, -126.0F) + 127.0F;
    const auto whole = static_cast<std::int32_t>(log2);
    const float f = log2 - static_cast<float>(whole);
    // Fitted to a relative error below 1e-7.
    const float mantissa =
        0.99999994F + f * (0.69315308F +  // NOLINT(modernize-use-std-numbers): fitted, not ln 2
                           f * (0.24015363F + f * (0.05582631F + f * (0.00898935F + f * 0.00187757F))));
    const float power = std::bit_cast<float>(static_cast<std::uint32_t>(whole) << 23U) * mantissa;
    return std::max(power - negligible, 0.0F);
}

}  // namespace tungsten_dip
