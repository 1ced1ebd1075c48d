/* Alarms: one frame per change of state, repeated every step until the user has confirmed it; at most one per code. */
#ifndef ALARMS_H
#define ALARMS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "pumpbench.h"

/* The alarms this firmware has; alarms.c knows their CtrlAlarmCode and priority. */
enum alarm_kind {
    ALARM_CGM_LOST,
    ALARM_CGM_IMPLAUSIBLE,
    ALARM_PUMP_LOST,
    ALARM_DELIVERY_UNCERTAIN,
    ALARM_DOSE_LIMITED,
    ALARM_DOSE_REJECTED,
    ALARM_E2E_FAULT,
    ALARM_WATCHDOG,
    ALARM_SELF_TEST,
    ALARM_URGENT_LOW,
    ALARM_CLOCK_JUMP,
    ALARM_STATE_CHANGE,
    ALARM_KINDS
};

struct alarm {
    bool active;
    bool changed;
    uint8_t state; /* CtrlAlarmState */
    uint16_t instance;
    uint16_t aux;
    uint8_t steps; /* reported so far, no further than it matters */
    uint8_t quiet; /* steps since the user confirmed or snoozed it */
};

struct alarms {
    struct alarm alarm[ALARM_KINDS];
    uint16_t next_instance;
};

/* Raise the alarm if its cause holds, end it if not; to be called once per step. */
void alarms_hold(struct alarms *alarms, enum alarm_kind kind, bool cause, int32_t aux);

/* The user confirms or snoozes one instance; the cause stays. */
void alarms_acknowledge(struct alarms *alarms, uint16_t instance, bool confirm);

bool alarms_active(const struct alarms *alarms, enum alarm_kind kind);

/* Send this alarm in the next report even if nothing about it has changed. */
void alarms_repeat(struct alarms *alarms, enum alarm_kind kind);

/* Something new of the same kind: pending again, also for a user who has confirmed the last one. */
void alarms_renew(struct alarms *alarms, enum alarm_kind kind);

/* Fill what changed and what is pending, highest priority first, and forget what has ended; how many. */
size_t alarms_report(struct alarms *alarms, struct pumpbench_ctrl_alarm_t frames[ALARM_KINDS]);

#endif
