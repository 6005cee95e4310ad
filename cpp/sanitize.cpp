// Finds and mends values that no renderer can have meant. Nothing else is clamped, however large.
#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <utility>
#include <vector>

#include "checks.hpp"
#include "core.hpp"
#include "fastest.hpp"

namespace tungsten_dip {
namespace {

// Squares of what is beyond these overflow.
constexpr float infinite_normal = 1e6F;
constexpr float infinite_albedo = 1e12F;  // which holds the radiance of lights, too
constexpr int reach = 16;                 // how far a sane pixel may be from the one it mends
// Of the radiance around, the largest part that a filter's negative lobe takes away; more is no lobe.
constexpr double largest_lobe = 0.25;

struct Rules {
    bool nonnegative;
    float infinite_from;  // values of this magnitude and more stand for infinity

    [[nodiscard]] bool sane(float value) const {
        return std::abs(value) < infinite_from && (value >= 0 || !nonnegative);
    }
};

Rules value_rules(Quantity quantity) {
    switch (quantity) {
        case Quantity::normal:
            return {.nonnegative = false, .infinite_from = infinite_normal};
        case Quantity::depth:
            return {.nonnegative = true, .infinite_from = infinite_depth};
        case Quantity::albedo:
        case Quantity::visibility:
            return {.nonnegative = true, .infinite_from = infinite_albedo};
        case Quantity::color:
            break;
    }
    return {.nonnegative = true, .infinite_from = infinite_radiance};
}

Rules variance_rules(Quantity quantity) {
    const float largest = value_rules(quantity).infinite_from;
    return {.nonnegative = true, .infinite_from = largest * largest};
}

// Without a branch for each value, since nearly always this is all that is asked.
TUNGSTEN_DIP_FASTEST bool all_sane(const float* values, std::ptrdiff_t count, Rules rules) {
    int insane = 0;
    for (std::ptrdiff_t i = 0; i < count; ++i) insane += rules.sane(values[i]) ? 0 : 1;
    return insane == 0;
}

Defects find_defects(ConstImage image, Rules rules, int threads) {
    if (!image.known()) return {};
    std::vector<Defects> rows(static_cast<std::size_t>(image.height));
    parallel_for(image.height, threads, [&](int y) {
        if (all_sane(image.row(y), image.row_size(), rules)) return;
        Defects found;
        for (const float* value = image.row(y); value != image.row(y) + image.row_size(); ++value) {
            if (rules.sane(*value)) continue;
            if (std::isnan(*value)) {
                ++found.nan;
            } else if (std::abs(*value) >= rules.infinite_from) {
                ++found.infinite;
            } else {
                ++found.negative;
            }
        }
        rows[static_cast<std::size_t>(y)] = found;
    });
    Defects sum;
    for (const Defects& row : rows) {
        sum.nan += row.nan;
        sum.infinite += row.infinite;
        sum.negative += row.negative;
    }
    return sum;
}

struct Position {
    int y, x, c;
};

// Calls visit(y, x) for the pixels of the 3x3 window around a position that are inside the image.
template <typename Visit>
void for_neighbourhood(const Image& image, Position at, const Visit& visit) {
    for (int y = std::max(at.y - 1, 0); y <= std::min(at.y + 1, image.height - 1); ++y) {
        for (int x = std::max(at.x - 1, 0); x <= std::min(at.x + 1, image.width - 1); ++x) visit(y, x);
    }
}

template <typename Visit>
void for_each_position(const Image& image, const Visit& visit) {
    for (int y = 0; y < image.height; ++y) {
        for (int x = 0; x < image.width; ++x) {
            for (int c = 0; c < image.channels; ++c) visit(Position{.y = y, .x = x, .c = c});
        }
    }
}

float lower_median(std::array<float, 9>& values, int count) {
    float* const middle = values.data() + (count - 1) / 2;
    std::nth_element(values.data(), middle, values.data() + count);
    return *middle;
}

float maximum(std::array<float, 9>& values, int count) {
    return *std::max_element(values.begin(), values.begin() + count);
}

// Fills non-finite values from the finite ones around, ring by ring; those out of reach stay as they are.
template <typename Pick>
void fill_from_neighbours(const Image& image, std::vector<Position> pending, const Pick& pick) {
    std::vector<float> filled;
    for (int ring = 0; ring < reach && !pending.empty(); ++ring) {
        filled.clear();
        for (const Position at : pending) {
            std::array<float, 9> sane{};
            int count = 0;
            for_neighbourhood(image, at, [&](int y, int x) {
                const float value = image.at(y, x, at.c);
                if (std::isfinite(value)) sane.at(static_cast<std::size_t>(count++)) = value;
            });
            filled.push_back(count > 0 ? pick(sane, count) : std::numeric_limits<float>::quiet_NaN());
        }
        std::vector<Position> left;
        for (std::size_t i = 0; i < pending.size(); ++i) {
            const Position at = pending[i];
            image.at(at.y, at.x, at.c) = filled[i];
            if (!std::isfinite(filled[i])) left.push_back(at);
        }
        pending = std::move(left);
    }
}

// Fills what is left with the values of another image, and with 0 where that is empty, too.
void fill_from_other(const Image& image, const std::vector<Position>& pending, const Image& other) {
    for (const Position at : pending) {
        float& value = image.at(at.y, at.x, at.c);
        if (std::isfinite(value)) continue;
        value = other.known() && std::isfinite(other.at(at.y, at.x, at.c)) ? other.at(at.y, at.x, at.c) : 0;
    }
}

// Sets to 0 what a filter's lobe has made negative, and takes as much from the values around: their sum,
// which is what the filter was given, stays. Zeros alone would brighten the image, its halves even more.
void settle_lobes(const Image& image, Rules rules) {
    for_each_position(image, [&](Position at) {
        float& value = image.at(at.y, at.x, at.c);
        if (!(value < 0)) return;
        double around = 0;
        for_neighbourhood(image, at, [&](int y, int x) {
            const float other = image.at(y, x, at.c);
            if (rules.sane(other)) around += other;
        });
        if (-value > largest_lobe * around) return;
        const auto kept = static_cast<float>(1 + value / around);
        for_neighbourhood(image, at, [&](int y, int x) {
            float& other = image.at(y, x, at.c);
            if (rules.sane(other)) other *= kept;
        });
        value = 0;
    });
}

// Sets negative values to 0, and infinite ones as well if asked to.
void zero(const Image& image, Rules rules, bool infinite) {
    for (float* value = image.data; value != image.data + image.size(); ++value) {
        if (rules.sane(*value) || std::isnan(*value)) continue;
        if (std::abs(*value) < rules.infinite_from || infinite) *value = 0;
    }
}

void mend_values(const Buffer& buffer, Quantity quantity) {
    const Rules rules = value_rules(quantity);
    const bool is_depth = quantity == Quantity::depth;
    if (quantity == Quantity::color) {
        for (const Image& image : {buffer.mean, buffer.half_a, buffer.half_b}) {
            if (image.known()) settle_lobes(image, rules);
        }
    }
    if (buffer.half_a.known()) zero(buffer.half_a, rules, is_depth);
    if (buffer.half_b.known()) zero(buffer.half_b, rules, is_depth);
    // The mean of halves of which one met something and one did not is their mean, not the sky.
    zero(buffer.mean, rules, is_depth && !buffer.has_halves());

    std::vector<Position> mean_left;
    std::vector<Position> a_left;
    std::vector<Position> b_left;
    for_each_position(buffer.mean, [&](Position at) {
        float unknown = std::numeric_limits<float>::quiet_NaN();
        float& mean = buffer.mean.at(at.y, at.x, at.c);
        float& a = buffer.half_a.known() ? buffer.half_a.at(at.y, at.x, at.c) : unknown;
        float& b = buffer.half_b.known() ? buffer.half_b.at(at.y, at.x, at.c) : unknown;
        const bool mean_sane = rules.sane(mean);
        const bool a_sane = rules.sane(a);
        const bool b_sane = rules.sane(b);
        const auto other_half = [&](float half) {
            const float other = 2 * mean - half;
            return rules.nonnegative ? std::max(other, 0.0F) : other;
        };
        if (!mean_sane && a_sane && b_sane) {
            mean = a / 2 + b / 2;
        } else if (mean_sane && a_sane && !b_sane && buffer.half_b.known()) {
            b = other_half(a);
        } else if (mean_sane && !a_sane && b_sane && buffer.half_a.known()) {
            a = other_half(b);
        } else if (mean_sane && buffer.has_halves() && !a_sane && !b_sane) {
            a = b = mean;
        }
        const auto leave_to_neighbours = [&](float& value, std::vector<Position>& left) {
            if (rules.sane(value)) return;
            value = std::numeric_limits<float>::quiet_NaN();
            left.push_back(at);
        };
        leave_to_neighbours(mean, mean_left);
        if (buffer.half_a.known()) leave_to_neighbours(a, a_left);
        if (buffer.half_b.known()) leave_to_neighbours(b, b_left);
    });
    fill_from_neighbours(buffer.mean, mean_left, lower_median);
    fill_from_neighbours(buffer.half_a, a_left, lower_median);
    fill_from_neighbours(buffer.half_b, b_left, lower_median);
    fill_from_other(buffer.half_a, a_left, buffer.half_b);
    fill_from_other(buffer.half_b, b_left, buffer.half_a);
    fill_from_other(buffer.mean, mean_left, buffer.half_a);
}

void mend_variance(const Buffer& buffer, Quantity quantity) {
    const Rules rules = variance_rules(quantity);
    const Image& variance = buffer.variance;
    std::vector<Position> left;
    for_each_position(variance, [&](Position at) {
        float& value = variance.at(at.y, at.x, at.c);
        if (rules.sane(value)) return;
        value = std::numeric_limits<float>::quiet_NaN();
        if (buffer.has_halves()) {
            double sum = 0;
            int count = 0;
            const auto squared = [&](int y, int x) {
                const double difference =
                    static_cast<double>(buffer.half_a.at(y, x, at.c)) - buffer.half_b.at(y, x, at.c);
                return difference * difference / 4;
            };
            for_neighbourhood(variance, at, [&](int y, int x) {
                sum += squared(y, x);
                ++count;
            });
            const double estimate = std::max(sum / count, squared(at.y, at.x));
            value = static_cast<float>(std::min<double>(estimate, std::numeric_limits<float>::max()));
        } else {
            left.push_back(at);
        }
    });
    fill_from_neighbours(variance, left, maximum);
    fill_from_other(variance, left, {});
}

}  // namespace

BufferDefects find_defects(const ConstBuffer& buffer, Quantity quantity, int threads) {
    check_buffer(buffer);
    const Rules rules = value_rules(quantity);
    return {.mean = find_defects(buffer.mean, rules, threads),
            .half_a = find_defects(buffer.half_a, rules, threads),
            .half_b = find_defects(buffer.half_b, rules, threads),
            .variance = find_defects(buffer.variance, variance_rules(quantity), threads)};
}

void mend(const Buffer& buffer, Quantity quantity) {
    check_buffer(buffer);
    mend_values(buffer, quantity);
    if (buffer.variance.known()) mend_variance(buffer, quantity);
}

}  // namespace tungsten_dip
