/* Bus -> device: the window of unanswered commands, and what answers do to it.
 *
 * The device answers in the order of its commands. So an answer belongs to the oldest command in
 * flight, and a text that answers a later one proves that the answers before it were lost.
 * A device that does not answer frames has another window for them: flow.c. */
#include "relay.h"

#include <errno.h>
#include <string.h>
#include <unistd.h>

#define RETRY_FIRST_NS INT64_C(1000000)
#define RETRY_LAST_NS INT64_C(16000000)
#define RETRIES_TOLD 16 /* about four times a second */

static struct inflight *inflight_at(struct relay *r, uint32_t i)
{
    return &r->inflight[(r->inflight_head + i) % INFLIGHT_MAX];
}

/* Grows with everything from the device that was no message, or one that nobody waits for. */
static uint64_t line_noise(const struct relay *r)
{
    return r->count.skipped_bytes + r->count.stray_answers;
}

/* Noise since a refusal, before it was checked, may have been the answer that the frame was taken. */
static void retry_disbelieve(struct relay *r)
{
    for (; r->retry_count && line_noise(r) != r->check_noise; retry_pop(r))
        queue_drop(r, TX_UNANSWERED);
}

/* The oldest command in flight is over without an answer of its own. */
static void inflight_give_up(struct relay *r)
{
    const struct inflight *head = inflight_at(r, 0);

    if (head->kind == INFLIGHT_FRAME)
        queue_drop(r, TX_UNANSWERED);
    else if (head->kind == INFLIGHT_COMMAND)
        relay_emit(r, EVENT_TIMEOUT, head->token, NULL, 0);
    else if (head->kind == INFLIGHT_POLL)
        r->polling = false;
    else if (head->kind == INFLIGHT_LEVEL)
        flow_unanswered(r);
    else if (r->checking) {
        r->checking = false;
        retry_disbelieve(r);
    }
    r->inflight_head = (r->inflight_head + 1) % INFLIGHT_MAX;
    r->inflight_count--;
}

/* With a window above 1 and an answer missing, a refusal may have been another frame's. What was
 * refused while anything is still in flight is not sent again. */
static void retry_doubt(struct relay *r)
{
    for (; !flow_used(r) && r->set.window > 1 && r->inflight_count && r->retry_count; retry_pop(r))
        queue_drop(r, TX_UNANSWERED);
}

/* Of `out` nothing stays but the message of which the port took a part. (None is longer than COMMAND_SIZE, but for
 * commands without an end.) */
static void out_cut(struct relay *r)
{
    size_t at = 0, next = 0;
    while (next < r->out_start) {
        at = next;
        next += r->set.codec->length(r->out + at, r->out_end - at);
    }
    if (next == r->out_start || next - at > COMMAND_SIZE)
        at = next = r->out_start;
    memmove(r->out, r->out + at, next - at);
    r->out_start -= at;
    r->out_end = next - at;
    r->out_until_ns = NEVER;
}

struct cut transmit_cut(const struct relay *r)
{
    struct cut cut = {.taken = r->out_start, .length = r->out_end};
    memcpy(cut.message, r->out, cut.length);
    return cut;
}

/* The port is that of the cut: the rest goes before all else. */
void transmit_resume(struct relay *r, const struct cut *cut)
{
    memcpy(r->out, cut->message, cut->length);
    r->out_start = cut->taken;
    r->out_end = cut->length;
}

/* The port is new, or that of a device whose cut is not to be finished. */
void transmit_forget(struct relay *r)
{
    r->out_start = r->out_end = 0;
    r->unread = false;
}

/* The port is gone or new: what was in flight will never be answered. */
void transmit_reset(struct relay *r)
{
    retry_doubt(r);
    while (r->inflight_count)
        inflight_give_up(r);
    for (; r->command_count; r->command_count--) {
        relay_emit(r, EVENT_TIMEOUT, r->commands[r->command_head].token, NULL, 0);
        r->command_head = (r->command_head + 1) % COMMANDS_MAX;
    }
    out_cut(r);
    r->resyncing = r->silent = r->polling = r->polled = r->checking = r->doubtful = false;
    r->poll.length = 0;
    r->retry_delay_ns = RETRY_FIRST_NS;
    r->retry_at_ns = 0;
    r->refused_ns = NEVER;
    flow_reset(r);
}

