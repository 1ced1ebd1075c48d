"""The firmware as a node on the bus: frames in, one pass of its tasks per step, frames out.

It speaks only in its turn (see `can_bus.lockstep`). Between two tokens it only remembers what arrived; the token runs
the tasks in a fixed order: calibration and user input, sensor, pump, ladder, control law, commands, boluses, alarms,
status. A bolus needs the pump's answers, so a step with one takes several turns.

Here is the order of things. What is known lies in parts with a module each: what was heard and what is amiss on the
bus (`wire`), mode and suspension (`user`), `meals`, the sensor (`cgm`), set-points (`pump`), boluses (`bolus`), what
was given (`delivery`), doubts about clock and resets (`caution`), and how much the law may do (`ladder`, `allowance`).

With a non-volatile memory it survives a reset at any instant: what it must not forget is stored before any frame that
depends on it leaves.
"""

import enum
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import dbc
from can_bus.codec import Check, Transmitter, message
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, Done, Phase, Turn

from . import allowance
from .alarms import Alarms, Code
from .bolus import Boluses, Drug
from .calibration import Calibration
from .caution import Caution
from .cgm import Cgm
from .control import layout
from .control.core import IOB_MAX, control_step
from .control.fixed import Ints, round_divide
from .control.layout import MODE_OFF
from .delivery import Delivery
from .heartbeat import TIMEOUT
from .history import AREA, History, Record
from .isotp import IsoTp
from .ladder import AGE_DEGRADED, PUMP_SILENT, Ladder, State
from .meals import Meals
from .nvm import Kept, Memory, Nvm, NvmError, memory_size
from .pump import Op, Pump
from .scheduler import Scheduler, Task
from .selftest import Failure, check_program, check_ram
from .uds import Uds
from .user import User
from .wire import DIAGNOSTICS, Wire

VERSION = (0, 2)

SERIAL_NUMBER = b"REFERENCE-0001"
DEVICE_ID = b"PUMPBENCHCTRL0001"
"""In the place of a vehicle's 17 characters."""

FRAMES_AT_MOST = 512
"""Frames between two tokens that the device can handle; more is an overrun."""

STOPS = Failure.PROGRAM | Failure.RAM | Failure.PARAMETERS
"""Failures after which nothing is commanded; a lost memory leaves the device without a calibration anyway."""

NVM_WORDS = 320
"""Room for everything that survives a reset."""

NVM_BYTES = memory_size(NVM_WORDS) + AREA
"""Of the whole memory: two banks, and the history behind them."""

COMMANDING = (State.AUTO, State.DEGRADED, State.DELIVERY_UNCERTAIN)
"""States in which the control law commands rates; in the others its limits cut nothing."""

CHANGES_OF_THEIR_OWN = frozenset({State.INIT, State.SUSPENDED})
"""States that no other alarm explains: StateChange tells that they are entered or left (requirement FAL-06)."""

NMT_BOOT_UP, NMT_OPERATIONAL, NMT_PRE_OPERATIONAL = 0, 5, 127

ACK_NODE_CTRL, ACK_CONFIRM, ACK_SNOOZE = 1, 1, 2
"""UI_AlarmAck: AlarmAckNode of an alarm of ours, and the two of AlarmAckAction."""

STEP_SNA = 1048575

URGENT_LOW = 550
"""0.1 mg/dL below which UrgentLow is raised, in every state (requirement ALM-03)."""

SKIPPED_AT_MOST = 288
"""Steps that are caught up one by one after a gap; by then every filter has forgotten."""


class Cause(enum.IntEnum):
    """HB_CTRL.ResetCauseCtrl."""

    POWER_ON = 0
    BROWN_OUT = 1
    WATCHDOG = 2
    SOFTWARE = 3
    PIN = 4


class Counters(NamedTuple):
    """What went wrong so far, in the order of the identifiers from 0x0110 on (docs/diagnostics.md)."""

    e2e_errors: int
    lost_frames: int
    sequence_errors: int
    saturations: int
    nvm_fallbacks: int
    overruns: int
    boots: int


