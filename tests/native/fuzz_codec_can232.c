/*
 * libFuzzer target: any bytes as a stream from a CAN232. The codec must keep its contract (codec_check.h), give the
 * same messages however the stream is cut, and every frame found must say what its line says and survive encoding.
 */
#include "codec_check.h"

#include <stdio.h>

enum { BYTES_MAX = 600 }; /* fuzz.sh makes none longer: more than two lines of line_max */

static const struct codec *const codec = &codec_can232;

static void expect(bool good, const char *what)
{
    if (good)
        return;
    fprintf(stderr, "codec violation: %s\n", what);
    abort();
}

static uint8_t upper(uint8_t byte)
{
    return byte >= 'a' && byte <= 'f' ? (uint8_t)(byte - 'a' + 'A') : byte;
}

/* A frame against its line, by way of the encoder, which knows no lower case, time stamp or DLC above 8. */
static void frame_check(const struct entry *entry, const uint8_t *line)
{
    const struct can_frame *frame = &entry->frame;
    uint8_t *out = malloc(codec->frame_max);
    expect(out != NULL, "out of memory");
    size_t n = codec->encode[REMOTE_PLAIN](frame, out);
    size_t dlc_at = frame->can_id & CAN_EFF_FLAG ? 9 : 4;

    expect(n > dlc_at && n <= codec->frame_max, "a frame decoded cannot be encoded");
    size_t extra = entry->length - n - entry->stamp_digits;
    bool with_data = frame->can_id & CAN_RTR_FLAG && extra == 2 * (size_t)frame->len;
    expect(entry->length >= n && (extra == 0 || with_data), "a frame of another length than its line");
    expect(line[entry->length - 1] == '\r' && out[n - 1] == '\r', "a frame without CR");
    expect(line[0] == out[0], "a frame of another type than its line");
    for (size_t i = 1; i < n - 1; i++) {
        uint8_t said = i == dlc_at && frame->len8_dlc ? (uint8_t)"9ABCDEF"[(frame->len8_dlc - 9) % 7] : out[i];
        expect(upper(line[i]) == said, "a frame that says something else than its line");
    }
    expect(frame->__pad == 0 && frame->__res0 == 0, "padding written");
    expect(frame->len8_dlc == 0 || (frame->len == 8 && frame->len8_dlc > 8 && frame->len8_dlc < 16),
           "wrong len8_dlc");

    struct codec_state state = {0};
    struct codec_message msg;
    struct can_frame back, sent = *frame;
    sent.len8_dlc = 0;
    expect(codec->decode(&state, out, n, &back, &msg) == n && msg.kind == CODEC_FRAME, "an encoded frame is none");
    expect(memcmp(&back, &sent, sizeof back) == 0, "an encoded frame came back different");
    free(out);
}

static void entry_check(const struct entry *entry, const uint8_t *at)
{
    size_t n = entry->length;

    switch (entry->kind) {
    case CODEC_FRAME:
        frame_check(entry, at);
        break;
    case CODEC_OK:
        expect(n == 1 && at[0] == '\r', "OK that is no CR");
        break;
    case CODEC_SENT:
        expect(n == 2 && (at[0] == 'z' || at[0] == 'Z') && at[1] == '\r', "SENT that is no z");
        break;
    case CODEC_REFUSED:
        expect(n == 1 && at[0] == '\a', "REFUSED that is no BELL");
        break;
    case CODEC_TEXT:
        expect(n >= 2 && entry->text_start == entry->start && entry->text_length == n - 1, "TEXT that is no line");
        expect(at[n - 1] == '\r' && !strchr("tTrR", at[0]), "TEXT that is no text");
        for (size_t i = 0; i < n - 1; i++)
            expect((at[i] >= ' ' && at[i] <= '~') || (i && at[i] == '\t'), "TEXT that cannot be printed");
        break;
    case CODEC_IDLE:
        for (size_t i = 0; i < n; i++)
            expect(at[i] == '\n', "IDLE that is no line feed");
        break;
    case CODEC_SKIPPED:
        expect(!memchr(at, '\a', n), "BELL skipped");
        break;
    default:
        expect(false, "unknown kind");
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *bytes, size_t n)
{
    static struct entry whole_entries[BYTES_MAX], cut_entries[BYTES_MAX];
    struct transcript whole = {.entries = whole_entries, .capacity = BYTES_MAX};
    struct transcript cut = {.entries = cut_entries, .capacity = BYTES_MAX};
    uint64_t hash = UINT64_C(0xCBF29CE484222325);
    size_t accounted = 0;

    if (n > BYTES_MAX)
        return 0;
    for (size_t i = 0; i < n; i++)
        hash = (hash ^ bytes[i]) * UINT64_C(0x100000001B3);

    const char *violated = transcript_decode(&whole, codec, bytes, n, CUT_NOWHERE);
    expect(!violated, violated);
    for (size_t i = 0; i < whole.count; i++) {
        expect(whole.entries[i].start == accounted, "bytes taken twice or never");
        accounted += whole.entries[i].length;
        entry_check(&whole.entries[i], bytes + whole.entries[i].start);
    }
    expect(accounted + whole.pending == n, "bytes lost");
    expect(whole.pending < codec->line_max, "a line that waits for ever");

    /* Byte by byte costs the square of a line's length: always for short inputs, sometimes for long ones. */
    uint64_t cuts = n <= 48 || hash % 64 == 0 ? CUT_EVERYWHERE : hash | 2;
    violated = transcript_decode(&cut, codec, bytes, n, cuts);
    expect(!violated, violated);
    expect(transcript_equal(&whole, &cut), "other messages when cut");
    return 0;
}
