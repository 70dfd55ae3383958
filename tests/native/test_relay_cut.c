/* What the relay does with a message of which the port took a part only, cut at every byte.
 * write() is replaced (-Wl,--wrap): no port of a test machine is full at a byte of one's choice. */
#include "check.h"
#include "../../bridged/relay/relay.c" /* to know its descriptor of the port, and to set the window's room */

#include <errno.h>
#include <string.h>
#include <unistd.h>

enum { FRAMES = 3, DEADLINE_NS = 1000000000 };

static int port_fd = -1;
static size_t room; /* of the port, in bytes */
static uint8_t wire[4096];
static size_t wire_length; /* all that the port took, and the device reads once */

ssize_t __real_write(int fd, const void *data, size_t n);
ssize_t __wrap_write(int fd, const void *data, size_t n);

ssize_t __wrap_write(int fd, const void *data, size_t n)
{
    if (fd != port_fd)
        return __real_write(fd, data, n);
    if (!room) {
        errno = EAGAIN;
        return -1;
    }
    n = n < room ? n : room;
    room -= n;
    memcpy(wire + wire_length, data, n);
    wire_length += n;
    return (ssize_t)n;
}

static const struct kind {
    const struct codec *codec;
    const char *sync, *words;
    size_t words_length;
} kinds[] = {
    {&codec_usb2can, "\x0F\x06", "\x0F\x02\x00\x0F\x12\x02\x00\x01", 8},
    {&codec_can232, "V\r", "C\rC\r", 4},
};

struct bench {
    struct relay *relay;
    const struct kind *kind;
    int far[2], near[2]; /* port, interface */
    int64_t now;
    uint8_t frames[FRAMES][64]; /* as the device is to get them */
    size_t lengths[FRAMES];
};

static void bench_attach(struct bench *b)
{
    static const struct level_settings level = {
        .capacity = 18, .critical = 15, .ready = 7, .ask = {.length = 3, .data = {0x0F, 0x06, 0}}};
    relay_attach_port(b->relay, b->near[0]);
    if (b->kind->codec->confirms == CONFIRMS_LEVEL) {
        relay_set_level_window(b->relay, &level);
        b->relay->level.room = FRAMES;
    }
    port_fd = b->relay->port;
}

/* Frames full of the number of each, of which the port takes `taken` bytes in all. */
static struct bench bench_new(const struct kind *kind, size_t taken)
{
    struct settings set = {
        .codec = kind->codec, .window = 16, .answer_timeout_ns = NS_PER_S / 4, .sync = {.length = 2},
        .queue = {.size = 16, .deadline_ns = DEADLINE_NS, .stuck_ns = NS_PER_S}};
    int port[2], interface[2];
    memcpy(set.sync.data, kind->sync, 2);
    struct bench b = {.relay = relay_new(&set), .kind = kind, .now = NS_PER_S};
    if (!b.relay || socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK, 0, port)
        || socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK, 0, interface))
        abort();
    for (int i = 0; i < 2; i++) {
        b.near[i] = i ? interface[0] : port[0];
        b.far[i] = i ? interface[1] : port[1];
    }
    bench_attach(&b);
    relay_attach_interface(b.relay, b.near[1]);
    relay_set_gates(b.relay, false, GATE_OPEN);
    room = taken;
    wire_length = 0;
    for (unsigned i = 0; i < FRAMES; i++) {
        struct can_frame frame = {.can_id = 0x123, .len = 8};
        memset(frame.data, 0xA0 + (int)i, 8);
        b.lengths[i] = kind->codec->encode[REMOTE_PLAIN](&frame, b.frames[i]);
        if (__real_write(b.far[1], &frame, sizeof frame) != sizeof frame)
            abort();
    }
    relay_turn(b.relay, (struct moment){b.now, b.now});
    CHECK(wire_length == taken);
    return b;
}

static void bench_free(struct bench *b)
{
    relay_detach_port(b->relay);
    relay_detach_interface(b->relay);
    relay_free(b->relay);
    for (int i = 0; i < 2; i++) {
        close(b->near[i]);
        close(b->far[i]);
    }
    port_fd = -1;
}

/* The port takes everything again. */
static void bench_drain(struct bench *b)
{
    room = sizeof wire - wire_length;
    b->now += 1000;
    relay_turn(b->relay, (struct moment){b->now, b->now});
}

