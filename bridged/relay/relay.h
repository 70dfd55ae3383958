/* The relay: moves frames between a port (bytes) and a bus (struct can_frame), with full accounting.
 *
 * One thread runs relay_run(). Everything in struct relay is guarded by `lock`, which that thread
 * holds all the time except while it waits. So any other thread that takes the lock sees
 * the relay between two turns: the counters of a snapshot add up. Each takes it by relay_lock(), in turn.
 *
 *   frames read from the bus = confirmed + dropped (by reason) + queued
 *   frames decoded from the port = put on the bus + dropped (by reason) + pending
 */
#ifndef CAN_BRIDGE_RELAY_H
#define CAN_BRIDGE_RELAY_H

#include <assert.h>
#include <pthread.h>
#include <sys/socket.h>

#include "codec.h"
#include "counters.h"

#define NS_PER_S INT64_C(1000000000)
#define NEVER INT64_MAX

enum {
    BUS_BATCH = 64,       /* frames per recvmmsg */
    RX_BATCH = 256,       /* frames per sendmmsg, and how many may wait for a full bus queue */
    QUEUE_MAX = 65536,    /* frames that wait for the device, as configured */
    WINDOW_MAX = 32,      /* frames and commands unanswered, as configured */
    INFLIGHT_MAX = 64,    /* ring: WINDOW_MAX and the sync command behind them */
    RETRY_MAX = 64,       /* ring: refused frames wait here; never more than were in flight */
    COMMANDS_MAX = 32,    /* ring: commands from Python that wait for their turn */
    COMMAND_SIZE = 64,    /* bytes of one command, and of one frame as it is sent */
    PREFIX_MAX = 4,       /* bytes by which a text is known to be a command's answer */
    EVENTS_MAX = 256,     /* ring: events that Python has not fetched yet */
    EVENTS_NEWS = 128,    /* of these for what nobody waits for; the rest is for answers and losses */
    EVENT_SIZE = 256,     /* bytes of text in one event */
    PORT_BUFFER = 65536,  /* bytes read from the port and not decoded yet */
    OUT_BUFFER = 4096,    /* bytes encoded and not taken by the port yet */
    SYNC_TRIES = 3,       /* unanswered sync commands until the adapter counts as silent */
};

static_assert((int)CODEC_FRAME_MAX <= (int)COMMAND_SIZE, "the room for a command is room for a frame");
static_assert((int)CODEC_LINE_MAX <= (int)PORT_BUFFER, "a message waits in `in` until all of it is there");

/* What happens to frames read from the bus. */
enum gate { GATE_AWAY, GATE_OPEN, GATE_LISTEN_ONLY, GATE_STOPPED, GATES };

/* Answers that settle a command; a text settles it when it begins with the command's prefix, if it has one. */
enum { ACCEPT_OK = 1, ACCEPT_REFUSED = 2 };

struct tx_frame {
    struct can_frame frame;
    int64_t born_ns; /* when the kernel received it, on the relay's clock */
    uint64_t number; /* order on the bus */
};

struct command {
    uint32_t token;
    uint8_t accept; /* ACCEPT_… */
    uint8_t prefix_length;
    uint8_t length;
    uint8_t prefix[PREFIX_MAX];
    int64_t timeout_ns;
    uint8_t data[COMMAND_SIZE];
};

enum inflight_kind {
    INFLIGHT_FRAME,
    INFLIGHT_COMMAND,
    INFLIGHT_POLL,
    INFLIGHT_LEVEL, /* flow.ask */
    INFLIGHT_CHECK, /* the sync command after a refusal: was it one? */
    INFLIGHT_SYNC,  /* the same after a missing answer */
};

struct inflight {
    enum inflight_kind kind;
    uint8_t accept;
    uint8_t prefix_length;
    uint8_t prefix[PREFIX_MAX];
    uint32_t token;
    int64_t deadline_ns; /* of the answer */
    uint64_t noise;      /* line_noise() when it was sent */
    struct tx_frame tx;
};

struct event {
    uint8_t kind;
    uint16_t length;
    uint32_t token;
    uint8_t text[EVENT_SIZE];
};

