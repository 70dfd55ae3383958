/* bridged._relay: the relay for Python. */
#include "module.h"

#include <assert.h>
#include <errno.h>
#include <string.h>
#include <unistd.h>

#include "clock.h"

#define NAME_AND_VALUE(name, ...) {#name, name},

static const struct {
    const char *name;
    long value;
} CONSTANTS[] = {
    {"GATE_AWAY", GATE_AWAY},
    {"GATE_OPEN", GATE_OPEN},
    {"GATE_LISTEN_ONLY", GATE_LISTEN_ONLY},
    {"GATE_STOPPED", GATE_STOPPED},
    {"ACCEPT_OK", ACCEPT_OK},
    {"ACCEPT_REFUSED", ACCEPT_REFUSED},
    EVENT_LIST(NAME_AND_VALUE)
    {"WINDOW_MAX", WINDOW_MAX},
};

enum { BITRATE_LEAST = 1000 };
enum { EVENTS_BATCH = 32 }; /* taken at once, with the lock */
static_assert(EVENTS_MAX % EVENTS_BATCH == 0, "events() returns EVENTS_MAX at most");

#define NAME_IN_PYTHON(name, python, ...) python,
static const char *const ANSWER_NAMES[] = {ANSWER_LIST(NAME_IN_PYTHON)};
static const char *const REMOTE_NAMES[] = {REMOTE_LIST(NAME_IN_PYTHON)};

struct module_state {
    PyTypeObject *tally_type;
};

typedef struct {
    PyObject_HEAD
    struct relay *relay;
} RelayObject;

static struct relay *self_relay(PyObject *self)
{
    return ((RelayObject *)self)->relay;
}

static PyObject *raise_errno(int error)
{
    errno = error;
    return PyErr_SetFromErrno(PyExc_OSError);
}

/* For "O&": PyArg_ParseTuple's own "I" takes 2**32 + 1 for 1. */
static int uint32_from(PyObject *number, void *out)
{
    unsigned long long value = PyLong_AsUnsignedLongLong(number);
    if (PyErr_Occurred())
        return 0;
    if (value > UINT32_MAX) {
        PyErr_SetString(PyExc_OverflowError, "a number is 0 to 2**32 - 1");
        return 0;
    }
    *(uint32_t *)out = (uint32_t)value;
    return 1;
}

static int64_t seconds_to_ns(double seconds)
{
    return (int64_t)(seconds * (double)NS_PER_S);
}

/* Also false for NaN. */
static bool seconds_valid(double seconds)
{
    return seconds >= 1e-9 && seconds < 1e6;
}

/* Fills a command; prefix is how the text that answers begins, empty if none does. */
static int command_init(struct command *c, const Py_buffer *data, int accept, const Py_buffer *prefix)
{
    if (accept & ~(ACCEPT_OK | ACCEPT_REFUSED)) {
        PyErr_SetString(PyExc_ValueError, "accept is a sum of ACCEPT_ constants");
        return -1;
    }
    if (data->len < 1 || data->len > COMMAND_SIZE) {
        PyErr_Format(PyExc_ValueError, "a command has 1 to %d bytes, not %zd", COMMAND_SIZE, data->len);
        return -1;
    }
    if (prefix->len > PREFIX_MAX) {
        PyErr_Format(PyExc_ValueError, "a prefix has up to %d bytes, not %zd", PREFIX_MAX, prefix->len);
        return -1;
    }
    *c = (struct command){
        .accept = (uint8_t)accept, .prefix_length = (uint8_t)prefix->len, .length = (uint8_t)data->len};
    memcpy(c->prefix, prefix->buf, (size_t)prefix->len);
    memcpy(c->data, data->buf, (size_t)data->len);
    return 0;
}

/* Settings of the queue as Python gives them. -> 0, or -1 with an exception */
static int queue_settings_from(struct queue_settings *set, uint32_t size, double deadline, double stuck)
{
    if (size < 1 || size > QUEUE_MAX || !seconds_valid(deadline) || !seconds_valid(stuck)) {
        PyErr_Format(PyExc_ValueError, "queue is 1 to %d, deadline and stuck are seconds, more than 0", QUEUE_MAX);
        return -1;
    }
    *set = (struct queue_settings){size, seconds_to_ns(deadline), seconds_to_ns(stuck)};
    return 0;
}

