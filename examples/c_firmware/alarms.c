#include "alarms.h"

#define CODE(name) PUMPBENCH_CTRL_ALARM_CTRL_ALARM_CODE_##name##_CHOICE
#define STATE(name) PUMPBENCH_CTRL_ALARM_CTRL_ALARM_STATE_##name##_CHOICE
#define PRIORITY(name) PUMPBENCH_CTRL_ALARM_CTRL_ALARM_PRIORITY_##name##_CHOICE

#define STEPS_AT_LEAST 6u  /* a flapping cause raises one alarm in 30 min (requirement FAL-03) */
#define STEPS_CONFIRMED 6u /* then it is pending again if its cause still holds (requirement ALM-04) */
#define STEPS_SUSPENDED 3u /* the same of StateChange, which reminds of Suspended */
#define INSTANCES 65535u   /* they run from 0 to 65534; 65535 is SNA */

static const struct {
    uint8_t code;
    uint8_t priority;
} KIND[ALARM_KINDS] = {
    [ALARM_CGM_LOST] = {CODE(CGM_LOST), PRIORITY(MEDIUM)},
    [ALARM_CGM_IMPLAUSIBLE] = {CODE(CGM_IMPLAUSIBLE), PRIORITY(MEDIUM)},
    [ALARM_PUMP_LOST] = {CODE(PUMP_LOST), PRIORITY(HIGH)},
    [ALARM_DELIVERY_UNCERTAIN] = {CODE(DELIVERY_UNCERTAIN), PRIORITY(HIGH)},
    [ALARM_DOSE_LIMITED] = {CODE(DOSE_LIMITED), PRIORITY(LOW)},
    [ALARM_DOSE_REJECTED] = {CODE(DOSE_REJECTED), PRIORITY(LOW)},
    [ALARM_E2E_FAULT] = {CODE(E2_E_FAULT), PRIORITY(MEDIUM)},
    [ALARM_WATCHDOG] = {CODE(WATCHDOG), PRIORITY(HIGH)},
    [ALARM_SELF_TEST] = {CODE(SELF_TEST), PRIORITY(HIGH)},
    [ALARM_URGENT_LOW] = {CODE(URGENT_LOW), PRIORITY(HIGH)},
    [ALARM_CLOCK_JUMP] = {CODE(CLOCK_JUMP), PRIORITY(LOW)},
    [ALARM_STATE_CHANGE] = {CODE(STATE_CHANGE), PRIORITY(INFO)},
};

void alarms_hold(struct alarms *alarms, enum alarm_kind kind, bool cause, int32_t aux)
{
    struct alarm *alarm = &alarms->alarm[kind];
    const uint16_t low_bits = (uint16_t)((uint32_t)aux & 0xFFFFu);
    if (cause && !alarm->active) {
        const struct alarm raised = {
            .active = true, .changed = true, .state = STATE(PENDING), .instance = alarms->next_instance, .aux = low_bits};
        *alarm = raised;
        alarms->next_instance = (uint16_t)((alarms->next_instance + 1u) % INSTANCES);
    } else if (cause) {
        alarm->aux = low_bits;
        alarm->quiet = (uint8_t)(alarm->state == STATE(PENDING) ? 0u : alarm->quiet + 1u);
        if (alarm->quiet > (kind == ALARM_STATE_CHANGE ? STEPS_SUSPENDED : STEPS_CONFIRMED)) {
            alarm->state = STATE(PENDING);
            alarm->quiet = 0u;
        }
    } else if (alarm->active && alarm->steps >= STEPS_AT_LEAST) {
        alarm->state = STATE(INACTIVE);
        alarm->changed = true;
    }
}

void alarms_acknowledge(struct alarms *alarms, uint16_t instance, bool confirm)
{
    for (unsigned kind = 0u; kind < ALARM_KINDS; kind++) {
        struct alarm *alarm = &alarms->alarm[kind];
        if (alarm->active && alarm->instance == instance &&
            (alarm->state == STATE(PENDING) || alarm->state == STATE(SNOOZED))) {
            alarm->state = confirm ? STATE(CONFIRMED) : STATE(SNOOZED);
            alarm->changed = true;
            return;
        }
    }
}

bool alarms_active(const struct alarms *alarms, enum alarm_kind kind)
{
    return alarms->alarm[kind].active;
}

void alarms_repeat(struct alarms *alarms, enum alarm_kind kind)
{
    alarms->alarm[kind].changed = true; /* of no meaning while it is not active */
}

void alarms_renew(struct alarms *alarms, enum alarm_kind kind)
{
    alarms->alarm[kind].state = STATE(PENDING);
    alarms->alarm[kind].changed = true;
}

/* Whether `a` is told before `b`. */
static bool goes_first(const struct alarms *alarms, unsigned a, unsigned b)
{
    if (KIND[a].priority != KIND[b].priority) {
        return KIND[a].priority > KIND[b].priority;
    }
    return alarms->alarm[a].instance < alarms->alarm[b].instance;
}

size_t alarms_report(struct alarms *alarms, struct pumpbench_ctrl_alarm_t frames[ALARM_KINDS])
{
    unsigned order[ALARM_KINDS];
    size_t active = 0u;
    for (unsigned kind = 0u; kind < ALARM_KINDS; kind++) {
        if (alarms->alarm[kind].active) {
            size_t place = active++;
            for (; place > 0u && goes_first(alarms, kind, order[place - 1u]); place--) {
                order[place] = order[place - 1u];
            }
            order[place] = kind;
        }
    }
    size_t sent = 0u;
    for (size_t place = 0u; place < active; place++) {
        const unsigned kind = order[place];
        struct alarm *alarm = &alarms->alarm[kind];
        if (alarm->changed || alarm->state == STATE(PENDING)) {
            struct pumpbench_ctrl_alarm_t *frame = &frames[sent++];
            (void)pumpbench_ctrl_alarm_init(frame);
            frame->ctrl_alarm_state = alarm->state;
            frame->ctrl_alarm_priority = KIND[kind].priority;
            frame->ctrl_alarm_code = KIND[kind].code;
            frame->ctrl_alarm_instance = alarm->instance;
            frame->ctrl_alarm_aux = alarm->aux;
            alarm->changed = false;
        }
        alarm->steps = (uint8_t)(alarm->steps < STEPS_AT_LEAST ? alarm->steps + 1u : STEPS_AT_LEAST);
        alarm->active = alarm->state != STATE(INACTIVE);
    }
    return sent;
}
