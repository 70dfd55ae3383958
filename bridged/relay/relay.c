/* The loop: waits, reads the port and the bus in batches, hands bytes to the codec and frames on. */
#include "relay.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

#define RX_STALL_NS INT64_C(100000000) /* how long frames wait for a full bus queue */
#define RX_RETRY_NS INT64_C(1000000)
#define STAMP_MAX_S INT64_C(4102444800)      /* the year 2100 */

#ifndef SYS_epoll_pwait2
#define SYS_epoll_pwait2 441 /* in Linux 5.11; unknown to older headers */
#endif

enum source { WAKE = 1, PORT = 2, BUS = 4 };
enum { SOURCES = 3 };

static int64_t clock_ns(clockid_t clock)
{
    struct timespec t;
    clock_gettime(clock, &t);
    return t.tv_sec * NS_PER_S + t.tv_nsec;
}

/* Counts on while the machine is suspended, so that frames grow old in their sleep too. */
int64_t relay_clock(void)
{
    return clock_ns(CLOCK_BOOTTIME);
}

/* In this order: a process stopped between the two takes its frames for older, never for younger. */
static struct moment moment_now(void)
{
    int64_t boot_ns = relay_clock();
    return (struct moment){boot_ns, clock_ns(CLOCK_REALTIME)};
}

/* --- life ------------------------------------------------------------------------------------ */

/* Fixed parts of the message headers; what the kernel writes back is renewed before each call. */
static void message_headers_init(struct relay *r)
{
    for (int i = 0; i < RX_BATCH; i++) {
        r->rx_iov[i] = (struct iovec){&r->rx[i], sizeof r->rx[i]};
        r->rx_msg[i].msg_hdr = (struct msghdr){.msg_iov = &r->rx_iov[i], .msg_iovlen = 1};
    }
    for (int i = 0; i < BUS_BATCH; i++) {
        r->bus_iov[i] = (struct iovec){&r->bus_message[i].frame, sizeof r->bus_message[i].frame};
        r->bus_msg[i].msg_hdr = (struct msghdr){
            .msg_iov = &r->bus_iov[i],
            .msg_iovlen = 1,
            .msg_control = &r->bus_message[i].control,
        };
    }
}

/* Unlike ppoll it is told once what to wait for, not at each turn. -> 0 or errno */
static int watch(struct relay *r, int operation, int fd, enum source source, uint32_t events)
{
    struct epoll_event wanted = {.events = events, .data.u32 = source};
    return epoll_ctl(r->epoll_fd, operation, fd, &wanted) < 0 ? errno : 0;
}

static void unwatch(struct relay *r, int fd)
{
    if (fd >= 0)
        epoll_ctl(r->epoll_fd, EPOLL_CTL_DEL, fd, NULL);
}

/* To close ours is not enough: while its owner has one open it would be watched on. */
static void let_go(struct relay *r, int *ours)
{
    unwatch(r, *ours);
    if (*ours >= 0)
        close(*ours);
    *ours = -1;
}

/* A descriptor of our own for what `fd` is: whatever its owner does with that number, ours stays what it is.
 * -> 0 or errno */
static int take(struct relay *r, int *ours, int fd, enum source source, bool watched)
{
    *ours = fcntl(fd, F_DUPFD_CLOEXEC, 0);
    int error = *ours < 0 ? errno : watched ? watch(r, EPOLL_CTL_ADD, *ours, source, EPOLLIN) : 0;
    if (error)
        let_go(r, ours);
    return error;
}

struct relay *relay_new(const struct settings *set)
{
    struct relay *r = calloc(1, sizeof *r);
    if (!r)
        return NULL;
    r->set = *set;
    r->port = r->bus = r->wake_fd = r->event_fd = r->epoll_fd = -1;
    r->rx_stalled_ns = r->rx_retry_ns = r->quiet_at_ns = NEVER;
    r->queue = calloc(set->queue, sizeof *r->queue);
    r->wake_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    r->event_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    r->epoll_fd = epoll_create1(EPOLL_CLOEXEC);
    if (!r->queue || r->wake_fd < 0 || r->event_fd < 0 || r->epoll_fd < 0
        || watch(r, EPOLL_CTL_ADD, r->wake_fd, WAKE, EPOLLIN)) {
        int error = errno;
        relay_free(r);
        errno = error;
        return NULL;
    }
    pthread_mutex_init(&r->turnstile, NULL);
    pthread_mutex_init(&r->lock, NULL);
    message_headers_init(r);
    transmit_reset(r);
    return r;
}

