// The Python module _core: the only file that knows pybind11.
#include <pybind11/pybind11.h>
#include "core.hpp"
PYBIND11_MODULE(_core, module) { module.attr("__version__") = TUNGSTEN_DIP_VERSION; }
