/* When frames may go to a device that does not tell how full its buffer is: by the time each takes on the bus. */
#ifndef CAN_BRIDGE_PACE_H
#define CAN_BRIDGE_PACE_H

#include <linux/can.h>

#include "values.h"

struct pace {
    uint32_t depth;      /* frames in the device's buffer at once; 0: frames are not paced */
    int64_t bit_ns;      /* of a bit on the bus, and a little more */
    int64_t latency_ns;  /* how long a frame may be on its way to the device */
    int64_t others_ns;   /* for how long others had the bus while our frames waited */
    int64_t ends[DEPTH_MAX]; /* ring: when each frame in the buffer will have left it, less others_ns */
    uint32_t head, count;
    uint32_t unanswered; /* the youngest of them: whether these have reached the device is not known */
};

void pace_set(struct pace *p, const struct sending_settings *set);
void pace_reset(struct pace *p);
bool pace_open(struct pace *p, uint32_t unanswered, int64_t now);
int64_t pace_start(const struct pace *p, int64_t now);
void pace_sent(struct pace *p, const struct can_frame *frame, int64_t now);
void pace_heard(struct pace *p, const struct can_frame *frame, int64_t now);
int64_t pace_deadline(const struct pace *p);

/* When a frame that is sent now leaves the device, as far as that is reckoned. */
static inline int64_t pace_leaves(const struct pace *p, int64_t now)
{
    return p->depth ? pace_start(p, now) : now;
}

#endif
