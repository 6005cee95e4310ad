// Images laid out for loops over rows that never ask where the image ends.
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

#include "core.hpp"

namespace tungsten_dip {

// Neighbouring pixels that are computed together.
constexpr int lanes = 8;
constexpr int rounded_up(int count, int multiple) { return (count + multiple - 1) / multiple * multiple; }

// An image's channels one after the other, [channel][y][x], with its border repeated `margin` pixels
// outwards: no loop needs to ask where the image ends.
class PaddedPlanes {
  public:
    // How far a loop over whole vectors may read beyond the margin; what it finds there is of no use.
    static constexpr std::size_t overread = lanes - 1;

    PaddedPlanes(int channels, int height, int width, int margin)
        : channels_(channels),
          height_(height),
          width_(width),
          margin_(margin),
          stride_(width + 2 * margin),
          pixels_(static_cast<std::size_t>(channels) * static_cast<std::size_t>(height + 2 * margin) *
                      static_cast<std::size_t>(stride_) +
                  overread) {}

    PaddedPlanes(ConstImage image, int margin, int threads)
        : PaddedPlanes(image.channels, image.height, image.width, margin) {
        parallel_for(height_, threads, [&](int y) {
            for (int c = 0; c < channels_; ++c) {
                float* to = row(c, y);
                for (int x = 0; x < width_; ++x) to[x] = image.at(y, x, c);
            }
        });
        repeat_border();
    }

    // Copies the border of what is inside into the margin.
    void repeat_border() {
        const auto columns = static_cast<std::size_t>(stride_);
        for (int c = 0; c < channels_; ++c) {
            for (int y = 0; y < height_; ++y) {
                float* pixels = row(c, y);
                std::fill_n(pixels - margin_, margin_, pixels[0]);
                std::fill_n(pixels + width_, margin_, pixels[width_ - 1]);
            }
            for (int i = 1; i <= margin_; ++i) {
                std::copy_n(row(c, 0) - margin_, columns, row(c, -i) - margin_);
                std::copy_n(row(c, height_ - 1) - margin_, columns, row(c, height_ - 1 + i) - margin_);
            }
        }
    }

    [[nodiscard]] int channels() const { return channels_; }
    [[nodiscard]] int height() const { return height_; }
    [[nodiscard]] int width() const { return width_; }
    // How far the planes of two channels lie apart.
    [[nodiscard]] std::ptrdiff_t plane_size() const { return (height_ + 2 * margin_) * stride_; }
    [[nodiscard]] float* row(int c, int y) { return pixels_.data() + offset(c, y); }
    [[nodiscard]] const float* row(int c, int y) const { return pixels_.data() + offset(c, y); }

  private:
    [[nodiscard]] std::ptrdiff_t offset(int c, int y) const {
        return (static_cast<std::ptrdiff_t>(c) * (height_ + 2 * margin_) + y + margin_) * stride_ + margin_;
    }

    int channels_;
    int height_;
    int width_;
    int margin_;
    std::ptrdiff_t stride_;
    std::vector<float> pixels_;
};

}  // namespace tungsten_dip
