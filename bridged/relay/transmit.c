/* Bus -> device: the transmit queue, the window of unanswered commands, and what answers do to it.
 *
 * The device answers in the order of its commands. So an answer belongs to the oldest command in
 * flight, and a text that answers a later one proves that the answers before it were lost. */
#include "relay.h"

#include <errno.h>
#include <string.h>
#include <unistd.h>

#define RETRY_FIRST_NS INT64_C(1000000)
#define RETRY_LAST_NS INT64_C(16000000)
#define RETRIES_TOLD 16 /* about four times a second */

static struct tx_frame *queue_at(struct relay *r, uint32_t i)
{
    return &r->queue[(r->queue_head + i) % r->set.queue];
}

static struct tx_frame *retry_at(struct relay *r, uint32_t i)
{
    return &r->retry[(r->retry_head + i) % RETRY_MAX];
}

static struct inflight *inflight_at(struct relay *r, uint32_t i)
{
    return &r->inflight[(r->inflight_head + i) % INFLIGHT_MAX];
}

static struct tx_frame queue_pop(struct relay *r)
{
    struct tx_frame tx = *queue_at(r, 0);
    r->queue_head = (r->queue_head + 1) % r->set.queue;
    r->queue_count--;
    return tx;
}

static struct tx_frame retry_pop(struct relay *r)
{
    struct tx_frame tx = *retry_at(r, 0);
    r->retry_head = (r->retry_head + 1) % RETRY_MAX;
    r->retry_count--;
    return tx;
}

/* Grows with everything from the device that was no message, or one that nobody waits for. */
static uint64_t line_noise(const struct relay *r)
{
    return r->count.skipped_bytes + r->count.stray_answers;
}

void transmit_drop(struct relay *r, enum tx_drop reason)
{
    r->count.tx_dropped[reason]++;
}

/* Both lists are in order of age, so only their heads need a look. */
void transmit_expire(struct relay *r, int64_t now)
{
    while (r->retry_count && now - retry_at(r, 0)->born_ns > r->set.deadline_ns) {
        retry_pop(r);
        transmit_drop(r, TX_REFUSED);
    }
    while (r->queue_count && now - queue_at(r, 0)->born_ns > r->set.deadline_ns) {
        queue_pop(r);
        transmit_drop(r, TX_STALE);
    }
}

/* A frame from the bus: into the queue, or dropped for what the gate says. */
void transmit_enqueue(struct relay *r, const struct can_frame *frame, int64_t born_ns, int64_t now)
{
    static const enum tx_drop closed[GATES] = {
        [GATE_AWAY] = TX_AWAY, [GATE_LISTEN_ONLY] = TX_LISTEN_ONLY, [GATE_STOPPED] = TX_STOPPED};

    if (r->gate != GATE_OPEN) {
        transmit_drop(r, closed[r->gate]);
        return;
    }
    if (r->queue_count == r->set.queue)
        transmit_expire(r, now);
    if (r->queue_count == r->set.queue) {
        transmit_drop(r, TX_QUEUE_FULL);
        return;
    }
    struct tx_frame *tx = queue_at(r, r->queue_count++);
    tx->frame = *frame;
    tx->born_ns = born_ns;
    tx->number = r->next_number++;
}

/* Frames that wait survive the adapter's absence until their deadline; nothing else does. */
void transmit_set_gate(struct relay *r, enum gate gate)
{
    r->gate = gate;
    if (gate != GATE_STOPPED && gate != GATE_LISTEN_ONLY)
        return;
    enum tx_drop reason = gate == GATE_STOPPED ? TX_STOPPED : TX_LISTEN_ONLY;
    for (; r->retry_count; retry_pop(r))
        transmit_drop(r, reason);
    for (; r->queue_count; queue_pop(r))
        transmit_drop(r, reason);
}

/* The oldest command in flight is over without an answer of its own. */
static void inflight_give_up(struct relay *r)
{
    const struct inflight *head = inflight_at(r, 0);

    if (head->kind == INFLIGHT_FRAME)
        transmit_drop(r, TX_UNANSWERED);
    else if (head->kind == INFLIGHT_COMMAND)
        relay_emit(r, EVENT_TIMEOUT, head->token, NULL, 0);
    else if (head->kind == INFLIGHT_POLL)
        r->polling = false;
    else
        r->checking = false;
    r->inflight_head = (r->inflight_head + 1) % INFLIGHT_MAX;
    r->inflight_count--;
}

/* With a window above 1 and an answer missing, a refusal may have been another frame's. What was
 * refused while anything is still in flight is not sent again. */
static void retry_doubt(struct relay *r)
{
    for (; r->set.window > 1 && r->inflight_count && r->retry_count; retry_pop(r))
        transmit_drop(r, TX_UNANSWERED);
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
    r->out_start = r->out_end = 0;
    r->resyncing = r->silent = r->polling = r->polled = r->checking = r->doubtful = false;
    r->out_until_ns = NEVER;
    r->poll.length = 0;
    r->retry_delay_ns = RETRY_FIRST_NS;
    r->retry_at_ns = 0;
}

