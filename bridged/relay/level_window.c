/* The window of a device that does not answer frames.
 *
 * Frames are followed by a question (set.ask). Its answer comes after the device has dealt with all frames
 * before it: those are taken now, unless they were handed back first. The answer also tells how full the device's
 * buffer is, or at least that it was not full enough for a "stop". So never more frames are on their way
 * than surely fit: a frame that comes back while later ones are taken could not be put in order again. */
#include "level_window.h"

#include <string.h>

#define ASK_FIRST_NS INT64_C(1000000)
#define ASK_LAST_NS INT64_C(16000000)
#define STOP_LOOK_NS INT64_C(50000000)   /* how often the level is looked at while stopped: "go" may be lost */
#define STOP_LIMIT_NS INT64_C(500000000) /* a stop without a "go" ends by trial then, where no level is told */
#define RETURNS_TOLD 64

static struct tx_frame *sent_at(struct level_window *w, uint32_t i)
{
    return &w->sent[(w->sent_head + i) % WINDOW_MAX];
}

static struct tx_frame sent_pop(struct level_window *w)
{
    struct tx_frame tx = *sent_at(w, 0);
    w->sent_head = (w->sent_head + 1) % WINDOW_MAX;
    w->sent_count--;
    return tx;
}

static uint32_t room_above(const struct level_window *w, uint32_t level)
{
    uint32_t used = level + w->sent_count;
    return w->set.capacity > used ? w->set.capacity - used : 0;
}

/* The oldest frame may have been taken or not. */
static void sent_unanswered(struct level_window *w)
{
    const struct tx_frame lost = sent_pop(w);
    w->unsure -= w->unsure > 0;
    queue_drop(w->queue, TX_UNANSWERED);
    queue_overtake(w->queue, &lost);
}

void level_window_init(struct level_window *w, struct queue *queue, struct line *line)
{
    w->queue = queue;
    w->line = line;
    w->counters = line->counters;
    level_window_reset(w);
}

/* The device is initialised. */
void level_window_start(struct level_window *w, const struct level_settings *set)
{
    level_window_reset(w);
    w->set = *set;
}

/* The port is gone or new. Nothing is known of the device's buffer: the first thing to do is to ask. */
void level_window_reset(struct level_window *w)
{
    while (w->sent_count)
        sent_unanswered(w);
    *w = (struct level_window){
        .queue = w->queue,
        .line = w->line,
        .counters = w->counters,
        .unread = w->unread,
        .limit = w->line->window,
        .ask_delay_ns = ASK_FIRST_NS,
    };
}

/* The port is new, or that of a device whose cut is not to be finished. */
void level_window_forget(struct level_window *w)
{
    w->unread = false;
}

/* Whether the question goes now. `more`: frames can follow at once, so that it can cover them too.
 * Never two at a time: should one be lost without a trace, the answer to the next would pass for its own. */
bool level_window_ask_due(const struct level_window *w, bool more, int64_t now)
{
    if (!w->set.ask.length || w->asking)
        return false;
    return w->sent_count ? !more : now >= level_window_deadline(w);
}

void level_window_ask(struct level_window *w, int64_t now)
{
    line_send_command(w->line, &w->set.ask, INFLIGHT_LEVEL, now);
    w->asking = true;
    w->asked_ns = now;
    w->asked = w->sent_count;
}

void level_window_sent(struct level_window *w, const struct tx_frame *tx)
{
    if (!w->sent_count)
        w->noise = w->counters->skipped_bytes;
    *sent_at(w, w->sent_count++) = *tx;
    w->room--;
    w->unread = true;
}

/* When the question that tells whether anything can go is due again. */
static void ask_again_at(struct level_window *w, int64_t now)
{
    if (w->stopped) {
        w->ask_at_ns = now + STOP_LOOK_NS;
        return;
    }
    w->ask_at_ns = now + w->ask_delay_ns;
    w->ask_delay_ns *= w->ask_delay_ns < ASK_LAST_NS ? 2 : 1;
}

/* The device says how many frames are in its buffer, `taken` more than at the last time. The answer may have
 * waited for us, so it counts as from when the question was put. */
static void level_observe(struct level_window *w, uint32_t level, uint32_t taken)
{
    bool left = !w->level || level < w->level + taken;
    w->level = level;
    if (left)
        w->left_at_ns = w->asked_ns;
    if (!level || w->asked_ns - w->left_at_ns <= w->queue->set.stuck_ns)
        return;
    w->left_at_ns = NEVER; /* said once */
    events_emit(w->line->events, EVENT_STUCK, level, NULL, 0);
}

