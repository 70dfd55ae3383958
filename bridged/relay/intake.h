/* From the interface to the queue: frames are read in batches, with the time when each was born. */
#ifndef CAN_BRIDGE_INTAKE_H
#define CAN_BRIDGE_INTAKE_H

#include <linux/can.h>
#include <sys/socket.h>
#include <sys/uio.h>

#include "events.h"
#include "queue.h"

enum { INTAKE_BATCH = 64 }; /* frames per recvmmsg */
enum { INTAKE_END = -1 };   /* in place of errno: the other end of a socketpair is closed */

struct intake {
    struct counters *counters;
    struct events *events;
    struct queue *queue;
    struct moment empty; /* no frame from before it is in the socket any more; boot_ns 0: not known */
    struct intake_message {
        union {
            struct can_frame classic;
            struct canfd_frame fd;
        } frame;
        union {
            struct cmsghdr align;
            uint8_t bytes[128];
        } control;
    } message[INTAKE_BATCH];
    struct mmsghdr msg[INTAKE_BATCH];
    struct iovec iov[INTAKE_BATCH];
};

void intake_init(struct intake *in, struct queue *queue, struct events *events);
void intake_attach(struct intake *in, struct moment now);
void intake_seen_empty(struct intake *in, struct moment at);
int intake_read(struct intake *in, int interface, struct moment turn, bool live, int64_t *now);

#endif
