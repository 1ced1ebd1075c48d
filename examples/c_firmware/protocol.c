#include "protocol.h"

#include <string.h>

#define PHASE(name) PUMPBENCH_SYNC_STEP_SYNC_PHASE_##name##_CHOICE
#define DONE(name) PUMPBENCH_SYNC_DONE_DONE_STATUS_##name##_CHOICE

#define FIRMWARE_MAJOR 0u
#define FIRMWARE_MINOR 1u

#define COUNTER_MASK 0x0Fu
#define MAX_LOST 2u /* frames that may be missing before one that is still used (requirement E2E-02) */
#define TX_COUNT_MAX 254u

/* ---- E2E Profile 2 (requirements E2E-01 to E2E-06) */

/* CRC-8/AUTOSAR over bytes 1 to the last one and then the data id that COUNTER selects. */
static uint8_t e2e_checksum(const uint8_t *data, size_t size, const uint8_t ids[16])
{
    uint8_t crc = 0xFFu;
    for (size_t i = 1u; i <= size; i++) {
        crc = (uint8_t)(crc ^ (i < size ? data[i] : ids[data[1] & COUNTER_MASK]));
        for (int bit = 0; bit < 8; bit++) {
            crc = (uint8_t)((crc & 0x80u) != 0u ? (unsigned)crc << 1 ^ 0x2Fu : (unsigned)crc << 1);
        }
    }
    return (uint8_t)(crc ^ 0xFFu);
}

/* The frame of a packed message, with COUNTER and CHECKSUM set. */
static struct frame protect(struct firmware *firmware, enum message_index index, const uint8_t *data)
{
    const struct message *message = &MESSAGE[index];
    struct frame frame = {.can_id = message->can_id, .len = message->length};
    memcpy(frame.data, data, message->length);
    if (message->is_protected) {
        frame.data[1] = (uint8_t)((frame.data[1] & 0xF0u) | firmware->counter[index]);
        frame.data[0] = e2e_checksum(frame.data, message->length, message->data_ids);
        firmware->counter[index] = (uint8_t)((firmware->counter[index] + 1u) & COUNTER_MASK);
    }
    return frame;
}

/* The message of an identifier, MESSAGES if there is none in the DBC that CTRL sends or receives. */
static unsigned find(uint32_t can_id)
{
    unsigned index = 0u;
    while (index < MESSAGES && MESSAGE[index].can_id != can_id) {
        index++;
    }
    return index;
}

/* Let the supervisor know what became of a frame of the messages whose checks it follows. */
static void note(struct firmware *firmware, unsigned index, enum verdict verdict)
{
    switch (index) {
    case MESSAGE_CGM_READING:
        supervisor_note(&firmware->supervisor, CYCLIC_READING, verdict);
        break;
    case MESSAGE_PUMP_STATUS:
        supervisor_note(&firmware->supervisor, CYCLIC_STATUS, verdict);
        break;
    case MESSAGE_PUMP_DELIVERED:
        supervisor_note(&firmware->supervisor, CYCLIC_TOTALS, verdict);
        break;
    default:
        break;
    }
}

