#include "supervisor.h"

#include <string.h>

#define STEP_SECONDS 300
#define STEPS_PER_HOUR 12
#define NEVER (-(1 << 20)) /* a step long before the first one */
#define SCHEDULE (-1)      /* in place of a commanded rate */

static bool has_bit(uint32_t bits, unsigned bit)
{
    return (bits >> bit & 1u) != 0u;
}

/* ---- heartbeats (requirement E2E-07) */

#define HEARTBEAT_TIMEOUT 3 /* steps since the last one after which a node is silent: more than 660 s */

static void hear_heartbeat(struct heartbeat *heartbeat, int32_t toggle)
{
    heartbeat->came = true;
    heartbeat->moved = heartbeat->moved || toggle != heartbeat->toggle;
    heartbeat->toggle = toggle;
}

void supervisor_hear_pump_heartbeat(struct supervisor *supervisor, const struct pumpbench_hb_pump_t *heartbeat)
{
    hear_heartbeat(&supervisor->pump.heartbeat, heartbeat->toggle_pump);
}

void supervisor_hear_cgm_heartbeat(struct supervisor *supervisor, const struct pumpbench_hb_cgm_t *heartbeat)
{
    hear_heartbeat(&supervisor->sensor.heartbeat, heartbeat->toggle_cgm);
}

static void close_heartbeat(struct heartbeat *heartbeat, int32_t step)
{
    if (heartbeat->came) { /* after a step without one the bit proves nothing: a single lost one costs one step */
        const bool alive = heartbeat->moved || step - heartbeat->came_step > 1;
        heartbeat->alive_step = alive ? step : heartbeat->alive_step;
        heartbeat->came_step = step;
    }
    heartbeat->came = heartbeat->moved = false;
}

static void forget_heartbeat(struct heartbeat *heartbeat)
{
    heartbeat->toggle = -1;
    heartbeat->came_step = heartbeat->alive_step = NEVER;
}

/* Whether the sensor's heartbeats have ceased; of a sensor that has never sent one they are not missed. */
static bool is_silent(const struct sensor *sensor, int32_t step)
{
    return sensor->heartbeat.alive_step != NEVER && step - sensor->heartbeat.alive_step >= HEARTBEAT_TIMEOUT;
}

/* ---- sensor (requirements SEN-01 to SEN-09) */

#define CGM_STATE(name) PUMPBENCH_CGM_READING_CGM_STATE_##name##_CHOICE

#define GLUCOSE_LOW 200           /* 0.1 mg/dL: what a sensor in state Ok may say */
#define GLUCOSE_HIGH 8000
#define BELOW_RANGE_ACTS_AS 400   /* and suspends besides, for 40 mg/dL is only where the sensor's scale ends */
#define ABOVE_RANGE_ACTS_AS 4000
#define URGENT_LOW 550            /* raised in every state (requirement ALM-03) */
#define AGE_USABLE 3              /* steps: an older sample is not used at all */
#define SEQUENCES_CGM 65535       /* CgmSampleSeq runs from 0 to 65534 */
#define SETTLING_SAMPLES 3u       /* in a row after a gap before trends are trusted again */
#define JUMP 500                  /* 0.1 mg/dL in a step: a rise above waits for the next sample; a fall never waits */
#define NOISE_HIGH 30u            /* CgmNoise, 0.5 mg/dL */
#define FAULT_BITS (1u | 2u | 8u) /* noise, compression low, calibration error */

void supervisor_hear_reading(struct supervisor *supervisor, const struct pumpbench_cgm_reading_t *reading)
{
    struct sensor *sensor = &supervisor->sensor;
    if (sensor->heard < SAMPLES_MAX) {
        sensor->samples[sensor->heard] = *reading;
    }
    sensor->heard++;
}

void supervisor_skip_reading(struct supervisor *supervisor)
{
    /* after a gap it is a sample, unused but not lost; beside a usable sample it is a copy */
    supervisor->sensor.skipped++;
}

void supervisor_hear_cgm_status(struct supervisor *supervisor, const struct pumpbench_cgm_status_t *status)
{
    struct sensor *sensor = &supervisor->sensor;
    const bool noisy = status->cgm_noise > NOISE_HIGH && status->cgm_noise < PUMPBENCH_CGM_STATUS_CGM_NOISE_ERROR_CHOICE;
    sensor->doubtful = noisy || (status->cgm_fault_bits & FAULT_BITS) != 0u;
    const uint8_t sna = PUMPBENCH_CGM_STATUS_CGM_SESSION_ID_SNA_CHOICE;
    if (status->cgm_session_id != sna && status->cgm_session_id != sensor->session) {
        if (sensor->session != sna) { /* another sensor: nothing of the old one says anything about it */
            sensor->since_gap = 0u;
            sensor->unconfirmed = sensor->last = sensor->value_last = -1;
        }
        sensor->session = status->cgm_session_id;
    }
}

static int32_t age_of_sample(const struct sensor *sensor, int32_t step)
{
    return sensor->taken == NEVER ? -NEVER : step - sensor->taken;
}

/* The glucose to dose on, -1 if the sample says none (requirements SEN-03 to SEN-05). */
static int32_t usable_glucose(const struct pumpbench_cgm_reading_t *sample)
{
    if (sample->cgm_sample_seq >= SEQUENCES_CGM) {
        return -1;
    }
    switch (sample->cgm_state) {
    case CGM_STATE(BELOW_RANGE):
        return BELOW_RANGE_ACTS_AS;
    case CGM_STATE(ABOVE_RANGE):
        return ABOVE_RANGE_ACTS_AS;
    case CGM_STATE(OK):
        return sample->glucose_conc >= GLUCOSE_LOW && sample->glucose_conc <= GLUCOSE_HIGH ? sample->glucose_conc : -1;
    default:
        return -1;
    }
}

