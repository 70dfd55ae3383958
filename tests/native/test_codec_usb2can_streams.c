/* codec_usb2can.c in the large: random messages in any cuts, damaged streams, any bytes at all. */
#include "check.h"
#include "codec_check.h"

enum { CUTS = 12, MESSAGES = 40, MESSAGE_MAX = 18, STREAM_MAX = 1024, DAMAGE_MAX = 16 };

#ifndef DAMAGED
#define DAMAGED 10000 /* streams of each filling */
#endif

static const struct codec *const codec = &codec_usb2can;

static size_t random_below(uint64_t *random, size_t n)
{
    return (size_t)(random_next(random) >> 16) % n;
}

/* ---- Messages as the device sends them */

enum filling { FILL_ANY, FILL_STARTS, FILL_MESSAGES };

static size_t random_message(uint64_t *random, enum filling filling, uint8_t *out);

/* A byte of data: any, or one of those that messages begin with. */
static uint8_t random_byte(uint64_t *random, enum filling filling)
{
    static const uint8_t alphabet[] = {0x0F, 0x0F, 0x0F, 0x41, 0x41, 0x3F, 0x09, 0x06, 0x0B, 0x0D, 0x03, 0x02,
                                       0x08, 0x00, 0x00, 0x88, 0x12, 0x01, 0x20, 0x3E, 0x60, 0x10, 0x62, 0x05};
    size_t any = random_below(random, 256);
    return filling == FILL_ANY ? (uint8_t)any : alphabet[any % sizeof alphabet];
}

/* Frame information, identifier, data; with_dirt: the bits below the identifier may hold anything. */
static size_t random_frame(uint64_t *random, enum filling filling, bool with_dirt, uint8_t *out)
{
    bool extended = random_below(random, 2), remote = random_below(random, 8) == 0;
    size_t n = 1, id_end = extended ? 5 : 3, dlc = random_below(random, random_below(random, 4) ? 9 : 16);

    out[0] = (uint8_t)((extended ? 0x80 : 0) | (remote ? 0x40 : 0) | (random_below(random, 4) << 4) | dlc);
    while (n < id_end)
        out[n++] = random_byte(random, filling);
    if (!with_dirt) {
        out[n - 1] &= extended ? 0xF8 : 0xE0;
        if (remote && random_below(random, 2))
            out[n - 1] |= extended ? 0x04 : 0x10;
    }
    size_t data_end = n + (remote ? 0 : dlc > 8 ? 8 : dlc);
    if (filling == FILL_MESSAGES)
        while (n < data_end && random_below(random, 8)) {
            uint8_t inner[MESSAGE_MAX];
            size_t length = random_message(random, FILL_ANY, inner);
            for (size_t i = 0; i < length && n < data_end; i++)
                out[n++] = inner[i];
        }
    while (n < data_end)
        out[n++] = random_byte(random, filling);
    return n;
}

/* An answer or an event: 0F, what is given of it, and any bytes up to its length. */
static size_t random_short(uint64_t *random, enum filling filling, uint8_t *out)
{
    static const struct {
        uint8_t given, length, bytes[4];
    } shorts[] = {
        {3, 4, {0x06, 1, 2}},    {2, 8, {0x08, 5}},       {2, 9, {0x08, 6}},    {3, 5, {0x10, 2, 6}},
        {3, 4, {0x12, 1, 31}},   {2, 4, {0x20, 1}},       {2, 7, {0x20, 4}},    {3, 8, {0x20, 5, 128}},
        {2, 3, {0x3E, 0}},       {2, 7, {0x3E, 4}},       {2, 4, {0x60, 1}},    {2, 4, {0x61, 1}},
        {2, 5, {0x62, 2}},       {3, 9, {0x09, 6, 1}},    {3, 10, {0x09, 7, 1}}, {4, 5, {0x09, 2, 2, 0}},
        {4, 5, {0x09, 2, 2, 1}}, {4, 5, {0x09, 2, 2, 2}}, {3, 4, {0x09, 1, 3}}, {4, 5, {0x09, 2, 3, 0}},
    };
    size_t i = random_below(random, LENGTH(shorts));

    out[0] = 0x0F;
    memcpy(out + 1, shorts[i].bytes, shorts[i].given);
    for (size_t n = 1 + (size_t)shorts[i].given; n < shorts[i].length; n++)
        out[n] = random_byte(random, filling);
    return shorts[i].length;
}

