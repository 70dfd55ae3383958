/* codec_usb2can.c, case by case. Each decoding case runs whole, byte by byte and cut at random. */
#include "check.h"
#include "codec_check.h"
#include "usb2can_text.h"

enum { CUTS = 20 };

static const struct codec *const codec = &codec_usb2can;

static void check_decode(int line, const char *hex, bool quiet_at_end, const char *expected)
{
    static struct entry entries[BYTES_MAX];
    static struct text text;
    struct transcript transcript = {.entries = entries, .capacity = LENGTH(entries), .quiet_at_end = quiet_at_end};
    uint8_t bytes[BYTES_MAX];
    size_t n = hex_read(hex, bytes);

    for (uint64_t i = 0; i < CUTS; i++) {
        const char *violated = transcript_decode(&transcript, codec, bytes, n, cuts_number(i));

        text_from_transcript(&text, &transcript, bytes);
        if (violated || strcmp(text.at, expected) != 0) {
            fail(__FILE__, line, "%s, cuts %d: expected [%s], got [%s], contract: %s", hex, (int)i, expected, text.at,
                 violated ? violated : "kept");
            return;
        }
    }
    passed++;
}

struct decode_case {
    int line;
    const char *hex, *expected;
};

#define CASE(hex, expected) {__LINE__, hex, expected}

/* ---- One message after the other */

