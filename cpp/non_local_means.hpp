// What weighing by non-local means takes (Rousselle et al. 2012, "Adaptive Rendering with Non-Local Means
// Filtering", section 3). The distance of two pixels is, averaged over channels (equation 2),
//
//   (difference^2 - (v_p + min(v_p, v_q))) / (floor + k^2 (v_p + v_q))
//
// with the variances v of their values. A patch's distance is the mean of its pixels', and the weight
// exp(-max(0, distance)).
#pragma once

#include <algorithm>

namespace tungsten_dip {

// What noise alone makes of a squared difference; no more than that of the pixel itself where its partner's
// is larger.
inline float expected_squared_difference(float variance, float partner) {
    return variance + std::min(variance, partner);
}

// What a squared difference is measured in. The floor keeps distances finite: where there is no variance,
// values whose difference is its square root have a distance of 1.
inline float unit_of_squared_difference(float variance, float partner, float k_squared, float floor) {
    return floor + k_squared * (variance + partner);
}

// Sets to 0 the weights of `count` pixels, from column x on, whose partners dx columns further are outside of
// an image so wide.
inline void drop_outside_partners(int x, int dx, int image_width, int count, float* weights) {
    const int before = std::clamp(-dx - x, 0, count);
    const int inside = std::clamp(image_width - dx - x, before, count);
    std::fill_n(weights, before, 0.0F);
    std::fill(weights + inside, weights + count, 0.0F);
}

}  // namespace tungsten_dip
