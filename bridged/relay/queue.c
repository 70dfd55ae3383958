/* Frames from the bus that wait for the device: those not sent yet, and those it did not take. */
#include "relay.h"

#include <errno.h>
#include <stdlib.h>

#define STUCK_LEAST_NS INT64_C(500000000) /* a slow, busy bus is no reason */

/* For how long no frame may leave the device's own buffer: what is in there is older than the deadline then. */
int64_t stuck_ns(const struct relay *r)
{
    return r->set.deadline_ns > STUCK_LEAST_NS ? r->set.deadline_ns : STUCK_LEAST_NS;
}

static struct tx_frame *waiting_at(struct relay *r, uint32_t i)
{
    return &r->queue[(r->queue_head + i) % r->set.queue];
}

static struct tx_frame *retry_at(struct relay *r, uint32_t i)
{
    return &r->retry[(r->retry_head + i) % RETRY_MAX];
}

const struct tx_frame *retry_first(struct relay *r)
{
    return retry_at(r, 0);
}

struct tx_frame queue_pop(struct relay *r)
{
    struct tx_frame tx = *waiting_at(r, 0);
    r->queue_head = (r->queue_head + 1) % r->set.queue;
    r->queue_count--;
    return tx;
}

struct tx_frame retry_pop(struct relay *r)
{
    struct tx_frame tx = *retry_at(r, 0);
    r->retry_head = (r->retry_head + 1) % RETRY_MAX;
    r->retry_count--;
    return tx;
}

void queue_drop(struct relay *r, enum tx_drop reason)
{
    r->count.tx_dropped[reason]++;
}

/* Both lists are in order of age, so only their heads need a look; what a sender's own time stamp puts out of order
 * send_next() finds. Where the adapter answers frames, nobody knows before a refusal was checked what became of the
 * frame. */
void queue_expire(struct relay *r, int64_t now)
{
    bool certain = flow_used(r) || !(r->checking || r->resyncing);
    while (certain && r->retry_count && now - retry_at(r, 0)->born_ns > r->set.deadline_ns) {
        retry_pop(r);
        queue_drop(r, TX_REFUSED);
    }
    while (r->queue_count && now - waiting_at(r, 0)->born_ns > r->set.deadline_ns) {
        queue_pop(r);
        queue_drop(r, TX_STALE);
    }
}

/* When the first of those that wait is too old. */
int64_t queue_expires_ns(struct relay *r)
{
    int64_t born = NEVER;
    if (r->queue_count)
        born = waiting_at(r, 0)->born_ns;
    if (r->retry_count && retry_at(r, 0)->born_ns < born)
        born = retry_at(r, 0)->born_ns;
    return born == NEVER ? NEVER : born + r->set.deadline_ns + 1;
}

/* A frame from the bus: into the queue, or dropped for what the gate says. */
void queue_add(struct relay *r, const struct can_frame *frame, int64_t born_ns, int64_t now)
{
    static const enum tx_drop closed[GATES] = {
        [GATE_AWAY] = TX_AWAY, [GATE_LISTEN_ONLY] = TX_LISTEN_ONLY, [GATE_STOPPED] = TX_STOPPED};

    if (r->gate != GATE_OPEN) {
        queue_drop(r, closed[r->gate]);
        return;
    }
    if (r->queue_count == r->set.queue)
        queue_expire(r, now);
    if (r->queue_count == r->set.queue) {
        queue_drop(r, TX_QUEUE_FULL);
        return;
    }
    struct tx_frame *tx = waiting_at(r, r->queue_count++);
    tx->frame = *frame;
    tx->born_ns = born_ns;
    tx->number = r->next_number++;
}

/* Room for so many frames that were not sent yet; of those that wait the newest are dropped if it is too small. */
int queue_resize(struct relay *r, uint32_t size)
{
    struct tx_frame *queue = malloc(size * sizeof *queue);
    if (!queue)
        return ENOMEM;
    uint32_t kept = r->queue_count < size ? r->queue_count : size;
    for (uint32_t i = 0; i < kept; i++)
        queue[i] = *waiting_at(r, i);
    for (; r->queue_count > kept; r->queue_count--)
        queue_drop(r, TX_QUEUE_FULL);
    free(r->queue);
    r->queue = queue;
    r->queue_head = 0;
    r->set.queue = size;
    return 0;
}

/* Frames that wait survive the adapter's absence until their deadline; nothing else does. */
void queue_set_gate(struct relay *r, enum gate gate)
{
    r->gate = gate;
    if (gate != GATE_STOPPED && gate != GATE_LISTEN_ONLY)
        return;
    enum tx_drop reason = gate == GATE_STOPPED ? TX_STOPPED : TX_LISTEN_ONLY;
    for (; r->retry_count; retry_pop(r))
        queue_drop(r, reason);
    for (; r->queue_count; queue_pop(r))
        queue_drop(r, reason);
}

/* Whether frames wait that may be sent. */
bool queue_waiting(const struct relay *r)
{
    return r->gate == GATE_OPEN && !r->silent && (r->retry_count || r->queue_count);
}

/* Puts a frame that was not taken back into its place before those not sent yet. */
void queue_retry(struct relay *r, const struct tx_frame *tx)
{
    uint32_t i = r->retry_count++;
    for (; i && retry_at(r, i - 1)->number > tx->number; i--)
        *retry_at(r, i) = *retry_at(r, i - 1);
    *retry_at(r, i) = *tx;
}

/* A frame was taken: an earlier one with its identifier that was not must not follow it. */
void queue_overtake(struct relay *r, const struct tx_frame *taken)
{
    uint32_t kept = 0;
    for (uint32_t i = 0; i < r->retry_count; i++) {
        const struct tx_frame *tx = retry_at(r, i);
        if (tx->number < taken->number && tx->frame.can_id == taken->frame.can_id)
            queue_drop(r, TX_OVERTAKEN);
        else
            *retry_at(r, kept++) = *tx;
    }
    r->retry_count = kept;
}
