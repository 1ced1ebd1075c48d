"""The firmware as a node on the bus: frames in, one pass of its tasks per step, frames out.

It speaks only in its turn (see `can_bus.lockstep`). Between two tokens it only remembers what arrived; the token runs
the tasks in a fixed order: calibration and user input, sensor, pump, ladder, control law, commands, boluses, alarms,
status. A bolus needs the pump's answers, so a step with one takes several turns.

With a non-volatile memory it survives a reset at any instant: what it must not forget is stored before any frame that
depends on it leaves.
"""

import enum
from collections.abc import Callable, Iterator, Sequence

import dbc
from can_bus.codec import Check, Receiver, Transmitter, message
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, Done, Phase, Turn

from .alarms import Alarms, Code
from .balance import Balance
from .bolus import Boluses, Drug
from .calibration import Calibration
from .cgm import Cgm
from .control import layout
from .control.core import control_step
from .control.fixed import Ints, round_divide
from .control.layout import MODE_OFF, MODE_S4
from .day import Day
from .e2e_window import E2eWindow
from .heartbeat import TIMEOUT, Heartbeat
from .history import AREA, History, Record, pack
from .isotp import IsoTp
from .ladder import AGE_DEGRADED, PUMP_SILENT, Ladder, State
from .meals import Meals
from .nvm import Memory, Nvm, NvmError, memory_size
from .pump import Op, Pump
from .scheduler import Scheduler, Task
from .selftest import Failure, check_program, check_ram
from .uds import CONFIRMED, FAILED, FAILED_SINCE_CLEAR, FAILED_THIS_CYCLE, Uds

VERSION = (0, 2)

SERIAL_NUMBER = b"REFERENCE-0001"
DEVICE_ID = b"PUMPBENCHCTRL0001"
"""In the place of a vehicle's 17 characters."""

SUPPORTED_MODES = tuple(range(MODE_OFF, MODE_S4 + 1))
"""Modes this build accepts from MODE_Cmd; any other is refused with DoseRejected."""

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

ALARM_HOLD = 3
"""Quiet steps after which the alarm of a passing error ends (project's choice)."""

UNBALANCED_INSULIN, UNBALANCED_PRAM = 500, 500
"""Ten strokes, in mU and in 0.01 ug (project's choice)."""

NMT_BOOT_UP, NMT_OPERATIONAL, NMT_PRE_OPERATIONAL = 0, 5, 127

REQUEST_SUSPEND, REQUEST_RESUME = 1, 2

STEP_SNA = 1048575

IOB_MAX = 4090

MODE_SEQUENCES = 255
"""ModeCmdSeq runs from 0 to 254; 255 is SNA."""

SIM_TIME_SNA = 268435455
CLOCK_TOLERANCE = 60
"""Seconds that SimTime may be off the step it names (requirement TIM-03)."""

CLOCK_CAUTION = 3
"""Samples after a jump of the clock in which insulin stays at or below the schedule (project's choice)."""

URGENT_LOW = 550
"""0.1 mg/dL below which UrgentLow is raised, in every state (requirement ALM-03)."""

RESETS_KEPT = 5
RESETS_WITHIN = 12
"""So many resets within so many steps hold SafeBasal until the user resumes (requirement RST-04)."""

SKIPPED_AT_MOST = 288
"""Steps that are caught up one by one after a gap; by then every filter has forgotten."""


class Cause(enum.IntEnum):
    """HB_CTRL.ResetCauseCtrl."""

    POWER_ON = 0
    BROWN_OUT = 1
    WATCHDOG = 2
    SOFTWARE = 3
    PIN = 4


CYCLIC = ("CGM_Reading", "PUMP_Status", "PUMP_Delivered")
"""Messages of every step whose values are used only while `E2eWindow` calls them valid (requirement E2E-03)."""

DIAGNOSTICS = "UDS_Request"
"""The one message that is answered out of turn, and that no task sees."""


