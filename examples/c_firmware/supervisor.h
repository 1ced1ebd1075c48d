/* What may be dosed at all: which CGM sample is usable, what the pump has delivered, where the device stands on the
 * ladder; the set-point of the step and the alarms. It takes decoded messages and fills decoded messages. */
#ifndef SUPERVISOR_H
#define SUPERVISOR_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "alarms.h"
#include "calibration.h"
#include "controller.h"
#include "pumpbench.h"

#define SAMPLES_MAX 16u /* CGM_Reading frames of one step that are looked at; more is an overrun anyway */
#define DAY_HOURS 25    /* the hour that runs, and 24 before it */
#define HORMONES 16u    /* codes that fit BolusStateHormone */

/* The fallback ladder (requirements FAL-01 to FAL-05); the codes are those of CTRL_Status.CtrlState. */
enum ladder_state {
    LADDER_INIT = PUMPBENCH_CTRL_STATUS_CTRL_STATE_INIT_CHOICE,
    LADDER_AUTO = PUMPBENCH_CTRL_STATUS_CTRL_STATE_AUTO_CHOICE,
    LADDER_DEGRADED = PUMPBENCH_CTRL_STATUS_CTRL_STATE_DEGRADED_CHOICE,
    LADDER_SAFE_BASAL = PUMPBENCH_CTRL_STATUS_CTRL_STATE_SAFE_BASAL_CHOICE,
    LADDER_SUSPENDED = PUMPBENCH_CTRL_STATUS_CTRL_STATE_SUSPENDED_CHOICE,
    LADDER_FAULT = PUMPBENCH_CTRL_STATUS_CTRL_STATE_FAULT_CHOICE,
    LADDER_DELIVERY_UNCERTAIN = PUMPBENCH_CTRL_STATUS_CTRL_STATE_DELIVERY_UNCERTAIN_CHOICE
};

/* The messages of every step whose values are used only while their last checks allow it (requirement E2E-03). */
enum cyclic { CYCLIC_READING, CYCLIC_STATUS, CYCLIC_TOTALS, CYCLIC_MESSAGES };

/* What E2E says of a frame: it may be read; the last one again, old but no error; not to be read. */
enum verdict { VERDICT_GOOD, VERDICT_REPEATED, VERDICT_BAD };

/* The window over the last checks of a message, one in every step in which something of it came. */
struct window {
    enum { WINDOW_NO_DATA, WINDOW_VALID, WINDOW_INVALID } state;
    bool good_came, repeated_came, bad_came; /* since the last check */
    uint8_t good, bad;                       /* a bit per check, the newest lowest */
};

/* Whether a node is alive: it says so once per step, with a bit that toggles (requirement E2E-07). */
struct heartbeat {
    bool came, moved;   /* since the last step */
    int32_t toggle;     /* of the newest one, -1 before the first */
    int32_t came_step;  /* when it came, NEVER before the first */
    int32_t alive_step; /* when one last counted, NEVER before the first: then none is missed */
};

/* The CGM as the firmware sees it. */
struct sensor {
    struct pumpbench_cgm_reading_t samples[SAMPLES_MAX]; /* of this step, checked by E2E */
    uint32_t heard;         /* samples of this step, those beyond SAMPLES_MAX too */
    uint32_t skipped;       /* frames of this step that E2E did not allow to read */
    int32_t sequence;       /* CgmSampleSeq of the newest usable sample, NEVER without one */
    int32_t taken;          /* step of that sample, NEVER without one */
    int32_t last;           /* its glucose, -1 without one */
    bool below_range;       /* it says only that glucose is very low */
    bool doubtful;          /* the sensor itself says that it is not to be trusted */
    uint8_t session;        /* CgmSessionId */
    int32_t unconfirmed;    /* a rise that waits for the next sample to agree, -1 without one */
    int32_t value_last;     /* of a sample in state Ok, -1 without one */
    uint32_t equal;         /* samples in a row with that value */
    uint32_t unused;        /* frames since the newest usable sample that came and could not be used */
    uint32_t streak;        /* steps in a row with a usable sample */
    uint32_t since_gap;     /* usable samples since the last long gap */
    struct heartbeat heartbeat;
};

/* The pump as the firmware sees it. */
struct pump {
    struct pumpbench_pump_status_t status;
    struct pumpbench_pump_delivered_t totals;
    bool status_came, totals_came; /* in this step */
    uint16_t bolus_states_came;    /* in this step, a bit per drug */
    int32_t status_step, totals_step, bolus_step[HORMONES]; /* when they were last heard, NEVER before the first */
    uint16_t bolus_states_heard;   /* ever, a bit per drug */
    struct heartbeat heartbeat;
    bool blocked;                  /* the insulin line or its motor does not deliver */
    uint32_t unlike;               /* steps in a row in which the pump showed another set-point than the last one */
    int32_t sequence;              /* BasalCmdSeq of the last set-point */
    int32_t commanded;             /* its rate, 0.005 U/h; SCHEDULE: the pump's own */
    bool rates_sent;               /* it held rates */
    int32_t rate_limit;            /* what the pump accepts as it last said, 0.005 U/h */
    bool answers;                  /* the pump is one that acknowledges set-points */
    uint8_t awaited;               /* answers to the last set-point that have not come, a bit per drug */
    int32_t total;                 /* mU, the newest one; -1 before the first */
    uint8_t boot_count;            /* PumpBootCount of that total */
    int64_t estimated;             /* mU assumed and not yet covered by a total */
    int32_t pram_total;            /* 0.01 ug, the newest one; -1 before the first */
    bool balanced;                 /* the balances below held in the step before: no gap since */
    int64_t insulin_balance;       /* 1/12 mU that the totals grew more than was asked for */
    int64_t pram_balance;          /* 1/12 of 0.01 ug */
    bool insulin_fell, pram_fell;  /* the newest total was below an older one, without a reset of the pump */
    uint32_t refused;              /* totals that fell without a reset, answers that were not Accepted */
    uint32_t unanswered;
};