/* Whether this value has come too often in a row (requirement SEN-07); beyond the range it may. */
static bool is_stuck(struct sensor *sensor, const struct pumpbench_cgm_reading_t *sample, int32_t limit)
{
    if (sample->cgm_state != CGM_STATE(OK)) {
        sensor->equal = 0u;
        sensor->value_last = -1;
        return false;
    }
    sensor->equal = sample->glucose_conc == sensor->value_last ? sensor->equal + 1u : 1u;
    sensor->value_last = sample->glucose_conc;
    return limit > 0 && sensor->equal >= (uint32_t)limit;
}

/* Whether a sample rises so fast that it waits for the next one to agree (requirement SEN-06). */
static bool has_jumped(struct sensor *sensor, int32_t glucose, int32_t taken)
{
    const int32_t steps = taken - sensor->taken;
    if (sensor->taken == NEVER || sensor->last < 0 || steps > AGE_USABLE) {
        return false;
    }
    if (glucose - sensor->last <= JUMP * (steps > 1 ? steps : 1)) {
        return false;
    }
    const int32_t difference = glucose - sensor->unconfirmed;
    if (sensor->unconfirmed >= 0 && difference >= -JUMP && difference <= JUMP) {
        return false;
    }
    sensor->unconfirmed = glucose;
    return true;
}

/* Judge one sample; its glucose, -1 if it is not used. */
static int32_t judge(struct supervisor *supervisor, const struct pumpbench_cgm_reading_t *sample, int32_t step,
                     int32_t stuck_limit, uint32_t *missing)
{
    struct sensor *sensor = &supervisor->sensor;
    const int32_t glucose = usable_glucose(sample);
    /* CgmSampleStep is absolute: a frame that was held back anywhere shows its age (requirement SEN-02) */
    const int32_t age = (int32_t)(((uint32_t)step - sample->cgm_sample_step) & 0xFFu);
    if (glucose < 0 || age > AGE_USABLE) {
        supervisor->last_implausible = step;
        sensor->unused++;
        return -1;
    }
    int32_t ahead = 1;
    if (sensor->sequence != NEVER) {
        ahead = (sample->cgm_sample_seq - sensor->sequence + SEQUENCES_CGM) % SEQUENCES_CGM;
        if (ahead == 0 || ahead >= SEQUENCES_CGM / 2) {
            supervisor->last_implausible = step;
            supervisor->sequence_errors++;
            return -1;
        }
    }
    if (is_stuck(sensor, sample, stuck_limit) || has_jumped(sensor, glucose, step - age)) {
        supervisor->last_implausible = step;
        sensor->unused++;
        return -1;
    }
    supervisor->sequence_errors += age > 0 ? 1u : 0u;
    const uint32_t between = (uint32_t)ahead - 1u;
    *missing += between > sensor->unused ? between - sensor->unused : 0u;
    sensor->last = glucose;
    sensor->unconfirmed = -1;
    sensor->unused = 0u;
    sensor->sequence = sample->cgm_sample_seq;
    sensor->taken = step - age;
    sensor->below_range = sample->cgm_state == CGM_STATE(BELOW_RANGE);
    return glucose;
}

/* Take the samples of this step; the glucose to dose on, -1 = none. */
static int32_t judge_sensor(struct supervisor *supervisor, int32_t step, int32_t stuck_limit, uint32_t lost_readings)
{
    struct sensor *sensor = &supervisor->sensor;
    const bool gap = age_of_sample(sensor, step) > AGE_USABLE + 1;
    int32_t glucose = -1;
    uint32_t missing = 0u;
    for (uint32_t i = 0u; i < sensor->heard && i < SAMPLES_MAX; i++) {
        const int32_t judged = judge(supervisor, &sensor->samples[i], step, stuck_limit, &missing);
        glucose = judged >= 0 ? judged : glucose;
    }
    if (glucose < 0) {
        sensor->unused += sensor->skipped;
        sensor->streak = 0u;
    } else {
        sensor->streak++;
        sensor->since_gap = gap ? 1u : sensor->since_gap < SETTLING_SAMPLES ? sensor->since_gap + 1u : SETTLING_SAMPLES;
        /* the 4-bit counter of the frames is blind to a gap of 16, the number of the sample is not */
        const uint32_t shown = lost_readings - supervisor->lost_at_sample;
        supervisor->lost_unseen += missing > shown ? missing - shown : 0u;
        supervisor->lost_at_sample = lost_readings;
        supervisor->urgent = glucose < URGENT_LOW;
        if (supervisor->clock_caution > 0 && supervisor->last_jump != step) {
            supervisor->clock_caution--;
        }
    }
    sensor->skipped = 0u;
    sensor->heard = 0u;
    return glucose;
}

/* ---- pump: set-points with number and expiry, and the totals it reports */

#define ACK_FOR(name) PUMPBENCH_PUMP_ACK_ACK_FOR_##name##_CHOICE
#define ACK_RESULT(name) PUMPBENCH_PUMP_ACK_ACK_RESULT_##name##_CHOICE
#define PUMP_STATE(name) PUMPBENCH_PUMP_STATUS_PUMP_STATE_##name##_CHOICE
#define BASAL_OP(name) PUMPBENCH_PUMP_BASAL_CMD_BASAL_OP_##name##_CHOICE

