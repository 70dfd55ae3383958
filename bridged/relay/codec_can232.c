/*
 * CAN232 (LAWICEL, "slcan"): lines of ASCII that end in CR. "t10021133\r" is id 100, DLC 2, data 11 33.
 *
 * Received      message
 * t10021133\r   CODEC_FRAME: t standard, T extended, r and R the same as remote frames, which carry no data;
 *               4 hex digits of time stamp may follow (8 where short_stamps is not set): "t100211334D67\r";
 *               a remote frame may have them after as much data as its DLC says, of no meaning: slcanpty
 * \r            CODEC_OK, but CODEC_SKIPPED when noise came just before it: it may be that line's end
 * z\r  Z\r      CODEC_SENT
 * \a            CODEC_REFUSED, wherever it comes; it ends a line that it interrupts, which is then skipped
 * V1013\r       CODEC_TEXT, and so is every other line of printable ASCII and, but at its start, TABs
 * \n            CODEC_IDLE at the start of a line
 *
 * Everything else is CODEC_SKIPPED: noise between lines byte by byte, a line with noise in it as a whole, and
 * so a line that begins like a frame and is none. Frames are never guessed out of broken lines.
 *
 * DLC 9 to F mean 8 data bytes (ISO 11898-1); the DLC is kept in len8_dlc, but not sent: the manual knows 0 to 8.
 */
#include "codec.h"

#include <assert.h>
#include <string.h>

enum {
    CR = '\r',
    LF = '\n',
    TAB = '\t',
    BELL = '\a',

    SFF_DIGITS = 3,
    EFF_DIGITS = 8,
    STAMP_STEP = 4, /* a time stamp has 0, 4 or 8 digits */
    STAMP_MAX = 8,

    CAN232_FRAME_MAX = 1 + EFF_DIGITS + 1 + 2 * CAN_MAX_DLEN + 1,
    CAN232_LINE_MAX = 256, /* clones answer V with a git URL */

    HEX = 0x10, /* marks a hex digit in hex_table, whose low four bits are its value */
    NIBBLE = 0x0F,
};
static_assert((int)CAN232_LINE_MAX <= (int)CODEC_LINE_MAX, "a line does not fit");
static_assert((int)CAN232_FRAME_MAX <= (int)CODEC_FRAME_MAX, "a frame does not fit");

static const uint8_t hex_table[256] = {
    ['0'] = HEX | 0,  ['1'] = HEX | 1,  ['2'] = HEX | 2,  ['3'] = HEX | 3,  ['4'] = HEX | 4,  ['5'] = HEX | 5,
    ['6'] = HEX | 6,  ['7'] = HEX | 7,  ['8'] = HEX | 8,  ['9'] = HEX | 9,  ['A'] = HEX | 10, ['B'] = HEX | 11,
    ['C'] = HEX | 12, ['D'] = HEX | 13, ['E'] = HEX | 14, ['F'] = HEX | 15, ['a'] = HEX | 10, ['b'] = HEX | 11,
    ['c'] = HEX | 12, ['d'] = HEX | 13, ['e'] = HEX | 14, ['f'] = HEX | 15,
};

static bool is_printable(uint8_t byte)
{
    return byte >= 0x20 && byte <= 0x7E;
}

static bool is_noise(uint8_t byte)
{
    return !is_printable(byte) && byte != CR && byte != LF && byte != BELL;
}

static bool is_frame_letter(uint8_t byte)
{
    return byte == 't' || byte == 'T' || byte == 'r' || byte == 'R';
}

static size_t report(struct codec_message *msg, enum codec_kind kind, size_t taken)
{
    *msg = (struct codec_message){.kind = kind, .length = kind == CODEC_SKIPPED ? taken : 0};
    return taken;
}

static bool is_hex(const uint8_t *in, size_t n)
{
    for (size_t i = 0; i < n; i++)
        if (!hex_table[in[i]])
            return false;
    return true;
}

/* What follows the data, up to the CR: "" 0, "4D67" 4, "0001E240" 8 digits; -1 when it is anything else. */
static int stamp_measure(const struct codec_state *state, const uint8_t *in, size_t n)
{
    if (n > 0 && in[0] == CR)
        return 0;
    size_t longest = state->short_stamps ? STAMP_STEP : STAMP_MAX;
    for (size_t digits = 0; digits <= longest; digits += STAMP_STEP) {
        if (n <= digits)
            return -1;
        if (in[digits] == CR)
            return (int)digits;
        if (n - digits < STAMP_STEP || !is_hex(in + digits, STAMP_STEP))
            return -1;
    }
    return -1;
}

