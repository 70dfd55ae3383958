/* What the relay does when the interface does not take a frame: one case for each error that the kernel can give.
 * send() and sendmmsg() are replaced (-Wl,--wrap): no interface of a test machine gives all of them. */
#include "check.h"
#include "../../bridged/relay/relay.h"

#include <errno.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

static int next_error;  /* that the next call ends with; 0: it is done by the kernel */
static int error_count; /* how many calls end so */

ssize_t __real_send(int fd, const void *data, size_t n, int flags);
ssize_t __wrap_send(int fd, const void *data, size_t n, int flags);
int __real_sendmmsg(int fd, struct mmsghdr *messages, unsigned n, int flags);
int __wrap_sendmmsg(int fd, struct mmsghdr *messages, unsigned n, int flags);

static bool fails(void)
{
    if (!error_count)
        return false;
    error_count--;
    errno = next_error;
    return true;
}

ssize_t __wrap_send(int fd, const void *data, size_t n, int flags)
{
    return fails() ? -1 : __real_send(fd, data, n, flags);
}

int __wrap_sendmmsg(int fd, struct mmsghdr *messages, unsigned n, int flags)
{
    return fails() ? -1 : __real_sendmmsg(fd, messages, n, flags);
}

struct bench {
    struct relay *relay;
    int port, interface; /* the far ends */
    int near[2];
    int64_t now;
};

static struct bench bench_new(void)
{
    static const struct command sync = {.prefix = "V", .prefix_length = 1, .data = "V\r", .length = 2};
    const struct settings set = {
        .codec = &codec_can232, .window = 1, .answer_timeout_ns = NS_PER_S, .sync = sync,
        .queue = {.size = 16, .deadline_ns = NS_PER_S, .stuck_ns = NS_PER_S}};
    int port[2], interface[2];
    struct bench b = {.relay = relay_new(&set), .now = NS_PER_S};
    if (!b.relay || socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK, 0, port)
        || socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK, 0, interface))
        abort();
    b.port = port[1];
    b.interface = interface[1];
    b.near[0] = port[0];
    b.near[1] = interface[0];
    relay_attach_port(b.relay, port[0]);
    relay_attach_interface(b.relay, interface[0]);
    relay_set_gates(b.relay, true, GATE_AWAY);
    return b;
}

static void bench_free(struct bench *b)
{
    relay_free(b->relay);
    close(b->port);
    close(b->interface);
    close(b->near[0]);
    close(b->near[1]);
}

/* The device sends frames, and the interface fails `times` times. */
static void bench_receive(struct bench *b, unsigned frames, int error, int times)
{
    static const char line[] = "t1231AA\r";
    char lines[300 * (sizeof line - 1)];
    size_t n = 0;
    for (unsigned i = 0; i < frames; i++, n += sizeof line - 1)
        memcpy(lines + n, line, sizeof line - 1);
    if (n && write(b->port, lines, n) != (ssize_t)n)
        abort();
    next_error = error;
    error_count = times;
    b->now += 1000;
    relay_turn(b->relay, (struct moment){b->now, b->now});
}

static unsigned bench_delivered(struct bench *b)
{
    struct can_frame frame;
    unsigned n = 0;
    while (read(b->interface, &frame, sizeof frame) == sizeof frame)
        n++;
    return n;
}

static bool bench_told(struct bench *b, enum event_kind kind)
{
    struct event events[EVENTS_MAX];
    uint32_t n = relay_take_events(b->relay, events, EVENTS_MAX);
    for (uint32_t i = 0; i < n; i++)
        if (events[i].kind == kind)
            return true;
    return false;
}

static struct snapshot bench_counted(struct bench *b)
{
    struct snapshot s;
    relay_snapshot(b->relay, &s);
    return s;
}

/* A call that a signal broke off is made again. */
static void test_interrupted(unsigned frames)
{
    struct bench b = bench_new();
    bench_receive(&b, frames, EINTR, 3);
    CHECK(bench_delivered(&b) == frames);
    CHECK(bench_counted(&b).counters.delivered == frames);
    bench_free(&b);
}

/* No room for the moment: the frames wait, and go when there is some. */
static void test_full(unsigned frames, int error)
{
    struct bench b = bench_new();
    bench_receive(&b, frames, error, 1);
    CHECK(bench_delivered(&b) == 0);
    CHECK(bench_counted(&b).pending == frames);
    b.now += NS_PER_S / 100;
    relay_turn(b.relay, (struct moment){b.now, b.now});
    CHECK(bench_delivered(&b) == frames);
    CHECK(bench_counted(&b).counters.rx_dropped[RX_INTERFACE_FULL] == 0);
    bench_free(&b);
}

/* The interface is down: the frames are dropped, it stays attached and carries the next. */
static void test_down(unsigned frames)
{
    struct bench b = bench_new();
    bench_receive(&b, frames, ENETDOWN, 1);
    CHECK(bench_counted(&b).counters.rx_dropped[RX_INTERFACE_DOWN] == frames);
    CHECK(bench_counted(&b).pending == 0);
    CHECK(!bench_told(&b, EVENT_INTERFACE_LOST));
    bench_receive(&b, frames, 0, 0);
    CHECK(bench_delivered(&b) == frames);
    bench_free(&b);
}

/* Anything else: the interface is gone, which is told; the frames are dropped under that reason. */
static void test_lost(unsigned frames, int error)
{
    struct bench b = bench_new();
    bench_receive(&b, frames, error, 1);
    CHECK(bench_counted(&b).counters.rx_dropped[RX_INTERFACE_LOST] == frames);
    CHECK(bench_told(&b, EVENT_INTERFACE_LOST));
    bench_receive(&b, frames, 0, 0);
    CHECK(bench_counted(&b).counters.rx_dropped[RX_INTERFACE_LOST] == 2 * frames);
    CHECK(bench_delivered(&b) == 0);
    bench_free(&b);
}

int main(void)
{
    for (unsigned frames = 1; frames <= 2; frames++) { /* one by send(), more by sendmmsg() */
        test_interrupted(frames);
        test_full(frames, EAGAIN);
        test_full(frames, ENOBUFS);
        test_down(frames);
        test_lost(frames, ENXIO);
        test_lost(frames, ENODEV);
    }
    test_lost(300, ENXIO); /* in the middle of what was read: more than one batch */
    return checks_end();
}
