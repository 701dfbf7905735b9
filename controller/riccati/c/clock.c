/* Clock of the statistics, in nanoseconds. A target without POSIX clocks defines NMPC_NOW as an expression of its own, or as 0. */
#ifndef NMPC_NOW
#define _POSIX_C_SOURCE 199309L
#include <time.h>
#endif

#include "solver.h"

int64_t clock_ns(void)
{
#ifdef NMPC_NOW
    return NMPC_NOW;
#else
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * INT64_C(1000000000) + now.tv_nsec;
#endif
}