uint32_t transmit_queued(const struct relay *r)
{
    uint32_t n = r->queue_count + r->retry_count;
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
    while (r->retry_count && retry_at(r, 0)->number < number) {
        retry_pop(r);
        transmit_drop(r, TX_OVERTAKEN);
    }
}

/* BELL says that the adapter did not take the frame: sending it again cannot double it. But a BELL may
 * be noise, or a second answer to the frame before (slcanpty); so first the sync command goes, and if the
 * frame's own answer comes before that command's, the frame was taken after all. Where there was noise
 * that answer may be in it, so that nothing is certain. While the line is being resynchronised BELL may mean something else (the sync command spliced to a broken
 * one), and a frame sent twice is worse than one dropped and counted. */
static void frame_refused(struct relay *r, const struct tx_frame *tx, uint64_t noise, int64_t now)
{
    if (r->resyncing || line_noise(r) != noise) {
        transmit_drop(r, TX_UNANSWERED);
        return;
    }
    if (r->gate != GATE_OPEN) {
        transmit_drop(r, r->gate == GATE_STOPPED ? TX_STOPPED : TX_REFUSED);
        return;
    }
    if (r->retry_delay_ns == RETRY_FIRST_NS || r->count.retries % RETRIES_TOLD == 0)
        relay_emit(r, EVENT_FRAME_REFUSED, (uint32_t)r->count.retries, NULL, 0);
    uint32_t i = r->retry_count++;
    for (; i && retry_at(r, i - 1)->number > tx->number; i--)
        *retry_at(r, i) = *retry_at(r, i - 1);
    *retry_at(r, i) = *tx;
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
    case INFLIGHT_CHECK:
        r->checking = false;
        for (; r->retry_count && line_noise(r) != r->check_noise; retry_pop(r))
            transmit_drop(r, TX_UNANSWERED);
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
        if (inflight_at(r, i)->prefix != msg->text[0])
            continue;
        while (i--)
            inflight_give_up(r);
        inflight_settle(r, EVENT_TEXT, msg, now);
        return;
    }
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

/* CODEC_OK, CODEC_SENT, CODEC_REFUSED or CODEC_TEXT came from the device. */
void transmit_answer(struct relay *r, const struct codec_message *msg, int64_t now)
{
    if (msg->kind == CODEC_TEXT) {
        answer_text(r, msg, now);
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
    in->prefix = c->prefix;
    memcpy(r->out + r->out_end, c->data, c->length);
    r->out_end += c->length;
}

static void send_frame(struct relay *r, const struct tx_frame *tx, int64_t now)
{
    size_t n = r->set.codec->encode(&tx->frame, r->out + r->out_end);
    if (!n) {
        transmit_drop(r, TX_MALFORMED);
        return;
    }
    struct inflight *in = inflight_push(r, INFLIGHT_FRAME, now + r->set.answer_timeout_ns);
    in->accept = ACCEPT_OK | ACCEPT_REFUSED;
    in->tx = *tx;
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
        bool frame = inflight_at(r, 0)->kind == INFLIGHT_FRAME;
        bool poll = inflight_at(r, 0)->kind == INFLIGHT_POLL;
        if (!frame) /* a frame keeps its place: its answer may only be late */
            inflight_give_up(r);
        if (frame || r->gate == GATE_OPEN || (poll && r->gate == GATE_LISTEN_ONLY)) {
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
    if (r->gate != GATE_OPEN || r->silent)
        return false;
    if (r->retry_count)
        return !r->inflight_count && now >= r->retry_at_ns;
    return r->queue_count > 0;
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
    r->count.retries += r->retry_count > 0;
    struct tx_frame tx = r->retry_count ? retry_pop(r) : queue_pop(r);
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

/* Sends what the window allows, in one write. */
void transmit_pump(struct relay *r, int64_t now)
{
    if (r->port < 0)
        return;
    if (now >= r->out_until_ns) { /* the port takes nothing: what waits here must not go out late */
        relay_port_lost(r, ETIME);
        return;
    }
    check_answers(r, now);
    if (r->port < 0)
        return;
    if (r->out_start == 0) { /* a message the port took in part is finished first */
        transmit_expire(r, now);
        while (r->out_end + COMMAND_SIZE <= OUT_BUFFER && send_next(r, now))
            ;
    }
    out_flush(r);
}

/* When transmit_pump has something to do without any input. */
int64_t transmit_deadline(const struct relay *r)
{
    int64_t at = NEVER;
    if (r->port < 0)
        return at;
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
    if (r->retry_count && r->gate == GATE_OPEN && !r->inflight_count && r->retry_at_ns < at)
        at = r->retry_at_ns;
    return at;
}