static size_t random_message(uint64_t *random, enum filling filling, uint8_t *out)
{
    size_t n = 3, choice = random_below(random, 16);

    if (choice == 0) {
        memcpy(out, "\x0F\x21\x0CHW0003FW0016", 15);
        return 15;
    }
    if (choice < 4)
        return random_short(random, filling, out);
    if (choice == 4) {
        out[n++] = 0;
        n += random_frame(random, filling, true, out + n);
        while (n < 17 && random_next(random) >> 63)
            out[n++] = random_byte(random, filling);
        n = n < 17 ? 4 + (size_t)(out[4] & 0x80 ? 5 : 3) + (out[4] & 0x40 ? 0 : out[4] & 8 ? 8 : out[4] & 7) : n;
        out[1] = 0x09;
    } else {
        n += random_frame(random, filling, false, out + n);
        out[1] = choice == 5 ? 0x3F : 0x41;
        if (choice == 5) {
            out[n++] = (uint8_t)random_below(random, 256);
            out[n++] = (uint8_t)random_below(random, 15);
        }
    }
    out[0] = 0x0F;
    out[2] = (uint8_t)(n - 3);
    return n;
}

/* ---- Streams of which every byte is known to belong to a message */

enum { ALIEN = -1 };

struct byte {
    uint8_t value, place; /* the place-th byte of its message */
    int16_t owner;
};

struct stream {
    struct byte tagged[STREAM_MAX];
    uint8_t bytes[STREAM_MAX];
    size_t n;
    size_t lengths[MESSAGES];
};

static void stream_make(struct stream *stream, uint64_t *random, enum filling filling)
{
    stream->n = 0;
    for (int16_t i = 0; i < MESSAGES; i++) {
        uint8_t message[MESSAGE_MAX + 1];
        size_t length = random_message(random, filling, message);
        stream->lengths[i] = length;
        for (size_t k = 0; k < length; k++)
            stream->tagged[stream->n++] = (struct byte){message[k], (uint8_t)k, i};
    }
}

/* Substitutes, deletes or inserts a run of bytes. */
static void stream_damage(struct stream *stream, uint64_t *random, enum filling filling)
{
    size_t kind = random_below(random, 3);
    size_t run = 1 + random_below(random, random_below(random, 2) ? 1 : DAMAGE_MAX);
    size_t at = random_below(random, stream->n - run);
    struct byte *from = stream->tagged + at;

    if (kind == 1) {
        memmove(from, from + run, (stream->n - at - run) * sizeof *from);
        stream->n -= run;
        return;
    }
    if (kind == 2) {
        memmove(from + run, from, (stream->n - at) * sizeof *from);
        stream->n += run;
    }
    for (size_t i = 0; i < run; i++)
        from[i] = (struct byte){random_byte(random, filling), 0, ALIEN};
}

static void stream_finish(struct stream *stream)
{
    for (size_t i = 0; i < stream->n; i++)
        stream->bytes[i] = stream->tagged[i].value;
}

/* Whether a whole message begins there. */
static bool stream_intact(const struct stream *stream, size_t at)
{
    int16_t owner = stream->tagged[at].owner;
    if (owner == ALIEN || at + stream->lengths[owner] > stream->n)
        return false;
    for (size_t i = 0; i < stream->lengths[owner]; i++)
        if (stream->tagged[at + i].owner != owner || stream->tagged[at + i].place != i)
            return false;
    return true;
}

/* Whether nothing is wrong with the message that begins there, nor with the one before. */
static bool stream_expects(const struct stream *stream, size_t at)
{
    if (!stream_intact(stream, at))
        return false;
    int16_t owner = stream->tagged[at].owner;
    if (owner == 0)
        return at == 0;
    size_t before = stream->lengths[owner - 1];
    return at >= before && stream->tagged[at - before].owner == owner - 1 && stream_intact(stream, at - before);
}

/* The message alone, as an entry at its place in the stream. */
static struct entry stream_entry(const struct stream *stream, size_t at)
{
    static struct entry alone[2];
    struct transcript transcript = {.entries = alone, .capacity = LENGTH(alone)};
    size_t n = stream->lengths[stream->tagged[at].owner];

    if (transcript_decode(&transcript, codec, stream->bytes + at, n, CUT_NOWHERE) || transcript.count != 1)
        abort();
    alone[0].start += at;
    alone[0].text_start += alone[0].kind == CODEC_TEXT ? at : 0;
    return alone[0];
}

