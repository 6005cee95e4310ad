// The core of tungsten-dip: the buffers of a render, how they are mended, what is known of their noise, the
// filters of features and pilots, and a layer of the published networks. Free of Python and of any renderer.
//
// Images are float32, C-contiguous, shape (height, width, channels), row 0 at the top; colour is linear
// radiance. `threads` is how many threads work, 1 at least; no result depends on it, to the bit. An argument
// that does not fit raises std::invalid_argument, which says what was expected and what came.
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <optional>
#include <span>
#include <string_view>
#include <type_traits>

namespace tungsten_dip {

// A view of pixels that somebody else owns. Without data the image is unknown.
template <typename T>
struct ImageView {
    T* data = nullptr;
    int height = 0;
    int width = 0;
    int channels = 0;

    [[nodiscard]] bool known() const { return data != nullptr; }
    [[nodiscard]] std::ptrdiff_t row_size() const { return static_cast<std::ptrdiff_t>(width) * channels; }
    [[nodiscard]] std::ptrdiff_t size() const { return height * row_size(); }
    [[nodiscard]] T* row(int y) const { return data + y * row_size(); }
    [[nodiscard]] T& at(int y, int x, int c) const {
        return row(y)[static_cast<std::ptrdiff_t>(x) * channels + c];
    }

    operator ImageView<const T>() const  // NOLINT(google-explicit-constructor): reading is always allowed
        requires(!std::is_const_v<T>)
    {
        return {data, height, width, channels};
    }
};
using Image = ImageView<float>;
using ConstImage = ImageView<const float>;

// One quantity: the mean over all samples, the means of two disjoint halves of them, the variance of the
// mean. All known images have the same shape.
template <typename T>
struct BufferView {
    ImageView<T> mean;
    ImageView<T> half_a;
    ImageView<T> half_b;
    ImageView<T> variance;

    [[nodiscard]] bool has_halves() const { return half_a.known() && half_b.known(); }

    operator BufferView<const T>() const
        requires(!std::is_const_v<T>)
    {
        return {mean, half_a, half_b, variance};
    }
};
using Buffer = BufferView<float>;
using ConstBuffer = BufferView<const float>;

enum class Quantity : std::uint8_t { color, albedo, normal, depth, visibility };

// By the value of a Quantity.
inline constexpr std::array<std::string_view, 5> quantity_names{"color", "albedo", "normal", "depth",
                                                                "visibility"};

constexpr std::size_t channel_count(Quantity quantity) {
    return quantity == Quantity::depth || quantity == Quantity::visibility ? 1 : 3;
}

constexpr std::optional<Quantity> quantity_from_name(std::string_view name) {
    const auto* found = std::ranges::find(quantity_names, name);
    if (found == quantity_names.end()) return std::nullopt;
    return static_cast<Quantity>(found - quantity_names.begin());
}

// Calls body(0) ... body(count - 1), in any order, on up to `threads` threads. The first exception is thrown
// again here.
void parallel_for(int count, int threads, const std::function<void(int)>& body);

// --- sanitize.cpp

// A depth from here on counts as infinite: renderers mark the sky so (Blender 1e10, Arnold 1e30).
constexpr float infinite_depth = 1e9F;

// Radiance from here on counts as infinite: sums of some hundreds overflow.
constexpr float infinite_radiance = 1e36F;

// How many values of an image cannot be meant. As infinite count, beside such depths and radiance, a
// component of a normal of 1e6 and more, an albedo or visibility of 1e12 and more, and variances from the
// squares of these on. Normals may be negative; no other quantity and no variance may.
struct Defects {
    std::int64_t nan = 0;
    std::int64_t infinite = 0;
    std::int64_t negative = 0;

    [[nodiscard]] bool any() const { return nan + infinite + negative > 0; }
};
struct BufferDefects {
    Defects mean;
    Defects half_a;
    Defects half_b;
    Defects variance;

