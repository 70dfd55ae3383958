/* Streams of a USB2CAN as hex, and what the codec makes of them as text. */
#ifndef CAN_BRIDGE_USB2CAN_TEXT_H
#define CAN_BRIDGE_USB2CAN_TEXT_H

#include "check.h"
#include "codec_check.h"

enum { TEXT_MAX = 2048, BYTES_MAX = 256 };

/* ---- Transcripts as text: "123#ABCD '12 01 06' stop skip3 idle5 +2"; ^: its text began in the message before. */

struct text {
    char at[TEXT_MAX];
    size_t length;
};

__attribute__((format(printf, 2, 3))) static inline void text_add(struct text *text, const char *format, ...)
{
    size_t room = sizeof text->at - text->length;
    va_list args;

    va_start(args, format);
    int length = vsnprintf(text->at + text->length, room, format, args);
    va_end(args);
    if (length > 0)
        text->length += (size_t)length < room ? (size_t)length : room - 1;
}

/* As candump writes it: 123#ABCD, 00000123#ABCD, 123#R2, DLC above 8 as "_9". */
static inline void text_add_frame(struct text *text, const struct can_frame *frame)
{
    if (frame->can_id & CAN_EFF_FLAG)
        text_add(text, "%08X#", frame->can_id & CAN_EFF_MASK);
    else
        text_add(text, "%03X#", frame->can_id & CAN_EFF_MASK);
    if (frame->can_id & CAN_RTR_FLAG)
        text_add(text, "R%u", frame->len);
    else
        for (size_t i = 0; i < frame->len && i < CAN_MAX_DLEN; i++)
            text_add(text, "%02X", frame->data[i]);
    if (frame->len8_dlc)
        text_add(text, "_%X", frame->len8_dlc);
}

static inline void text_add_entry(struct text *text, const struct entry *entry, const uint8_t *bytes)
{
    switch (entry->kind) {
    case CODEC_RETURNED:
        text_add(text, "returned:");
        text_add_frame(text, &entry->frame);
        break;
    case CODEC_FRAME:
        text_add_frame(text, &entry->frame);
        break;
    case CODEC_TEXT:
        text_add(text, entry->text_start < entry->start ? "^'" : "'");
        for (size_t i = 0; i < entry->text_length; i++)
            text_add(text, i ? " %02X" : "%02X", bytes[entry->text_start + i]);
        text_add(text, "'");
        break;
    case CODEC_IDLE:
        text_add(text, "idle%zu", entry->length);
        break;
    case CODEC_SKIPPED:
        text_add(text, "skip%zu", entry->length);
        break;
    case CODEC_STOP:
        text_add(text, "stop");
        break;
    case CODEC_GO:
        text_add(text, "go");
        break;
    case CODEC_OVERRUN:
        text_add(text, "overrun");
        break;
    default:
        text_add(text, "?%d", (int)entry->kind);
    }
}

static inline void text_from_transcript(struct text *text, const struct transcript *transcript, const uint8_t *bytes)
{
    text->length = 0;
    text->at[0] = '\0';
    for (size_t i = 0; i < transcript->count; i++) {
        if (i)
            text_add(text, " ");
        text_add_entry(text, &transcript->entries[i], bytes);
    }
    if (transcript->pending)
        text_add(text, "%s+%zu", transcript->count ? " " : "", transcript->pending);
}

/* "0F41 05" as bytes; returns how many. */
static inline size_t hex_read(const char *hex, uint8_t *bytes)
{
    static const char digits[] = "0123456789ABCDEF";
    size_t n = 0;

    for (; *hex; hex++) {
        if (*hex == ' ')
            continue;
        const char *high = strchr(digits, hex[0]), *low = strchr(digits, hex[1]);
        if (!high || !low || n == BYTES_MAX)
            abort();
        bytes[n++] = (uint8_t)((high - digits) << 4 | (low - digits));
        hex++;
    }
    return n;
}

#endif