#define RATE_EXPIRES_AFTER 3 /* steps a set-point may run without a newer one */
#define SEQUENCES_BASAL 1023 /* BasalCmdSeq runs from 0 to 1022 */
#define UNLIKE_STEPS 2u      /* steps with another set-point than the last one until the alarm (requirement CMD-09) */
#define UNBALANCED 500       /* mU, and 0.01 ug: ten strokes */
#define AWAIT_INSULIN 1u
#define AWAIT_PRAM 2u

void supervisor_hear_pump_status(struct supervisor *supervisor, const struct pumpbench_pump_status_t *status)
{
    supervisor->pump.status = *status;
    supervisor->pump.status_came = true;
}

void supervisor_hear_delivered(struct supervisor *supervisor, const struct pumpbench_pump_delivered_t *totals)
{
    supervisor->pump.totals = *totals;
    supervisor->pump.totals_came = true;
}

void supervisor_hear_bolus_state(struct supervisor *supervisor, const struct pumpbench_pump_bolus_state_t *state)
{
    struct pump *pump = &supervisor->pump;
    pump->bolus_states_came = (uint16_t)(pump->bolus_states_came | 1u << (state->bolus_state_hormone % HORMONES));
}

bool supervisor_hear_ack(struct supervisor *supervisor, const struct pumpbench_pump_ack_t *ack)
{
    struct pump *pump = &supervisor->pump;
    const bool insulin = ack->ack_for == ACK_FOR(INSULIN_RATE);
    if (ack->ack_id != pump->sequence || !(insulin || ack->ack_for == ACK_FOR(PRAM_RATE))) {
        return true;
    }
    const bool accepted = ack->ack_result == ACK_RESULT(ACCEPTED) || ack->ack_result == ACK_RESULT(DUPLICATE);
    pump->answers = true;
    pump->awaited = (uint8_t)(pump->awaited & ~(insulin ? AWAIT_INSULIN : AWAIT_PRAM));
    pump->refused += accepted ? 0u : 1u;
    if (insulin) {
        /* a refusal lowers the limit, the answer to what was accepted may raise it */
        if (ack->ack_result == ACK_RESULT(OVER_LIMIT) || (accepted && ack->ack_limit_raw > pump->rate_limit)) {
            pump->rate_limit = ack->ack_limit_raw;
        }
    }
    const int32_t asked = insulin ? pump->commanded : 0;
    return !accepted || !pump->rates_sent || ack->ack_echo_raw == asked;
}

/* Steps since status, totals, heartbeat and the states of boluses were last heard; of the latter two, those ever heard. */
static int32_t silence_of_pump(const struct pump *pump, int32_t step)
{
    int32_t heard = pump->status_step < pump->totals_step ? pump->status_step : pump->totals_step;
    if (pump->heartbeat.alive_step != NEVER && pump->heartbeat.alive_step < heard) {
        heard = pump->heartbeat.alive_step;
    }
    for (unsigned drug = 0u; drug < HORMONES; drug++) {
        if (has_bit(pump->bolus_states_heard, drug) && pump->bolus_step[drug] < heard) {
            heard = pump->bolus_step[drug];
        }
    }
    return step - heard;
}

static void follow_status(struct pump *pump, int32_t step)
{
    const struct pumpbench_pump_status_t *status = &pump->status;
    const uint16_t shown = status->pump_last_basal_seq;
    const bool like = shown == PUMPBENCH_PUMP_STATUS_PUMP_LAST_BASAL_SEQ_SNA_CHOICE || shown == pump->sequence;
    pump->unlike = like ? 0u : pump->unlike + 1u;
    pump->status_step = step;
    pump->blocked = status->pump_state == PUMP_STATE(STOPPED) || status->pump_state == PUMP_STATE(FAULT) ||
                    status->insulin_occlusion == PUMPBENCH_PUMP_STATUS_INSULIN_OCCLUSION_OCCLUDED_CHOICE ||
                    status->insulin_reservoir == 0u;
}

/* Whether a total can be what it claims; one that is not counts as not received. */
static bool believable(struct pump *pump)
{
    const struct pumpbench_pump_delivered_t *totals = &pump->totals;
    if (totals->insulin_total >= PUMPBENCH_PUMP_DELIVERED_INSULIN_TOTAL_ERROR_CHOICE ||
        totals->pump_boot_count >= PUMPBENCH_PUMP_DELIVERED_PUMP_BOOT_COUNT_SNA_CHOICE) {
        return false;
    }
    /* a total never falls without a reset of the pump */
    pump->insulin_fell = pump->total >= 0 && (int32_t)totals->insulin_total < pump->total &&
                         totals->pump_boot_count == pump->boot_count;
    pump->refused += pump->insulin_fell ? 1u : 0u;
    return !pump->insulin_fell;
}

/* Insulin delivered since the last step in mU, -1 while no total has ever come. What a missing total leaves open is
 * estimated from the command in force and settled when the next one comes: the sum is always what the pump says. */
