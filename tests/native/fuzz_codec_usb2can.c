/*
 * libFuzzer target: any bytes as a stream from a USB2CAN. The codec must keep its contract (codec_check.h), give the
 * same messages however the stream is cut, leave nothing once all is quiet, and every message found must be what the
 * bytes that it ends with say.
 */
#include "codec_check.h"

#include <stdio.h>

enum { BYTES_MAX = 600, MESSAGE_MAX = 18 };

static const struct codec *const codec = &codec_usb2can;

static void expect(bool good, const char *what)
{
    if (good)
        return;
    fprintf(stderr, "codec violation: %s\n", what);
    abort();
}

/* A frame against its bytes, from the frame information on, by way of the encoder. */
static bool frame_says(const struct can_frame *frame, const uint8_t *at, size_t n, bool clean)
{
    uint8_t out[16];
    struct can_frame sent = *frame;
    size_t length = codec->encode[REMOTE_PLAIN](&sent, out);
    bool extended = frame->can_id & CAN_EFF_FLAG, remote = frame->can_id & CAN_RTR_FLAG;
    size_t low = extended ? 4 : 2;
    uint8_t below = extended ? 0x07 : 0x1F, rtr = extended ? 0x04 : 0x10;

    expect(length >= 6 && length <= codec->frame_max, "a frame decoded cannot be encoded");
    expect(out[0] == 0x0F && out[1] == 0x40 && out[2] == length - 3, "an encoded frame is no WRITE_MESSAGE");
    expect(frame->__pad == 0 && frame->__res0 == 0, "padding written");
    for (size_t i = remote ? 0 : frame->len; i < 8; i++)
        expect(frame->data[i] == 0, "data written beyond the length");
    if (frame->len8_dlc) {
        expect(frame->len == 8 && frame->len8_dlc > 8 && frame->len8_dlc < 16, "wrong len8_dlc");
        out[3] = (uint8_t)((out[3] & 0xF0) | frame->len8_dlc);
    }
    if (length - 3 > n || (at[0] & 0xCF) != out[3] || (at[low] & ~below) != out[3 + low])
        return false;
    if (clean && (at[low] & below) && !(remote && (at[low] & below) == rtr))
        return false;
    for (size_t i = 1; i < length - 3; i++)
        if (i != low && at[i] != out[3 + i])
            return false;
    return true;
}

static bool received_says(const struct can_frame *frame, const uint8_t *at, size_t n)
{
    size_t size = 1 + (at[3] & 0x80 ? 4 : 2);
    if (!(at[3] & 0x40))
        size += (at[3] & 15) > 8 ? 8 : at[3] & 15;
    if (at[1] == 0x3F) {
        int one = at[n - 2] << 8 | at[n - 1], other = at[n - 1] << 8 | at[n - 2];
        return n == 3 + size + 2 && (one < 4000 || other < 4000) && frame_says(frame, at + 3, size, true);
    }
    return at[1] == 0x41 && n == 3 + size && frame_says(frame, at + 3, size, true);
}

/* Whether a whole message at[0..n), whose LENGTH is right, is one of those with text. */
static bool text_says(const uint8_t *at, size_t n)
{
    switch (at[1]) {
    case 6:
        return n == 4 && at[3] < 4;
    case 8:
        return n == 8 || n == 9;
    case 9:
        return at[3] == 1 && (n == 9 || n == 10);
    case 16:
        return n == 5 && at[3] < 128;
    case 18:
        return n == 4 && at[3] < 128;
    case 32:
        return n >= 4 && n <= 8;
    case 33:
        for (size_t i = 3; i < n; i++)
            if (at[i] < ' ' || at[i] > '~')
                return false;
        return n == 15;
    case 96:
    case 97:
        return n == 4;
    case 98:
        return n == 5;
    default:
        return false;
    }
}

/* Whether at[0..n) is a whole message that says what the entry does. */
static bool message_says(const struct entry *entry, const uint8_t *at, size_t n)
{
    if (n < 3 || at[0] != 0x0F || at[2] != n - 3)
        return false;
    bool event = at[1] == 9 && n == 5 && at[3] == 2;

    switch (entry->kind) {
    case CODEC_FRAME:
        return n >= 6 && received_says(&entry->frame, at, n);
    case CODEC_RETURNED:
        return n >= 7 && at[1] == 9 && at[3] == 0 && frame_says(&entry->frame, at + 4, n - 4, false);
    case CODEC_TEXT:
        return n >= 4 && entry->text_length == n - 1 && text_says(at, n);
    case CODEC_STOP:
        return event && at[4] == 1;
    case CODEC_GO:
        return event && at[4] == 0;
    case CODEC_OVERRUN:
        return at[1] == 9 && (n == 4 || n == 5) && at[3] == 3;
    case CODEC_IDLE:
        return (at[1] == 62 && n <= 7) || (event && at[4] > 1);
    default:
        return false;
    }
}

static void entry_check(const struct entry *entry, const uint8_t *bytes)
{
    size_t end = entry->start + entry->length;
    bool said = false;

    if (entry->kind == CODEC_SKIPPED)
        return;
    for (size_t n = entry->length; n <= MESSAGE_MAX && n <= end && !said; n++)
        said = message_says(entry, bytes + end - n, n);
    /* Several idle messages are one entry: the last of them will do. */
    for (size_t n = 3; entry->kind == CODEC_IDLE && n <= entry->length && n <= MESSAGE_MAX && !said; n++)
        said = message_says(entry, bytes + end - n, n);
    expect(said, "a message that says something else than its bytes");
}

static void stream_check(const struct transcript *whole, const uint8_t *bytes, size_t n)
{
    size_t accounted = 0;

    for (size_t i = 0; i < whole->count; i++) {
        expect(whole->entries[i].start == accounted, "bytes taken twice or never");
        accounted += whole->entries[i].length;
        entry_check(&whole->entries[i], bytes);
    }
    expect(accounted + whole->pending == n, "bytes lost");
    expect(whole->pending < codec->line_max, "a message that waits for ever");
    expect(!whole->quiet_at_end || whole->pending == 0, "bytes left though all is quiet");
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    static struct entry whole_entries[BYTES_MAX], cut_entries[BYTES_MAX];
    struct transcript whole = {.entries = whole_entries, .capacity = BYTES_MAX};
    struct transcript cut = {.entries = cut_entries, .capacity = BYTES_MAX};
    uint64_t hash = UINT64_C(0xCBF29CE484222325);

    if (n > BYTES_MAX)
        return 0;
    for (size_t i = 0; i < n; i++)
        hash = (hash ^ bytes[i]) * UINT64_C(0x100000001B3);

    whole.quiet_at_end = cut.quiet_at_end = hash >> 40 & 1;
    const char *violated = transcript_decode(&whole, codec, bytes, n, CUT_NOWHERE);
    expect(!violated, violated);
    stream_check(&whole, bytes, n);

    violated = transcript_decode(&cut, codec, bytes, n, n <= 48 || hash % 16 == 0 ? CUT_EVERYWHERE : hash | 2);
    expect(!violated, violated);
    expect(transcript_equal(&whole, &cut), "other messages when cut");
    return 0;
}