/* Whether the device got some frames, whole, then exactly this. */
static bool wire_is(const struct bench *b, const void *rest, size_t length)
{
    size_t at = 0;
    for (unsigned i = 0; i < FRAMES && wire_length - at > length; i++) {
        if (wire_length - at < b->lengths[i] || memcmp(wire + at, b->frames[i], b->lengths[i]))
            return false;
        at += b->lengths[i];
    }
    return wire_length - at == length && !memcmp(wire + at, rest, length);
}

/* Whether the device got nothing but whole frames, each once and in order, and this command. */
static bool wire_is_clean(const struct bench *b, const struct command *command)
{
    size_t at = 0, n;
    unsigned next = 0;
    for (; at < wire_length; at += n) {
        n = b->kind->codec->length(wire + at, wire_length - at);
        if (n == command->length && !memcmp(wire + at, command->data, n))
            continue;
        while (next < FRAMES && (n != b->lengths[next] || memcmp(wire + at, b->frames[next], n)))
            next++;
        if (next++ == FRAMES)
            return false;
    }
    return true;
}

static bool bench_lost(struct bench *b)
{
    return b->relay->port < 0;
}

static uint64_t frames_counted(const struct bench *b)
{
    struct snapshot s;
    relay_snapshot(b->relay, &s);
    uint64_t n = s.queued + s.counters.confirmed;
    for (unsigned i = 0; i < TX_DROPS; i++)
        n += s.counters.tx_dropped[i];
    return n;
}

/* The port is given up at the deadline and attached again: first the rest, however often it is cut anew. */
static void test_resumed(const struct kind *kind, size_t taken, size_t more)
{
    static const struct command command = {.length = 4, .data = {0x0F, 0x12, 0x01, 0x00}, .timeout_ns = NS_PER_S};
    struct bench b = bench_new(kind, taken);
    b.now += DEADLINE_NS + 1;
    relay_turn(b.relay, (struct moment){b.now, b.now});
    CHECK(bench_lost(&b));
    for (int i = 0; i < 2; i++) {
        struct cut cut = relay_cut(b.relay);
        CHECK(!cut.length || (cut.taken > 0 && cut.taken < cut.length));
        bench_attach(&b);
        relay_resume(b.relay, &cut);
        relay_command(b.relay, &command, false);
        room = i ? 0 : more;
        b.now += 1000;
        relay_turn(b.relay, (struct moment){b.now, b.now});
        if (i) {
            bench_drain(&b);
        } else {
            b.now += NS_PER_S; /* the rest does not wait for ever, nor does the command */
            relay_turn(b.relay, (struct moment){b.now, b.now});
            relay_detach_port(b.relay);
        }
    }
    CHECK(wire_is_clean(&b, &command));
    CHECK(!memcmp(wire + wire_length - 4, command.data, 4));
    CHECK(frames_counted(&b) == FRAMES);
    CHECK(b.relay->counters.tx_dropped[TX_UNANSWERED] == FRAMES);
    bench_free(&b);
}

/* The device is another one: it gets nothing of that. */
static void test_forgotten(const struct kind *kind, size_t taken)
{
    struct bench b = bench_new(kind, taken);
    b.now += DEADLINE_NS + 1;
    relay_turn(b.relay, (struct moment){b.now, b.now});
    bench_attach(&b);
    wire_length = 0;
    bench_drain(&b);
    CHECK(wire_length == 0);
    CHECK(relay_cut(b.relay).length == 0);
    bench_free(&b);
}

/* The end: the rest, and no other frame, before the channel is closed; at once or when there is room. */
static void test_last_words(const struct kind *kind, size_t taken, bool late)
{
    struct bench b = bench_new(kind, taken);
    size_t begun = 0, at = 0;
    for (; begun < FRAMES && at < taken; begun++)
        at += b.lengths[begun];
    room = late ? 0 : sizeof wire - wire_length;
    relay_last_words(b.relay, (const uint8_t *)kind->words, kind->words_length);
    bench_drain(&b);
    CHECK(wire_is(&b, kind->words, kind->words_length));
    CHECK(wire_length == at + kind->words_length);
    bench_free(&b);
}

int main(void)
{
    for (unsigned k = 0; k < LENGTH(kinds); k++) {
        struct bench b = bench_new(&kinds[k], 0);
        size_t size = 0;
        for (unsigned i = 0; i < FRAMES; i++)
            size += b.lengths[i];
        bench_free(&b);
        for (size_t taken = 0; taken < size; taken++) {
            test_forgotten(&kinds[k], taken);
            test_last_words(&kinds[k], taken, false);
            test_last_words(&kinds[k], taken, true);
            for (size_t more = 0; k == 0 && more < 24; more++)
                test_resumed(&kinds[k], taken, more);
        }
    }
    return checks_end();
}
