// The hook's Python face: arrays share memory with Tungsten's buffers, and the GIL is released while it
// renders.
#include "bindings.hpp"

#include <pybind11/numpy.h>
#include <pybind11/stl.h>

#include "render.hpp"

namespace py = pybind11;

namespace tungsten_dip {

namespace {

using FloatArray = py::array_t<float, py::array::c_style>;

// An array over memory that lives as long as any array of the same render.
// NOLINTNEXTLINE(misc-const-correctness): numpy may write to it
py::object array_over(const RenderBuffers& buffers, float* data, int channels) {
    if (data == nullptr) return py::none();
    const py::capsule owner(new std::shared_ptr<void>(buffers.memory),
                            [](void* shared) { delete static_cast<std::shared_ptr<void>*>(shared); });
    return FloatArray({buffers.height, buffers.width, channels}, data, owner);
}

py::dict dict_from_buffers(const RenderBuffers& buffers) {
    py::dict result;
    for (const QuantityPlanes& quantity : buffers.quantities) {
        py::dict planes;
        planes["mean"] = array_over(buffers, quantity.mean, quantity.channels);
        planes["half_a"] = array_over(buffers, quantity.half_a, quantity.channels);
        planes["half_b"] = array_over(buffers, quantity.half_b, quantity.channels);
        planes["variance"] = array_over(buffers, quantity.variance, quantity.channels);
        result[quantity.name] = planes;
    }
    result["spp"] =
        buffers.spp != nullptr ? array_over(buffers, buffers.spp, 1) : py::float_(buffers.uniform_spp);
    return result;
}

// Passes are rendered whole: a pass cut short would leave a state that cannot be resumed. What a signal
// handler raises in the meantime is raised after the pass.
void render_pass(Render& render) {
    using namespace std::chrono_literals;
    constexpr auto signal_poll = 50ms;
    std::optional<py::error_already_set> raised;
    {
        const py::gil_scoped_release release;
        render.start_pass();
    }
    for (bool finished = false; !finished;) {
        {
            const py::gil_scoped_release release;
            finished = render.wait_for_pass(signal_poll);
        }
        if (PyErr_CheckSignals() != 0) raised.emplace();
    }
    if (raised) throw std::move(*raised);
}

}  // namespace

void bind(const py::module_& module) {
    module.doc() = "Tungsten itself: renders a scene and hands over its camera's buffers.";
    module.attr("tungsten_version") = tungsten_version();

    py::register_exception<PictureTooLarge>(module, "PictureTooLarge");
    py::class_<RenderPlan>(module, "RenderPlan", "What the scene file and the overrides come to.")
        .def_readonly("integrator", &RenderPlan::integrator)
        .def_readonly("tonemap", &RenderPlan::tonemap)
        .def_readonly("output_file", &RenderPlan::output_file)
        .def_readonly("checkpoint_interval_s", &RenderPlan::checkpoint_interval_s)
        .def_readonly("timeout_s", &RenderPlan::timeout_s)
        .def_readonly("resume", &RenderPlan::resume)
        .def_readonly("writes_features", &RenderPlan::writes_features)
        .def_readonly("seed", &RenderPlan::seed);

    py::class_<Render>(module, "Render",
                       "A loaded scene that is rendered pass by pass; one at a time per process.")
        .def(py::init([](const std::string& scene, int threads, std::uint64_t max_pixels,
                         std::optional<std::uint32_t> spp, std::optional<std::uint32_t> seed,
                         std::string input_directory, std::string output_directory, std::string output_file,
                         std::string hdr_output_file) {
                 return std::make_unique<Render>(
                     scene, RenderOptions{.threads = threads,
                                          .max_pixels = max_pixels,
                                          .spp = spp,
                                          .seed = seed,
                                          .input_directory = std::move(input_directory),
                                          .output_directory = std::move(output_directory),
                                          .output_file = std::move(output_file),
                                          .hdr_output_file = std::move(hdr_output_file)});
             }),
             py::arg("scene"), py::kw_only(), py::arg("threads"), py::arg("max_pixels"),
             py::arg("spp") = py::none(), py::arg("seed") = py::none(), py::arg("input_directory") = "",
             py::arg("output_directory") = "", py::arg("output_file") = "", py::arg("hdr_output_file") = "",
             py::call_guard<py::gil_scoped_release>(),
             "Load a scene. Raises RuntimeError, in one line, where Tungsten cannot, and PictureTooLarge, "
             "which says the size, for more than max_pixels.")
        .def_property_readonly("plan", &Render::plan, py::return_value_policy::copy)
        .def_property_readonly("current_spp", &Render::current_spp)
        .def_property_readonly("total_spp", &Render::total_spp)
        .def_property_readonly("done", &Render::done)
        .def("resume", &Render::resume, "Continue from the saved state; False where there is none that fits.")
        .def("render_pass", &render_pass, "Render the next samples (the scene's spp_step) of every pixel.")
        .def("save_checkpoint", &Render::save_checkpoint, py::call_guard<py::gil_scoped_release>())
        .def("save_outputs", &Render::save_outputs, py::call_guard<py::gil_scoped_release>())
        .def(
            "buffers",
            [](const Render& render) {
                const auto buffers = [&] {
                    const py::gil_scoped_release release;
                    return render.buffers();
                }();
                return dict_from_buffers(buffers);
            },
            "A copy of what is known so far: {quantity: {mean, half_a, half_b, variance}, 'spp': ...}.")
        .def(
            "take_buffers",
            [](Render& render) {
                const auto buffers = [&] {
                    const py::gil_scoped_release release;
                    return render.take_buffers();
                }();
                return dict_from_buffers(buffers);
            },
            "Tungsten's own buffers as arrays, without a copy, as buffers() has them; ends the render.");
}

}  // namespace tungsten_dip
