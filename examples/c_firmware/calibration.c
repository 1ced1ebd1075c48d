#include "calibration.h"

#include <string.h>

#define REQUIRED INT32_MIN /* without it no set becomes active */
#define ANY INT32_MIN      /* whatever the range of the DBC allows */
#define NEEDED 10u         /* nor without any index below, whatever the mode (requirement STA-01) */

/* CfgIndex and signal, the least raw value that is plausible (project's choice), and what counts if it was not flashed:
 * of limits and options the tight value, never unlimited (requirement LIM-04). This firmware gives no boluses and no
 * pramlintide; what belongs to them is stored and echoed all the same, for the bench goes on only if every echo fits. */
#define PARAMETER_LIST(P)                               \
    P(CFG_BASAL, cfg_basal, 1, REQUIRED)                \
    P(CFG_CARB_RATIO, cfg_carb_ratio, 100, REQUIRED)    \
    P(CFG_GLUCOSE_TARGET, cfg_glucose_target, 600, REQUIRED) \
    P(CFG_MAX_BASAL, cfg_max_basal, ANY, REQUIRED)      \
    P(CFG_MAX_BOLUS, cfg_max_bolus, ANY, REQUIRED)      \
    P(CFG_MAX_IOB, cfg_max_iob, ANY, REQUIRED)          \
    P(CFG_PRAM_RATIO, cfg_pram_ratio, ANY, REQUIRED)    \
    P(CFG_PRAM_BOLUS, cfg_pram_bolus, ANY, REQUIRED)    \
    P(CFG_INSULIN_TDD, cfg_insulin_tdd, ANY, 0)         \
    P(CFG_STALE_CGM_LIMIT, cfg_stale_cgm_limit, ANY, 15) \
    P(CFG_MEAL_GAIN, cfg_meal_gain, 10000, REQUIRED)    \
    P(CFG_INSULIN_GAIN, cfg_insulin_gain, 10000, REQUIRED) \
    P(CFG_OBSERVER_GAIN, cfg_observer_gain, ANY, REQUIRED) \
    P(CFG_BOLUS_DEDUCTION, cfg_bolus_deduction, ANY, REQUIRED) \
    P(CFG_MEAL_FACTOR, cfg_meal_factor, ANY, REQUIRED)  \
    P(CFG_ASSUMED_CARBS, cfg_assumed_carbs, ANY, REQUIRED) \
    P(CFG_LEAD1_B0, cfg_lead1_b0, ANY, REQUIRED)        \
    P(CFG_LEAD1_B1, cfg_lead1_b1, ANY, REQUIRED)        \
    P(CFG_LEAD2_B0, cfg_lead2_b0, ANY, REQUIRED)        \
    P(CFG_LEAD2_B1, cfg_lead2_b1, ANY, REQUIRED)        \
    P(CFG_LEAD_A1, cfg_lead_a1, ANY, REQUIRED)          \
    P(CFG_INSULIN_A11, cfg_insulin_a11, ANY, REQUIRED)  \
    P(CFG_INSULIN_A21, cfg_insulin_a21, ANY, REQUIRED)  \
    P(CFG_INSULIN_A22, cfg_insulin_a22, ANY, REQUIRED)  \
    P(CFG_INSULIN_A31, cfg_insulin_a31, ANY, REQUIRED)  \
    P(CFG_INSULIN_A32, cfg_insulin_a32, ANY, REQUIRED)  \
    P(CFG_INSULIN_A33, cfg_insulin_a33, ANY, REQUIRED)  \
    P(CFG_INSULIN_B1, cfg_insulin_b1, ANY, REQUIRED)    \
    P(CFG_INSULIN_B2, cfg_insulin_b2, ANY, REQUIRED)    \
    P(CFG_INSULIN_B3, cfg_insulin_b3, ANY, REQUIRED)    \
    P(CFG_FILTER_A1, cfg_filter_a1, ANY, REQUIRED)      \
    P(CFG_FILTER_A2, cfg_filter_a2, ANY, REQUIRED)      \
    P(CFG_FILTER_A3, cfg_filter_a3, ANY, REQUIRED)      \
    P(CFG_FILTER_B1, cfg_filter_b1, ANY, REQUIRED)      \
    P(CFG_FILTER_B2, cfg_filter_b2, ANY, REQUIRED)      \
    P(CFG_FILTER_B3, cfg_filter_b3, ANY, REQUIRED)      \
    P(CFG_PEAK_RATIO, cfg_peak_ratio, ANY, REQUIRED)    \
    P(CFG_PEAK_SLOPE, cfg_peak_slope, ANY, REQUIRED)    \
    P(CFG_PEAK_LOCKOUT, cfg_peak_lockout, ANY, REQUIRED) \
    P(CFG_BASAL_FACTOR, cfg_basal_factor, ANY, 0)       \
    P(CFG_LOW_SUSPEND, cfg_low_suspend, ANY, 700)       \
    P(CFG_BOLUS_LOCKOUT, cfg_bolus_lockout, ANY, 3)     \
    P(CFG_MAX_RISE, cfg_max_rise, ANY, 2000)            \
    P(CFG_PRAM_TDD, cfg_pram_tdd, ANY, 0)               \
    P(CFG_STUCK_SAMPLES, cfg_stuck_samples, ANY, 10)

