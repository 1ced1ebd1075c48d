"""The firmware as a node on the bus: frames in, one pass of its tasks per step, frames out.

It speaks only in its turn (see `can_bus.lockstep`). Between two tokens it only remembers what arrived; the token runs
the tasks in a fixed order: calibration and user input, sensor, pump, ladder, control law, commands, alarms, status.
"""

from collections.abc import Callable, Sequence

import dbc
from can_bus.codec import Check, Receiver, Transmitter
from can_bus.frame import Frame
from can_bus.lockstep import Done, Phase, Turn

from .alarms import Alarms, Code
from .calibration import Calibration
from .cgm import Cgm
from .control import layout
from .control.core import (
    MODE_NMA,
    MODE_OFF,
    MODE_OPEN_LOOP,
    MODE_S2,
    control_step,
)
from .control.fixed import Ints
from .ladder import AGE_DEGRADED, Ladder, State
from .pump import Op, Pump

VERSION = (0, 1)

SUPPORTED_MODES = (MODE_OFF, MODE_OPEN_LOOP, MODE_NMA, MODE_S2)
"""Modes this build accepts from MODE_Cmd; the rest are refused with DoseRejected."""

COMMANDING = (State.AUTO, State.DEGRADED, State.DELIVERY_UNCERTAIN)
"""States in which the control law commands rates; in the others its limits cut nothing."""

ALARM_HOLD = 3
"""Quiet steps after which the alarm of a passing error ends (project's choice)."""

NMT_BOOT_UP, NMT_OPERATIONAL, NMT_PRE_OPERATIONAL = 0, 5, 127

REQUEST_SUSPEND, REQUEST_RESUME = 1, 2

STEP_SNA = 1048575

MODE_SEQUENCES = 255
"""ModeCmdSeq runs from 0 to 254; 255 is SNA."""


def subscriptions() -> list[str]:
    """Names of the messages the DBC addresses to CTRL."""
    return [message.name for message in dbc.load().messages if "CTRL" in message.receivers]


