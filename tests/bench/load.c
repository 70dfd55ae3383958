/* The load of the benchmarks: plays the adapter (or its host) on a port and a program on the bus at once.
 *
 *   load [OPTION…] PORT BUS [PORT BUS …]
 *
 * PORT is a descriptor that was inherited (the master of a pty, a socket), or the path of a terminal; with "-"
 * there is none, and frames are only put on the bus.
 * BUS is an inherited descriptor (a socketpair's end), or the name of a CAN interface.
 * Frames carry the time when they were sent and a sequence number. After a warm-up the received ones are
 * counted for some seconds, and what the watched processes used meanwhile; then no more are sent, and those
 * on their way are waited for. The result is one JSON object. */
#define _GNU_SOURCE
#include "load.h"

#include <errno.h>
#include <fcntl.h>
#include <getopt.h>
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <poll.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define RECEIVE_BUFFER (32 << 20)
#define STALL_NS (NS_PER_S / 2)   /* nothing came for so long: what is on its way is lost */
#define TIME_MASK ((UINT64_C(1) << 40) - 1)
#define SEQUENCE_MASK ((UINT32_C(1) << SEQUENCE_BITS) - 1)
enum { SAMPLES_MAX = 4000000 };

static struct options set = {.warm_up_s = 0.3, .seconds = 2, .drain_s = 2, .cpu = -1};
static struct channel *channels;
static size_t channel_count;
static struct pollfd *fds; /* of channel n: 2n its port, 2n + 1 its bus */
static int epoll = -1;     /* instead */
static uint64_t sent_total, received_total;
static uint64_t bunched; /* frames that were late, and so went out at once with that before it */
static int64_t measure_from, measure_until, progress_at;
static uint32_t *samples; /* latencies in ns, of frames sent while it was measured */
static size_t sample_count;

int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * NS_PER_S + t.tv_nsec;
}

void fail(const char *what)
{
    fprintf(stderr, "load: %s: %s\n", what, errno ? strerror(errno) : "unexpected");
    exit(1);
}

/* --- frames ---------------------------------------------------------------------------------- */

static void data_stamp(struct channel *ch, uint8_t data[8], int64_t now)
{
    uint64_t value = ((uint64_t)now & TIME_MASK) << SEQUENCE_BITS | (ch->sent & SEQUENCE_MASK);
    for (int i = 8; i--; value >>= 8)
        data[i] = (uint8_t)value;
}

/* A frame came out at the other end: in its order? how long after it was sent? */
void frame_arrived(struct channel *ch, const uint8_t data[8])
{
    ch->received++;
    received_total++;
    if (set.opaque)
        return;
    uint64_t value = 0;
    for (int i = 0; i < 8; i++)
        value = value << 8 | data[i];
    uint32_t sequence = (uint32_t)value & SEQUENCE_MASK, ahead = (sequence - ch->next) & SEQUENCE_MASK;
    if (ahead > SEQUENCE_MASK / 2) {
        ch->misordered++;
        return;
    }
    ch->lost += ahead;
    ch->next = (sequence + 1) & SEQUENCE_MASK;
    int64_t now = now_ns();
    int64_t latency = (int64_t)(((uint64_t)now - (value >> SEQUENCE_BITS)) & TIME_MASK);
    int64_t sent_at = now - latency;
    if (sent_at >= measure_from && sent_at < measure_until && sample_count < SAMPLES_MAX)
        samples[sample_count++] = latency < UINT32_MAX ? (uint32_t)latency : UINT32_MAX;
}

/* One frame into the subject; false: it does not take it now. */
static bool frame_send(struct channel *ch, int64_t now)
{
    uint8_t data[8];
    data_stamp(ch, data, now);
    if (set.direction == TO_BUS) {
        if (ch->out_end + 64 > OUT_SIZE)
            return false;
        port_put_frame(ch, data);
    } else {
        struct can_frame frame = {.can_id = 0x123, .len = 8};
        memcpy(frame.data, data, 8);
        if (send(ch->bus, &frame, sizeof frame, MSG_DONTWAIT | MSG_NOSIGNAL) != sizeof frame) {
            if (errno == EAGAIN || errno == ENOBUFS || errno == EINTR)
                return false;
            fail("sending to the bus");
        }
    }
    ch->sent++;
    sent_total++;
    return true;
}

