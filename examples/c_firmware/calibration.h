/* The calibration of one patient: flashed parameter by parameter, checked as a set, active as a whole. */
#ifndef CALIBRATION_H
#define CALIBRATION_H

#include <stdbool.h>
#include <stdint.h>

#include "controller.h"
#include "pumpbench.h"

#define CFG_INDICES 63 /* CfgIndex of values; 63 itself is CfgSetCrc */

/* Raw values by CfgIndex; a bit of `known` says which are there. */
struct value_set {
    int32_t value[CFG_INDICES];
    uint64_t known;
};

/* What the supervisor needs and the control core does not know. */
struct supervision {
    int32_t insulin_tdd;     /* 0.01 U, usual insulin per day */
    int32_t stale_cgm_limit; /* min */
    int32_t stuck_samples;   /* equal CGM values in a row; 0 = off */
};

struct calibration {
    struct value_set received;
    struct value_set active;
    uint16_t active_crc;
    struct parameters parameters;   /* of the active set, 0 without one */
    struct supervision supervision; /* of the active set, the tight values without one */
};

void calibration_boot(struct calibration *calibration);

/* Whether a complete, checked set is in force. */
bool calibration_active(const struct calibration *calibration);

/* Whether what is in force is still what was checked when it was activated (requirement STA-02). */
bool calibration_intact(const struct calibration *calibration);

/* Take one CFG_Param and fill its echo. A value out of range is refused, not clipped: the echo shows what stays. */
void calibration_store(struct calibration *calibration, const struct pumpbench_cfg_param_t *param,
                       struct pumpbench_cfg_param_echo_t *echo);

#endif
