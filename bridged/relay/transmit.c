/* Decides which command, poll or frame goes to the device next, and hands each answer to whom it concerns. */
#include "transmit.h"

#include <errno.h>
#include <string.h>

void transmit_init(struct transmit *t, struct queue *queue, struct line *line, struct ack_window *ack,
                   struct level_window *level, struct pace *pace)
{
    t->counters = line->counters;
    t->events = line->events;
    t->queue = queue;
    t->line = line;
    t->ack = ack;
    t->level = level;
    t->pace = pace;
    t->answers_each = line->codec->confirms == CONFIRMS_EACH;
}

/* --- answers --------------------------------------------------------------------------------- */

static void poll_answered(struct transmit *t, int64_t now)
{
    bool had_frames = t->counters->decoded != t->poll_decoded;
    t->polling = false;
    t->poll_at_ns = had_frames ? now : now + t->poll_interval_ns;
}

/* The device answered the oldest in flight. `how`: EVENT_OK, EVENT_REFUSED or EVENT_TEXT. */
static void oldest_answered(struct transmit *t, enum event_kind how, const struct codec_message *msg, int64_t now)
{
    const struct inflight done = line_take(t->line);

    switch (done.kind) {
    case INFLIGHT_FRAME:
        if (how == EVENT_REFUSED)
            ack_window_refused(t->ack, &done, now);
        else
            ack_window_confirmed(t->ack, done.tx.number);
        break;
    case INFLIGHT_COMMAND:
        if (how == EVENT_TEXT)
            t->late_answer_possible = false;
        events_emit(t->events, how, done.token, msg->text, msg->length);
        break;
    case INFLIGHT_POLL:
        poll_answered(t, now);
        break;
    case INFLIGHT_LEVEL:
        level_window_answered(t->level, msg, now);
        break;
    case INFLIGHT_CHECK:
        ack_window_check_ended(t->ack);
        break;
    case INFLIGHT_SYNC:
        line_synced(t->line);
        ack_window_synced(t->ack);
        break;
    }
}

/* The oldest in flight is over without an answer of its own. */
static void oldest_unanswered(struct transmit *t)
{
    const struct inflight lost = line_take(t->line);

    switch (lost.kind) {
    case INFLIGHT_FRAME:
        queue_drop(t->queue, TX_UNANSWERED);
        break;
    case INFLIGHT_COMMAND:
        events_emit(t->events, EVENT_TIMEOUT, lost.token, NULL, 0);
        break;
    case INFLIGHT_POLL:
        t->polling = false;
        break;
    case INFLIGHT_LEVEL:
        level_window_unanswered(t->level);
        break;
    case INFLIGHT_CHECK:
    case INFLIGHT_SYNC:
        ack_window_check_ended(t->ack);
        break;
    }
}

/* A text answers the oldest command that asked for it; answers to what was sent before are lost. */
static void answer_text(struct transmit *t, const struct codec_message *msg, int64_t now)
{
    uint32_t before = line_find(t->line, msg);
    if (before < t->line->inflight_count) {
        if (t->line->overtaking)
            line_bring_forward(t->line, before);
        else
            while (before--)
                oldest_unanswered(t);
        oldest_answered(t, EVENT_TEXT, msg, now);
        return;
    }
    if (!t->line->codec->reports)
        t->counters->stray_answers++;
    events_emit(t->events, EVENT_UNASKED, 0, msg->text, msg->length);
}

/* CODEC_OK, CODEC_SENT or CODEC_REFUSED came. */
static void answer_short(struct transmit *t, enum codec_kind kind, int64_t now)
{
    const struct codec_message none = {.kind = kind};
    if (t->line->overtaking && line_find_frame(t->line) < t->line->inflight_count)
        line_bring_forward(t->line, line_find_frame(t->line));
    const struct inflight *oldest = t->line->inflight_count ? line_at(t->line, 0) : NULL;
    bool refused = kind == CODEC_REFUSED;
    bool accepted = oldest && oldest->accept & (refused ? ACCEPT_REFUSED : ACCEPT_OK);

    if (!refused && !accepted && ack_window_take_late(t->ack))
        return;
    if (!accepted || (kind == CODEC_SENT && oldest->kind != INFLIGHT_FRAME)) {
        t->counters->stray_answers++;
        return;
    }
    oldest_answered(t, refused ? EVENT_REFUSED : EVENT_OK, &none, now);
}