/* As fast as accepted: a few kilobytes ready for the port, a bounded number of frames on their way. */
static void channel_saturate(struct channel *ch, int64_t now)
{
    if (now - progress_at > STALL_NS)
        ch->answered = ch->sent;
    uint64_t done = ch->received > ch->answered ? ch->received : ch->answered;
    while (ch->sent < done + set.outstanding && ch->out_end < OUT_LEVEL && frame_send(ch, now_ns()))
        ;
}

static void bus_receive(struct channel *ch)
{
    static struct canfd_frame frames[BATCH];
    static struct iovec iov[BATCH];
    static struct mmsghdr messages[BATCH];
    for (int i = 0; i < BATCH && !iov[i].iov_base; i++) {
        iov[i] = (struct iovec){&frames[i], sizeof frames[i]};
        messages[i].msg_hdr = (struct msghdr){.msg_iov = &iov[i], .msg_iovlen = 1};
    }
    int n = recvmmsg(ch->bus, messages, BATCH, MSG_DONTWAIT, NULL);
    if (n < 0 && errno != EAGAIN && errno != EINTR)
        fail("receiving from the bus");
    for (int i = 0; i < n; i++) {
        if (messages[i].msg_len == 0)
            fail("the bus has ended");
        if (frames[i].can_id == 0x123)
            frame_arrived(ch, frames[i].data);
    }
}

/* --- the loop -------------------------------------------------------------------------------- */

/* Sends what is due up to now, round robin, but no more than a batch: who is late must see the end all the same.
 * -> when the next one is due */
static int64_t send_due(int64_t now, int64_t start)
{
    if (set.direction == IDLE)
        return INT64_MAX;
    if (set.rate == 0) {
        for (size_t i = 0; i < channel_count; i++)
            channel_saturate(&channels[i], now);
        return now + STALL_NS;
    }
    for (int n = 0; n < BATCH; n++) {
        int64_t due = start + (int64_t)((double)sent_total / set.rate * NS_PER_S);
        if (due > now)
            return due;
        if (!frame_send(&channels[sent_total % channel_count], now_ns()))
            return now + NS_PER_S / 1000;
        bunched += n > 0;
    }
    return now;
}

static void channel_ready(size_t n, uint32_t events)
{
    struct channel *ch = &channels[n / 2];
    if (n % 2)
        bus_receive(ch);
    else if (events & ~(uint32_t)POLLOUT)
        port_receive(ch);
}

static void epoll_change(int operation, size_t n)
{
    struct epoll_event event = {.events = (uint32_t)fds[n].events, .data.u64 = n};
    if (fds[n].fd >= 0 && epoll_ctl(epoll, operation, fds[n].fd, &event) < 0)
        fail("epoll_ctl");
}

/* POLLIN and the others are EPOLLIN and so on. */
static void epoll_turn(const struct timespec *timeout)
{
    static struct epoll_event events[2 * CHANNELS_MAX];
    int n = epoll_pwait2(epoll, events, 2 * CHANNELS_MAX, timeout, NULL);
    if (n < 0 && errno != EINTR)
        fail("epoll_pwait2");
    for (int i = 0; i < n; i++)
        channel_ready(events[i].data.u64, events[i].events);
}

static void poll_turn(const struct timespec *timeout)
{
    int n = ppoll(fds, 2 * channel_count, timeout, NULL);
    if (n < 0 && errno != EINTR)
        fail("ppoll");
    for (size_t i = 0; n > 0 && i < 2 * channel_count; i++)
        if (fds[i].revents)
            channel_ready(i, (uint32_t)fds[i].revents);
}

/* Waits until then for whatever comes, and takes it. */
static void wait_and_take(int64_t now, int64_t until)
{
    for (size_t i = 0; i < channel_count; i++) {
        short events = POLLIN | (channels[i].out_end ? POLLOUT : 0);
        if (events == fds[2 * i].events)
            continue;
        fds[2 * i].events = events;
        if (epoll >= 0)
            epoll_change(EPOLL_CTL_MOD, 2 * i);
    }
    int64_t left = until > now ? until - now : 0;
    struct timespec timeout = {left / NS_PER_S, left % NS_PER_S};
    if (epoll >= 0)
        epoll_turn(&timeout);
    else
        poll_turn(&timeout);
}

/* One turn; sends only if told to. -> the time */
static int64_t turn(int64_t start, int64_t end, bool sending)
{
    int64_t now = now_ns();
    int64_t until = sending ? send_due(now, start) : now + NS_PER_S / 100;
    uint64_t before = received_total;
    for (size_t i = 0; i < channel_count; i++)
        if (channels[i].out_end)
            port_flush(&channels[i]);
    wait_and_take(now, until < end ? until : end);
    now = now_ns();
    if (received_total != before)
        progress_at = now;
    return now;
}

