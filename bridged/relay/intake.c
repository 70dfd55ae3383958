/* From the interface to the queue.
 *
 * The time stamp of a frame is the wall clock's, which somebody may have set since, or one that the sender made up
 * (SO_TXTIME). So it counts only as far as it can be true: a frame came after its socket was seen empty, and not
 * after it was read. */
#include "intake.h"

#include <errno.h>
#include <string.h>
#include <time.h>

#include "clock.h"

#define STAMP_MAX_S INT64_C(4102444800) /* the year 2100 */

/* Fixed parts of the message headers; what the kernel writes back is renewed before each call. */
void intake_init(struct intake *in, struct queue *queue, struct events *events)
{
    in->counters = queue->counters;
    in->events = events;
    in->queue = queue;
    for (int i = 0; i < INTAKE_BATCH; i++) {
        in->iov[i] = (struct iovec){&in->message[i].frame, sizeof in->message[i].frame};
        in->msg[i].msg_hdr = (struct msghdr){
            .msg_iov = &in->iov[i],
            .msg_iovlen = 1,
            .msg_control = &in->message[i].control,
        };
    }
}

/* Nothing is known of the socket but how the clocks differ at this moment. */
void intake_attach(struct intake *in, struct moment now)
{
    in->empty = (struct moment){0, now.wall_ns - now.boot_ns};
}

void intake_seen_empty(struct intake *in, struct moment at)
{
    in->empty = at;
}

/* The kernel's time stamp on the wall clock; -1: there is none; INT64_MAX: no clock shows it before 2100. */
static int64_t message_stamp(const struct msghdr *h)
{
    for (struct cmsghdr *c = CMSG_FIRSTHDR(h); c; c = CMSG_NXTHDR((struct msghdr *)(uintptr_t)h, c)) {
        if (c->cmsg_level != SOL_SOCKET || c->cmsg_type != SCM_TIMESTAMPNS)
            continue;
        struct timespec t;
        memcpy(&t, CMSG_DATA(c), sizeof t);
        return t.tv_sec >= 0 && t.tv_sec < STAMP_MAX_S ? t.tv_sec * NS_PER_S + t.tv_nsec : INT64_MAX;
    }
    return -1;
}

/* When a frame that was read by `now` was born, on the relay's clock. `offset` turns the wall clock's time into ours,
 * see clock_offset(). A stamp that cannot be true says nothing: the frame counts as old as it can be. Without a stamp
 * it is as young as can be: no interface of ours has such. */
static int64_t frame_born(const struct intake *in, const struct msghdr *h, int64_t offset, int64_t now)
{
    int64_t stamp = message_stamp(h);
    if (stamp < 0)
        return now;
    int64_t born = stamp == INT64_MAX ? stamp : stamp - offset;
    return born < in->empty.boot_ns || born > now ? in->empty.boot_ns : born;
}

/* The wall clock less ours, now or when the socket was seen empty: the one by which frames are older. Where the wall
 * clock was set in between, nobody knows whether before or after a frame. */
static int64_t clock_offset(const struct intake *in, struct moment now)
{
    int64_t before = in->empty.wall_ns - in->empty.boot_ns, after = now.wall_ns - now.boot_ns;
    return before > after ? before : after;
}

static void take_message(struct intake *in, int i, int64_t offset, int64_t now)
{
    const struct mmsghdr *m = &in->msg[i];
    const struct can_frame *frame = &in->message[i].frame.classic;
    in->counters->interface_read++;
    if (m->msg_len == CANFD_MTU)
        queue_drop(in->queue, TX_FD_FRAME);
    else if (m->msg_len != CAN_MTU)
        queue_drop(in->queue, TX_MALFORMED);
    else if (frame->can_id & CAN_ERR_FLAG)
        queue_drop(in->queue, TX_ERROR_FRAME);
    else
        queue_add(in->queue, frame, frame_born(in, &m->msg_hdr, offset, now), now);
}

/* Reads a batch in the turn that began at `turn`. `live`: time has gone on since; `now` becomes that time.
 * EINTR: epoll tells when. EAGAIN, or fewer frames than asked for: the socket was empty. ENETDOWN: the interface went
 * down, which is an event; the socket stays. That may have cut short the batch before, so nobody knows any more since
 * when the socket is empty.
 * An empty message is the end of a socketpair. Anything else: the interface is gone.
 * -> 0, or errno or INTAKE_END of an interface that is gone */
int intake_read(struct intake *in, int interface, struct moment turn, bool live, int64_t *now)
{
    for (int i = 0; i < INTAKE_BATCH; i++)
        in->msg[i].msg_hdr.msg_controllen = sizeof in->message[i].control;
    int n = recvmmsg(interface, in->msg, INTAKE_BATCH, MSG_DONTWAIT, NULL);
    int error = n < 0 ? errno : 0;
    int lost = error == EINTR || error == EAGAIN || error == ENETDOWN ? 0 : error;
    const struct moment at = live ? clock_moment() : turn;
    *now = at.boot_ns;
    if (error == ENETDOWN) {
        in->empty = (struct moment){0, in->empty.wall_ns - in->empty.boot_ns};
        events_emit(in->events, EVENT_INTERFACE_DOWN, 0, NULL, 0);
    }
    int64_t offset = clock_offset(in, at);
    for (int i = 0; i < n; i++) {
        if (in->msg[i].msg_len == 0) {
            lost = INTAKE_END;
            break;
        }
        take_message(in, i, offset, at.boot_ns);
    }
    if (error == EAGAIN || (n >= 0 && n < INTAKE_BATCH))
        in->empty = turn;
    return lost;
}
