// The mean over a square window, in a time that hardly grows with it.
#include <algorithm>
#include <cstddef>
#include <utility>
#include <vector>

#include "checks.hpp"
#include "core.hpp"
#include "fastest.hpp"

namespace tungsten_dip {
namespace {

TUNGSTEN_DIP_FASTEST void add(const float* a, const float* b, std::size_t count, float* sums) {
    for (std::size_t i = 0; i < count; ++i) sums[i] = a[i] + b[i];
}

TUNGSTEN_DIP_FASTEST void add_to(float* sums, const float* values, std::size_t count) {
    for (std::size_t i = 0; i < count; ++i) sums[i] += values[i];
}

// The means of rows and those up to `radius` before and after, for `count` rows of `width` numbers.
//
// Sums over 2, 4, 8, ... rows are made of two of half as many, and a window of those that the binary digits
// of its length name, so that the time grows with the logarithm of the radius. Unlike one running sum, this
// subtracts nothing: next to a firefly, what is left of dark pixels would be rounding.
class WindowMeans {
  public:
    WindowMeans(int count, int width, int radius)
        : count_(count),
          width_(static_cast<std::size_t>(width)),
          radius_(std::min(radius, count - 1)),
          padded_(static_cast<std::size_t>(count + 2 * radius_) * width_),
          doubled_(padded_.size()),
          sums_(static_cast<std::size_t>(count) * width_) {}

    // A row, to be filled in.
    [[nodiscard]] float* row(int y) {
        return padded_.data() + static_cast<std::size_t>(y + radius_) * width_;
    }

    // Changes the rows.
    void sum_up() {
        const std::size_t length = 2 * static_cast<std::size_t>(radius_) + 1;
        std::size_t summed = 0;
        for (std::size_t rows = 1;; rows *= 2) {
            if ((length & rows) != 0) {
                add_to(sums_.data(), padded_.data() + summed * width_, sums_.size());
                summed += rows;
            }
            if (summed == length) break;
            add(padded_.data(), padded_.data() + rows * width_, padded_.size() - (2 * rows - 1) * width_,
                doubled_.data());
            std::swap(padded_, doubled_);
        }
    }

    void write_mean(int y, float* mean) const {
        const auto rows =
            static_cast<float>(std::min(y + radius_, count_ - 1) - std::max(y - radius_, 0) + 1);
        const float* sum = sums_.data() + static_cast<std::size_t>(y) * width_;
        for (std::size_t x = 0; x < width_; ++x) mean[x] = sum[x] / rows;
    }

  private:
    int count_;
    std::size_t width_;
    int radius_;
    std::vector<float> padded_;
    std::vector<float> doubled_;
    std::vector<float> sums_;
};

}  // namespace

void box_mean(ConstImage in, int radius, Image out, int threads) {
    if (radius < 0) refuse("radius", "0 or more", radius);
    check_same_shape("out", out, "image", in);
    if (in.size() == 0) return;
    std::vector<float> pixels(static_cast<std::size_t>(in.size()));
    const Image across{
        .data = pixels.data(), .height = in.height, .width = in.width, .channels = in.channels};
    parallel_for(in.height, threads, [&](int y) {
        WindowMeans columns(in.width, in.channels, radius);
        std::copy_n(in.row(y), in.row_size(), columns.row(0));
        columns.sum_up();
        for (int x = 0; x < in.width; ++x) columns.write_mean(x, &across.at(y, x, 0));
    });
    constexpr std::ptrdiff_t strip = 32;  // numbers of every row, few enough for the cache to hold all rows
    parallel_for(static_cast<int>((in.row_size() + strip - 1) / strip), threads, [&](int index) {
        const std::ptrdiff_t left = index * strip;
        const auto width = static_cast<int>(std::min(strip, in.row_size() - left));
        WindowMeans rows(in.height, width, radius);
        for (int y = 0; y < in.height; ++y) std::copy_n(across.row(y) + left, width, rows.row(y));
        rows.sum_up();
        for (int y = 0; y < in.height; ++y) rows.write_mean(y, out.row(y) + left);
    });
}

}  // namespace tungsten_dip
