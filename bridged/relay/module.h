/* Shared by the files that know Python. */
#ifndef CAN_BRIDGE_MODULE_H
#define CAN_BRIDGE_MODULE_H

#define PY_SSIZE_T_CLEAN
#include <Python.h>

#include "relay.h"

const struct codec *codec_by_name(const char *name); /* NULL with ValueError */
PyObject *module_decode(PyObject *module, PyObject *args);
PyObject *module_encode(PyObject *module, PyObject *args);
PyObject *module_meanings(PyObject *module, PyObject *ignored);
PyObject *counters_dict(const struct snapshot *s);
PyTypeObject *tally_type(void); /* a new reference */
PyObject *tally_object(PyTypeObject *type, const struct counters *c);

#endif