/* Anything but a received frame or noise came from the device; `frame` is that of CODEC_RETURNED. */
void transmit_answer(struct transmit *t, const struct codec_message *msg, const struct can_frame *frame, int64_t now)
{
    if (msg->kind == CODEC_TEXT)
        answer_text(t, msg, now);
    else if (msg->kind == CODEC_STOP || msg->kind == CODEC_GO || msg->kind == CODEC_RETURNED)
        level_window_message(t->level, msg->kind, frame, now);
    else
        answer_short(t, msg->kind, now);
}

/* --- a port comes or goes -------------------------------------------------------------------- */

static void answer_missing(struct transmit *t)
{
    if (t->answers_each)
        ack_window_answer_missing(t->ack);
}

/* The port is gone or new: what was in flight will never be answered. */
void transmit_reset(struct transmit *t)
{
    answer_missing(t);
    while (t->line->inflight_count)
        oldest_unanswered(t);
    for (; t->command_count; t->command_count--) {
        events_emit(t->events, EVENT_TIMEOUT, t->commands[t->command_head].token, NULL, 0);
        t->command_head = (t->command_head + 1) % COMMANDS_MAX;
    }
    t->polling = t->polled = t->late_answer_possible = false;
    t->stuck_told_ns = 0;
    t->poll.length = 0;
    line_reset(t->line);
    ack_window_reset(t->ack);
    level_window_reset(t->level);
    pace_reset(t->pace);
}

/* The port is new, or that of a device whose cut is not to be finished. */
void transmit_forget(struct transmit *t)
{
    line_forget(t->line);
    level_window_forget(t->level);
}

/* Says this at once, but behind the message that the port took in part. Nothing that waited is sent any more.
 * -> 0, or errno of a port that is gone */
int transmit_last_words(struct transmit *t, int port, const uint8_t *words, size_t length)
{
    transmit_reset(t);
    return port >= 0 && line_say(t->line, words, length) ? line_flush(t->line, port) : 0;
}

/* -> false: more commands wait than can ever be meant */
bool transmit_command(struct transmit *t, const struct command *command)
{
    if (t->command_count == COMMANDS_MAX)
        return false;
    t->commands[(t->command_head + t->command_count++) % COMMANDS_MAX] = *command;
    return true;
}

/* How the device wants its frames; until the port is detached. */
void transmit_set_sending(struct transmit *t, const struct sending_settings *set)
{
    line_set(t->line, set);
    ack_window_set(t->ack, set);
    pace_set(t->pace, set);
}

void transmit_poll(struct transmit *t, const struct command *poll, int64_t interval_ns)
{
    t->poll = *poll;
    t->poll_interval_ns = interval_ns;
    t->poll_at_ns = 0;
}

/* --- missing answers -------------------------------------------------------------------------
 *
 * A frame whose answer does not come in time stays the oldest in flight (keeps_its_place()), and the sync command is
 * sent behind it; nothing else goes until that is answered. Answers come in order, so:
 * - "done" before the sync command's answer is the frame's, late (what a refusal means then: ack_window.c);
 * - the sync command's answer says that the frame's is lost: the frame may be on the bus, so it is not sent again but
 *   dropped as `unanswered`;
 * - no answer to SYNC_TRIES sync commands: all in flight is dropped so, and EVENT_SILENT lets Python begin anew.
 * A device that answers no frame (CONFIRMS_LEVEL) is asked for its fill level instead: level_window.c. */

static int resync(struct transmit *t, int64_t now)
{
    answer_missing(t);
    t->late_answer_possible = false;
    return line_resync(t->line, now);
}

static int resync_again(struct transmit *t, int64_t now)
{
    int error = line_sync_again(t->line, now);
    if (error != ENODATA)
        return error;
    while (t->line->inflight_count)
        oldest_unanswered(t);
    line_fall_silent(t->line);
    return 0;
}

/* Whether the oldest in flight may still be answered late, so that its place is kept: a frame, or the question
 * behind frames. */
static bool keeps_its_place(const struct inflight *oldest, bool live)
{
    return oldest->kind == INFLIGHT_FRAME || (oldest->kind == INFLIGHT_LEVEL && live);
}

/* When the i-th in flight is overdue, where frames are answered when they are on the bus: such a frame waits for the
 * bus, until the gate is closed. */