/* A valid frame that is all there: its length with the CR. 0: it is none, or not all there yet. */
static size_t frame_decode(const struct codec_state *state, const uint8_t *in, size_t n, struct can_frame *frame,
                           struct codec_message *msg)
{
    if (!is_frame_letter(in[0]))
        return 0;
    bool extended = in[0] == 'T' || in[0] == 'R';
    bool remote = in[0] == 'r' || in[0] == 'R';
    size_t head = 1 + (extended ? EFF_DIGITS : SFF_DIGITS) + 1;
    if (n < head)
        return 0;

    canid_t id = 0;
    unsigned int hex = HEX;
    for (size_t i = 1; i < head - 1; i++) {
        hex &= hex_table[in[i]];
        id = id << 4 | (hex_table[in[i]] & NIBBLE);
    }
    hex &= hex_table[in[head - 1]];
    if (!hex || id > (extended ? CAN_EFF_MASK : CAN_SFF_MASK))
        return 0;

    uint8_t dlc = hex_table[in[head - 1]] & NIBBLE;
    uint8_t len = dlc > CAN_MAX_DLEN ? CAN_MAX_DLEN : dlc;
    size_t data_len = remote ? 0 : len;
    size_t body = head + 2 * data_len;
    if (n < body)
        return 0;
    int stamp_digits = stamp_measure(state, in + body, n - body);
    if (stamp_digits < 0 && remote && n - body > 2 * (size_t)len && is_hex(in + body, 2 * (size_t)len)) {
        body += 2 * (size_t)len;
        stamp_digits = stamp_measure(state, in + body, n - body);
    }
    if (stamp_digits < 0)
        return 0;

    struct can_frame found;
    memset(&found, 0, sizeof found);
    found.can_id = id | (extended ? CAN_EFF_FLAG : 0) | (remote ? CAN_RTR_FLAG : 0);
    found.len = len;
    found.len8_dlc = dlc > CAN_MAX_DLEN ? dlc : 0;
    for (size_t i = 0; i < data_len; i++) {
        unsigned int high = hex_table[in[head + 2 * i]];
        unsigned int low = hex_table[in[head + 2 * i + 1]];
        hex &= high & low;
        found.data[i] = (uint8_t)((high & NIBBLE) << 4 | (low & NIBBLE));
    }
    if (!hex)
        return 0;

    *frame = found;
    report(msg, CODEC_FRAME, 0);
    msg->stamp_digits = (uint8_t)stamp_digits;
    return body + (size_t)stamp_digits + 1;
}

/* The rest of a line that was too long; 0 when a BELL comes at once: that is a message of its own. */
static size_t long_line_skip(struct codec_state *state, const uint8_t *in, size_t n, struct codec_message *msg)
{
    size_t end = 0;
    while (end < n && in[end] != CR && in[end] != BELL)
        end++;
    if (end == n)
        return report(msg, CODEC_SKIPPED, n);
    state->can232.discarding = false;
    state->can232.dirty = false;
    return report(msg, CODEC_SKIPPED, in[end] == CR ? end + 1 : end);
}

static size_t noise_skip(struct codec_state *state, const uint8_t *in, size_t n, struct codec_message *msg)
{
    size_t end = 1;
    while (end < n && is_noise(in[end]))
        end++;
    state->can232.dirty = true;
    return report(msg, CODEC_SKIPPED, end);
}

/* A line that begins with a printable byte and is no valid frame. */
static size_t line_decode(struct codec_state *state, const uint8_t *in, size_t n, struct codec_message *msg)
{
    size_t limit = n < CAN232_LINE_MAX ? n : CAN232_LINE_MAX;
    size_t end = 0;
    bool printable = true;
    while (end < limit && in[end] != CR && in[end] != BELL) {
        printable = printable && (is_printable(in[end]) || in[end] == TAB);
        end++;
    }
    if (end == CAN232_LINE_MAX) {
        state->can232.discarding = true;
        return report(msg, CODEC_SKIPPED, end);
    }
    if (end == n)
        return 0;

    state->can232.dirty = false;
    if (in[end] == BELL)
        return report(msg, CODEC_SKIPPED, end);
    if (!printable || is_frame_letter(in[0]))
        return report(msg, CODEC_SKIPPED, end + 1);
    if (end == 1 && (in[0] == 'z' || in[0] == 'Z'))
        return report(msg, CODEC_SENT, end + 1);
    report(msg, CODEC_TEXT, 0);
    msg->text = in;
    msg->length = end;
    return end + 1;
}