void relay_free(struct relay *r)
{
    let_go(r, &r->port);
    let_go(r, &r->bus);
    if (r->wake_fd >= 0)
        close(r->wake_fd);
    if (r->event_fd >= 0)
        close(r->event_fd);
    if (r->epoll_fd >= 0)
        close(r->epoll_fd);
    free(r->queue);
    free(r);
}

/* A thread that gives a mutex back and takes it again at once, as the loop does under a flood, is always faster than
 * one that waits for it. At the turnstile it must queue behind that one. */
void relay_lock(struct relay *r)
{
    pthread_mutex_lock(&r->turnstile);
    pthread_mutex_lock(&r->lock);
    pthread_mutex_unlock(&r->turnstile);
}

void relay_unlock(struct relay *r)
{
    pthread_mutex_unlock(&r->lock);
}

/* An eventfd is full only after 2^64 writes nobody read: the result cannot matter. */
static void eventfd_raise(int fd)
{
    uint64_t one = 1;
    ssize_t ignored = write(fd, &one, sizeof one);
    (void)ignored;
}

void relay_wake(struct relay *r)
{
    eventfd_raise(r->wake_fd);
}

void relay_emit(struct relay *r, enum event_kind kind, uint32_t token, const uint8_t *text, size_t length)
{
    bool news = kind == EVENT_UNASKED || kind == EVENT_NOISE || kind == EVENT_FRAME_REFUSED || kind == EVENT_UNANSWERED || kind == EVENT_STAMPED
        || kind == EVENT_BUS_DOWN;
    if (r->event_count >= (news ? EVENTS_NEWS : EVENTS_MAX)) {
        r->count.events_lost++;
        return;
    }
    struct event *e = &r->events[(r->event_head + r->event_count++) % EVENTS_MAX];
    e->kind = (uint8_t)kind;
    e->token = token;
    e->length = (uint16_t)(length < EVENT_SIZE ? length : EVENT_SIZE);
    if (e->length)
        memcpy(e->text, text, e->length);
    eventfd_raise(r->event_fd);
}

/* --- device -> bus --------------------------------------------------------------------------- */

static void rx_drop(struct relay *r, uint32_t n, enum rx_drop reason)
{
    r->count.rx_dropped[reason] += n;
    r->rx_count -= n;
    memmove(r->rx, r->rx + n, r->rx_count * sizeof r->rx[0]);
}

static void bus_lost(struct relay *r, int error)
{
    if (r->bus < 0)
        return;
    let_go(r, &r->bus);
    relay_emit(r, EVENT_BUS_LOST, (uint32_t)error, NULL, 0);
}

/* EINTR: again. EAGAIN, ENOBUFS: the bus queue is full: wait a little, then drop. ENETDOWN: down,
 * may come back by itself. Anything else: the interface is gone. */
static void rx_failed(struct relay *r, int error, int64_t now)
{
    if (error == EAGAIN || error == ENOBUFS) {
        if (r->rx_stalled_ns == NEVER)
            r->rx_stalled_ns = now;
        r->rx_retry_ns = now + RX_RETRY_NS;
        if (now - r->rx_stalled_ns > RX_STALL_NS)
            rx_drop(r, r->rx_count, RX_BUS_FULL);
        return;
    }
    if (error == ENETDOWN) {
        rx_drop(r, r->rx_count, RX_BUS_DOWN);
        return;
    }
    bus_lost(r, error);
    rx_drop(r, r->rx_count, RX_BUS_LOST);
}

/* A single frame, as they come on most buses, is cheaper without the vector. -> frames sent, or -1 with errno */
static int rx_send(struct relay *r)
{
    if (r->rx_count > 1)
        return sendmmsg(r->bus, r->rx_msg, r->rx_count, MSG_DONTWAIT | MSG_NOSIGNAL);
    return send(r->bus, &r->rx[0], sizeof r->rx[0], MSG_DONTWAIT | MSG_NOSIGNAL) < 0 ? -1 : 1;
}

/* Puts the decoded frames on the bus. */
static void rx_flush(struct relay *r, int64_t now)
{
    if (r->bus < 0)
        rx_drop(r, r->rx_count, RX_BUS_LOST);
    while (r->rx_count) {
        int n = rx_send(r);
        if (n < 0 && errno == EINTR)
            continue;
        if (n < 0) {
            rx_failed(r, errno, now);
            break;
        }
        r->count.delivered += (uint64_t)n;
        r->rx_count -= (uint32_t)n;
        r->rx_stalled_ns = NEVER;
        memmove(r->rx, r->rx + n, r->rx_count * sizeof r->rx[0]);
    }
    if (!r->rx_count)
        r->rx_stalled_ns = r->rx_retry_ns = NEVER;
}

