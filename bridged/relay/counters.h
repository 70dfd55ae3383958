/* The lists of the relay's counters, of its reasons to drop a frame, and of its events for Python.
 *
 * A new one is a line in one of these lists: X(NAME, "its name in Python", "what it means").
 * The enumerators, the struct, Python's constants and the keys of counters() come from them. Tests hold the stub
 * (_relay.pyi) against the events, and README.md (What the counters mean) against the reasons why a frame was not
 * sent. What drops a frame calls queue_drop() or receive_drop(). */
#ifndef CAN_BRIDGE_COUNTERS_H
#define CAN_BRIDGE_COUNTERS_H

#include <stdint.h>

/* Why a frame from the interface was not sent. */
#define TX_DROP_LIST(X) \
    X(TX_ERROR_FRAME, "error-frame", "error frames are the bus's own affair") \
    X(TX_FD_FRAME, "fd-frame", "the adapter knows classic CAN only") \
    X(TX_MALFORMED, "malformed", "no struct can_frame, or one the protocol cannot say") \
    X(TX_REMOTE, "remote-frame", "a remote frame of a kind that this firmware cannot send") \
    X(TX_QUEUE_FULL, "queue-full", "the transmit queue was full") \
    X(TX_STALE, "stale", "older than the deadline before its turn came") \
    X(TX_REFUSED, "refused", "the adapter refused it, or handed it back, until its deadline") \
    X(TX_OVERTAKEN, "overtaken", "refused, and a later frame was taken: sending it now would swap them") \
    X(TX_UNANSWERED, "unanswered", "sent, but no answer came: it may be on the bus, so it is not sent again") \
    X(TX_AWAY, "adapter-away", "no adapter, or not initialised") \
    X(TX_LISTEN_ONLY, "listen-only", "the channel is listen-only") \
    X(TX_STOPPED, "stopped", "the bridge is stopping")

/* Why a frame from the adapter did not reach the interface. */
#define RX_DROP_LIST(X) \
    X(RX_NOT_RUNNING, "not-running", "decoded while the adapter was being initialised or closed") \
    X(RX_INTERFACE_FULL, "bus-queue-full", "the interface had no room for 0.1 s, or more than 256 frames waited") \
    X(RX_INTERFACE_DOWN, "bus-down", "the interface is down (ENETDOWN)") \
    X(RX_INTERFACE_LOST, "bus-lost", "the interface is gone, or none is attached")

/* What a device says by its answer to a frame, and the counter for that. */
#define ANSWER_LIST(X) \
    X(ANSWER_TAKEN, "taken", confirmed) /* it is in a buffer which is emptied when the channel is closed */ \
    X(ANSWER_SENT, "sent", confirmed) /* it is on the bus */ \
    X(ANSWER_QUEUED, "queued", buffered) /* it is in a buffer */ \
    X(ANSWER_ALWAYS, "always", unconfirmed) /* nothing: the device answers also where the frame is lost */ \
    X(ANSWER_NONE, "nothing", unconfirmed) /* the device answers no frame */

/* The kinds of event that events() returns. The name in Python is that of the enumerator. */
#define EVENT_LIST(X) \
    X(EVENT_OK, "a command was answered \"done\"") \
    X(EVENT_REFUSED, "a command was refused") \
    X(EVENT_TEXT, "a command was answered with a text") \
    X(EVENT_TIMEOUT, "a command was not answered in time, or the port went away before") \
    X(EVENT_UNASKED, "a text that no command asked for") \
    X(EVENT_NOISE, "bytes that are no message, before frames are received") \
    X(EVENT_FRAME_REFUSED, "the adapter refused a frame; token: how many retries so far. Not at each") \
    X(EVENT_UNANSWERED, "an answer is missing: the line is being resynchronised") \
    X(EVENT_SILENT, "not even the sync command is answered; nothing is sent until a new attach") \
    X(EVENT_STUCK, "no frame has left the device for `stuck`; token: how many are in it, 0: not known") \
    X(EVENT_STAMPED, "a frame had a time stamp; said once per attach") \
    X(EVENT_PORT_LOST, "token: errno, 0 for end of file") \
    X(EVENT_INTERFACE_DOWN, "the interface is down") \
    X(EVENT_INTERFACE_LOST, "token: errno, 0 for end of file")

/* Each is a field of struct counters. */
#define COUNTER_LIST(X) \
    X(interface_read, "bus_read", "frames read from the interface") \
    X(confirmed, "tx_frames", "frames that the adapter put on its bus, or into a buffer that closing empties") \
    X(buffered, "tx_queued", "frames that are in the adapter's buffer, or were: it does not tell") \
    X(unconfirmed, "tx_unconfirmed", "frames given to an adapter that says nothing of what became of them") \
    X(late, "tx_late", "of these, frames that may leave late: from a stuck buffer that closing does not empty") \
    X(retries, "tx_retries", "frames sent once more after a refusal") \
    X(returned, "tx_returned", "frames that the adapter handed back") \
    X(stops, "tx_stops", "how often the adapter said that its transmit buffer is nearly full") \
    X(decoded, "decoded", "frames decoded from the port") \
    X(delivered, "rx_frames", "frames put on the interface") \
    X(overruns, "rx_overruns", "how often the adapter said that it lost frames") \
    X(stamped, "rx_stamped", "frames that carried a time stamp") \
    X(skipped_messages, "skipped_messages", "pieces of noise between messages") \
    X(skipped_bytes, "skipped_bytes", "bytes of noise") \
    X(stray_answers, "stray_answers", "answers that nothing was waiting for") \
    X(resyncs, "resyncs", "how often the line was resynchronised after a missing answer") \
    X(events_lost, "events_lost", "events that Python fetched too late") \
    X(turns, "turns", "how often the loop woke")

#define LIST_NAME(name, ...) name,
#define LIST_FIELD(name, ...) uint64_t name;

enum tx_drop { TX_DROP_LIST(LIST_NAME) TX_DROPS };
enum rx_drop { RX_DROP_LIST(LIST_NAME) RX_DROPS };
enum event_kind { EVENT_LIST(LIST_NAME) EVENT_KINDS };
enum answer { ANSWER_LIST(LIST_NAME) ANSWERS };

struct counters {
    COUNTER_LIST(LIST_FIELD)
    uint64_t tx_dropped[TX_DROPS];
    uint64_t rx_dropped[RX_DROPS];
};

#endif
