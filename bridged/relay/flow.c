/* The window of a device that does not answer frames, but says "stop", "go" and hands back what has no room.
 *
 * Frames are followed by a question (flow.ask). Its answer comes after the device has dealt with all frames
 * before it: those are taken now, unless they were handed back first. It also tells how full the device's
 * buffer is, or at least that it was not full enough for a "stop". So never more frames are on their way
 * than surely fit: a frame that comes back while later ones are taken could not be put in order again. */
#include "relay.h"

#include <string.h>

#define ASK_FIRST_NS INT64_C(1000000)
#define ASK_LAST_NS INT64_C(16000000)
#define STOP_LOOK_NS INT64_C(50000000)   /* how often the level is looked at while stopped: "go" may be lost */
#define STOP_LIMIT_NS INT64_C(500000000) /* after this a stop without a "go" ends by trial, where the level is not told */
#define RETURNS_TOLD 64

bool flow_used(const struct relay *r)
{
    return r->set.codec->confirms == CONFIRMS_LEVEL;
}

static struct tx_frame *sent_at(struct flow *f, uint32_t i)
{
    return &f->sent[(f->sent_head + i) % WINDOW_MAX];
}

static struct tx_frame sent_pop(struct flow *f)
{
    struct tx_frame tx = *sent_at(f, 0);
    f->sent_head = (f->sent_head + 1) % WINDOW_MAX;
    f->sent_count--;
    return tx;
}

static uint32_t room_above(const struct flow *f, uint32_t level)
{
    uint32_t used = level + f->sent_count;
    return f->capacity > used ? f->capacity - used : 0;
}

/* The oldest frame may have been taken or not. */
static void sent_unanswered(struct relay *r)
{
    const struct tx_frame lost = sent_pop(&r->flow);
    r->flow.doubted -= r->flow.doubted > 0;
    queue_drop(r, TX_UNANSWERED);
    queue_overtake(r, &lost);
}

/* The device is initialised: `set` says what to ask and what its buffer holds. */
void flow_start(struct relay *r, const struct flow *set)
{
    flow_reset(r);
    r->flow.ask = set->ask;
    r->flow.capacity = set->capacity;
    r->flow.critical = set->critical;
    r->flow.ready = set->ready;
}

/* Nothing is known of the device's buffer: the first thing to do is to ask. */
void flow_reset(struct relay *r)
{
    struct flow *f = &r->flow;
    while (f->sent_count)
        sent_unanswered(r);
    *f = (struct flow){.limit = r->set.window, .ask_delay_ns = ASK_FIRST_NS};
}

bool flow_ready(const struct relay *r)
{
    const struct flow *f = &r->flow;
    return f->ask.length && !f->stopped && !f->settling && f->room && f->sent_count < f->limit;
}

/* Whether the question goes now. `more`: frames can follow at once, so that it can cover them too.
 * Never two at a time: should one be lost without a trace, the answer to the next would pass for its own. */
bool flow_ask_due(const struct relay *r, bool more, int64_t now)
{
    const struct flow *f = &r->flow;
    if (!f->ask.length || f->asking)
        return false;
    return f->sent_count ? !more : now >= flow_deadline(r);
}

void flow_asked(struct relay *r, int64_t now)
{
    r->flow.asking = true;
    r->flow.asked_ns = now;
    r->flow.asked = r->flow.sent_count;
}

void flow_sent(struct relay *r, const struct tx_frame *tx)
{
    struct flow *f = &r->flow;
    if (!f->sent_count)
        f->noise = r->count.skipped_bytes;
    *sent_at(f, f->sent_count++) = *tx;
    f->room--;
    r->unread = true;
}

/* When the question that tells whether anything can go is due again. */
static void ask_again_at(struct flow *f, int64_t now)
{
    if (f->stopped) {
        f->ask_at_ns = now + STOP_LOOK_NS;
        return;
    }
    f->ask_at_ns = now + f->ask_delay_ns;
    f->ask_delay_ns *= f->ask_delay_ns < ASK_LAST_NS ? 2 : 1;
}

/* The device says how many frames are in its buffer, `taken` more than at the last time. The answer may have
 * waited for us, so it counts as from when the question was put. */
static void level_observe(struct relay *r, uint32_t level, uint32_t taken)
{
    struct flow *f = &r->flow;
    bool left = !f->level || level < f->level + taken;
    f->level = level;
    if (left)
        f->left_at_ns = f->asked_ns;
    if (!level || f->asked_ns - f->left_at_ns <= stuck_ns(r))
        return;
    f->left_at_ns = NEVER; /* said once */
    relay_emit(r, EVENT_STUCK, level, NULL, 0);
}

