// The parallel loop: every index once, exceptions reach the caller.
#include <atomic>
#include <stdexcept>
#include <string>
#include <vector>

#include "check.hpp"
#include "core.hpp"

using tungsten_dip::parallel_for;

int main() {
    for (const int threads : {1, 2, 7}) {
        for (const int count : {0, 1, 2, 100}) {
            std::vector<std::atomic<int>> visits(static_cast<std::size_t>(count));
            parallel_for(count, threads, [&](int i) { ++visits[static_cast<std::size_t>(i)]; });
            bool once = true;
            for (const auto& visit : visits) once = once && visit == 1;
            CHECK(once);
        }
        bool caught = false;
        try {
            parallel_for(10, threads, [](int i) {
                if (i == 3) throw std::runtime_error("three");
            });
        } catch (const std::runtime_error& error) {
            caught = std::string(error.what()) == "three";
        }
        CHECK(caught);
    }
    return failed_checks();
}