static int settings_check(const struct settings *s, double answer_timeout)
{
    if (s->window < 1 || s->window > WINDOW_MAX) {
        PyErr_Format(PyExc_ValueError, "window is 1 to %d", WINDOW_MAX);
        return -1;
    }
    if (!seconds_valid(answer_timeout)) {
        PyErr_SetString(PyExc_ValueError, "answer_timeout is seconds, more than 0");
        return -1;
    }
    return 0;
}

static PyObject *Relay_new(PyTypeObject *type, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"codec", "queue", "window", "deadline", "stuck", "answer_timeout", "sync", "sync_prefix",
                            NULL};
    struct settings set = {0};
    const char *codec;
    uint32_t queue;
    double deadline, stuck, answer_timeout;
    Py_buffer sync, prefix;
    RelayObject *self = NULL;

    if (!PyArg_ParseTupleAndKeywords(args, kwargs, "s$O&O&dddy*y*:Relay", names, &codec, uint32_from, &queue,
                                     uint32_from, &set.window, &deadline, &stuck, &answer_timeout, &sync, &prefix))
        return NULL;
    set.codec = codec_by_name(codec);
    if (!set.codec || queue_settings_from(&set.queue, queue, deadline, stuck) < 0
        || settings_check(&set, answer_timeout) < 0 || command_init(&set.sync, &sync, 0, &prefix) < 0)
        goto done;
    set.answer_timeout_ns = seconds_to_ns(answer_timeout);
    allocfunc alloc = (allocfunc)PyType_GetSlot(type, Py_tp_alloc);
    self = (RelayObject *)alloc(type, 0);
    if (self && !(self->relay = relay_new(&set))) {
        PyErr_SetFromErrno(PyExc_OSError);
        Py_CLEAR(self);
    }
done:
    PyBuffer_Release(&sync);
    PyBuffer_Release(&prefix);
    return (PyObject *)self;
}

static void Relay_dealloc(PyObject *self)
{
    PyTypeObject *type = Py_TYPE(self);
    freefunc release = (freefunc)PyType_GetSlot(type, Py_tp_free);
    if (self_relay(self))
        relay_free(self_relay(self));
    release(self);
    Py_DECREF(type);
}

static PyObject *Relay_run(PyObject *self, PyObject *Py_UNUSED(ignored))
{
    int error;
    Py_BEGIN_ALLOW_THREADS
    error = relay_run(self_relay(self));
    Py_END_ALLOW_THREADS
    if (error)
        return raise_errno(error);
    Py_RETURN_NONE;
}

/* A time of the tests' clocks: what the relay adds to it, below 1e6 s, must not overset. */
static int clock_from(PyObject *number, void *ns)
{
    int64_t value = PyLong_AsLongLong(number);
    if (value == -1 && PyErr_Occurred())
        return 0;
    if (value < 0 || value > INT64_C(1) << 62) {
        PyErr_SetString(PyExc_ValueError, "a time is 0 to 2**62 ns");
        return 0;
    }
    *(int64_t *)ns = value;
    return 1;
}

static PyObject *Relay_turn(PyObject *self, PyObject *args)
{
    struct moment at = {0};
    if (!PyArg_ParseTuple(args, "O&|O&:turn", clock_from, &at.boot_ns, clock_from, &at.wall_ns))
        return NULL;
    int64_t next = relay_turn(self_relay(self), at);
    if (next == NEVER)
        Py_RETURN_NONE;
    return PyLong_FromLongLong(next);
}

static PyObject *Relay_stop(PyObject *self, PyObject *Py_UNUSED(ignored))
{
    relay_stop(self_relay(self));
    Py_RETURN_NONE;
}

static PyObject *Relay_wake(PyObject *self, PyObject *Py_UNUSED(ignored))
{
    relay_wake(self_relay(self));
    Py_RETURN_NONE;
}

static PyObject *Relay_fileno(PyObject *self, PyObject *Py_UNUSED(ignored))
{
    return PyLong_FromLong(relay_event_fd(self_relay(self)));
}

