// A loop shared among threads.
#include <algorithm>
#include <atomic>
#include <exception>
#include <mutex>
#include <thread>
#include <vector>

#include "checks.hpp"
#include "core.hpp"

namespace tungsten_dip {

void parallel_for(int count, int threads, const std::function<void(int)>& body) {
    if (threads < 1) refuse("threads", "a whole number from 1 on", threads);
    threads = std::min(threads, count);

    std::atomic<int> next = 0;
    std::exception_ptr error;
    std::mutex error_mutex;
    const auto work = [&] {
        try {
            for (int i = next++; i < count; i = next++) body(i);
        } catch (...) {
            next = count;
            const std::scoped_lock lock(error_mutex);
            if (!error) error = std::current_exception();
        }
    };
    {
        std::vector<std::jthread> helpers;
        for (int i = 1; i < threads; ++i) helpers.emplace_back(work);
        work();
    }
    if (error) std::rethrow_exception(error);
}

}  // namespace tungsten_dip
