/* Drives a codec through a stream cut in any way, holding it to the contract of codec.h; for tests and fuzzers. */
#ifndef CAN_BRIDGE_CODEC_CHECK_H
#define CAN_BRIDGE_CODEC_CHECK_H

#include "../../bridged/relay/codec.h"

#include <stdlib.h>
#include <string.h>

/* One message of a stream. Skipped or idle bytes in a row are one entry, however many pieces they came in. */
struct entry {
    enum codec_kind kind;
    uint8_t stamp_digits;
    size_t start, length;           /* the bytes of the stream that it took */
    size_t text_start, text_length; /* CODEC_TEXT: where in the stream its text is */
    struct can_frame frame;
};

struct transcript {
    struct entry *entries;
    size_t count, capacity;
    size_t pending;    /* bytes at the end of the stream that still wait for more */
    bool quiet_at_end; /* set by the test: after the stream comes silence, and the codec is told so */
};

enum { CUT_NOWHERE = 0, CUT_EVERYWHERE = 1 }; /* any other value is a seed for cuts at random */

static inline bool has_frame(enum codec_kind kind)
{
    return kind == CODEC_FRAME || kind == CODEC_RETURNED;
}

static inline uint64_t random_next(uint64_t *state)
{
    *state ^= *state << 13;
    *state ^= *state >> 7;
    *state ^= *state << 17;
    return *state;
}

/* What the i-th run of a test passes as cuts: whole, byte by byte, then seeds. */
static inline uint64_t cuts_number(uint64_t i)
{
    return i <= CUT_EVERYWHERE ? i : i * UINT64_C(0x9E3779B97F4A7C15);
}

static inline size_t piece_next(uint64_t *cuts, size_t left)
{
    if (*cuts == CUT_NOWHERE || *cuts == CUT_EVERYWHERE)
        return *cuts == CUT_EVERYWHERE ? 1 : left;
    uint64_t random = random_next(cuts);
    size_t piece = 1 + (size_t)(random >> 8) % ((random & 7) == 0 ? 300 : (random & 7) * 8);
    return piece < left ? piece : left;
}

/* Appends one message; returns what it violates, NULL if nothing. */
static inline const char *transcript_add(struct transcript *transcript, const struct codec_message *msg,
                                         const struct can_frame *frame, const uint8_t *in, size_t start,
                                         size_t length)
{
    if (msg->kind == CODEC_TEXT && (msg->text < in || msg->text + msg->length > in + length))
        return "text outside the bytes of its message";
    if (msg->kind != CODEC_TEXT && msg->text)
        return "text without CODEC_TEXT";
    if (msg->kind == CODEC_SKIPPED ? msg->length != length : msg->kind != CODEC_TEXT && msg->length != 0)
        return "wrong length in the message";
    if (msg->kind != CODEC_FRAME && msg->stamp_digits != 0)
        return "time stamp without CODEC_FRAME";

    struct entry *last = transcript->count ? &transcript->entries[transcript->count - 1] : NULL;
    if (last && last->kind == msg->kind && (msg->kind == CODEC_SKIPPED || msg->kind == CODEC_IDLE)) {
        last->length += length;
        return NULL;
    }
    if (transcript->count == transcript->capacity)
        return "more messages than bytes";
    struct entry *entry = &transcript->entries[transcript->count++];
    memset(entry, 0, sizeof *entry);
    entry->kind = msg->kind;
    entry->stamp_digits = msg->stamp_digits;
    entry->start = start;
    entry->length = length;
    if (msg->kind == CODEC_TEXT) {
        entry->text_start = start + (size_t)(msg->text - in);
        entry->text_length = msg->length;
    }
    if (has_frame(msg->kind))
        entry->frame = *frame;
    return NULL;
}

