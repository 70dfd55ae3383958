/* codec_can232.c in the large: random frames there and back, random streams cut in many ways. */
#include "check.h"
#include "codec_check.h"

enum { CUTS = 20, STREAM_MAX = 16384 };

static const struct codec *const codec = &codec_can232;

static size_t encode(const struct can_frame *frame, char *line)
{
    return codec->encode[REMOTE_PLAIN](frame, (uint8_t *)line);
}

static void random_frame(uint64_t *random, struct can_frame *frame)
{
    uint64_t bits = random_next(random);
    bool extended = bits & 1, remote = (bits & 6) == 6;

    memset(frame, 0, sizeof *frame);
    frame->can_id = (canid_t)(bits >> 32) & (extended ? CAN_EFF_MASK : CAN_SFF_MASK);
    frame->can_id |= (extended ? CAN_EFF_FLAG : 0) | (remote ? CAN_RTR_FLAG : 0);
    frame->len = (uint8_t)((bits >> 8) % 9);
    bits = random_next(random);
    for (size_t i = 0; i < frame->len && !remote; i++)
        frame->data[i] = (uint8_t)(bits >> (8 * i));
}

/* Makes an encoded line what a device may send: with a time stamp, in lower case, with a DLC of 9 to 15. */
static size_t random_dress(uint64_t *random, struct can_frame *frame, char *line, size_t n, uint8_t *stamp_digits)
{
    uint64_t bits = random_next(random);

    if (frame->len == 8 && bits % 4 == 0) {
        frame->len8_dlc = (uint8_t)(9 + (bits >> 8) % 7);
        line[frame->can_id & CAN_EFF_FLAG ? 9 : 4] = "9ABCDEF"[frame->len8_dlc - 9];
    }
    *stamp_digits = (uint8_t)(4 * ((bits >> 16) % 3));
    for (size_t i = 0; i < *stamp_digits; i++)
        line[n - 1 + i] = "0123456789ABCDEF"[bits >> (20 + 4 * i) & 15];
    n += *stamp_digits;
    line[n - 1] = '\r';
    if (bits >> 60 & 1)
        for (size_t i = 1; i < n - 1; i++)
            if (line[i] >= 'A' && line[i] <= 'F')
                line[i] = (char)(line[i] + 'a' - 'A');
    return n;
}

static void test_round_trip(void)
{
    uint64_t random = 1;
    unsigned wrong = 0;

    for (int i = 0; i < 500000 && !wrong; i++) {
        struct can_frame frame, back;
        struct codec_state state = {0};
        struct codec_message msg;
        char line[64];
        uint8_t stamp_digits;

        random_frame(&random, &frame);
        size_t n = random_dress(&random, &frame, line, encode(&frame, line), &stamp_digits);
        size_t taken = codec->decode(&state, (const uint8_t *)line, n, &back, &msg);
        if (taken != n || msg.kind != CODEC_FRAME || msg.stamp_digits != stamp_digits ||
            memcmp(&frame, &back, sizeof frame) != 0) {
            printf("no round trip: %.*s\n", (int)n - 1, line);
            wrong++;
        }
    }
    CHECK(wrong == 0);
}

/* A stream under construction, with the transcript that it must give. */
struct stream {
    uint8_t bytes[STREAM_MAX];
    size_t n;
    struct transcript expected;
    bool dirty;
};

static void stream_add(struct stream *stream, const char *bytes, size_t n)
{
    memcpy(stream->bytes + stream->n, bytes, n);
    stream->n += n;
}

/* The last n bytes of the stream are one message. */
static void stream_expect(struct stream *stream, enum codec_kind kind, size_t n)
{
    const uint8_t *at = stream->bytes + stream->n - n;
    struct codec_message msg = {.kind = kind, .length = kind == CODEC_SKIPPED ? n : 0};

    if (kind == CODEC_TEXT) {
        msg.text = at;
        msg.length = n - 1;
    }
    if (transcript_add(&stream->expected, &msg, NULL, at, stream->n - n, n))
        abort();
}

static void stream_add_frame(struct stream *stream, uint64_t *random)
{
    struct can_frame frame;
    struct codec_message msg = {.kind = CODEC_FRAME};
    char line[64];

    random_frame(random, &frame);
    size_t n = random_dress(random, &frame, line, encode(&frame, line), &msg.stamp_digits);
    stream_add(stream, line, n);
    if (transcript_add(&stream->expected, &msg, &frame, stream->bytes + stream->n - n, stream->n - n, n))
        abort();
    stream->dirty = false;
}

/* The start of a frame, broken off too early for its DLC, ended by end (CR or BELL). */
static void stream_add_broken(struct stream *stream, uint64_t *random, char end)
{
    struct can_frame frame;
    char line[64];

    random_frame(random, &frame);
    size_t n = encode(&frame, line) - 1;
    n = 1 + (size_t)random_next(random) % (n - 1);
    stream_add(stream, line, n);
    if (end == '\r') {
        stream_add(stream, "\r", 1);
        stream_expect(stream, CODEC_SKIPPED, n + 1);
    } else {
        stream_expect(stream, CODEC_SKIPPED, n);
        stream_add(stream, "\a", 1);
        stream_expect(stream, CODEC_REFUSED, 1);
    }
    stream->dirty = false;
}

