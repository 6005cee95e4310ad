// Marks inner loops that are worth compiling for newer processors too.
#pragma once

// Compiled twice, and the faster one chosen when the program starts. Sanitizers cannot run before that
// choice.
#if defined(__x86_64__) && defined(__linux__) && !defined(__SANITIZE_ADDRESS__) && \
    !defined(__SANITIZE_THREAD__)
#define TUNGSTEN_DIP_FASTEST __attribute__((target_clones("arch=x86-64-v3", "default")))
#else
#define TUNGSTEN_DIP_FASTEST
#endif