static const struct decode_case message_cases[] = {
    CASE("", ""),

    /* READ_MESSAGE: standard, extended, each DLC. */
    CASE("0F4105022460ABCD", "123#ABCD"),
    CASE("0F4103000000", "000#"),
    CASE("0F410300FFE0", "7FF#"),
    CASE("0F410300FF00", "7F8#"),
    CASE("0F41030000E0", "007#"),
    CASE("0F4104012460A1", "123#A1"),
    CASE("0F4106032460A1A2A3", "123#A1A2A3"),
    CASE("0F4107042460A1A2A3A4", "123#A1A2A3A4"),
    CASE("0F4108052460A1A2A3A4A5", "123#A1A2A3A4A5"),
    CASE("0F4109062460A1A2A3A4A5A6", "123#A1A2A3A4A5A6"),
    CASE("0F410A072460A1A2A3A4A5A6A7", "123#A1A2A3A4A5A6A7"),
    CASE("0F410B082460A1A2A3A4A5A6A7A8", "123#A1A2A3A4A5A6A7A8"),
    CASE("0F4105 80 00000000", "00000000#"),
    CASE("0F4105 80 FFFFFFF8", "1FFFFFFF#"),
    CASE("0F4105 80 91A2B3C0", "12345678#"),
    CASE("0F4107 82 91A2B3C0 ABCD", "12345678#ABCD"),
    CASE("0F410D 88 91A2B3C0 A1A2A3A4A5A6A7A8", "12345678#A1A2A3A4A5A6A7A8"),

    /* DLC 9 to 15 mean 8 bytes, and are kept. */
    CASE("0F410B092460A1A2A3A4A5A6A7A8", "123#A1A2A3A4A5A6A7A8_9"),
    CASE("0F410B0F2460A1A2A3A4A5A6A7A8", "123#A1A2A3A4A5A6A7A8_F"),
    CASE("0F410D 8C 91A2B3C0 A1A2A3A4A5A6A7A8", "12345678#A1A2A3A4A5A6A7A8_C"),

    /* Remote frames: a DLC, no data; RTR perhaps once more below the identifier. */
    CASE("0F410340 2460", "123#R0"),
    CASE("0F410348 2460", "123#R8"),
    CASE("0F41034F 2460", "123#R8_F"),
    CASE("0F410342 2470", "123#R2"),
    CASE("0F4105C2 91A2B3C0", "12345678#R2"),
    CASE("0F4105C2 91A2B3C4", "12345678#R2"),

    /* Bits 5 and 4 of the frame information mean nothing. */
    CASE("0F4105 12 2460 ABCD", "123#ABCD"),
    CASE("0F4105 22 2460 ABCD", "123#ABCD"),
    CASE("0F4107 B2 91A2B3C0 ABCD", "12345678#ABCD"),

    /* Identifier bits that cannot be. */
    CASE("0F4103 00 2461", "skip6"),
    CASE("0F4103 00 2462", "skip6"),
    CASE("0F4103 00 2464", "skip6"),
    CASE("0F4103 00 2468", "skip6"),
    CASE("0F4103 00 2470", "skip6"),
    CASE("0F4103 42 2478", "skip6"),
    CASE("0F4103 42 2471", "skip6"),
    CASE("0F4105 80 91A2B3C1", "skip8"),
    CASE("0F4105 80 91A2B3C2", "skip8"),
    CASE("0F4105 80 91A2B3C4", "skip8"),
    CASE("0F4105 C0 91A2B3C5", "skip8"),
    CASE("0F4105 C0 91A2B3C6", "skip8"),

    /* A LENGTH that the frame information contradicts. */
    CASE("0F4104 00 2460 A1", "skip7"),
    CASE("0F4104 02 2460 A1", "skip7"),
    CASE("0F4105 42 2460 ABCD", "skip8"),
    CASE("0F4105 02 2460", "+6"),
    CASE("0F4105 82 91A2B3C0", "skip8"),
    CASE("0F4107 02 2460 ABCDABCD", "skip10"),
    CASE("0F410C 09 2460 A1A2A3A4A5A6A7A8A9", "skip15"),
    CASE("0F410E", "skip3"),
    CASE("0F4102", "skip3"),
    CASE("0F4100", "skip3"),
    CASE("0F41FF", "skip3"),
    CASE("0F4110", "skip3"),

    /* READ_MESSAGE_TS: a stamp below 4000 in either byte order. */
    CASE("0F3F07 02 2460 ABCD 0000", "123#ABCD"),
    CASE("0F3F07 02 2460 ABCD 0F9F", "123#ABCD"),
    CASE("0F3F07 02 2460 ABCD 9F0F", "123#ABCD"),
    CASE("0F3F07 02 2460 ABCD 0FA0", "skip10"),
    CASE("0F3F07 02 2460 ABCD A00F", "skip9 +1"),
    CASE("0F3F07 02 2460 ABCD FFFF", "skip10"),
    CASE("0F3F05 00 2460 00FF", "123#"),
    CASE("0F3F05 42 2460 0001", "123#R2"),
    CASE("0F3F07 80 91A2B3C0 0001", "12345678#"),
    CASE("0F3F0F 88 91A2B3C0 A1A2A3A4A5A6A7A8 0001", "12345678#A1A2A3A4A5A6A7A8"),
    CASE("0F3F0D 0F 2460 A1A2A3A4A5A6A7A8 0001", "123#A1A2A3A4A5A6A7A8_F"),
    CASE("0F3F05 02 2460 ABCD", "skip8"),
    CASE("0F3F05 00 2461 0000", "skip8"),
    CASE("0F3F04", "skip3"),
    CASE("0F3F10", "skip3"),

    /* ERROR, CAN_TRANSMIT: the frame back, exact or filled up; what is below its identifier is not looked at. */
    CASE("0F0904 00 00 2460", "returned:123#"),
    CASE("0F0906 00 02 2460 ABCD", "returned:123#ABCD"),
    CASE("0F0906 00 02 247F ABCD", "returned:123#ABCD"),
    CASE("0F090C 00 08 2460 A1A2A3A4A5A6A7A8", "returned:123#A1A2A3A4A5A6A7A8"),
    CASE("0F090E 00 88 91A2B3C7 A1A2A3A4A5A6A7A8", "returned:12345678#A1A2A3A4A5A6A7A8"),
    CASE("0F0904 00 48 2460", "returned:123#R8"),
    CASE("0F0906 00 C1 91A2B3C0", "returned:12345678#R1"),
    CASE("0F090E 00 00 2460 FFFFFFFFFFFFFFFFFFFF", "returned:123#"),
    CASE("0F090E 00 02 2460 ABCDFFFFFFFFFFFFFFFF", "returned:123#ABCD"),
    CASE("0F090E 00 42 2460 FFFFFFFFFFFFFFFFFFFF", "returned:123#R2"),
    CASE("0F090E 00 0A 2460 A1A2A3A4A5A6A7A8FFFF", "returned:123#A1A2A3A4A5A6A7A8_A"),
    CASE("0F090D 00 00 2460 FFFFFFFFFFFFFFFFFF", "skip16"),
    CASE("0F0905 00 00 2460 FF", "skip8"),
    CASE("0F0901 00", "skip4"),
    CASE("0F0902 00 00", "skip5"),
    CASE("0F0903", "skip3"),
    CASE("0F090F", "skip2 +1"),
    CASE("0F0900", "skip3"),

    /* The other kinds of ERROR. */
    CASE("0F0906 01 A1A2A3A4A5", "'09 06 01 A1 A2 A3 A4 A5'"),
    CASE("0F0907 01 A1A2A3A4A5A6", "'09 07 01 A1 A2 A3 A4 A5 A6'"),
    CASE("0F0905 01 A1A2A3A4", "skip8"),
    CASE("0F0902 02 01", "stop"),
    CASE("0F0902 02 00", "go"),
    CASE("0F0902 02 02", "idle5"),
    CASE("0F0902 02 FF", "idle5"),
    CASE("0F0901 02", "skip4"),
    CASE("0F0904 02 010101", "skip7"),
    CASE("0F0901 03", "overrun"),
    CASE("0F0902 03 77", "overrun"),
    CASE("0F0904 03 777777", "skip7"),
    CASE("0F0902 04 00", "skip5"),
    CASE("0F0901 FF", "skip4"),

    /* Answers and other events. */
    CASE("0F0601 00", "'06 01 00'"),
    CASE("0F0601 03", "'06 01 03'"),
    CASE("0F0601 04", "skip4"),
    CASE("0F0600", "skip3"),
    CASE("0F0602", "skip3"),
    CASE("0F0805 A1A2A3A4A5", "'08 05 A1 A2 A3 A4 A5'"),
    CASE("0F0806 A1A2A3A4A5A6", "'08 06 A1 A2 A3 A4 A5 A6'"),
    CASE("0F0804", "skip3"),
    CASE("0F0807", "skip3"),
    CASE("0F1002 7F FF", "'10 02 7F FF'"),
    CASE("0F1002 80 FF", "skip5"),
    CASE("0F1001", "skip3"),
    CASE("0F1201 7F", "'12 01 7F'"),
    CASE("0F1201 80", "skip4"),
    CASE("0F1202", "skip3"),
    CASE("0F2001 08", "'20 01 08'"),
    CASE("0F2004 0F070203", "'20 04 0F 07 02 03'"),
    CASE("0F2005 800F070203", "'20 05 80 0F 07 02 03'"),
    CASE("0F2000", "skip3"),
    CASE("0F2006", "skip3"),
    CASE("0F210C 485730303033465730303136", "'21 0C 48 57 30 30 30 33 46 57 30 30 31 36'"),
    CASE("0F210C 48573030303346573030311F", "skip15"),
    CASE("0F210C 7F5730303033465730303136", "skip15"),
    CASE("0F210B", "skip3"),
    CASE("0F6001 7F", "'60 01 7F'"),
    CASE("0F6101 80", "'61 01 80'"),
    CASE("0F6202 0001", "'62 02 00 01'"),
    CASE("0F6002", "skip3"),
    CASE("0F6201", "skip3"),
    CASE("0F3E00", "idle3"),
    CASE("0F3E02 0102", "idle5"),
    CASE("0F3E04 01020304", "idle7"),
    CASE("0F3E05", "skip3"),

    /* What only the host says, and what nobody does. */
    CASE("0F40 03 00 2460", "skip6"),
    CASE("0F00", "skip2"),
    CASE("0F02", "skip2"),
    CASE("0F11", "skip2"),
    CASE("0F14", "skip2"),
    CASE("0F42", "skip2"),
    CASE("0F7F", "skip2"),
    CASE("0FFF", "skip2"),
    CASE("FF", "skip1"),
    CASE("0041030024 60", "skip6"),

    /* Unfinished. */
    CASE("0F", "+1"),
    CASE("0F41", "+2"),
    CASE("0F4105", "+3"),
    CASE("0F410502", "+4"),
    CASE("0F4105022460AB", "+7"),
    CASE("0F120106 0F", "'12 01 06' +1"),
    CASE("0F120106 0F4105022460ABCD 0F3E00 0F090201", "'12 01 06' 123#ABCD idle3 skip4"),
};

