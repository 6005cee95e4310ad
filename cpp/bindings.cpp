// The Python module _core: the one file that uses pybind11. Arrays are shared with numpy, never converted;
// that they are such arrays is checked here, all else by the core.
#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>
#include <pybind11/stl.h>

#include <array>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "core.hpp"

namespace py = pybind11;

namespace tungsten_dip {
namespace {

using Array = py::array_t<float, py::array::c_style>;

bool has_flag(const py::array& array, const char* flag) {
    return array.attr("flags").attr(flag).cast<bool>();
}
bool contiguous(const py::array& array) { return has_flag(array, "c_contiguous"); }
bool aligned(const py::array& array) { return has_flag(array, "aligned"); }

std::string described(const py::array& array) {
    return py::str("{} of shape {}{}{}")
        .format(array.dtype(), array.attr("shape"), contiguous(array) ? "" : ", not C-contiguous",
                aligned(array) ? "" : ", not aligned");
}

template <typename T>
ImageView<T> view_of(T* data, const py::array& array) {
    return {.data = data,
            .height = static_cast<int>(array.shape(0)),
            .width = static_cast<int>(array.shape(1)),
            .channels = static_cast<int>(array.shape(2))};
}

// Inputs are read alone: numpy's read-only arrays are welcome.
ConstImage image_from_array(const std::string& name, const py::array& array) {
    constexpr py::ssize_t limit = 100'000'000;  // times the channels of an image, it is still an int
    const std::string expected =
        name + ": expected an aligned C-contiguous float32 array of shape (height, width, channels), up to " +
        std::to_string(limit) + " each, got ";
    if (!py::isinstance<py::array_t<float>>(array)) throw py::type_error(expected + described(array));
    if (array.ndim() != 3 || !contiguous(array) || !aligned(array) || array.shape(0) > limit ||
        array.shape(1) > limit || array.shape(2) > limit) {
        throw py::value_error(expected + described(array));
    }
    return view_of(static_cast<const float*>(array.data()), array);
}

using OptionalArray = std::optional<py::array>;

ConstImage image_from_array(const std::string& name, const OptionalArray& array) {
    return array ? image_from_array(name, *array) : ConstImage{};
}

ConstBuffer buffer_from_arrays(const py::array& mean, const OptionalArray& half_a,
                               const OptionalArray& half_b, const OptionalArray& variance) {
    return {.mean = image_from_array("mean", mean),
            .half_a = image_from_array("half_a", half_a),
            .half_b = image_from_array("half_b", half_b),
            .variance = image_from_array("variance", variance)};
}

Image view_of(Array& out) { return view_of(out.mutable_data(), out); }
Array array_like(ConstImage image) { return Array({image.height, image.width, image.channels}); }

// Returns the images, those with defects as mended copies, and the defects of each.
py::tuple sanitize(const std::string& quantity_name, const py::array& mean, const OptionalArray& half_a,
                   const OptionalArray& half_b, const OptionalArray& variance, int threads) {
    const std::optional<Quantity> quantity = quantity_from_name(quantity_name);
    if (!quantity) {
        throw py::value_error(py::str("quantity: expected one of {}, got {}")
                                  .format(py::str(", ").attr("join")(quantity_names), quantity_name));
    }
    const ConstBuffer buffer = buffer_from_arrays(mean, half_a, half_b, variance);
    BufferDefects defects;
    {
        const py::gil_scoped_release release;
        defects = find_defects(buffer, *quantity, threads);
    }
    Buffer mended;
    const auto copied_if_defective = [](const OptionalArray& array, const Defects& found, Image& view) {
        if (!array) return py::object(py::none());
        const py::array image = found.any() ? py::array(array->attr("copy")()) : *array;
        // `mend` writes to no image without defects.
        view = view_of(static_cast<float*>(const_cast<void*>(image.data())), image);
        return py::object(image);
    };
    const py::tuple images = py::make_tuple(copied_if_defective(mean, defects.mean, mended.mean),
                                            copied_if_defective(half_a, defects.half_a, mended.half_a),
                                            copied_if_defective(half_b, defects.half_b, mended.half_b),
                                            copied_if_defective(variance, defects.variance, mended.variance));
    if (defects.any()) {
        const py::gil_scoped_release release;
        mend(mended, *quantity);
    }
    return py::make_tuple(images,
                          py::make_tuple(defects.mean, defects.half_a, defects.half_b, defects.variance));
}

HalvesTest compare_halves_arrays(const py::array& half_a, const py::array& half_b,
                                 const OptionalArray& variance, int threads) {
    const ConstImage image_a = image_from_array("half_a", half_a);
    const ConstImage image_b = image_from_array("half_b", half_b);
    const ConstImage variance_image = image_from_array("variance", variance);
    const py::gil_scoped_release release;
    return compare_halves(image_a, image_b, variance_image, threads);
}

py::tuple prefilter_feature_arrays(const py::array& mean, const py::array& half_a, const py::array& half_b,
                                   const OptionalArray& variance, int radius, int step, float k,
                                   int threads) {
    const ConstBuffer in = buffer_from_arrays(mean, half_a, half_b, variance);
    std::array<Array, 4> images{array_like(in.mean), array_like(in.mean), array_like(in.mean),
                                array_like(in.mean)};
    const Buffer out{.mean = view_of(images[0]),
                     .half_a = view_of(images[1]),
                     .half_b = view_of(images[2]),
                     .variance = view_of(images[3])};
    {
        const py::gil_scoped_release release;
        prefilter_feature(in, out, {.radius = radius, .step = step}, k, threads);
    }
    return py::make_tuple(images[0], images[1], images[2], images[3]);
}

Array box_mean_array(const py::array& in, int radius, int threads) {
    const ConstImage image = image_from_array("image", in);
    Array out = array_like(image);
    const Image out_image = view_of(out);
    const py::gil_scoped_release release;
    box_mean(image, radius, out_image, threads);
    return out;
}

Array regress_arrays(const py::array& target, const py::array& features, const std::vector<float>& penalty,
                     const OptionalArray& guide, const OptionalArray& guide_variance, int radius, int step,
                     float k, int threads) {
    const ConstImage target_image = image_from_array("target", target);
    const ConstImage feature_image = image_from_array("features", features);
    if (guide.has_value() != guide_variance.has_value())
        throw py::value_error("guide and guide_variance: expected both or neither, got one");
    std::optional<Guide> guide_images;
    if (guide) {
        guide_images = Guide{.image = image_from_array("guide", *guide),
                             .variance = image_from_array("guide_variance", *guide_variance),
                             .k = k};
    }
    Array out = array_like(target_image);
    const Image out_image = view_of(out);
    const py::gil_scoped_release release;
    regress(target_image, feature_image, penalty, guide_images, {.radius = radius, .step = step}, out_image,
            threads);
    return out;
}

Array structure_tensor_array(const py::array& features, int threads) {
    const ConstImage in = image_from_array("features", features);
    Array out({in.height, in.width, 3});
    const Image out_image = view_of(out);
    const py::gil_scoped_release release;
    structure_tensor(in, out_image, threads);
    return out;
}

Array smooth_along_edges_array(const py::array& image, const py::array& tensor, float along, float across,
                               int threads) {
    const ConstImage in = image_from_array("image", image);
    const ConstImage tensor_image = image_from_array("tensor", tensor);
    Array out = array_like(in);
    const Image out_image = view_of(out);
    const py::gil_scoped_release release;
    smooth_along_edges(in, tensor_image, along, across, out_image, threads);
    return out;
}

using Numbers = py::array_t<BFloat16, py::array::c_style>;

// Takes an image in bfloat16, as bits, and its norm.
NormAct norm_from_arrays(const Numbers& x, const Array& weight, const Array& bias, float epsilon,
                         float slope) {
    if (x.ndim() != 2 || x.shape(1) == 0 || x.shape(0) == 0 || weight.size() != x.shape(1) ||
        bias.size() != x.shape(1)) {
        throw py::value_error(
            "x, weight, bias: expected shape (pixels, channels) without a 0, and one weight and bias for "
            "each "
            "channel, got " +
            described(x) + ", " + described(weight) + ", " + described(bias));
    }
    return {.pixels = static_cast<std::size_t>(x.shape(0)),
            .channels = static_cast<std::size_t>(x.shape(1)),
            .weight = weight.data(),
            .bias = bias.data(),
            .epsilon = epsilon,
            .slope = slope};
}

py::tuple norm_act_arrays(const Numbers& x, const Array& weight, const Array& bias, float epsilon,
                          float slope) {
    const NormAct norm = norm_from_arrays(x, weight, bias, epsilon, slope);
    Numbers y({x.shape(0), x.shape(1)});
    Array mean(x.shape(1));
    Array scale(x.shape(1));
    const auto [from, to] = std::pair(x.data(), y.mutable_data());
    const auto [means, scales] = std::pair(mean.mutable_data(), scale.mutable_data());
    {
        const py::gil_scoped_release release;
        norm_act(norm, from, to, means, scales);
    }
    return py::make_tuple(y, mean, scale);
}

py::tuple norm_act_gradient_arrays(const Numbers& gradient, const Numbers& x, const Array& weight,
                                   const Array& bias, float epsilon, float slope, const Numbers& y,
                                   const Array& mean, const Array& scale) {
    const NormAct norm = norm_from_arrays(x, weight, bias, epsilon, slope);
    const auto in_shape_of_x = [&](const Numbers& image) {
        return image.ndim() == 2 && image.shape(0) == x.shape(0) && image.shape(1) == x.shape(1);
    };
    if (!in_shape_of_x(y) || !in_shape_of_x(gradient) || mean.size() != x.shape(1) ||
        scale.size() != x.shape(1)) {
        throw py::value_error(
            "gradient, y, mean, scale: expected two images in the shape of x and two values for each of its "
            "channels, got " +
            described(gradient) + ", " + described(y) + ", " + described(mean) + ", " + described(scale));
    }
    Numbers by_x({x.shape(0), x.shape(1)});
    Array by_weight(x.shape(1));
    Array by_bias(x.shape(1));
    const BFloat16* by_y = gradient.data();
    const Normed normed{.x = x.data(), .y = y.data(), .mean = mean.data(), .scale = scale.data()};
    const NormActGradients out{
        .x = by_x.mutable_data(), .weight = by_weight.mutable_data(), .bias = by_bias.mutable_data()};
    {
        const py::gil_scoped_release release;
        norm_act_gradient(by_y, norm, normed, out);
    }
    return py::make_tuple(by_x, by_weight, by_bias);
}

}  // namespace
}  // namespace tungsten_dip

