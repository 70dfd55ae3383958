/* codec_can232.c, case by case. Each decoding case runs whole, byte by byte and cut at random. */
#include "check.h"
#include "codec_check.h"

enum { CUTS = 20, TEXT_MAX = 4096 };

static const struct codec *const codec = &codec_can232;
/* ---- Transcripts as text: "100#1133 ok sent refused 'V1013' skip3 lf1 +2", +2: two bytes wait for more. */

struct text {
    char at[TEXT_MAX];
    size_t length;
};

__attribute__((format(printf, 2, 3))) static void text_add(struct text *text, const char *format, ...)
{
    size_t room = sizeof text->at - text->length;
    va_list args;

    va_start(args, format);
    int length = vsnprintf(text->at + text->length, room, format, args);
    va_end(args);
    if (length > 0)
        text->length += (size_t)length < room ? (size_t)length : room - 1;
}

/* As candump writes it: 100#1133, 00000100#1133, 100#R2, DLC above 8 as "_9"; then the stamp's digits as "@4". */
static void text_add_frame(struct text *text, const struct can_frame *frame, unsigned stamp_digits)
{
    if (frame->can_id & CAN_EFF_FLAG)
        text_add(text, "%08X#", frame->can_id & CAN_EFF_MASK);
    else
        text_add(text, "%03X#", frame->can_id & CAN_SFF_MASK);
    if (frame->can_id & CAN_RTR_FLAG)
        text_add(text, "R%u", frame->len);
    else
        for (size_t i = 0; i < frame->len && i < CAN_MAX_DLEN; i++)
            text_add(text, "%02X", frame->data[i]);
    if (frame->len8_dlc)
        text_add(text, "_%X", frame->len8_dlc);
    if (stamp_digits)
        text_add(text, "@%u", stamp_digits);
}

static void text_from_transcript(struct text *text, const struct transcript *transcript, const char *bytes)
{
    text->length = 0;
    text->at[0] = '\0';
    for (size_t i = 0; i < transcript->count; i++) {
        const struct entry *entry = &transcript->entries[i];

        if (i)
            text_add(text, " ");
        switch (entry->kind) {
        case CODEC_IDLE:
            text_add(text, "lf%zu", entry->length);
            break;
        case CODEC_FRAME:
            text_add_frame(text, &entry->frame, entry->stamp_digits);
            break;
        case CODEC_OK:
            text_add(text, "ok");
            break;
        case CODEC_SENT:
            text_add(text, "sent");
            break;
        case CODEC_REFUSED:
            text_add(text, "refused");
            break;
        case CODEC_TEXT:
            text_add(text, "'%.*s'", (int)entry->text_length, bytes + entry->text_start);
            break;
        case CODEC_SKIPPED:
            text_add(text, "skip%zu", entry->length);
            break;
        default:
            text_add(text, "?%d", (int)entry->kind);
        }
    }
    if (transcript->pending)
        text_add(text, "%s+%zu", transcript->count ? " " : "", transcript->pending);
}

static void check_decode(int line, const char *bytes, size_t n, const char *expected)
{
    static struct entry entries[TEXT_MAX];
    static struct text text;
    struct transcript transcript = {.entries = entries, .capacity = LENGTH(entries)};

    for (uint64_t i = 0; i < CUTS; i++) {
        const char *violated = transcript_decode(&transcript, codec, (const uint8_t *)bytes, n, cuts_number(i));

        text_from_transcript(&text, &transcript, bytes);
        if (violated || strcmp(text.at, expected) != 0) {
            fail(__FILE__, line, "cuts %d: expected [%s], got [%s], contract: %s", (int)i, expected, text.at,
                 violated ? violated : "kept");
            return;
        }
    }
    passed++;
}

/* ---- Decoding */

struct decode_case {
    int line;
    const char *bytes;
    size_t n;
    const char *expected;
};

#define CASE(bytes, expected) {__LINE__, bytes, sizeof(bytes) - 1, expected}
#define HEX16 "0123456789abCDEF"