static uint64_t missing(void)
{
    uint64_t n = 0;
    for (size_t i = 0; i < channel_count; i++)
        n += channels[i].sent - channels[i].received;
    return n;
}

/* --- the result ------------------------------------------------------------------------------ */

static int by_size(const void *a, const void *b)
{
    uint32_t x = *(const uint32_t *)a, y = *(const uint32_t *)b;
    return (x > y) - (x < y);
}

static double latency_us(double share)
{
    size_t at = (size_t)(share * (double)sample_count);
    return samples[at < sample_count ? at : sample_count - 1] / 1e3;
}

static void report(const struct usage *a, const struct usage *b, double wall_s, uint64_t frames)
{
    struct channel sum = {0};
    uint64_t own_lost = 0;
    for (size_t i = 0; i < channel_count; i++) {
        sum.lost += channels[i].lost;
        sum.misordered += channels[i].misordered;
        sum.refusals += channels[i].refusals;
        sum.commands += channels[i].commands;
        own_lost += socket_lost(channels[i].bus);
    }
    printf("{\"wall_s\": %.6f, \"frames\": %llu, \"sent\": %llu, \"received\": %llu, \"missing\": %llu,\n", wall_s,
           (unsigned long long)frames, (unsigned long long)sent_total, (unsigned long long)received_total,
           (unsigned long long)missing());
    printf(" \"gaps\": %llu, \"misordered\": %llu, \"refusals\": %llu, \"commands\": %llu, \"own_lost\": %llu,\n",
           (unsigned long long)sum.lost, (unsigned long long)sum.misordered, (unsigned long long)sum.refusals,
           (unsigned long long)sum.commands, (unsigned long long)own_lost);
    printf(" \"bunched\": %llu,\n", (unsigned long long)bunched);
    printf(" \"cpu_ns\": %llu, \"own_cpu_ns\": %llu, \"busy_ns\": %llu, \"switches\": %llu",
           (unsigned long long)(b->cpu_ns - a->cpu_ns), (unsigned long long)(b->own_cpu_ns - a->own_cpu_ns),
           (unsigned long long)(b->busy_ns - a->busy_ns), (unsigned long long)(b->switches - a->switches));
    if (sample_count) {
        qsort(samples, sample_count, sizeof *samples, by_size);
        printf(",\n \"latency_us\": {\"n\": %zu, \"p50\": %.3f, \"p99\": %.3f, \"p999\": %.3f, \"max\": %.3f}",
               sample_count, latency_us(0.5), latency_us(0.99), latency_us(0.999), latency_us(1));
    }
    printf("}\n");
}

/* --- options --------------------------------------------------------------------------------- */

static bool is_number(const char *text)
{
    return text[0] && strspn(text, "0123456789") == strlen(text);
}

static int port_open(const char *text)
{
    if (!strcmp(text, "-"))
        return -1;
    int fd = is_number(text) ? atoi(text) : open(text, O_RDWR | O_NOCTTY | O_NONBLOCK | O_CLOEXEC);
    struct termios t;
    if (fd < 0 || fcntl(fd, F_SETFL, fcntl(fd, F_GETFL) | O_NONBLOCK) < 0)
        fail(text);
    if (!is_number(text) && !tcgetattr(fd, &t)) {
        cfmakeraw(&t);
        tcsetattr(fd, TCSANOW, &t);
    }
    return fd;
}

static int bus_open(const char *text)
{
    if (is_number(text))
        return atoi(text);
    int fd = socket(AF_CAN, SOCK_RAW | SOCK_CLOEXEC, CAN_RAW);
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = (int)if_nametoindex(text)};
    int size = RECEIVE_BUFFER;
    if (fd < 0 || !address.can_ifindex || bind(fd, (struct sockaddr *)&address, sizeof address) < 0)
        fail(text);
    if (setsockopt(fd, SOL_SOCKET, SO_RCVBUFFORCE, &size, sizeof size) < 0)
        fail("SO_RCVBUFFORCE");
    return fd;
}

static int choice(const char *text, const char *const *names)
{
    for (int i = 0; names[i]; i++)
        if (!strcmp(text, names[i]))
            return i;
    fail(text);
}

