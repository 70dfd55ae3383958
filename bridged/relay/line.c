/* The way to the device. */
#include "line.h"

#include <assert.h>
#include <errno.h>
#include <string.h>
#include <unistd.h>

enum { SYNC_TRIES = 3 }; /* unanswered sync commands until the device counts as silent */

static_assert((int)CODEC_FRAME_MAX <= (int)COMMAND_SIZE, "the room for a command is room for a frame");
static_assert((int)WINDOW_MAX < (int)INFLIGHT_MAX, "room for the sync command behind a full window");

/* How the device wants its frames; until the port is detached. */
void line_set(struct line *l, const struct sending_settings *set)
{
    bool each = l->codec->confirms == CONFIRMS_EACH;
    l->encode = l->codec->encode[set->remote];
    l->unconfirmed = each && set->answer == ANSWER_NONE;
    l->answered = each && !l->unconfirmed;
    l->overtaking = each && set->answer == ANSWER_SENT;
    l->frames_max = l->unconfirmed ? WINDOW_MAX : set->window ? set->window : l->usual_window;
    l->window = l->frames_max + l->overtaking;
}

static void set_usual(struct line *l)
{
    const struct sending_settings usual = {0};
    line_set(l, &usual);
}

void line_init(struct line *l, const struct settings *set, struct counters *counters, struct events *events)
{
    l->counters = counters;
    l->events = events;
    l->codec = set->codec;
    l->sync = set->sync;
    l->answer_timeout_ns = set->answer_timeout_ns;
    l->usual_window = set->window;
    l->out_until_ns = NEVER;
    set_usual(l);
}

/* --- what the port takes in part ------------------------------------------------------------- */

/* Of `out` nothing stays but the message of which the port took a part. (None is longer than COMMAND_SIZE, but for
 * commands without an end.) */
static void out_cut(struct line *l)
{
    size_t at = 0, next = 0;
    while (next < l->out_start) {
        at = next;
        next += l->codec->length(l->out + at, l->out_end - at);
    }
    if (next == l->out_start || next - at > COMMAND_SIZE)
        at = next = l->out_start;
    memmove(l->out, l->out + at, next - at);
    l->out_start -= at;
    l->out_end = next - at;
    l->out_until_ns = NEVER;
}

/* The port is gone or new. The caller has taken everything out of flight before. */
void line_reset(struct line *l)
{
    l->counters->tx_dropped[TX_UNANSWERED] += l->unwritten;
    l->unwritten = 0;
    set_usual(l);
    out_cut(l);
    l->resyncing = l->silent = false;
}

struct cut line_cut(const struct line *l)
{
    struct cut cut = {.taken = l->out_start, .length = l->out_end};
    memcpy(cut.message, l->out, cut.length);
    return cut;
}

/* The port is that of the cut: the rest goes before all else. */
void line_resume(struct line *l, const struct cut *cut)
{
    memcpy(l->out, cut->message, cut->length);
    l->out_start = cut->taken;
    l->out_end = cut->length;
}

/* The port is new, or that of a device whose cut is not to be finished. */
void line_forget(struct line *l)
{
    l->out_start = l->out_end = 0;
}

/* Puts these bytes into `out`; nobody waits for an answer. -> whether there is room */
bool line_say(struct line *l, const uint8_t *words, size_t length)
{
    if (length > OUT_BUFFER - l->out_end)
        return false;
    memcpy(l->out + l->out_end, words, length);
    l->out_end += length;
    return true;
}

/* --- sending --------------------------------------------------------------------------------- */

static void out_within(struct line *l, int64_t until_ns)
{
    if (until_ns < l->out_until_ns)
        l->out_until_ns = until_ns;
}

static struct inflight *inflight_push(struct line *l, enum inflight_kind kind, int64_t deadline_ns)
{
    struct inflight *in = &l->inflight[(l->inflight_head + l->inflight_count++) % INFLIGHT_MAX];
    in->kind = kind;
    in->prefix_length = 0;
    in->deadline_ns = deadline_ns;
    in->noise = line_noise(l);
    return in;
}

/* The caller has seen that there is room. */
void line_send_command(struct line *l, const struct command *c, enum inflight_kind kind, int64_t now)
{
    int64_t deadline_ns = now + (c->timeout_ns ? c->timeout_ns : l->answer_timeout_ns);
    struct inflight *in = inflight_push(l, kind, deadline_ns);
    out_within(l, deadline_ns);
    in->token = c->token;
    in->accept = c->accept;
    in->prefix_length = c->prefix_length;
    memcpy(in->prefix, c->prefix, sizeof in->prefix);
    memcpy(l->out + l->out_end, c->data, c->length);
    l->out_end += c->length;
}

/* The same for a frame, which is in flight only if the device answers it. `deadline_ns`: its greatest age.
 * -> false: this protocol cannot say it */
