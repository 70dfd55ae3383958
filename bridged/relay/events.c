/* Events for Python. */
#include "events.h"

#include <errno.h>
#include <string.h>
#include <sys/eventfd.h>
#include <unistd.h>

enum { NEWS_MAX = 128 }; /* of the ring, for events that nobody waits for; the rest is for answers and losses */

int events_init(struct events *e, struct counters *counters)
{
    e->counters = counters;
    e->fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    return e->fd < 0 ? errno : 0;
}

void events_close(struct events *e)
{
    if (e->fd >= 0)
        close(e->fd);
}

/* An eventfd is full only after 2^64 writes nobody read: the result cannot matter. */
void eventfd_raise(int fd)
{
    uint64_t one = 1;
    ssize_t ignored = write(fd, &one, sizeof one);
    (void)ignored;
}

static bool is_news(enum event_kind kind)
{
    switch (kind) {
    case EVENT_UNASKED:
    case EVENT_NOISE:
    case EVENT_FRAME_REFUSED:
    case EVENT_UNANSWERED:
    case EVENT_STAMPED:
    case EVENT_INTERFACE_DOWN:
        return true;
    default:
        return false;
    }
}

void events_emit(struct events *e, enum event_kind kind, uint32_t token, const uint8_t *text, size_t length)
{
    if (e->count >= (is_news(kind) ? NEWS_MAX : EVENTS_MAX)) {
        e->counters->events_lost++;
        return;
    }
    struct event *event = &e->ring[(e->head + e->count++) % EVENTS_MAX];
    event->kind = (uint8_t)kind;
    event->token = token;
    event->length = (uint16_t)(length < EVENT_SIZE ? length : EVENT_SIZE);
    if (event->length)
        memcpy(event->text, text, event->length);
    eventfd_raise(e->fd);
}

/* The oldest events, `room` at most. -> how many */
uint32_t events_take(struct events *e, struct event *batch, uint32_t room)
{
    uint32_t n = e->count < room ? e->count : room;
    for (uint32_t i = 0; i < n; i++)
        batch[i] = e->ring[(e->head + i) % EVENTS_MAX];
    e->head = (e->head + n) % EVENTS_MAX;
    e->count -= n;
    return n;
}