static int32_t delivered(struct pump *pump, int32_t step, int32_t basal)
{
    if (pump->totals_came && believable(pump)) {
        const int32_t total = (int32_t)pump->totals.insulin_total;
        const int32_t last = pump->total;
        const bool rebooted = pump->totals.pump_boot_count != pump->boot_count;
        pump->totals_step = step;
        pump->total = total;
        pump->boot_count = pump->totals.pump_boot_count;
        if (last < 0) {
            return -1;
        }
        const int32_t given = rebooted ? total : total - last;
        const int64_t estimated = pump->estimated;
        /* what was assumed too much comes off the next steps; before a reset it may well have been delivered */
        pump->estimated = rebooted || estimated < given ? 0 : estimated - given;
        return given > estimated ? (int32_t)(given - estimated) : 0;
    }
    if (pump->total < 0) {
        return -1;
    }
    const int32_t milliunits = pump->commanded == SCHEDULE ? basal : pump->commanded * 5;
    const int32_t estimate = (int32_t)round_divide(milliunits, STEPS_PER_HOUR);
    pump->estimated += estimate;
    return estimate;
}

/* Pramlintide delivered since the last total, 0.01 ug; this firmware asks for none. Before the insulin of the step is
 * judged, which takes note of the boot count. */
static int32_t pramlintide(struct pump *pump)
{
    const struct pumpbench_pump_delivered_t *totals = &pump->totals;
    if (!pump->totals_came || totals->pram_total >= PUMPBENCH_PUMP_DELIVERED_PRAM_TOTAL_ERROR_CHOICE ||
        totals->pump_boot_count >= PUMPBENCH_PUMP_DELIVERED_PUMP_BOOT_COUNT_SNA_CHOICE) {
        return 0;
    }
    const int32_t last = pump->pram_total, total = (int32_t)totals->pram_total;
    const bool rebooted = totals->pump_boot_count != pump->boot_count;
    pump->pram_fell = last >= 0 && total < last && !rebooted;
    if (pump->pram_fell) {
        return 0;
    }
    pump->pram_total = total;
    return last < 0 ? 0 : rebooted ? total : total - last;
}

/* Hold what the totals grew by against what was asked for: a motor that slips or runs away shows here, and air. Over a
 * gap nobody knows what was asked for. It only tells; what counts for doses is what the totals say. */
static void balance(struct pump *pump, int32_t insulin, int32_t pram, int32_t basal, int32_t skipped)
{
    const bool known = pump->totals_came && skipped == 0 && insulin >= 0;
    if (known && pump->balanced) {
        const int32_t rate = pump->commanded == SCHEDULE ? basal : pump->commanded * 5;
        pump->insulin_balance += (int64_t)insulin * STEPS_PER_HOUR - rate;
        pump->pram_balance += (int64_t)pram * STEPS_PER_HOUR;
    } else {
        pump->insulin_balance = 0;
        pump->pram_balance = 0;
    }
    pump->balanced = known;
}

/* Whether a balance is off by more than ten strokes; it is rounded down. */
static bool is_off(int64_t twelfths)
{
    return twelfths < -(int64_t)UNBALANCED * STEPS_PER_HOUR || twelfths >= ((int64_t)UNBALANCED + 1) * STEPS_PER_HOUR;
}

/* Fill the set-point of this step, with a new number and an absolute expiry; whether the pump's limit has cut it. */
static bool set_point(struct pump *pump, uint8_t op, int32_t step, int32_t rate, struct pumpbench_pump_basal_cmd_t *cmd)
{
    const int32_t asked = rate;
    rate = rate < pump->rate_limit ? rate : pump->rate_limit;
    pump->sequence = (pump->sequence + 1) % SEQUENCES_BASAL;
    if (pump->answers) {
        pump->unanswered += (pump->awaited & AWAIT_INSULIN) != 0u ? 1u : 0u;
        pump->unanswered += (pump->awaited & AWAIT_PRAM) != 0u ? 1u : 0u;
    }
    pump->awaited = AWAIT_INSULIN | AWAIT_PRAM;
    pump->rates_sent = op == BASAL_OP(SET_RATE);
    pump->commanded = op == BASAL_OP(SET_RATE) ? rate : op == BASAL_OP(SUSPEND) ? 0 : SCHEDULE;
    (void)pumpbench_pump_basal_cmd_init(cmd);
    cmd->basal_op = op;
    cmd->basal_cmd_seq = (uint16_t)pump->sequence;
    cmd->basal_until_step = (uint8_t)((step + RATE_EXPIRES_AFTER) % 128);
    if (pump->rates_sent) {
        cmd->insulin_rate = (uint16_t)rate;
        cmd->pramlintide_rate = 0u;
    }
    return rate != asked;
}

/* ---- the day's insulin (requirement LIM-06) */

static void day_add(struct day *day, int32_t amount, int32_t step)
{
    const int32_t hour = step / STEPS_PER_HOUR;
    for (int32_t passed = 0; passed < hour - day->hour && passed < DAY_HOURS; passed++) {
        day->hours[(hour - passed) % DAY_HOURS] = 0;
    }
    day->hour = hour;
    day->hours[hour % DAY_HOURS] += amount;
}

/* What twice the usual daily dose leaves within 24 h, mU. */
static int32_t insulin_left(const struct supervisor *supervisor, const struct calibration *calibration)
{
    int64_t left = (int64_t)calibration->supervision.insulin_tdd * 20;
    for (unsigned hour = 0u; hour < DAY_HOURS; hour++) {
        left -= supervisor->day.hours[hour];
    }
    return left > 0 ? (int32_t)left : 0;
}

/* ---- ladder: down at once, up one rung per step and only after two usable samples in a row */

#define AGE_DEGRADED 4   /* steps: from this age of the newest usable sample on, at most the schedule */
#define AGE_SAFE_BASAL 7 /* from this age on, exactly the schedule */
#define SAMPLES_UP 2u
#define PUMP_SILENT 3    /* steps without the pump after which delivery is uncertain */
#define BITES_AFTER 3u   /* overruns in a row after which the watchdog bites */

