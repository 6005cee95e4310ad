// What all plugins share.
#pragma once

#include <mitsuba/core/properties.h>
#include <mitsuba/core/spectrum.h>
#include <mitsuba/mitsuba.h>

#include <numbers>
#include <string_view>

// As runtime.py asks for: a plugin that was compiled against another release would crash in this one.
static_assert(std::string_view(MI_VERSION) == "3.9.1",
              "Mitsuba lays out its objects differently in every release: pip install mitsuba==3.9.1");

namespace mitsuba {

using Rgb = Color<float, 3>;

constexpr float pi = std::numbers::pi_v<float>;
constexpr float inv_pi = std::numbers::inv_pi_v<float>;
constexpr float two_pi = 2.f * pi;

template <typename Scalar>
Scalar squared(Scalar x) {
    return x * x;
}

}  // namespace mitsuba

// Registers a class for the one variant that the embedded host renders with.
#define TUNGSTEN_EXPORT_PLUGIN(...)                                                               \
    extern "C" MI_EXPORT void init_plugin(std::string_view name, mitsuba::PluginRegisterFn add) { \
        using namespace mitsuba;                                                                  \
        using Plugin = __VA_ARGS__;                                                               \
        add(name, "scalar_rgb", Plugin::Type,                                                     \
            [](void*, const Properties& props) -> ref<Object> { return new Plugin(props); });     \
    }