static const struct decode_case decode_cases[] = {
    /* The manual's examples. */
    CASE("t10021133\r", "100#1133"),
    CASE("T0000010021133\r", "00000100#1133"),
    CASE("r1002\r", "100#R2"),
    CASE("R000001002\r", "00000100#R2"),
    CASE("t100211334D67\r", "100#1133@4"),
    CASE("\r", "ok"),
    CASE("z\r", "sent"),
    CASE("Z\r", "sent"),
    CASE("\a", "refused"),
    CASE("V1013\r", "'V1013'"),
    CASE("NA123\r", "'NA123'"),
    CASE("F04\r", "'F04'"),
    CASE("A\r", "'A'"),
    CASE("t10021133\rT0000010021133\rA\r", "100#1133 00000100#1133 'A'"),
    CASE("\rz\r\aZ\r\a\a\r", "ok sent refused sent refused refused ok"),

    /* Identifiers. */
    CASE("t0000\r", "000#"),
    CASE("t7FF0\r", "7FF#"),
    CASE("t7fF0\r", "7FF#"),
    CASE("t8000\r", "skip6"),
    CASE("tFFF0\r", "skip6"),
    CASE("r7FF0\r", "7FF#R0"),
    CASE("r8000\r", "skip6"),
    CASE("T000000000\r", "00000000#"),
    CASE("T1FFFFFFF0\r", "1FFFFFFF#"),
    CASE("T1fffffff0\r", "1FFFFFFF#"),
    CASE("T200000000\r", "skip11"),
    CASE("TFFFFFFFF0\r", "skip11"),
    CASE("R1FFFFFFF8\r", "1FFFFFFF#R8"),
    CASE("R200000000\r", "skip11"),
    CASE("T0000007FF0\r", "skip12"),
    CASE("t 100\r", "skip6"),
    CASE("t0x10\r", "skip6"),
    CASE("t-100\r", "skip6"),
    CASE("t+100\r", "skip6"),
    CASE("t1G00\r", "skip6"),
    CASE("t1:00\r", "skip6"),
    CASE("t1`00\r", "skip6"),

    /* DLC: above 8 it means 8 data bytes, and is kept. */
    CASE("t1231aB\r", "123#AB"),
    CASE("t12370123456789abCD\r", "123#0123456789ABCD"),
    CASE("t1238" HEX16 "\r", "123#0123456789ABCDEF"),
    CASE("t1239" HEX16 "\r", "123#0123456789ABCDEF_9"),
    CASE("t123A" HEX16 "\r", "123#0123456789ABCDEF_A"),
    CASE("t123f" HEX16 "\r", "123#0123456789ABCDEF_F"),
    CASE("T00000123F" HEX16 "\r", "00000123#0123456789ABCDEF_F"),
    CASE("t123F" HEX16 "EA5F\r", "123#0123456789ABCDEF_F@4"),
    CASE("t123G" HEX16 "\r", "skip22"),
    CASE("t123 \r", "skip6"),
    CASE("t123/\r", "skip6"),

    /* Remote frames carry a DLC and no data. */
    CASE("r1230\r", "123#R0"),
    CASE("r1238\r", "123#R8"),
    CASE("r123F\r", "123#R8_F"),
    CASE("R00000123c\r", "00000123#R8_C"),
    CASE("r12324D67\r", "123#R2@4"),
    CASE("r1232004D6700\r", "123#R2@8"),
    CASE("R0000012320000\r", "00000123#R2@4"),
    CASE("r12321133\r", "123#R2@4"),
    CASE("r1231AA\r", "123#R1"),
    CASE("r1231AA4D67\r", "123#R1@4"),
    CASE("r1231A\r", "skip7"),
    CASE("r1231AG\r", "skip8"),
    CASE("r1233AABB\r", "123#R3@4"),
    CASE("r1233AABBC\r", "skip11"),
    CASE("r1230AA\r", "skip8"),
    CASE("r12381122334455667788\r", "123#R8"),
    CASE("R00000123F1122334455667788EA5F\r", "00000123#R8_F@4"),

    /* Time stamps: 0, 4 or 8 hex digits; where the CR is decides. */
    CASE("t1230EA5F\r", "123#@4"),
    CASE("t12300001e240\r", "123#@8"),
    CASE("t1231AA0001\r", "123#AA@4"),
    CASE("t1238" HEX16 "FFFFFFFF\r", "123#0123456789ABCDEF@8"),
    CASE("T1FFFFFFF8" HEX16 "FFFFFFFF\r", "1FFFFFFF#0123456789ABCDEF@8"),
    CASE("t12301\r", "skip7"),
    CASE("t123012\r", "skip8"),
    CASE("t1230123\r", "skip9"),
    CASE("t123012345\r", "skip11"),
    CASE("t1230123456\r", "skip12"),
    CASE("t12301234567\r", "skip13"),
    CASE("t1230123456789\r", "skip15"),
    CASE("t12300123456789AB\r", "skip18"),
    CASE("t1230123G\r", "skip10"),
    CASE("t123012345G78\r", "skip14"),

    /* Frames that contradict themselves take nothing with them but their own line. */
    CASE("t\r", "skip2"),
    CASE("t12\rt1230\r", "skip4 123#"),
    CASE("t123\rz\r", "skip5 sent"),
    CASE("t1231A\rz\r", "skip7 sent"),
    CASE("t1231\rV1013\r", "skip6 'V1013'"),
    CASE("t1231GG\r\r", "skip8 ok"),
    CASE("t1238112233445566778\r\r", "skip21 ok"),
    CASE("t123811223344556677889\r\r", "skip23 ok"),
    CASE("t1231t1230\rt4560\r", "skip11 456#"),
    CASE("ready\rTEC 0\r", "skip12"),
    CASE("T0000010\rR\rr\r", "skip13"),
    CASE("t1230 \r", "skip7"),
    CASE(" t1230\r", "' t1230'"),

    /* Line feeds mean nothing before a line, and spoil it within. */
    CASE("\n", "lf1"),
    CASE("\n\n\n", "lf3"),
    CASE("\r\n\r\nt1230\r\nz\r\n", "ok lf1 ok lf1 123# lf1 sent lf1"),
    CASE("\nV1013\r\n\a\n", "lf1 'V1013' lf1 refused lf1"),
    CASE("V10\n13\r\r", "skip7 ok"),
    CASE("t1230\n\rt1240\r", "skip7 124#"),
    CASE("z\n\r", "skip3"),

    /* Noise before a line: the line still counts, unless it is empty. */
    CASE("\0", "skip1"),
    CASE("\xFF\x80\x00\x7F\x1B\t", "skip6"),
    CASE("\x00t1230\r\r", "skip1 123# ok"),
    CASE("\xFFz\r\r", "skip1 sent ok"),
    CASE("\x7FV1013\r\r", "skip1 'V1013' ok"),
    CASE("\x80\r\r", "skip2 ok"),
    CASE("\x80\n\r\r", "skip1 lf1 skip1 ok"),
    CASE("\x80\n\x80\r\r", "skip1 lf1 skip2 ok"),
    CASE("\x80\a\r", "skip1 refused ok"),
    CASE("\xFFt12\r\r", "skip5 ok"),
    CASE("\x1F \r\x1E~\r", "skip1 ' ' skip1 '~'"),
    CASE("+A: B\tC: D\t\r", "'+A: B\tC: D\t'"),
    CASE("\tV1013\r\tt1230\r\r", "skip1 'V1013' skip1 123# ok"),
    CASE("t12\t30\r\r", "skip7 ok"),

    /* Noise within a line spoils the line. */
    CASE("t12\x00" "30\r\r", "skip7 ok"),
    CASE("V1\xFF" "013\r\r", "skip7 ok"),
    CASE("V\x7F\rV\x1F\rV~\r", "skip6 'V~'"),
    CASE("z\x80\r\r", "skip3 ok"),
    CASE("t1230\x80\r\r", "skip7 ok"),

    /* BELL ends what it interrupts, and always refuses. */
    CASE("V10\a\r", "skip3 refused ok"),
    CASE("t12\at1230\r", "skip3 refused 123#"),
    CASE("t1230\a\r", "skip5 refused ok"),
    CASE("t12381122\a334455667788\r", "skip9 refused '334455667788'"),
    CASE("t100211334D6\a\r", "skip12 refused ok"),
    CASE("z\a\r", "skip1 refused ok"),
    CASE("V\xFF\az\r", "skip2 refused sent"),
    CASE("\a\a\a", "refused refused refused"),

    /* Any other line is text. */
    CASE("zX\r", "'zX'"),
    CASE("zz\r", "'zz'"),
    CASE("ZZ\r", "'ZZ'"),
    CASE("x\r", "'x'"),
    CASE(" \r", "' '"),
    CASE("VL2K7-aB https://example.org/can.git ~!\r", "'VL2K7-aB https://example.org/can.git ~!'"),
    CASE("d1230\r", "'d1230'"),

    /* Unfinished. */
    CASE("", ""),
    CASE("t", "+1"),
    CASE("t1230", "+5"),
    CASE("t10021133", "+9"),
    CASE("tG", "+2"),
    CASE("z", "+1"),
    CASE("V1013", "+5"),
    CASE("V\xFF", "+2"),
    CASE("t1230\rt456", "123# +4"),
};

