// Where Tungsten's camera keeps the data of an image, and how to get at it without changing Tungsten.
#pragma once

#include <cstdint>
#include <memory>
#include <ostream>
#include <stdexcept>
#include <streambuf>
#include <vector>

#include "cameras/Camera.hpp"
#include "cameras/OutputBuffer.hpp"
#include "render.hpp"

namespace tungsten_dip {

// A derived class may name the camera's protected members: the way to own a buffer that outlives its scene.
struct CameraBuffers : Tungsten::Camera {
    static constexpr auto color = &CameraBuffers::_colorBuffer;
    static constexpr auto albedo = &CameraBuffers::_albedoBuffer;
    static constexpr auto normal = &CameraBuffers::_normalBuffer;
    static constexpr auto depth = &CameraBuffers::_depthBuffer;
    static constexpr auto visibility = &CameraBuffers::_visibilityBuffer;
};

// Calls f(type, name, member) for every quantity, colour first.
template <typename F>
void for_each_quantity(F&& f) {
    f(Tungsten::OutputColor, "color", CameraBuffers::color);
    f(Tungsten::OutputAlbedo, "albedo", CameraBuffers::albedo);
    f(Tungsten::OutputNormal, "normal", CameraBuffers::normal);
    f(Tungsten::OutputDepth, "depth", CameraBuffers::depth);
    f(Tungsten::OutputVisibility, "visibility", CameraBuffers::visibility);
}

// OutputBuffer::serialize writes half A, half B, the summed squared deviations and the sample counts, each as
// one block. This stream notes where the blocks lie and copies nothing.
class BlockAddresses : public std::streambuf {
  public:
    std::vector<const char*> blocks;

  protected:
    std::streamsize xsputn(const char* data, std::streamsize size) override {
        blocks.push_back(data);
        return size;
    }
};

struct BufferBlocks {
    const float* half_a;
    const float* half_b;
    const float* squared_deviations;
    const std::uint32_t* counts;
};

// Only for buffers with halves and variance, which is what Render asks for.
template <typename T>
BufferBlocks blocks_of(const Tungsten::OutputBuffer<T>& buffer) {
    static_assert(sizeof(Tungsten::Vec3f) == 3 * sizeof(float));
    BlockAddresses addresses;
    Tungsten::OutputStreamHandle stream = std::make_shared<std::ostream>(&addresses);
    buffer.serialize(stream);
    if (addresses.blocks.size() != 4)
        throw std::runtime_error(
            "expected output buffers with halves and variance; this Tungsten keeps others");
    const auto floats = [&](std::size_t i) { return reinterpret_cast<const float*>(addresses.blocks[i]); };
    return {floats(0), floats(1), floats(2), reinterpret_cast<const std::uint32_t*>(addresses.blocks[3])};
}

// Memory for the means of RenderBuffers, one array per quantity, all pages touched.
std::vector<std::vector<float>> means_for(const Tungsten::Camera& camera, bool writes_features);

// The camera's buffers as RenderBuffers: copies, after which the render may go on, or the buffers themselves,
// moved out of the camera, with the memory of `means_for` for the means. An integrator that writes no
// features fills colour alone, and in part by splatting.
RenderBuffers copied_buffers(Tungsten::Camera& camera, std::uint32_t spp, bool writes_features);
RenderBuffers taken_buffers(Tungsten::Camera& camera, std::uint32_t spp, bool writes_features,
                            std::vector<std::vector<float>> means);

}  // namespace tungsten_dip
