/*
 * CANLAB USB2CAN: messages 0F COMMAND LENGTH DATA, without checksum, escapes or an end.
 *
 * Received                  message
 * 0F 41 05 02 24 60 AB CD   CODEC_FRAME: READ_MESSAGE, id 123, DLC 2, data AB CD, as the SJA1000 has it:
 *                           FF RTR x x DLC; identifier, left-aligned in 2 bytes (FF: 4); data, RTR: none
 * 0F 3F 05 00 24 60 9F 0F   CODEC_FRAME: READ_MESSAGE_TS; a time stamp of 0 to 3999 follows, which is dropped
 * 0F 09 04 00 00 24 60      CODEC_RETURNED: ERROR, CAN_TRANSMIT; may be filled up to a LENGTH of 14
 * 0F 09 02 02 01            CODEC_STOP: ERROR, CRITICAL_TRANSMIT; with 00 CODEC_GO; any other CODEC_IDLE:
 *                           devices with wrong limits repeat 02
 * 0F 09 01 03               CODEC_OVERRUN: ERROR, RX_OVERRUN
 * 0F 12 01 06               CODEC_TEXT 12 01 06: WRITE_REG was done; so all answers, BUS_OFF, ERROR STATUS
 * 0F 3E ..                  CODEC_IDLE: TIMESTAMP
 *
 * Everything else is CODEC_SKIPPED, and so is a message that contradicts itself: a LENGTH that its COMMAND,
 * frame information or kind of ERROR cannot have, identifier bits that the SJA1000 never sets.
 *
 * Where messages begin, nothing tells for certain: data may hold anything. As long as each begins where the
 * one before ended it is taken at once. Where none begins, there is doubt:
 *   1. Bytes may have been lost. Then the last message took the first bytes of the next as its own data, and
 *      that begins within it: in 0F 41 05 02 24 60 AB 0F 12 01 06, at the last 0F. So each is kept for that.
 *   2. Otherwise bytes are skipped up to where a message begins. An answer or event is taken there at once:
 *      the device may say nothing more until it is asked. A frame must be confirmed, and so must anything
 *      under 1: by what may be a message just after it.
 *
 * The cost of damage is what it touches and the message after; besides, what a damaged message took whole as
 * its data, and what lies where data is made of messages that follow each other from one frame to the next.
 */
#include "codec.h"

#include <assert.h>
#include <string.h>

enum {
    START = 0x0F,
    HEAD = 3, /* START, COMMAND, LENGTH */

    GET_MODE = 6, BUS_OFF = 8, ERROR = 9, READ_REG = 16, WRITE_REG = 18, COMMAND = 32, FW_VERSION = 33,
    TIMESTAMP = 62, READ_MESSAGE_TS = 63, WRITE_MESSAGE = 64, READ_MESSAGE = 65,
    READ_TEC = 96, READ_REC = 97, READ_RST = 98,

    ERROR_CAN_TRANSMIT = 0, ERROR_STATUS = 1, ERROR_CRITICAL_TRANSMIT = 2, ERROR_RX_OVERRUN = 3,

    COMMAND_GET = 128,
    MODE_MAX = 3,
    REGISTER_MAX = 127,
    STAMP_BYTES = 2,
    STAMP_MAX = 3999,

    INFO_FF = 0x80,
    INFO_RTR = 0x40,
    INFO_DLC = 0x0F,
    SFF_ID_BYTES = 2,
    EFF_ID_BYTES = 4,
    SFF_SHIFT = 5, /* bits below an identifier */
    EFF_SHIFT = 3,

    FRAME_BYTES_MAX = 1 + EFF_ID_BYTES + CAN_MAX_DLEN,
    RETURNED_LENGTH = 1 + FRAME_BYTES_MAX, /* of a message that is filled up */
    MESSAGE_MAX = HEAD + FRAME_BYTES_MAX + STAMP_BYTES,
    CONFIRM_BYTES = 4, /* of the next message: its head and, in a frame, the frame information */
    USB2CAN_LINE_MAX = MESSAGE_MAX + CONFIRM_BYTES,
};

static_assert((int)MESSAGE_MAX <= (int)CODEC_KEPT_MAX, "codec_state keeps any message");
static_assert((int)USB2CAN_LINE_MAX <= (int)CODEC_LINE_MAX, "a message does not fit");
static_assert(HEAD + FRAME_BYTES_MAX <= (int)CODEC_FRAME_MAX, "a frame does not fit");

enum { NONE = -1, MORE = 0 }; /* instead of a length: no message; perhaps one, but not all of it is there */