static void test_decode_cases(void)
{
    for (size_t i = 0; i < LENGTH(decode_cases); i++)
        check_decode(decode_cases[i].line, decode_cases[i].bytes, decode_cases[i].n, decode_cases[i].expected);
}

/* fill, times over, then the tail: lines around line_max. */
static void check_long(int line, char fill, size_t times, const char *tail, const char *expected)
{
    char bytes[2048];
    size_t tail_length = strlen(tail);

    memset(bytes, fill, times);
    memcpy(bytes + times, tail, tail_length);
    check_decode(line, bytes, times + tail_length, expected);
}

static void test_long_lines(void)
{
    char expected[300] = "'";

    memset(expected + 1, 'V', 255);
    strcpy(expected + 256, "' ok");
    check_long(__LINE__, 'V', 255, "\r\r", expected);
    check_long(__LINE__, 'V', 255, "", "+255");
    check_long(__LINE__, 'V', 255, "\a\r", "skip255 refused ok");
    check_long(__LINE__, 'V', 256, "", "skip256");
    check_long(__LINE__, 'V', 256, "\r\r", "skip257 ok");
    check_long(__LINE__, 'V', 256, "\a\r", "skip256 refused ok");
    check_long(__LINE__, 'V', 257, "z\rz\r", "skip259 sent");
    check_long(__LINE__, 'V', 511, "\r\r", "skip512 ok");
    check_long(__LINE__, 'V', 512, "\r\r", "skip513 ok");
    check_long(__LINE__, 'V', 1000, "\n\xFFt1230\rt4560\r", "skip1008 456#");
    check_long(__LINE__, 'V', 1000, "t1230\at4560\r", "skip1005 refused 456#");
    check_long(__LINE__, 't', 256, "t1230\rt4560\r", "skip262 456#");
    check_long(__LINE__, 't', 300, "\a", "skip300 refused");
    check_long(__LINE__, '\xFF', 300, "t1230\r\r", "skip300 123# ok");
    check_long(__LINE__, '\xFF', 300, "\r\r", "skip301 ok");
    check_long(__LINE__, '\n', 300, "\r\r", "lf300 ok ok");
}