static size_t empty_line_decode(struct codec_state *state, struct codec_message *msg)
{
    enum codec_kind kind = state->can232.dirty ? CODEC_SKIPPED : CODEC_OK;
    state->can232.dirty = false;
    return report(msg, kind, 1);
}

static size_t can232_decode(struct codec_state *state, const uint8_t *in, size_t n, struct can_frame *frame,
                            struct codec_message *msg)
{
    if (n == 0)
        return 0;
    if (state->can232.discarding) {
        size_t skipped = long_line_skip(state, in, n, msg);
        if (skipped > 0)
            return skipped;
    }
    size_t taken = frame_decode(state, in, n, frame, msg);
    if (taken > 0) {
        state->can232.dirty = false;
        return taken;
    }
    switch (in[0]) {
    case CR:
        return empty_line_decode(state, msg);
    case LF:
        return report(msg, CODEC_IDLE, 1);
    case BELL:
        state->can232.dirty = false;
        return report(msg, CODEC_REFUSED, 1);
    default:
        return is_noise(in[0]) ? noise_skip(state, in, n, msg) : line_decode(state, in, n, msg);
    }
}

static bool is_remote(const struct can_frame *frame)
{
    return frame->can_id & CAN_RTR_FLAG;
}

static size_t can232_encode(const struct can_frame *frame, uint8_t *out)
{
    static const uint8_t digits[] = "0123456789ABCDEF";
    bool extended = frame->can_id & CAN_EFF_FLAG;
    bool remote = is_remote(frame);
    canid_t id = frame->can_id & CAN_EFF_MASK;
    size_t len = frame->len;
    if ((frame->can_id & CAN_ERR_FLAG) || len > CAN_MAX_DLEN || (!extended && id > CAN_SFF_MASK))
        return 0;

    size_t n = 0;
    if (extended)
        out[n++] = remote ? 'R' : 'T';
    else
        out[n++] = remote ? 'r' : 't';
    for (size_t i = extended ? EFF_DIGITS : SFF_DIGITS; i > 0; i--)
        out[n++] = digits[id >> (4 * (i - 1)) & NIBBLE];
    out[n++] = digits[len];
    for (size_t i = 0; !remote && i < len; i++) {
        out[n++] = digits[frame->data[i] >> 4];
        out[n++] = digits[frame->data[i] & NIBBLE];
    }
    out[n++] = CR;
    return n;
}

/* "r1002\r" becomes "r10020000\r". */
static size_t can232_encode_digits(const struct can_frame *frame, uint8_t *out)
{
    size_t n = can232_encode(frame, out);
    if (!n || !is_remote(frame))
        return n;
    memset(out + n - 1, '0', 2 * (size_t)frame->len);
    n += 2 * (size_t)frame->len;
    out[n - 1] = CR;
    return n;
}

static size_t can232_encode_no_standard(const struct can_frame *frame, uint8_t *out)
{
    bool standard = !(frame->can_id & CAN_EFF_FLAG);
    return standard && is_remote(frame) ? 0 : can232_encode(frame, out);
}

static size_t can232_encode_data(const struct can_frame *frame, uint8_t *out)
{
    return is_remote(frame) ? 0 : can232_encode(frame, out);
}

/* A command without CR (there are those that only spoil what was typed before) ends with all that there is. */
static size_t can232_length(const uint8_t *message, size_t n)
{
    const uint8_t *end = memchr(message, CR, n);
    return end ? (size_t)(end - message) + 1 : n;
}

const struct codec codec_can232 = {
    .name = "can232",
    .line_max = CAN232_LINE_MAX,
    .frame_max = CAN232_FRAME_MAX,
    .confirms = CONFIRMS_EACH,
    .decode = can232_decode,
    .encode = {
        [REMOTE_PLAIN] = can232_encode,
        [REMOTE_WITH_DIGITS] = can232_encode_digits,
        [REMOTE_NO_STANDARD] = can232_encode_no_standard,
        [REMOTE_NONE] = can232_encode_data,
    },
    .length = can232_length,
};
