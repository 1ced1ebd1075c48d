/* The device's side of docs/protocol.md: roll call, calibration, turns, E2E protection in and out.
 *
 * A function from a frame to the frames it answers with: no operating system, no clock, no heap. */
#ifndef PROTOCOL_H
#define PROTOCOL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "calibration.h"
#include "frame.h"
#include "supervisor.h"
#include "tables.h"

#define FIRMWARE_ECHOES 64u       /* CFG_ParamEcho frames that fit into one turn; the DBC has fewer parameters */
#define FIRMWARE_FRAMES_AT_MOST 96u /* that one call of firmware_receive may answer with */

struct firmware {
    struct supervisor supervisor;
    struct calibration calibration;
    uint8_t counter[MESSAGES];    /* COUNTER of the next frame sent, or of the last one received */
    bool counter_known[MESSAGES]; /* of a message received */
    uint32_t lost[MESSAGES];      /* frames missing by their counters; a gap of 16 looks like none */
    uint32_t e2e_errors;          /* wrong CRC, length or format; ids of ours that others sent; error frames */
    uint32_t sequence_errors;
    uint32_t frames_heard;        /* since the last step */
    bool peer_known;
    uint8_t peer_major;           /* PlantProtocolMajor */
    bool toggle;                  /* of the heartbeat */
    struct frame echo[FIRMWARE_ECHOES]; /* CFG_ParamEcho frames that wait for the turn */
    size_t echoes;
};

/* Everything as after power-on; `out` is what the device says before it listens. Room for FIRMWARE_FRAMES_AT_MOST. */
void firmware_start(struct firmware *firmware, struct frame *out, size_t *n);

/* Take one frame; only a token is answered. False when the bench has ended the run, once `out` is sent. */
bool firmware_receive(struct firmware *firmware, const struct frame *in, struct frame *out, size_t *n);

#endif