static PyObject *Relay_attach_port(PyObject *self, PyObject *arg)
{
    int fd = PyObject_AsFileDescriptor(arg);
    if (fd < 0)
        return NULL;
    int error = relay_attach_port(self_relay(self), fd);
    if (error)
        return raise_errno(error);
    Py_RETURN_NONE;
}

static PyObject *Relay_detach_port(PyObject *self, PyObject *Py_UNUSED(ignored))
{
    relay_detach_port(self_relay(self));
    Py_RETURN_NONE;
}

static PyObject *Relay_cut(PyObject *self, PyObject *Py_UNUSED(ignored))
{
    const struct cut cut = relay_cut(self_relay(self));
    return Py_BuildValue("(Ny#n)", PyBool_FromLong(cut.unread), (const char *)cut.message, (Py_ssize_t)cut.length,
                         (Py_ssize_t)cut.taken);
}

static PyObject *Relay_resume(PyObject *self, PyObject *args)
{
    struct cut cut = {0};
    Py_buffer message;
    Py_ssize_t taken;
    if (!PyArg_ParseTuple(args, "y*n:resume", &message, &taken))
        return NULL;
    bool valid = message.len <= COMMAND_SIZE && taken > 0 && taken < message.len;
    if (valid) {
        cut.length = (size_t)message.len;
        cut.taken = (size_t)taken;
        memcpy(cut.message, message.buf, cut.length);
    }
    PyBuffer_Release(&message);
    if (!valid) {
        PyErr_SetString(PyExc_ValueError, "resume takes what cut() gave, of which a part was taken");
        return NULL;
    }
    relay_resume(self_relay(self), &cut);
    Py_RETURN_NONE;
}

static PyObject *Relay_last_words(PyObject *self, PyObject *arg)
{
    Py_buffer words;
    if (PyObject_GetBuffer(arg, &words, PyBUF_SIMPLE) < 0)
        return NULL;
    relay_last_words(self_relay(self), words.buf, (size_t)words.len);
    PyBuffer_Release(&words);
    Py_RETURN_NONE;
}

static PyObject *Relay_attach_interface(PyObject *self, PyObject *arg)
{
    int fd = PyObject_AsFileDescriptor(arg);
    if (fd < 0)
        return NULL;
    int error = relay_attach_interface(self_relay(self), fd);
    if (error)
        return raise_errno(error);
    Py_RETURN_NONE;
}

static PyObject *Relay_detach_interface(PyObject *self, PyObject *Py_UNUSED(ignored))
{
    relay_detach_interface(self_relay(self));
    Py_RETURN_NONE;
}

static PyObject *Relay_hold_interface(PyObject *self, PyObject *arg)
{
    int held = PyObject_IsTrue(arg);
    if (held < 0)
        return NULL;
    relay_hold_interface(self_relay(self), held);
    Py_RETURN_NONE;
}

static PyObject *Relay_set_gates(PyObject *self, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"receiving", "transmit", NULL};
    int receiving, gate;
    if (!PyArg_ParseTupleAndKeywords(args, kwargs, "$pi:set_gates", names, &receiving, &gate))
        return NULL;
    if (gate < 0 || gate >= GATES) {
        PyErr_SetString(PyExc_ValueError, "transmit is one of the GATE_ constants");
        return NULL;
    }
    relay_set_gates(self_relay(self), receiving, (enum gate)gate);
    Py_RETURN_NONE;
}

static PyObject *Relay_set_queue(PyObject *self, PyObject *args)
{
    struct queue_settings set;
    uint32_t size;
    double deadline, stuck;
    if (!PyArg_ParseTuple(args, "O&dd:set_queue", uint32_from, &size, &deadline, &stuck)
        || queue_settings_from(&set, size, deadline, stuck) < 0)
        return NULL;
    if (relay_set_queue(self_relay(self), &set))
        return PyErr_NoMemory();
    Py_RETURN_NONE;
}

static PyObject *Relay_set_sync(PyObject *self, PyObject *args)
{
    struct command c;
    Py_buffer data, prefix;
    if (!PyArg_ParseTuple(args, "y*y*:set_sync", &data, &prefix))
        return NULL;
    int result = command_init(&c, &data, 0, &prefix);
    PyBuffer_Release(&data);
    PyBuffer_Release(&prefix);
    if (result < 0)
        return NULL;
    relay_set_sync(self_relay(self), &c);
    Py_RETURN_NONE;
}