/* Bit n: LENGTH n is legal. 0: the device never says this. */
static const uint16_t legal_lengths[256] = {
    [GET_MODE] = 1 << 1,   [BUS_OFF] = 1 << 5 | 1 << 6, [ERROR] = 0x7FF6 /* 1, 2, 4 to 14 */,
    [READ_REG] = 1 << 2,   [WRITE_REG] = 1 << 1,        [COMMAND] = 0x003E /* 1 to 5 */,
    [READ_TEC] = 1 << 1,   [READ_REC] = 1 << 1,         [READ_RST] = 1 << 2,
    [FW_VERSION] = 1 << 12, [TIMESTAMP] = 0x001F /* 0 to 4 */,
    [READ_MESSAGE] = 0x3FF8 /* 3 to 13 */, [READ_MESSAGE_TS] = 0xFFE0 /* 5 to 15 */,
};

static size_t report(struct codec_message *msg, enum codec_kind kind, size_t taken)
{
    *msg = (struct codec_message){.kind = kind, .length = kind == CODEC_SKIPPED ? taken : 0};
    return taken;
}

static size_t min_size(size_t a, size_t b)
{
    return a < b ? a : b;
}

static size_t id_bytes(uint8_t info)
{
    return info & INFO_FF ? EFF_ID_BYTES : SFF_ID_BYTES;
}

static size_t data_bytes(uint8_t info)
{
    return info & INFO_RTR ? 0 : min_size(info & INFO_DLC, CAN_MAX_DLEN);
}

static size_t frame_bytes(uint8_t info)
{
    return 1 + id_bytes(info) + data_bytes(info);
}

/* Below its identifier a received frame has zeros, or RTR once more. */
static bool id_clean(const uint8_t *at)
{
    unsigned int rtr = 1U << ((at[0] & INFO_FF ? EFF_SHIFT : SFF_SHIFT) - 1);
    unsigned int below = at[id_bytes(at[0])] & (2 * rtr - 1);
    return below == 0 || (below == rtr && (at[0] & INFO_RTR));
}

static void frame_read(const uint8_t *at, struct can_frame *frame)
{
    uint8_t info = at[0], dlc = info & INFO_DLC;
    canid_t id;
    if (info & INFO_FF) {
        id = (canid_t)at[1] << 24 | (canid_t)at[2] << 16 | (canid_t)at[3] << 8 | at[4];
        id = id >> EFF_SHIFT | CAN_EFF_FLAG;
    } else {
        id = ((canid_t)at[1] << 8 | at[2]) >> SFF_SHIFT;
    }
    memset(frame, 0, sizeof *frame);
    frame->can_id = id | (info & INFO_RTR ? CAN_RTR_FLAG : 0);
    frame->len = dlc > CAN_MAX_DLEN ? CAN_MAX_DLEN : dlc;
    frame->len8_dlc = dlc > CAN_MAX_DLEN ? dlc : 0;
    size_t n = data_bytes(info);
    const uint8_t *data = at + 1 + id_bytes(info);
    if (n == CAN_MAX_DLEN)
        memcpy(frame->data, data, CAN_MAX_DLEN); /* what most frames have, and a constant size is fast */
    else
        for (size_t i = 0; i < n; i++)
            frame->data[i] = data[i];
}

static bool stamp_legal(const uint8_t *at)
{
    int little = at[0] | at[1] << 8, big = at[0] << 8 | at[1]; /* the document does not say which */
    return little <= STAMP_MAX || big <= STAMP_MAX;
}

static bool all_printable(const uint8_t *at, size_t n)
{
    for (size_t i = 0; i < n; i++)
        if (at[i] < 0x20 || at[i] > 0x7E)
            return false;
    return true;
}

/* Whether at[0..n), all that is there yet, may be DATA of this LENGTH; so do the next two (n <= length). */
static bool received_possible(const uint8_t *at, size_t n, size_t length)
{
    return n == 0 || (frame_bytes(at[0]) == length && (n <= id_bytes(at[0]) || id_clean(at)));
}

static bool error_possible(const uint8_t *at, size_t n, size_t length)
{
    if (n == 0)
        return true;
    switch (at[0]) {
    case ERROR_CAN_TRANSMIT:
        return length > 2 && (n == 1 || length == RETURNED_LENGTH || length == 1 + frame_bytes(at[1]));
    case ERROR_STATUS:
        return length == 6 || length == 7;
    case ERROR_CRITICAL_TRANSMIT:
        return length == 2;
    case ERROR_RX_OVERRUN:
        return length <= 2;
    default:
        return false;
    }
}

