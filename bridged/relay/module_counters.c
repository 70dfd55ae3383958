/* The relay's counters as a dict. */
#include "module.h"

static const char *const TX_DROP_NAMES[TX_DROPS] = {
    "error-frame", "fd-frame", "malformed", "queue-full", "stale", "refused",
    "overtaken", "unanswered", "adapter-away", "listen-only", "stopped"};
static const char *const RX_DROP_NAMES[RX_DROPS] = {"not-running", "bus-queue-full", "bus-down", "bus-lost"};

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

PyObject *counters_dict(const struct counters *c, uint64_t queued, uint64_t pending)
{
    const struct {
        const char *name;
        uint64_t value;
    } plain[] = {
        {"bus_read", c->bus_read},
        {"tx_frames", c->confirmed},
        {"tx_retries", c->retries},
        {"tx_returned", c->returned},
        {"tx_stops", c->stops},
        {"queued", queued},
        {"decoded", c->decoded},
        {"rx_frames", c->delivered},
        {"rx_pending", pending},
        {"rx_overruns", c->overruns},
        {"rx_stamped", c->stamped},
        {"skipped_messages", c->skipped_messages},
        {"skipped_bytes", c->skipped_bytes},
        {"stray_answers", c->stray_answers},
        {"resyncs", c->resyncs},
        {"events_lost", c->events_lost},
        {"turns", c->turns},
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
