#include "controller.h"

#define DELIVERED_MAX 60000 /* mU in one step beyond which a total is not believed: more than any limit allows */

/* Insulin on board as two equal compartments of 55 min: exp(-5/55) and 5/55 exp(-5/55), Q1.30. */
#define IOB_A11 980434429
#define IOB_A21 89130403

#define ONE_Q16 65536 /* 1 with 16 fractional bits, the format of rates inside the core */

/* ---- arithmetic: 32-bit words, 64-bit products, one rounding rule */

static int64_t smaller(int64_t a, int64_t b)
{
    return a < b ? a : b;
}

static int64_t larger(int64_t a, int64_t b)
{
    return a > b ? a : b;
}

/* C rounds towards zero, the rule of the core is towards minus infinity. */
static int64_t floor_divide(int64_t value, int64_t divisor)
{
    return value / divisor - (value % divisor < 0 ? 1 : 0);
}

int64_t round_divide(int64_t value, int64_t divisor)
{
    return floor_divide(value + divisor / 2, divisor);
}

/* value / 2^bits by the same rule. What >> does to a negative number is the compiler's choice in C, hence the two ~. */
static int64_t round_shift(int64_t value, int bits)
{
    value += INT64_C(1) << (bits - 1);
    return value < 0 ? ~(~value >> bits) : value >> bits;
}

/* Clamp to a 32-bit word, and count it. */
static int32_t saturate(struct control_state *state, int64_t value)
{
    if (value > INT32_MAX || value < INT32_MIN) {
        state->saturations += state->saturations < INT32_MAX ? 1u : 0u;
        return value > 0 ? INT32_MAX : INT32_MIN;
    }
    return (int32_t)value;
}

static int64_t product(int32_t a, int32_t b)
{
    return (int64_t)a * b;
}

/* ---- insulin on board and trends */

/* Insulin delivered in the last step above the schedule, in mU with `scale` as 1; 0 when not known. */
static int32_t above_schedule(const struct parameters *p, const struct control_inputs *in, int32_t scale)
{
    if (in->delivered < 0) {
        return 0;
    }
    return (int32_t)(smaller(in->delivered, DELIVERED_MAX) * scale - round_divide(product(p->basal, scale), 12));
}

/* Advance the insulin on board by what was delivered; 0.01 U, never below zero. */
static int32_t insulin_on_board(struct control_state *s, const struct parameters *p, const struct control_inputs *in)
{
    const int32_t one = s->iob[0];
    s->iob[1] = saturate(s, round_shift(product(IOB_A21, one) + product(IOB_A11, s->iob[1]), 30));
    s->iob[0] = saturate(s, round_shift(product(IOB_A11, one), 30) + above_schedule(p, in, 256));
    return (int32_t)smaller(larger(round_divide((int64_t)s->iob[0] + s->iob[1], 2560), 0), IOB_MAX);
}

/* Shift the last samples, before the observer takes the new one; a missing sample or a new start ends the row. */
static void follow_trend(struct control_state *s, const struct control_inputs *in)
{
    if (in->glucose < 0 || in->reset) {
        s->trend = 0;
    }
    if (in->glucose >= 0) {
        s->glucose_2 = s->glucose_1;
        s->glucose_1 = s->glucose;
        s->trend = (int32_t)smaller(s->trend + 1, 3);
    }
}

/* ---- the disturbance observer: d = F G_d^-1 [y + G_u u], u_I = gamma d (Pons Torres et al. 2025)
 *
 * u is what the pump says it delivered above the schedule, clipped or not: that is the anti-windup. */

/* Three first-order lags in cascade, x(k+1) = A x(k) + B u(k) with exact hold over the sample. */
static void advance_lags(struct control_state *s, const struct parameters *p, int32_t u)
{
    const int32_t x1 = s->lag[0], x2 = s->lag[1], x3 = s->lag[2];
    s->lag[0] = saturate(s, round_shift(product(p->insulin_a11, x1) + product(p->insulin_b1, u), 30));
    s->lag[1] = saturate(
        s, round_shift(product(p->insulin_a21, x1) + product(p->insulin_a22, x2) + product(p->insulin_b2, u), 30));
    s->lag[2] = saturate(s, round_shift(product(p->insulin_a31, x1) + product(p->insulin_a32, x2) +
                                            product(p->insulin_a33, x3) + product(p->insulin_b3, u),
                                        30));
}

/* G_u u: the glucose lowered by insulin above the schedule, 0.1 mg/dL Q21.10. */
static int32_t insulin_effect(struct control_state *s, const struct parameters *p, const struct control_inputs *in)
{
    advance_lags(s, p, s->u[2]);
    s->u[2] = s->u[1];
    s->u[1] = s->u[0];
    s->u[0] = above_schedule(p, in, 16384);
    /* K_u in 0.001 mg/dL/(U/min), the lag in mU per 5 min Q17.14: / (1000 * 1000 * 5) * 10 and 4 bits less */
    return saturate(s, round_divide(product(p->insulin_gain, s->lag[2]), 500000 * 16));
}

/* One section (tau s + 1)/(theta s + 1) by Tustin's rule. */
static int32_t lead(struct control_state *s, int32_t x, int32_t x_last, int32_t y_last, int32_t b0, int32_t b1,
                    int32_t a1)
{
    return saturate(s, round_shift(product(b0, x) + product(b1, x_last) - product(a1, y_last), 24));
}