static enum ladder_state next_rung(enum ladder_state rung, int32_t age, uint32_t streak, enum ladder_state best)
{
    if (age >= AGE_SAFE_BASAL) {
        return LADDER_SAFE_BASAL;
    }
    if (best >= rung) {
        return best;
    }
    if (streak < SAMPLES_UP) {
        return rung;
    }
    return rung == LADDER_SAFE_BASAL ? LADDER_DEGRADED : LADDER_AUTO;
}

static void climb(struct supervisor *supervisor, int32_t step, const struct calibration *calibration)
{
    const int32_t age = age_of_sample(&supervisor->sensor, step);
    const uint32_t streak = supervisor->sensor.streak;
    /* CfgStaleCgmLimit as an age in steps; it can only tighten (requirement USR-05) */
    const int32_t stale = calibration->supervision.stale_cgm_limit / 5 + 1;
    const bool doubted = age >= (stale < AGE_DEGRADED ? stale : AGE_DEGRADED) || is_silent(&supervisor->sensor, step);
    const enum ladder_state best = doubted ? LADDER_DEGRADED : LADDER_AUTO;
    supervisor->rung = next_rung(supervisor->rung, age, streak, best);
    if (supervisor->parameters_damaged || supervisor->overruns_in_a_row >= BITES_AFTER) {
        supervisor->state = LADDER_FAULT;
    } else if (!calibration_active(calibration)) {
        supervisor->state = LADDER_INIT;
    } else if (supervisor->suspended || supervisor->mode == MODE_OFF) {
        supervisor->state = LADDER_SUSPENDED;
    } else if (silence_of_pump(&supervisor->pump, step) >= PUMP_SILENT) {
        supervisor->state = LADDER_DELIVERY_UNCERTAIN;
    } else if (supervisor->state == LADDER_INIT && streak < SAMPLES_UP && age < AGE_SAFE_BASAL) {
        supervisor->state = LADDER_INIT;
    } else if (supervisor->state == LADDER_INIT && streak >= SAMPLES_UP) {
        supervisor->rung = best; /* the first samples of a run are not a way back up */
        supervisor->state = best;
    } else {
        supervisor->state = supervisor->rung;
    }
}

/* Whether the control law commands rates; elsewhere its limits cut nothing. */
static bool is_commanding(enum ladder_state state)
{
    return state == LADDER_AUTO || state == LADDER_DEGRADED || state == LADDER_DELIVERY_UNCERTAIN;
}

/* ---- the user */

#define MODE_SEQUENCES 255 /* ModeCmdSeq runs from 0 to 254 */

void supervisor_hear_mode(struct supervisor *supervisor, const struct pumpbench_mode_cmd_t *command)
{
    const int32_t sequence = command->mode_cmd_seq;
    if (sequence == supervisor->mode_sequence) {
        return;
    }
    const int32_t last = supervisor->mode_sequence < 0 ? sequence - 1 : supervisor->mode_sequence;
    const int32_t ahead = (sequence - last + MODE_SEQUENCES) % MODE_SEQUENCES;
    if (sequence >= MODE_SEQUENCES || ahead > MODE_SEQUENCES / 2) {
        supervisor->sequence_errors++;
        return;
    }
    supervisor->mode_sequence = sequence;
    if (command->mode_request <= MODE_NMA) {
        supervisor->mode = (enum mode)command->mode_request;
    } else {
        supervisor->rejected = true;
    }
    if (command->suspend_request == PUMPBENCH_MODE_CMD_SUSPEND_REQUEST_SUSPEND_CHOICE) {
        supervisor->suspended = true;
    } else if (command->suspend_request == PUMPBENCH_MODE_CMD_SUSPEND_REQUEST_RESUME_CHOICE) {
        supervisor->suspended = false;
    }
}

void supervisor_hear_alarm_ack(struct supervisor *supervisor, const struct pumpbench_ui_alarm_ack_t *ack)
{
    const bool confirm = ack->alarm_ack_action == PUMPBENCH_UI_ALARM_ACK_ALARM_ACK_ACTION_CONFIRM_CHOICE;
    const bool snooze = ack->alarm_ack_action == PUMPBENCH_UI_ALARM_ACK_ALARM_ACK_ACTION_SNOOZE_CHOICE;
    if (ack->alarm_ack_node == PUMPBENCH_UI_ALARM_ACK_ALARM_ACK_NODE_CTRL_CHOICE && (confirm || snooze)) {
        alarms_acknowledge(&supervisor->alarms, ack->alarm_ack_instance, confirm);
    }
}

/* ---- whether a message may be used at all (requirement E2E-03) */

#define WINDOW_MASK 0xFu  /* the last four checks count */
#define ERRORS_AT_MOST 1u /* of them, with which a message is still valid, or becomes so */
#define OK_TO_RETURN 2u   /* after a disturbance one good frame may be chance */

void supervisor_note(struct supervisor *supervisor, enum cyclic message, enum verdict verdict)
{
    struct window *window = &supervisor->windows[message];
    window->good_came = window->good_came || verdict == VERDICT_GOOD;
    window->repeated_came = window->repeated_came || verdict == VERDICT_REPEATED;
    window->bad_came = window->bad_came || verdict == VERDICT_BAD;
}

static unsigned count_bits(uint8_t bits)
{
    unsigned count = 0u;
    for (; bits != 0u; bits &= (uint8_t)(bits - 1u)) {
        count++;
    }
    return count;
}

