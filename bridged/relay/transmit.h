/* Decides which command, poll or frame goes to the device next, and hands each answer to whom it concerns. */
#ifndef CAN_BRIDGE_TRANSMIT_H
#define CAN_BRIDGE_TRANSMIT_H

#include "ack_window.h"
#include "level_window.h"
#include "pace.h"

enum { COMMANDS_MAX = 32 }; /* ring: commands from Python that wait for their turn */

struct transmit {
    struct counters *counters;
    struct events *events;
    struct queue *queue;
    struct line *line;
    struct ack_window *ack;     /* both are there; frames use the one that codec->confirms says */
    struct level_window *level;
    struct pace *pace;
    bool answers_each; /* CONFIRMS_EACH */
    struct command commands[COMMANDS_MAX];
    uint32_t command_head, command_count;
    struct command poll; /* length 0: the device speaks by itself */
    int64_t poll_interval_ns, poll_at_ns;
    uint64_t poll_decoded; /* counters.decoded when the last poll was sent */
    bool polling;          /* one is in flight */
    bool polled;           /* since the last frame: a frame goes before the next poll */
    int64_t stuck_told_ns; /* EVENT_STUCK of a device that answers a frame when it is on the bus; 0: not yet */
    bool late_answer_possible; /* a command timed out; resync before sending the first frame */
};

void transmit_init(struct transmit *t, struct queue *queue, struct line *line, struct ack_window *ack,
                   struct level_window *level, struct pace *pace);
void transmit_reset(struct transmit *t);
void transmit_forget(struct transmit *t);
bool transmit_command(struct transmit *t, const struct command *command);
void transmit_set_sending(struct transmit *t, const struct sending_settings *set);
void transmit_poll(struct transmit *t, const struct command *poll, int64_t interval_ns);
int transmit_last_words(struct transmit *t, int port, const uint8_t *words, size_t length);
void transmit_answer(struct transmit *t, const struct codec_message *msg, const struct can_frame *frame, int64_t now);
bool transmit_idle(const struct transmit *t);
int transmit_pump(struct transmit *t, int port, bool receiving, int64_t now);
int64_t transmit_deadline(const struct transmit *t, bool receiving);
uint32_t transmit_queued(const struct transmit *t);

#endif