static void stream_add_long(struct stream *stream, uint64_t *random, char end)
{
    char line[600];
    size_t n = codec->line_max + (size_t)random_next(random) % (sizeof line - codec->line_max);

    for (size_t i = 0; i < n; i++)
        line[i] = "tTrRzZV0123456789\n\xFF\x00~ "[random_next(random) % 22];
    line[0] = "tV~ "[random_next(random) % 4];
    stream_add(stream, line, n);
    stream_expect(stream, CODEC_SKIPPED, n);
    stream_add(stream, &end, 1);
    stream_expect(stream, end == '\r' ? CODEC_SKIPPED : CODEC_REFUSED, 1);
    stream->dirty = false;
}

static void stream_add_line(struct stream *stream, enum codec_kind kind, const char *line)
{
    stream_add(stream, line, strlen(line));
    stream_expect(stream, kind, strlen(line));
    stream->dirty = false;
}

static void stream_add_any(struct stream *stream, uint64_t *random)
{
    static const char *const texts[] = {"V1013\r", "NA123\r", "F00\r", "A\r", "zX\r", " \r", "~t1230\r"};
    static const char *const spoilt[] = {"V\n1\r", "z\xFF\r", "t1230\x01\r", "F0\x80\r",
                                         "t8000\r", "T200000000\r"};
    uint64_t choice = random_next(random) >> 16;

    switch (choice % 16) {
    default:
        stream_add_frame(stream, random);
        break;
    case 0:
        stream_add_line(stream, stream->dirty ? CODEC_SKIPPED : CODEC_OK, "\r");
        break;
    case 1:
        stream_add_line(stream, CODEC_SENT, choice & 16 ? "z\r" : "Z\r");
        break;
    case 2:
        stream_add_line(stream, CODEC_REFUSED, "\a");
        break;
    case 3:
        stream_add_line(stream, CODEC_TEXT, texts[(choice >> 8) % LENGTH(texts)]);
        break;
    case 4:
        stream_add_line(stream, CODEC_SKIPPED, spoilt[(choice >> 8) % LENGTH(spoilt)]);
        break;
    case 5:
        stream_add_broken(stream, random, choice & 16 ? '\r' : '\a');
        break;
    case 6:
        stream_add(stream, "\n", 1);
        stream_expect(stream, CODEC_IDLE, 1);
        break;
    case 7:
    case 8:
        stream_add(stream, &"\x00\xFF\x80\x7F\x1F\t\x0B\x01"[(choice >> 8) % 8], 1);
        stream_expect(stream, CODEC_SKIPPED, 1);
        stream->dirty = true;
        break;
    case 9:
        if (choice % 5 == 0)
            stream_add_long(stream, random, choice & 16 ? '\r' : '\a');
        break;
    }
}

/* Decodes a stream in many cuts; returns the first cut that does not give the expected transcript, -1 if none. */
static int stream_differs(const uint8_t *bytes, size_t n, const struct transcript *expected, int cuts)
{
    static struct entry entries[STREAM_MAX];
    struct transcript transcript = {.entries = entries, .capacity = LENGTH(entries)};

    for (int i = 0; i < cuts; i++) {
        const char *violated = transcript_decode(&transcript, codec, bytes, n, cuts_number((uint64_t)i));
        if (violated)
            printf("codec %s\n", violated);
        if (violated || !transcript_equal(expected, &transcript))
            return i;
    }
    return -1;
}

/* Streams made of known messages give exactly these, however they are cut. */
static void test_streams(void)
{
    static struct entry entries[STREAM_MAX];
    static struct stream stream;
    uint64_t random = 2;
    unsigned wrong = 0;

    for (int i = 0; i < 300 && !wrong; i++) {
        stream.n = 0;
        stream.dirty = false;
        stream.expected = (struct transcript){.entries = entries, .capacity = LENGTH(entries)};
        while (stream.n < STREAM_MAX / 4)
            stream_add_any(&stream, &random);
        int cuts = stream_differs(stream.bytes, stream.n, &stream.expected, CUTS);
        if (cuts >= 0) {
            printf("stream %d, cuts %d: not the messages it is made of\n", i, cuts);
            wrong++;
        }
    }
    CHECK(wrong == 0);
}

/* Any bytes at all give the same messages however they are cut. */
static void test_cuts(void)
{
    static const uint8_t alphabet[] = "tTrRzZVA012389aF0000\r\r\r\r\n\a\xFF\x00\x80 ~";
    static struct entry entries[STREAM_MAX];
    uint8_t bytes[700];
    struct transcript whole = {.entries = entries, .capacity = LENGTH(entries)};
    uint64_t random = 3;
    unsigned wrong = 0;

    for (int i = 0; i < 4000 && !wrong; i++) {
        size_t n = (size_t)random_next(&random) % sizeof bytes;
        size_t letters = i % 4 == 0 ? 256 : i % 4 == 1 ? 20 : LENGTH(alphabet) - 1; /* 20: lines without end */

        for (size_t k = 0; k < n; k++) {
            uint64_t bits = random_next(&random) >> 8;
            bytes[k] = letters == 256 ? (uint8_t)bits : alphabet[bits % letters];
        }
        if (letters == 20 && n > 300)
            bytes[n - 20] = i & 4 ? '\r' : '\a';
        const char *violated = transcript_decode(&whole, codec, bytes, n, CUT_NOWHERE);
        int cuts = violated ? 0 : stream_differs(bytes, n, &whole, CUTS);
        if (cuts >= 0) {
            printf("stream %d, cuts %d: other messages than whole\n", i, cuts);
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
    return checks_end();
}