#define INDEX(name) PUMPBENCH_CFG_PARAM_CFG_INDEX_##name##_CHOICE

/* The raw value of a CFG_Param and whether it may be used; false for an index that does not exist, too. */
static bool take(const struct pumpbench_cfg_param_t *param, int32_t *value)
{
    switch (param->cfg_index) {
#define TAKE(name, field, lowest, unset) \
    case INDEX(name):                    \
        *value = (int32_t)param->field;  \
        return *value >= (lowest) && pumpbench_cfg_param_##field##_is_in_range(param->field);
        PARAMETER_LIST(TAKE)
#undef TAKE
    default:
        return false;
    }
}

static int32_t unset(unsigned index)
{
    switch (index) {
#define UNSET(name, field, lowest, unset) \
    case INDEX(name):                     \
        return (unset);
        PARAMETER_LIST(UNSET)
#undef UNSET
    default:
        return 0;
    }
}

static bool is_known(const struct value_set *set, unsigned index)
{
    return (set->known >> index & 1u) != 0u;
}

static int32_t value_of(const struct value_set *set, unsigned index)
{
    return is_known(set, index) ? set->value[index] : unset(index);
}

static bool is_complete(const struct value_set *set)
{
    for (unsigned index = 0u; index < CFG_INDICES; index++) {
        if ((index < NEEDED || unset(index) == REQUIRED) && !is_known(set, index)) {
            return false;
        }
    }
    return true;
}

static uint16_t crc_of_byte(uint16_t crc, uint32_t byte)
{
    crc = (uint16_t)(crc ^ (byte & 0xFFu) << 8);
    for (int bit = 0; bit < 8; bit++) {
        crc = (uint16_t)((crc & 0x8000u) != 0u ? (unsigned)crc << 1 ^ 0x1021u : (unsigned)crc << 1);
    }
    return crc;
}

/* CRC-16/CCITT-FALSE over index (1 byte) and raw value (4 bytes, little endian, signed) in order of index. */
static uint16_t set_crc(const struct value_set *set)
{
    uint16_t crc = 0xFFFFu;
    for (unsigned index = 0u; index < CFG_INDICES; index++) {
        if (is_known(set, index)) {
            crc = crc_of_byte(crc, index);
            for (unsigned shift = 0u; shift < 32u; shift += 8u) {
                crc = crc_of_byte(crc, (uint32_t)set->value[index] >> shift);
            }
        }
    }
    return crc;
}