/* Check what came since the last step; whether it may be used. A step without a frame is no check. */
static bool close_window(struct window *window)
{
    if (window->good_came || window->repeated_came || window->bad_came) {
        const bool bad = window->bad_came && !window->good_came;
        window->good = (uint8_t)((window->good << 1 | (window->good_came ? 1u : 0u)) & WINDOW_MASK);
        window->bad = (uint8_t)((window->bad << 1 | (bad ? 1u : 0u)) & WINDOW_MASK);
        window->good_came = window->repeated_came = window->bad_came = false;
        const unsigned needed = window->state == WINDOW_INVALID ? OK_TO_RETURN : 1u;
        if (count_bits(window->good) >= needed && count_bits(window->bad) <= ERRORS_AT_MOST) {
            window->state = WINDOW_VALID;
        } else if (window->state == WINDOW_VALID) {
            window->state = WINDOW_INVALID;
        }
    }
    return window->state == WINDOW_VALID;
}

/* What came of a message that is not valid is as if it had not come. */
static void drop_invalid(struct supervisor *supervisor)
{
    if (!close_window(&supervisor->windows[CYCLIC_READING])) {
        supervisor->sensor.skipped += supervisor->sensor.heard;
        supervisor->sensor.heard = 0u;
    }
    if (!close_window(&supervisor->windows[CYCLIC_STATUS])) {
        supervisor->pump.status_came = false;
    }
    if (!close_window(&supervisor->windows[CYCLIC_TOTALS])) {
        supervisor->pump.totals_came = false;
    }
}

/* ---- the step */

#define FRAMES_AT_MOST 512u   /* frames of one step that the device can handle; more is an overrun */
#define SKIPPED_AT_MOST 288   /* steps caught up one by one after a gap; by then every filter has forgotten */
#define SELF_TEST_SECONDS 3600
#define CLOCK_TOLERANCE 60    /* seconds that SimTime may be off the step it names (requirement TIM-03) */
#define CLOCK_CAUTION 3       /* samples after a jump in which insulin stays at or below the schedule */
#define ALARM_HOLD 3          /* quiet steps after which the alarm of a passing error ends */

static void check_clock(struct supervisor *supervisor, int32_t step, uint32_t sim_time)
{
    const int32_t off = (int32_t)sim_time - step * STEP_SECONDS;
    if (sim_time != PUMPBENCH_SYNC_STEP_SIM_TIME_SNA_CHOICE && (off < -CLOCK_TOLERANCE || off > CLOCK_TOLERANCE)) {
        supervisor->clock_caution = CLOCK_CAUTION;
        supervisor->last_jump = step;
    }
}

static int32_t hear_pump(struct supervisor *supervisor, int32_t step, int32_t skipped,
                         const struct calibration *calibration)
{
    struct pump *pump = &supervisor->pump;
    if (pump->status_came) {
        follow_status(pump, step);
    }
    for (unsigned drug = 0u; drug < HORMONES; drug++) {
        if (has_bit(pump->bolus_states_came, drug)) {
            pump->bolus_step[drug] = step;
        }
    }
    pump->bolus_states_heard = (uint16_t)(pump->bolus_states_heard | pump->bolus_states_came);
    const int32_t basal = calibration->parameters.basal;
    const int32_t pram = pramlintide(pump);
    const int32_t given = delivered(pump, step, basal);
    balance(pump, given, pram, basal, skipped);
    day_add(&supervisor->day, given > 0 ? given : 0, step);
    pump->status_came = false;
    pump->totals_came = false;
    pump->bolus_states_came = 0u;
    return given;
}

/* Let insulin on board and the filters age by steps that never came (requirement TIM-02); how many. */
static int32_t catch_up(struct supervisor *supervisor, int32_t skipped, const struct calibration *calibration)
{
    const int32_t steps = skipped < SKIPPED_AT_MOST ? skipped : SKIPPED_AT_MOST;
    if (!calibration_active(calibration)) {
        return 0;
    }
    const struct control_inputs inputs = {
        .glucose = -1,
        .delivered = -1,
        .mode = supervisor->mode,
        .limit = LIMIT_SCHEDULE,
        .insulin_left = insulin_left(supervisor, calibration),
    };
    for (int32_t i = 0; i < steps; i++) {
        control_step(&supervisor->control, &calibration->parameters, &inputs, &supervisor->outputs);
    }
    return steps;
}

static void control(struct supervisor *supervisor, int32_t glucose, int32_t given,
                    const struct calibration *calibration)
{
    const struct sensor *sensor = &supervisor->sensor;
    const bool cautious = sensor->doubtful || supervisor->clock_caution > 0 || supervisor->pump.blocked;
    struct control_inputs inputs = {
        .glucose = glucose,
        .delivered = given,
        .mode = supervisor->mode,
        .limit = LIMIT_SCHEDULE,
        .reset = sensor->since_gap < SETTLING_SAMPLES,
        .insulin_left = insulin_left(supervisor, calibration),
    };
    if (supervisor->state == LADDER_SUSPENDED || sensor->below_range) {
        inputs.limit = LIMIT_SUSPEND;
    } else if (supervisor->state == LADDER_AUTO && !cautious) {
        inputs.limit = LIMIT_NONE;
    }
    if (calibration_active(calibration)) {
        control_step(&supervisor->control, &calibration->parameters, &inputs, &supervisor->outputs);
    }
}