static bool data_possible(uint8_t command, const uint8_t *at, size_t n, size_t length)
{
    switch (command) {
    case READ_MESSAGE:
        return received_possible(at, n, length);
    case READ_MESSAGE_TS:
        length -= STAMP_BYTES;
        return received_possible(at, min_size(n, length), length) &&
               (n < length + STAMP_BYTES || stamp_legal(at + length));
    case ERROR:
        return error_possible(at, n, length);
    case GET_MODE:
        return n == 0 || at[0] <= MODE_MAX;
    case READ_REG:
    case WRITE_REG:
        return n == 0 || at[0] <= REGISTER_MAX;
    case FW_VERSION:
        return all_printable(at, n);
    default:
        return true;
    }
}

/* The length of the message that begins at in[0], or MORE, or NONE; n >= 1. */
static int message_measure(const uint8_t *in, size_t n)
{
    if (in[0] != START)
        return NONE;
    if (n == 1)
        return MORE;
    unsigned int lengths = legal_lengths[in[1]];
    if (n < HEAD)
        return lengths ? MORE : NONE;
    size_t length = in[2];
    if (length >= 16 || !(lengths >> length & 1))
        return NONE;
    if (!data_possible(in[1], in + HEAD, min_size(n - HEAD, length), length))
        return NONE;
    return n < HEAD + length ? MORE : (int)(HEAD + length);
}

static enum codec_kind error_kind(const uint8_t *data)
{
    if (data[0] == ERROR_CRITICAL_TRANSMIT)
        return data[1] == 1 ? CODEC_STOP : data[1] == 0 ? CODEC_GO : CODEC_IDLE;
    if (data[0] == ERROR_CAN_TRANSMIT)
        return CODEC_RETURNED;
    return data[0] == ERROR_STATUS ? CODEC_TEXT : CODEC_OVERRUN;
}

/* Of a message that has been measured. */
static enum codec_kind message_kind(const uint8_t *in)
{
    switch (in[1]) {
    case READ_MESSAGE:
    case READ_MESSAGE_TS:
        return CODEC_FRAME;
    case ERROR:
        return error_kind(in + HEAD);
    case TIMESTAMP:
        return CODEC_IDLE;
    default:
        return CODEC_TEXT;
    }
}

/* Takes a message that has been measured, at in[0..n), and keeps it, as the next may begin in it. */
static size_t message_take(struct codec_state *state, const uint8_t *in, size_t n, size_t length,
                           struct can_frame *frame, struct codec_message *msg)
{
    enum codec_kind kind = message_kind(in);
    report(msg, kind, 0);
    if (kind == CODEC_FRAME) {
        frame_read(in + HEAD, frame);
    } else if (kind == CODEC_RETURNED) {
        frame_read(in + HEAD + 1, frame);
    } else if (kind == CODEC_TEXT) {
        msg->text = in + 1;
        msg->length = length - 1;
    }
    if (n >= CODEC_KEPT_MAX)
        memcpy(state->usb2can.kept, in, CODEC_KEPT_MAX); /* as with the data: fast, and the rest is not looked at */
    else
        memcpy(state->usb2can.kept, in, length);
    state->usb2can.kept_length = (uint8_t)length;
    state->doubt = false;
    return length;
}

/* Whether what follows a message, in[0..n), confirms it: 1, or MORE, or NONE. */
static int confirmation(const uint8_t *in, size_t n, bool quiet)
{
    int length = n == 0 ? MORE : message_measure(in, min_size(n, CONFIRM_BYTES));
    if (length == NONE)
        return NONE;
    return length != MORE || n >= CONFIRM_BYTES || quiet ? 1 : MORE;
}

/* As message_measure, for a message that what follows must confirm; when all is quiet nothing will. */
static int confirmed_measure(const uint8_t *in, size_t n, bool quiet)
{
    int length = message_measure(in, n);
    if (length == MORE && quiet)
        return NONE;
    if (length <= 0)
        return length;
    int confirmed = confirmation(in + length, n - (size_t)length, quiet);
    return confirmed > 0 ? length : confirmed;
}

/* A message that began within the last one: how many bytes of in it takes, or MORE, or NONE. */
static int lost_bytes_decode(struct codec_state *state, const uint8_t *in, size_t n, struct can_frame *frame,
                             struct codec_message *msg)
{
    uint8_t joined[CODEC_KEPT_MAX + USB2CAN_LINE_MAX];
    bool follows[CODEC_KEPT_MAX + 1] = {false}; /* a message, whole in the last one: that confirms as well */
    size_t kept = state->usb2can.kept_length;
    memcpy(joined, state->usb2can.kept, kept);
    n = min_size(n, USB2CAN_LINE_MAX);
    memcpy(joined + kept, in, n);