bool line_send_frame(struct line *l, const struct tx_frame *tx, int64_t deadline_ns, int64_t now)
{
    size_t n = l->encode(&tx->frame, l->out + l->out_end);
    if (!n)
        return false;
    if (l->answered) {
        struct inflight *in = inflight_push(l, INFLIGHT_FRAME, now + l->answer_timeout_ns);
        in->accept = ACCEPT_OK | ACCEPT_REFUSED;
        in->tx = *tx;
    } else {
        l->unwritten += l->unconfirmed;
    }
    out_within(l, tx->born_ns + deadline_ns + 1);
    l->out_end += n;
    return true;
}

/* Whether this protocol has words for the frame, though the device may not know them. */
bool line_can_say(const struct line *l, const struct can_frame *frame)
{
    uint8_t words[CODEC_FRAME_MAX];
    return l->codec->encode[REMOTE_PLAIN](frame, words);
}

/* EINTR: again. EAGAIN: when epoll says so. Anything else: the port is gone. -> 0, or errno of a port that is gone */
int line_flush(struct line *l, int port)
{
    while (l->out_start < l->out_end) {
        ssize_t n = write(port, l->out + l->out_start, l->out_end - l->out_start);
        if (n < 0 && errno == EINTR)
            continue;
        if (n < 0 && errno != EAGAIN)
            return errno;
        if (n <= 0)
            return 0;
        l->out_start += (size_t)n;
    }
    l->out_start = l->out_end = 0;
    l->out_until_ns = NEVER;
    l->counters->unconfirmed += l->unwritten;
    l->unwritten = 0;
    return 0;
}

/* A message begun before this port was attached must be finished as soon as a command must be answered. */
void line_finish(struct line *l, int64_t now)
{
    if (l->out_until_ns == NEVER)
        l->out_until_ns = now + l->answer_timeout_ns;
}

/* --- answers --------------------------------------------------------------------------------- */

/* Takes the oldest out of flight. */
struct inflight line_take(struct line *l)
{
    struct inflight oldest = *line_at(l, 0);
    l->inflight_head = (l->inflight_head + 1) % INFLIGHT_MAX;
    l->inflight_count--;
    return oldest;
}

/* Makes the i-th oldest in flight the oldest. */
void line_bring_forward(struct line *l, uint32_t i)
{
    struct inflight moved = *line_at(l, i);
    for (; i; i--)
        l->inflight[(l->inflight_head + i) % INFLIGHT_MAX] = *line_at(l, i - 1);
    l->inflight[l->inflight_head] = moved;
}

/* The oldest frame in flight; inflight_count if there is none. */
uint32_t line_find_frame(const struct line *l)
{
    uint32_t i = 0;
    while (i < l->inflight_count && line_at(l, i)->kind != INFLIGHT_FRAME)
        i++;
    return i;
}

/* Which in flight this text answers: the oldest that asked for it; inflight_count if none. */
uint32_t line_find(struct line *l, const struct codec_message *text)
{
    uint32_t i = 0;
    for (; i < l->inflight_count; i++) {
        const struct inflight *in = line_at(l, i);
        if (in->prefix_length && text->length >= in->prefix_length
            && memcmp(in->prefix, text->text, in->prefix_length) == 0)
            break;
    }
    return i;
}

/* What answers it may be known only once the device has said who it is. */
void line_set_sync(struct line *l, const struct command *sync)
{
    l->sync = *sync;
}

/* The only command that does not wait for room in the window, so it looks for room in `out` itself. */
static int send_sync(struct line *l, int64_t now)
{
    if (!line_has_room(l))
        return ETIME;
    line_send_command(l, &l->sync, INFLIGHT_SYNC, now);
    return 0;
}

/* An answer is missing. -> 0; ETIME: the port takes nothing any more */
int line_resync(struct line *l, int64_t now)
{
    l->resyncing = true;
    l->sync_tries = 1;
    l->counters->resyncs++;
    events_emit(l->events, EVENT_UNANSWERED, (uint32_t)l->counters->resyncs, NULL, 0);
    return send_sync(l, now);
}

/* The sync command, the last in flight, is not answered in time. -> 0: sent again; ETIME as above;
 * ENODATA: it was sent often enough */
int line_sync_again(struct line *l, int64_t now)
{
    l->inflight_count--;
    return l->sync_tries++ < SYNC_TRIES ? send_sync(l, now) : ENODATA;
}

void line_synced(struct line *l)
{
    l->resyncing = false;
}

void line_fall_silent(struct line *l)
{
    l->resyncing = false;
    l->silent = true;
    events_emit(l->events, EVENT_SILENT, 0, NULL, 0);
}

/* When an answer is missing, or the port has been taking nothing for too long. */
int64_t line_deadline(const struct line *l)
{
    int64_t at = NEVER;
    if (l->inflight_count)
        at = line_at(l, l->resyncing ? l->inflight_count - 1 : 0)->deadline_ns;
    return l->out_until_ns < at ? l->out_until_ns : at;
}
