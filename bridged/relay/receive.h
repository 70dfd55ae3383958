/* From the device to the interface: bytes are decoded, frames go out in batches. */
#ifndef CAN_BRIDGE_RECEIVE_H
#define CAN_BRIDGE_RECEIVE_H

#include <sys/socket.h>

#include "codec.h"
#include "transmit.h"

enum {
    RX_BATCH = 256,      /* frames per sendmmsg, and how many may wait for an interface that has no room */
    PORT_BUFFER = 65536, /* bytes read from the port and not decoded yet */
};

struct receive {
    struct counters *counters;
    struct events *events;
    struct transmit *transmit; /* gets what is no frame */
    const struct codec *codec;
    struct codec_state decoder;
    bool receiving;       /* frames are wanted; else they are dropped */
    bool stamp_seen;      /* since the port was attached */
    int64_t quiet_at_ns;  /* when bytes that wait for more are decoded without; NEVER: none wait */
    int64_t stalled_ns;   /* since when the interface has no room; NEVER: it has */
    int64_t retry_at_ns;  /* when the next try is due */
    uint32_t count;       /* frames decoded, not on the interface yet */
    struct can_frame frames[RX_BATCH];
    struct mmsghdr msg[RX_BATCH];
    struct iovec iov[RX_BATCH];
    size_t in_length;
    uint8_t in[PORT_BUFFER];
};

void receive_init(struct receive *rc, struct transmit *transmit);
void receive_reset(struct receive *rc);
void receive_set(struct receive *rc, bool receiving);
void receive_set_stamps(struct receive *rc, bool longer);
void receive_drop(struct receive *rc, enum rx_drop reason);
ssize_t receive_read(struct receive *rc, int port);
int receive_decode(struct receive *rc, int interface, int64_t now);
int receive_due(struct receive *rc, int interface, int64_t now);
int64_t receive_deadline(const struct receive *rc);

#endif
