/* From the device to the interface. */
#include "receive.h"

#include <assert.h>
#include <errno.h>
#include <string.h>
#include <unistd.h>

#define STALL_NS INT64_C(100000000) /* how long frames wait for an interface that has no room */
#define RETRY_NS INT64_C(1000000)

static_assert((int)CODEC_LINE_MAX <= (int)PORT_BUFFER, "a message waits in `in` until all of it is there");

/* The message headers stay as they are. */
void receive_init(struct receive *rc, struct transmit *transmit)
{
    rc->counters = transmit->counters;
    rc->events = transmit->events;
    rc->transmit = transmit;
    rc->codec = transmit->line->codec;
    rc->stalled_ns = rc->retry_at_ns = rc->quiet_at_ns = NEVER;
    rc->decoder.short_stamps = true;
    for (int i = 0; i < RX_BATCH; i++) {
        rc->iov[i] = (struct iovec){&rc->frames[i], sizeof rc->frames[i]};
        rc->msg[i].msg_hdr = (struct msghdr){.msg_iov = &rc->iov[i], .msg_iovlen = 1};
    }
}

/* The port is gone. A message of which only a part has come is noise. */
void receive_reset(struct receive *rc)
{
    rc->receiving = rc->stamp_seen = false;
    rc->decoder = (struct codec_state){.short_stamps = true};
    rc->quiet_at_ns = NEVER;
    if (!rc->in_length)
        return;
    rc->counters->skipped_messages++;
    rc->counters->skipped_bytes += rc->in_length;
    rc->in_length = 0;
}

/* Whether frames are wanted; else they are dropped. */
void receive_set(struct receive *rc, bool receiving)
{
    rc->receiving = receiving;
}

/* Until the port is detached. */
void receive_set_stamps(struct receive *rc, bool longer)
{
    rc->decoder.short_stamps = !longer;
}

/* --- to the interface ------------------------------------------------------------------------ */

static void batch_shift(struct receive *rc, uint32_t n)
{
    rc->count -= n;
    memmove(rc->frames, rc->frames + n, rc->count * sizeof rc->frames[0]);
}

/* All frames that wait. */
void receive_drop(struct receive *rc, enum rx_drop reason)
{
    rc->counters->rx_dropped[reason] += rc->count;
    rc->count = 0;
}

/* EAGAIN, ENOBUFS: the interface has no room: wait a little, then drop. ENETDOWN: it is down, and may come back by
 * itself. Anything else: it is gone. -> 0, or errno of an interface that is gone */
static int batch_failed(struct receive *rc, int error, int64_t now)
{
    if (error == EAGAIN || error == ENOBUFS) {
        if (rc->stalled_ns == NEVER)
            rc->stalled_ns = now;
        rc->retry_at_ns = now + RETRY_NS;
        if (now - rc->stalled_ns > STALL_NS)
            receive_drop(rc, RX_INTERFACE_FULL);
        return 0;
    }
    receive_drop(rc, error == ENETDOWN ? RX_INTERFACE_DOWN : RX_INTERFACE_LOST);
    return error == ENETDOWN ? 0 : error;
}

/* A single frame, as they come on most buses, is cheaper without the vector. -> frames sent, or -1 with errno */
static int batch_send(struct receive *rc, int interface)
{
    if (rc->count > 1)
        return sendmmsg(interface, rc->msg, rc->count, MSG_DONTWAIT | MSG_NOSIGNAL);
    return send(interface, &rc->frames[0], sizeof rc->frames[0], MSG_DONTWAIT | MSG_NOSIGNAL) < 0 ? -1 : 1;
}

/* Puts the decoded frames on the interface; -1: there is none. EINTR: again.
 * -> 0, or errno of an interface that is gone */
static int batch_flush(struct receive *rc, int interface, int64_t now)
{
    int error = 0;
    if (interface < 0)
        receive_drop(rc, RX_INTERFACE_LOST);
    while (rc->count) {
        int n = batch_send(rc, interface);
        if (n < 0 && errno == EINTR)
            continue;
        if (n < 0) {
            error = batch_failed(rc, errno, now);
            break;
        }
        rc->counters->delivered += (uint64_t)n;
        rc->stalled_ns = NEVER;
        batch_shift(rc, (uint32_t)n);
    }
    if (!rc->count)
        rc->stalled_ns = rc->retry_at_ns = NEVER;
    return error;
}