static void command(struct supervisor *supervisor, int32_t step, const struct calibration *calibration,
                    struct report *report)
{
    struct pump *pump = &supervisor->pump;
    const enum ladder_state state = supervisor->state;
    struct pumpbench_pump_basal_cmd_t *cmd = &report->basal_cmd;
    report->commands = true;
    if (state == LADDER_DELIVERY_UNCERTAIN && supervisor->rung == LADDER_SAFE_BASAL) {
        (void)set_point(pump, BASAL_OP(RESUME_SCHEDULE), step, 0, cmd);
    } else if (is_commanding(state)) {
        if (set_point(pump, BASAL_OP(SET_RATE), step, supervisor->outputs.rate, cmd)) {
            supervisor->outputs.limiters |= LIMITER_MAX_BASAL;
        }
    } else if (state == LADDER_SUSPENDED) {
        (void)set_point(pump, BASAL_OP(SUSPEND), step, 0, cmd);
    } else if (calibration_active(calibration) && state != LADDER_FAULT) {
        (void)set_point(pump, BASAL_OP(RESUME_SCHEDULE), step, 0, cmd);
    } else {
        report->commands = false;
    }
}

/* Whether no other alarm explains that this state is entered or left: StateChange does (requirement FAL-06). */
static bool is_told_by_itself(enum ladder_state state)
{
    return state == LADDER_INIT || state == LADDER_SUSPENDED;
}

static void report_alarms(struct supervisor *supervisor, int32_t step, const struct calibration *calibration,
                          const struct link_counts *counts, struct report *report)
{
    struct alarms *alarms = &supervisor->alarms;
    const enum ladder_state state = supervisor->state;
    const int32_t age = age_of_sample(&supervisor->sensor, step);
    if (counts->e2e_errors > supervisor->e2e_errors_seen) {
        supervisor->e2e_errors_seen = counts->e2e_errors;
        supervisor->last_e2e_error = step;
    }
    /* a missing sample is told by LimiterBits, and by CgmLost when it matters */
    if ((supervisor->outputs.limiters & ~LIMITER_STALE_CGM) != 0 && state == LADDER_AUTO) {
        supervisor->last_limited = step;
    }
    if (supervisor->rejected) {
        supervisor->last_rejected = step;
        supervisor->rejected = false;
    }
    if (state != supervisor->reported && (is_told_by_itself(state) || is_told_by_itself(supervisor->reported))) {
        supervisor->last_change = step;
    }
    const bool down = supervisor->rung != LADDER_AUTO;
    const bool absent = age >= AGE_DEGRADED || is_silent(&supervisor->sensor, step);
    const bool lost = absent || (down && (alarms_active(alarms, ALARM_CGM_LOST) || state == supervisor->rung));
    /* without a calibration nothing is dosed, but a sensor that was heard and falls silent is told of all the same */
    const bool listening = calibration_active(calibration) || supervisor->sensor.sequence != NEVER;
    alarms_hold(alarms, ALARM_CGM_LOST, lost && listening, age < 0xFFFF ? age : 0xFFFF);
    alarms_hold(alarms, ALARM_CGM_IMPLAUSIBLE, step - supervisor->last_implausible < ALARM_HOLD, step);
    alarms_hold(alarms, ALARM_E2E_FAULT, step - supervisor->last_e2e_error < ALARM_HOLD, step);
    alarms_hold(alarms, ALARM_DOSE_LIMITED, step - supervisor->last_limited < ALARM_HOLD, step);
    alarms_hold(alarms, ALARM_DOSE_REJECTED, step - supervisor->last_rejected < ALARM_HOLD, step);
    const struct pump *pump = &supervisor->pump;
    const bool silent = calibration_active(calibration) && silence_of_pump(pump, step) >= PUMP_SILENT;
    alarms_hold(alarms, ALARM_PUMP_LOST, silent, step);
    const bool fallen = pump->insulin_fell || pump->pram_fell;
    const bool off = is_off(pump->insulin_balance) || is_off(pump->pram_balance);
    const bool amiss = pump->unlike >= UNLIKE_STEPS || fallen || off;
    alarms_hold(alarms, ALARM_DELIVERY_UNCERTAIN, amiss, step);
    alarms_hold(alarms, ALARM_URGENT_LOW, supervisor->urgent, step);
    alarms_hold(alarms, ALARM_CLOCK_JUMP, step - supervisor->last_jump < ALARM_HOLD, step);
    const bool bitten = supervisor->overruns_in_a_row >= BITES_AFTER;
    alarms_hold(alarms, ALARM_WATCHDOG, supervisor->late || bitten, (int32_t)(supervisor->overruns & 0xFFFFu));
    alarms_hold(alarms, ALARM_SELF_TEST, supervisor->parameters_damaged, 8); /* Failure.PARAMETERS of the reference */
    /* Suspended stays a cause: the user is reminded of it */
    const bool changed = step - supervisor->last_change < ALARM_HOLD;
    alarms_hold(alarms, ALARM_STATE_CHANGE, changed || state == LADDER_SUSPENDED, state);
    if (state != supervisor->reported) {
        /* every change of state is told with its cause in the same step, also to a user who has confirmed it */
        supervisor->reported = state;
        alarms_repeat(alarms, ALARM_CGM_LOST);
        alarms_repeat(alarms, ALARM_PUMP_LOST);
        alarms_repeat(alarms, ALARM_DELIVERY_UNCERTAIN);
        alarms_repeat(alarms, ALARM_WATCHDOG);
        alarms_repeat(alarms, ALARM_SELF_TEST);
        if (supervisor->last_change == step) {
            alarms_renew(alarms, ALARM_STATE_CHANGE);
        }
    }
    report->alarms = alarms_report(alarms, report->alarm);
}