/* The insulin rate that answers the estimated meal, 0.005 U/h Q15.16; 0 before the first sample. */
static int32_t meal_insulin(struct control_state *s, const struct parameters *p, const struct control_inputs *in)
{
    const int32_t effect = insulin_effect(s, p, in);
    if (in->glucose >= 0) {
        s->glucose = in->glucose;
        if (in->reset) {
            s->primed = false;
        }
    } else if (!s->primed) {
        return 0;
    }
    const int32_t v = saturate(s, (int64_t)(s->glucose - p->target) * 1024 + effect);
    if (!s->primed) {
        /* every section starts in its steady state, so that the first sample does not look like a meal */
        s->primed = true;
        s->lead[0] = s->lead[1] = s->lead[2] = v;
    } else {
        const int32_t first = lead(s, v, s->v, s->lead[0], p->lead2_b0, p->lead2_b1, p->lead_a1);
        const int32_t second = lead(s, first, s->lead[0], s->lead[1], p->lead1_b0, p->lead1_b1, p->lead_a1);
        const int32_t third = lead(s, second, s->lead[1], s->lead[2], p->lead1_b0, p->lead1_b1, p->lead_a1);
        s->lead[0] = first;
        s->lead[1] = second;
        s->lead[2] = third;
    }
    s->v = v;
    /* gamma 1e-7 U/g, LEAD_3 0.1 mg/dL Q21.10, K_d 0.001 mg/dL/(g/min), 60 min/h, LSB 0.005 U/h Q15.16 */
    return saturate(s, round_divide(product(p->observer_gain, s->lead[2]) * 192, (int64_t)25 * p->meal_gain));
}

/* ---- what cuts a dose, whatever the law asks for (requirements LIM-01 to LIM-09) */

/* A rate of 0.001 U/h in 0.005 U/h Q15.16. */
static int64_t rate_q16(int32_t milliunits)
{
    return round_divide((int64_t)milliunits * ONE_Q16, 5);
}

static bool low(const struct parameters *p, const struct control_inputs *in)
{
    return in->glucose >= 0 && in->glucose < p->low_suspend;
}

/* Whether the line through three samples in a row crosses the limit within 30 min (requirement LIM-05). */
static bool soon_low(const struct control_state *s, const struct parameters *p)
{
    const int32_t level = s->glucose + s->glucose_1 + s->glucose_2;
    /* least squares: mean + 7 (G_0 - G_2) / 2, six times that */
    return s->trend >= 3 && 2 * level + 21 * (s->glucose - s->glucose_2) < 6 * p->low_suspend;
}

/* Lower the ceiling to `to` if it is above, and tell by `bit` whether that cuts the demand. */
static void cut(int64_t *ceiling, int64_t to, int64_t demand, uint8_t bit, uint8_t *limiters)
{
    if (to < *ceiling) {
        *ceiling = to;
        if (demand > to) {
            *limiters = (uint8_t)(*limiters | bit);
        }
    }
}

/* The rate to command: within the limits, rounded down, the rest carried to the next step. */
static int32_t limit_rate(int32_t demand, struct control_state *s, const struct parameters *p,
                          const struct control_inputs *in, struct control_outputs *out)
{
    const int64_t basal = rate_q16(p->basal);
    int64_t ceiling = smaller(larger(rate_q16(p->max_basal), basal), (int64_t)RATE_MAX * ONE_Q16);
    const int64_t factor = round_divide(product(p->basal_factor, p->basal) * ONE_Q16, 50);
    ceiling = smaller(ceiling, larger(factor, basal));
    if (demand > ceiling) {
        out->limiters |= LIMITER_MAX_BASAL;
    }
    /* what may still come on board within a step: 0.01 U in 5 min are 24 times 0.005 U/h */
    const int64_t room = larger(p->max_iob - out->iob, 0) * 24;
    cut(&ceiling, basal + room * ONE_Q16, demand, LIMITER_MAX_IOB, &out->limiters);
    /* 1 mU in 5 min is 12/5 of 0.005 U/h */
    const int64_t left = larger(in->insulin_left, 0) * 12 / 5;
    cut(&ceiling, left * ONE_Q16, demand, LIMITER_DAY, &out->limiters);
    const int64_t last = (int64_t)s->rate * ONE_Q16;
    cut(&ceiling, last + rate_q16(p->max_rise), demand, LIMITER_RISE, &out->limiters);
    if (low(p, in) || in->limit == LIMIT_SUSPEND) {
        ceiling = 0;
        if (demand > 0) {
            out->limiters |= LIMITER_LOW_GLUCOSE;
        }
    } else if (soon_low(s, p)) {
        cut(&ceiling, basal, demand, LIMITER_LOW_GLUCOSE, &out->limiters);
    }
    if (in->limit == LIMIT_SCHEDULE) {
        cut(&ceiling, basal, demand, LIMITER_STALE_CGM, &out->limiters);
    }
    if (in->glucose < 0) {
        /* without a new sample the held one looks like the end of a fall: insulin may go down but never up */
        cut(&ceiling, last, demand, LIMITER_STALE_CGM, &out->limiters);
    }
    const int64_t total = smaller(larger(demand, 0), ceiling) + s->rate_carry;
    s->rate_carry = (int32_t)(total % ONE_Q16);
    s->rate = (int32_t)smaller(total / ONE_Q16, ceiling / ONE_Q16);
    return s->rate;
}

void control_step(struct control_state *state, const struct parameters *parameters,
                  const struct control_inputs *inputs, struct control_outputs *outputs)
{
    outputs->limiters = 0;
    outputs->iob = insulin_on_board(state, parameters, inputs);
    follow_trend(state, inputs);
    const int32_t meal = meal_insulin(state, parameters, inputs); /* advances in every mode */
    int32_t demand = (int32_t)rate_q16(parameters->basal);
    if (inputs->mode == MODE_OFF) {
        demand = 0;
    } else if (inputs->mode == MODE_NMA) {
        demand = saturate(state, (int64_t)demand + meal);
    }
    outputs->rate = limit_rate(demand, state, parameters, inputs, outputs);
}