/* ---- What must come out */

/* Undamaged streams give exactly their messages, however they are cut. */
static void test_streams(void)
{
    static struct entry entries[STREAM_MAX], expected_entries[STREAM_MAX];
    static struct stream stream;
    uint64_t random = 1;
    unsigned wrong = 0;

    for (uint64_t i = 0; i < 3000 && !wrong; i++) {
        struct transcript transcript = {.entries = entries, .capacity = LENGTH(entries)};
        struct transcript expected = {.entries = expected_entries, .capacity = LENGTH(entries)};
        stream_make(&stream, &random, (enum filling)(i % 3));
        stream_finish(&stream);
        for (size_t at = 0; at < stream.n; at += stream.lengths[stream.tagged[at].owner]) {
            expected.entries[expected.count] = stream_entry(&stream, at);
            if (expected.entries[expected.count].kind != CODEC_IDLE)
                expected.count++;
        }
        for (uint64_t cuts = 0; cuts < CUTS && !wrong; cuts++) {
            const char *violated = transcript_decode(&transcript, codec, stream.bytes, stream.n, cuts_number(cuts));
            size_t count = 0;
            for (size_t k = 0; k < transcript.count; k++)
                if (transcript.entries[k].kind != CODEC_IDLE)
                    transcript.entries[count++] = transcript.entries[k];
            transcript.count = count;
            if (violated || !transcript_equal(&expected, &transcript)) {
                printf("stream %d, cuts %d: %s\n", (int)i, (int)cuts, violated ? violated : "other messages");
                wrong++;
            }
        }
    }
    CHECK(wrong == 0);
}

/* Where the message that ends with an entry begins, which may be in the entry before. */
static size_t entry_begin(const struct entry *entry, const uint8_t *bytes)
{
    size_t end = entry->start + entry->length, begin = entry->start;
    if (entry->kind == CODEC_TEXT)
        return entry->text_start - 1;
    for (size_t length = entry->length; length <= MESSAGE_MAX && length <= end; length++) {
        begin = end - length;
        if (bytes[begin] == 0x0F && bytes[begin + 2] == length - 3)
            return begin;
    }
    return entry->start;
}

/*
 * Whether a message at bytes[at..end) could not be found: other messages, made up by damage or by the data of frames,
 * hold all of it, or its beginning and then follow each other.
 */
static bool hidden(const struct transcript *transcript, const uint8_t *bytes, size_t at, size_t end)
{
    for (size_t i = 0; i < transcript->count; i++) {
        const struct entry *entry = &transcript->entries[i];
        size_t entry_end = entry->start + entry->length;
        if (entry->kind == CODEC_SKIPPED || entry_end <= at || entry_begin(entry, bytes) > at)
            continue;
        bool next = i + 1 < transcript->count && entry[1].kind != CODEC_SKIPPED &&
                    entry_begin(&entry[1], bytes) == entry_end;
        if (next || entry_end >= end || entry->kind == CODEC_IDLE)
            return true;
    }
    return false;
}

/* Hidden itself; or the message before is, which is as good as damage, and damage again comes just after. */
static bool excused(const struct transcript *transcript, const struct stream *stream, size_t at)
{
    int16_t owner = stream->tagged[at].owner;
    size_t end = at + stream->lengths[owner];
    if (hidden(transcript, stream->bytes, at, end))
        return true;
    return owner > 0 && end < stream->n && !stream_intact(stream, end) &&
           hidden(transcript, stream->bytes, at - stream->lengths[owner - 1], at);
}

static bool found(const struct transcript *transcript, const struct entry *wanted)
{
    for (size_t i = 0; i < transcript->count; i++) {
        const struct entry *entry = &transcript->entries[i];
        if (entry->start + entry->length == wanted->start + wanted->length && entry->kind == wanted->kind &&
            entry->text_length == wanted->text_length &&
            memcmp(&entry->frame, &wanted->frame, sizeof entry->frame) == 0)
            return true;
    }
    return false;
}

