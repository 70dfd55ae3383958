/* Reads the clocks. */
#include "clock.h"

#include <time.h>

static int64_t clock_read(clockid_t clock)
{
    struct timespec t;
    clock_gettime(clock, &t);
    return t.tv_sec * NS_PER_S + t.tv_nsec;
}

int64_t clock_now_ns(void)
{
    return clock_read(CLOCK_BOOTTIME);
}

/* In this order: a process stopped between the two takes its frames for older, never for younger. */
struct moment clock_moment(void)
{
    int64_t boot_ns = clock_now_ns();
    return (struct moment){boot_ns, clock_read(CLOCK_REALTIME)};
}
