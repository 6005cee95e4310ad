// The whole test framework: a check that fails says where, and what the values are; a test's main returns
// failed_checks().
#pragma once

#include <cmath>
#include <iostream>
#include <stdexcept>
#include <string>
#include <type_traits>

inline int& failures() {
    static int count = 0;
    return count;
}
inline int& checks() {
    static int count = 0;
    return count;
}

struct Place {
    const char* what;
    const char* file;
    int line;
};

template <typename... Parts>
void check(bool passed, Place place, const Parts&... values) {
    ++checks();
    if (passed) return;
    ++failures();
    std::cerr.precision(9);  // tells any two floats apart
    std::cerr << place.file << ":" << place.line << ": " << place.what;
    (std::cerr << ... << values) << "\n";
}

template <typename Value>
void check_equal(const Value& value, const std::type_identity_t<Value>& expected, Place place) {
    check(value == expected, place, ": expected ", expected, ", got ", value);
}

inline void check_near(double value, double expected, double tolerance, Place place) {
    check(std::abs(value - expected) <= tolerance, place, ": expected ", expected, " within ", tolerance,
          ", got ", value);
}

inline void check_below(double value, double bound, Place place) {
    check(value < bound, place, ": expected less than ", bound, ", got ", value);
}

// What a call says where it refuses its arguments; nothing if it takes them.
template <typename Call>
std::string refusal(const Call& call) {
    try {
        call();
    } catch (const std::invalid_argument& error) {
        return error.what();
    }
    return {};
}

inline int failed_checks() {
    std::cout << checks() << " checks, " << failures() << " failed\n";
    return failures() == 0 && checks() > 0 ? 0 : 1;
}

#define CHECK(condition) check(condition, {#condition, __FILE__, __LINE__})
#define CHECK_EQUAL(value, expected) check_equal(value, expected, {#value, __FILE__, __LINE__})
#define CHECK_NEAR(value, expected, tolerance) \
    check_near(value, expected, tolerance, {#value, __FILE__, __LINE__})
#define CHECK_BELOW(value, bound) check_below(value, bound, {#value, __FILE__, __LINE__})
