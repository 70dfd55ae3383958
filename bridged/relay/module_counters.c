/* The relay's counters as a dict, some of them as a tuple with names, and what the names in counters.h mean. */
#include "module.h"

#include <stddef.h>
#include <string.h>

#define NAME_IN_PYTHON(name, python, meaning) python,
static const char *const TX_DROP_NAMES[] = {TX_DROP_LIST(NAME_IN_PYTHON)};
static const char *const RX_DROP_NAMES[] = {RX_DROP_LIST(NAME_IN_PYTHON)};

static int dict_set(PyObject *dict, const char *name, uint64_t value)
{
    PyObject *number = PyLong_FromUnsignedLongLong(value);
    int result = number ? PyDict_SetItemString(dict, name, number) : -1;
    Py_XDECREF(number);
    return result;
}

static PyObject *reasons_dict(const char *const *names, const uint64_t *values, size_t n)
{
    PyObject *dict = PyDict_New();
    for (size_t i = 0; dict && i < n; i++)
        if (dict_set(dict, names[i], values[i]) < 0)
            Py_CLEAR(dict);
    return dict;
}

#define NAME_AND_VALUE(field, python, meaning) {python, c->field},

PyObject *counters_dict(const struct snapshot *s)
{
    const struct counters *c = &s->counters;
    const struct {
        const char *name;
        uint64_t value;
    } plain[] = {
        COUNTER_LIST(NAME_AND_VALUE)
        {"queued", s->queued},
        {"rx_pending", s->pending},
    };
    PyObject *dict = PyDict_New();
    for (size_t i = 0; dict && i < sizeof plain / sizeof plain[0]; i++)
        if (dict_set(dict, plain[i].name, plain[i].value) < 0)
            Py_CLEAR(dict);
    PyObject *tx = reasons_dict(TX_DROP_NAMES, c->tx_dropped, TX_DROPS);
    PyObject *rx = reasons_dict(RX_DROP_NAMES, c->rx_dropped, RX_DROPS);
    if (!dict || !tx || !rx || PyDict_SetItemString(dict, "tx_dropped", tx) < 0
        || PyDict_SetItemString(dict, "rx_dropped", rx) < 0)
        Py_CLEAR(dict);
    Py_XDECREF(tx);
    Py_XDECREF(rx);
    return dict;
}

/* The counters that are looked at often; their order is nobody's affair but this list's. */
static const struct {
    const char *name;
    size_t field;
} TALLY[] = {
    {"decoded", offsetof(struct counters, decoded)},
    {"rx_frames", offsetof(struct counters, delivered)},
    {"tx_frames", offsetof(struct counters, confirmed)},
    {"tx_queued", offsetof(struct counters, buffered)},
    {"tx_unconfirmed", offsetof(struct counters, unconfirmed)},
    {"rx_overruns", offsetof(struct counters, overruns)},
    {"skipped_bytes", offsetof(struct counters, skipped_bytes)},
};

enum { TALLY_SIZE = sizeof TALLY / sizeof TALLY[0] };

PyTypeObject *tally_type(void)
{
    PyStructSequence_Field fields[TALLY_SIZE + 1] = {0};
    for (size_t i = 0; i < TALLY_SIZE; i++)
        fields[i].name = TALLY[i].name;
    PyStructSequence_Desc description = {
        .name = "bridged._relay.Tally",
        .doc = "Some of the relay's counters, for frequent looks.",
        .fields = fields,
        .n_in_sequence = TALLY_SIZE,
    };
    return PyStructSequence_NewType(&description);
}

PyObject *tally_object(PyTypeObject *type, const struct counters *c)
{
    PyObject *tally = PyStructSequence_New(type);
    for (size_t i = 0; tally && i < TALLY_SIZE; i++) {
        uint64_t value;
        memcpy(&value, (const char *)c + TALLY[i].field, sizeof value);
        PyObject *number = PyLong_FromUnsignedLongLong(value);
        if (number)
            PyStructSequence_SetItem(tally, (Py_ssize_t)i, number);
        else
            Py_CLEAR(tally);
    }
    return tally;
}

#define NAME_AND_MEANING(name, python, meaning) {python, meaning},
#define EVENT_AND_MEANING(name, meaning) {#name, meaning},

struct meaning {
    const char *name, *text;
};

static const struct meaning TX_DROP_MEANINGS[] = {TX_DROP_LIST(NAME_AND_MEANING) {0}};
static const struct meaning RX_DROP_MEANINGS[] = {RX_DROP_LIST(NAME_AND_MEANING) {0}};
static const struct meaning EVENT_MEANINGS[] = {EVENT_LIST(EVENT_AND_MEANING) {0}};
static const struct meaning COUNTER_MEANINGS[] = {COUNTER_LIST(NAME_AND_MEANING) {0}};

static int add_meanings(PyObject *all, const char *key, const struct meaning *m)
{
    PyObject *dict = PyDict_New();
    int result = dict ? 0 : -1;
    for (; !result && m->name; m++) {
        PyObject *text = PyUnicode_FromString(m->text);
        result = text ? PyDict_SetItemString(dict, m->name, text) : -1;
        Py_XDECREF(text);
    }
    if (!result)
        result = PyDict_SetItemString(all, key, dict);
    Py_XDECREF(dict);
    return result;
}

PyObject *module_meanings(PyObject *Py_UNUSED(module), PyObject *Py_UNUSED(ignored))
{
    PyObject *all = PyDict_New();
    if (all
        && (add_meanings(all, "counters", COUNTER_MEANINGS) < 0 || add_meanings(all, "events", EVENT_MEANINGS) < 0
            || add_meanings(all, "rx_dropped", RX_DROP_MEANINGS) < 0
            || add_meanings(all, "tx_dropped", TX_DROP_MEANINGS) < 0))
        Py_CLEAR(all);
    return all;
}
