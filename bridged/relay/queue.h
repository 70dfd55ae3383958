/* Frames from the interface that wait for the device: those not sent yet, and those that it did not take. */
#ifndef CAN_BRIDGE_QUEUE_H
#define CAN_BRIDGE_QUEUE_H

#include <linux/can.h>

#include "counters.h"
#include "values.h"

enum { RETRY_MAX = 64 }; /* never more than were in flight */

struct tx_frame {
    struct can_frame frame;
    int64_t born_ns; /* when the kernel received it, on the relay's clock */
    uint64_t number; /* order on the interface */
};

struct queue {
    struct counters *counters;
    struct queue_settings set;
    enum gate gate;
    uint64_t next_number;
    struct tx_frame *waiting; /* ring of set.size: not sent yet */
    uint32_t waiting_head, waiting_count;
    struct tx_frame retry[RETRY_MAX]; /* ring: sent, and not taken */
    uint32_t retry_head, retry_count;
};

int queue_init(struct queue *q, const struct queue_settings *set, struct counters *counters); /* -> 0 or errno */
void queue_free(struct queue *q);
int queue_change(struct queue *q, const struct queue_settings *set); /* -> 0 or ENOMEM with nothing changed */
void queue_set_gate(struct queue *q, enum gate gate);
void queue_add(struct queue *q, const struct can_frame *frame, int64_t born_ns, int64_t now);
void queue_expire(struct queue *q, bool retries, int64_t now);
int64_t queue_expires_ns(const struct queue *q);
struct tx_frame queue_pop(struct queue *q);
struct tx_frame queue_retry_pop(struct queue *q);
bool queue_retry(struct queue *q, const struct tx_frame *tx);
void queue_overtake(struct queue *q, const struct tx_frame *taken);

static inline void queue_drop(struct queue *q, enum tx_drop reason)
{
    q->counters->tx_dropped[reason]++;
}

static inline const struct tx_frame *queue_retry_first(const struct queue *q)
{
    return &q->retry[q->retry_head];
}

static inline bool queue_expired(const struct queue *q, const struct tx_frame *tx, int64_t now)
{
    return now - tx->born_ns > q->set.deadline_ns;
}

/* Whether frames wait that the gate lets through. */
static inline bool queue_waiting(const struct queue *q)
{
    return q->gate == GATE_OPEN && (q->retry_count || q->waiting_count);
}

#endif