/* Both clocks at one time: the relay's own, that of the kernel's time stamps. */
struct moment {
    int64_t boot_ns, wall_ns;
};

struct settings {
    const struct codec *codec;
    uint32_t queue;
    uint32_t window;
    int64_t deadline_ns;       /* a frame older than this is not sent */
    int64_t answer_timeout_ns; /* of a frame, a poll, a sync command */
    struct command sync;       /* a command with an answer that nothing else gives */
};

/* Window of a device that does not answer frames (flow.c). */
struct flow {
    struct command ask; /* answered once all frames before it are taken or handed back; length 0: nothing goes */
    uint32_t capacity, critical, ready; /* frames in the device's buffer: fit surely, stop above, go below */
    struct tx_frame sent[WINDOW_MAX]; /* ring: not known to be taken yet */
    uint32_t sent_head, sent_count;
    uint32_t asked;        /* how many of them the question in flight covers */
    int64_t asked_ns;      /* when it was put */
    uint32_t room;         /* frames that fit surely */
    uint32_t level;        /* frames in the device's buffer when it said so last; 0: not known */
    int64_t left_at_ns;    /* when one was seen to have left it last */
    uint32_t limit;        /* of sent_count: 1 after frames came back, doubled until it is the window again */
    uint64_t noise;        /* counters.skipped_bytes when `sent` was empty or a question answered last */
    uint32_t doubted;      /* the oldest of `sent`: noise since may have been one handed back */
    bool asking, stopped;
    bool settling;         /* frames came back: none goes before the fate of the others is known */
    int64_t stopped_ns;    /* since when */
    int64_t ask_at_ns, ask_delay_ns; /* while nothing can go */
};

/* The message of which the port took only so many bytes before it was detached; length 0: none. */
struct cut {
    size_t taken, length;
    uint8_t message[COMMAND_SIZE];
};

struct relay {
    pthread_mutex_t turnstile; /* held while waiting for `lock` */
    pthread_mutex_t lock;      /* guards all below */
    struct settings set;
    bool stop, running;
    int wake_fd;  /* eventfd: another thread changed something */
    int event_fd; /* eventfd: events to fetch */
    int epoll_fd; /* waits for wake_fd, port and bus */
    int port, bus; /* our own, -1: none */
    bool port_full; /* epoll_fd waits for room in the port, too */
    uint32_t attachments; /* counts attach and detach: results of a wait before one are void */
    enum gate gate;
    bool receiving;
    bool bus_held; /* the bus is not read */

    /* bus -> device (queue.c, transmit.c) */
    struct tx_frame *queue; /* ring of set.queue */
    uint32_t queue_head, queue_count;
    uint64_t next_number;
    struct tx_frame retry[RETRY_MAX];
    uint32_t retry_head, retry_count;
    int64_t retry_at_ns, retry_delay_ns;
    int64_t refused_ns; /* since when the device takes no frame; NEVER: it does */
    struct inflight inflight[INFLIGHT_MAX];
    uint32_t inflight_head, inflight_count;
    struct command commands[COMMANDS_MAX];
    uint32_t command_head, command_count;
    struct command poll; /* length 0: the device speaks by itself */
    int64_t poll_interval_ns, poll_at_ns;
    uint64_t poll_decoded; /* counters.decoded when the last poll was sent */
    bool polling, polled, resyncing, silent;
    bool checking; /* a refusal is not believed yet: INFLIGHT_CHECK is to be sent, or its answer to come */
    uint64_t check_noise; /* line_noise() at the refusal that is being checked */
    bool doubtful; /* an answer may come late: settled before the first frame goes */
    uint32_t sync_tries;
    struct flow flow;
    uint8_t out[OUT_BUFFER];
    size_t out_start, out_end;
    int64_t out_until_ns; /* what is in `out` is too old then */
    bool unread;          /* the device may not have read all frames: its answer to what came after them is missing */