uint32_t transmit_queued(const struct relay *r)
{
    uint32_t n = r->queue_count + r->retry_count + r->flow.sent_count;
    for (uint32_t i = 0; i < r->inflight_count; i++)
        n += r->inflight[(r->inflight_head + i) % INFLIGHT_MAX].kind == INFLIGHT_FRAME;
    return n;
}

bool transmit_command(struct relay *r, const struct command *command)
{
    if (r->command_count == COMMANDS_MAX)
        return false;
    r->commands[(r->command_head + r->command_count++) % COMMANDS_MAX] = *command;
    return true;
}

/* --- answers --------------------------------------------------------------------------------- */

static void frame_confirmed(struct relay *r, uint64_t number)
{
    r->count.confirmed++;
    r->retry_delay_ns = RETRY_FIRST_NS;
    r->refused_ns = NEVER;
    while (r->retry_count && retry_first(r)->number < number) {
        retry_pop(r);
        queue_drop(r, TX_OVERTAKEN);
    }
}

/* Where the device's buffer is full and takes nothing for so long, nothing has left it either. */
static void look_if_stuck(struct relay *r, int64_t now)
{
    if (r->refused_ns == NEVER)
        r->refused_ns = now;
    if (now - r->refused_ns < stuck_ns(r))
        return;
    r->refused_ns = now;
    relay_emit(r, EVENT_STUCK, 0, NULL, 0);
}

/* BELL says that the adapter did not take the frame: sending it again cannot double it. But a BELL may
 * be noise, or a second answer to the frame before (slcanpty); so first the sync command goes, and if the
 * frame's own answer comes before that command's, the frame was taken after all. Where there was noise
 * that answer may be in it, so that nothing is certain. While the line is being resynchronised BELL may mean something else (the sync command spliced to a broken
 * one), and a frame sent twice is worse than one dropped and counted. */
static void frame_refused(struct relay *r, const struct tx_frame *tx, uint64_t noise, int64_t now)
{
    if (r->resyncing || line_noise(r) != noise) {
        queue_drop(r, TX_UNANSWERED);
        return;
    }
    if (r->gate != GATE_OPEN) {
        queue_drop(r, r->gate == GATE_STOPPED ? TX_STOPPED : TX_REFUSED);
        return;
    }
    if (r->retry_delay_ns == RETRY_FIRST_NS || r->count.retries % RETRIES_TOLD == 0)
        relay_emit(r, EVENT_FRAME_REFUSED, (uint32_t)r->count.retries, NULL, 0);
    look_if_stuck(r, now);
    queue_retry(r, tx);
    if (!r->checking)
        r->check_noise = line_noise(r);
    r->checking = true;
    r->retry_at_ns = now + r->retry_delay_ns;
    r->retry_delay_ns *= r->retry_delay_ns < RETRY_LAST_NS ? 2 : 1;
}

static void poll_done(struct relay *r, int64_t now)
{
    r->polling = false;
    r->poll_at_ns = r->count.decoded != r->poll_decoded ? now : now + r->poll_interval_ns;
}

/* Takes the oldest command out of flight and says what became of it. */
static void inflight_settle(struct relay *r, enum event_kind how, const struct codec_message *msg, int64_t now)
{
    const struct inflight done = *inflight_at(r, 0);
    r->inflight_head = (r->inflight_head + 1) % INFLIGHT_MAX;
    r->inflight_count--;

    switch (done.kind) {
    case INFLIGHT_FRAME:
        if (how == EVENT_REFUSED)
            frame_refused(r, &done.tx, done.noise, now);
        else
            frame_confirmed(r, done.tx.number);
        break;
    case INFLIGHT_COMMAND:
        r->doubtful = r->doubtful && how != EVENT_TEXT;
        relay_emit(r, how, done.token, msg->text, msg->length);
        break;
    case INFLIGHT_POLL:
        poll_done(r, now);
        break;
    case INFLIGHT_LEVEL:
        flow_answered(r, msg, now);
        break;
    case INFLIGHT_CHECK:
        r->checking = false;
        retry_disbelieve(r);
        break;
    case INFLIGHT_SYNC:
        r->resyncing = r->checking = false;
        break;
    }
}