static PyObject *Relay_set_polling(PyObject *self, PyObject *args)
{
    struct command c;
    Py_buffer data, prefix;
    double interval;
    if (!PyArg_ParseTuple(args, "y*y*d:set_polling", &data, &prefix, &interval))
        return NULL;
    int result = command_init(&c, &data, ACCEPT_REFUSED, &prefix);
    if (!result && !seconds_valid(interval)) {
        PyErr_SetString(PyExc_ValueError, "interval is seconds, more than 0");
        result = -1;
    }
    PyBuffer_Release(&data);
    PyBuffer_Release(&prefix);
    if (result < 0)
        return NULL;
    relay_set_polling(self_relay(self), &c, seconds_to_ns(interval));
    Py_RETURN_NONE;
}

/* The place of `name` in the list, or -1 with ValueError. */
static int name_find(const char *const *list, int n, const char *what, const char *name)
{
    for (int i = 0; i < n; i++)
        if (strcmp(list[i], name) == 0)
            return i;
    PyErr_Format(PyExc_ValueError, "no %s is named '%s'", what, name);
    return -1;
}

static PyObject *Relay_set_sending(PyObject *self, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"", "", "window", "bitrate", "depth", "retries", "long_stamps", NULL};
    struct sending_settings set = {0};
    const char *answer_name, *remote_name;
    int retries, long_stamps;
    if (!PyArg_ParseTupleAndKeywords(args, kwargs, "ss$O&O&O&pp:set_sending", names, &answer_name, &remote_name,
                                     uint32_from, &set.window, uint32_from, &set.bitrate, uint32_from, &set.depth,
                                     &retries, &long_stamps))
        return NULL;
    int answer = name_find(ANSWER_NAMES, ANSWERS, "confirmation", answer_name);
    int remote = answer < 0 ? -1 : name_find(REMOTE_NAMES, REMOTES, "way to send remote frames", remote_name);
    if (remote < 0)
        return NULL;
    if (set.window > WINDOW_MAX) {
        PyErr_Format(PyExc_ValueError, "window is 1 to %d, or 0 for what the relay was made with", WINDOW_MAX);
        return NULL;
    }
    if (set.bitrate && (set.bitrate < BITRATE_LEAST || set.depth < 1 || set.depth > DEPTH_MAX)) {
        PyErr_Format(PyExc_ValueError, "a bit rate is %d bit/s or more, depth 1 to %d", BITRATE_LEAST, DEPTH_MAX);
        return NULL;
    }
    if (answer == ANSWER_NONE && !set.bitrate) {
        PyErr_SetString(PyExc_ValueError, "frames that are not answered go by the bit rate");
        return NULL;
    }
    set.answer = (enum answer)answer;
    set.retries = retries;
    set.long_stamps = long_stamps;
    set.remote = (enum remote)remote;
    relay_set_sending(self_relay(self), &set);
    Py_RETURN_NONE;
}

static PyObject *Relay_count_late(PyObject *self, PyObject *arg)
{
    uint32_t kept;
    if (!uint32_from(arg, &kept))
        return NULL;
    relay_count_late(self_relay(self), kept);
    Py_RETURN_NONE;
}

static PyObject *Relay_set_level_window(PyObject *self, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"ask", "prefix", "capacity", "critical", "ready", NULL};
    struct level_settings set = {0};
    Py_buffer ask, prefix;
    if (!PyArg_ParseTupleAndKeywords(args, kwargs, "y*y*$O&O&O&:set_level_window", names, &ask, &prefix, uint32_from,
                                     &set.capacity, uint32_from, &set.critical, uint32_from, &set.ready))
        return NULL;
    int result = command_init(&set.ask, &ask, 0, &prefix);
    if (!result && (set.capacity < 1 || set.capacity > UINT8_MAX || set.critical > set.capacity
                    || set.ready >= set.critical)) {
        PyErr_SetString(PyExc_ValueError, "ready < critical <= capacity <= 255 is wanted");
        result = -1;
    }
    PyBuffer_Release(&ask);
    PyBuffer_Release(&prefix);
    if (result < 0)
        return NULL;
    relay_set_level_window(self_relay(self), &set);
    Py_RETURN_NONE;
}

