/* Frames that wait for the device. */
#include "queue.h"

#include <errno.h>
#include <stdlib.h>

static struct tx_frame *waiting_at(const struct queue *q, uint32_t i)
{
    return &q->waiting[(q->waiting_head + i) % q->set.size];
}

static struct tx_frame *retry_at(struct queue *q, uint32_t i)
{
    return &q->retry[(q->retry_head + i) % RETRY_MAX];
}

int queue_init(struct queue *q, const struct queue_settings *set, struct counters *counters)
{
    *q = (struct queue){.counters = counters, .set = *set};
    q->waiting = calloc(set->size, sizeof *q->waiting);
    return q->waiting ? 0 : ENOMEM;
}

void queue_free(struct queue *q)
{
    free(q->waiting);
}

struct tx_frame queue_pop(struct queue *q)
{
    struct tx_frame tx = *waiting_at(q, 0);
    q->waiting_head = (q->waiting_head + 1) % q->set.size;
    q->waiting_count--;
    return tx;
}

struct tx_frame queue_retry_pop(struct queue *q)
{
    struct tx_frame tx = *retry_at(q, 0);
    q->retry_head = (q->retry_head + 1) % RETRY_MAX;
    q->retry_count--;
    return tx;
}

/* Drops what is older than the deadline. `retries`: also among the frames that the device did not take; not before
 * their refusal is certain. Both rings are in order of age, so only their heads need a look. Where a sender's own
 * time stamp put a frame out of order, queue_expired() finds it when its turn comes. */
void queue_expire(struct queue *q, bool retries, int64_t now)
{
    while (retries && q->retry_count && queue_expired(q, retry_at(q, 0), now)) {
        queue_retry_pop(q);
        queue_drop(q, TX_REFUSED);
    }
    while (q->waiting_count && queue_expired(q, waiting_at(q, 0), now)) {
        queue_pop(q);
        queue_drop(q, TX_STALE);
    }
}

/* When the first of those that wait is too old. */
int64_t queue_expires_ns(const struct queue *q)
{
    int64_t born = NEVER;
    if (q->waiting_count)
        born = waiting_at(q, 0)->born_ns;
    if (q->retry_count && queue_retry_first(q)->born_ns < born)
        born = queue_retry_first(q)->born_ns;
    return born == NEVER ? NEVER : born + q->set.deadline_ns + 1;
}

/* A frame from the interface: into the queue, or dropped for what the gate says. */
void queue_add(struct queue *q, const struct can_frame *frame, int64_t born_ns, int64_t now)
{
    static const enum tx_drop closed[GATES] = {
        [GATE_AWAY] = TX_AWAY, [GATE_LISTEN_ONLY] = TX_LISTEN_ONLY, [GATE_STOPPED] = TX_STOPPED};

    if (q->gate != GATE_OPEN) {
        queue_drop(q, closed[q->gate]);
        return;
    }
    if (q->waiting_count == q->set.size)
        queue_expire(q, false, now);
    if (q->waiting_count == q->set.size) {
        queue_drop(q, TX_QUEUE_FULL);
        return;
    }
    struct tx_frame *tx = waiting_at(q, q->waiting_count++);
    tx->frame = *frame;
    tx->born_ns = born_ns;
    tx->number = q->next_number++;
}

/* Where there is less room for frames not sent yet than before, the newest are dropped. */
int queue_change(struct queue *q, const struct queue_settings *set)
{
    struct tx_frame *waiting = malloc(set->size * sizeof *waiting);
    if (!waiting)
        return ENOMEM;
    uint32_t kept = q->waiting_count < set->size ? q->waiting_count : set->size;
    for (uint32_t i = 0; i < kept; i++)
        waiting[i] = *waiting_at(q, i);
    for (; q->waiting_count > kept; q->waiting_count--)
        queue_drop(q, TX_QUEUE_FULL);
    free(q->waiting);
    q->waiting = waiting;
    q->waiting_head = 0;
    q->set = *set;
    return 0;
}

/* Frames that wait survive the adapter's absence until their deadline; nothing else does. */
void queue_set_gate(struct queue *q, enum gate gate)
{
    q->gate = gate;
    if (gate != GATE_STOPPED && gate != GATE_LISTEN_ONLY)
        return;
    enum tx_drop reason = gate == GATE_STOPPED ? TX_STOPPED : TX_LISTEN_ONLY;
    for (; q->retry_count; queue_retry_pop(q))
        queue_drop(q, reason);
    for (; q->waiting_count; queue_pop(q))
        queue_drop(q, reason);
}

/* Puts a frame that the device did not take into its place before those not sent yet.
 * -> false: the gate is not open any more, so that the frame is dropped */
bool queue_retry(struct queue *q, const struct tx_frame *tx)
{
    if (q->gate != GATE_OPEN) {
        queue_drop(q, q->gate == GATE_STOPPED ? TX_STOPPED : TX_REFUSED);
        return false;
    }
    uint32_t i = q->retry_count++;
    for (; i && retry_at(q, i - 1)->number > tx->number; i--)
        *retry_at(q, i) = *retry_at(q, i - 1);
    *retry_at(q, i) = *tx;
    return true;
}

/* The device took a frame: an earlier one with its identifier that it did not take must not follow. */
void queue_overtake(struct queue *q, const struct tx_frame *taken)
{
    uint32_t kept = 0;
    for (uint32_t i = 0; i < q->retry_count; i++) {
        const struct tx_frame *tx = retry_at(q, i);
        if (tx->number < taken->number && tx->frame.can_id == taken->frame.can_id)
            queue_drop(q, TX_OVERTAKEN);
        else
            *retry_at(q, kept++) = *tx;
    }
    q->retry_count = kept;
}
