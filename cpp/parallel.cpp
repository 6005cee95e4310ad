// A loop shared among threads.
#include <algorithm>
#include <atomic>
#include <exception>
#include <mutex>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "core.hpp"

namespace tungsten_dip {

void parallel_for(int count, int threads, const std::function<void(int)>& body) {
    if (threads < 1) {
        throw std::invalid_argument("threads: expected a whole number from 1 on, got " +
                                    std::to_string(threads));
    }
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