static int64_t overdue_at(const struct transmit *t, uint32_t i)
{
    const struct inflight *in = line_at(t->line, i);
    if (in->kind != INFLIGHT_FRAME || t->queue->gate != GATE_OPEN)
        return in->deadline_ns;
    int64_t sent_ns = in->deadline_ns - t->line->answer_timeout_ns;
    int64_t since = sent_ns > t->stuck_told_ns ? sent_ns : t->stuck_told_ns;
    return since + t->queue->set.stuck_ns;
}

static int64_t overtaking_deadline(const struct transmit *t)
{
    int64_t at = t->line->out_until_ns;
    for (uint32_t i = 0; i < t->line->inflight_count; i++)
        if (overdue_at(t, i) < at)
            at = overdue_at(t, i);
    return at;
}

/* The channel is being closed: the answer to that must not count for a frame. */
static void give_up_frames(struct transmit *t)
{
    for (uint32_t i; (i = line_find_frame(t->line)) < t->line->inflight_count;) {
        line_bring_forward(t->line, i);
        oldest_unanswered(t);
    }
}

/* No answer is lost: those to frames come later than those to commands, and not before the bus takes the frame. */
static void look_for_overdue(struct transmit *t, int64_t now)
{
    struct line *l = t->line;
    for (uint32_t i = 0; i < l->inflight_count; i++) {
        if (overdue_at(t, i) > now)
            continue;
        if (line_at(l, i)->kind == INFLIGHT_FRAME && t->queue->gate == GATE_OPEN) {
            t->stuck_told_ns = now;
            events_emit(t->events, EVENT_STUCK, l->inflight_count, NULL, 0);
            continue;
        }
        line_bring_forward(l, i);
        oldest_unanswered(t);
        i--;
    }
}

/* -> 0, or errno of a port that is gone */
static int look_for_missing(struct transmit *t, int64_t now)
{
    struct line *l = t->line;
    bool live = t->queue->gate == GATE_OPEN || t->queue->gate == GATE_LISTEN_ONLY;

    if (l->resyncing)
        return line_at(l, l->inflight_count - 1)->deadline_ns <= now ? resync_again(t, now) : 0;
    if (l->unconfirmed) { /* no frame waits for an answer, for which a late one could be taken */
        while (l->inflight_count && line_at(l, 0)->deadline_ns <= now)
            oldest_unanswered(t);
        t->late_answer_possible = false;
        return 0;
    }
    if (l->overtaking)
        look_for_overdue(t, now);
    while (!l->overtaking && l->inflight_count && line_at(l, 0)->deadline_ns <= now) {
        bool kept = keeps_its_place(line_at(l, 0), live);
        if (!kept)
            oldest_unanswered(t);
        if (kept || live)
            return resync(t, now);
        t->late_answer_possible = true;
    }
    if (t->late_answer_possible && t->queue->gate == GATE_OPEN && !l->inflight_count)
        return resync(t, now);
    return 0;
}

/* --- sending --------------------------------------------------------------------------------- */

static bool frame_ready(const struct transmit *t, int64_t now)
{
    if (t->line->silent || !queue_waiting(t->queue) || t->line->inflight_count >= t->line->frames_max)
        return false;
    if (t->pace->depth && !pace_open(t->pace, t->line->unconfirmed ? 0 : t->line->inflight_count, now))
        return false;
    return t->answers_each ? ack_window_open(t->ack, now) : level_window_open(t->level);
}

static void send_frame(struct transmit *t, int64_t now)
{
    struct queue *q = t->queue;
    bool again = q->retry_count > 0;
    const struct tx_frame tx = again ? queue_retry_pop(q) : queue_pop(q);

    t->polled = false;
    /* it stood behind a younger one, where queue_expire() does not look; or would be too old when it leaves */
    if (queue_expired(q, &tx, pace_leaves(t->pace, now))) {
        queue_drop(q, again ? TX_REFUSED : TX_STALE);
        return;
    }
    t->counters->retries += again;
    if (!line_send_frame(t->line, &tx, q->set.deadline_ns, now))
        queue_drop(q, line_can_say(t->line, &tx.frame) ? TX_REMOTE : TX_MALFORMED);
    else if (!t->answers_each)
        level_window_sent(t->level, &tx);
    else if (t->pace->depth)
        pace_sent(t->pace, &tx.frame, now);
}