static void test_constants(void)
{
    CHECK(strcmp(codec->name, "can232") == 0);
    CHECK(codec->line_max == 256);
    CHECK(codec->frame_max == 27);
}

static bool is_hex(int byte)
{
    return (byte >= '0' && byte <= '9') || (byte >= 'a' && byte <= 'f') || (byte >= 'A' && byte <= 'F');
}

/* Every byte at every place of a frame: a frame if and only if it is a hex digit there. */
static void test_each_byte(void)
{
    static const char *const frames[] = {"t1238" HEX16 "4D67\r", "T001234568" HEX16 "0004D67A\r", "r1234EA5F\r"};
    unsigned wrong = 0;

    for (size_t f = 0; f < LENGTH(frames); f++) {
        size_t n = strlen(frames[f]), dlc_at = frames[f][0] == 'T' ? 9 : 4;

        for (size_t i = 1; i < n - 1; i++)
            for (int byte = 0; byte < 256; byte++) {
                uint8_t bytes[40];
                struct codec_state state = {0};
                struct codec_message msg;
                struct can_frame frame;
                bool high_id = i == 1 && !(byte >= '0' && byte <= (frames[f][0] == 'T' ? '1' : '7'));
                bool short_dlc = i == dlc_at && byte >= '0' && byte <= '7' && frames[f][0] != 'r';

                memcpy(bytes, frames[f], n);
                bytes[i] = (uint8_t)byte;
                bool found = codec->decode(&state, bytes, n, &frame, &msg) == n && msg.kind == CODEC_FRAME;
                if (short_dlc) /* what is left over may look like a time stamp: the table has those cases */
                    continue;
                if (found != (is_hex(byte) && !high_id)) {
                    printf("%s with byte %zu %02X: %s\n", frames[f], i, (unsigned)byte, found ? "frame" : "none");
                    wrong++;
                }
            }
    }
    CHECK(wrong == 0);
}

/* No byte: no message, in whatever state. */
static void test_nothing(void)
{
    uint8_t *nothing = malloc(1);
    struct codec_state state = {0}, discarding = {.can232 = {.discarding = true, .dirty = true}};
    struct codec_message msg;
    struct can_frame frame;

    CHECK(nothing && codec->decode(&state, nothing + 1, 0, &frame, &msg) == 0);
    CHECK(nothing && codec->decode(&discarding, nothing + 1, 0, &frame, &msg) == 0);
    CHECK(discarding.can232.discarding && discarding.can232.dirty);
    free(nothing);
}

