// What is refused before anything is computed: images of other shapes, which would be read out of bounds, and
// numbers of no use. The message names the argument, what was expected and what came.
#include <limits>
#include <optional>
#include <string>
#include <vector>

#include "check.hpp"
#include "core.hpp"
#include "pixels.hpp"

using namespace tungsten_dip;

namespace {

constexpr float infinity = std::numeric_limits<float>::infinity();
constexpr float nan = std::numeric_limits<float>::quiet_NaN();

void buffers_have_one_shape() {
    Pixels mean(4, 5, 3);
    Pixels small(4, 4, 3);
    Pixels gray(4, 5, 1);
    const Buffer other_half{
        .mean = mean.view(), .half_a = mean.view(), .half_b = small.view(), .variance = {}};
    const std::string half_b = "half_b: expected the shape of mean, (4, 5, 3), got (4, 4, 3)";
    CHECK_EQUAL(refusal([&] { (void)find_defects(other_half, Quantity::color, 1); }), half_b);
    CHECK_EQUAL(refusal([&] { mend(other_half, Quantity::color); }), half_b);
    const Buffer other_variance{.mean = mean.view(), .half_a = {}, .half_b = {}, .variance = gray.view()};
    const std::string variance = "variance: expected the shape of mean, (4, 5, 3), got (4, 5, 1)";
    CHECK_EQUAL(refusal([&] { mend(other_variance, Quantity::color); }), variance);

    constexpr SearchWindow window{.radius = 1, .step = 1};
    const auto prefilter = [&](const Buffer& in, const Buffer& out) {
        return refusal([&] { prefilter_feature(in, out, window, 1, 1); });
    };
    Pixels result(4, 5, 3);
    const Buffer out{
        .mean = result.view(), .half_a = result.view(), .half_b = result.view(), .variance = result.view()};
    CHECK_EQUAL(prefilter(other_half, out), half_b);
    CHECK_EQUAL(prefilter({.mean = mean.view(), .half_a = mean.view(), .half_b = {}, .variance = {}}, out),
                "half_a and half_b: expected both, got one or none");
    Buffer without_variance = out;
    without_variance.variance = {};
    const Buffer in{.mean = mean.view(), .half_a = mean.view(), .half_b = mean.view(), .variance = {}};
    CHECK_EQUAL(prefilter(in, without_variance),
                "out.variance: expected the shape of mean, (4, 5, 3), got (0, 0, 0)");
}

void halves_have_one_shape() {
    Pixels a(4, 5, 3);
    Pixels small(3, 5, 3);
    const std::string half_b = "half_b: expected the shape of half_a, (4, 5, 3), got (3, 5, 3)";
    CHECK_EQUAL(refusal([&] { halves_variance(a.view(), small.view(), a.view(), 1); }), half_b);
    CHECK_EQUAL(refusal([&] { halves_variance(a.view(), a.view(), small.view(), 1); }),
                "out: expected the shape of half_a, (4, 5, 3), got (3, 5, 3)");
    CHECK_EQUAL(refusal([&] { (void)compare_halves(a.view(), small.view(), {}, 1); }), half_b);
    CHECK_EQUAL(refusal([&] { (void)compare_halves(a.view(), a.view(), small.view(), 1); }),
                "variance: expected the shape of half_a, (4, 5, 3), got (3, 5, 3)");
}

void results_have_the_shape_of_what_they_are_computed_from() {
    Pixels image(4, 5, 3);
    Pixels small(3, 5, 3);
    Pixels gray(4, 5, 1);
    CHECK_EQUAL(refusal([&] { box_mean(image.view(), 1, small.view(), 1); }),
                "out: expected the shape of image, (4, 5, 3), got (3, 5, 3)");
    CHECK_EQUAL(refusal([&] { box_mean(image.view(), -1, image.view(), 1); }),
                "radius: expected 0 or more, got -1");
    CHECK_EQUAL(refusal([&] { structure_tensor(image.view(), small.view(), 1); }),
                "out: expected the height and width of features, (4, 5), got (3, 5)");
    CHECK_EQUAL(refusal([&] { structure_tensor(image.view(), gray.view(), 1); }),
                "out: expected 3 channels, got 1");
    const auto smooth = [&](Pixels& tensor, Pixels& out) {
        return refusal([&] { smooth_along_edges(image.view(), tensor.view(), 3, 1, out.view(), 1); });
    };
    CHECK_EQUAL(smooth(small, image), "tensor: expected the height and width of image, (4, 5), got (3, 5)");
    CHECK_EQUAL(smooth(gray, image), "tensor: expected 3 channels, got 1");
    CHECK_EQUAL(smooth(image, gray), "out: expected the shape of image, (4, 5, 3), got (4, 5, 1)");
}

void gaussians_are_neither_too_narrow_nor_too_wide() {
    Pixels image(1, 1, 3);
    Pixels out(1, 1, 3);
    const auto smooth = [&](float along, float across) {
        return refusal([&] { smooth_along_edges(image.view(), image.view(), along, across, out.view(), 1); });
    };
    CHECK_EQUAL(smooth(3, 0.3F), "");
    CHECK_EQUAL(smooth(128, 0.01F), "");
    for (const float along : {0.0F, 129.0F, infinity, nan}) CHECK(!smooth(along, 0.3F).empty());
    for (const float across : {0.0F, 1e-30F, infinity, nan}) CHECK(!smooth(3, across).empty());
}

struct Task {
    Pixels target{3, 4, 3};
    Pixels features{3, 4, 2};
    std::vector<float> penalty{0.1F, 0.1F};
    std::optional<Guide> guide = std::nullopt;
    SearchWindow window{.radius = 4, .step = 2};
    Pixels out{3, 4, 3};
};

std::string refused(Task task) {
    return refusal([&] {
        regress(task.target.view(), task.features.view(), task.penalty, task.guide, task.window,
                task.out.view(), 1);
    });
}

void regressions_take_what_fits_together() {
    CHECK_EQUAL(refused({}), "");
    const auto with_features = [](int count) {
        return Task{.features{3, 4, count}, .penalty = std::vector(static_cast<std::size_t>(count), 0.1F)};
    };
    CHECK_EQUAL(refused(with_features(16)), "");
    CHECK_EQUAL(refused(with_features(17)), "features: expected up to 16 channels, got 17");
    CHECK_EQUAL(refused({.target{3, 4, 1}}), "target: expected 3 channels, got 1");
    CHECK_EQUAL(refused({.features{4, 3, 2}}),
                "features: expected the height and width of target, (3, 4), got (4, 3)");
    CHECK_EQUAL(refused({.penalty{0.1F}}), "penalty: expected one value per feature, 2, got 1");
    for (const float value : {-1.0F, infinity, nan})
        CHECK(refused({.penalty{0.1F, value}}).starts_with("penalty: expected finite numbers from 0 on"));
    CHECK_EQUAL(refused({.out{3, 4, 1}}), "out: expected the shape of target, (3, 4, 3), got (3, 4, 1)");
}

void guides_fit_the_target_and_their_variance() {
    Pixels image(3, 4, 2);
    Pixels small(2, 4, 2);
    Pixels nothing(3, 4, 0);
    const auto with_guide = [](Pixels& guide, Pixels& variance, float k) {
        return refused({.guide = Guide{.image = guide.view(), .variance = variance.view(), .k = k}});
    };
    CHECK_EQUAL(with_guide(image, image, 1), "");
    CHECK_EQUAL(with_guide(small, small, 1),
                "guide: expected the height and width of target, (3, 4), got (2, 4)");
    CHECK_EQUAL(with_guide(image, small, 1),
                "guide_variance: expected the shape of guide, (3, 4, 2), got (2, 4, 2)");
    CHECK_EQUAL(with_guide(nothing, nothing, 1), "guide: expected 1 channel or more, got 0");
    CHECK_EQUAL(with_guide(image, image, 0), "k: expected a number above 0 with a finite square, got 0");
    for (const float k : {-1.0F, 1e30F, infinity, nan}) CHECK(with_guide(image, image, k).starts_with("k: "));
}

void windows_can_be_searched() {
    const auto with_window = [](int radius, int step) {
        return refused({.window{.radius = radius, .step = step}});
    };
    constexpr int largest = std::numeric_limits<int>::max();
    CHECK_EQUAL(with_window(max_radius, max_radius), "");
    CHECK_EQUAL(with_window(3, 2), "radius: expected 0 to 256, a multiple of the step 2, got 3");
    for (const int radius : {-1, max_radius + 1, largest})
        CHECK(with_window(radius, 1).starts_with("radius: "));
    CHECK_EQUAL(with_window(4, 0), "step: expected 1 to 256, got 0");
    for (const int step : {-1, largest}) CHECK(with_window(0, step).starts_with("step: "));
}

void somebody_has_to_work() {
    for (const int threads : {0, -1}) {
        CHECK_EQUAL(refusal([&] { parallel_for(10, threads, [](int) {}); }),
                    "threads: expected a whole number from 1 on, got " + std::to_string(threads));
    }
}

}  // namespace

int main() {
    buffers_have_one_shape();
    halves_have_one_shape();
    results_have_the_shape_of_what_they_are_computed_from();
    gaussians_are_neither_too_narrow_nor_too_wide();
    regressions_take_what_fits_together();
    guides_fit_the_target_and_their_variance();
    windows_can_be_searched();
    somebody_has_to_work();
    return failed_checks();
}