static uint16_t at_most(uint32_t count, uint16_t largest)
{
    return count < largest ? (uint16_t)count : largest;
}

static void report_status(const struct supervisor *supervisor, const struct link_counts *counts, struct report *report)
{
    struct pumpbench_ctrl_status_t *status = &report->status;
    (void)pumpbench_ctrl_status_init(status);
    status->ctrl_mode = (uint8_t)supervisor->mode;
    status->ctrl_state = (uint8_t)supervisor->state;
    status->insulin_on_board = (uint16_t)supervisor->outputs.iob;
    status->limiter_bits = is_commanding(supervisor->state) ? supervisor->outputs.limiters : 0u;
    if (supervisor->sensor.sequence != NEVER) {
        status->last_cgm_seq = (uint16_t)supervisor->sensor.sequence;
    }
    const struct pump *pump = &supervisor->pump;
    const uint32_t numbers = counts->sequence_errors + supervisor->sequence_errors + pump->refused + pump->unanswered;
    (void)pumpbench_ctrl_diag_init(&report->diag);
    report->diag.e2e_error_count = at_most(counts->e2e_errors, 4095u);
    report->diag.lost_frame_count = at_most(counts->lost + supervisor->lost_unseen, 4095u);
    report->diag.sequence_error_count = at_most(numbers, 1023u);
    report->diag.saturation_count = at_most(supervisor->control.saturations, 1023u);
}

/* Work is counted, not timed, so that it is the same on every machine; more than a budget is an overrun. */
static void count_work(struct supervisor *supervisor, uint32_t frames, uint32_t samples)
{
    supervisor->late = frames > FRAMES_AT_MOST || samples >= SAMPLES_MAX;
    supervisor->overruns += (frames > FRAMES_AT_MOST ? 1u : 0u) + (samples >= SAMPLES_MAX ? 1u : 0u);
}

void supervisor_step(struct supervisor *supervisor, int32_t step, uint32_t sim_time,
                     const struct calibration *calibration, const struct link_counts *counts, struct report *report)
{
    drop_invalid(supervisor);
    close_heartbeat(&supervisor->pump.heartbeat, step);
    close_heartbeat(&supervisor->sensor.heartbeat, step);
    const int32_t skipped = supervisor->step < 0 ? 0 : step - supervisor->step - 1;
    const uint32_t samples = supervisor->sensor.heard;
    supervisor->step = step;
    check_clock(supervisor, step, sim_time);
    report->work = counts->frames + samples + 5u; /* one each for sensor, pump, ladder, control and command */

    const int32_t glucose =
        judge_sensor(supervisor, step, calibration->supervision.stuck_samples, counts->lost_readings);
    int32_t given = hear_pump(supervisor, step, skipped, calibration);
    const int32_t tick = step * STEP_SECONDS;
    if (tick - supervisor->self_test_tick >= SELF_TEST_SECONDS) {
        supervisor->self_test_tick = tick;
        supervisor->parameters_damaged = supervisor->parameters_damaged || !calibration_intact(calibration);
        report->work++;
    }
    climb(supervisor, step, calibration);
    report->work += (uint32_t)catch_up(supervisor, skipped, calibration);
    if (given > 0) { /* what the schedule gave in the steps that were caught up has been counted there */
        const int64_t more = given - round_divide((int64_t)calibration->parameters.basal * skipped, STEPS_PER_HOUR);
        given = more > 0 ? (int32_t)more : 0;
    }
    control(supervisor, glucose, given, calibration);
    command(supervisor, step, calibration, report);
    count_work(supervisor, counts->frames, samples);
    if (supervisor->overruns_in_a_row < BITES_AFTER) { /* the watchdog does not let go until the device restarts */
        supervisor->overruns_in_a_row = supervisor->late ? supervisor->overruns_in_a_row + 1u : 0u;
    }
    report->overrun = supervisor->late;
    report_alarms(supervisor, step, calibration, counts, report);
    report_status(supervisor, counts, report);
}

void supervisor_boot(struct supervisor *supervisor)
{
    memset(supervisor, 0, sizeof *supervisor);
    struct sensor *sensor = &supervisor->sensor;
    sensor->sequence = sensor->taken = NEVER;
    forget_heartbeat(&sensor->heartbeat);
    sensor->last = sensor->unconfirmed = sensor->value_last = -1;
    sensor->session = PUMPBENCH_CGM_STATUS_CGM_SESSION_ID_SNA_CHOICE;
    struct pump *pump = &supervisor->pump;
    pump->status_step = pump->totals_step = NEVER;
    forget_heartbeat(&pump->heartbeat);
    pump->sequence = SEQUENCES_BASAL - 1;
    pump->commanded = SCHEDULE;
    pump->rate_limit = RATE_MAX;
    pump->total = pump->pram_total = -1;
    pump->boot_count = PUMPBENCH_PUMP_DELIVERED_PUMP_BOOT_COUNT_SNA_CHOICE;
    supervisor->state = supervisor->reported = LADDER_INIT;
    supervisor->rung = LADDER_SAFE_BASAL;
    supervisor->mode = MODE_OFF;
    supervisor->mode_sequence = -1;
    supervisor->step = -1;
    supervisor->self_test_tick = -SELF_TEST_SECONDS;
    supervisor->last_e2e_error = supervisor->last_implausible = supervisor->last_limited = NEVER;
    supervisor->last_rejected = supervisor->last_jump = supervisor->last_change = NEVER;
}