/* ---- Doubt */

static const struct decode_case doubt_cases[] = {
    /* After noise: an answer or event at once, a frame once something follows it. */
    CASE("FFFF 0F120106", "skip2 '12 01 06'"),
    CASE("FFFF 0F09020201", "skip2 stop"),
    CASE("FFFF 0F090103", "skip2 overrun"),
    CASE("FFFF 0F3E00", "skip2 idle3"),
    CASE("FFFF 0F4105022460ABCD", "skip2 +8"),
    CASE("FFFF 0F4105022460ABCD 0F", "skip2 +9"),
    CASE("FFFF 0F4105022460ABCD 0F41", "skip2 +10"),
    CASE("FFFF 0F4105022460ABCD 0F4105", "skip2 +11"),
    CASE("FFFF 0F4105022460ABCD 0F410502", "skip2 123#ABCD +4"),
    CASE("FFFF 0F4105022460ABCD 0F120106", "skip2 123#ABCD '12 01 06'"),
    CASE("FFFF 0F4105022460ABCD 0F3E00", "skip2 123#ABCD idle3"),
    CASE("FFFF 0F090400002460 0F", "skip2 +8"),
    CASE("FFFF 0F090400002460 0F3E00", "skip2 returned:123# idle3"),

    /* Something that contradicts does not confirm. */
    CASE("FFFF 0F4105022460ABCD 00", "skip11"),
    CASE("FFFF 0F4105022460ABCD 0F42", "skip12"),
    CASE("FFFF 0F4105022460ABCD 0F4102", "skip13"),
    CASE("FFFF 0F4105022460ABCD 0F410503", "skip14"),
    CASE("FFFF 0F4105022460ABCD 0F1201FF", "skip14"),
    CASE("FFFF 0F4105022460ABCD 0F0F120106", "skip11 '12 01 06'"),
    CASE("FFFF 0F090400002460 00", "skip10"),

    /* It ends with the first message that counts. */
    CASE("FF 0F4105022460ABCD 0F4105022461ABCD 0F3E00", "skip1 123#ABCD skip8 idle3"),
    CASE("FF 0F120106 0F4105022460ABCD", "skip1 '12 01 06' 123#ABCD"),

    /* A byte lost: the message after is whole. */
    CASE("0F4105022460AB 0F120106", "123#AB0F +3"),
    CASE("0F4105022460AB 0F120106 0F", "123#AB0F +4"),
    CASE("0F4105022460AB 0F120106 0F3E00", "123#AB0F '12 01 06' idle3"),
    CASE("0F4105022460AB 0F120106 0F120107", "123#AB0F '12 01 06' '12 01 07'"),
    CASE("0F4105022460 0F120106 0F120107", "123#0F12 ^'12 01 06' '12 01 07'"),
    CASE("0F41052460ABCD 0F120106", "skip7 '12 01 06'"),
    CASE("0F4105022460AB 0F4105024680ABCD 0F3E00", "123#AB0F 234#ABCD idle3"),
    CASE("0F4105022460AB 0F3F07024680ABCD0001 0F3E00", "123#AB0F 234#ABCD idle3"),
    CASE("0F4105022460AB 0F0906000246 80ABCD 0F3E00", "123#AB0F returned:234#ABCD idle3"),
    CASE("0F4105022460AB 0F09020201 0F3E00", "123#AB0F stop idle3"),
    CASE("0F4105022460AB 0F09020200 0F3E00", "123#AB0F go idle3"),
    CASE("0F4105022460AB 0F090103 0F3E00", "123#AB0F overrun idle3"),
    CASE("0F4105022460AB 0F3E00 0F120106", "123#AB0F idle2 '12 01 06'"),
    CASE("0F20050F070102 0F120106 0F120107", "'20 05 0F 07 01 02 0F' '12 01 06' '12 01 07'"),
    CASE("0F4105022460AB 0F210C485730303033465730303136 0F3E00",
         "123#AB0F '21 0C 48 57 30 30 30 33 46 57 30 30 31 36' idle3"),

    /* ... unless nothing confirms it: it lost a byte itself, or what follows did. */
    CASE("0F4105022460AB 0F4105024680AB 0F120106 0F3E00", "123#AB0F skip6 '12 01 06' idle3"),
    CASE("0F4105022460AB 0F120106 00", "123#AB0F skip4"),
    CASE("0F4105022460AB 0F120106 0F12FF", "123#AB0F skip6"),

    /* Many lost: what a damaged message took whole is gone, but confirms what it took half. */
    CASE("0F410B082460 0F12010C 0F12010D FF", "123#0F12010C0F12010D skip1"),
    CASE("0F410B082460 A1 0F12010C 0F12010D FF", "123#A10F12010C0F1201 ^'12 01 0D' skip1"),
    CASE("0F410B082460 A1A2A3A4A5 0F12010C FF", "123#A1A2A3A4A50F1201 skip2"),

    /* The end of data is no place where a message began, and an inner message is none that went on. */
    CASE("0F4106032460 0F3E00 FF 0F120106", "123#0F3E00 skip1 '12 01 06'"),
    CASE("0F410401 2460 0F FF 0F120106", "123#0F skip1 '12 01 06'"),

    /* Only the last message is looked at. */
    CASE("0F4104012460 0F 0F120106 FF 120107", "123#0F '12 01 06' skip4"),
    CASE("0F410401 2460 0F FF 120106 0F3E00", "123#0F skip4 idle3"),

    /* Inserted bytes. */
    CASE("0F4105022460AB 00 CD 0F120106", "123#AB00 skip1 '12 01 06'"),
    CASE("0F4105022460AB 0F CD 0F120106", "123#AB0F skip1 '12 01 06'"),
    CASE("0F 0F120106", "skip1 '12 01 06'"),
    CASE("0F41 0F120106", "skip2 '12 01 06'"),
    CASE("0F4105 0F120106", "skip3 '12 01 06'"),
    CASE("0F410502 0F120106 0F3E00", "skip4 '12 01 06' idle3"),
};