PYBIND11_MODULE(_core, module) {
    using namespace tungsten_dip;  // NOLINT(google-build-using-namespace): a scope of declarations alone
    module.doc() = "The core of tungsten-dip in C++. _core.pyi documents it; use tungsten_dip.buffers.";

    module.attr("INFINITE_DEPTH") = infinite_depth;
    module.attr("INFINITE_RADIANCE") = infinite_radiance;

    py::class_<Defects>(module, "Defects")
        .def_readonly("nan", &Defects::nan)
        .def_readonly("infinite", &Defects::infinite)
        .def_readonly("negative", &Defects::negative);
    py::class_<HalvesTest>(module, "HalvesTest")
        .def(py::init<>())
        .def_readonly("correlation", &HalvesTest::correlation)
        .def_readonly("variance_ratio", &HalvesTest::variance_ratio)
        .def_readonly("variance_fits", &HalvesTest::variance_fits)
        .def_readonly("independent", &HalvesTest::independent);

    module.def("sanitize", &sanitize, py::arg("quantity"), py::arg("mean"), py::arg("half_a"),
               py::arg("half_b"), py::arg("variance"), py::arg("threads"));
    module.def("compare_halves", &compare_halves_arrays, py::arg("half_a"), py::arg("half_b"),
               py::arg("variance"), py::arg("threads"));
    module.def("prefilter_feature", &prefilter_feature_arrays, py::arg("mean"), py::arg("half_a"),
               py::arg("half_b"), py::arg("variance"), py::kw_only(), py::arg("radius"), py::arg("step"),
               py::arg("k"), py::arg("threads"));
    module.def("box_mean", &box_mean_array, py::arg("image"), py::arg("radius"), py::arg("threads"));
    module.def("regress", &regress_arrays, py::arg("target"), py::arg("features"), py::arg("penalty"),
               py::arg("guide") = py::none(), py::arg("guide_variance") = py::none(), py::kw_only(),
               py::arg("radius"), py::arg("step"), py::arg("k") = 1.0F, py::arg("threads"));
    module.def("structure_tensor", &structure_tensor_array, py::arg("features"), py::arg("threads"));
    module.def("smooth_along_edges", &smooth_along_edges_array, py::arg("image"), py::arg("tensor"),
               py::kw_only(), py::arg("along"), py::arg("across"), py::arg("threads"));
    module.def("norm_act", &norm_act_arrays, py::arg("x").noconvert(), py::arg("weight").noconvert(),
               py::arg("bias").noconvert(), py::arg("epsilon"), py::arg("slope"));
    module.def("norm_act_gradient", &norm_act_gradient_arrays, py::arg("gradient").noconvert(),
               py::arg("x").noconvert(), py::arg("weight").noconvert(), py::arg("bias").noconvert(),
               py::arg("epsilon"), py::arg("slope"), py::arg("y").noconvert(), py::arg("mean").noconvert(),
               py::arg("scale").noconvert());
}
