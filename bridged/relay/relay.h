/* The relay: moves frames between a port (bytes) and an interface (struct can_frame), with full accounting.
 *
 * One thread runs relay_run(); any other may call the functions below meanwhile. Each sees the relay between two
 * turns of the loop, so that the counters of a snapshot add up:
 *
 *   frames read from the interface = confirmed + buffered + unconfirmed + dropped (by reason) + queued
 *   frames decoded from the port = put on the interface + dropped (by reason) + pending
 *
 * Each part of the relay has its own files and owns its struct; their includes go one way:
 *   counters.h, events <- queue <- line <- ack_window, level_window <- transmit <- receive <- relay
 *                         queue <- intake <- relay
 *                         pace <- transmit */
#ifndef CAN_BRIDGE_RELAY_H
#define CAN_BRIDGE_RELAY_H

#include "codec.h"
#include "counters.h"
#include "values.h"

struct relay;

/* Queued: read from the interface, and nobody knows yet what becomes of them. Pending: decoded, and not on the
 * interface yet. */
struct snapshot {
    struct counters counters;
    uint32_t queued, pending;
};

struct relay *relay_new(const struct settings *set); /* NULL with errno */
void relay_free(struct relay *r);
int relay_run(struct relay *r); /* -> 0 after relay_stop(), or errno */
void relay_stop(struct relay *r);
void relay_wake(struct relay *r);
int64_t relay_turn(struct relay *r, struct moment at); /* -> when the next is due */

int relay_attach_port(struct relay *r, int fd); /* a duplicate; -> 0, or errno with none attached */
void relay_detach_port(struct relay *r);
struct cut relay_cut(struct relay *r);
void relay_resume(struct relay *r, const struct cut *cut);
void relay_last_words(struct relay *r, const uint8_t *words, size_t length);

int relay_attach_interface(struct relay *r, int fd); /* the same */
void relay_detach_interface(struct relay *r);
void relay_hold_interface(struct relay *r, bool held);

void relay_set_gates(struct relay *r, bool receiving, enum gate gate);
int relay_set_queue(struct relay *r, const struct queue_settings *set); /* -> 0 or ENOMEM */
void relay_set_sync(struct relay *r, const struct command *sync);
void relay_set_polling(struct relay *r, const struct command *poll, int64_t interval_ns);
void relay_set_sending(struct relay *r, const struct sending_settings *set);
void relay_count_late(struct relay *r, uint32_t kept);
void relay_set_level_window(struct relay *r, const struct level_settings *set);
void relay_command(struct relay *r, const struct command *command, bool more);

int relay_event_fd(const struct relay *r); /* an eventfd, readable when there are events */
uint32_t relay_take_events(struct relay *r, struct event *batch, uint32_t room); /* -> how many */
void relay_snapshot(struct relay *r, struct snapshot *out);
void relay_glimpse(struct relay *r, struct can_frame *from_interface, struct can_frame *to_interface);

#endif
