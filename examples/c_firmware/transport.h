/* How frames come and go: one of the transports below, chosen by the scheme of a URL. */
#ifndef TRANSPORT_H
#define TRANSPORT_H

#include <stdbool.h>
#include <stddef.h>

#include "frame.h"

#define TRANSPORT_BATCH 64u /* most frames of one call */

/* Errors are one line on stderr. There is one bus per program, so a transport keeps its socket to itself. */
struct transport {
    /* Whether the transport knows this kind of URL. */
    bool (*knows)(const char *url);
    /* Join the bus; false if that failed. */
    bool (*open)(const char *url);
    /* Wait for frames; how many came, 0 when the bus is gone. */
    size_t (*receive)(struct frame frames[TRANSPORT_BATCH]);
    /* Send frames in order; false when the bus is gone. */
    bool (*send)(const struct frame *frames, size_t n);
    /* Leave the bus, after what was sent has left. */
    void (*close)(void);
};

/* unix:/path, tcp:127.0.0.1:port, and stdio: for the same stream on stdin and stdout, without the greeting */
extern const struct transport transport_hub;

/* socketcan:vcan0 */
extern const struct transport transport_socketcan;

/* slcan: the text of USB-CAN adapters on the serial line of serial.h. Joined when the other end opens the channel. */
extern const struct transport transport_slcan;

#endif