/* Whether a frame may be read, and which message it is; what it may not is counted and has no other effect. */
static bool check(struct firmware *firmware, const struct frame *frame, unsigned *index)
{
    if ((frame->can_id & FRAME_ERROR) != 0u) { /* its id is a class of errors, no node sent it */
        firmware->e2e_errors++;
        return false;
    }
    const unsigned i = find(frame->can_id & FRAME_ID_MASK);
    const bool flagged = (frame->can_id & ~FRAME_ID_MASK) != 0u;
    if (i == MESSAGES || i == MESSAGE_UDS_REQUEST) { /* diagnostics are not answered here */
        return false;
    }
    if (!MESSAGE[i].received) {
        firmware->e2e_errors += flagged ? 0u : 1u; /* a node never hears itself: somebody uses our id */
        return false;
    }
    *index = i;
    firmware->frames_heard++;
    if (flagged || frame->len != MESSAGE[i].length) {
        firmware->e2e_errors++;
        note(firmware, i, VERDICT_BAD);
        return false;
    }
    if (!MESSAGE[i].is_protected) {
        return true;
    }
    if (frame->data[0] != e2e_checksum(frame->data, frame->len, MESSAGE[i].data_ids)) {
        firmware->e2e_errors++;
        note(firmware, i, VERDICT_BAD);
        return false;
    }
    const uint8_t counter = frame->data[1] & COUNTER_MASK;
    const uint32_t step = firmware->counter_known[i] ? ((uint32_t)counter - firmware->counter[i]) & COUNTER_MASK : 1u;
    firmware->counter[i] = counter;
    firmware->counter_known[i] = true;
    const uint32_t lost = step > 1u ? step - 1u : 0u;
    firmware->lost[i] += lost;
    if (step == 0u || lost > MAX_LOST) {
        firmware->sequence_errors++;
        if (i == MESSAGE_CGM_READING) {
            supervisor_skip_reading(&firmware->supervisor);
        }
        note(firmware, i, step == 0u ? VERDICT_REPEATED : VERDICT_BAD);
        return false;
    }
    note(firmware, i, VERDICT_GOOD);
    return true;
}

/* ---- frames out */

static void send_heartbeat(struct firmware *firmware, uint8_t nmt, struct frame *out, size_t *n)
{
    struct pumpbench_hb_ctrl_t heartbeat;
    uint8_t data[FRAME_DATA_MAX];
    (void)pumpbench_hb_ctrl_init(&heartbeat);
    heartbeat.nmt_ctrl = nmt;
    heartbeat.toggle_ctrl = firmware->toggle ? 1u : 0u;
    heartbeat.reset_cause_ctrl = PUMPBENCH_HB_CTRL_RESET_CAUSE_CTRL_POWER_ON_CHOICE;
    firmware->toggle = !firmware->toggle;
    (void)pumpbench_hb_ctrl_pack(data, &heartbeat, sizeof data);
    out[(*n)++] = protect(firmware, MESSAGE_HB_CTRL, data);
}

/* SYNC_Done, which counts the frames of the turn and itself. */
static void close_turn(struct firmware *firmware, uint32_t step, uint8_t status, uint16_t exec_time, struct frame *out,
                       size_t *n)
{
    struct pumpbench_sync_done_t done;
    uint8_t data[FRAME_DATA_MAX];
    (void)pumpbench_sync_done_init(&done);
    done.done_status = status;
    done.done_step_index = step;
    done.exec_time = exec_time;
    done.tx_count = (uint8_t)(*n + 1u < TX_COUNT_MAX ? *n + 1u : TX_COUNT_MAX);
    (void)pumpbench_sync_done_pack(data, &done, sizeof data);
    out[(*n)++] = protect(firmware, MESSAGE_SYNC_DONE, data);
}

static void send_report(struct firmware *firmware, const struct report *report, struct frame *out, size_t *n)
{
    uint8_t data[FRAME_DATA_MAX];
    if (report->commands) {
        (void)pumpbench_pump_basal_cmd_pack(data, &report->basal_cmd, sizeof data);
        out[(*n)++] = protect(firmware, MESSAGE_PUMP_BASAL_CMD, data);
    }
    for (size_t i = 0u; i < report->alarms; i++) {
        (void)pumpbench_ctrl_alarm_pack(data, &report->alarm[i], sizeof data);
        out[(*n)++] = protect(firmware, MESSAGE_CTRL_ALARM, data);
    }
    (void)pumpbench_ctrl_status_pack(data, &report->status, sizeof data);
    out[(*n)++] = protect(firmware, MESSAGE_CTRL_STATUS, data);
    (void)pumpbench_ctrl_diag_pack(data, &report->diag, sizeof data);
    out[(*n)++] = protect(firmware, MESSAGE_CTRL_DIAG, data);
    const bool calibrated = calibration_active(&firmware->calibration);
    send_heartbeat(firmware,
                   calibrated ? PUMPBENCH_HB_CTRL_NMT_CTRL_OPERATIONAL_CHOICE
                              : PUMPBENCH_HB_CTRL_NMT_CTRL_PRE_OPERATIONAL_CHOICE,
                   out, n);
}

