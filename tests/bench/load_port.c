/* The port's side of the load: frames and answers as a CAN232, a USB2CAN, or a CAN232's host speaks. */
#include "load.h"

#include <errno.h>
#include <string.h>
#include <unistd.h>

enum {
    START = 0x0F, HEAD = 3, LENGTH_MAX = 16,
    CONFIG_MODE = 2, NORMAL_MODE = 3, GET_MODE = 6, READ_REG = 16, WRITE_REG = 18, COMMAND = 32, FW_VERSION = 33,
    WRITE_MESSAGE = 64, READ_MESSAGE = 65, READ_TEC = 96, READ_REC = 97, READ_RST = 98,
    CONFIG = 1, NORMAL = 2,
    CMD_CRITICAL = 0, CMD_READY = 1, CMD_GET = 128,
    STANDARD_8 = 8, /* frame information: standard, DLC 8 */
    ID_HIGH = 0x24, ID_LOW = 0x60, /* 123, left-aligned */
};

static const char DIGITS[] = "0123456789ABCDEF";

static void out_put(struct channel *ch, const void *data, size_t n)
{
    if (ch->out_end + n > OUT_SIZE)
        fail("nobody reads the port");
    memcpy(ch->out + ch->out_end, data, n);
    ch->out_end += n;
}

/* EAGAIN: when poll says so. */
void port_flush(struct channel *ch)
{
    while (ch->out_start < ch->out_end) {
        ssize_t n = write(ch->port, ch->out + ch->out_start, ch->out_end - ch->out_start);
        if (n < 0 && errno == EINTR)
            continue;
        if (n < 0 && errno != EAGAIN)
            fail("writing to the port");
        if (n <= 0)
            break;
        ch->out_start += (size_t)n;
    }
    ch->out_end -= ch->out_start;
    memmove(ch->out, ch->out + ch->out_start, ch->out_end);
    ch->out_start = 0;
}

/* A received frame, as the adapter tells its host: "t1238…\r", or 0F 41 0B 08 24 60 …. */
void port_put_frame(struct channel *ch, const uint8_t data[8])
{
    if (ch->set->protocol == USB2CAN) {
        uint8_t message[14] = {START, READ_MESSAGE, 11, STANDARD_8, ID_HIGH, ID_LOW};
        memcpy(message + 6, data, 8);
        out_put(ch, message, sizeof message);
        return;
    }
    char line[22] = "t1238";
    for (int i = 0; i < 8; i++) {
        line[5 + 2 * i] = DIGITS[data[i] >> 4];
        line[6 + 2 * i] = DIGITS[data[i] & 15];
    }
    line[21] = '\r';
    out_put(ch, line, sizeof line);
}

static int digit(uint8_t c)
{
    return c >= 'a' ? c - 'a' + 10 : c >= 'A' ? c - 'A' + 10 : c - '0';
}

static void answer(struct channel *ch, const char *text)
{
    if (ch->set->protocol == CAN232)
        out_put(ch, text, strlen(text));
}

/* One line without its CR. */
static void line_receive(struct channel *ch, const uint8_t *line, size_t n)
{
    if (n == 21 && line[0] == 't') {
        uint8_t data[8];
        for (int i = 0; i < 8; i++)
            data[i] = (uint8_t)(digit(line[5 + 2 * i]) << 4 | digit(line[6 + 2 * i]));
        frame_arrived(ch, data);
        answer(ch, "z\r");
        return;
    }
    if (ch->set->protocol == HOST) /* the answer to a frame */
        return;
    ch->commands += n > 0;
    if (n && line[0] == 'V')
        answer(ch, "V1324\r");
    else if (n && line[0] == 'N')
        answer(ch, "NA123\r");
    else if (n && line[0] == 'F')
        answer(ch, "F00\r");
    else if (n && line[0] == 'A') /* it sends by itself */
        answer(ch, "\a");
    else
        answer(ch, "\r");
}

/* How many bytes the first line takes, 0: not all of it is there. */
static size_t can232_receive(struct channel *ch, const uint8_t *in, size_t n)
{
    if (in[0] == '\a') {
        ch->refusals++;
        return 1;
    }
    const uint8_t *end = memchr(in, '\r', n);
    if (!end)
        return 0;
    line_receive(ch, in, (size_t)(end - in));
    return (size_t)(end - in) + 1;
}

static void reply(struct channel *ch, uint8_t command, const void *data, size_t n)
{
    uint8_t message[HEAD + LENGTH_MAX] = {START, command, (uint8_t)n};
    memcpy(message + HEAD, data, n);
    out_put(ch, message, HEAD + n);
}

/* A device whose buffer is always empty; what it was told is in `ch`. */
static void command_receive(struct channel *ch, uint8_t command, const uint8_t *data)
{
    ch->commands++;
    switch (command) {
    case CONFIG_MODE:
    case NORMAL_MODE:
        ch->configuring = command == CONFIG_MODE;
        break;
    case GET_MODE:
        reply(ch, command, &(uint8_t){ch->configuring ? CONFIG : NORMAL}, 1);
        break;
    case WRITE_REG:
        reply(ch, command, data, 1);
        break;
    case READ_REG:
        reply(ch, command, (uint8_t[]){data[0], 0}, 2);
        break;
    case COMMAND:
        if (data[0] == CMD_GET)
            reply(ch, command, (uint8_t[]){CMD_GET, 15, 7, 0, 0}, 5); /* the bridge's own limits; empty */
        break;
    case FW_VERSION:
        reply(ch, command, "HW0100FW4100", 12);
        break;
    case READ_TEC:
    case READ_REC:
        reply(ch, command, "", 1);
        break;
    case READ_RST:
        reply(ch, command, "\0", 2);
        break;
    default:
        break;
    }
}

static size_t usb2can_receive(struct channel *ch, const uint8_t *in, size_t n)
{
    if (in[0] != START)
        fail("no message where one should begin");
    if (n < HEAD || n < HEAD + (size_t)in[2])
        return 0;
    if (in[1] == WRITE_MESSAGE && in[2] == 11)
        frame_arrived(ch, in + 6);
    else
        command_receive(ch, in[1], in + HEAD);
    return HEAD + (size_t)in[2];
}

/* What the subject says: frames, commands, answers. */
void port_receive(struct channel *ch)
{
    ssize_t n = read(ch->port, ch->in + ch->in_length, IN_SIZE - ch->in_length);
    if (n <= 0) {
        if (n < 0 && (errno == EAGAIN || errno == EINTR))
            return;
        fail("reading from the port");
    }
    ch->in_length += (size_t)n;
    size_t at = 0, used = 1;
    while (at < ch->in_length && used) {
        used = ch->set->protocol == USB2CAN ? usb2can_receive(ch, ch->in + at, ch->in_length - at)
                                            : can232_receive(ch, ch->in + at, ch->in_length - at);
        at += used;
    }
    ch->in_length -= at;
    memmove(ch->in, ch->in + at, ch->in_length);
    port_flush(ch);
}