static PyObject *Relay_command(PyObject *self, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"token", "data", "accept", "prefix", "timeout", "more", NULL};
    struct command c;
    uint32_t token;
    Py_buffer data, prefix;
    int accept;
    double timeout;
    int more = 0;
    if (!PyArg_ParseTupleAndKeywords(args, kwargs, "O&y*iy*d|$p:command", names, uint32_from, &token, &data,
                                     &accept, &prefix, &timeout, &more))
        return NULL;
    int result = command_init(&c, &data, accept, &prefix);
    if (!result && !seconds_valid(timeout)) {
        PyErr_SetString(PyExc_ValueError, "timeout is seconds, more than 0");
        result = -1;
    }
    PyBuffer_Release(&data);
    PyBuffer_Release(&prefix);
    if (result < 0)
        return NULL;
    c.token = token;
    c.timeout_ns = seconds_to_ns(timeout);
    relay_command(self_relay(self), &c, more);
    Py_RETURN_NONE;
}

static PyObject *event_object(const struct event *e)
{
    return Py_BuildValue("(iIy#)", e->kind, e->token, (const char *)e->text, (Py_ssize_t)e->length);
}

/* At most EVENTS_MAX, or a flood would keep the caller here. They are all that there were when the eventfd was reset;
 * what has come since made it readable again. */
static PyObject *Relay_events(PyObject *self, PyObject *Py_UNUSED(ignored))
{
    struct event batch[EVENTS_BATCH];
    PyObject *list = PyList_New(0);
    if (!list)
        return NULL;
    uint64_t value;
    ssize_t ignored = read(relay_event_fd(self_relay(self)), &value, sizeof value);
    (void)ignored;
    for (uint32_t taken = 0, n = EVENTS_BATCH; n == EVENTS_BATCH && taken < EVENTS_MAX; taken += n) {
        n = relay_take_events(self_relay(self), batch, EVENTS_BATCH);
        for (uint32_t i = 0; i < n; i++) {
            PyObject *item = event_object(&batch[i]);
            int result = item ? PyList_Append(list, item) : -1;
            Py_XDECREF(item);
            if (result < 0) {
                Py_DECREF(list);
                return NULL;
            }
        }
    }
    return list;
}

static PyObject *Relay_counters(PyObject *self, PyObject *Py_UNUSED(ignored))
{
    struct snapshot now;
    relay_snapshot(self_relay(self), &now);
    return counters_dict(&now);
}

static PyObject *Relay_glimpse(PyObject *self, PyObject *Py_UNUSED(ignored))
{
    struct can_frame from, to;
    relay_glimpse(self_relay(self), &from, &to);
    return Py_BuildValue("y#y#", (const char *)&from, (Py_ssize_t)sizeof from, (const char *)&to,
                         (Py_ssize_t)sizeof to);
}

static PyObject *Relay_tally(PyObject *self, PyObject *Py_UNUSED(ignored))
{
    struct snapshot now;
    relay_snapshot(self_relay(self), &now);
    const struct module_state *state = PyType_GetModuleState(Py_TYPE(self));
    return tally_object(state->tally_type, &now.counters);
}