/* ---- turns */

static void boot(struct firmware *firmware)
{
    memset(firmware, 0, sizeof *firmware);
    supervisor_boot(&firmware->supervisor);
    calibration_boot(&firmware->calibration);
}

static void answer_roll_call(struct firmware *firmware, uint32_t call, struct frame *out, size_t *n)
{
    const bool understood = !firmware->peer_known || firmware->peer_major == PROTOCOL_MAJOR;
    struct pumpbench_ctrl_info_t info;
    uint8_t data[FRAME_DATA_MAX];
    boot(firmware);
    send_heartbeat(firmware, PUMPBENCH_HB_CTRL_NMT_CTRL_BOOT_UP_CHOICE, out, n);
    (void)pumpbench_ctrl_info_init(&info);
    info.ctrl_protocol_major = PROTOCOL_MAJOR;
    info.ctrl_protocol_minor = PROTOCOL_MINOR;
    info.firmware_major = FIRMWARE_MAJOR;
    info.firmware_minor = FIRMWARE_MINOR;
    info.firmware_build = 0u;
    (void)pumpbench_ctrl_info_pack(data, &info, sizeof data);
    out[(*n)++] = protect(firmware, MESSAGE_CTRL_INFO, data);
    close_turn(firmware, call, understood ? DONE(OK) : DONE(FAULT), PUMPBENCH_SYNC_DONE_EXEC_TIME_SNA_CHOICE, out, n);
    boot(firmware); /* the run starts with fresh counters, however often the roll was called */
}

static void run_step(struct firmware *firmware, const struct pumpbench_sync_step_t *token, struct frame *out, size_t *n)
{
    struct link_counts counts = {
        .frames = firmware->frames_heard,
        .e2e_errors = firmware->e2e_errors,
        .lost_readings = firmware->lost[MESSAGE_CGM_READING],
        .sequence_errors = firmware->sequence_errors,
    };
    for (unsigned i = 0u; i < MESSAGES; i++) {
        counts.lost += firmware->lost[i];
    }
    struct report report;
    supervisor_step(&firmware->supervisor, (int32_t)token->step_index, token->sim_time, &firmware->calibration, &counts,
                    &report);
    firmware->frames_heard = 0u;
    send_report(firmware, &report, out, n);
    const uint32_t largest = PUMPBENCH_SYNC_DONE_EXEC_TIME_SNA_CHOICE - 1u;
    close_turn(firmware, token->step_index, report.overrun ? DONE(OVERRUN) : DONE(OK),
               (uint16_t)(report.work < largest ? report.work : largest), out, n);
}

/* Answer a token; false at the end of the run. */
static bool take_turn(struct firmware *firmware, const struct pumpbench_sync_step_t *token, struct frame *out, size_t *n)
{
    if (token->sync_phase == PHASE(INIT)) {
        answer_roll_call(firmware, token->step_index, out, n);
        return true;
    }
    memcpy(out, firmware->echo, firmware->echoes * sizeof *out);
    *n = firmware->echoes;
    firmware->echoes = 0u;
    if (token->sync_phase == PHASE(STEP) && token->step_index != PUMPBENCH_SYNC_STEP_STEP_INDEX_SNA_CHOICE &&
        (int32_t)token->step_index > firmware->supervisor.step) {
        run_step(firmware, token, out, n);
        return true;
    }
    /* also a step that was done before: its doses are out, and are not given again */
    close_turn(firmware, token->step_index, DONE(OK), PUMPBENCH_SYNC_DONE_EXEC_TIME_SNA_CHOICE, out, n);
    return token->sync_phase != PHASE(END);
}