/* Noise may have been a frame that was handed back: then nothing is certain. */
void level_window_answered(struct level_window *w, const struct codec_message *msg, int64_t now)
{
    bool grows = false;
    uint32_t taken_count = w->asked;
    if (w->counters->skipped_bytes != w->noise)
        w->unsure = w->sent_count;
    w->noise = w->counters->skipped_bytes;
    w->asking = false;
    for (; w->asked; w->asked--) {
        if (w->unsure) {
            sent_unanswered(w);
            continue;
        }
        const struct tx_frame taken = sent_pop(w);
        w->counters->confirmed++;
        queue_overtake(w->queue, &taken);
        w->ask_delay_ns = ASK_FIRST_NS;
        grows = !w->settling;
    }
    if (grows)
        w->limit = 2 * w->limit < w->line->window ? 2 * w->limit : w->line->window;
    w->settling = w->settling && w->sent_count;
    w->unread = w->sent_count > 0;

    /* A "go" may be lost: the level says the same. Where none is told, one frame goes after some time, to see. */
    int level = w->line->codec->level(msg->text, msg->length);
    bool trial = w->stopped && level < 0 && now - w->stopped_ns >= STOP_LIMIT_NS;
    if (trial || (level >= 0 && level < (int)w->set.ready))
        w->stopped = false;
    if (level >= 0) {
        level_observe(w, (uint32_t)level, taken_count);
        w->room = room_above(w, (uint32_t)level);
    } else if (trial) {
        w->room = !w->sent_count;
    } else {
        w->room = w->set.critical < w->set.capacity ? room_above(w, w->set.critical) : !w->sent_count;
    }
    if (w->stopped || !w->room)
        ask_again_at(w, now);
    else if (w->level)
        w->ask_at_ns = now + STOP_LOOK_NS;
}

/* The answer to the question was lost: the frames before it may have been taken, or handed back in what was lost. */
void level_window_unanswered(struct level_window *w)
{
    w->asking = false;
    for (; w->asked; w->asked--)
        sent_unanswered(w);
    w->unsure = w->sent_count; /* those after them may have been handed back there, too */
    w->room = 0;
    w->settling = w->settling && w->sent_count;
}

static bool frames_equal(const struct can_frame *a, const struct can_frame *b)
{
    size_t data = a->can_id & CAN_RTR_FLAG ? 0 : a->len;
    return a->can_id == b->can_id && a->len == b->len && !memcmp(a->data, b->data, data);
}

/* Which of `sent` the device hands back, sent_count if none: of equal ones the newest, since it is the
 * newest that finds a buffer full, but none after a question that is not answered yet. */
static uint32_t sent_find(struct level_window *w, const struct can_frame *frame)
{
    for (uint32_t i = w->asking ? w->asked : w->sent_count; i > 0; i--)
        if (frames_equal(&sent_at(w, i - 1)->frame, frame))
            return i - 1;
    return w->sent_count;
}

/* The device hands a frame back, which goes into its place before those not sent yet. One that is not ours is not
 * sent. */
static void frame_returned(struct level_window *w, const struct can_frame *frame, int64_t now)
{
    uint32_t i = sent_find(w, frame);
    if (i == w->sent_count) {
        w->counters->stray_answers++;
        w->unsure = w->sent_count; /* or one of ours, damaged */
        return;
    }
    struct tx_frame tx = *sent_at(w, i);
    w->asked -= i < w->asked;
    w->unsure -= i < w->unsure;
    for (; i + 1 < w->sent_count; i++)
        *sent_at(w, i) = *sent_at(w, i + 1);
    w->sent_count--;
    w->room = 0;
    w->limit = 1;
    w->settling = w->sent_count;
    ask_again_at(w, now);
    if (w->counters->returned++ % RETURNS_TOLD == 0)
        events_emit(w->line->events, EVENT_FRAME_REFUSED, (uint32_t)w->counters->returned, NULL, 0);
    queue_retry(w->queue, &tx);
}

/* CODEC_STOP, CODEC_GO or CODEC_RETURNED came. */
void level_window_message(struct level_window *w, enum codec_kind kind, const struct can_frame *frame, int64_t now)
{
    if (kind == CODEC_RETURNED) {
        frame_returned(w, frame, now);
    } else if (kind == CODEC_STOP) {
        w->counters->stops++;
        if (!w->stopped)
            w->stopped_ns = now; /* some firmware repeats it */
        w->stopped = true;
        ask_again_at(w, now);
    } else if (w->stopped) {
        w->stopped = false;
        w->room = room_above(w, w->set.ready);
        w->ask_at_ns = now;
    }
}

int64_t level_window_deadline(const struct level_window *w)
{
    bool blocked = queue_waiting(w->queue) && (w->stopped || !w->room);
    bool looks = w->set.ask.length && !w->asking && !w->sent_count && w->queue->gate == GATE_OPEN && !w->line->silent;
    return looks && (blocked || w->level) ? w->ask_at_ns : NEVER;
}
