/* One classic CAN frame, as the transports hand it over. */
#ifndef FRAME_H
#define FRAME_H

#include <stdint.h>

/* Flag bits of can_id, those of Linux and of the hub's stream. */
#define FRAME_EXTENDED 0x80000000u
#define FRAME_REMOTE 0x40000000u
#define FRAME_ERROR 0x20000000u
#define FRAME_ID_MASK 0x1FFFFFFFu

#define FRAME_DATA_MAX 8u

struct frame {
    uint32_t can_id; /* with its flag bits */
    uint8_t len;     /* 0 to 8 */
    uint8_t data[FRAME_DATA_MAX];
};

#endif
