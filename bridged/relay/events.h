/* Events for Python: a ring, and an eventfd that is readable while the ring has any. */
#ifndef CAN_BRIDGE_EVENTS_H
#define CAN_BRIDGE_EVENTS_H

#include "counters.h"
#include "values.h"

struct events {
    struct counters *counters;
    int fd;
    uint32_t head, count;
    struct event ring[EVENTS_MAX];
};

int events_init(struct events *e, struct counters *counters); /* -> 0 or errno */
void events_close(struct events *e);
void events_emit(struct events *e, enum event_kind kind, uint32_t token, const uint8_t *text, size_t length);
uint32_t events_take(struct events *e, struct event *batch, uint32_t room);

void eventfd_raise(int fd);

#endif
