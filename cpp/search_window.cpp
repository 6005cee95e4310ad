// What windows filters can search.
#include <cmath>
#include <stdexcept>
#include <string>

#include "core.hpp"

namespace tungsten_dip {

void SearchWindow::check() const {
    // Patches are compared in units of k^2.
    if (radius >= 0 && radius <= max_radius && step >= 1 && step <= max_radius && radius % step == 0 &&
        k > 0 && std::isfinite(k * k)) {
        return;
    }
    const std::string largest = std::to_string(max_radius);
    throw std::invalid_argument("expected a radius of 0 to " + largest +
                                " that is a multiple of the step, a step of 1 to " + largest +
                                ", and a finite k above 0, got " + std::to_string(radius) + ", " +
                                std::to_string(step) + " and " + std::to_string(k));
}

}  // namespace tungsten_dip
