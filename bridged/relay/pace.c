/* Paces frames by the time that each takes on the bus.
 *
 * A frame's length is exact, stuff bits included. What nobody can tell is reckoned to our disadvantage: clocks
 * differ, so a bit takes a hundredth more; a frame is on its way for a time until it reaches a device that does not
 * answer. Frames that others send while ours wait keep ours from leaving, as far as they are received: those behind
 * the device's filter, error frames, and frames that nobody acknowledges are not known. */
#include "pace.h"

#define LATENCY_NS INT64_C(2000000) /* to a device on USB */

static uint32_t place(const struct pace *p, uint32_t i)
{
    return (p->head + i) % DEPTH_MAX;
}

/* How the device wants its frames; until the port is detached. What was reckoned before goes on to count: some
 * devices keep their buffer. */
void pace_set(struct pace *p, const struct sending_settings *set)
{
    p->depth = set->bitrate ? set->depth : 0;
    p->bit_ns = set->bitrate ? (NS_PER_S + NS_PER_S / 100 + set->bitrate - 1) / set->bitrate : 0;
    p->latency_ns = set->answer == ANSWER_NONE ? LATENCY_NS : 0;
}

/* The port is gone or new. */
void pace_reset(struct pace *p)
{
    p->depth = 0;
    p->unanswered = 0;
}

/* The bits of a frame as they go over the bus: ISO 11898-1, 10.5 (bit stuffing), 10.4.2.6 (CRC). */
struct bits {
    uint32_t count, run, last;
    uint32_t crc;
};

static void bits_put(struct bits *b, uint32_t value, int n)
{
    while (n--) {
        uint32_t bit = value >> n & 1;
        b->crc = b->crc << 1 ^ ((b->crc >> 14 & 1) ^ bit ? 0x4599U : 0);
        b->run = bit == b->last ? b->run + 1 : 1;
        b->last = bit;
        b->count++;
        if (b->run == 5) { /* a stuff bit, which may be the first of the next five */
            b->count++;
            b->last = !bit;
            b->run = 1;
        }
    }
}

/* From its start to the first bit that another frame may take. */
static uint32_t frame_bits(const struct can_frame *frame)
{
    enum { DELIMITERS_ACK_END_PAUSE = 1 + 2 + 7 + 3 };
    bool remote = frame->can_id & CAN_RTR_FLAG;
    struct bits b = {.last = 1};

    bits_put(&b, 0, 1);
    if (frame->can_id & CAN_EFF_FLAG) {
        bits_put(&b, frame->can_id >> 18 & CAN_SFF_MASK, 11);
        bits_put(&b, 3, 2);
        bits_put(&b, frame->can_id, 18);
        bits_put(&b, remote, 1);
        bits_put(&b, 0, 2);
    } else {
        bits_put(&b, frame->can_id, 11);
        bits_put(&b, remote, 1);
        bits_put(&b, 0, 2);
    }
    bits_put(&b, frame->len, 4);
    for (int i = 0; !remote && i < frame->len; i++)
        bits_put(&b, frame->data[i], 8);
    bits_put(&b, b.crc & 0x7FFF, 15);
    return b.count + DELIMITERS_ACK_END_PAUSE;
}

/* Takes those out that have left the device, by our reckoning. What it has not answered may still come: the line may
 * have held it up. */
static void look_for_gone(struct pace *p, int64_t now)
{
    while (p->count > p->unanswered && p->ends[p->head] + p->others_ns <= now) {
        p->head = place(p, 1);
        p->count--;
    }
}

/* Whether a frame may go now, where frames are paced. `unanswered`: so many are in flight; 0 where none is answered.
 * The oldest that was answered since the last look had just reached the device, and those behind it came after it. */
bool pace_open(struct pace *p, uint32_t unanswered, int64_t now)
{
    if (unanswered < p->unanswered && p->count) {
        uint32_t oldest = p->count > p->unanswered ? p->count - p->unanswered : 0;
        int64_t end = p->ends[place(p, oldest)] + p->others_ns;
        if (end < now)
            p->others_ns += now - end;
    }
    p->unanswered = unanswered;
    look_for_gone(p, now);
    return p->count < p->depth;
}

/* When a frame that is sent now begins on the bus at the latest. */
int64_t pace_start(const struct pace *p, int64_t now)
{
    int64_t arrives = now + p->latency_ns;
    if (!p->count)
        return arrives;
    int64_t last = p->ends[place(p, p->count - 1)] + p->others_ns;
    return last > arrives ? last : arrives;
}

/* There was room for it. */
void pace_sent(struct pace *p, const struct can_frame *frame, int64_t now)
{
    int64_t end = pace_start(p, now) + frame_bits(frame) * p->bit_ns;
    p->ends[place(p, p->count++)] = end - p->others_ns;
    p->unanswered += !p->latency_ns;
}

/* Somebody else sent a frame. */
void pace_heard(struct pace *p, const struct can_frame *frame, int64_t now)
{
    look_for_gone(p, now);
    if (p->count)
        p->others_ns += frame_bits(frame) * p->bit_ns;
}

/* When frames may go again, where there is no room now. Not for each: while the device has enough to send, some go
 * together. NEVER: not before it answers. */
int64_t pace_deadline(const struct pace *p)
{
    if (!p->depth || p->count < p->depth)
        return NEVER;
    uint32_t i = p->count - p->depth + p->depth / 4;
    return i + p->unanswered < p->count ? p->ends[place(p, i)] + p->others_ns : NEVER;
}