class Firmware:
    """The dosing controller, without a bus: see `can_bus.lockstep.Node`."""

    def __init__(self) -> None:
        self.finished = False
        self._handlers: dict[str, Callable[[dict[str, int]], None]] = {
            "CGM_Reading": self._on_cgm_reading,
            "PUMP_Status": self._on_pump_status,
            "PUMP_Delivered": self._on_pump_delivered,
            "MODE_Cmd": self._on_mode_cmd,
            "CFG_Param": self._on_cfg_param,
            "UI_AlarmAck": self._on_alarm_ack,
            "PLANT_Info": self._on_plant_info,
        }
        self._boot()

    def _boot(self) -> None:
        """Everything as after power-on."""
        self._transmitter = Transmitter()
        self._receiver = Receiver(subscriptions())
        self._turn = Turn(self._transmitter)
        self._calibration = Calibration()
        self._alarms = Alarms()
        self._cgm = Cgm()
        self._pump = Pump()
        self._ladder = Ladder()
        self._state: Ints = [0] * len(layout.STATE)
        self._inputs: Ints = [0] * len(layout.INPUTS)
        self._outputs: Ints = [0] * len(layout.OUTPUTS)
        self._mode = MODE_OFF
        self._mode_sequence: int | None = None
        self._suspended = False
        self._step: int | None = None
        self._samples: list[dict[str, int]] = []
        self._totals: dict[str, int] | None = None
        self._status_heard = False
        self._rejected = False
        self._peer_version: tuple[int, int] | None = None
        self._toggle = 0
        self._crc_errors_seen = 0
        self._lost_samples_seen = 0  # of the CGM, by the counter of its frames, when the newest sample came
        self._lost_unseen = 0  # CGM frames lost that this counter could not show
        self._sequence_errors = 0
        self._reported_state = State.INIT
        self._last_e2e_error = -STEP_SNA
        self._last_implausible = -STEP_SNA
        self._last_limited = -STEP_SNA
        self._last_rejected = -STEP_SNA

    # ---- frames in

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """Take one frame; only a token is answered."""
        check, name, values, _ = self._receiver.receive(frame)
        if check > Check.OK_SOME_LOST:
            if check in (Check.REPEATED, Check.WRONG_SEQUENCE) and name == "CGM_Reading":
                self._cgm.skip()
            return ()
        if name == "SYNC_Step":
            return self._on_token(values)
        handler = self._handlers.get(name)
        if handler is not None:
            handler(values)
        return ()

    def _on_cgm_reading(self, values: dict[str, int]) -> None:
        self._samples.append(values)

    def _on_pump_status(self, _values: dict[str, int]) -> None:
        self._status_heard = True

    def _on_pump_delivered(self, values: dict[str, int]) -> None:
        self._totals = values

    def _on_plant_info(self, values: dict[str, int]) -> None:
        self._peer_version = (values["PlantProtocolMajor"], values["PlantProtocolMinor"])

    def _on_cfg_param(self, values: dict[str, int]) -> None:
        self._turn.send("CFG_ParamEcho", **self._calibration.store(values))

    def _on_mode_cmd(self, values: dict[str, int]) -> None:
        sequence = values["ModeCmdSeq"]
        if sequence == self._mode_sequence:
            return
        last = sequence - 1 if self._mode_sequence is None else self._mode_sequence
        if sequence >= MODE_SEQUENCES or (sequence - last) % MODE_SEQUENCES > MODE_SEQUENCES // 2:
            self._sequence_errors += 1
            return
        self._mode_sequence = sequence
        if values["ModeRequest"] in SUPPORTED_MODES:
            self._mode = values["ModeRequest"]
        else:
            self._rejected = True
        if values["SuspendRequest"] == REQUEST_SUSPEND:
            self._suspended = True
        elif values["SuspendRequest"] == REQUEST_RESUME:
            self._suspended = False

    def _on_alarm_ack(self, values: dict[str, int]) -> None:
        if values["AlarmAckNode"] == 1 and values["AlarmAckAction"] in (1, 2):
            self._alarms.acknowledge(values["AlarmAckInstance"], confirm=values["AlarmAckAction"] == 1)

    # ---- turns

    def _on_token(self, values: dict[str, int]) -> list[Frame]:
        phase, step = values["SyncPhase"], values["StepIndex"]
        if phase == Phase.INIT:
            return self._answer_roll_call(step)
        if phase == Phase.STEP and step != STEP_SNA:
            if self._step is None or step > self._step:
                self._run_step(step)
        elif phase == Phase.END:
            self.finished = True
        return self._turn.close(step)

    def _answer_roll_call(self, call: int) -> list[Frame]:
        peer = self._peer_version
        self._boot()
        major, minor = dbc.protocol_version()
        self._send_heartbeat(NMT_BOOT_UP)
        self._turn.send(
            "CTRL_Info",
            CtrlProtocolMajor=major,
            CtrlProtocolMinor=minor,
            FirmwareMajor=VERSION[0],
            FirmwareMinor=VERSION[1],
            FirmwareBuild=0,
        )
        understood = peer is None or peer[0] == major
        answer = self._turn.close(call, Done.OK if understood else Done.FAULT)
        self._boot()  # the run starts with fresh counters, however often the roll was called
        return answer

    def _run_step(self, step: int) -> None:
        self._step = step
        glucose = self._judge_sensor(step)
        delivered = self._hear_pump(step)
        state = self._ladder.update(
            calibrated=self._calibration.active,
            suspended=self._suspended or self._mode == MODE_OFF,
            age=self._cgm.age(step),
            streak=self._cgm.streak,
            pump_age=self._pump.age(step),
        )
        self._control(state, glucose, delivered)
        self._command(state, step)
        self._report_alarms(state, step)
        self._report_status(state)

    def _judge_sensor(self, step: int) -> int:
        verdict = self._cgm.judge(self._samples, step)
        self._samples = []
        if verdict.glucose >= 0:
            # the 4-bit counter of the frames is blind to a gap of 16, the number of the sample is not
            lost = self._receiver.lost_of("CGM_Reading")
            self._lost_unseen += max(verdict.missing - (lost - self._lost_samples_seen), 0)
            self._lost_samples_seen = lost
        self._sequence_errors += verdict.repeated
        if verdict.refused or verdict.repeated:
            self._last_implausible = step
        return verdict.glucose

    def _hear_pump(self, step: int) -> int:
        if self._status_heard:
            self._pump.status(step)
        basal = self._calibration.parameters[layout.BASAL]
        delivered = self._pump.delivered(self._totals, step, basal)
        self._status_heard = False
        self._totals = None
        return delivered

    def _control(self, state: State, glucose: int, delivered: int) -> None:
        inputs = self._inputs
        inputs[layout.IN_GLUCOSE] = glucose
        inputs[layout.IN_DELIVERED] = delivered
        inputs[layout.IN_MODE] = self._mode
        inputs[layout.IN_RESET] = 1 if self._cgm.settling else 0
        if state == State.SUSPENDED or self._cgm.below_range:
            inputs[layout.IN_LIMIT] = layout.LIMIT_SUSPEND
        elif state == State.AUTO:
            inputs[layout.IN_LIMIT] = layout.LIMIT_NONE
        else:
            inputs[layout.IN_LIMIT] = layout.LIMIT_SCHEDULE
        if self._calibration.active:
            control_step(self._state, self._calibration.parameters, inputs, self._outputs)

    def _command(self, state: State, step: int) -> None:
        if state == State.DELIVERY_UNCERTAIN and self._ladder.rung == State.SAFE_BASAL:
            self._pump.command(self._turn, Op.RESUME_SCHEDULE, step)
        elif state in (State.AUTO, State.DEGRADED, State.DELIVERY_UNCERTAIN):
            rate, pramlintide = self._outputs[layout.OUT_RATE], self._outputs[layout.OUT_PRAM_RATE]
            self._pump.command(self._turn, Op.SET_RATE, step, rate, pramlintide if rate > 0 else 0)
        elif state == State.SUSPENDED:
            self._pump.command(self._turn, Op.SUSPEND, step)
        elif self._calibration.active:
            self._pump.command(self._turn, Op.RESUME_SCHEDULE, step)

    def _report_alarms(self, state: State, step: int) -> None:
        alarms = self._alarms
        age = self._cgm.age(step)
        if self._receiver.crc_errors + self._receiver.malformed > self._crc_errors_seen:
            self._crc_errors_seen = self._receiver.crc_errors + self._receiver.malformed
            self._last_e2e_error = step
        # a missing sample is told by LimiterBits, and by CgmLost when it matters
        if self._outputs[layout.OUT_LIMITERS] & ~layout.LIMITER_STALE_CGM and state == State.AUTO:
            self._last_limited = step
        if self._rejected:
            self._last_rejected = step
            self._rejected = False
        down = self._ladder.rung != State.AUTO
        lost = age >= AGE_DEGRADED or (down and (alarms.active(Code.CGM_LOST) or state == self._ladder.rung))
        alarms.hold(Code.CGM_LOST, lost and self._calibration.active, min(age, 0xFFFF))
        alarms.hold(Code.CGM_IMPLAUSIBLE, step - self._last_implausible < ALARM_HOLD, step)
        alarms.hold(Code.E2E_FAULT, step - self._last_e2e_error < ALARM_HOLD, step)
        alarms.hold(Code.DOSE_LIMITED, step - self._last_limited < ALARM_HOLD, step)
        alarms.hold(Code.DOSE_REJECTED, step - self._last_rejected < ALARM_HOLD, step)
        alarms.hold(Code.PUMP_LOST, state == State.DELIVERY_UNCERTAIN, step)
        if state != self._reported_state:
            # every change of state is told with its cause in the same step, also to a user who has confirmed it
            self._reported_state = state
            alarms.repeat(Code.CGM_LOST)
            alarms.repeat(Code.PUMP_LOST)
        alarms.report(self._turn)

    def _report_status(self, state: State) -> None:
        used = self._cgm.sequence
        self._turn.send(
            "CTRL_Status",
            CtrlMode=self._mode,
            CtrlState=state,
            InsulinOnBoard=self._outputs[layout.OUT_IOB],
            LimiterBits=self._outputs[layout.OUT_LIMITERS] if state in COMMANDING else 0,
            **({} if used is None else {"LastCgmSeq": used}),
        )
        receiver = self._receiver
        self._turn.send(
            "CTRL_Diag",
            E2eErrorCount=min(receiver.crc_errors + receiver.malformed, 4095),
            LostFrameCount=min(self._lost_frames(), 4095),
            SequenceErrorCount=min(receiver.sequence_errors + self._sequence_errors + self._pump.refused, 1023),
            SaturationCount=min(self._state[layout.SATURATIONS], 1023),
            NvmFallbackCount=0,
        )
        self._send_heartbeat(NMT_OPERATIONAL if self._calibration.active else NMT_PRE_OPERATIONAL)

    def _lost_frames(self) -> int:
        return self._receiver.lost + self._lost_unseen

    def _send_heartbeat(self, nmt: int) -> None:
        self._turn.send("HB_CTRL", NmtCtrl=nmt, ToggleCtrl=self._toggle, ResetCauseCtrl=0, BootCtrl=0)
        self._toggle ^= 1