def subscriptions() -> list[str]:
    """Names of the messages the DBC addresses to CTRL."""
    return [each.name for each in dbc.load().messages if "CTRL" in each.receivers]


def own_messages() -> list[str]:
    """Names of the messages that nobody but CTRL may send."""
    return [each.name for each in dbc.load().messages if each.senders == ["CTRL"]]


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
        self._own_ids = frozenset(message(name).can_id for name in own_messages())
        self._handlers: dict[str, Callable[[dict[str, int]], None]] = {
            "CGM_Reading": self._on_cgm_reading,
            "PUMP_Status": self._on_pump_status,
            "PUMP_Delivered": self._on_pump_delivered,
            "MODE_Cmd": self._on_mode_cmd,
            "CFG_Param": self._on_cfg_param,
            "UI_AlarmAck": self._on_alarm_ack,
            "PLANT_Info": self._on_plant_info,
            "PUMP_Ack": self._on_pump_ack,
            "PUMP_BolusState": self._on_bolus_state,
            "CGM_Status": self._on_cgm_status,
            "MEAL_Announce": self._on_meal_announce,
            "HB_PUMP": lambda values: self._pump_heartbeat.hear(values["TogglePump"]),
            "HB_CGM": lambda values: self._cgm_heartbeat.hear(values["ToggleCgm"]),
        }
        self._boot()
        record = None if self._nvm is None else self._nvm.load()
        if record is not None:
            self._restore(iter(record))
        elif self._nvm is not None and self._nvm.damaged:
            self._failures |= Failure.MEMORY  # nothing is known: not even the calibration, so nothing is commanded

    def _boot(self) -> None:
        """Everything as after power-on."""
        self._transmitter = Transmitter()
        self._receiver = Receiver(name for name in subscriptions() if name != DIAGNOSTICS)
        self._windows = {name: E2eWindow() for name in CYCLIC}
        self._pump_heartbeat = Heartbeat()
        self._cgm_heartbeat = Heartbeat()
        self._isotp = IsoTp()
        self._uds = Uds(self)
        self._turn = Turn(self._transmitter)
        self._calibration = Calibration()
        self._alarms = Alarms()
        self._cgm = Cgm()
        self._pump = Pump()
        self._boluses = Boluses()
        self._meals = Meals()
        self._balances = {Drug.INSULIN: Balance(UNBALANCED_INSULIN), Drug.PRAMLINTIDE: Balance(UNBALANCED_PRAM)}
        self._insulin_day = Day()
        self._pram_day = Day()
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
        self._totals_known = False  # in the step before
        self._short_seen = dict.fromkeys(Drug, 0)
        self._status: dict[str, int] | None = None
        self._bolus_states: set[int] = set()  # drugs heard of in this step
        self._rejected = False
        self._scheduler = Scheduler(self._tasks())
        self._frames_heard = 0
        self._work = 0  # counted in this step
        self._glucose, self._delivered, self._bolus, self._skipped = -1, -1, 0, 0  # found by the tasks of this step
        self._pram_delivered = 0
        self._failures = check_program() | check_ram(self._state, self._inputs, self._outputs)
        self._turn_open = False  # the step waits for the pump's answers
        self._refused_seen = 0
        self._boots = 0
        self._boot_steps: list[int] = []  # first steps after the last resets
        self._reset_here = False  # this life began in the middle of a run
        self._held = False  # too many resets
        self._clock_caution = 0
        self._urgent = False
        self._peer_version: tuple[int, int] | None = None
        self._peer_dbc = 0  # CRC-32 of the bench's DBC, 0: not stated
        self._toggle = 0
        self._crc_errors_seen = 0
        self._lost_samples_seen = 0  # of the CGM, by the counter of its frames, when the newest sample came
        self._lost_unseen = 0  # CGM frames lost that this counter could not show
        self._sequence_errors = 0
        self._reported_state = State.INIT
        self._last_e2e_error = -STEP_SNA
        self._bus_errors = 0  # error frames of the controller
        self._impostors = 0  # frames with an id of ours that we did not send
        self._impostors_seen = 0
        self._last_impostor = -STEP_SNA
        self._last_implausible = -STEP_SNA
        self._last_limited = -STEP_SNA
        self._last_rejected = -STEP_SNA
        self._last_reset = -STEP_SNA
        self._last_jump = -STEP_SNA
        self._last_change = -STEP_SNA

    def start(self) -> list[Frame]:
        """What the device says when it starts, before it listens: it cannot know that no run is on."""
        self._send_heartbeat(NMT_BOOT_UP)
        return self._turn.take()

    # ---- frames in

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """Take one frame; only a token is answered, and a tester."""
        if frame.can_id == self._uds_request:
            return self._diagnose(frame.data)
        check, name, values, _ = self._receiver.receive(frame)
        if check == Check.UNKNOWN and frame.can_id in self._own_ids:
            self._impostors += 1  # a node never hears itself
        self._bus_errors += frame.is_error
        self._frames_heard += check != Check.UNKNOWN
        window = self._windows.get(name)
        if window is not None:
            window.hear(check)
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

    def _on_cgm_reading(self, values: dict[str, int]) -> None:
        self._samples.append(values)

    def _on_pump_status(self, values: dict[str, int]) -> None:
        self._status = values

    def _on_pump_ack(self, values: dict[str, int]) -> None:
        misunderstood = self._pump.misunderstood
        self._pump.hear_ack(values)
        self._impostors += self._pump.misunderstood > misunderstood  # somebody else told the pump
        self._boluses.hear_ack(values)

    def _on_bolus_state(self, values: dict[str, int]) -> None:
        self._boluses.hear_state(values)
        self._bolus_states.add(values["BolusStateHormone"])

    def _on_cgm_status(self, values: dict[str, int]) -> None:
        self._cgm.status(values)

    def _on_meal_announce(self, values: dict[str, int]) -> None:
        self._meals.hear(values)

    def _on_pump_delivered(self, values: dict[str, int]) -> None:
        self._totals = values

    def _on_plant_info(self, values: dict[str, int]) -> None:
        self._peer_version = (values["PlantProtocolMajor"], values["PlantProtocolMinor"])
        self._peer_dbc = values["PlantDbcCrc"]

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
            self._held = False
            self._boot_steps.clear()

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
                self._check_clock(step, values["SimTime"])
                self._run_step(step)
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

    def _check_clock(self, step: int, sim_time: int) -> None:
        off = sim_time - step * STEP_SECONDS
        if sim_time != SIM_TIME_SNA and not -CLOCK_TOLERANCE <= off <= CLOCK_TOLERANCE:
            self._clock_caution = CLOCK_CAUTION
            self._last_jump = step

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
        peer, ours = self._peer_version, dbc.protocol_version()
        if peer is None:
            return True
        spoken = f"protocol {peer[0]}.{peer[1]}, this firmware {ours[0]}.{ours[1]}"
        if peer[0] != ours[0]:
            self.log("error", 0, "version", f"refused: the bench speaks {spoken}")
        elif peer != ours:
            self.log("warn", 0, "version", f"the bench speaks {spoken}")
        elif self._peer_dbc not in (0, dbc.crc32()):
            self.log("warn", 0, "version", f"the bench has another DBC: CRC {self._peer_dbc}, ours {dbc.crc32()}")
        return peer[0] == ours[0]

    def _run_step(self, step: int) -> None:
        self._skipped = 0 if self._step is None else step - self._step - 1
        self._step = step
        self._uds.tick()
        if self._reset_here and self._last_reset < 0:
            self._count_reset(step)
        self._work = self._scheduler.run(step * STEP_SECONDS)

    def _tasks(self) -> tuple[Task, ...]:
        """The tasks in the order in which they run; a later one sees what an earlier one has found."""
        return (
            Task("inputs", STEP_SECONDS, FRAMES_AT_MOST, self._count_inputs),
            Task("sensor", STEP_SECONDS, 16, self._task_sensor),
            Task("pump", STEP_SECONDS, 4, self._task_pump),
            Task("self_test", 3600, 4, self._task_self_test),
            Task("ladder", STEP_SECONDS, 1, self._task_ladder),
            Task("control", STEP_SECONDS, SKIPPED_AT_MOST + 1, self._task_control),
            Task("command", STEP_SECONDS, 3, self._task_command),
        )

    def _count_inputs(self) -> int:
        frames = self._frames_heard
        self._frames_heard = 0
        if self._impostors > self._impostors_seen:
            self._impostors_seen = self._impostors
            self._last_impostor = self._now
        self._drop_invalid()
        self._pump_heartbeat.close(self._now)
        self._cgm_heartbeat.close(self._now)
        return frames

    def _drop_invalid(self) -> None:
        """Treat what came of a message that is not valid as if it had not come."""
        valid = {name: window.close() for name, window in self._windows.items()}
        if not valid["CGM_Reading"]:
            for _ in self._samples:
                self._cgm.skip()
            self._samples = []
        if not valid["PUMP_Status"]:
            self._status = None
        if not valid["PUMP_Delivered"]:
            self._totals = None

    def _task_sensor(self) -> int:
        samples = len(self._samples)
        self._glucose = self._judge_sensor(self._now)
        return samples + 1

    def _task_pump(self) -> int:
        self._delivered, self._bolus = self._hear_pump(self._now)
        if self._suspended:
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
            suspended=self._suspended or self._mode == MODE_OFF,
            age=self._cgm.age(step),
            streak=self._cgm.streak,
            pump_age=self._pump_age(step),
            sensor_silent=self._sensor_silent(step),
            uncertain=self._boluses.uncertain,
            held=self._held,
            fault=bool(self._failures & STOPS) or self._scheduler.bitten,
            age_degraded=self._stale_age(),
        )
        return 1

    def _task_control(self) -> int:
        steps = self._catch_up(self._skipped)
        delivered = self._delivered
        if delivered > 0:  # what the schedule gave in the steps that were caught up has been counted there
            delivered = max(delivered - self._scheduled(self._skipped), 0)
        self._control(self._ladder.state, self._glucose, delivered, self._bolus)
        return steps + 1

    def _task_command(self) -> int:
        self._command(self._ladder.state, self._now)
        return 1 + self._start_boluses(self._now)

    @property
    def _now(self) -> int:
        return -1 if self._step is None else self._step

    def _pump_age(self, step: int) -> int:
        """Steps since all that the pump says in every step was heard."""
        return max(self._pump.age(step), self._pump_heartbeat.silence(step))

    def _sensor_silent(self, step: int) -> bool:
        """Whether the sensor's heartbeats have ceased."""
        return self._cgm_heartbeat.silence(step) >= TIMEOUT

    def _stale_age(self) -> int:
        """CfgStaleCgmLimit as the age of a sample, in steps; it can only tighten (requirement USR-05)."""
        return min(self._calibration.value("CfgStaleCgmLimit") // 5 + 1, AGE_DEGRADED)

    def _count_reset(self, step: int) -> None:
        self._last_reset = step
        self._boot_steps = [*self._boot_steps, step][-RESETS_KEPT:]
        if len(self._boot_steps) == RESETS_KEPT and step - self._boot_steps[0] < RESETS_WITHIN:
            self._held = True

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
            inputs[layout.IN_MODE] = self._mode
            inputs[layout.IN_LIMIT] = layout.LIMIT_SCHEDULE
            inputs[layout.IN_INSULIN_LEFT] = self._insulin_left()
            inputs[layout.IN_PRAM_LEFT] = self._pram_left()
            control_step(self._state, self._calibration.parameters, inputs, self._outputs)
        return steps

    def _judge_sensor(self, step: int) -> int:
        self._cgm.stuck_limit = self._calibration.value("CfgStuckSamples")
        verdict = self._cgm.judge(self._samples, step)
        self._samples = []
        if verdict.glucose >= 0:
            # the 4-bit counter of the frames is blind to a gap of 16, the number of the sample is not
            lost = self._receiver.lost_of("CGM_Reading")
            self._lost_unseen += max(verdict.missing - (lost - self._lost_samples_seen), 0)
            self._lost_samples_seen = lost
        self._sequence_errors += verdict.repeated + verdict.late
        if verdict.refused or verdict.repeated:
            self._last_implausible = step
        if verdict.glucose >= 0:
            self._urgent = verdict.glucose < URGENT_LOW
            self._clock_caution = max(self._clock_caution - 1, 0) if self._last_jump != step else self._clock_caution
        return verdict.glucose

    def _hear_pump(self, step: int) -> tuple[int, int]:
        """Insulin (mU) delivered since the last step, -1 when not known; and the part of it that was a bolus."""
        if self._status is not None:
            self._pump.status(self._status, step)
        for drug in self._bolus_states:
            self._pump.bolus_state(drug, step)
        self._bolus_states.clear()
        pramlintide = self._pump.pramlintide(self._totals)
        basal = self._calibration.parameters[layout.BASAL]
        told = self._boluses.open_step(step)
        bolus, pram_bolus = (sum(raw * 10 for drug, raw in told if drug == wanted) for wanted in Drug)
        delivered = self._pump.delivered(self._totals, step, basal, bolus)
        self._pram_delivered = pramlintide
        # of a bolus that ended too early all that was asked for is held against the pump
        asked, pram_asked = bolus + self._newly_short(Drug.INSULIN), pram_bolus + self._newly_short(Drug.PRAMLINTIDE)
        self._balance(basal, {Drug.INSULIN: (asked, delivered), Drug.PRAMLINTIDE: (pram_asked, pramlintide)})
        self._status = None
        self._totals = None
        self._insulin_day.add(max(delivered, 0), step)
        self._pram_day.add(pramlintide, step)
        return delivered, bolus

    def _balance(self, basal: int, of: dict[Drug, tuple[int, int]]) -> None:
        """Hold what the totals grew by against what was asked for; over a gap nobody knows what that was."""
        known = self._totals is not None and self._skipped == 0 and of[Drug.INSULIN][1] >= 0
        for (drug, (bolus, delivered)), rate in zip(of.items(), self._pump.asked(basal), strict=True):
            if known and self._totals_known:
                self._balances[drug].account(rate, bolus, delivered)
            else:
                self._balances[drug].reset()
        self._totals_known = known

    def _newly_short(self, drug: Drug) -> int:
        """In mU or 0.01 ug."""
        short = self._boluses.short[drug]
        new, self._short_seen[drug] = short - self._short_seen[drug], short
        return new * 10

    def _unbalanced(self) -> bool:
        return any(balance.off(self._boluses.remaining(drug) * 10) for drug, balance in self._balances.items())

    def _control(self, state: State, glucose: int, delivered: int, bolus: int) -> None:
        inputs = self._inputs
        inputs[layout.IN_GLUCOSE] = glucose
        inputs[layout.IN_DELIVERED] = delivered
        inputs[layout.IN_BOLUS] = bolus
        inputs[layout.IN_MODE] = self._mode
        inputs[layout.IN_RESET] = 1 if self._cgm.settling else 0
        cautious = self._cgm.doubtful or self._clock_caution > 0 or self._pump.insulin_blocked
        if state == State.SUSPENDED or self._cgm.below_range:
            inputs[layout.IN_LIMIT] = layout.LIMIT_SUSPEND
        elif state == State.AUTO and not cautious:
            inputs[layout.IN_LIMIT] = layout.LIMIT_NONE
        else:
            inputs[layout.IN_LIMIT] = layout.LIMIT_SCHEDULE
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
            self._rejected = True

    def _may_bolus(self, drug: Drug, state: State) -> bool:
        alone = self._now - self._last_impostor >= ALARM_HOLD  # nobody else tells the pump what to give (E2E-05)
        return state == State.AUTO and alone and self._pump.heard and self._boluses.ready(drug)

    def _insulin_left(self) -> int:
        """What twice the daily dose leaves within 24 h, in mU; a bolus under way counts (requirement LIM-06)."""
        limit = self._calibration.value("CfgInsulinTdd") * 20
        return max(limit - self._insulin_day.total - self._boluses.remaining(Drug.INSULIN) * 10, 0)

    def _pram_left(self) -> int:
        """0.1 ug that the limit of 24 h leaves."""
        delivered = round_divide(self._pram_day.total, 10)
        limit = self._calibration.value("CfgPramTdd")
        return max(limit - delivered - self._boluses.remaining(Drug.PRAMLINTIDE), 0)

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
        elif state in (State.AUTO, State.DEGRADED, State.DELIVERY_UNCERTAIN):
            rate, pramlintide = self._outputs[layout.OUT_RATE], self._outputs[layout.OUT_PRAM_RATE]
            if self._pump.command(self._turn, Op.SET_RATE, step, rate, pramlintide if rate > 0 else 0):
                self._outputs[layout.OUT_LIMITERS] |= layout.LIMITER_MAX_BASAL
        elif state == State.SUSPENDED:
            self._pump.command(self._turn, Op.SUSPEND, step)
        elif self._calibration.active and state != State.FAULT:
            self._pump.command(self._turn, Op.RESUME_SCHEDULE, step)

    def _report_alarms(self, state: State, step: int) -> None:
        alarms = self._alarms
        age = self._cgm.age(step)
        if self._e2e_errors() > self._crc_errors_seen:
            self._crc_errors_seen = self._e2e_errors()
            self._last_e2e_error = step
        # a missing sample is told by LimiterBits, and by CgmLost when it matters
        if self._outputs[layout.OUT_LIMITERS] & ~layout.LIMITER_STALE_CGM and state == State.AUTO:
            self._last_limited = step
        if self._rejected or self._boluses.refused > self._refused_seen:
            self._refused_seen = self._boluses.refused
            self._last_rejected = step
            self._rejected = False
        if state != self._reported_state and not CHANGES_OF_THEIR_OWN.isdisjoint((state, self._reported_state)):
            self._last_change = step
        down = self._ladder.rung != State.AUTO
        silent = age >= AGE_DEGRADED or self._sensor_silent(step)
        lost = silent or (down and (alarms.active(Code.CGM_LOST) or state == self._ladder.rung))
        # without a calibration nothing is dosed, but a sensor that was heard and falls silent is told of all the same
        listening = self._calibration.active or self._cgm.sequence is not None
        alarms.hold(Code.CGM_LOST, lost and listening, min(age, 0xFFFF))
        alarms.hold(Code.CGM_IMPLAUSIBLE, step - self._last_implausible < ALARM_HOLD, step)
        alarms.hold(Code.E2E_FAULT, step - self._last_e2e_error < ALARM_HOLD, step)
        alarms.hold(Code.DOSE_LIMITED, step - self._last_limited < ALARM_HOLD, step)
        alarms.hold(Code.DOSE_REJECTED, step - self._last_rejected < ALARM_HOLD, step)
        alarms.hold(Code.PUMP_LOST, self._calibration.active and self._pump_age(step) >= PUMP_SILENT, step)
        amiss = self._boluses.uncertain or self._pump.unlike or self._pump.fallen or self._unbalanced()
        alarms.hold(Code.DELIVERY_UNCERTAIN, amiss, step)
        alarms.hold(Code.URGENT_LOW, self._urgent, step)
        alarms.hold(Code.CLOCK_JUMP, step - self._last_jump < ALARM_HOLD, step)
        alarms.hold(Code.NODE_RESET, step - self._last_reset < ALARM_HOLD, self._boots)
        alarms.hold(Code.WATCHDOG, bool(self._scheduler.late) or self._scheduler.bitten, self._scheduler.overruns)
        alarms.hold(Code.SELF_TEST, self._failures != Failure.NONE, self._failures)
        # Suspended stays a cause: the user is reminded of it
        alarms.hold(Code.STATE_CHANGE, step - self._last_change < ALARM_HOLD or state == State.SUSPENDED, state)
        if state != self._reported_state:
            # every change of state is told with its cause in the same step, also to a user who has confirmed it
            self.log("info", step * STEP_SECONDS, "ladder", f"{self._reported_state.name} -> {state.name}")
            self._reported_state = state
            for code in (Code.CGM_LOST, Code.PUMP_LOST, Code.DELIVERY_UNCERTAIN, Code.WATCHDOG, Code.SELF_TEST):
                alarms.repeat(code)
            if self._last_change == step:
                alarms.renew(Code.STATE_CHANGE)
        alarms.report(self._turn)

    def _report_status(self, state: State) -> None:
        used = self._cgm.sequence
        self._turn.send(
            "CTRL_Status",
            CtrlMode=self._mode,
            CtrlState=state,
            InsulinOnBoard=self._insulin_on_board(),
            LimiterBits=self._limiters(state),
            **({} if used is None else {"LastCgmSeq": used}),
            **({} if self._meals.last is None else {"LastMealId": self._meals.last}),
        )
        self._turn.send(
            "CTRL_Diag",
            E2eErrorCount=min(self._e2e_errors(), 4095),
            LostFrameCount=min(self._lost_frames(), 4095),
            SequenceErrorCount=min(self._all_sequence_errors(), 1023),
            SaturationCount=min(self._state[layout.SATURATIONS], 1023),
            NvmFallbackCount=min(self._fallbacks(), 255),
        )
        self._send_heartbeat(NMT_OPERATIONAL if self._calibration.active else NMT_PRE_OPERATIONAL)

    def _insulin_on_board(self) -> int:
        return min(self._outputs[layout.OUT_IOB] + self._boluses.remaining(Drug.INSULIN), IOB_MAX)

    def _limiters(self, state: State) -> int:
        return self._outputs[layout.OUT_LIMITERS] if state in COMMANDING else 0

    def _all_sequence_errors(self) -> int:
        by_number = self._pump.refused + self._meals.repeated
        unanswered = self._pump.unanswered + self._boluses.unanswered
        return self._sequence_errors + self._receiver.sequence_errors + by_number + unanswered

    def _fallbacks(self) -> int:
        return 0 if self._nvm is None else self._nvm.fallbacks

    def _e2e_errors(self) -> int:
        return self._receiver.crc_errors + self._receiver.malformed + self._impostors + self._bus_errors

    def _lost_frames(self) -> int:
        return self._receiver.lost + self._lost_unseen

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
            mode=self._mode,
            op=op,
            glucose=self._glucose,
            iob=self._insulin_on_board(),
            rate=rate,
            pram_rate=pram_rate,
            bolus=self._boluses.committed[Drug.INSULIN],
            pram_bolus=self._boluses.committed[Drug.PRAMLINTIDE],
            delivered=self._delivered,
            pram_delivered=self._pram_delivered,
            limiters=self._limiters(state),
            alarms=self._alarms.bits,
        )

    def _save(self) -> list[int]:
        resets = self._boot_steps + [-1] * (RESETS_KEPT - len(self._boot_steps))
        return [
            -1 if self._step is None else self._step,
            self._boots,
            self._mode,
            -1 if self._mode_sequence is None else self._mode_sequence,
            int(self._suspended),
            int(self._held),
            self._clock_caution,
            *resets,
            *self._meals.save(),
            *self._boluses.save(),
            *self._pump.save(),
            *self._cgm.save(),
            *self._alarms.save(),
            *self._insulin_day.save(),
            *self._pram_day.save(),
            *self._calibration.save(),
            *self._state,
        ]

    def _restore(self, words: Iterator[int]) -> None:
        """Take up an earlier life: everything that `_save` wrote, and one boot more."""
        step = next(words)
        self._step = None if step < 0 else step
        self._boots = next(words) + 1
        self._mode = next(words)
        sequence = next(words)
        self._mode_sequence = None if sequence < 0 else sequence
        self._suspended = next(words) == 1
        self._held = next(words) == 1
        self._clock_caution = next(words)
        self._boot_steps = [reset for reset in (next(words) for _ in range(RESETS_KEPT)) if reset >= 0]
        for part in (
            self._meals,
            self._boluses,
            self._pump,
            self._cgm,
            self._alarms,
            self._insulin_day,
            self._pram_day,
            self._calibration,
        ):
            part.restore(words)
        self._state[:] = [next(words) for _ in layout.STATE]
        self._reset_here = True

    # ---- what the console sees

    def status(self) -> dict[str, int | str]:
        """The newest step; rates and doses raw, as in the DBC."""
        step = -1 if self._step is None else self._step
        return {
            "step": step,
            "time": max(step, 0) * STEP_SECONDS,
            "state": self._ladder.state.name.lower(),
            "mode": self._mode,
            "glucose": self._inputs[layout.IN_GLUCOSE],
            "cgm_age": min(self._cgm.age(max(step, 0)), STEP_SNA),
            "rate": self._outputs[layout.OUT_RATE],
            "pram_rate": self._outputs[layout.OUT_PRAM_RATE],
            "iob": self._outputs[layout.OUT_IOB],
            "limiters": self._outputs[layout.OUT_LIMITERS],
            "e2e_errors": self._e2e_errors(),
            "lost_frames": self._lost_frames(),
            "boots": self._boots,
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
        counters = (
            self._e2e_errors(),
            self._lost_frames(),
            self._all_sequence_errors(),
            self._state[layout.SATURATIONS],
            self._fallbacks(),
            self._scheduler.overruns,
            self._boots,
        )
        return {
            0xF18C: SERIAL_NUMBER,
            0xF190: DEVICE_ID,
            0xF191: b"SIM",
            0xF195: f"{VERSION[0]}.{VERSION[1]}".encode(),
            0x0100: bytes([major, minor]),
            0x0101: dbc.crc32().to_bytes(4, "big"),
            0x0102: bytes([self._ladder.state, self._mode]),
            0x0103: (STEP_SNA if self._step is None else self._step).to_bytes(4, "big"),
            0x0120: len(records).to_bytes(2, "big"),
            **{0x0110 + i: min(count, 0xFFFF).to_bytes(2, "big") for i, count in enumerate(counters)},
        }

    def history_at(self, place: int) -> bytes:
        """The packed record in a place of the ring; empty where there is none."""
        record = self._history.at(place)
        return b"" if record is None else pack(record)

    def dtc_status(self, code: Code) -> int:
        """Status byte of an alarm's DTC."""
        in_force, since_boot, since_clear = self._alarms.history(code)
        kept = CONFIRMED | FAILED_SINCE_CLEAR if since_clear else 0
        return (FAILED if in_force else 0) | (FAILED_THIS_CYCLE if since_boot else 0) | kept

    def clear_dtcs(self, codes: tuple[Code, ...]) -> None:
        """Forget what is remembered of these alarms; one that is in force stays in force."""
        for code in codes:
            self._alarms.clear(code)

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
