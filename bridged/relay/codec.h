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
    CODEC_TEXT,    /* any other line of printable ASCII, without its end: "V1013", "F04", "A" */
    CODEC_SKIPPED, /* bytes that are no message: noise, a frame that contradicts itself */
};

struct codec_message {
    enum codec_kind kind;
    uint8_t stamp_digits;  /* CODEC_FRAME: hex digits of time stamp that followed: 0, 4 or 8 */
    const uint8_t *text;   /* CODEC_TEXT: first byte, inside the caller's input */
    size_t length;         /* CODEC_TEXT: length in bytes. CODEC_SKIPPED: how many bytes are skipped */
};

/* What a decoder must remember between two calls; zero it to start. */
struct codec_state {
    bool discarding; /* inside a line that is too long: skip until its end */
    bool dirty;      /* noise was skipped since the last end of line: an empty line means nothing now */
};

/*
 * decode: looks at in[0..n), returns how many bytes the first message takes (always <= n), 0 when more
 * bytes are needed to tell. Every call that returns > 0 fills *msg; *frame is written only for
 * CODEC_FRAME (all of it: reserved bytes are zero). However a stream is cut, the same frames come out.
 * More bytes are never needed once n >= line_max, so a caller's buffer of that size cannot get stuck.
 *
 * encode: writes one frame as the device wants it, returns its length, 0 if the frame cannot be said in
 * this protocol. Never writes more than frame_max bytes.
 */
struct codec {
    const char *name;
    size_t line_max;
    size_t frame_max;
    size_t (*decode)(struct codec_state *state, const uint8_t *in, size_t n, struct can_frame *frame,
                     struct codec_message *msg);
    size_t (*encode)(const struct can_frame *frame, uint8_t *out);
};

extern const struct codec codec_can232;

#endif