/* What silence decides. */
static const struct decode_case quiet_cases[] = {
    CASE("0F4105022460ABCD", "123#ABCD"),
    CASE("FFFF 0F4105022460ABCD", "skip2 123#ABCD"),
    CASE("FFFF 0F4105022460ABCD 0F", "skip2 123#ABCD skip1"),
    CASE("FFFF 0F4105022460ABCD 0F4105", "skip2 123#ABCD skip3"),
    CASE("0F4105022460AB", "skip7"),
    CASE("0F", "skip1"),
    CASE("0F4105 0F12", "skip5"),
    CASE("0F410A 07 2460 0F120106", "skip6 '12 01 06'"),
    CASE("0F410A 07 2460 0F4105022460", "skip12"),
    CASE("0F4105022460AB 0F120106", "123#AB0F '12 01 06'"),
    CASE("0F4105022460AB 0F120106 0F", "123#AB0F '12 01 06' skip1"),
    CASE("0F4105022460AB 0F4105024680ABCD", "123#AB0F 234#ABCD"),
    CASE("0F4105022460AB 0F4105024680AB", "123#AB0F skip6"),
    CASE("0F4105022460AB 0F120106 FF", "123#AB0F skip4"),
};

static void test_decode(void)
{
    for (size_t i = 0; i < LENGTH(message_cases); i++)
        check_decode(message_cases[i].line, message_cases[i].hex, false, message_cases[i].expected);
    for (size_t i = 0; i < LENGTH(doubt_cases); i++)
        check_decode(doubt_cases[i].line, doubt_cases[i].hex, false, doubt_cases[i].expected);
    for (size_t i = 0; i < LENGTH(quiet_cases); i++)
        check_decode(quiet_cases[i].line, quiet_cases[i].hex, true, quiet_cases[i].expected);
}