static void rx_frame(struct relay *r, const struct can_frame *frame, const struct codec_message *msg)
{
    r->count.decoded++;
    /* Digits after a remote frame may be the data that some firmware gives it. */
    if (msg->stamp_digits && !(frame->can_id & CAN_RTR_FLAG)) {
        if (!r->stamp_seen)
            relay_emit(r, EVENT_STAMPED, msg->stamp_digits, NULL, 0);
        r->stamp_seen = true;
        r->count.stamped++;
    }
    if (r->receiving)
        r->rx_count++;
    else
        r->count.rx_dropped[RX_NOT_RUNNING]++;
}

/* Decodes what is in the port buffer; an incomplete message stays there. */
static void port_decode(struct relay *r, int64_t now)
{
    struct can_frame spare;
    struct codec_message msg;
    size_t at = 0, used;

    for (; at < r->in_length; at += used) {
        if (r->rx_count == RX_BATCH)
            rx_flush(r, now);
        struct can_frame *frame = r->rx_count < RX_BATCH ? &r->rx[r->rx_count] : &spare;
        used = r->set.codec->decode(&r->decoder, r->in + at, r->in_length - at, frame, &msg);
        if (!used)
            break;
        if (msg.kind == CODEC_FRAME && frame == &spare && r->receiving) {
            r->count.decoded++;
            r->count.rx_dropped[RX_BUS_FULL]++;
        } else if (msg.kind == CODEC_FRAME) {
            rx_frame(r, frame, &msg);
        } else if (msg.kind == CODEC_SKIPPED) {
            r->count.skipped_messages++;
            r->count.skipped_bytes += msg.length;
            if (!r->receiving)
                relay_emit(r, EVENT_NOISE, 0, r->in + at, msg.length);
        } else if (msg.kind == CODEC_OVERRUN) {
            r->count.overruns++;
        } else if (msg.kind != CODEC_IDLE) {
            transmit_answer(r, &msg, frame, now);
        }
    }
    r->in_length -= at;
    memmove(r->in, r->in + at, r->in_length);
    rx_flush(r, now);
}

/* Bytes that wait for more may be a message of which some were lost, and must not become one with
 * those that come much later. */
static void quiet_start(struct relay *r, int64_t now)
{
    const struct codec *codec = r->set.codec;
    r->quiet_at_ns = NEVER;
    if (r->in_length && codec->quiet_ns)
        r->quiet_at_ns = now + (r->decoder.doubt ? codec->doubt_quiet_ns : codec->quiet_ns);
}

static void quiet_over(struct relay *r, int64_t now)
{
    r->decoder.quiet = true;
    port_decode(r, now);
    r->decoder.quiet = false;
    quiet_start(r, now);
}

void relay_port_lost(struct relay *r, int error)
{
    if (r->port < 0)
        return;
    relay_emit(r, EVENT_PORT_LOST, (uint32_t)error, NULL, 0); /* the cause before what it causes */
    relay_detach_port(r);
}

/* EINTR, EAGAIN: poll tells when. 0: hang-up or end of file. Anything else: the port is gone. */
static void port_read(struct relay *r, int64_t now)
{
    ssize_t n = read(r->port, r->in + r->in_length, sizeof r->in - r->in_length);
    if (n < 0 && (errno == EINTR || errno == EAGAIN))
        return;
    if (n <= 0) {
        relay_port_lost(r, n ? errno : 0);
        return;
    }
    r->in_length += (size_t)n;
    port_decode(r, now);
    quiet_start(r, now);
}

/* --- bus -> device --------------------------------------------------------------------------- */

/* The kernel's time stamp on the wall clock; -1 if there is none, INT64_MAX for one that no clock shows before 2100. */
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

/* When a frame that was read by `now` was born, on the relay's clock: by its time stamp as far as that can be true.
 *
 * The stamp is the wall clock's, which somebody may have set since, or one that the sender made up (SO_TXTIME).
 * The frame came after the socket was seen empty, and not after `now`: a stamp that says otherwise says nothing, and
 * the frame counts as old as it can be. `offset` turns the wall clock's time into ours, see clock_offset().
 * Without a stamp it is as young as can be: no bus of ours has such. */
static int64_t frame_born(const struct relay *r, const struct msghdr *h, int64_t offset, int64_t now)
{
    int64_t stamp = message_stamp(h);
    if (stamp < 0)
        return now;
    int64_t born = stamp == INT64_MAX ? stamp : stamp - offset;
    return born < r->empty.boot_ns || born > now ? r->empty.boot_ns : born;
}