    for (size_t at = 1; at < kept; at++) {
        int inner = message_measure(joined + at, kept - at);
        if (inner > 0)
            follows[at + (size_t)inner] = true;
        if (inner != MORE)
            continue;
        int length = follows[at] ? message_measure(joined + at, kept + n - at)
                                 : confirmed_measure(joined + at, kept + n - at, state->quiet);
        if (length == MORE && !state->quiet)
            return MORE;
        if (length <= 0)
            continue;
        memcpy(state->usb2can.spliced, joined + at, (size_t)length);
        message_take(state, state->usb2can.spliced, (size_t)length, (size_t)length, frame, msg);
        return (int)(at + (size_t)length - kept);
    }
    return NONE;
}

/* Up to where the next message may begin. */
static size_t noise_skip(struct codec_state *state, const uint8_t *in, size_t n, struct codec_message *msg)
{
    const uint8_t *next = memchr(in + 1, START, n - 1);
    state->doubt = true;
    state->usb2can.kept_length = 0;
    return report(msg, CODEC_SKIPPED, next ? (size_t)(next - in) : n);
}

static size_t doubt_decode(struct codec_state *state, const uint8_t *in, size_t n, struct can_frame *frame,
                           struct codec_message *msg)
{
    int used = lost_bytes_decode(state, in, n, frame, msg);
    if (used != NONE)
        return (size_t)used;

    int length = message_measure(in, n);
    if (length > 0) {
        enum codec_kind kind = message_kind(in);
        if (kind == CODEC_FRAME || kind == CODEC_RETURNED)
            length = confirmed_measure(in, n, state->quiet);
    }
    if (length > 0)
        return message_take(state, in, n, (size_t)length, frame, msg);
    if (length == MORE && !state->quiet)
        return 0;
    return noise_skip(state, in, n, msg);
}

static size_t usb2can_decode(struct codec_state *state, const uint8_t *in, size_t n, struct can_frame *frame,
                             struct codec_message *msg)
{
    if (n == 0)
        return 0;
    if (!state->doubt) {
        int length = message_measure(in, n);
        if (length > 0)
            return message_take(state, in, n, (size_t)length, frame, msg);
        if (length == MORE && !state->quiet)
            return 0;
    }
    return doubt_decode(state, in, n, frame, msg);
}

static size_t usb2can_encode(const struct can_frame *frame, uint8_t *out)
{
    bool extended = frame->can_id & CAN_EFF_FLAG;
    bool remote = frame->can_id & CAN_RTR_FLAG;
    canid_t id = frame->can_id & CAN_EFF_MASK;
    size_t len = frame->len;
    if ((frame->can_id & CAN_ERR_FLAG) || len > CAN_MAX_DLEN || (!extended && id > CAN_SFF_MASK))
        return 0;

    size_t n = HEAD;
    out[n++] = (uint8_t)((extended ? INFO_FF : 0) | (remote ? INFO_RTR : 0) | (int)len);
    id = extended ? id << EFF_SHIFT : id << SFF_SHIFT;
    for (unsigned int shift = extended ? 32 : 16; shift > 0; shift -= 8)
        out[n++] = (uint8_t)(id >> (shift - 8));
    for (size_t i = 0; !remote && i < len; i++)
        out[n++] = frame->data[i];
    out[0] = START;
    out[1] = WRITE_MESSAGE;
    out[2] = (uint8_t)(n - HEAD);
    return n;
}

static size_t usb2can_length(const uint8_t *message, size_t n)
{
    return n < HEAD ? n : min_size((size_t)HEAD + message[2], n);
}

/* The answer to COMMAND GET: [128,] critical limit, ready limit, frames in the first and second buffer. */
static int usb2can_level(const uint8_t *text, size_t length)
{
    enum { LIMITS = 2, LEVELS = 2 };
    if (length < 2 || text[0] != COMMAND || text[1] != length - 2)
        return -1;
    size_t n = length - 2;
    if (n != LIMITS + LEVELS && !(n == 1 + LIMITS + LEVELS && text[2] == COMMAND_GET))
        return -1;
    return text[length - 2] + text[length - 1];
}

const struct codec codec_usb2can = {
    .name = "usb2can",
    .line_max = USB2CAN_LINE_MAX,
    .frame_max = HEAD + FRAME_BYTES_MAX,
    .confirms = CONFIRMS_LEVEL,
    .reports = true,
    .quiet_ns = 1000000000,
    .doubt_quiet_ns = 50000000,
    .decode = usb2can_decode,
    .encode = {usb2can_encode, usb2can_encode, usb2can_encode, usb2can_encode}, /* there is one way */
    .level = usb2can_level,
    .length = usb2can_length,
};