/* Insulin delivered within the last 24 hours, by the hour (requirement LIM-06). */
struct day {
    int64_t hours[DAY_HOURS]; /* mU */
    int32_t hour;
};

struct supervisor {
    struct window windows[CYCLIC_MESSAGES];
    struct sensor sensor;
    struct pump pump;
    struct day day;
    struct alarms alarms;
    struct control_state control;
    struct control_outputs outputs;
    enum ladder_state state;
    enum ladder_state rung;     /* what the CGM alone allows, remembered under Suspended and the like */
    enum ladder_state reported; /* state of the last report */
    enum mode mode;
    int32_t mode_sequence;      /* -1 before the first MODE_Cmd */
    bool suspended;             /* by the user */
    bool rejected;              /* a mode was asked for that this firmware does not have */
    int32_t step;               /* the newest one, -1 before the first */
    int32_t clock_caution;      /* samples until the clock is trusted again */
    bool urgent;                /* the newest sample is very low */
    bool parameters_damaged;
    int32_t self_test_tick;     /* when the calibration was last looked at, simulated seconds */
    uint32_t overruns;
    uint32_t overruns_in_a_row;
    bool late;                  /* this step had more work than a device can do */
    uint32_t sequence_errors;   /* samples and mode commands refused for their number, samples that came late */
    uint32_t lost_unseen;       /* CGM frames lost that their 4-bit counter could not show */
    uint32_t lost_at_sample;    /* those it showed, when the newest sample came */
    uint32_t e2e_errors_seen;
    int32_t last_e2e_error, last_implausible, last_limited, last_rejected, last_jump, last_change; /* steps */
};

/* What the protocol has counted since the roll call. */
struct link_counts {
    uint32_t frames;          /* heard since the last step */
    uint32_t e2e_errors;
    uint32_t lost;            /* frames of all messages */
    uint32_t lost_readings;   /* of these, CGM_Reading */
    uint32_t sequence_errors;
};

/* What a step has to say, in the order in which it is sent. */
struct report {
    bool commands; /* whether there is a set-point */
    struct pumpbench_pump_basal_cmd_t basal_cmd;
    size_t alarms;
    struct pumpbench_ctrl_alarm_t alarm[ALARM_KINDS];
    struct pumpbench_ctrl_status_t status;
    struct pumpbench_ctrl_diag_t diag;
    bool overrun;
    uint32_t work; /* counted, not timed: frames handled, samples judged, core steps done */
};

void supervisor_boot(struct supervisor *supervisor);

/* Frames between two tokens, checked by E2E. */
void supervisor_hear_reading(struct supervisor *supervisor, const struct pumpbench_cgm_reading_t *reading);
void supervisor_skip_reading(struct supervisor *supervisor); /* one that E2E does not allow to read */
void supervisor_note(struct supervisor *supervisor, enum cyclic message, enum verdict verdict);
void supervisor_hear_pump_heartbeat(struct supervisor *supervisor, const struct pumpbench_hb_pump_t *heartbeat);
void supervisor_hear_cgm_heartbeat(struct supervisor *supervisor, const struct pumpbench_hb_cgm_t *heartbeat);
void supervisor_hear_cgm_status(struct supervisor *supervisor, const struct pumpbench_cgm_status_t *status);
void supervisor_hear_pump_status(struct supervisor *supervisor, const struct pumpbench_pump_status_t *status);
void supervisor_hear_delivered(struct supervisor *supervisor, const struct pumpbench_pump_delivered_t *totals);
void supervisor_hear_bolus_state(struct supervisor *supervisor, const struct pumpbench_pump_bolus_state_t *state);
void supervisor_hear_mode(struct supervisor *supervisor, const struct pumpbench_mode_cmd_t *command);
void supervisor_hear_alarm_ack(struct supervisor *supervisor, const struct pumpbench_ui_alarm_ack_t *ack);

/* False if the pump took the last set-point for another one: somebody else told it. */
bool supervisor_hear_ack(struct supervisor *supervisor, const struct pumpbench_pump_ack_t *ack);

/* Run sampling instant `step`, which must be above the last one. */
void supervisor_step(struct supervisor *supervisor, int32_t step, uint32_t sim_time,
                     const struct calibration *calibration, const struct link_counts *counts, struct report *report);

#endif