/* Every COMMAND with every LENGTH: taken if and only if the table of the document has it. */
static void test_lengths(void)
{
    static const struct {
        uint8_t command, from, to;
    } legal[] = {
        {6, 1, 1},   {8, 5, 6},    {16, 2, 2}, {18, 1, 1}, {32, 1, 5}, {33, 12, 12},
        {62, 0, 4},  {96, 1, 1},   {97, 1, 1}, {98, 2, 2}, {63, 5, 5}, {65, 3, 3},
    };

    unsigned wrong = 0;
    for (unsigned command = 0; command < 256; command++)
        for (unsigned length = 0; length < 256; length++) {
            uint8_t bytes[3 + 256] = {0x0F, (uint8_t)command, (uint8_t)length};
            struct codec_state state = {0};
            struct codec_message msg;
            struct can_frame frame;
            bool expected = command == 9 && (length == 4 || length == 14); /* all zero: a frame returned */
            for (size_t i = 0; i < LENGTH(legal); i++)
                expected |= command == legal[i].command && length >= legal[i].from && length <= legal[i].to;
            if (command == 33)
                memset(bytes + 3, 'H', sizeof bytes - 3);
            size_t taken = codec->decode(&state, bytes, 3 + length, &frame, &msg);
            bool accepted = taken == 3 + length && msg.kind != CODEC_SKIPPED;
            if (accepted != expected) {
                printf("COMMAND %u, LENGTH %u: %s\n", command, length, accepted ? "taken" : "not taken");
                wrong++;
            }
        }
    CHECK(wrong == 0);
}

