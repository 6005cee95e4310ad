// The mean over a window, against values that are known.
#include "check.hpp"
#include "core.hpp"
#include "pixels.hpp"

using namespace tungsten_dip;

namespace {

void it_is_clipped_at_borders() {
    Pixels ramp(1, 5, 2);
    for (int x = 0; x < 5; ++x) ramp.at(0, x, 1) = static_cast<float>(x);
    Pixels out(1, 5, 2, -1.0F);
    box_mean(ramp.view(), 1, out.view(), 1);
    CHECK_EQUAL(out.at(0, 0, 1), 0.5F);
    CHECK_EQUAL(out.at(0, 2, 1), 2);
    CHECK_EQUAL(out.at(0, 4, 1), 3.5F);
    CHECK_EQUAL(out.at(0, 3, 0), 0);

    Pixels impulse(7, 6, 1);
    impulse.at(3, 3) = 25;
    Pixels spread(7, 6, 1);
    box_mean(impulse.view(), 2, spread.view(), 3);
    CHECK_NEAR(spread.at(3, 3), 1, 1e-6);
    CHECK_NEAR(spread.at(1, 3), 1.25, 1e-6);
    CHECK_EQUAL(spread.at(0, 3), 0);
    CHECK_NEAR(spread.at(3, 5), 25.0 / 15, 1e-5);
}

}  // namespace

int main() {
    it_is_clipped_at_borders();
    return failed_checks();
}