/* --- from the device ------------------------------------------------------------------------- */

/* Digits after a remote frame may be the data that some firmware gives it. */
static void note_stamp(struct receive *rc, const struct can_frame *frame, uint8_t digits)
{
    if (frame->can_id & CAN_RTR_FLAG)
        return;
    if (!rc->stamp_seen)
        events_emit(rc->events, EVENT_STAMPED, digits, NULL, 0);
    rc->stamp_seen = true;
    rc->counters->stamped++;
}

/* `frame` is the next of the batch, or a spare one where that is full. */
static void take_frame(struct receive *rc, const struct can_frame *frame, const struct codec_message *msg)
{
    rc->counters->decoded++;
    if (!rc->receiving)
        rc->counters->rx_dropped[RX_NOT_RUNNING]++;
    else if (rc->count == RX_BATCH)
        rc->counters->rx_dropped[RX_INTERFACE_FULL]++;
    else
        rc->count++;
    if (msg->stamp_digits)
        note_stamp(rc, frame, msg->stamp_digits);
}

static void take_noise(struct receive *rc, const uint8_t *bytes, size_t length)
{
    rc->counters->skipped_messages++;
    rc->counters->skipped_bytes += length;
    if (!rc->receiving)
        events_emit(rc->events, EVENT_NOISE, 0, bytes, length);
}

/* Bytes that wait for more may be a message of which some were lost, and must not become one with those that come
 * much later. */
static void quiet_start(struct receive *rc, int64_t now)
{
    rc->quiet_at_ns = NEVER;
    if (rc->in_length && rc->codec->quiet_ns)
        rc->quiet_at_ns = now + (rc->decoder.doubt ? rc->codec->doubt_quiet_ns : rc->codec->quiet_ns);
}

/* Reads what the port has. -> as read() */
ssize_t receive_read(struct receive *rc, int port)
{
    ssize_t n = read(port, rc->in + rc->in_length, sizeof rc->in - rc->in_length);
    if (n > 0)
        rc->in_length += (size_t)n;
    return n;
}

/* Decodes what was read; an incomplete message waits for more. -> 0, or errno of an interface that is gone */
int receive_decode(struct receive *rc, int interface, int64_t now)
{
    struct can_frame spare;
    struct codec_message msg;
    size_t at = 0, used;
    bool paced = rc->transmit->pace->depth;
    int error = 0;

    for (; at < rc->in_length; at += used) {
        if (rc->count == RX_BATCH && !error)
            error = batch_flush(rc, interface, now);
        struct can_frame *frame = rc->count < RX_BATCH ? &rc->frames[rc->count] : &spare;
        used = rc->codec->decode(&rc->decoder, rc->in + at, rc->in_length - at, frame, &msg);
        if (!used)
            break;
        if (paced && msg.kind == CODEC_FRAME)
            pace_heard(rc->transmit->pace, frame, now);
        if (msg.kind == CODEC_FRAME)
            take_frame(rc, frame, &msg);
        else if (msg.kind == CODEC_SKIPPED)
            take_noise(rc, rc->in + at, msg.length);
        else if (msg.kind == CODEC_OVERRUN)
            rc->counters->overruns++;
        else if (msg.kind != CODEC_IDLE)
            transmit_answer(rc->transmit, &msg, frame, now);
    }
    rc->in_length -= at;
    memmove(rc->in, rc->in + at, rc->in_length);
    if (error)
        receive_drop(rc, RX_INTERFACE_LOST);
    else
        error = batch_flush(rc, interface, now);
    quiet_start(rc, now);
    return error;
}

/* Does what is due without any input: frames that the interface had no room for, bytes that wait for more.
 * -> 0, or errno of an interface that is gone */
int receive_due(struct receive *rc, int interface, int64_t now)
{
    int error = rc->retry_at_ns <= now ? batch_flush(rc, interface, now) : 0;
    if (!error && rc->quiet_at_ns <= now) {
        rc->decoder.quiet = true;
        error = receive_decode(rc, interface, now);
        rc->decoder.quiet = false;
    }
    return error;
}

int64_t receive_deadline(const struct receive *rc)
{
    return rc->retry_at_ns < rc->quiet_at_ns ? rc->retry_at_ns : rc->quiet_at_ns;
}