static PyMethodDef RELAY_METHODS[] = {
    {"run", Relay_run, METH_NOARGS, NULL},
    {"turn", Relay_turn, METH_VARARGS, NULL},
    {"stop", Relay_stop, METH_NOARGS, NULL},
    {"wake", Relay_wake, METH_NOARGS, NULL},
    {"fileno", Relay_fileno, METH_NOARGS, NULL},
    {"attach_port", Relay_attach_port, METH_O, NULL},
    {"detach_port", Relay_detach_port, METH_NOARGS, NULL},
    {"cut", Relay_cut, METH_NOARGS, NULL},
    {"resume", Relay_resume, METH_VARARGS, NULL},
    {"last_words", Relay_last_words, METH_O, NULL},
    {"attach_interface", Relay_attach_interface, METH_O, NULL},
    {"detach_interface", Relay_detach_interface, METH_NOARGS, NULL},
    {"hold_interface", Relay_hold_interface, METH_O, NULL},
    {"set_gates", (PyCFunction)(void (*)(void))Relay_set_gates, METH_VARARGS | METH_KEYWORDS, NULL},
    {"set_queue", Relay_set_queue, METH_VARARGS, NULL},
    {"set_sync", Relay_set_sync, METH_VARARGS, NULL},
    {"set_polling", Relay_set_polling, METH_VARARGS, NULL},
    {"set_sending", (PyCFunction)(void (*)(void))Relay_set_sending, METH_VARARGS | METH_KEYWORDS, NULL},
    {"count_late", Relay_count_late, METH_O, NULL},
    {"set_level_window", (PyCFunction)(void (*)(void))Relay_set_level_window, METH_VARARGS | METH_KEYWORDS, NULL},
    {"command", (PyCFunction)(void (*)(void))Relay_command, METH_VARARGS | METH_KEYWORDS, NULL},
    {"events", Relay_events, METH_NOARGS, NULL},
    {"counters", Relay_counters, METH_NOARGS, NULL},
    {"tally", Relay_tally, METH_NOARGS, NULL},
    {"glimpse", Relay_glimpse, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyType_Slot RELAY_SLOTS[] = {
    {Py_tp_doc, "Relay of frames between a port and an interface; see _relay.pyi."},
    {Py_tp_new, Relay_new},
    {Py_tp_dealloc, Relay_dealloc},
    {Py_tp_methods, RELAY_METHODS},
    {0, NULL},
};

static PyType_Spec RELAY_SPEC = {
    .name = "bridged._relay.Relay",
    .basicsize = sizeof(RelayObject),
    .flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    .slots = RELAY_SLOTS,
};

static PyObject *module_clock(PyObject *Py_UNUSED(module), PyObject *Py_UNUSED(ignored))
{
    return PyLong_FromLongLong(clock_now_ns());
}

static PyMethodDef MODULE_METHODS[] = {
    {"decode", module_decode, METH_VARARGS, NULL},
    {"encode", module_encode, METH_VARARGS, NULL},
    {"clock", module_clock, METH_NOARGS, NULL},
    {"meanings", module_meanings, METH_NOARGS, NULL},
    {NULL, NULL, 0, NULL},
};

/* Takes the reference to `object`, which may be NULL with an exception. */
static int add_object(PyObject *module, const char *name, PyObject *object)
{
    int result = object ? PyModule_AddObjectRef(module, name, object) : -1;
    Py_XDECREF(object);
    return result;
}

static int module_exec(PyObject *module)
{
    struct module_state *state = PyModule_GetState(module);
    state->tally_type = tally_type();
    int result = add_object(module, "Tally", Py_XNewRef((PyObject *)state->tally_type));
    if (result == 0)
        result = add_object(module, "Relay", PyType_FromModuleAndSpec(module, &RELAY_SPEC, NULL));
    for (size_t i = 0; result == 0 && i < sizeof CONSTANTS / sizeof CONSTANTS[0]; i++)
        result = PyModule_AddIntConstant(module, CONSTANTS[i].name, CONSTANTS[i].value);
    return result;
}

static int module_traverse(PyObject *module, visitproc visit, void *arg)
{
    const struct module_state *state = PyModule_GetState(module);
    Py_VISIT(state->tally_type);
    return 0;
}

static int module_clear(PyObject *module)
{
    struct module_state *state = PyModule_GetState(module);
    Py_CLEAR(state->tally_type);
    return 0;
}

static void module_free(void *module)
{
    module_clear(module);
}

static PyModuleDef_Slot MODULE_SLOTS[] = {{Py_mod_exec, (void *)module_exec}, {0, NULL}};

static struct PyModuleDef MODULE = {
    PyModuleDef_HEAD_INIT,
    .m_name = "bridged._relay",
    .m_doc = "The data plane of can-bridge.",
    .m_size = sizeof(struct module_state),
    .m_methods = MODULE_METHODS,
    .m_slots = MODULE_SLOTS,
    .m_traverse = module_traverse,
    .m_clear = module_clear,
    .m_free = module_free,
};

PyMODINIT_FUNC PyInit__relay(void)
{
    return PyModuleDef_Init(&MODULE);
}
