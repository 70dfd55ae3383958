/* Work for instructions.sh to count: one codec function or the relay, again and again with frames of one kind.
 * Prints how many frames went through. Everything is the same at each run: frames, batches, the time. */
#include "../../bridged/relay/relay.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <unistd.h>

enum { FRAMES = 64, ROUNDS = 50, WIRE = 64 * FRAMES, WINDOW_CAN232 = 32, WINDOW_USB2CAN = 16 };

static struct can_frame frames[FRAMES];
static uint8_t wire[WIRE];
static unsigned long moved;

static void must(bool good, const char *what)
{
    if (good)
        return;
    fprintf(stderr, "instructions: %s\n", what);
    exit(EXIT_FAILURE);
}

static void frames_fill(canid_t flags)
{
    for (size_t i = 0; i < FRAMES; i++) {
        canid_t id = flags & CAN_EFF_FLAG ? (canid_t)i * 0x00345677 & CAN_EFF_MASK : (canid_t)i * 31;
        frames[i] = (struct can_frame){.can_id = id | flags, .len = CAN_MAX_DLEN};
        for (size_t k = 0; k < CAN_MAX_DLEN; k++)
            frames[i].data[k] = (uint8_t)(i * 31 + k * 17);
    }
}

/* All frames as the host sends them; returns the bytes that they take. */
static size_t wire_encode(const struct codec *codec)
{
    size_t n = 0;
    for (size_t i = 0; i < FRAMES; i++)
        n += codec->encode[REMOTE_PLAIN](&frames[i], wire + n);
    return n;
}

/* The same as the device sends them: a USB2CAN says READ_MESSAGE instead of WRITE_MESSAGE. */
static size_t wire_received(const struct codec *codec)
{
    size_t n = wire_encode(codec);
    if (codec == &codec_usb2can)
        for (size_t at = 0; at < n; at += 3 + (size_t)wire[at + 2])
            wire[at + 1]++;
    return n;
}

static void encode(const struct codec *codec)
{
    must(wire_encode(codec) > 0, "nothing encoded");
    moved += FRAMES;
}

static void decode(const struct codec *codec)
{
    struct codec_state state = {0};
    struct codec_message msg;
    struct can_frame frame;
    size_t n = wire_received(codec);
    for (size_t at = 0; at < n; moved++) {
        at += codec->decode(&state, wire + at, n - at, &frame, &msg);
        must(msg.kind == CODEC_FRAME, "not decoded");
    }
}

/* Linked in place of syscall(), by which the relay calls epoll_pwait2: valgrind up to 3.19 does not know it. */
long __wrap_syscall(long number, int epoll_fd, struct epoll_event *ready, int room);

long __wrap_syscall(long number, int epoll_fd, struct epoll_event *ready, int room)
{
    (void)number;
    return epoll_wait(epoll_fd, ready, room, 0);
}

/* --- the relay over socketpairs -------------------------------------------------------------------- */

static struct relay *relay;
static int port, bus; /* the far ends */
static int64_t now = NS_PER_S;

static void turn(void)
{
    now += 1000;
    relay_turn(relay, (struct moment){now, now});
}

static struct counters counted(void)
{
    struct snapshot s;
    relay_snapshot(relay, &s);
    return s.counters;
}

static void relay_start(const struct codec *codec)
{
    static const struct command sync = {.prefix = "V", .prefix_length = 1, .data = "V\r", .length = 2};
    const struct settings set = {
        .codec = codec,
        .queue = {.size = 1024, .deadline_ns = NS_PER_S, .stuck_ns = NS_PER_S},
        .window = codec->confirms == CONFIRMS_LEVEL ? WINDOW_USB2CAN : WINDOW_CAN232,
        .answer_timeout_ns = NS_PER_S,
        .sync = sync,
    };
    int ports[2], buses[2];
    relay = relay_new(&set);
    must(relay && !socketpair(AF_UNIX, SOCK_STREAM | SOCK_NONBLOCK, 0, ports)
             && !socketpair(AF_UNIX, SOCK_SEQPACKET | SOCK_NONBLOCK, 0, buses), "no relay");
    port = ports[1];
    bus = buses[1];
    must(!relay_attach_port(relay, ports[0]) && !relay_attach_interface(relay, buses[0]), "nothing attached");
    relay_set_gates(relay, true, GATE_OPEN);
    if (codec->confirms != CONFIRMS_LEVEL)
        return;
    /* GET and its answer: limits 15 and 7, both buffers empty */
    static const struct level_settings level = {
        .ask = {.prefix = {32}, .prefix_length = 1, .data = {0x0F, 32, 1, 2}, .length = 4},
        .capacity = 18, .critical = 15, .ready = 7,
    };
    relay_set_level_window(relay, &level);
}

/* What the relay has sent: commands and frames, CAN232's end with CR; returns whether it was anything. */
static bool answer(const struct codec *codec)
{
    static const uint8_t level[] = {0x0F, 32, 4, 15, 7, 0, 0};
    bool asks = codec->confirms == CONFIRMS_LEVEL;
    uint8_t in[WIRE];
    ssize_t n = read(port, in, sizeof in);
    if (n <= 0)
        return false;
    for (ssize_t i = 0; i < n && !asks; i++)
        if (in[i] == '\r')
            must(write(port, "z\r", 2) == 2, "no answer");
    if (asks)
        must(write(port, level, sizeof level) == sizeof level, "no answer");
    return true;
}

static void to_device(const struct codec *codec)
{
    for (size_t i = 0; i < FRAMES; i++)
        must(write(bus, &frames[i], sizeof frames[i]) == sizeof frames[i], "the bus is full");
    do
        turn();
    while (answer(codec));
    moved = counted().confirmed;
}

static void to_bus(const struct codec *codec)
{
    struct can_frame frame;
    size_t n = wire_received(codec);
    must(write(port, wire, n) == (ssize_t)n, "the port is full");
    turn();
    for (size_t i = 0; i < FRAMES; i++) {
        must(read(bus, &frame, sizeof frame) == sizeof frame, "frames are missing");
        must(memcmp(&frame, &frames[i], sizeof frame) == 0, "another frame");
    }
    moved = counted().delivered;
}

int main(int argc, char **argv)
{
    static const struct work {
        const char *name;
        void (*round)(const struct codec *codec);
    } works[] = {{"encode", encode}, {"decode", decode}, {"to-device", to_device}, {"to-bus", to_bus}};
    const struct codec *codec = argc == 4 && !strcmp(argv[1], "can232") ? &codec_can232 : &codec_usb2can;

    must(argc == 4, "usage: instructions can232|usb2can encode|decode|to-device|to-bus standard|extended");
    frames_fill(!strcmp(argv[3], "extended") ? CAN_EFF_FLAG : 0);
    for (size_t i = 0; i < sizeof works / sizeof works[0]; i++) {
        if (strcmp(argv[2], works[i].name) != 0)
            continue;
        if (i >= 2)
            relay_start(codec);
        for (int round = 0; round < ROUNDS; round++)
            works[i].round(codec);
    }
    must(moved == (unsigned long)FRAMES * ROUNDS, "frames are missing");
    printf("%lu\n", moved);
    return EXIT_SUCCESS;
}