/* The wall clock less ours, now or when the socket was seen empty: the one by which frames are older. Where the wall
 * clock was set in between, nobody knows whether before or after a frame. */
static int64_t clock_offset(const struct relay *r, struct moment now)
{
    int64_t before = r->empty.wall_ns - r->empty.boot_ns, after = now.wall_ns - now.boot_ns;
    return before > after ? before : after;
}

static void bus_message(struct relay *r, struct mmsghdr *m, const struct bus_message *b, int64_t offset, int64_t now)
{
    r->count.bus_read++;
    if (m->msg_len == CANFD_MTU)
        queue_drop(r, TX_FD_FRAME);
    else if (m->msg_len != CAN_MTU)
        queue_drop(r, TX_MALFORMED);
    else if (b->frame.classic.can_id & CAN_ERR_FLAG)
        queue_drop(r, TX_ERROR_FRAME);
    else
        queue_add(r, &b->frame.classic, frame_born(r, &m->msg_hdr, offset, now), now);
}

/* Reads a batch in the turn that began at `turn`. `live`: time has gone on since. -> the time now
 * EINTR: poll tells when. EAGAIN, or fewer frames than asked for: the socket was empty. ENETDOWN: the interface went
 * down; said, the socket stays. It may have cut short the batch before, so nothing is known of the socket any more.
 * An empty message is the end of a socketpair. Anything else: the interface is gone. */
static int64_t bus_read(struct relay *r, struct moment turn, bool live)
{
    for (int i = 0; i < BUS_BATCH; i++)
        r->bus_msg[i].msg_hdr.msg_controllen = sizeof r->bus_message[i].control;
    int n = recvmmsg(r->bus, r->bus_msg, BUS_BATCH, MSG_DONTWAIT, NULL);
    int error = n < 0 ? errno : 0;
    const struct moment now = live ? moment_now() : turn;
    if (error == ENETDOWN) {
        r->empty = (struct moment){0, r->empty.wall_ns - r->empty.boot_ns};
        relay_emit(r, EVENT_BUS_DOWN, 0, NULL, 0);
    } else if (error && error != EINTR && error != EAGAIN) {
        bus_lost(r, error);
    }
    int64_t offset = clock_offset(r, now);
    for (int i = 0; i < n; i++) {
        if (r->bus_msg[i].msg_len == 0) {
            bus_lost(r, 0);
            break;
        }
        bus_message(r, &r->bus_msg[i], &r->bus_message[i], offset, now.boot_ns);
    }
    if (error == EAGAIN || (n >= 0 && n < BUS_BATCH))
        r->empty = turn;
    return now.boot_ns;
}

/* --- attach, detach: lock held --------------------------------------------------------------- */

/* -> 0, or errno with none attached */
int relay_attach_port(struct relay *r, int fd)
{
    relay_detach_port(r);
    transmit_forget(r);
    r->port_full = false;
    return take(r, &r->port, fd, PORT, true);
}

/* What it said in part is noise. */
void relay_detach_port(struct relay *r)
{
    r->attachments++;
    let_go(r, &r->port);
    r->receiving = false;
    if (r->gate == GATE_OPEN || r->gate == GATE_LISTEN_ONLY)
        r->gate = GATE_AWAY;
    if (r->in_length) {
        r->count.skipped_messages++;
        r->count.skipped_bytes += r->in_length;
        r->in_length = 0;
    }
    r->decoder = (struct codec_state){0};
    r->quiet_at_ns = NEVER;
    r->stamp_seen = false;
    transmit_reset(r);
}

/* -> 0, or errno with none attached. Frames may wait in it, since the bridge before us had it: of those only their
 * time stamps tell how old they are, and how the clocks differ at this moment. */
int relay_attach_bus(struct relay *r, int fd)
{
    const struct moment now = moment_now();
    r->attachments++;
    let_go(r, &r->bus);
    r->empty = (struct moment){0, now.wall_ns - now.boot_ns};
    return take(r, &r->bus, fd, BUS, !r->bus_held);
}

void relay_detach_bus(struct relay *r)
{
    r->attachments++;
    let_go(r, &r->bus);
    rx_drop(r, r->rx_count, RX_BUS_LOST);
}

/* While `held` the bus is not read, whichever is attached: its frames wait in the socket, which stamps them. Those for
 * it go on. */
void relay_hold_bus(struct relay *r, bool held)
{
    if (r->bus_held == held)
        return;
    r->attachments++;
    r->bus_held = held;
    int error = 0;
    if (held)
        unwatch(r, r->bus);
    else if (r->bus >= 0)
        error = watch(r, EPOLL_CTL_ADD, r->bus, BUS, EPOLLIN);
    if (error)
        bus_lost(r, error);
}

