// The core of tungsten-dip: what is known of a render's noise, and how to mend and pre-filter its buffers.
#pragma once
namespace tungsten_dip {
int thread_count(int threads);
}