static void parse(int argc, char **argv)
{
    static const char *const DIRECTIONS[] = {"to-bus", "to-device", "idle", NULL};
    static const char *const PROTOCOLS[] = {"can232", "host", "usb2can", NULL};
    static const struct option OPTIONS[] = {
        {"direction", 1, 0, 'd'}, {"protocol", 1, 0, 'p'}, {"rate", 1, 0, 'r'},   {"seconds", 1, 0, 's'},
        {"warm-up", 1, 0, 'w'},   {"drain", 1, 0, 'D'},    {"watch", 1, 0, 'W'},  {"outstanding", 1, 0, 'o'},
        {"cpu", 1, 0, 'c'},      {"opaque", 0, 0, 'O'},    {"epoll", 0, 0, 'e'},
        {0},
    };
    for (int option; (option = getopt_long(argc, argv, "", OPTIONS, NULL)) != -1;) {
        switch (option) {
        case 'd': set.direction = (enum direction)choice(optarg, DIRECTIONS); break;
        case 'p': set.protocol = (enum protocol)choice(optarg, PROTOCOLS); break;
        case 'r': set.rate = atof(optarg); break;
        case 's': set.seconds = atof(optarg); break;
        case 'w': set.warm_up_s = atof(optarg); break;
        case 'D': set.drain_s = atof(optarg); break;
        case 'o': set.outstanding = (uint32_t)atoi(optarg); break;
        case 'c': set.cpu = atoi(optarg); break;
        case 'O': set.opaque = true; break;
        case 'e': set.epoll = true; break;
        case 'W':
            if (set.watched_count == WATCH_MAX)
                fail("too many processes to watch");
            set.watched[set.watched_count++] = atoi(optarg);
            break;
        default: exit(2);
        }
    }
    if (!set.outstanding) /* a port takes as many as it has room for */
        set.outstanding = set.direction == TO_BUS ? UINT32_MAX : 128;
    channel_count = (size_t)(argc - optind) / 2;
    if (!channel_count || channel_count > CHANNELS_MAX || (argc - optind) % 2)
        fail("PORT BUS, up to 64 times, is wanted");
    channels = calloc(channel_count, sizeof *channels);
    fds = calloc(2 * channel_count, sizeof *fds);
    samples = malloc(SAMPLES_MAX * sizeof *samples);
    if (!channels || !fds || !samples)
        fail("memory");
    for (size_t i = 0; i < channel_count; i++) {
        channels[i] = (struct channel){
            .set = &set, .port = port_open(argv[optind + 2 * (int)i]), .bus = bus_open(argv[optind + 2 * (int)i + 1])};
        fds[2 * i] = (struct pollfd){.fd = channels[i].port, .events = POLLIN};
        fds[2 * i + 1] = (struct pollfd){.fd = channels[i].bus, .events = POLLIN};
    }
    if (!set.epoll)
        return;
    epoll = epoll_create1(EPOLL_CLOEXEC);
    for (size_t n = 0; n < 2 * channel_count; n++)
        epoll_change(EPOLL_CTL_ADD, n);
}

int main(int argc, char **argv)
{
    prctl(PR_SET_PDEATHSIG, 9);
    prctl(PR_SET_TIMERSLACK, 1);
    parse(argc, argv);
    if (set.cpu >= 0) {
        cpu_set_t cpus;
        CPU_ZERO(&cpus);
        CPU_SET(set.cpu, &cpus);
        if (sched_setaffinity(0, sizeof cpus, &cpus) < 0)
            fail("sched_setaffinity");
    }
    int64_t start = now_ns();
    progress_at = start;
    measure_from = start + (int64_t)(set.warm_up_s * NS_PER_S);
    measure_until = measure_from + (int64_t)(set.seconds * NS_PER_S);
    int64_t now = start;
    while (now < measure_from)
        now = turn(start, measure_from, true);
    int64_t stopped = now_ns();
    struct usage before = usage_now(&set);
    int64_t from = measure_from = now_ns();
    start += from - stopped; /* what was due while the books were read does not come all at once */
    measure_until = from + (int64_t)(set.seconds * NS_PER_S);
    uint64_t received = received_total;
    while (now < measure_until)
        now = turn(start, measure_until, true);
    received = received_total - received;
    int64_t until = now_ns();
    struct usage after = usage_now(&set);
    int64_t give_up = now_ns() + (int64_t)(set.drain_s * NS_PER_S);
    while (missing() && now < give_up) {
        uint64_t had = received_total;
        now = turn(start, give_up, false);
        if (received_total != had)
            give_up = now + (int64_t)(set.drain_s * NS_PER_S);
    }
    report(&before, &after, (double)(until - from) / 1e9, received);
    return 0;
}
