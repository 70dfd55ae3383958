/* The relay's lock: a loop that gives it back and takes it again at once does not starve another thread. */
#include "../../bridged/relay/relay.c" /* its lock is nobody else's affair */

#include <sched.h>
#include <stdatomic.h>
#include <stdlib.h>

#include "check.h"

enum { ROUNDS = 100, PATIENCE_S = 20 };

static struct relay *relay;
static atomic_bool came; /* the other thread is about to take the lock */
static bool had_it;      /* guarded by the relay's lock */

static void *other(void *unused)
{
    atomic_store(&came, true);
    lock(relay);
    had_it = true;
    unlock(relay);
    return unused;
}

/* Whether a thread is at the turnstile, at last; not for ever, or a lock without one would hang this test. */
static bool somebody_waits(void)
{
    int64_t end = clock_now_ns() + PATIENCE_S * NS_PER_S;
    while (clock_now_ns() < end) {
        if (atomic_load(&came)) {
            if (pthread_mutex_trylock(&relay->turnstile))
                return true;
            pthread_mutex_unlock(&relay->turnstile);
        }
        sched_yield();
    }
    return false;
}

static bool is_next(void)
{
    pthread_t thread;
    atomic_store(&came, false);
    lock(relay);
    had_it = false;
    if (pthread_create(&thread, NULL, other, NULL))
        abort();
    bool waits = somebody_waits();
    unlock(relay);
    lock(relay);
    bool next = waits && had_it;
    unlock(relay);
    pthread_join(thread, NULL);
    return next;
}

int main(void)
{
    const struct settings set = {.codec = &codec_can232, .queue = {.size = 1}, .window = 1};
    relay = relay_new(&set);
    if (!relay)
        abort();
    int i = 0;
    while (i < ROUNDS && is_next())
        i++;
    CHECK(i == ROUNDS);
    relay_free(relay);
    return checks_end();
}