/* A frame is written whole, whatever the memory held. */
static void test_frame_is_whole(void)
{
    struct can_frame expected, frame;
    struct codec_state state = {0};
    struct codec_message msg;

    memset(&expected, 0, sizeof expected);
    expected.can_id = 0x123;
    expected.len = 1;
    expected.data[0] = 0xAB;
    memset(&frame, 0xFF, sizeof frame);
    CHECK(codec->decode(&state, (const uint8_t *)"t1231AB\r", 8, &frame, &msg) == 8);
    CHECK(memcmp(&frame, &expected, sizeof frame) == 0);

    expected.can_id = 0x12345678 | CAN_EFF_FLAG | CAN_RTR_FLAG;
    expected.len = 8;
    expected.len8_dlc = 9;
    expected.data[0] = 0;
    memset(&frame, 0xFF, sizeof frame);
    CHECK(codec->decode(&state, (const uint8_t *)"R123456789\r", 11, &frame, &msg) == 11);
    CHECK(memcmp(&frame, &expected, sizeof frame) == 0);
}

/* ---- Encoding */

static size_t encode(const struct can_frame *frame, char *line)
{
    uint8_t *out = malloc(codec->frame_max); /* exactly: AddressSanitizer watches its end */
    if (!out)
        abort();
    memset(out, '?', codec->frame_max);
    size_t n = codec->encode[REMOTE_PLAIN](frame, out);
    memcpy(line, out, codec->frame_max);
    free(out);
    return n;
}

#define DATA8 {0x01, 0x23, 0x45, 0x67, 0x89, 0xAB, 0xCD, 0xEF}

static const struct encode_case {
    int line;
    struct can_frame frame;
    const char *expected; /* "": cannot be said */
} encode_cases[] = {
    {__LINE__, {.can_id = 0x100, .len = 2, .data = {0x11, 0x33}}, "t10021133\r"},
    {__LINE__, {.can_id = 0x100 | CAN_EFF_FLAG, .len = 2, .data = {0x11, 0x33}}, "T0000010021133\r"},
    {__LINE__, {.can_id = 0x100 | CAN_RTR_FLAG, .len = 2}, "r1002\r"},
    {__LINE__, {.can_id = 0x100 | CAN_RTR_FLAG | CAN_EFF_FLAG, .len = 2}, "R000001002\r"},
    {__LINE__, {.can_id = 0}, "t0000\r"},
    {__LINE__, {.can_id = 0x7FF, .len = 8, .data = DATA8}, "t7FF80123456789ABCDEF\r"},
    {__LINE__, {.can_id = 0x1FFFFFFF | CAN_EFF_FLAG, .len = 8, .data = DATA8}, "T1FFFFFFF80123456789ABCDEF\r"},
    {__LINE__, {.can_id = 0x0ABCDEF0 | CAN_EFF_FLAG, .len = 1, .data = DATA8}, "T0ABCDEF0101\r"},
    {__LINE__, {.can_id = 0x7FF | CAN_RTR_FLAG, .len = 8, .data = DATA8}, "r7FF8\r"},
    {__LINE__, {.can_id = 0x7FF, .len = 8, .len8_dlc = 15, .data = DATA8}, "t7FF80123456789ABCDEF\r"},
    {__LINE__, {.can_id = 0x7FF | CAN_RTR_FLAG, .len = 8, .len8_dlc = 9}, "r7FF8\r"},
    {__LINE__, {.can_id = 0x123, .len = 1, .__pad = 1, .__res0 = 1, .data = {0xAB, 0xFF}}, "t1231AB\r"},
    {__LINE__, {.can_id = 0x123, .len = 9}, ""},
    {__LINE__, {.can_id = 0x123, .len = 255}, ""},
    {__LINE__, {.can_id = 0x123 | CAN_RTR_FLAG, .len = 9}, ""},
    {__LINE__, {.can_id = 0x800}, ""},
    {__LINE__, {.can_id = 0x1FFFFFFF}, ""},
    {__LINE__, {.can_id = 0x800 | CAN_RTR_FLAG}, ""},
    {__LINE__, {.can_id = 0x4 | CAN_ERR_FLAG, .len = 8}, ""},
    {__LINE__, {.can_id = 0x4 | CAN_ERR_FLAG | CAN_EFF_FLAG, .len = 8}, ""},
};

static void test_encode_cases(void)
{
    for (size_t i = 0; i < LENGTH(encode_cases); i++) {
        const struct encode_case *c = &encode_cases[i];
        char line[32];
        size_t n = encode(&c->frame, line);

        if (n == strlen(c->expected) && memcmp(line, c->expected, n) == 0)
            passed++;
        else
            fail(__FILE__, c->line, "expected [%s], got [%.*s]", c->expected, (int)n, line);
    }
}

int main(void)
{
    test_constants();
    test_decode_cases();
    test_long_lines();
    test_each_byte();
    test_nothing();
    test_frame_is_whole();
    test_encode_cases();
    return checks_end();
}
