/* The window of a device that answers each frame.
 *
 * A refusal (BELL, say) says that the device did not take the frame, so that a retry cannot put the frame on the
 * bus twice. Three exceptions: noise that looks like a refusal; a second answer to the frame before;
 * a resynchronisation in progress, where the refusal may mean the sync command, spliced to a broken one.
 * Hence:
 * - After a refusal the sync command goes first. If the frame's confirmation comes before the sync command's answer,
 *   the device took the frame after all.
 * - If noise came in between, it may have been that confirmation: the frame is counted as `unanswered`.
 * - While the line is being resynchronised, a refused frame is counted as `unanswered`, too: a frame sent twice is
 *   worse than one dropped and counted. */
#include "ack_window.h"

#define RETRY_FIRST_NS INT64_C(1000000)
#define RETRY_LAST_NS INT64_C(16000000)
#define COUNTER_OF_ANSWER(name, python, counter) [name] = &c->counter,
#define RETRIES_TOLD 16 /* about four times a second */

void ack_window_init(struct ack_window *w, struct queue *queue, struct line *line)
{
    w->queue = queue;
    w->line = line;
    ack_window_reset(w);
}

/* What an answer means; until the port is detached. */
void ack_window_set(struct ack_window *w, const struct sending_settings *set)
{
    struct counters *c = w->queue->counters;
    uint64_t *const counter[ANSWERS] = {ANSWER_LIST(COUNTER_OF_ANSWER)};
    w->taken = counter[set->answer];
    w->retries = set->retries;
}

/* The port is gone or new. */
void ack_window_reset(struct ack_window *w)
{
    const struct sending_settings usual = {.answer = ANSWER_TAKEN, .retries = true};
    ack_window_set(w, &usual);
    w->checking = false;
    w->retry_delay_ns = RETRY_FIRST_NS;
    w->retry_at_ns = 0;
    w->refused_ns = NEVER;
}

/* Drops the refused frames: the device may have taken them after all. */
static void refused_unanswered(struct ack_window *w)
{
    for (; w->queue->retry_count; queue_retry_pop(w->queue))
        queue_drop(w->queue, TX_UNANSWERED);
}

/* With a window above 1 and an answer missing, a refusal may have been meant for another frame. So frames refused
 * while anything is still in flight are not sent again. */
void ack_window_answer_missing(struct ack_window *w)
{
    if (w->line->window > 1 && w->line->inflight_count)
        refused_unanswered(w);
}

/* The sync command after a refusal was answered, or will not be. */
void ack_window_check_ended(struct ack_window *w)
{
    if (!w->checking)
        return;
    w->checking = false;
    if (line_noise(w->line) != w->check_noise)
        refused_unanswered(w);
}

/* The sync command after a missing answer was answered: all refusals before it are certain. */
void ack_window_synced(struct ack_window *w)
{
    w->checking = false;
}

/* The device took frame `number`. */
void ack_window_confirmed(struct ack_window *w, uint64_t number)
{
    struct queue *q = w->queue;
    ++*w->taken;
    w->retry_delay_ns = RETRY_FIRST_NS;
    w->refused_ns = NEVER;
    while (q->retry_count && queue_retry_first(q)->number < number) {
        queue_retry_pop(q);
        queue_drop(q, TX_OVERTAKEN);
    }
}

/* "Done" came, which answers nothing in flight, while a refusal is being checked: the device took that frame
 * after all. -> whether there is such a frame */
bool ack_window_take_late(struct ack_window *w)
{
    if (!w->queue->retry_count || !(w->checking || w->line->resyncing))
        return false;
    const struct tx_frame taken = queue_retry_pop(w->queue);
    ack_window_confirmed(w, taken.number);
    return true;
}

/* A device that has been refusing every frame for so long has a full buffer that no frame leaves. */
static void look_if_stuck(struct ack_window *w, int64_t now)
{
    if (w->refused_ns == NEVER)
        w->refused_ns = now;
    if (now - w->refused_ns < w->queue->set.stuck_ns)
        return;
    w->refused_ns = now;
    events_emit(w->line->events, EVENT_STUCK, 0, NULL, 0);
}

static void refused_for_good(struct ack_window *w, int64_t now)
{
    const struct counters *count = w->line->counters;
    if (count->tx_dropped[TX_REFUSED] % RETRIES_TOLD == 0)
        events_emit(w->line->events, EVENT_FRAME_REFUSED, (uint32_t)count->retries, NULL, 0);
    queue_drop(w->queue, TX_REFUSED);
    look_if_stuck(w, now);
}

void ack_window_refused(struct ack_window *w, const struct inflight *frame, int64_t now)
{
    const struct counters *count = w->line->counters;
    if (w->line->resyncing || line_noise(w->line) != frame->noise) {
        queue_drop(w->queue, TX_UNANSWERED);
        return;
    }
    if (!w->retries) {
        refused_for_good(w, now);
        return;
    }
    if (!queue_retry(w->queue, &frame->tx))
        return;
    if (w->retry_delay_ns == RETRY_FIRST_NS || count->retries % RETRIES_TOLD == 0)
        events_emit(w->line->events, EVENT_FRAME_REFUSED, (uint32_t)count->retries, NULL, 0);
    look_if_stuck(w, now);
    if (!w->checking)
        w->check_noise = line_noise(w->line);
    w->checking = true;
    w->retry_at_ns = now + w->retry_delay_ns;
    w->retry_delay_ns *= w->retry_delay_ns < RETRY_LAST_NS ? 2 : 1;
}
