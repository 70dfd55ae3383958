/* The way to the device: bytes that the port has not taken yet, and what was sent and is not answered yet.
 *
 * The device answers in the order of its commands. So an answer belongs to the oldest in flight, and a text that
 * answers a later one proves that the answers before it were lost. When an answer is missing, the line is
 * resynchronised: nothing more is sent until the device has answered the sync command, whose answer cannot be taken
 * for any other. What came before that answer belongs to the past. */
#ifndef CAN_BRIDGE_LINE_H
#define CAN_BRIDGE_LINE_H

#include "codec.h"
#include "events.h"
#include "queue.h"

enum {
    INFLIGHT_MAX = 64, /* ring: WINDOW_MAX and the sync command behind them */
    OUT_BUFFER = 4096, /* bytes encoded and not taken by the port yet */
};

enum inflight_kind {
    INFLIGHT_FRAME,
    INFLIGHT_COMMAND,
    INFLIGHT_POLL,
    INFLIGHT_LEVEL, /* the level window's question */
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

struct line {
    struct counters *counters;
    struct events *events;
    const struct codec *codec;
    struct command sync;
    int64_t answer_timeout_ns;
    size_t (*encode)(const struct can_frame *frame, uint8_t *out);
    uint32_t window, usual_window;
    uint32_t frames_max; /* of `window`; with `overtaking` a command has a place besides */
    bool overtaking;    /* a frame is answered when it is on the bus; commands are answered at once, before it */
    bool answered;      /* a frame is in flight until the device answers it */
    bool unconfirmed;   /* the device never tells of a frame */
    uint32_t unwritten; /* with `unconfirmed`: frames in `out` */
    uint8_t out[OUT_BUFFER];
    size_t out_start, out_end;
    int64_t out_until_ns; /* what is in `out` must be gone by then */
    struct inflight inflight[INFLIGHT_MAX];
    uint32_t inflight_head, inflight_count;
    bool resyncing;
    bool silent; /* the device answered no sync command: nothing is sent until the next attach */
    uint32_t sync_tries;
};

void line_init(struct line *l, const struct settings *set, struct counters *counters, struct events *events);
void line_set(struct line *l, const struct sending_settings *set);
void line_reset(struct line *l);
void line_forget(struct line *l);
struct cut line_cut(const struct line *l);
void line_resume(struct line *l, const struct cut *cut);
bool line_say(struct line *l, const uint8_t *words, size_t length);

void line_send_command(struct line *l, const struct command *c, enum inflight_kind kind, int64_t now);
bool line_send_frame(struct line *l, const struct tx_frame *tx, int64_t deadline_ns, int64_t now);
bool line_can_say(const struct line *l, const struct can_frame *frame);
int line_flush(struct line *l, int port);
void line_finish(struct line *l, int64_t now);

struct inflight line_take(struct line *l);
void line_bring_forward(struct line *l, uint32_t i);
uint32_t line_find_frame(const struct line *l);
uint32_t line_find(struct line *l, const struct codec_message *text);
void line_set_sync(struct line *l, const struct command *sync);
int line_resync(struct line *l, int64_t now);
int line_sync_again(struct line *l, int64_t now);
void line_synced(struct line *l);
void line_fall_silent(struct line *l);
int64_t line_deadline(const struct line *l);

/* The i-th oldest in flight. */
static inline const struct inflight *line_at(const struct line *l, uint32_t i)
{
    return &l->inflight[(l->inflight_head + i) % INFLIGHT_MAX];
}

/* Grows with everything from the device that was no message, or one that nobody waits for. */
static inline uint64_t line_noise(const struct line *l)
{
    return l->counters->skipped_bytes + l->counters->stray_answers;
}

/* Whether the port has not taken all of `out`. */
static inline bool line_waits_for_port(const struct line *l)
{
    return l->out_start < l->out_end;
}

/* Whether one more command or frame fits into `out`. */
static inline bool line_has_room(const struct line *l)
{
    return l->out_end + COMMAND_SIZE <= OUT_BUFFER;
}

/* Whether another answer may be waited for. */
static inline bool line_window_open(const struct line *l)
{
    return !l->resyncing && l->inflight_count < l->window;
}

#endif
