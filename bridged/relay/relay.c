/* The relay: its lock, its descriptors and the loop. The other files have the parts, this one puts them together.
 *
 * The loop's thread holds `lock` all the time except while it waits. */
#include "relay.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdlib.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <sys/syscall.h>
#include <unistd.h>

#include "clock.h"
#include "intake.h"
#include "receive.h"

#ifndef SYS_epoll_pwait2
#define SYS_epoll_pwait2 441 /* in Linux 5.11; unknown to older headers */
#endif

enum source { WAKE = 1, PORT = 2, INTERFACE = 4 };
enum { SOURCES = 3 };

struct relay {
    pthread_mutex_t turnstile; /* held while waiting for `lock` */
    pthread_mutex_t lock;      /* guards all below */
    bool stop, running;
    int wake_fd;         /* eventfd: another thread changed something */
    int epoll_fd;        /* waits for wake_fd, port and interface */
    int port, interface; /* our own, -1: none */
    bool port_full;      /* epoll_fd waits for room in the port, too */
    bool held;           /* the interface is not read */
    uint64_t late_looked; /* frames given to devices when those that may be late were counted last */
    uint32_t attachments; /* counts attach and detach: results of a wait before one are void */

    struct counters counters;
    struct events events;
    struct queue queue;
    struct line line;
    struct ack_window ack;
    struct level_window level;
    struct pace pace;
    struct transmit transmit;
    struct receive receive;
    struct intake intake;
};

/* --- lock ------------------------------------------------------------------------------------ */

/* A thread that gives a mutex back and takes it again at once, as the loop does under a flood, is always faster than
 * one that waits for it. At the turnstile it must queue behind that one. */
static void lock(struct relay *r)
{
    pthread_mutex_lock(&r->turnstile);
    pthread_mutex_lock(&r->lock);
    pthread_mutex_unlock(&r->turnstile);
}

static void unlock(struct relay *r)
{
    pthread_mutex_unlock(&r->lock);
}

void relay_wake(struct relay *r)
{
    eventfd_raise(r->wake_fd);
}

/* After a change that the loop must see. */
static void unlock_wake(struct relay *r)
{
    unlock(r);
    relay_wake(r);
}

/* --- descriptors ----------------------------------------------------------------------------- */

/* Unlike ppoll, epoll is told once what to wait for, not at each turn. -> 0 or errno */
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

/* --- life ------------------------------------------------------------------------------------ */

/* -> 0 or errno */
static int init(struct relay *r, const struct settings *set)
{
    int error = events_init(&r->events, &r->counters);
    if (!error)
        error = queue_init(&r->queue, &set->queue, &r->counters);
    if (error)
        return error;
    r->wake_fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
    r->epoll_fd = epoll_create1(EPOLL_CLOEXEC);
    if (r->wake_fd < 0 || r->epoll_fd < 0)
        return errno;
    return watch(r, EPOLL_CTL_ADD, r->wake_fd, WAKE, EPOLLIN);
}

struct relay *relay_new(const struct settings *set)
{
    struct relay *r = calloc(1, sizeof *r);
    if (!r)
        return NULL;
    r->port = r->interface = r->wake_fd = r->epoll_fd = -1;
    int error = init(r, set);
    if (error) {
        relay_free(r);
        errno = error;
        return NULL;
    }
    pthread_mutex_init(&r->turnstile, NULL);
    pthread_mutex_init(&r->lock, NULL);
    line_init(&r->line, set, &r->counters, &r->events);
    ack_window_init(&r->ack, &r->queue, &r->line);
    level_window_init(&r->level, &r->queue, &r->line);
    transmit_init(&r->transmit, &r->queue, &r->line, &r->ack, &r->level, &r->pace);
    receive_init(&r->receive, &r->transmit);
    intake_init(&r->intake, &r->queue, &r->events);
    return r;
}

void relay_free(struct relay *r)
{
    let_go(r, &r->port);
    let_go(r, &r->interface);
    if (r->wake_fd >= 0)
        close(r->wake_fd);
    if (r->epoll_fd >= 0)
        close(r->epoll_fd);
    events_close(&r->events);
    queue_free(&r->queue);
    free(r);
}

/* --- attach, detach -------------------------------------------------------------------------- */

static void detach_port(struct relay *r)
{
    r->attachments++;
    let_go(r, &r->port);
    if (r->queue.gate == GATE_OPEN || r->queue.gate == GATE_LISTEN_ONLY)
        queue_set_gate(&r->queue, GATE_AWAY);
    receive_reset(&r->receive);
    transmit_reset(&r->transmit);
}

/* `error`: errno, 0 for end of file. */
static void port_lost(struct relay *r, int error)
{
    events_emit(&r->events, EVENT_PORT_LOST, (uint32_t)error, NULL, 0); /* the cause before what it causes */
    detach_port(r);
}