/* A text that a codec had to put together in its state must still be what the stream says up to bytes[end]. */
static inline const char *transcript_add_spliced(struct transcript *transcript, const struct codec_message *msg,
                                                 const uint8_t *bytes, size_t start, size_t end)
{
    const struct codec_message empty = {.kind = CODEC_TEXT, .text = bytes + start};
    if (msg->length < end - start || msg->length > end)
        return "a spliced text that begins where there is no lost message";
    if (memcmp(bytes + end - msg->length, msg->text, msg->length) != 0)
        return "a spliced text that says something else than the stream";
    const char *violated = transcript_add(transcript, &empty, NULL, bytes + start, start, end - start);
    if (!violated) {
        transcript->entries[transcript->count - 1].text_start = end - msg->length;
        transcript->entries[transcript->count - 1].text_length = msg->length;
    }
    return violated;
}

/* One call, of what lies in in[0..left), where the stream goes on at bytes[done]. */
static inline const char *transcript_step(struct transcript *transcript, const struct codec *codec,
                                          struct codec_state *state, const uint8_t *bytes, size_t done,
                                          const uint8_t *in, size_t left, size_t *taken)
{
    struct codec_state before = *state;
    struct codec_message msg = {.kind = (enum codec_kind)99, .stamp_digits = 99, .text = in, .length = 99};
    struct can_frame poison, frame;

    memset(&poison, 0xA5, sizeof poison);
    frame = poison;
    *taken = codec->decode(state, in, left, &frame, &msg);
    if (*taken > left)
        return "took more bytes than there are";
    if (*taken == 0 && left >= codec->line_max)
        return "stuck with line_max bytes";
    if (*taken == 0 && transcript->quiet_at_end && state->quiet)
        return "waits though all is quiet";
    if (*taken == 0 && memcmp(&before, state, sizeof before) != 0)
        return "changed its state without taking a byte";
    if (state->quiet != before.quiet)
        return "changed what is the caller's";
    if ((*taken == 0 || !has_frame(msg.kind)) && memcmp(&frame, &poison, sizeof frame) != 0)
        return "wrote a frame without CODEC_FRAME or CODEC_RETURNED";
    if (*taken == 0)
        return NULL;
    const uint8_t *spliced = state->usb2can.spliced;
    if (msg.kind == CODEC_TEXT && msg.text >= spliced && msg.text < spliced + sizeof state->usb2can.spliced)
        return transcript_add_spliced(transcript, &msg, bytes, done, done + *taken);
    return transcript_add(transcript, &msg, &frame, in, done, *taken);
}

/*
 * Decodes bytes[0..n) in pieces. What is not yet decoded lies in a heap block of exactly its size, so that
 * AddressSanitizer sees every read past it. Returns what the codec violates, NULL if nothing.
 */
static inline const char *transcript_decode(struct transcript *transcript, const struct codec *codec,
                                            const uint8_t *bytes, size_t n, uint64_t cuts)
{
    struct codec_state state = {0};
    const char *violated = NULL;
    size_t fed = 0, done = 0;

    transcript->count = 0;
    while (!violated && (fed < n || (transcript->quiet_at_end && done < n))) {
        if (fed == n)
            state.quiet = true;
        else
            fed += piece_next(&cuts, n - fed);
        size_t base = done, size = fed - base, taken = 0;
        uint8_t *in = malloc(size);
        if (!in)
            return "out of memory";
        memcpy(in, bytes + base, size);
        do {
            const uint8_t *at = in + (done - base);
            violated = transcript_step(transcript, codec, &state, bytes, done, at, fed - done, &taken);
            done += taken;
        } while (taken > 0 && done < fed && !violated);
        free(in);
    }
    transcript->pending = n - done;
    return violated;
}

static inline bool entry_equal(const struct entry *a, const struct entry *b)
{
    return a->kind == b->kind && a->stamp_digits == b->stamp_digits && a->start == b->start &&
           a->length == b->length && a->text_start == b->text_start && a->text_length == b->text_length &&
           memcmp(&a->frame, &b->frame, sizeof a->frame) == 0;
}

static inline bool transcript_equal(const struct transcript *a, const struct transcript *b)
{
    if (a->count != b->count || a->pending != b->pending)
        return false;
    for (size_t i = 0; i < a->count; i++)
        if (!entry_equal(&a->entries[i], &b->entries[i]))
            return false;
    return true;
}

#endif