/* A text answers the oldest command that asked for it; answers to what was sent before are lost. */
static void answer_text(struct relay *r, const struct codec_message *msg, int64_t now)
{
    for (uint32_t i = 0; i < r->inflight_count; i++) {
        const struct inflight *in = inflight_at(r, i);
        if (!in->prefix_length || msg->length < in->prefix_length
            || memcmp(in->prefix, msg->text, in->prefix_length) != 0)
            continue;
        while (i--)
            inflight_give_up(r);
        inflight_settle(r, EVENT_TEXT, msg, now);
        return;
    }
    if (!r->set.codec->reports)
        r->count.stray_answers++;
    relay_emit(r, EVENT_UNASKED, 0, msg->text, msg->length);
}

/* Whether "done" can only be the answer to a frame that a BELL seemed to refuse. */
static bool answers_refused(struct relay *r)
{
    const struct inflight *head = inflight_at(r, 0);
    bool expected = r->inflight_count && (head->kind == INFLIGHT_FRAME || head->accept & ACCEPT_OK);
    return r->retry_count && (r->checking || r->resyncing) && !expected;
}

/* Anything but a received frame or noise came from the device; `frame` is that of CODEC_RETURNED. */
void transmit_answer(struct relay *r, const struct codec_message *msg, const struct can_frame *frame, int64_t now)
{
    if (msg->kind == CODEC_TEXT) {
        answer_text(r, msg, now);
        return;
    }
    if (msg->kind == CODEC_STOP || msg->kind == CODEC_GO || msg->kind == CODEC_RETURNED) {
        flow_message(r, msg->kind, frame, now);
        return;
    }
    const struct codec_message none = {.kind = msg->kind};
    const struct inflight *head = inflight_at(r, 0);
    bool refused = msg->kind == CODEC_REFUSED;
    uint8_t needed = refused ? ACCEPT_REFUSED : ACCEPT_OK;

    if (!refused && answers_refused(r)) {
        frame_confirmed(r, retry_pop(r).number);
        return;
    }
    if (!r->inflight_count || !(head->accept & needed)
        || (msg->kind == CODEC_SENT && head->kind != INFLIGHT_FRAME)) {
        r->count.stray_answers++;
        return;
    }
    inflight_settle(r, refused ? EVENT_REFUSED : EVENT_OK, &none, now);
}

/* --- sending --------------------------------------------------------------------------------- */

static struct inflight *inflight_push(struct relay *r, enum inflight_kind kind, int64_t deadline_ns)
{
    struct inflight *in = inflight_at(r, r->inflight_count++);
    *in = (struct inflight){.kind = kind, .deadline_ns = deadline_ns, .noise = line_noise(r)};
    return in;
}

static void send_command(struct relay *r, const struct command *c, enum inflight_kind kind, int64_t now)
{
    int64_t timeout = c->timeout_ns ? c->timeout_ns : r->set.answer_timeout_ns;
    struct inflight *in = inflight_push(r, kind, now + timeout);
    if (now + timeout < r->out_until_ns)
        r->out_until_ns = now + timeout;
    in->token = c->token;
    in->accept = c->accept;
    in->prefix_length = c->prefix_length;
    memcpy(in->prefix, c->prefix, sizeof in->prefix);
    memcpy(r->out + r->out_end, c->data, c->length);
    r->out_end += c->length;
}

