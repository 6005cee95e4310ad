#include <thread>
#include <algorithm>
#include "core.hpp"
namespace tungsten_dip {
int thread_count(int threads) { return threads > 0 ? threads : std::max(1, static_cast<int>(std::thread::hardware_concurrency())); }
}
