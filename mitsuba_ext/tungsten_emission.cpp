// tungsten_emission: a texture for area lights that is sampled by area, as Tungsten does.
//
// Mitsuba samples the texels of a light's texture instead, which needs UV that cover the shape once.
//
//   (nested)   the texture of the radiance
#include <mitsuba/render/texture.h>

#include <string>

#include "tungsten_plugin.hpp"

namespace mitsuba {

template <typename Float, typename Spectrum>
class Emission final : public Texture<Float, Spectrum> {
  public:
    using Base = Texture<Float, Spectrum>;
    MI_IMPORT_TYPES()

    explicit Emission(const Properties& props) : Base(props) {
        for (const auto& prop : props.objects())
            if (auto* texture = prop.try_get<Base>()) texture_ = texture;
        if (!texture_) Throw("Expected a nested texture");
    }

    UnpolarizedSpectrum eval(const SurfaceInteraction3f& si, Mask active) const override {
        return texture_->eval(si, active);
    }

    Float mean() const override { return texture_->mean(); }

    ScalarFloat max() const override { return texture_->max(); }

    [[nodiscard]] bool is_spatially_varying() const override { return false; }

    [[nodiscard]] std::string to_string() const override { return "Emission[]"; }

    MI_DECLARE_CLASS(Emission)

  private:
    ref<Base> texture_;
};

}  // namespace mitsuba

TUNGSTEN_EXPORT_PLUGIN(Emission<float, Rgb>)
