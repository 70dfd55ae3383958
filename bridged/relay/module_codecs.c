/* bridged._relay: the codecs for Python, as its tests use them. */
#include "module.h"

#include <string.h>

const struct codec *codec_by_name(const char *name)
{
    static const struct codec *const codecs[] = {&codec_can232, &codec_usb2can};
    for (size_t i = 0; i < sizeof codecs / sizeof codecs[0]; i++)
        if (strcmp(codecs[i]->name, name) == 0)
            return codecs[i];
    PyErr_Format(PyExc_ValueError, "no codec named '%s'", name);
    return NULL;
}

static PyObject *message_object(const struct codec_message *msg, const struct can_frame *frame)
{
    static const char *const kinds[] = {"idle", "frame", "ok",       "sent",    "refused", "text",
                                        "stop", "go",    "returned", "overrun", "skipped"};
    if (msg->kind == CODEC_FRAME || msg->kind == CODEC_RETURNED)
        return Py_BuildValue("(sy#i)", kinds[msg->kind], (const char *)frame, (Py_ssize_t)sizeof *frame,
                             msg->stamp_digits);
    if (msg->kind == CODEC_TEXT)
        return Py_BuildValue("(sy#i)", "text", (const char *)msg->text, (Py_ssize_t)msg->length, 0);
    return Py_BuildValue("(sy#i)", kinds[msg->kind], "", (Py_ssize_t)0, (int)msg->length);
}

/* decode(codec, pieces): the messages of a stream that arrives in these pieces. */
PyObject *module_decode(PyObject *Py_UNUSED(module), PyObject *args)
{
    const char *name;
    PyObject *pieces, *list = NULL;
    if (!PyArg_ParseTuple(args, "sO!:decode", &name, &PyList_Type, &pieces))
        return NULL;
    const struct codec *codec = codec_by_name(name);
    if (!codec || !(list = PyList_New(0)))
        return NULL;
    struct codec_state state = {0};
    uint8_t buffer[8192];
    size_t length = 0;
    for (Py_ssize_t i = 0; i < PyList_Size(pieces); i++) {
        char *bytes;
        Py_ssize_t n;
        if (PyBytes_AsStringAndSize(PyList_GetItem(pieces, i), &bytes, &n) < 0)
            goto failed;
        if ((size_t)n > sizeof buffer - length) {
            PyErr_SetString(PyExc_ValueError, "piece too long");
            goto failed;
        }
        memcpy(buffer + length, bytes, (size_t)n);
        length += (size_t)n;
        struct can_frame frame;
        struct codec_message msg;
        size_t at = 0, used;
        while (at < length && (used = codec->decode(&state, buffer + at, length - at, &frame, &msg))) {
            at += used;
            PyObject *item = message_object(&msg, &frame);
            int result = item ? PyList_Append(list, item) : -1;
            Py_XDECREF(item);
            if (result < 0)
                goto failed;
        }
        length -= at;
        memmove(buffer, buffer + at, length);
    }
    return list;
failed:
    Py_DECREF(list);
    return NULL;
}

/* encode(codec, frame): the bytes for one struct can_frame; empty if it cannot be said. */
PyObject *module_encode(PyObject *Py_UNUSED(module), PyObject *args)
{
    const char *name;
    Py_buffer data;
    PyObject *result = NULL;
    if (!PyArg_ParseTuple(args, "sy*:encode", &name, &data))
        return NULL;
    const struct codec *codec = codec_by_name(name);
    struct can_frame frame;
    if (codec && data.len == sizeof frame) {
        uint8_t out[CODEC_FRAME_MAX];
        memcpy(&frame, data.buf, sizeof frame);
        result = PyBytes_FromStringAndSize((const char *)out, (Py_ssize_t)codec->encode[REMOTE_PLAIN](&frame, out));
    } else if (codec) {
        PyErr_SetString(PyExc_ValueError, "a frame has the 16 bytes of struct can_frame");
    }
    PyBuffer_Release(&data);
    return result;
}
