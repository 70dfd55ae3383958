/* The window of a device that answers each frame: frames that it refuses are sent again, never twice. */
#ifndef CAN_BRIDGE_ACK_WINDOW_H
#define CAN_BRIDGE_ACK_WINDOW_H

#include "line.h"
#include "queue.h"

struct ack_window {
    struct queue *queue;
    struct line *line;
    bool retries;    /* a refused frame was not taken; else it may have been on the bus, and is not sent again */
    uint64_t *taken; /* the counter of frames that the device answers with "done" */
    int64_t retry_at_ns, retry_delay_ns;
    int64_t refused_ns;   /* when the device began to refuse every frame; NEVER: it took the last one */
    bool checking;        /* refusals are not certain yet: the sync command goes next, or is in flight */
    uint64_t check_noise; /* line_noise() at the first of these refusals */
};

void ack_window_init(struct ack_window *w, struct queue *queue, struct line *line);
void ack_window_set(struct ack_window *w, const struct sending_settings *set);
void ack_window_reset(struct ack_window *w);
void ack_window_confirmed(struct ack_window *w, uint64_t number);
void ack_window_refused(struct ack_window *w, const struct inflight *frame, int64_t now);
bool ack_window_take_late(struct ack_window *w);
void ack_window_check_ended(struct ack_window *w);
void ack_window_synced(struct ack_window *w);
void ack_window_answer_missing(struct ack_window *w);

/* Whether a frame may go now. After a refusal one at a time, so that none overtakes another. */
static inline bool ack_window_open(const struct ack_window *w, int64_t now)
{
    return !w->queue->retry_count || (!w->line->inflight_count && now >= w->retry_at_ns);
}

/* When a refused frame may go. */
static inline int64_t ack_window_deadline(const struct ack_window *w)
{
    bool waits = w->queue->retry_count && w->queue->gate == GATE_OPEN && !w->line->inflight_count;
    return waits ? w->retry_at_ns : NEVER;
}

#endif