/* A frame is written whole, whatever the memory held. */
static void test_frame_is_whole(void)
{
    struct can_frame expected = {.can_id = 0x12345678 | CAN_EFF_FLAG | CAN_RTR_FLAG, .len = 8, .len8_dlc = 9};
    struct can_frame frame;
    struct codec_state state = {0};
    struct codec_message msg;

    memset(&frame, 0xFF, sizeof frame);
    CHECK(codec->decode(&state, (const uint8_t *)"\x0F\x41\x05\xC9\x91\xA2\xB3\xC0", 8, &frame, &msg) == 8);
    CHECK(memcmp(&frame, &expected, sizeof frame) == 0);
    CHECK(msg.kind == CODEC_FRAME && msg.stamp_digits == 0 && msg.length == 0 && !msg.text);

    expected = (struct can_frame){.can_id = 0x123, .len = 1, .data = {0xAB}};
    memset(&frame, 0xFF, sizeof frame);
    CHECK(codec->decode(&state, (const uint8_t *)"\x0F\x09\x05\x00\x01\x24\x60\xAB", 8, &frame, &msg) == 8);
    CHECK(memcmp(&frame, &expected, sizeof frame) == 0);
    CHECK(msg.kind == CODEC_RETURNED);
}

/* No byte: no message, in whatever state. */
static void test_nothing(void)
{
    uint8_t *nothing = malloc(1);
    struct codec_state state = {0}, doubt = {.doubt = true, .quiet = true};
    struct codec_message msg;
    struct can_frame frame;

    CHECK(nothing && codec->decode(&state, nothing + 1, 0, &frame, &msg) == 0);
    CHECK(nothing && codec->decode(&doubt, nothing + 1, 0, &frame, &msg) == 0);
    free(nothing);
}

/* ---- Encoding */