    [[nodiscard]] bool any() const { return mean.any() || half_a.any() || half_b.any() || variance.any(); }
};

// Images that are not known have none.
[[nodiscard]] BufferDefects find_defects(const ConstBuffer& buffer, Quantity quantity, int threads);

// Replaces every defect in place; images without defects are not written to.
// - negative values become 0, and so does an infinite depth: the ray left the scene. Negative radiance of up
//   to a quarter of what is around (3x3 pixels) is a filter's lobe, and taken from there; apart from this
//   only defects are changed;
// - mean, half_a and half_b follow from one another (mean = (half_a + half_b) / 2) where two of them are
//   sane; both halves are the mean where it alone is sane;
// - a variance (a negative one as well) follows from the halves: (half_a - half_b)^2 / 4, averaged over 3x3
//   pixels but no less than the pixel's own, since a firefly's variance is what overflows half floats;
// - else the median (for a variance: the maximum) of the sane pixels around; more than 16 pixels away from
//   any, the value of the half that is sane, or 0.
void mend(const Buffer& buffer, Quantity quantity);

// --- statistics.cpp

// (half_a - half_b)^2 / 4: an unbiased, very noisy estimate of the variance of the mean of independent
// halves.
void halves_variance(ConstImage half_a, ConstImage half_b, Image out, int threads);

// Whether the noise of two halves is independent, as everything that scores one half by the other assumes.
struct HalvesTest {
    // Of the two halves' errors; NaN if this image does not allow measuring it.
    double correlation = std::numeric_limits<double>::quiet_NaN();
    // Of the variance that the halves show to the one that is given; NaN without the latter, or if its digits
    // are too few.
    double variance_ratio = std::numeric_limits<double>::quiet_NaN();
    bool variance_fits = true;  // false if these are variances of different things
    bool independent = false;   // false as well where the correlation is NaN
};
// `variance` is that of the mean, by the samples; it may be unknown. NaN in the halves is left out.
[[nodiscard]] HalvesTest compare_halves(ConstImage half_a, ConstImage half_b, ConstImage variance,
                                        int threads);

// --- box_mean.cpp

// The mean over a square window of (2 radius + 1)^2 pixels, clipped at the borders of the image.
void box_mean(ConstImage in, int radius, Image out, int threads);

// --- The windows of filters

// How far filters may look, in pixels: further than any needs to, and images with so wide a border repeated
// around them still fit into memory.
constexpr int max_radius = 256;

// Where a filter looks for pixels that are alike: in every `step`-th row and column up to `radius` away,
// which is a multiple of the step.
struct SearchWindow {
    int radius;
    int step;
};

// --- prefilter.cpp

// Cross-filters the halves of a feature by non-local means, each with the weights of the other (Bitterli et
// al. 2016, "Nonlinearly Weighted First-order Regression for Denoising Monte Carlo Renderings", section 5.1).
// Values are alike that are `k` standard deviations of their noise apart. `in` must have halves; `out` needs
// all four images and overlaps nothing; its variance is that of the noise which remains. A value is passed
// through unchanged where its pixel and those next to it have hardly any noise: their halves differ, and
// their standard deviations are, by less than a thousandth of it.
void prefilter_feature(const ConstBuffer& in, const Buffer& out, SearchWindow window, float k, int threads);

// --- regression.cpp

// What tells which neighbours are alike: an image, the variance of its values (same shape), and how many
// standard deviations of their noise apart values may be.
struct Guide {
    ConstImage image;
    ConstImage variance;
    float k;
};

// Denoises `target` by first-order regression on `features`, fitted anew around every pixel; all predictions
// that a pixel gets from its neighbours' fits are averaged (Bitterli et al. 2016, section 4; Moon et al.
// 2014); with a window's step above 1, those in every (step + 1)-th row and column. A neighbour's weight is
// the non-local means weight of the guide (1 without one), times exp(-sum penalty_c (feature_c(p) -
// feature_c(q))^2). `penalty` has one value per feature. At most 16 features; everything must be finite. Sums
// are float32: features should differ by no more than some tens within a window; where they differ by some
// hundreds, results are useless.
void regress(ConstImage target, ConstImage features, std::span<const float> penalty,
             const std::optional<Guide>& guide, SearchWindow window, Image out, int threads);

// --- steering.cpp

// The products of the features' gradients, summed over features and smoothed: channels xx, yy, xy (Foerstner
// and Guelch 1987), shape (height, width, 3). It holds the direction of edges.
void structure_tensor(ConstImage features, Image out, int threads);

// Averages an image along the edges of a structure tensor of its size: around every pixel by a Gaussian with
// standard deviations `along` and `across` (0.01 to 128 pixels) the edge (Feng and Milanfar 2002, "Multiscale
// principal components analysis for image local orientation estimation"; Takeda et al. 2007, "Kernel
// Regression for Image Processing and Reconstruction"). Neighbours with another tensor, as beyond the end of
// the edge, weigh less.
void smooth_along_edges(ConstImage image, ConstImage tensor, float along, float across, Image out,
                        int threads);

// --- norm_act.cpp

using BFloat16 = std::uint16_t;  // the upper half of a float

// Batch norm, with the statistics of the image in hand, and leaky ReLU of an image in bfloat16: `pixels` rows
// of `channels` numbers, with a weight and a bias for each channel. On one thread: PyTorch's, which run
// before and after, would not leave their cores to others.
struct NormAct {
    std::size_t pixels = 0;
    std::size_t channels = 0;
    const float* weight = nullptr;
    const float* bias = nullptr;
    float epsilon = 0;  // added to the variance
    float slope = 0;    // of the leaky ReLU, for x < 0
};

// Writes the output y and, for each channel, the mean and one over the standard deviation.
void norm_act(const NormAct& norm, const BFloat16* x, BFloat16* y, float* mean, float* scale);

// What norm_act was given and what it wrote.
struct Normed {
    const BFloat16* x = nullptr;
    const BFloat16* y = nullptr;
    const float* mean = nullptr;
    const float* scale = nullptr;
};

// Where gradients are written: that of x, which may take the place of y's, and one of weight and bias for
// each channel.
struct NormActGradients {
    BFloat16* x = nullptr;
    float* weight = nullptr;
    float* bias = nullptr;
};

// Writes the gradients that follow from `gradient`, that of y.
void norm_act_gradient(const BFloat16* gradient, const NormAct& norm, const Normed& normed,
                       const NormActGradients& out);

}  // namespace tungsten_dip