static struct parameters parameters_of(const struct value_set *set)
{
    const struct parameters parameters = {
        .basal = value_of(set, INDEX(CFG_BASAL)),
        .target = value_of(set, INDEX(CFG_GLUCOSE_TARGET)),
        .max_basal = value_of(set, INDEX(CFG_MAX_BASAL)),
        .basal_factor = value_of(set, INDEX(CFG_BASAL_FACTOR)),
        .max_iob = value_of(set, INDEX(CFG_MAX_IOB)),
        .max_rise = value_of(set, INDEX(CFG_MAX_RISE)),
        .low_suspend = value_of(set, INDEX(CFG_LOW_SUSPEND)),
        .meal_gain = value_of(set, INDEX(CFG_MEAL_GAIN)),
        .insulin_gain = value_of(set, INDEX(CFG_INSULIN_GAIN)),
        .observer_gain = value_of(set, INDEX(CFG_OBSERVER_GAIN)),
        .lead1_b0 = value_of(set, INDEX(CFG_LEAD1_B0)),
        .lead1_b1 = value_of(set, INDEX(CFG_LEAD1_B1)),
        .lead2_b0 = value_of(set, INDEX(CFG_LEAD2_B0)),
        .lead2_b1 = value_of(set, INDEX(CFG_LEAD2_B1)),
        .lead_a1 = value_of(set, INDEX(CFG_LEAD_A1)),
        .insulin_a11 = value_of(set, INDEX(CFG_INSULIN_A11)),
        .insulin_a21 = value_of(set, INDEX(CFG_INSULIN_A21)),
        .insulin_a22 = value_of(set, INDEX(CFG_INSULIN_A22)),
        .insulin_a31 = value_of(set, INDEX(CFG_INSULIN_A31)),
        .insulin_a32 = value_of(set, INDEX(CFG_INSULIN_A32)),
        .insulin_a33 = value_of(set, INDEX(CFG_INSULIN_A33)),
        .insulin_b1 = value_of(set, INDEX(CFG_INSULIN_B1)),
        .insulin_b2 = value_of(set, INDEX(CFG_INSULIN_B2)),
        .insulin_b3 = value_of(set, INDEX(CFG_INSULIN_B3)),
    };
    return parameters;
}

static struct supervision supervision_of(const struct value_set *set)
{
    const struct supervision supervision = {
        .insulin_tdd = value_of(set, INDEX(CFG_INSULIN_TDD)),
        .stale_cgm_limit = value_of(set, INDEX(CFG_STALE_CGM_LIMIT)),
        .stuck_samples = value_of(set, INDEX(CFG_STUCK_SAMPLES)),
    };
    return supervision;
}

void calibration_boot(struct calibration *calibration)
{
    memset(calibration, 0, sizeof *calibration);
    calibration->supervision = supervision_of(&calibration->active);
}

bool calibration_active(const struct calibration *calibration)
{
    return calibration->active.known != 0u;
}

bool calibration_intact(const struct calibration *calibration)
{
    if (!calibration_active(calibration)) {
        return true;
    }
    const struct parameters parameters = parameters_of(&calibration->active);
    const struct supervision supervision = supervision_of(&calibration->active);
    return set_crc(&calibration->active) == calibration->active_crc &&
           memcmp(&parameters, &calibration->parameters, sizeof parameters) == 0 &&
           memcmp(&supervision, &calibration->supervision, sizeof supervision) == 0;
}

static void activate(struct calibration *calibration)
{
    if (is_complete(&calibration->received)) {
        calibration->active = calibration->received;
        calibration->active_crc = set_crc(&calibration->active);
        calibration->parameters = parameters_of(&calibration->active);
        calibration->supervision = supervision_of(&calibration->active);
    }
}

void calibration_store(struct calibration *calibration, const struct pumpbench_cfg_param_t *param,
                       struct pumpbench_cfg_param_echo_t *echo)
{
    const unsigned index = param->cfg_index;
    int32_t stored = 0;
    if (index == INDEX(CFG_SET_CRC)) {
        if (set_crc(&calibration->received) == param->cfg_set_crc) {
            activate(calibration);
        }
        stored = calibration->active_crc;
    } else if (index < CFG_INDICES) {
        int32_t value = 0;
        if (take(param, &value)) {
            calibration->received.value[index] = value;
            calibration->received.known |= UINT64_C(1) << index;
        }
        stored = is_known(&calibration->received, index) ? calibration->received.value[index] : 0;
    }
    (void)pumpbench_cfg_param_echo_init(echo);
    echo->echo_index = (uint8_t)index;
    echo->echo_raw = (uint32_t)stored & 0x3FFFFFFFu;
    echo->echo_set_crc = set_crc(&calibration->received);
}
