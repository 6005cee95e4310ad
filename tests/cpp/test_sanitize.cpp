// Mending: each kind of defect, rebuilt from what is known of it, and nothing else touched.
#include <limits>
#include <utility>

#include "check.hpp"
#include "core.hpp"
#include "pixels.hpp"

using namespace tungsten_dip;

namespace {

constexpr float nan = std::numeric_limits<float>::quiet_NaN();
constexpr float inf = std::numeric_limits<float>::infinity();

Buffer only_mean(Pixels& mean) { return {.mean = mean.view(), .half_a = {}, .half_b = {}, .variance = {}}; }

void sane_values_stay() {
    Pixels mean(3, 5, 3, 1e30F);
    mean.at(0, 0) = 0.0F;
    mean.at(1, 1) = 65504.0F;
    mean.at(2, 2) = std::numeric_limits<float>::denorm_min();
    const Pixels before = mean;
    CHECK(!find_defects(only_mean(mean), Quantity::color, 1).mean.any());
    mend(only_mean(mean), Quantity::color);
    CHECK(mean == before);
}

void counts_by_kind() {
    Pixels mean(2, 3, 1, 1.0F);
    mean.at(0, 0) = nan;
    mean.at(0, 1) = -inf;
    mean.at(1, 0) = inf;
    mean.at(1, 2) = -2.0F;
    const Defects color = find_defects(only_mean(mean), Quantity::color, 2).mean;
    CHECK_EQUAL(color.nan, 1);
    CHECK_EQUAL(color.infinite, 2);
    CHECK_EQUAL(color.negative, 1);
    const Defects normal = find_defects(only_mean(mean), Quantity::normal, 1).mean;
    CHECK_EQUAL(normal.nan, 1);
    CHECK_EQUAL(normal.infinite, 2);
    CHECK_EQUAL(normal.negative, 0);
}

void mean_and_halves_follow_from_one_another() {
    Render render(1, 4, 4, 1, [](auto&) { return 0.0; });
    render.half_a.at(0, 0) = 2;
    render.half_b.at(0, 0) = 4;
    render.mean.at(0, 0) = inf;
    render.mean.at(0, 1) = 3;
    render.half_a.at(0, 1) = 5;
    render.half_b.at(0, 1) = nan;
    render.mean.at(0, 2) = 3;
    render.half_a.at(0, 2) = inf;
    render.half_b.at(0, 2) = 8;  // 2 * 3 - 8 is negative: 0
    mend(render.buffer(), Quantity::color);
    CHECK_EQUAL(render.mean.at(0, 0), 3);
    CHECK_EQUAL(render.half_b.at(0, 1), 1);
    CHECK_EQUAL(render.half_a.at(0, 2), 0);
    CHECK_EQUAL(render.mean.at(0, 3), 1);
    CHECK_EQUAL(render.half_a.at(0, 3), 1);
    CHECK_EQUAL(render.half_b.at(0, 3), 1);
}

void lost_values_come_from_the_neighbours() {
    Pixels mean(3, 3, 1, 2.0F);
    mean.at(0, 0) = 1000;  // the median ignores a firefly
    mean.at(1, 1) = nan;
    mend(only_mean(mean), Quantity::color);
    CHECK_EQUAL(mean.at(1, 1), 2);

    Pixels hole(40, 40, 1, nan);
    hole.at(0, 0) = 5;
    mend(only_mean(hole), Quantity::color);
    CHECK_EQUAL(hole.at(16, 16), 5);
    CHECK_EQUAL(hole.at(17, 17), 0);

    Pixels single(1, 1, 3, nan);
    mend(only_mean(single), Quantity::normal);
    CHECK(single == Pixels(1, 1, 3, 0.0F));
}

void the_sky_has_depth_0() {
    Render render(1, 3, 4, 1, [](auto&) { return 0.0; });
    for (Pixels* plane : {&render.mean, &render.half_a, &render.half_b}) plane->at(0, 0) = 1e10F;
    render.mean.at(0, 1) = inf;
    render.half_a.at(0, 1) = inf;
    render.half_b.at(0, 1) = 6;
    CHECK_EQUAL(find_defects(render.buffer(), Quantity::depth, 1).mean.infinite, 2);
    mend(render.buffer(), Quantity::depth);
    CHECK_EQUAL(render.mean.at(0, 0), 0);
    CHECK_EQUAL(render.half_a.at(0, 0), 0);
    CHECK_EQUAL(render.half_b.at(0, 0), 0);
    CHECK_EQUAL(render.mean.at(0, 1), 3);
    CHECK_EQUAL(render.half_a.at(0, 1), 0);
    CHECK_EQUAL(render.half_b.at(0, 1), 6);

    Pixels mean(1, 2, 1, 4.0F);
    mean.at(0, 0) = inf;
    mend(only_mean(mean), Quantity::depth);
    CHECK_EQUAL(mean.at(0, 0), 0);
    CHECK_EQUAL(mean.at(0, 1), 4);

    Pixels beside_nan(1, 1, 1, 1e10F);
    Pixels half_a(1, 1, 1, nan);
    Pixels half_b(1, 1, 1, 1.0F);
    mend({.mean = beside_nan.view(), .half_a = half_a.view(), .half_b = half_b.view(), .variance = {}},
         Quantity::depth);
    CHECK_EQUAL(beside_nan.at(0, 0), 1);
    CHECK_EQUAL(half_a.at(0, 0), 1);
    CHECK_EQUAL(half_b.at(0, 0), 1);
}

// Where no neighbour is sane either, what one plane knows is not lost.
void a_sane_plane_stands_for_the_others() {
    Pixels mean(40, 40, 3, nan);
    Pixels half_a(40, 40, 3, inf);
    Pixels half_b(40, 40, 3, 2.0F);
    mend({.mean = mean.view(), .half_a = half_a.view(), .half_b = half_b.view(), .variance = {}},
         Quantity::color);
    CHECK_EQUAL(mean.at(20, 20), 2);
    CHECK_EQUAL(half_a.at(20, 20), 2);
    CHECK_EQUAL(half_b.at(20, 20), 2);

    Pixels known(3, 3, 1, 5.0F);
    Pixels lost_a(3, 3, 1, 4.0F);
    Pixels lost_b(3, 3, 1, 6.0F);
    lost_a.at(1, 1) = nan;
    lost_b.at(1, 1) = nan;
    mend({.mean = known.view(), .half_a = lost_a.view(), .half_b = lost_b.view(), .variance = {}},
         Quantity::color);
    CHECK_EQUAL(known.at(1, 1), 5);
    CHECK_EQUAL(lost_a.at(1, 1), 5);
    CHECK_EQUAL(lost_b.at(1, 1), 5);

    Pixels nothing(40, 40, 1, nan);
    mend(only_mean(nothing), Quantity::color);
    CHECK_EQUAL(nothing.at(20, 20), 0);
}

void lobes_keep_the_light_around_them() {
    Pixels mean(1, 5, 1, 4.0F);
    mean.at(0, 1) = -1;
    mean.at(0, 3) = -3;  // as much as no lobe takes from 4 + 4 beside it
    mend(only_mean(mean), Quantity::color);
    CHECK_EQUAL(mean.at(0, 0), 3.5F);
    CHECK_EQUAL(mean.at(0, 1), 0);
    CHECK_EQUAL(mean.at(0, 2), 3.5F);
    CHECK_EQUAL(mean.at(0, 3), 0);
    CHECK_EQUAL(mean.at(0, 4), 4);

    Pixels albedo(1, 3, 1, 4.0F);
    albedo.at(0, 1) = -1;
    mend(only_mean(albedo), Quantity::albedo);
    CHECK_EQUAL(albedo.at(0, 0), 4);
    CHECK_EQUAL(albedo.at(0, 1), 0);

    Pixels alone(1, 1, 1, -1.0F);
    mend(only_mean(alone), Quantity::color);
    CHECK_EQUAL(alone.at(0, 0), 0);

    Pixels wild(1, 3, 1, inf);
    wild.at(0, 0) = -inf;
    wild.at(0, 1) = -1;
    mend(only_mean(wild), Quantity::color);
    CHECK_EQUAL(wild.at(0, 1), 0);
}

void wild_normals_come_from_the_neighbours() {
    Pixels normal(1, 3, 3, 0.6F);
    normal.at(0, 1) = 1e19F;
    CHECK_EQUAL(find_defects(only_mean(normal), Quantity::normal, 1).mean.infinite, 1);
    mend(only_mean(normal), Quantity::normal);
    CHECK_EQUAL(normal.at(0, 1), 0.6F);
}

void variance_follows_from_the_halves() {
    Render render(3, 3, 4, 1, [](auto&) { return 0.0; });
    render.half_a.at(1, 1) = 601;
    render.half_b.at(1, 1) = 1;  // (601 - 1)^2 / 4 = 90000 overflows half floats
    render.variance.at(1, 1) = inf;
    render.variance.at(0, 0) = nan;
    render.variance.at(2, 2) = -1;
    mend(render.buffer(), Quantity::color);
    CHECK_EQUAL(render.variance.at(1, 1), 90000);
    CHECK_EQUAL(render.variance.at(0, 0), 22500);
    CHECK_EQUAL(render.variance.at(2, 2), 22500);
    CHECK_EQUAL(render.variance.at(0, 1), 0);

    Pixels mean(1, 3, 1, 1.0F);
    Pixels variance(1, 3, 1, 0.5F);
    variance.at(0, 1) = inf;
    variance.at(0, 2) = 0.75F;
    mend({.mean = mean.view(), .half_a = {}, .half_b = {}, .variance = variance.view()}, Quantity::albedo);
    CHECK_EQUAL(variance.at(0, 1), 0.75F);
}

void empty_images_are_fine() {
    for (const auto& [height, width] : {std::pair{0, 4}, std::pair{4, 0}, std::pair{0, 0}}) {
        Pixels mean(height, width, 3);
        CHECK(!find_defects(only_mean(mean), Quantity::color, 2).mean.any());
        mend(only_mean(mean), Quantity::color);
    }
}

}  // namespace

int main() {
    sane_values_stay();
    counts_by_kind();
    mean_and_halves_follow_from_one_another();
    lost_values_come_from_the_neighbours();
    the_sky_has_depth_0();
    a_sane_plane_stands_for_the_others();
    lobes_keep_the_light_around_them();
    wild_normals_come_from_the_neighbours();
    variance_follows_from_the_halves();
    empty_images_are_fine();
    return failed_checks();
}
