/* The load of the benchmarks: what load.c, load_port.c and load_probe.c share. */
#ifndef CAN_BRIDGE_BENCH_LOAD_H
#define CAN_BRIDGE_BENCH_LOAD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/types.h>

#define NS_PER_S INT64_C(1000000000)

enum {
    IN_SIZE = 1 << 16,
    OUT_SIZE = 1 << 14,
    OUT_LEVEL = 4096,  /* as fast as accepted: so many bytes are kept ready for the port */
    BATCH = 64,        /* frames per recvmmsg */
    CHANNELS_MAX = 64,
    WATCH_MAX = 64,    /* processes */
    SEQUENCE_BITS = 24,
};

enum direction { TO_BUS, TO_DEVICE, IDLE };
enum protocol {
    CAN232,   /* we are the adapter: frames are answered "z", commands as a CAN232 does */
    HOST,     /* we are the host of a program that plays a CAN232 (slcanpty): nothing is answered */
    USB2CAN,  /* we are the adapter */
};

struct options {
    enum direction direction;
    enum protocol protocol;
    bool opaque;   /* frames come out with other data than they went in: count only */
    bool epoll;    /* wait by epoll: for many channels; to wake us then costs the subject 0.4 µs more */
    double rate;   /* frames a second over all channels; 0: as fast as accepted */
    double warm_up_s, seconds, drain_s;
    uint32_t outstanding; /* as fast as accepted: frames on their way */
    int cpu;
    pid_t watched[WATCH_MAX];
    size_t watched_count;
};

/* One subject: a port and a bus. */
struct channel {
    const struct options *set;
    int port, bus;
    uint64_t sent, received, lost, misordered, refusals, commands;
    uint64_t answered; /* frames received when nothing had come for long: those before are not waited for */
    bool configuring;  /* USB2CAN: mode CONFIG */
    uint32_t next;     /* sequence number that is to come */
    uint8_t in[IN_SIZE];
    size_t in_length;
    uint8_t out[OUT_SIZE];
    size_t out_start, out_end;
};

/* What a process, or several, used up to now. */
struct usage {
    uint64_t cpu_ns;      /* of the watched ones */
    uint64_t switches;    /* voluntary ones of theirs */
    uint64_t own_cpu_ns;  /* of this process */
    uint64_t busy_ns;     /* of the whole machine */
};

/* load.c */
int64_t now_ns(void);
void frame_arrived(struct channel *ch, const uint8_t data[8]);
void fail(const char *what) __attribute__((noreturn));

/* load_port.c: bytes of the port */
void port_put_frame(struct channel *ch, const uint8_t data[8]);
void port_receive(struct channel *ch);
void port_flush(struct channel *ch);

/* load_probe.c: the operating system's books */
struct usage usage_now(const struct options *set);
uint64_t socket_lost(int fd);

#endif
