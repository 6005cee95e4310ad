// The whole test framework: CHECK counts what fails and says where; a test's main returns failed_checks().
#pragma once

#include <cmath>
#include <iostream>

inline int& failures() {
    static int count = 0;
    return count;
}
inline int& checks() {
    static int count = 0;
    return count;
}

inline void check(bool passed, const char* what, const char* file, int line) {
    ++checks();
    if (passed) return;
    ++failures();
    std::cerr << file << ":" << line << ": " << what << "\n";
}

inline bool near(double value, double expected, double tolerance) {
    return std::abs(value - expected) <= tolerance;
}

inline int failed_checks() {
    std::cout << checks() << " checks, " << failures() << " failed\n";
    return failures() == 0 && checks() > 0 ? 0 : 1;
}

#define CHECK(condition) check((condition), #condition, __FILE__, __LINE__)
