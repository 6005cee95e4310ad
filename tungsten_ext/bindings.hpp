// What Python sees of the hook; the same for the importable module and for the one inside the native command.
#pragma once

#include <pybind11/pybind11.h>

namespace tungsten_dip {

void bind(const pybind11::module_& module);

}  // namespace tungsten_dip
