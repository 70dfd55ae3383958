/* Plain values that the relay and its owner (module*.c) hand each other. */
#ifndef CAN_BRIDGE_VALUES_H
#define CAN_BRIDGE_VALUES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "codec.h"
#include "counters.h"

/* Times are nanoseconds on the relay's clock, see clock.h. */
#define NS_PER_S INT64_C(1000000000)
#define NEVER INT64_MAX

enum {
    QUEUE_MAX = 65536, /* frames that wait for the device, as configured */
    WINDOW_MAX = 32,   /* frames and commands unanswered, as configured */
    DEPTH_MAX = 128,   /* frames in the buffer of a device, where they are reckoned */
    COMMAND_SIZE = 64, /* bytes of one command, and of one frame as it is sent */
    PREFIX_MAX = 4,    /* bytes by which a text is known to be a command's answer */
    EVENT_SIZE = 256,  /* bytes of text in one event */
    EVENTS_MAX = 256,  /* events that Python has not fetched yet */
};

/* Frames read from the interface are sent (GATE_OPEN), or dropped with the reason of this name. */
enum gate { GATE_AWAY, GATE_OPEN, GATE_LISTEN_ONLY, GATE_STOPPED, GATES };

/* Answers that settle a command; a text settles it when it begins with the command's prefix, if it has one. */
enum { ACCEPT_OK = 1, ACCEPT_REFUSED = 2 };

struct command {
    uint32_t token;
    uint8_t accept; /* ACCEPT_… */
    uint8_t prefix_length;
    uint8_t length;
    uint8_t prefix[PREFIX_MAX];
    int64_t timeout_ns; /* 0: settings.answer_timeout_ns */
    uint8_t data[COMMAND_SIZE];
};

struct queue_settings {
    uint32_t size;
    int64_t deadline_ns; /* a frame older than this is not sent */
    int64_t stuck_ns;    /* EVENT_STUCK when no frame has left the device for so long */
};

struct settings {
    const struct codec *codec;
    struct queue_settings queue;
    uint32_t window;
    int64_t answer_timeout_ns; /* of a frame, a poll, a sync command */
    struct command sync;       /* a command with an answer that nothing else gives */
};

/* How a device wants its frames. */
struct sending_settings {
    enum answer answer;
    enum remote remote;
    uint32_t window;  /* frames and commands unanswered; 0: settings.window */
    uint32_t bitrate; /* bit/s: frames go no faster than a bus of this rate takes them; 0: as the answers come */
    bool retries;     /* a refused frame is sent again; else it may have been on the bus */
    bool long_stamps; /* a received frame may have a time stamp of 8 digits */
    uint32_t depth;   /* with a bitrate: frames in the device's own buffer at once */
};

struct level_settings {
    struct command ask; /* answered once all frames before it are taken or handed back; length 0: no frame goes */
    uint32_t capacity, critical, ready; /* frames in the device's buffer: fit surely, stop above, go below */
};

/* Where the sending ended when a port was detached. */
struct cut {
    bool unread;          /* the device may not have read all frames */
    size_t taken, length; /* bytes of the message that the port took in part; length 0: there is none */
    uint8_t message[COMMAND_SIZE];
};

struct event {
    uint8_t kind; /* enum event_kind */
    uint16_t length;
    uint32_t token;
    uint8_t text[EVENT_SIZE];
};

/* The relay's clock and that of the kernel's time stamps at one moment. */
struct moment {
    int64_t boot_ns, wall_ns;
};

#endif