static void send_frame(struct relay *r, const struct tx_frame *tx, int64_t now)
{
    size_t n = r->set.codec->encode(&tx->frame, r->out + r->out_end);
    if (!n) {
        queue_drop(r, TX_MALFORMED);
        return;
    }
    if (flow_used(r)) {
        flow_sent(r, tx);
    } else {
        struct inflight *in = inflight_push(r, INFLIGHT_FRAME, now + r->set.answer_timeout_ns);
        in->accept = ACCEPT_OK | ACCEPT_REFUSED;
        in->tx = *tx;
    }
    if (tx->born_ns + r->set.deadline_ns + 1 < r->out_until_ns)
        r->out_until_ns = tx->born_ns + r->set.deadline_ns + 1;
    r->out_end += n;
}

/* The only command that does not wait for room in the window, so it looks for room in `out` itself. */
static void send_sync(struct relay *r, int64_t now)
{
    if (r->out_end + COMMAND_SIZE > OUT_BUFFER)
        relay_port_lost(r, ETIME);
    else
        send_command(r, &r->set.sync, INFLIGHT_SYNC, now);
}

/* An answer is missing. Nothing more is sent until the adapter has answered a command whose answer
 * cannot be taken for any other: what came before it then belongs to the past. */
static void resync_start(struct relay *r, int64_t now)
{
    retry_doubt(r);
    r->resyncing = true;
    r->doubtful = false;
    r->sync_tries = 1;
    r->count.resyncs++;
    relay_emit(r, EVENT_UNANSWERED, (uint32_t)r->count.resyncs, NULL, 0);
    send_sync(r, now);
}

static void resync_again(struct relay *r, int64_t now)
{
    r->inflight_count--; /* the sync command is always the last in flight */
    if (r->sync_tries++ < SYNC_TRIES) {
        send_sync(r, now);
        return;
    }
    while (r->inflight_count)
        inflight_give_up(r);
    r->resyncing = false;
    r->silent = true;
    relay_emit(r, EVENT_SILENT, 0, NULL, 0);
}

static void check_answers(struct relay *r, int64_t now)
{
    if (r->resyncing) {
        if (inflight_at(r, r->inflight_count - 1)->deadline_ns <= now)
            resync_again(r, now);
        return;
    }
    while (r->inflight_count && inflight_at(r, 0)->deadline_ns <= now) {
        enum inflight_kind kind = inflight_at(r, 0)->kind;
        bool live = r->gate == GATE_OPEN || r->gate == GATE_LISTEN_ONLY;
        bool frame = kind == INFLIGHT_FRAME || (kind == INFLIGHT_LEVEL && live);
        if (!frame) /* a frame keeps its place: its answer may only be late */
            inflight_give_up(r);
        if (frame || live) {
            resync_start(r, now);
            return;
        }
        r->doubtful = true;
    }
    if (r->doubtful && r->gate == GATE_OPEN && !r->inflight_count)
        resync_start(r, now);
}

/* Whether a frame may go now. After a refusal one at a time, so that none overtakes another. */
static bool frame_ready(const struct relay *r, int64_t now)
{
    if (!queue_waiting(r))
        return false;
    if (flow_used(r))
        return flow_ready(r);
    if (r->retry_count)
        return !r->inflight_count && now >= r->retry_at_ns;
    return true;
}

static bool send_next(struct relay *r, int64_t now)
{
    if (r->resyncing || r->inflight_count >= r->set.window)
        return false;
    if (r->checking) {
        if (!r->inflight_count)
            send_command(r, &r->set.sync, INFLIGHT_CHECK, now);
        return false;
    }
    if (flow_ask_due(r, frame_ready(r, now) && !r->command_count, now)) {
        flow_asked(r, now);
        send_command(r, &r->flow.ask, INFLIGHT_LEVEL, now);
        return true;
    }
    if (r->command_count) {
        send_command(r, &r->commands[r->command_head], INFLIGHT_COMMAND, now);
        r->command_head = (r->command_head + 1) % COMMANDS_MAX;
        r->command_count--;
        return true;
    }
    bool turn_of_frame = r->polled && frame_ready(r, now); /* a busy bus must not keep frames from going */
    if (r->poll.length && r->receiving && !r->polling && !r->silent && now >= r->poll_at_ns && !turn_of_frame) {
        r->polling = r->polled = true;
        r->poll_decoded = r->count.decoded;
        send_command(r, &r->poll, INFLIGHT_POLL, now);
        return true;
    }
    if (!frame_ready(r, now))
        return false;
    r->polled = false;
    bool again = r->retry_count > 0;
    struct tx_frame tx = again ? retry_pop(r) : queue_pop(r);
    if (now - tx.born_ns > r->set.deadline_ns) { /* it stood behind a younger one, where queue_expire() does not look */
        queue_drop(r, again ? TX_REFUSED : TX_STALE);
        return true;
    }
    r->count.retries += again;
    send_frame(r, &tx, now);
    return true;
}

