/* Throughput of the codecs on one core: million messages a second, the best of a few rounds. */
#define _POSIX_C_SOURCE 200809L /* clock_gettime */
#include "../../bridged/relay/codec.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { FRAMES = 4096, PASSES = 200, ROUNDS = 7, LINE_ROOM = 40 };

static uint8_t wire[FRAMES * LINE_ROOM];
static struct can_frame frames[FRAMES];

static double now_s(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + (double)now.tv_nsec * 1e-9;
}

/* Encodes all frames one after the other; returns the bytes that they take. */
static size_t encode_all(const struct codec *codec)
{
    size_t n = 0;
    for (size_t i = 0; i < FRAMES; i++)
        n += codec->encode[REMOTE_PLAIN](&frames[i], wire + n);
    return n;
}

/* Returns how many messages of the kind are in the wire's first n bytes. */
static size_t decode_all(const struct codec *codec, size_t n, enum codec_kind kind)
{
    struct codec_state state = {0};
    struct codec_message msg;
    size_t at = 0, taken = 0, found = 0;

    while ((taken = codec->decode(&state, wire + at, n - at, &frames[found % FRAMES], &msg)) > 0) {
        at += taken;
        found += msg.kind == kind;
    }
    return found;
}

static void frames_fill(canid_t flags, uint8_t len)
{
    for (size_t i = 0; i < FRAMES; i++) {
        frames[i] = (struct can_frame){.can_id = (canid_t)(i & CAN_SFF_MASK) | flags, .len = len};
        for (size_t k = 0; k < len; k++)
            frames[i].data[k] = (uint8_t)(i * 31 + k * 17);
    }
}

/* The wire filled with one message again and again; returns its bytes. */
static size_t wire_fill(const char *message, size_t length)
{
    for (size_t i = 0; i < FRAMES; i++)
        memcpy(wire + i * length, message, length);
    return FRAMES * length;
}

#define WIRE_FILL(message) wire_fill(message, sizeof(message) - 1)

/* What the host sends to a USB2CAN is WRITE_MESSAGE; what comes back is READ_MESSAGE. */
static size_t wire_receive(const struct codec *codec, size_t n)
{
    if (codec == &codec_usb2can)
        for (size_t at = 0; at < n; at += 3 + (size_t)wire[at + 2])
            wire[at + 1]++;
    return n;
}

static void bench_encode(const struct codec *codec, const char *name)
{
    double best_s = 1e9;
    for (int round = 0; round < ROUNDS; round++) {
        double start_s = now_s();
        for (int pass = 0; pass < PASSES; pass++)
            if (encode_all(codec) == 0)
                abort();
        double took_s = now_s() - start_s;
        best_s = took_s < best_s ? took_s : best_s;
    }
    printf("%s encode %-28s %7.1f M/s\n", codec->name, name, FRAMES * (double)PASSES / best_s / 1e6);
}

static void bench_decode(const struct codec *codec, const char *name, size_t n, enum codec_kind kind)
{
    double best_s = 1e9;
    for (int round = 0; round < ROUNDS; round++) {
        double start_s = now_s();
        for (int pass = 0; pass < PASSES; pass++)
            if (decode_all(codec, n, kind) != FRAMES)
                abort();
        double took_s = now_s() - start_s;
        best_s = took_s < best_s ? took_s : best_s;
    }
    printf("%s decode %-28s %7.1f M/s\n", codec->name, name, FRAMES * (double)PASSES / best_s / 1e6);
}

static void bench_frames(const struct codec *codec, const char *name, canid_t flags, uint8_t len)
{
    frames_fill(flags, len);
    bench_encode(codec, name);
    bench_decode(codec, name, wire_receive(codec, encode_all(codec)), CODEC_FRAME);
}

static void bench_codec(const struct codec *codec)
{
    bench_frames(codec, "standard, 8 bytes", 0, 8);
    bench_frames(codec, "extended, 8 bytes", CAN_EFF_FLAG, 8);
    bench_frames(codec, "standard, no data", 0, 0);
    bench_frames(codec, "standard, remote", CAN_RTR_FLAG, 8);
}

int main(void)
{
    bench_codec(&codec_can232);
    bench_decode(&codec_can232, "standard, 8 bytes, stamp", WIRE_FILL("t12380123456789ABCDEFEA5F\r"), CODEC_FRAME);
    bench_decode(&codec_can232, "z", WIRE_FILL("z\r"), CODEC_SENT);
    bench_decode(&codec_can232, "F00", WIRE_FILL("F00\r"), CODEC_TEXT);
    bench_decode(&codec_can232, "no frame, 22 characters", WIRE_FILL("t12380123456789ABCDEG\r"), CODEC_SKIPPED);

    bench_codec(&codec_usb2can);
    bench_decode(&codec_usb2can, "standard, 8 bytes, stamp",
                 WIRE_FILL("\x0F\x3F\x0D\x08\x24\x60" "\1\2\3\4\5\6\7\x0F\x9F\x0F"), CODEC_FRAME);
    bench_decode(&codec_usb2can, "WRITE_REG", WIRE_FILL("\x0F\x12\x01\x06"), CODEC_TEXT);
    bench_decode(&codec_usb2can, "a byte lost, look-back", WIRE_FILL("\x0F\x41\x04\x01\x24\x60" "\x0F\x12\x01\x06"),
                 CODEC_FRAME);
    bench_decode(&codec_usb2can, "no message, 14 bytes",
                 WIRE_FILL("\x0F\x41\x0B\x07\x24\x60" "\1\2\3\4\5\6\7\x08"), CODEC_SKIPPED);
    return EXIT_SUCCESS;
}
