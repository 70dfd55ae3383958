/* The window of a device that does not answer frames, but says "stop" and "go", hands back frames that it has no
 * room for, and tells on a question how full its buffer is. */
#ifndef CAN_BRIDGE_LEVEL_WINDOW_H
#define CAN_BRIDGE_LEVEL_WINDOW_H

#include "line.h"
#include "queue.h"

struct level_window {
    struct queue *queue;
    struct line *line;
    struct counters *counters;
    struct level_settings set;
    struct tx_frame sent[WINDOW_MAX]; /* ring: not known to be taken yet */
    uint32_t sent_head, sent_count;
    uint32_t asked;     /* how many of them the question in flight covers */
    int64_t asked_ns;   /* when the question was put */
    uint32_t room;      /* frames that fit surely */
    uint32_t level;     /* frames in the device's buffer when it said so last; 0: not known */
    int64_t left_at_ns; /* when one was seen to have left it last */
    uint32_t limit;     /* of sent_count: 1 after frames came back, doubled until it is the window again */
    uint64_t noise;     /* counters.skipped_bytes when `sent` was empty or a question answered last */
    uint32_t unsure;    /* how many of the oldest sent frames may have been returned inside bytes lost to noise */
    bool asking;        /* the question is in flight */
    bool stopped;
    bool settling;      /* frames came back: none goes before the fate of the others is known */
    bool unread;        /* the device may not have read all frames; kept when the port is detached */
    int64_t stopped_ns; /* since when */
    int64_t ask_at_ns, ask_delay_ns; /* while no frame can go */
};

void level_window_init(struct level_window *w, struct queue *queue, struct line *line);
void level_window_start(struct level_window *w, const struct level_settings *set);
void level_window_reset(struct level_window *w);
void level_window_forget(struct level_window *w);
bool level_window_ask_due(const struct level_window *w, bool more, int64_t now);
void level_window_ask(struct level_window *w, int64_t now);
void level_window_sent(struct level_window *w, const struct tx_frame *tx);
void level_window_answered(struct level_window *w, const struct codec_message *msg, int64_t now);
void level_window_unanswered(struct level_window *w);
void level_window_message(struct level_window *w, enum codec_kind kind, const struct can_frame *frame, int64_t now);
int64_t level_window_deadline(const struct level_window *w);

/* Whether a frame may go now. */
static inline bool level_window_open(const struct level_window *w)
{
    return w->set.ask.length && !w->stopped && !w->settling && w->room && w->sent_count < w->limit;
}

#endif
