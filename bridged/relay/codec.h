/* Bytes <-> frames: what a codec is. No I/O, no allocation, no statics, no Python. */
#ifndef CAN_BRIDGE_CODEC_H
#define CAN_BRIDGE_CODEC_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include <linux/can.h>

enum codec_kind {
    CODEC_IDLE,    /* bytes without meaning that are no error: line feeds */
    CODEC_FRAME,   /* *frame is filled in */
    CODEC_OK,      /* "\r": a command was done */
    CODEC_SENT,    /* "z\r", "Z\r": a frame was taken for transmission */
    CODEC_REFUSED, /* "\a": a command was refused */
    CODEC_TEXT,    /* any other answer or report, without what frames it: "V1013", "F04"; 06 01 02 */
    CODEC_STOP,    /* the device's transmit buffer is nearly full: send no more */
    CODEC_GO,      /* it has room again */
    CODEC_RETURNED, /* *frame is handed back: the device had no room for it */
    CODEC_OVERRUN, /* the device lost a frame that it received */
    CODEC_SKIPPED, /* bytes that are no message: noise, a frame that contradicts itself */
};

struct codec_message {
    enum codec_kind kind;
    uint8_t stamp_digits;  /* CODEC_FRAME: hex digits of time stamp that followed: 0, 4 or 8 */
    const uint8_t *text;   /* CODEC_TEXT: first byte, inside the caller's input or the codec_state */
    size_t length;         /* CODEC_TEXT: length in bytes. CODEC_SKIPPED: how many bytes are skipped */
};

/* How a device wants a remote frame, where its protocol leaves a choice. */
#define REMOTE_LIST(X) \
    X(REMOTE_PLAIN, "plain") \
    X(REMOTE_WITH_DIGITS, "with-digits") /* with as many zeros behind it as a data frame of its DLC has digits */ \
    X(REMOTE_NO_STANDARD, "no-standard") /* plain; one with a standard identifier cannot be sent */ \
    X(REMOTE_NONE, "none") /* none can be sent */

#define REMOTE_NAME(name, ...) name,
enum remote { REMOTE_LIST(REMOTE_NAME) REMOTES };

/* No codec exceeds these, so buffers have their sizes; each codec asserts its own. */
enum {
    CODEC_LINE_MAX = 256, /* line_max */
    CODEC_FRAME_MAX = 64, /* frame_max */
};

enum { CODEC_KEPT_MAX = 20 }; /* bytes of the longest message of a binary protocol */

/* A decoder's memory between two calls; zero it to start. */
struct codec_state {
    bool doubt; /* not certain where messages begin: a frame counts once something valid follows it */
    bool quiet; /* set by the caller: nothing has come for quiet_ns, decide with what there is */
    bool short_stamps; /* set by the caller: a time stamp has 4 digits, so that 8 are a sign of a broken line */
    union {
        struct {
            bool discarding; /* inside a line that is too long: skip until its end */
            bool dirty;      /* noise was skipped since the last end of line: an empty line means nothing now */
        } can232;
        struct {
            uint8_t kept_length;
            uint8_t kept[CODEC_KEPT_MAX];    /* the last message: the next may begin in it, where bytes were lost */
            uint8_t spliced[CODEC_KEPT_MAX]; /* a message that did */
        } usb2can;
    };
};

/* How the device says what became of the frames that it was sent. */
enum codec_confirms {
    CONFIRMS_EACH,  /* it answers each frame, in order: CODEC_OK, CODEC_SENT or CODEC_REFUSED */
    CONFIRMS_LEVEL, /* it hands back what has no room, and tells on a question how full its buffer is */
};

/*
 * decode: looks at in[0..n), returns how many bytes the first message takes (always <= n), 0 when more
 * bytes are needed to tell. Every call that returns > 0 fills *msg; *frame is written only for
 * CODEC_FRAME and CODEC_RETURNED (all of it: reserved bytes are zero). However a stream is cut, the same
 * frames come out. More bytes are never needed once n >= line_max, so a caller's buffer of that size
 * cannot get stuck.
 *
 * encode: writes one frame as the device wants it, returns its length, 0 if the frame cannot be said in
 * this protocol. Never writes more than frame_max bytes.
 *
 * level: with CONFIRMS_LEVEL, how many frames wait in the device's transmit buffer, if a CODEC_TEXT tells it,
 * else -1.
 *
 * length: of the message to the device that begins at message[0], of n bytes where it and others are.
 *
 * quiet_ns, doubt_quiet_ns: a protocol without ends of lines has no other sign of lost bytes than the time. When
 * bytes that wait for more, of a message or (while `doubt`) behind a frame, have got nothing for so long, the caller
 * decodes them with `quiet` set. 0: they wait for ever, the next end of a line tells.
 *
 * reports: the device also sends texts that nobody asked for.
 */
struct codec {
    const char *name;
    size_t line_max;
    size_t frame_max;
    enum codec_confirms confirms;
    bool reports;
    int64_t quiet_ns, doubt_quiet_ns;
    size_t (*decode)(struct codec_state *state, const uint8_t *in, size_t n, struct can_frame *frame,
                     struct codec_message *msg);
    size_t (*encode[REMOTES])(const struct can_frame *frame, uint8_t *out);
    int (*level)(const uint8_t *text, size_t length);
    size_t (*length)(const uint8_t *message, size_t n);
};

extern const struct codec codec_can232;
extern const struct codec codec_usb2can;

#endif