static void store_parameter(struct firmware *firmware, const struct pumpbench_cfg_param_t *param)
{
    if (firmware->echoes < FIRMWARE_ECHOES) { /* what cannot be echoed is not stored either */
        struct pumpbench_cfg_param_echo_t echo;
        uint8_t data[FRAME_DATA_MAX];
        calibration_store(&firmware->calibration, param, &echo);
        (void)pumpbench_cfg_param_echo_pack(data, &echo, sizeof data);
        firmware->echo[firmware->echoes++] = protect(firmware, MESSAGE_CFG_PARAM_ECHO, data);
    }
}

/* ---- frames in */

#define UNPACK(message, frame)             \
    struct pumpbench_##message##_t values; \
    (void)pumpbench_##message##_unpack(&values, (frame)->data, (frame)->len)

bool firmware_receive(struct firmware *firmware, const struct frame *in, struct frame *out, size_t *n)
{
    struct supervisor *supervisor = &firmware->supervisor;
    unsigned index = MESSAGES;
    *n = 0u;
    if (!check(firmware, in, &index)) {
        return true;
    }
    switch (index) {
    case MESSAGE_SYNC_STEP: {
        UNPACK(sync_step, in);
        return take_turn(firmware, &values, out, n);
    }
    case MESSAGE_PLANT_INFO: {
        UNPACK(plant_info, in);
        firmware->peer_known = true;
        firmware->peer_major = values.plant_protocol_major;
        return true;
    }
    case MESSAGE_CFG_PARAM: {
        UNPACK(cfg_param, in);
        store_parameter(firmware, &values);
        return true;
    }
    case MESSAGE_MODE_CMD: {
        UNPACK(mode_cmd, in);
        supervisor_hear_mode(supervisor, &values);
        return true;
    }
    case MESSAGE_UI_ALARM_ACK: {
        UNPACK(ui_alarm_ack, in);
        supervisor_hear_alarm_ack(supervisor, &values);
        return true;
    }
    case MESSAGE_CGM_READING: {
        UNPACK(cgm_reading, in);
        supervisor_hear_reading(supervisor, &values);
        return true;
    }
    case MESSAGE_CGM_STATUS: {
        UNPACK(cgm_status, in);
        supervisor_hear_cgm_status(supervisor, &values);
        return true;
    }
    case MESSAGE_PUMP_STATUS: {
        UNPACK(pump_status, in);
        supervisor_hear_pump_status(supervisor, &values);
        return true;
    }
    case MESSAGE_PUMP_DELIVERED: {
        UNPACK(pump_delivered, in);
        supervisor_hear_delivered(supervisor, &values);
        return true;
    }
    case MESSAGE_PUMP_BOLUS_STATE: {
        UNPACK(pump_bolus_state, in);
        supervisor_hear_bolus_state(supervisor, &values);
        return true;
    }
    case MESSAGE_PUMP_ACK: {
        UNPACK(pump_ack, in);
        if (!supervisor_hear_ack(supervisor, &values)) {
            firmware->e2e_errors++; /* the pump runs a set-point that somebody else sent with our number */
        }
        return true;
    }
    case MESSAGE_HB_CGM: {
        UNPACK(hb_cgm, in);
        supervisor_hear_cgm_heartbeat(supervisor, &values);
        return true;
    }
    case MESSAGE_HB_PUMP: {
        UNPACK(hb_pump, in);
        supervisor_hear_pump_heartbeat(supervisor, &values);
        return true;
    }
    default: /* the pump's alarms are checked and counted; meals mean nothing to mode nma */
        return true;
    }
}

void firmware_start(struct firmware *firmware, struct frame *out, size_t *n)
{
    *n = 0u;
    boot(firmware);
    send_heartbeat(firmware, PUMPBENCH_HB_CTRL_NMT_CTRL_BOOT_UP_CHOICE, out, n);
}