/* Noise may have been a frame that was handed back: then nothing is certain. */
void flow_answered(struct relay *r, const struct codec_message *msg, int64_t now)
{
    struct flow *f = &r->flow;
    bool grows = false;
    uint32_t taken_count = f->asked;
    if (r->count.skipped_bytes != f->noise)
        f->doubted = f->sent_count;
    f->noise = r->count.skipped_bytes;
    f->asking = false;
    for (; f->asked; f->asked--) {
        if (f->doubted) {
            sent_unanswered(r);
            continue;
        }
        const struct tx_frame taken = sent_pop(f);
        r->count.confirmed++;
        queue_overtake(r, &taken);
        f->ask_delay_ns = ASK_FIRST_NS;
        grows = !f->settling;
    }
    if (grows)
        f->limit = 2 * f->limit < r->set.window ? 2 * f->limit : r->set.window;
    f->settling = f->settling && f->sent_count;
    r->unread = f->sent_count > 0;

    /* A "go" may be lost: the level says the same. Where none is told, one frame goes after some time, to see. */
    int level = r->set.codec->level(msg->text, msg->length);
    bool trial = f->stopped && level < 0 && now - f->stopped_ns >= STOP_LIMIT_NS;
    if (trial || (level >= 0 && level < (int)f->ready))
        f->stopped = false;
    if (level >= 0) {
        level_observe(r, (uint32_t)level, taken_count);
        f->room = room_above(f, (uint32_t)level);
    } else if (trial) {
        f->room = !f->sent_count;
    } else {
        f->room = f->critical < f->capacity ? room_above(f, f->critical) : !f->sent_count;
    }
    if (f->stopped || !f->room)
        ask_again_at(f, now);
    else if (f->level)
        f->ask_at_ns = now + STOP_LOOK_NS;
}

/* Its answer was lost: the frames before it may have been taken, or handed back in what was lost. */
void flow_unanswered(struct relay *r)
{
    struct flow *f = &r->flow;
    f->asking = false;
    for (; f->asked; f->asked--)
        sent_unanswered(r);
    f->doubted = f->sent_count; /* and so may those after them */
    f->room = 0;
    f->settling = f->settling && f->sent_count;
}

static bool frames_equal(const struct can_frame *a, const struct can_frame *b)
{
    size_t data = a->can_id & CAN_RTR_FLAG ? 0 : a->len;
    return a->can_id == b->can_id && a->len == b->len && !memcmp(a->data, b->data, data);
}

/* Which of `sent` the device hands back, sent_count if none: of equal ones the newest, since it is the
 * newest that finds a buffer full, but none after a question that is not answered yet. */
static uint32_t sent_find(struct flow *f, const struct can_frame *frame)
{
    for (uint32_t i = f->asking ? f->asked : f->sent_count; i > 0; i--)
        if (frames_equal(&sent_at(f, i - 1)->frame, frame))
            return i - 1;
    return f->sent_count;
}

/* Handed back: into its place before those not sent yet. One that is not ours is not sent. */
static void frame_returned(struct relay *r, const struct can_frame *frame, int64_t now)
{
    struct flow *f = &r->flow;
    uint32_t i = sent_find(f, frame);
    if (i == f->sent_count) {
        r->count.stray_answers++;
        f->doubted = f->sent_count; /* or one of ours, damaged */
        return;
    }
    struct tx_frame tx = *sent_at(f, i);
    f->asked -= i < f->asked;
    f->doubted -= i < f->doubted;
    for (; i + 1 < f->sent_count; i++)
        *sent_at(f, i) = *sent_at(f, i + 1);
    f->sent_count--;
    f->room = 0;
    f->limit = 1;
    f->settling = f->sent_count;
    ask_again_at(f, now);
    if (r->count.returned++ % RETURNS_TOLD == 0)
        relay_emit(r, EVENT_FRAME_REFUSED, (uint32_t)r->count.returned, NULL, 0);
    if (r->gate == GATE_OPEN)
        queue_retry(r, &tx);
    else
        queue_drop(r, r->gate == GATE_STOPPED ? TX_STOPPED : TX_REFUSED);
}

/* CODEC_STOP, CODEC_GO or CODEC_RETURNED came. */
void flow_message(struct relay *r, enum codec_kind kind, const struct can_frame *frame, int64_t now)
{
    struct flow *f = &r->flow;
    if (kind == CODEC_RETURNED) {
        frame_returned(r, frame, now);
    } else if (kind == CODEC_STOP) {
        r->count.stops++;
        if (!f->stopped)
            f->stopped_ns = now; /* some firmware repeats it */
        f->stopped = true;
        ask_again_at(f, now);
    } else if (f->stopped) {
        f->stopped = false;
        f->room = room_above(f, f->ready);
        f->ask_at_ns = now;
    }
}

int64_t flow_deadline(const struct relay *r)
{
    const struct flow *f = &r->flow;
    bool blocked = queue_waiting(r) && (f->stopped || !f->room);
    bool looks = f->ask.length && !f->asking && !f->sent_count && r->gate == GATE_OPEN && !r->silent;
    return looks && (blocked || f->level) ? f->ask_at_ns : NEVER;
}
