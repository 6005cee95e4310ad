// tungsten_dip._tungsten, importable where Tungsten's static libraries are position-independent.
#include "bindings.hpp"

PYBIND11_MODULE(_tungsten, module) { tungsten_dip::bind(module); }