/* EINTR: again. EAGAIN: when poll says so. Anything else: the port is gone. */
static void out_flush(struct relay *r)
{
    while (r->out_start < r->out_end) {
        ssize_t n = write(r->port, r->out + r->out_start, r->out_end - r->out_start);
        if (n < 0 && errno == EINTR)
            continue;
        if (n < 0 && errno != EAGAIN) {
            relay_port_lost(r, errno);
            return;
        }
        if (n <= 0)
            return;
        r->out_start += (size_t)n;
    }
    r->out_start = r->out_end = 0;
    r->out_until_ns = NEVER;
}

/* Says this at once, but behind the message that the port took in part. Nothing that waited is sent any more. */
void transmit_last_words(struct relay *r, const uint8_t *words, size_t length)
{
    transmit_reset(r);
    if (r->port < 0 || length > OUT_BUFFER - r->out_end)
        return;
    memcpy(r->out + r->out_end, words, length);
    r->out_end += length;
    out_flush(r);
}

/* Nothing waits, nothing is in flight, nothing is in the device's buffer: transmit_pump and transmit_deadline
 * have nothing to look at. */
bool transmit_idle(const struct relay *r)
{
    bool owed = r->queue_count || r->retry_count || r->command_count || r->inflight_count || r->out_end;
    bool taken = r->flow.sent_count || r->flow.level;
    return !owed && !taken && !r->poll.length && !r->doubtful && !r->checking && !r->resyncing;
}

/* Sends what the window allows, in one write. */
void transmit_pump(struct relay *r, int64_t now)
{
    if (r->port < 0) {
        queue_expire(r, now);
        return;
    }
    if (now >= r->out_until_ns) { /* the port takes nothing: what waits here must not go out late */
        relay_port_lost(r, ETIME);
        return;
    }
    check_answers(r, now);
    if (r->port < 0)
        return;
    if (r->out_start) { /* a message the port took in part is finished first */
        if (r->out_until_ns == NEVER) /* begun before this port was attached */
            r->out_until_ns = now + r->set.answer_timeout_ns;
        out_flush(r);
    }
    if (r->out_start || r->port < 0)
        return;
    queue_expire(r, now);
    while (r->out_end + COMMAND_SIZE <= OUT_BUFFER && send_next(r, now)) /* a command or a frame */
        ;
    out_flush(r);
}

/* When transmit_pump has something to do without any input. */
int64_t transmit_deadline(struct relay *r)
{
    int64_t at = NEVER;
    if (r->port < 0)
        return queue_expires_ns(r);
    if (r->inflight_count) {
        uint32_t i = r->resyncing ? r->inflight_count - 1 : 0;
        at = r->inflight[(r->inflight_head + i) % INFLIGHT_MAX].deadline_ns;
    }
    if (r->out_until_ns < at)
        at = r->out_until_ns;
    if (r->resyncing || r->silent || r->checking || r->out_start || r->inflight_count >= r->set.window)
        return at;
    if (r->poll.length && r->receiving && !r->polling && r->poll_at_ns < at)
        at = r->poll_at_ns;
    if (flow_used(r)) {
        int64_t ask_at = flow_deadline(r);
        return ask_at < at ? ask_at : at;
    }
    if (r->retry_count && r->gate == GATE_OPEN && !r->inflight_count && r->retry_at_ns < at)
        at = r->retry_at_ns;
    return at;
}