/* --- the loop -------------------------------------------------------------------------------- */

static int64_t next_deadline(struct relay *r)
{
    int64_t at = transmit_idle(r) ? NEVER : transmit_deadline(r);
    at = r->quiet_at_ns < at ? r->quiet_at_ns : at;
    return r->rx_retry_ns < at ? r->rx_retry_ns : at;
}

/* Waits for room in the port as long as there is something for it. */
static void watch_room(struct relay *r)
{
    bool full = r->out_start < r->out_end;
    if (r->port < 0 || full == r->port_full)
        return;
    r->port_full = full;
    watch(r, EPOLL_CTL_MOD, r->port, PORT, full ? EPOLLIN | EPOLLOUT : EPOLLIN);
}

/* For `ns` at most, or NEVER. -> how many sources are ready, or -1. Never fails for long: EINTR cannot happen
 * with all signals blocked, EINVAL would be a bug that shows as a busy loop. */
static long wait_epoll(int epoll_fd, struct epoll_event ready[SOURCES], int64_t ns)
{
    const struct {
        int64_t s, ns; /* struct __kernel_timespec: on a 32-bit machine too */
    } timeout = {ns / NS_PER_S, ns % NS_PER_S};
    long n = syscall(SYS_epoll_pwait2, epoll_fd, ready, SOURCES, ns == NEVER ? NULL : &timeout, NULL, (size_t)0);
    if (n >= 0 || (errno != ENOSYS && errno != EPERM)) /* an older kernel; a filter that does not know the call */
        return n;
    int64_t ms = ns / 1000000 + (ns % 1000000 != 0);
    return epoll_wait(epoll_fd, ready, SOURCES, ns == NEVER ? -1 : ms > INT_MAX ? INT_MAX : (int)ms);
}

/* Waits without the lock until something is there or `until` has come; says which sources are ready.
 * `turn`: the time of the turn before: where the bus is not ready, its socket was empty after that. */
static unsigned int wait_ready(struct relay *r, struct moment turn, int64_t until)
{
    struct epoll_event ready[SOURCES];
    int64_t wait_ns = until == NEVER ? NEVER : until > turn.boot_ns ? until - turn.boot_ns : 0;
    watch_room(r);
    uint32_t attachments = r->attachments;
    relay_unlock(r);
    long n = wait_epoll(r->epoll_fd, ready, wait_ns);
    relay_lock(r);
    r->count.turns++;
    unsigned int sources = 0;
    for (long i = 0; i < n; i++)
        if (ready[i].events & ~(uint32_t)EPOLLOUT)
            sources |= ready[i].data.u32;
    if (sources & WAKE) {
        uint64_t value;
        ssize_t ignored = read(r->wake_fd, &value, sizeof value);
        (void)ignored;
    }
    if (attachments != r->attachments)
        return 0;
    if (n >= 0 && !(sources & BUS) && !r->bus_held)
        r->empty = turn;
    return sources;
}

/* What has come is handled, what may go is sent. `at` is the time of this turn; `live`: it goes on meanwhile. */
static int64_t turn(struct relay *r, unsigned int ready, struct moment at, bool live)
{
    int64_t now = at.boot_ns;
    if (ready & PORT && r->port >= 0)
        port_read(r, now);
    if (ready & BUS && r->bus >= 0)
        now = bus_read(r, at, live);
    if (r->rx_retry_ns <= now)
        rx_flush(r, now);
    if (r->quiet_at_ns <= now)
        quiet_over(r, now);
    if (!transmit_idle(r))
        transmit_pump(r, now);
    return next_deadline(r);
}

/* One turn without waiting, at a time of the caller's choice: tests run the relay on their own clocks. */
int64_t relay_turn(struct relay *r, struct moment at)
{
    return turn(r, wait_ready(r, at, at.boot_ns), at, false);
}

/* Turns until relay_stop. Returns at once with EBUSY if another thread runs it. */
int relay_run(struct relay *r)
{
    sigset_t all, before;
    sigfillset(&all);
    pthread_sigmask(SIG_BLOCK, &all, &before); /* signals are for Python's main thread */
    relay_lock(r);
    int result = r->running ? EBUSY : 0;
    if (!result) {
        r->running = true;
        struct moment at = moment_now();
        int64_t until = turn(r, 0, at, true);
        while (!r->stop) {
            unsigned int ready = wait_ready(r, at, until);
            at = moment_now();
            until = turn(r, ready, at, true);
        }
        r->running = r->stop = false;
    }
    relay_unlock(r);
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    return result;
}