int relay_attach_port(struct relay *r, int fd)
{
    lock(r);
    detach_port(r);
    transmit_forget(&r->transmit);
    r->port_full = false;
    int error = take(r, &r->port, fd, PORT, true);
    unlock_wake(r);
    return error;
}

void relay_detach_port(struct relay *r)
{
    lock(r);
    detach_port(r);
    unlock_wake(r);
}

/* Where the sending ended, after the port was detached. */
struct cut relay_cut(struct relay *r)
{
    lock(r);
    struct cut cut = line_cut(&r->line);
    cut.unread = r->level.unread;
    unlock(r);
    return cut;
}

/* The port attached is that of the cut: the rest of the message goes first. */
void relay_resume(struct relay *r, const struct cut *cut)
{
    lock(r);
    line_resume(&r->line, cut);
    unlock_wake(r);
}

void relay_last_words(struct relay *r, const uint8_t *words, size_t length)
{
    lock(r);
    int error = transmit_last_words(&r->transmit, r->port, words, length);
    if (error)
        port_lost(r, error);
    unlock_wake(r);
}

/* `error`: errno, 0 for end of file. */
static void interface_lost(struct relay *r, int error)
{
    let_go(r, &r->interface);
    events_emit(&r->events, EVENT_INTERFACE_LOST, (uint32_t)error, NULL, 0);
}

/* Frames may wait in it, since the bridge before us had it: of those only their time stamps tell how old they are. */
int relay_attach_interface(struct relay *r, int fd)
{
    lock(r);
    r->attachments++;
    let_go(r, &r->interface);
    intake_attach(&r->intake, clock_moment());
    int error = take(r, &r->interface, fd, INTERFACE, !r->held);
    unlock_wake(r);
    return error;
}

void relay_detach_interface(struct relay *r)
{
    lock(r);
    r->attachments++;
    let_go(r, &r->interface);
    receive_drop(&r->receive, RX_INTERFACE_LOST);
    unlock_wake(r);
}

/* While `held` the interface is not read, whichever is attached: its frames wait in the socket, which stamps them.
 * Those for it go on. */
void relay_hold_interface(struct relay *r, bool held)
{
    lock(r);
    if (r->held != held) {
        r->attachments++;
        r->held = held;
        int error = 0;
        if (held)
            unwatch(r, r->interface);
        else if (r->interface >= 0)
            error = watch(r, EPOLL_CTL_ADD, r->interface, INTERFACE, EPOLLIN);
        if (error)
            interface_lost(r, error);
    }
    unlock_wake(r);
}

/* --- settings, commands, what is told -------------------------------------------------------- */

void relay_set_gates(struct relay *r, bool receiving, enum gate gate)
{
    lock(r);
    receive_set(&r->receive, receiving);
    queue_set_gate(&r->queue, gate);
    unlock_wake(r);
}

int relay_set_queue(struct relay *r, const struct queue_settings *set)
{
    lock(r);
    int error = queue_change(&r->queue, set);
    unlock_wake(r);
    return error;
}

void relay_set_sync(struct relay *r, const struct command *sync)
{
    lock(r);
    line_set_sync(&r->line, sync);
    unlock_wake(r);
}

void relay_set_polling(struct relay *r, const struct command *poll, int64_t interval_ns)
{
    lock(r);
    transmit_poll(&r->transmit, poll, interval_ns);
    unlock_wake(r);
}

void relay_set_sending(struct relay *r, const struct sending_settings *set)
{
    lock(r);
    transmit_set_sending(&r->transmit, set);
    receive_set_stamps(&r->receive, set->long_stamps);
    unlock_wake(r);
}

/* No frame leaves the device, and its buffer, of `kept` frames, outlives what is done about that. Those in it are the
 * last that it got; none is counted twice. */
void relay_count_late(struct relay *r, uint32_t kept)
{
    lock(r);
    const uint64_t given = r->counters.confirmed + r->counters.buffered + r->counters.unconfirmed;
    const uint64_t fresh = given - r->late_looked;
    r->counters.late += fresh < kept ? fresh : kept;
    r->late_looked = given;
    unlock(r);
}

void relay_set_level_window(struct relay *r, const struct level_settings *set)
{
    lock(r);
    level_window_start(&r->level, set);
    unlock_wake(r);
}

/* An event with the command's token always follows. `more`: the loop is woken by the next command. */
void relay_command(struct relay *r, const struct command *command, bool more)
{
    lock(r);
    if (r->port < 0 || !transmit_command(&r->transmit, command))
        events_emit(&r->events, EVENT_TIMEOUT, command->token, NULL, 0);
    unlock(r);
    if (!more)
        relay_wake(r);
}

int relay_event_fd(const struct relay *r)
{
    return r->events.fd;
}

uint32_t relay_take_events(struct relay *r, struct event *batch, uint32_t room)
{
    lock(r);
    uint32_t n = events_take(&r->events, batch, room);
    unlock(r);
    return n;
}