class Firmware:
    """The dosing controller, without a bus: see `can_bus.lockstep.Node`.

    Args:
        memory: non-volatile; what it holds of an earlier life is taken up, until a roll call begins a new run.
        cause: why the device starts.

    Raises:
        NvmError: the memory has less than `NVM_BYTES` bytes.
    """

    def __init__(self, memory: Memory | None = None, cause: Cause = Cause.POWER_ON) -> None:
        self.finished = False
        self.reset_requested = False
        self.log: Callable[[str, int, str, str], None] = lambda _level, _seconds, _module, _text: None
        if memory is not None and memory.size < NVM_BYTES:
            raise NvmError(f"a memory of {memory.size} bytes, but the firmware needs {NVM_BYTES} bytes")
        self._nvm = None if memory is None else Nvm(memory, NVM_WORDS)
        self._history = History(memory, memory_size(NVM_WORDS))
        self._cause = cause
        self._uds_request = message(DIAGNOSTICS).can_id
        self._uds_response = message("UDS_Response").can_id
        self._boot()
        record = None if self._nvm is None else self._nvm.load()
        if record is not None:
            self._restore(iter(record))
        elif self._nvm is not None and self._nvm.damaged:
            self._failures |= Failure.MEMORY  # nothing is known: not even the calibration, so nothing is commanded

    def _boot(self) -> None:
        """Everything as after power-on."""
        self._turn = Turn(Transmitter())
        self._turn_open = False  # the step waits for the pump's answers
        self._toggle = 0  # of the heartbeat
        self._wire = Wire()
        self._alarms = Alarms()
        self._isotp = IsoTp()
        self._uds = Uds(self, self._alarms, self._history)
        self._calibration = Calibration()
        self._user = User()
        self._meals = Meals()
        self._cgm = Cgm()
        self._pump = Pump()
        self._boluses = Boluses()
        self._delivery = Delivery(self._pump, self._boluses)
        self._caution = Caution()
        self._ladder = Ladder()
        self._state: Ints = [0] * len(layout.STATE)
        self._inputs: Ints = [0] * len(layout.INPUTS)
        self._outputs: Ints = [0] * len(layout.OUTPUTS)
        self._scheduler = Scheduler(self._tasks())
        self._handlers: dict[str, Callable[[dict[str, int]], object]] = {
            "MODE_Cmd": self._on_mode_cmd,
            "CFG_Param": self._on_cfg_param,
            "UI_AlarmAck": self._on_alarm_ack,
            "PLANT_Info": self._on_plant_info,
            "PUMP_Ack": self._on_pump_ack,
            "CGM_Status": self._cgm.status,
            "MEAL_Announce": self._meals.hear,
        }
        self._failures = check_program() | check_ram(self._state, self._inputs, self._outputs)
        self._boots = 0
        self._reset_here = False  # this life began in the middle of a run
        self._reset_counted = False
        self._peer: dict[str, int] | None = None  # PLANT_Info
        self._step: int | None = None
        self._skipped = 0  # before this one
        self._work = 0  # counted in this step
        self._glucose = -1  # of this step that may be dosed on
        self._urgent = False
        self._misordered = 0  # samples that were repeated or late
        self._meals_refused = 0  # by what they say, or because no bolus was possible
        self._reported_state = State.INIT

    def start(self) -> list[Frame]:
        """What the device says when it starts, before it listens: it cannot know that no run is on."""
        self._send_heartbeat(NMT_BOOT_UP)
        return self._turn.take()

    # ---- frames in

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """Take one frame; only a token is answered, and a tester."""
        if frame.can_id == self._uds_request:
            return self._diagnose(frame.data)
        check, name, values = self._wire.hear(frame)
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

    def _diagnose(self, data: bytes) -> list[Frame]:
        """Answer a tester at once: it may be there without a bench, and must not wait for a turn of five minutes."""
        request, frames = self._isotp.receive(data)
        if request is not None:
            answer = self._uds.answer(request)
            frames += self._isotp.send(answer) if answer else []
        return [Frame(self._uds_response, frame) for frame in frames]

    def _on_pump_ack(self, values: dict[str, int]) -> None:
        misunderstood = self._pump.misunderstood
        self._pump.hear_ack(values)
        if self._pump.misunderstood > misunderstood:
            self._wire.impostor()  # who told it something else
        self._boluses.hear_ack(values)

    def _on_plant_info(self, values: dict[str, int]) -> None:
        self._peer = values

    def _on_cfg_param(self, values: dict[str, int]) -> None:
        self._turn.send("CFG_ParamEcho", **self._calibration.store(values))

    def _on_mode_cmd(self, values: dict[str, int]) -> None:
        if self._user.hear(values):
            self._caution.resume()

    def _on_alarm_ack(self, values: dict[str, int]) -> None:
        if values["AlarmAckNode"] == ACK_NODE_CTRL and values["AlarmAckAction"] in (ACK_CONFIRM, ACK_SNOOZE):
            self._alarms.acknowledge(values["AlarmAckInstance"], confirm=values["AlarmAckAction"] == ACK_CONFIRM)

    # ---- turns

    def _on_token(self, values: dict[str, int]) -> list[Frame]:
        phase, step = values["SyncPhase"], values["StepIndex"]
        if phase == Phase.INIT:
            return self._answer_roll_call(step)
        if phase == Phase.STEP and step != STEP_SNA:
            if self._step is None or step > self._step:
                self._run_step(step, values["SimTime"])
                return self._close(step)
        elif phase == Phase.CONTINUE and self._turn_open and step == self._step:
            self._boluses.listen()
            return self._close(step)
        elif phase == Phase.END:
            self.finished = True
        return self._turn.close(step)

    def _close(self, step: int) -> list[Frame]:
        """End the turn: with a question to the pump as long as a bolus needs its answer, else with the reports."""
        self._turn_open = self._boluses.speak(self._turn)
        if not self._turn_open:
            if self._boluses.uncertain:
                self._ladder.doubt()
            self._report_alarms(self._ladder.state, step)
            self._report_status(self._ladder.state)
        self._store()
        self._history.write(self._record(step))
        if self._turn_open:
            return self._turn.close(step, Done.CONTINUE)
        return self._turn.close(step, Done.OVERRUN if self._scheduler.late else Done.OK, self._work)

    def _answer_roll_call(self, call: int) -> list[Frame]:
        understood = self._judge_peer()
        self._boot()
        self._history.clear()
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
        answer = self._turn.close(call, Done.OK if understood else Done.FAULT)
        self._boot()  # the run starts with fresh counters, however often the roll was called
        return answer

    def _judge_peer(self) -> bool:
        """Whether this device speaks the bench's major version; what else differs is logged."""
        if self._peer is None:
            return True
        ours = dbc.protocol_version()
        theirs = self._peer["PlantProtocolMajor"], self._peer["PlantProtocolMinor"]
        spoken = f"protocol {theirs[0]}.{theirs[1]}, this firmware {ours[0]}.{ours[1]}"
        crc = self._peer["PlantDbcCrc"]
        if theirs[0] != ours[0]:
            self.log("error", 0, "version", f"refused: the bench speaks {spoken}")
        elif theirs != ours:
            self.log("warn", 0, "version", f"the bench speaks {spoken}")
        elif crc not in (0, dbc.crc32()):  # 0: not stated
            self.log("warn", 0, "version", f"the bench has another DBC: CRC {crc}, ours {dbc.crc32()}")
        return theirs[0] == ours[0]

    def _run_step(self, step: int, sim_time: int) -> None:
        self._skipped = 0 if self._step is None else step - self._step - 1
        self._step = step
        self._uds.tick()
        if self._caution.check_clock(step, sim_time):
            self._alarms.event(Code.CLOCK_JUMP, step)
        if self._reset_here and not self._reset_counted:
            self._reset_counted = True
            self._caution.count_reset(step)
            self._alarms.event(Code.NODE_RESET, step)
        self._work = self._scheduler.run(step * STEP_SECONDS)

    def _tasks(self) -> tuple[Task, ...]:
        """The tasks in the order in which they run; a later one sees what an earlier one has found."""
        return (
            Task("inputs", STEP_SECONDS, FRAMES_AT_MOST, self._task_inputs),
            Task("sensor", STEP_SECONDS, 16, self._task_sensor),
            Task("pump", STEP_SECONDS, 4, self._task_pump),
            Task("self_test", 3600, 4, self._task_self_test),
            Task("ladder", STEP_SECONDS, 1, self._task_ladder),
            Task("control", STEP_SECONDS, SKIPPED_AT_MOST + 1, self._task_control),
            Task("command", STEP_SECONDS, 3, self._task_command),
        )

    def _task_inputs(self) -> int:
        return self._wire.close(self._now)

    def _task_sensor(self) -> int:
        samples, unusable = self._wire.take("CGM_Reading")
        for _ in range(unusable):
            self._cgm.skip()
        self._glucose = self._judge_sensor(samples, self._now)
        return len(samples) + 1

    def _task_pump(self) -> int:
        step = self._now
        status = self._wire.newest("PUMP_Status")
        if status is not None:
            self._pump.status(status, step)
        bolus_states, _ = self._wire.take("PUMP_BolusState")
        for state in bolus_states:
            self._pump.bolus_state(state["BolusStateHormone"], step)
            self._boluses.hear_state(state)
        totals = self._wire.newest("PUMP_Delivered")
        self._delivery.update(totals, step, self._calibration.parameters[layout.BASAL], self._skipped)
        if self._user.suspended:
            self._boluses.cancel()
        return 1

    def _task_self_test(self) -> int:
        """Once an hour: the calibration in force is still the one that was checked."""
        if not self._calibration.intact:
            self._failures |= Failure.PARAMETERS
        return 1

    def _task_ladder(self) -> int:
        step = self._now
        self._ladder.update(
            calibrated=self._calibration.active,
            suspended=self._user.suspended or self._user.mode == MODE_OFF,
            age=self._cgm.age(step),
            streak=self._cgm.streak,
            pump_age=self._pump_age(step),
            sensor_silent=self._sensor_silent(step),
            uncertain=self._boluses.uncertain,
            held=self._caution.held,
            fault=bool(self._failures & STOPS) or self._scheduler.bitten,
            age_degraded=allowance.stale_age(self._calibration.value("CfgStaleCgmLimit")),
        )
        return 1

    def _task_control(self) -> int:
        steps = self._catch_up(self._skipped)
        delivered = self._delivery.insulin
        if delivered > 0:  # what the schedule gave in the steps that were caught up has been counted there
            delivered = max(delivered - self._scheduled(self._skipped), 0)
        self._control(self._ladder.state, self._glucose, delivered, self._delivery.bolus)
        return steps + 1

    def _task_command(self) -> int:
        self._command(self._ladder.state, self._now)
        return 1 + self._start_boluses(self._now)

    @property
    def _now(self) -> int:
        return -1 if self._step is None else self._step

    def _pump_age(self, step: int) -> int:
        """Steps since all that the pump says in every step was heard."""
        return max(self._pump.age(step), self._wire.silence("HB_PUMP", step))

    def _sensor_silent(self, step: int) -> bool:
        """Whether the sensor's heartbeats have ceased."""
        return self._wire.silence("HB_CGM", step) >= TIMEOUT

    def _scheduled(self, steps: int) -> int:
        """Insulin (mU) of the schedule in some steps."""
        return round_divide(self._calibration.parameters[layout.BASAL] * steps, 12)

    def _catch_up(self, skipped: int) -> int:
        """Let insulin on board and the filters age by steps that never came (requirement TIM-02); how many."""
        if not self._calibration.active:
            return 0
        inputs = self._inputs
        steps = min(skipped, SKIPPED_AT_MOST)
        for _ in range(steps):
            inputs[:] = [0] * len(inputs)
            inputs[layout.IN_GLUCOSE] = -1
            inputs[layout.IN_DELIVERED] = -1
            inputs[layout.IN_MODE] = self._user.mode
            inputs[layout.IN_LIMIT] = layout.LIMIT_SCHEDULE
            inputs[layout.IN_INSULIN_LEFT] = self._insulin_left()
            inputs[layout.IN_PRAM_LEFT] = self._pram_left()
            control_step(self._state, self._calibration.parameters, inputs, self._outputs)
        return steps

    def _judge_sensor(self, samples: list[dict[str, int]], step: int) -> int:
        self._cgm.stuck_limit = self._calibration.value("CfgStuckSamples")
        verdict = self._cgm.judge(samples, step)
        self._misordered += verdict.repeated + verdict.late
        if verdict.refused or verdict.repeated:
            self._alarms.event(Code.CGM_IMPLAUSIBLE, step)
        if verdict.glucose >= 0:
            self._wire.used_sample(verdict.missing)
            self._urgent = verdict.glucose < URGENT_LOW
            self._caution.sample(step)
        return verdict.glucose

    def _control(self, state: State, glucose: int, delivered: int, bolus: int) -> None:
        inputs = self._inputs
        inputs[layout.IN_GLUCOSE] = glucose
        inputs[layout.IN_DELIVERED] = delivered
        inputs[layout.IN_BOLUS] = bolus
        inputs[layout.IN_MODE] = self._user.mode
        inputs[layout.IN_RESET] = 1 if self._cgm.settling else 0
        cautious = self._cgm.doubtful or self._caution.clock_doubtful or self._pump.insulin_blocked
        suspended = state == State.SUSPENDED or self._cgm.below_range
        inputs[layout.IN_LIMIT] = allowance.limit_of(state == State.AUTO, suspended, cautious)
        inputs[layout.IN_OPEN] = self._boluses.remaining(Drug.INSULIN)
        inputs[layout.IN_INSULIN_LEFT] = self._insulin_left()
        inputs[layout.IN_PRAM_LEFT] = self._pram_left()
        pump = self._pump
        inputs[layout.IN_PRAM_STOP] = 1 if pump.pram_blocked or pump.insulin_blocked or pump.pram_unanswered else 0
        stop = 0 if self._may_bolus(Drug.INSULIN, state) else layout.STOP_INSULIN
        inputs[layout.IN_BOLUS_STOP] = stop | (0 if self._may_bolus(Drug.PRAMLINTIDE, state) else layout.STOP_PRAM)
        inputs[layout.IN_MEAL], inputs[layout.IN_CARBS] = self._meals.take()
        if self._calibration.active:
            control_step(self._state, self._calibration.parameters, inputs, self._outputs)
        if self._outputs[layout.OUT_REFUSED] or self._meals.refused:
            self._meals.refused = False
            self._meals_refused += 1

    def _may_bolus(self, drug: Drug, state: State) -> bool:
        alone = self._wire.alone(self._now)  # nobody else tells the pump what to give (E2E-05)
        return state == State.AUTO and alone and self._pump.heard and self._boluses.ready(drug)

    def _insulin_left(self) -> int:
        return self._delivery.insulin_left(self._calibration.value("CfgInsulinTdd"))

    def _pram_left(self) -> int:
        return self._delivery.pram_left(self._calibration.value("CfgPramTdd"))

    def _start_boluses(self, step: int) -> int:
        """Start what the law decided on, within what the pump accepts; how many."""
        started = 0
        for drug, word in ((Drug.INSULIN, layout.OUT_BOLUS), (Drug.PRAMLINTIDE, layout.OUT_PRAM_BOLUS)):
            wanted = self._outputs[word] if self._ladder.state == State.AUTO else 0
            if wanted == 0:
                continue
            dose = min(wanted, self._boluses.limit[drug])
            if dose < wanted:
                self._outputs[layout.OUT_LIMITERS] |= layout.LIMITER_MAX_BOLUS
            if dose > 0:
                self._boluses.start(drug, dose, step)
                started += 1
        return started

    def _command(self, state: State, step: int) -> None:
        if state == State.DELIVERY_UNCERTAIN and self._ladder.rung == State.SAFE_BASAL:
            self._pump.command(self._turn, Op.RESUME_SCHEDULE, step)
        elif state in COMMANDING:
            rate, pramlintide = self._outputs[layout.OUT_RATE], self._outputs[layout.OUT_PRAM_RATE]
            if self._pump.command(self._turn, Op.SET_RATE, step, rate, pramlintide if rate > 0 else 0):
                self._outputs[layout.OUT_LIMITERS] |= layout.LIMITER_MAX_BASAL
        elif state == State.SUSPENDED:
            self._pump.command(self._turn, Op.SUSPEND, step)
        elif self._calibration.active and state != State.FAULT:
            self._pump.command(self._turn, Op.RESUME_SCHEDULE, step)

    def _report_alarms(self, state: State, step: int) -> None:
        alarms = self._alarms
        alarms.count(Code.E2E_FAULT, self._wire.e2e_errors, step)
        # a missing sample is told by LimiterBits, and by CgmLost when it matters
        if self._outputs[layout.OUT_LIMITERS] & ~layout.LIMITER_STALE_CGM and state == State.AUTO:
            alarms.event(Code.DOSE_LIMITED, step)
        alarms.count(Code.DOSE_REJECTED, self._user.refused + self._meals_refused + self._boluses.refused, step)
        before = self._reported_state
        of_its_own = state != before and not CHANGES_OF_THEIR_OWN.isdisjoint((state, before))
        if of_its_own:
            alarms.event(Code.STATE_CHANGE, step)
        self._hold_alarms(state, step)
        if state != before:
            self._reported_state = state
            # every change of state is told with its cause in the same step, also to a user who has confirmed it
            self.log("info", step * STEP_SECONDS, "ladder", f"{before.name} -> {state.name}")
            for code in (Code.CGM_LOST, Code.PUMP_LOST, Code.DELIVERY_UNCERTAIN, Code.WATCHDOG, Code.SELF_TEST):
                alarms.repeat(code)
            if of_its_own:
                alarms.renew(Code.STATE_CHANGE)
        alarms.report(self._turn)

    def _hold_alarms(self, state: State, step: int) -> None:
        """Raise the alarms whose causes hold, in the order in which they get their instances; end the others."""
        alarms = self._alarms
        age = self._cgm.age(step)
        down = self._ladder.rung != State.AUTO
        silent = age >= AGE_DEGRADED or self._sensor_silent(step)
        lost = silent or (down and (alarms.active(Code.CGM_LOST) or state == self._ladder.rung))
        # without a calibration nothing is dosed, but a sensor that was heard and falls silent is told of all the same
        listening = self._calibration.active or self._cgm.sequence is not None
        alarms.hold(Code.CGM_LOST, lost and listening, min(age, 0xFFFF))
        for code in (Code.CGM_IMPLAUSIBLE, Code.E2E_FAULT, Code.DOSE_LIMITED, Code.DOSE_REJECTED):
            alarms.hold(code, alarms.recent(code, step), step)
        alarms.hold(Code.PUMP_LOST, self._calibration.active and self._pump_age(step) >= PUMP_SILENT, step)
        amiss = self._boluses.uncertain or self._pump.unlike or self._pump.fallen or self._delivery.unbalanced
        alarms.hold(Code.DELIVERY_UNCERTAIN, amiss, step)
        alarms.hold(Code.URGENT_LOW, self._urgent, step)
        alarms.hold(Code.CLOCK_JUMP, alarms.recent(Code.CLOCK_JUMP, step), step)
        alarms.hold(Code.NODE_RESET, alarms.recent(Code.NODE_RESET, step), self._boots)
        alarms.hold(Code.WATCHDOG, bool(self._scheduler.late) or self._scheduler.bitten, self._scheduler.overruns)
        alarms.hold(Code.SELF_TEST, self._failures != Failure.NONE, self._failures)
        # Suspended stays a cause: the user is reminded of it
        changed = alarms.recent(Code.STATE_CHANGE, step) or state == State.SUSPENDED
        alarms.hold(Code.STATE_CHANGE, changed, state)

    def _report_status(self, state: State) -> None:
        used = self._cgm.sequence
        counters = self._counters()
        self._turn.send(
            "CTRL_Status",
            CtrlMode=self._user.mode,
            CtrlState=state,
            InsulinOnBoard=self._insulin_on_board(),
            LimiterBits=self._limiters(state),
            **({} if used is None else {"LastCgmSeq": used}),
            **({} if self._meals.last is None else {"LastMealId": self._meals.last}),
        )
        self._turn.send(
            "CTRL_Diag",
            E2eErrorCount=min(counters.e2e_errors, 4095),
            LostFrameCount=min(counters.lost_frames, 4095),
            SequenceErrorCount=min(counters.sequence_errors, 1023),
            SaturationCount=min(counters.saturations, 1023),
            NvmFallbackCount=min(counters.nvm_fallbacks, 255),
        )
        self._send_heartbeat(NMT_OPERATIONAL if self._calibration.active else NMT_PRE_OPERATIONAL)

    def _insulin_on_board(self) -> int:
        return min(self._outputs[layout.OUT_IOB] + self._boluses.remaining(Drug.INSULIN), IOB_MAX)

    def _limiters(self, state: State) -> int:
        return self._outputs[layout.OUT_LIMITERS] if state in COMMANDING else 0

    def _counters(self) -> Counters:
        by_number = self._user.sequence_errors + self._misordered + self._pump.refused + self._meals.repeated
        unanswered = self._pump.unanswered + self._boluses.unanswered
        return Counters(
            e2e_errors=self._wire.e2e_errors,
            lost_frames=self._wire.lost_frames,
            sequence_errors=self._wire.sequence_errors + by_number + unanswered,
            saturations=self._state[layout.SATURATIONS],
            nvm_fallbacks=0 if self._nvm is None else self._nvm.fallbacks,
            overruns=self._scheduler.overruns,
            boots=self._boots,
        )

    def _send_heartbeat(self, nmt: int) -> None:
        self._turn.send(
            "HB_CTRL",
            NmtCtrl=nmt,
            ToggleCtrl=self._toggle,
            ResetCauseCtrl=self._told_cause(),
            BootCtrl=self._boots % 32,
        )
        self._toggle ^= 1

    def _told_cause(self) -> Cause:
        return self._cause if self._reset_here else Cause.POWER_ON

    # ---- non-volatile memory

    def _store(self) -> None:
        """Keep what must survive a reset; called before the frames of the turn leave."""
        if self._nvm is not None:
            self._nvm.store(self._save())

    def _record(self, step: int) -> Record:
        """What the history keeps of this step; of a turn that is not the last one, what is known by then."""
        state = self._ladder.state
        op, rate, pram_rate = self._pump.set_point if self._pump.set_point_step == step else (0, 0, 0)
        return Record(
            step=step,
            boots=self._boots,
            cause=self._told_cause(),
            state=state,
            mode=self._user.mode,
            op=op,
            glucose=self._glucose,
            iob=self._insulin_on_board(),
            rate=rate,
            pram_rate=pram_rate,
            bolus=self._boluses.committed[Drug.INSULIN],
            pram_bolus=self._boluses.committed[Drug.PRAMLINTIDE],
            delivered=self._delivery.insulin,
            pram_delivered=self._delivery.pramlintide,
            limiters=self._limiters(state),
            alarms=self._alarms.bits,
        )

    def _kept(self) -> tuple[Kept, ...]:
        """The parts that survive a reset, in the order of the record."""
        return (
            self._user,
            self._caution,
            self._meals,
            self._boluses,
            self._pump,
            self._cgm,
            self._alarms,
            self._delivery.insulin_day,
            self._delivery.pram_day,
            self._calibration,
        )

    def _save(self) -> list[int]:
        words = [self._now, self._boots]
        for part in self._kept():
            words += part.save()
        return [*words, *self._state]

    def _restore(self, words: Iterator[int]) -> None:
        """Take up an earlier life: everything that `_save` wrote, and one boot more."""
        step = next(words)
        self._step = None if step < 0 else step
        self._boots = next(words) + 1
        for part in self._kept():
            part.restore(words)
        self._state[:] = [next(words) for _ in layout.STATE]
        self._reset_here = True

    # ---- what the console sees

    def status(self) -> dict[str, int | str]:
        """The newest step; rates and doses raw, as in the DBC."""
        step = self._now
        counters = self._counters()
        return {
            "step": step,
            "time": max(step, 0) * STEP_SECONDS,
            "state": self._ladder.state.name.lower(),
            "mode": self._user.mode,
            "glucose": self._inputs[layout.IN_GLUCOSE],
            "cgm_age": min(self._cgm.age(max(step, 0)), STEP_SNA),
            "rate": self._outputs[layout.OUT_RATE],
            "pram_rate": self._outputs[layout.OUT_PRAM_RATE],
            "iob": self._outputs[layout.OUT_IOB],
            "limiters": self._outputs[layout.OUT_LIMITERS],
            "e2e_errors": counters.e2e_errors,
            "lost_frames": counters.lost_frames,
            "boots": counters.boots,
        }

    def parameters(self) -> dict[str, int]:
        """The calibration in force, raw values by DBC name."""
        return self._calibration.values

    def faults(self) -> list[dict[str, int | str]]:
        """Alarms in force, highest priority first."""
        return self._alarms.listing()

    def history(self) -> Sequence[Record]:
        """The last 24 h, the oldest step first."""
        return self._history.records()

    def version(self) -> dict[str, int | str]:
        """Of this firmware, and of the protocol it speaks."""
        major, minor = dbc.protocol_version()
        return {"firmware": f"{VERSION[0]}.{VERSION[1]}", "protocol": f"{major}.{minor}", "dbc_crc": dbc.crc32()}

    def request_reset(self) -> bool:
        """Ask whoever runs this device to restart it; False without a memory to restart from."""
        self.reset_requested = self._nvm is not None
        return self.reset_requested

    # ---- what a tester sees (`uds.Device`)

    def identification(self) -> dict[int, bytes]:
        """Data by identifier: docs/diagnostics.md has the table."""
        major, minor = dbc.protocol_version()
        records = self._history.records()
        return {
            0xF18C: SERIAL_NUMBER,
            0xF190: DEVICE_ID,
            0xF191: b"SIM",
            0xF195: f"{VERSION[0]}.{VERSION[1]}".encode(),
            0x0100: bytes([major, minor]),
            0x0101: dbc.crc32().to_bytes(4, "big"),
            0x0102: bytes([self._ladder.state, self._user.mode]),
            0x0103: (STEP_SNA if self._step is None else self._step).to_bytes(4, "big"),
            0x0120: len(records).to_bytes(2, "big"),
            **{0x0110 + i: min(count, 0xFFFF).to_bytes(2, "big") for i, count in enumerate(self._counters())},
        }

    def may_restart(self) -> bool:
        """Whether no bolus is under way."""
        return not self._boluses.open

    def self_test(self) -> int:
        """The tests of the boot once more, the memory's too; what fails counts as it would there."""
        found = check_program() | check_ram(self._state, self._inputs, self._outputs)
        if not self._calibration.intact:
            found |= Failure.PARAMETERS
        if self._nvm is not None and not self._nvm.intact():
            found |= Failure.MEMORY
        self._failures |= found
        return found

    def load(self, task: int, work: int) -> bool:
        """Give a task more work in its next run; False if there is no such task."""
        return self._scheduler.load(task, work)