    /* device -> bus (relay.c) */
    struct codec_state decoder;
    int64_t quiet_at_ns; /* what is in `in` has waited long enough then */
    bool stamp_seen;
    uint8_t in[PORT_BUFFER];
    size_t in_length;
    struct can_frame rx[RX_BATCH];
    struct iovec rx_iov[RX_BATCH];
    struct mmsghdr rx_msg[RX_BATCH];
    uint32_t rx_count;
    int64_t rx_stalled_ns, rx_retry_ns; /* NEVER: the bus takes frames */

    struct bus_message {
        union {
            struct can_frame classic;
            struct canfd_frame fd;
        } frame;
        union {
            struct cmsghdr align;
            uint8_t bytes[128];
        } control;
    } bus_message[BUS_BATCH];
    struct iovec bus_iov[BUS_BATCH];
    struct mmsghdr bus_msg[BUS_BATCH];
    struct moment empty; /* no frame from before it is in the bus's socket any more; boot_ns 0: not known */

    struct event events[EVENTS_MAX];
    uint32_t event_head, event_count;
    struct counters count;
};

/* relay.c */
struct relay *relay_new(const struct settings *set); /* NULL with errno */
void relay_free(struct relay *r);
int64_t relay_clock(void);
void relay_lock(struct relay *r);
void relay_unlock(struct relay *r);
int relay_run(struct relay *r);                    /* takes the lock; -> 0 or errno */
int64_t relay_turn(struct relay *r, struct moment at); /* lock held; -> next deadline */
void relay_wake(struct relay *r);
int relay_attach_port(struct relay *r, int fd); /* a duplicate; -> 0 or errno */
void relay_detach_port(struct relay *r);
int relay_attach_bus(struct relay *r, int fd); /* the same */
void relay_detach_bus(struct relay *r);
void relay_hold_bus(struct relay *r, bool held);
void relay_emit(struct relay *r, enum event_kind kind, uint32_t token, const uint8_t *text, size_t length);
void relay_port_lost(struct relay *r, int error);

/* queue.c: all with the lock held */
void queue_add(struct relay *r, const struct can_frame *frame, int64_t born_ns, int64_t now);
void queue_drop(struct relay *r, enum tx_drop reason);
void queue_expire(struct relay *r, int64_t now);
int64_t queue_expires_ns(struct relay *r);
void queue_set_gate(struct relay *r, enum gate gate);
int queue_resize(struct relay *r, uint32_t size); /* -> 0 or ENOMEM */
bool queue_waiting(const struct relay *r);
int64_t stuck_ns(const struct relay *r);
struct tx_frame queue_pop(struct relay *r);
void queue_retry(struct relay *r, const struct tx_frame *tx);
void queue_overtake(struct relay *r, const struct tx_frame *taken);
const struct tx_frame *retry_first(struct relay *r);
struct tx_frame retry_pop(struct relay *r);

/* transmit.c: all with the lock held */
void transmit_reset(struct relay *r);
struct cut transmit_cut(const struct relay *r);
void transmit_resume(struct relay *r, const struct cut *cut);
void transmit_forget(struct relay *r);
void transmit_last_words(struct relay *r, const uint8_t *words, size_t length);
bool transmit_command(struct relay *r, const struct command *command);
bool transmit_idle(const struct relay *r);
void transmit_pump(struct relay *r, int64_t now);
int64_t transmit_deadline(struct relay *r);
uint32_t transmit_queued(const struct relay *r);
void transmit_answer(struct relay *r, const struct codec_message *msg, const struct can_frame *frame, int64_t now);

/* flow.c: all with the lock held */
bool flow_used(const struct relay *r);
void flow_start(struct relay *r, const struct flow *set);
void flow_reset(struct relay *r);
bool flow_ready(const struct relay *r);
bool flow_ask_due(const struct relay *r, bool more, int64_t now);
void flow_asked(struct relay *r, int64_t now);
void flow_sent(struct relay *r, const struct tx_frame *tx);
void flow_answered(struct relay *r, const struct codec_message *msg, int64_t now);
void flow_unanswered(struct relay *r);
void flow_message(struct relay *r, enum codec_kind kind, const struct can_frame *frame, int64_t now);
int64_t flow_deadline(const struct relay *r);

#endif
