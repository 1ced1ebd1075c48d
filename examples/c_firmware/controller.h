/* The control core of mode nma: one sampling instant, from glucose and delivered insulin to the rate to command.
 *
 * Pure arithmetic on integers, the same bits as firmware_sim/control: no frames, no clock, no operating system. Names,
 * units and formats are those of docs/numbers.md; Qm.n is a raw value with n fractional bits. What may be dosed at all
 * is decided outside, by the supervisor, and arrives here as `limit`. */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#include <stdbool.h>
#include <stdint.h>

#define RATE_MAX 8000 /* largest raw rate on the wire, 0.005 U/h; the codes above are reserved */
#define IOB_MAX 4090  /* 0.01 U */

enum mode { MODE_OFF = 0, MODE_OPEN_LOOP = 1, MODE_NMA = 2 };

enum limit { LIMIT_NONE, LIMIT_SCHEDULE, LIMIT_SUSPEND };

/* LimiterBits of the DBC. */
enum {
    LIMITER_MAX_BASAL = 1,
    LIMITER_MAX_IOB = 4,
    LIMITER_LOW_GLUCOSE = 8,
    LIMITER_STALE_CGM = 16,
    LIMITER_DAY = 64,
    LIMITER_RISE = 128
};

/* Constant between two calibrations; computed on the bench's side and flashed. */
struct parameters {
    int32_t basal;         /* u_b, 0.001 U/h */
    int32_t target;        /* G_b, 0.1 mg/dL */
    int32_t max_basal;     /* 0.001 U/h */
    int32_t basal_factor;  /* 0.1 schedules */
    int32_t max_iob;       /* 0.01 U */
    int32_t max_rise;      /* 0.001 U/h in one step */
    int32_t low_suspend;   /* 0.1 mg/dL */
    int32_t meal_gain;     /* K_d, 0.001 mg/dL/(g/min), above 0 */
    int32_t insulin_gain;  /* K_u, 0.001 mg/dL/(U/min) */
    int32_t observer_gain; /* gamma, 1e-7 U/g */
    int32_t lead1_b0, lead1_b1, lead2_b0, lead2_b1, lead_a1; /* Q7.24 */
    int32_t insulin_a11, insulin_a21, insulin_a22, insulin_a31, insulin_a32, insulin_a33; /* Q1.30 */
    int32_t insulin_b1, insulin_b2, insulin_b3; /* Q1.30 */
};

/* What survives from step to step; all zero after a start. */
struct control_state {
    uint32_t saturations;       /* clamped additions so far */
    int32_t u[3];               /* U_1 to U_3: insulin above schedule of the last steps, mU/step Q17.14 */
    int32_t lag[3];             /* LAG_1 to LAG_3 of G_u, mU/step Q17.14 */
    int32_t v;                  /* V_1, input of the first lead section, 0.1 mg/dL Q21.10 */
    int32_t lead[3];            /* LEAD_1 to LEAD_3, 0.1 mg/dL Q21.10 */
    int32_t glucose, glucose_1, glucose_2; /* the last samples, newest first, 0.1 mg/dL */
    int32_t trend;              /* samples in a row up to this one, at most 3 */
    bool primed;                /* the observer has seen a sample since reset */
    int32_t rate_carry;         /* what is below one LSB of the rate, Q15.16 */
    int32_t rate;               /* commanded in the last step, 0.005 U/h */
    int32_t iob[2];             /* IOB_1 and IOB_2: insulin above schedule on board, mU Q23.8 */
};

struct control_inputs {
    int32_t glucose;      /* 0.1 mg/dL; -1 = no usable sample in this step */
    int32_t delivered;    /* mU since the last step; -1 = not known, as scheduled */
    enum mode mode;
    enum limit limit;
    bool reset;           /* the observer starts anew at this sample */
    int32_t insulin_left; /* mU that the limit of 24 h leaves */
};

struct control_outputs {
    int32_t rate;     /* to command, 0.005 U/h */
    uint8_t limiters; /* LimiterBits */
    int32_t iob;      /* 0.01 U above schedule, never below zero */
};

/* value / divisor for a positive divisor, to the nearest, halves up: |value| + divisor / 2 below 2^63. */
int64_t round_divide(int64_t value, int64_t divisor);

/* Run one sampling instant. */
void control_step(struct control_state *state, const struct parameters *parameters,
                  const struct control_inputs *inputs, struct control_outputs *outputs);

#endif