void relay_snapshot(struct relay *r, struct snapshot *out)
{
    lock(r);
    out->counters = r->counters;
    out->queued = transmit_queued(&r->transmit);
    out->pending = r->receive.count;
    unlock(r);
}

/* The buffers of the last batch each way; bytes of a message that was no frame may be among them. */
void relay_glimpse(struct relay *r, struct can_frame *from_interface, struct can_frame *to_interface)
{
    lock(r);
    *from_interface = r->intake.message[0].frame.classic;
    *to_interface = r->receive.frames[0];
    unlock(r);
}

/* --- the loop -------------------------------------------------------------------------------- */

static int64_t earlier(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

static int64_t next_deadline(struct relay *r)
{
    int64_t at = receive_deadline(&r->receive);
    if (transmit_idle(&r->transmit))
        return at;
    if (r->port < 0)
        return earlier(at, queue_expires_ns(&r->queue));
    return earlier(at, transmit_deadline(&r->transmit, r->receive.receiving));
}

/* Waits for room in the port as long as there is something for it. */
static void watch_room(struct relay *r)
{
    bool full = line_waits_for_port(&r->line);
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

/* Waits without the lock until something is there or `until` has come; returns which sources are ready.
 * `turn`: the time of the turn before: where the interface is not ready, its socket was empty after that. */
static unsigned int wait_ready(struct relay *r, struct moment turn, int64_t until)
{
    struct epoll_event ready[SOURCES];
    int64_t wait_ns = until == NEVER ? NEVER : until > turn.boot_ns ? until - turn.boot_ns : 0;
    watch_room(r);
    uint32_t attachments = r->attachments;
    unlock(r);
    long n = wait_epoll(r->epoll_fd, ready, wait_ns);
    lock(r);
    r->counters.turns++;
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
    if (n >= 0 && !(sources & INTERFACE) && !r->held)
        intake_seen_empty(&r->intake, turn);
    return sources;
}

/* EINTR, EAGAIN: epoll tells when. 0: hang-up or end of file. Anything else: the port is gone. */
static void port_ready(struct relay *r, int64_t now)
{
    ssize_t n = receive_read(&r->receive, r->port);
    if (n < 0 && (errno == EINTR || errno == EAGAIN))
        return;
    if (n <= 0) {
        port_lost(r, n ? errno : 0);
        return;
    }
    int error = receive_decode(&r->receive, r->interface, now);
    if (error)
        interface_lost(r, error);
}

/* -> the time now */
static int64_t interface_ready(struct relay *r, struct moment at, bool live)
{
    int64_t now;
    int error = intake_read(&r->intake, r->interface, at, live, &now);
    if (error)
        interface_lost(r, error == INTAKE_END ? 0 : error);
    return now;
}

static void send_waiting(struct relay *r, int64_t now)
{
    if (r->port < 0) {
        queue_expire(&r->queue, true, now);
        return;
    }
    int error = transmit_pump(&r->transmit, r->port, r->receive.receiving, now);
    if (error)
        port_lost(r, error);
}

/* One turn: takes what has come, then sends what may go. `at`: when it began; `live`: time goes on meanwhile.
 * -> when the next turn is due */
static int64_t turn(struct relay *r, unsigned int ready, struct moment at, bool live)
{
    int64_t now = at.boot_ns;
    if (ready & PORT && r->port >= 0)
        port_ready(r, now);
    if (ready & INTERFACE && r->interface >= 0)
        now = interface_ready(r, at, live);
    int error = receive_deadline(&r->receive) <= now ? receive_due(&r->receive, r->interface, now) : 0;
    if (error)
        interface_lost(r, error);
    if (!transmit_idle(&r->transmit))
        send_waiting(r, now);
    return next_deadline(r);
}

/* One turn without waiting, at a time of the caller's choice: tests run the relay on their own clocks. */
int64_t relay_turn(struct relay *r, struct moment at)
{
    lock(r);
    int64_t next = turn(r, wait_ready(r, at, at.boot_ns), at, false);
    unlock(r);
    return next;
}

void relay_stop(struct relay *r)
{
    lock(r);
    r->stop = true;
    unlock_wake(r);
}

/* Turns until relay_stop. Returns at once with EBUSY if another thread runs it. */
int relay_run(struct relay *r)
{
    sigset_t all, before;
    sigfillset(&all);
    pthread_sigmask(SIG_BLOCK, &all, &before); /* signals are for Python's main thread */
    lock(r);
    int result = r->running ? EBUSY : 0;
    if (!result) {
        r->running = true;
        struct moment at = clock_moment();
        int64_t until = turn(r, 0, at, true);
        while (!r->stop) {
            unsigned int ready = wait_ready(r, at, until);
            at = clock_moment();
            until = turn(r, ready, at, true);
        }
        r->running = r->stop = false;
    }
    unlock(r);
    pthread_sigmask(SIG_SETMASK, &before, NULL);
    return result;
}