/* Damaged streams: what is touched is lost, the message after it perhaps, and no other, unless it is hidden. */
static void test_damage(void)
{
    static const size_t hidden_ppm[] = {[FILL_ANY] = 5, [FILL_STARTS] = 5, [FILL_MESSAGES] = 100};
    static struct entry entries[STREAM_MAX];
    static struct stream stream;
    struct transcript transcript = {.entries = entries, .capacity = LENGTH(entries), .quiet_at_end = true};
    uint64_t random = 2;
    unsigned wrong = 0;

    for (enum filling filling = FILL_ANY; filling <= FILL_MESSAGES; filling++) {
        size_t expected = 0, missing = 0;
        for (int i = 0; i < DAMAGED && !wrong; i++) {
            stream_make(&stream, &random, filling);
            for (size_t damages = 1 + random_below(&random, 5); damages > 0; damages--)
                stream_damage(&stream, &random, filling);
            stream_finish(&stream);
            uint64_t cuts = cuts_number((uint64_t)i);
            const char *violated = transcript_decode(&transcript, codec, stream.bytes, stream.n, cuts);
            for (size_t at = 0; at < stream.n && !wrong; at++) {
                if (!stream_expects(&stream, at))
                    continue;
                struct entry wanted = stream_entry(&stream, at);
                if (wanted.kind == CODEC_IDLE)
                    continue;
                expected++;
                if (found(&transcript, &wanted))
                    continue;
                missing++;
                if (!excused(&transcript, &stream, at)) {
                    printf("filling %d, stream %d: the message at %zu is lost\n", (int)filling, i, at);
                    wrong++;
                }
            }
            if (violated) {
                printf("filling %d, stream %d: %s\n", (int)filling, i, violated);
                wrong++;
            }
        }
        CHECK(missing * 1000000 <= (expected + 1000000) * hidden_ppm[filling]);
    }
    CHECK(wrong == 0);
}

/* Any bytes at all give the same messages however they are cut, and once all is quiet nothing is left. */
static void test_cuts(void)
{
    static struct entry whole_entries[STREAM_MAX], cut_entries[STREAM_MAX];
    uint8_t bytes[500];
    uint64_t random = 3;
    unsigned wrong = 0;

    for (uint64_t i = 0; i < 20000 && !wrong; i++) {
        struct transcript whole = {.entries = whole_entries, .capacity = STREAM_MAX, .quiet_at_end = i & 1};
        struct transcript cut = {.entries = cut_entries, .capacity = STREAM_MAX, .quiet_at_end = i & 1};
        size_t n = random_below(&random, i % 8 ? 60 : sizeof bytes);
        for (size_t k = 0; k < n; k++)
            bytes[k] = random_byte(&random, i % 5 ? FILL_STARTS : FILL_ANY);
        const char *violated = transcript_decode(&whole, codec, bytes, n, CUT_NOWHERE);
        if (i & 1 && whole.pending > 0)
            violated = "bytes left though all is quiet";
        for (uint64_t cuts = 1; cuts < CUTS && !violated; cuts++) {
            violated = transcript_decode(&cut, codec, bytes, n, cuts_number(cuts));
            if (!violated && !transcript_equal(&whole, &cut))
                violated = "other messages than whole";
        }
        if (violated) {
            printf("stream %d: %s\n", (int)i, violated);
            wrong++;
        }
    }
    CHECK(wrong == 0);
}

/* What we send is what we receive, but for the COMMAND. */
static void test_round_trip(void)
{
    uint64_t random = 4;
    unsigned wrong = 0;

    for (int i = 0; i < 300000 && !wrong; i++) {
        uint8_t bytes[32], back[32];
        struct codec_state state = {0};
        struct codec_message msg;
        struct can_frame frame;
        size_t n = 3 + random_frame(&random, FILL_ANY, false, bytes + 3);
        bytes[0] = 0x0F;
        bytes[1] = 0x41;
        bytes[2] = (uint8_t)(n - 3);
        size_t taken = codec->decode(&state, bytes, n, &frame, &msg);
        bytes[1] = 0x40;
        bytes[3] &= 0xCF;
        if ((bytes[3] & 0x0F) > 8)
            bytes[3] = (uint8_t)((bytes[3] & 0xF0) | 8);
        if (bytes[3] & 0x40)
            bytes[bytes[3] & 0x80 ? 7 : 5] &= bytes[3] & 0x80 ? 0xF8 : 0xE0;
        if (taken != n || msg.kind != CODEC_FRAME || codec->encode[REMOTE_PLAIN](&frame, back) != n ||
            memcmp(bytes, back, n) != 0) {
            printf("no round trip: %d\n", i);
            wrong++;
        }
    }
    CHECK(wrong == 0);
}

int main(void)
{
    test_round_trip();
    test_streams();
    test_cuts();
    test_damage();
    return checks_end();
}