static void check_encode(int line, struct can_frame frame, const char *hex)
{
    uint8_t expected[BYTES_MAX], *out = malloc(codec->frame_max);
    size_t n = hex_read(hex, expected);

    if (out && codec->encode[REMOTE_PLAIN](&frame, out) == n && memcmp(out, expected, n) == 0)
        passed++;
    else
        fail(__FILE__, line, "not encoded as %s", hex);
    free(out);
}

#define FRAME(...) ((struct can_frame){__VA_ARGS__})
#define ENCODE(frame, hex) check_encode(__LINE__, frame, hex)
#define DATA {0xA1, 0xA2, 0xA3, 0xA4, 0xA5, 0xA6, 0xA7, 0xA8}

static void test_encode(void)
{
    ENCODE(FRAME(.can_id = 0x123, .len = 2, .data = DATA), "0F4005022460A1A2");
    ENCODE(FRAME(.can_id = 0), "0F4003000000");
    ENCODE(FRAME(.can_id = 0x7FF), "0F400300FFE0");
    ENCODE(FRAME(.can_id = 0x7FF, .len = 8, .data = DATA), "0F400B08FFE0A1A2A3A4A5A6A7A8");
    ENCODE(FRAME(.can_id = 0x12345678 | CAN_EFF_FLAG, .len = 1, .data = DATA), "0F40068191A2B3C0A1");
    ENCODE(FRAME(.can_id = 0x123 | CAN_EFF_FLAG), "0F40058000000918");
    ENCODE(FRAME(.can_id = 0x1FFFFFFF | CAN_EFF_FLAG, .len = 8, .data = DATA), "0F400D88FFFFFFF8A1A2A3A4A5A6A7A8");
    ENCODE(FRAME(.can_id = 0x123 | CAN_RTR_FLAG, .len = 8, .data = DATA), "0F4003482460");
    ENCODE(FRAME(.can_id = 0x12345678 | CAN_EFF_FLAG | CAN_RTR_FLAG, .len = 3), "0F4005C391A2B3C0");
    ENCODE(FRAME(.can_id = 0x123, .len = 8, .len8_dlc = 15, .data = DATA), "0F400B082460A1A2A3A4A5A6A7A8");

    ENCODE(FRAME(.can_id = 0x800), "");
    ENCODE(FRAME(.can_id = 0x1FFFFFFF), "");
    ENCODE(FRAME(.can_id = 0x123, .len = 9), "");
    ENCODE(FRAME(.can_id = 0x123 | CAN_RTR_FLAG, .len = 9), "");
    ENCODE(FRAME(.can_id = 0x123 | CAN_ERR_FLAG, .len = 8), "");
    ENCODE(FRAME(.can_id = 0x123, .len = 255), "");
}

/* ---- The level of the device's transmit buffer */

static void test_level(void)
{
    static const struct {
        const char *hex;
        int level;
    } cases[] = {
        {"2005800F070203", 5}, {"20040F070203", 5},   {"2005800F070000", 0},   {"20040F07FFFF", 510},
        {"2005810F070203", -1}, {"200100", -1},       {"2003070203", -1},      {"20020F07", -1},
        {"06010F", -1},        {"2105800F070203", -1}, {"2004800F070203", -1}, {"2005800F0702", -1},
        {"20", -1},             {"", -1},
    };

    for (size_t i = 0; i < LENGTH(cases); i++) {
        uint8_t bytes[BYTES_MAX];
        size_t n = hex_read(cases[i].hex, bytes);
        uint8_t *text = malloc(n + 1);
        CHECK(text != NULL);
        memcpy(text, bytes, n);
        if (codec->level(text, n) != cases[i].level)
            fail(__FILE__, __LINE__, "level of %s: %d", cases[i].hex, codec->level(text, n));
        free(text);
    }
}

static void test_constants(void)
{
    CHECK(strcmp(codec->name, "usb2can") == 0);
    CHECK(codec->line_max == 22);
    CHECK(codec->frame_max == 16);
}

int main(void)
{
    test_constants();
    test_decode();
    test_lengths();
    test_frame_is_whole();
    test_nothing();
    test_encode();
    test_level();
    return checks_end();
}