/* A poll is due. After one a frame goes first: a busy bus must not keep frames from going. */
static bool poll_due(const struct transmit *t, bool receiving, bool frame, int64_t now)
{
    if (!t->poll.length || !receiving || t->polling || t->line->silent || now < t->poll_at_ns)
        return false;
    return !(t->polled && frame);
}

/* -> whether more may go now */
static bool send_next(struct transmit *t, bool receiving, int64_t now)
{
    if (!line_has_room(t->line) || !line_window_open(t->line))
        return false;
    if (t->ack->checking) {
        if (!t->line->inflight_count)
            line_send_command(t->line, &t->line->sync, INFLIGHT_CHECK, now);
        return false;
    }
    bool frame = frame_ready(t, now);
    if (!t->answers_each && level_window_ask_due(t->level, frame && !t->command_count, now)) {
        level_window_ask(t->level, now);
        return true;
    }
    if (t->command_count) {
        if (t->line->overtaking && t->queue->gate != GATE_OPEN)
            give_up_frames(t);
        line_send_command(t->line, &t->commands[t->command_head], INFLIGHT_COMMAND, now);
        t->command_head = (t->command_head + 1) % COMMANDS_MAX;
        t->command_count--;
        return true;
    }
    if (poll_due(t, receiving, frame, now)) {
        t->polling = t->polled = true;
        t->poll_decoded = t->counters->decoded;
        line_send_command(t->line, &t->poll, INFLIGHT_POLL, now);
        return true;
    }
    if (frame)
        send_frame(t, now);
    return frame;
}

/* Nothing waits, nothing is in flight, nothing is in the device's buffer: transmit_pump and transmit_deadline
 * have nothing to look at. */
bool transmit_idle(const struct transmit *t)
{
    const struct line *l = t->line;
    bool waiting = t->queue->waiting_count || t->queue->retry_count || t->command_count;
    bool owed = l->inflight_count || l->out_end || t->late_answer_possible || t->ack->checking || l->resyncing;
    bool taken = t->level->sent_count || t->level->level;
    return !waiting && !owed && !taken && !t->poll.length;
}

/* Sends what the window allows, in one write. `receiving`: the device may be asked for frames.
 * -> 0, or errno of a port that is gone; ETIME: the port takes nothing, what waits in `out` must not go out late */
int transmit_pump(struct transmit *t, int port, bool receiving, int64_t now)
{
    struct line *l = t->line;
    if (now >= l->out_until_ns)
        return ETIME;
    int error = look_for_missing(t, now);
    if (!error && l->out_start) { /* a message the port took in part is finished first */
        line_finish(l, now);
        error = line_flush(l, port);
    }
    if (error || l->out_start)
        return error;
    /* where each frame is answered, nobody knows before a refusal was checked what became of the frame */
    queue_expire(t->queue, !t->answers_each || !(t->ack->checking || l->resyncing), now);
    while (send_next(t, receiving, now))
        ;
    return line_flush(l, port);
}

/* When transmit_pump has something to do without any input. */
int64_t transmit_deadline(const struct transmit *t, bool receiving)
{
    const struct line *l = t->line;
    int64_t at = l->overtaking && !l->resyncing ? overtaking_deadline(t) : line_deadline(l);
    if (l->silent || t->ack->checking || l->out_start || !line_has_room(l) || !line_window_open(l))
        return at;
    if (t->poll.length && receiving && !t->polling && t->poll_at_ns < at)
        at = t->poll_at_ns;
    int64_t frame_at = t->answers_each ? ack_window_deadline(t->ack) : level_window_deadline(t->level);
    int64_t paced_at = queue_waiting(t->queue) ? pace_deadline(t->pace) : NEVER;
    if (paced_at != NEVER && (frame_at == NEVER || frame_at < paced_at))
        frame_at = paced_at;
    return frame_at < at ? frame_at : at;
}

/* Frames read from the interface of which nobody knows yet what becomes of them. */
uint32_t transmit_queued(const struct transmit *t)
{
    uint32_t n = t->queue->waiting_count + t->queue->retry_count + t->level->sent_count + t->line->unwritten;
    for (uint32_t i = 0; i < t->line->inflight_count; i++)
        n += line_at(t->line, i)->kind == INFLIGHT_FRAME;
    return n;
}
