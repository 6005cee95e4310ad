// The hook: from the camera's output buffers to the arrays that a fit reads.
#include <algorithm>
#include <cstdint>
#include <memory>
#include <thread>
#include <type_traits>
#include <utility>
#include <vector>

#include "camera_buffers.hpp"
#include "thread/ThreadPool.hpp"
#include "thread/ThreadUtils.hpp"

namespace tungsten_dip {

using namespace Tungsten;

namespace {

template <typename Value>
constexpr std::size_t channels_of = std::is_same_v<Value, float> ? 1 : 3;

// For all pixels in [begin, end): the mean of both halves, and, in place, the variance of that mean from the
// summed squared deviations. Both as OutputBuffer has them, but in runs of equal sample counts, which the
// compiler can vectorise. A pixel without samples gets 0 where OutputBuffer::save writes a variance of 0/0.
void combine(const BufferBlocks& blocks, std::size_t channels, std::uint32_t begin, std::uint32_t end,
             float* __restrict mean, float* __restrict variance) {
    while (begin < end) {
        const std::uint32_t count = blocks.counts[begin];
        const std::uint32_t* run_end = std::find_if(blocks.counts + begin, blocks.counts + end,
                                                    [=](std::uint32_t c) { return c != count; });
        const auto stop = static_cast<std::uint32_t>(run_end - blocks.counts);
        const std::uint32_t samples_b = count / 2;  // samples alternate A, B, A, B
        const auto weight_a = static_cast<float>(count - samples_b);
        const auto weight_b = static_cast<float>(samples_b);
        const auto n = static_cast<float>(std::max(count, 1u));
        const float degrees = std::max(1.0f, n * (n - 1.0f));
        for (std::size_t i = begin * channels; i < stop * channels; ++i) {
            mean[i] = (blocks.half_a[i] * weight_a + blocks.half_b[i] * weight_b) / n;
            variance[i] /= degrees;
        }
        begin = stop;
    }
}

// Calls f(begin, end) for a share of the items on as many threads as the render had. Tungsten's own
// parallelFor looks for the end of the work only every 10 ms, which is a fifth of what a hand-over may take.
template <typename F>
void parallel_ranges(std::uint32_t items, const F& f) {
    const std::uint32_t shares = ThreadUtils::pool->threadCount();
    std::vector<std::jthread> threads;
    threads.reserve(shares);
    for (std::uint64_t share = 0; share < shares; ++share)
        threads.emplace_back(f, static_cast<std::uint32_t>(items * share / shares),
                             static_cast<std::uint32_t>(items * (share + 1) / shares));
}

// Owns what RenderBuffers point into: buffers moved out of the camera, and arrays of our own.
class BufferMemory {
  public:
    float* own(std::vector<float> array) {
        arrays_.push_back(std::move(array));
        return arrays_.back().data();
    }

    template <typename T>
    void own(std::unique_ptr<OutputBuffer<T>> buffer) {
        buffers_.emplace_back(std::move(buffer));
    }

  private:
    std::vector<std::shared_ptr<void>> buffers_;
    std::vector<std::vector<float>> arrays_;
};

enum class Access : std::uint8_t { copy, take };

RenderBuffers buffers_of(Camera& camera, std::uint32_t spp, bool writes_features,
                         std::vector<std::vector<float>> means, Access access) {
    const auto owner = std::make_shared<BufferMemory>();
    BufferMemory& memory = *owner;
    const Vec2u size = camera.resolution();
    const std::uint32_t width = size.x();
    const std::uint32_t pixels = size.product();
    RenderBuffers buffers{.width = static_cast<int>(width),
                          .height = static_cast<int>(size.y()),
                          .quantities = {},
                          .spp = nullptr,
                          .uniform_spp = static_cast<float>(spp),
                          .memory = owner};

    if (!writes_features) {
        // Light also arrives by splatting, which no half contains: only the whole image is sound.
        float* mean = memory.own(std::move(means[0]));
        parallel_ranges(pixels, [&](std::uint32_t begin, std::uint32_t end) {
            for (std::uint32_t i = begin; i < end; ++i) {
                const Vec3f radiance =
                    camera.getLinear(static_cast<int>(i % width), static_cast<int>(i / width));
                std::copy_n(radiance.data(), 3, mean + std::size_t{i} * 3);
            }
        });
        buffers.quantities.push_back({.name = "color", .channels = 3, .mean = mean});
        return buffers;
    }

    auto mean = means.begin();
    for_each_quantity([&](OutputBufferTypeEnum type, const char* name, auto member) {
        auto& buffer = camera.*member;
        constexpr std::size_t channels = channels_of<std::decay_t<decltype((*buffer)[0])>>;
        const BufferBlocks blocks = blocks_of(*buffer);
        const std::size_t floats = pixels * channels;
        // What is taken is ours alone from here on; otherwise the render still needs it as it is.
        const auto array = [&](const float* block) {
            return access == Access::take ? const_cast<float*>(block) : memory.own({block, block + floats});
        };
        const QuantityPlanes quantity{.name = name,
                                      .channels = static_cast<int>(channels),
                                      .mean = memory.own(std::move(*mean++)),
                                      .half_a = array(blocks.half_a),
                                      .half_b = array(blocks.half_b),
                                      .variance = array(blocks.squared_deviations)};
        parallel_ranges(pixels, [&](std::uint32_t begin, std::uint32_t end) {
            combine(blocks, channels, begin, end, quantity.mean, quantity.variance);
        });
        buffers.quantities.push_back(quantity);

        if (type == OutputColor) {
            const std::uint32_t* first = blocks.counts;
            const std::uint32_t* last = first + pixels;
            buffers.uniform_spp = static_cast<float>(*first);
            if (std::find_if(first, last, [=](std::uint32_t count) { return count != *first; }) != last) {
                buffers.spp = memory.own({first, last});
            }
        }
        if (access == Access::take) memory.own(std::move(buffer));
    });
    return buffers;
}

}  // namespace

std::vector<std::vector<float>> means_for(const Camera& camera, bool writes_features) {
    const std::size_t pixels = camera.resolution().product();
    std::vector<std::vector<float>> means;
    for_each_quantity([&](OutputBufferTypeEnum type, const char*, auto member) {
        using Value = std::decay_t<decltype((*(camera.*member))[0])>;
        if (type == OutputColor || writes_features) means.emplace_back(pixels * channels_of<Value>);
    });
    return means;
}

RenderBuffers copied_buffers(Camera& camera, std::uint32_t spp, bool writes_features) {
    return buffers_of(camera, spp, writes_features, means_for(camera, writes_features), Access::copy);
}

RenderBuffers taken_buffers(Camera& camera, std::uint32_t spp, bool writes_features,
                            std::vector<std::vector<float>> means) {
    return buffers_of(camera, spp, writes_features, std::move(means), Access::take);
}

}  // namespace tungsten_dip
