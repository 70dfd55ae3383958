/* The relay's clock. It goes on while the machine is suspended, so that frames grow old in their sleep too. */
#ifndef CAN_BRIDGE_CLOCK_H
#define CAN_BRIDGE_CLOCK_H

#include "values.h"

int64_t clock_now_ns(void);
struct moment clock_moment(void);

#endif
