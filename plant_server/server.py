"""The plant as a node on the bus: patient, sensor, pump and user, and the keeper of simulated time.

One object plays the nodes PLANT, CGM, PUMP and UI of the DBC, and TESTER while it flashes the calibration. It opens
every sampling instant with what the device must know, gives it the turn, and integrates the patient over five minutes
when the device says it is done. It never waits and never looks at a clock; `plant_server.serve` does.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import dbc
from can_bus import codec
from can_bus.batch import Batch, Layout
from can_bus.codec import Check, Receiver, Transmitter
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, TURNS_PER_STEP, Done, Phase

from . import mechanism, physiology
from .body import Body
from .faults import AnyPumpFault, PumpFault
from .physiology import Patient
from .pump import NMT_BOOT_UP, NMT_OPERATIONAL, REPORT, Pump, PumpSettings
from .scenario import Scenario
from .sensor import Sensor, SensorSettings
from .sensors.effects import Effect
from .user import Plan, User

_log = logging.getLogger("plant_server.server")

PMOL_PER_L_PER_MU_PER_L = 6.0
"""The model's conversion of plasma insulin: 1 mU/L = 6 pmol/L (Dalla Man et al. 2007)."""

GLUCOSE_UNKNOWN, RATE_UNKNOWN = 8191, -1024
"""CGM_Reading.GlucoseConc and GlucoseRate SNA."""

ALARM_PENDING = 1

MODE_SEQUENCES = 255
"""MODE_Cmd.ModeCmdSeq runs from 0 to 254."""

VERSION_UNKNOWN = 63
"""CTRL_Info.CtrlProtocolMajor and CtrlProtocolMinor SNA."""

READING: Layout = (("CGM_Reading", ("CgmState", "GlucoseConc", "GlucoseRate", "CgmSampleSeq", "CgmSampleStep"), {}),)
HEARTBEATS: Layout = (
    ("HB_PUMP", ("NmtPump", "BootPump", "TogglePump"), {"ResetCausePump": 0}),
    ("HB_CGM", ("ToggleCgm",), {"NmtCgm": NMT_OPERATIONAL, "ResetCauseCgm": 0, "BootCgm": 0}),
)
TRUTH: Layout = tuple(
    ("PLANT_Truth", ("TruthStep", *signals), {"TruthSel": page})
    for page, signals in enumerate(
        (
            ("TruthGlucose", "TruthInterstitial"),
            ("TruthInsulin", "TruthPramlintide"),
            ("TruthEta", "TruthQsto"),
            ("TruthRa", "TruthMealCarbs"),
            ("TruthInsulinCommanded", "TruthInsulinPending", "TruthInsulinLost"),
            ("TruthPramCommanded", "TruthPramPending", "TruthPramLost"),
        )
    )
)
TOKEN: Layout = (("SYNC_Step", ("SyncPhase", "StepIndex", "SimTime"), {}),)


class PlantError(RuntimeError):
    """The device broke the protocol or refused to run; the text says what it did and what was expected."""


class Run(NamedTuple):
    """What one run is made of."""

    patient: Patient
    scenario: Scenario
    steps: int
    seed: int
    mode: int  # CtrlMode to ask for
    calibration: Mapping[int, int]  # CfgIndex -> raw value, the CRC of the set last
    sensor: str | SensorSettings = "coloured"
    variability: tuple[str, ...] = tuple(physiology.SOURCES)
    faults: tuple[AnyPumpFault | Effect, ...] = ()  # of the pump, and of the sensor besides its own effects
    changes: tuple[Plan, ...] = ()  # of mode and scenario, in order of time

    @property
    def plans(self) -> tuple[Plan, ...]:
        """Mode and scenario, from instant 0 on and after every change."""
        return (Plan(0, self.mode, self.scenario), *self.changes)


def stated_version(info: Mapping[str, int]) -> tuple[int, int] | None:
    """Major and minor version in the raw values of CTRL_Info; None if it does not say."""
    version = info["CtrlProtocolMajor"], info["CtrlProtocolMinor"]
    return None if VERSION_UNKNOWN in version else version


def judge_version(theirs: tuple[int, int] | None, status: int) -> str | None:
    """Whether a device that answered the roll call is to be let in: the rules of docs/your-firmware.md.

    Args:
        theirs: major and minor version of its CTRL_Info; None: it does not say.
        status: DoneStatus of its answer.

    Returns:
        What is worth a warning, None if there is nothing.

    Raises:
        PlantError: it speaks another language, or it refuses.
    """
    ours = dbc.protocol_version()
    if theirs is not None and theirs[0] != ours[0]:
        raise PlantError(
            f"CTRL was built for protocol {_dotted(theirs)}, this bench speaks {_dotted(ours)}: "
            "rebuild the firmware with this bench's pumpbench.dbc"
        )
    if status == Done.FAULT:
        said = "does not say its version" if theirs is None else f"was built for protocol {_dotted(theirs)}"
        raise PlantError(
            f"CTRL refused the roll call with DoneStatus Fault; it {said}, this bench speaks {_dotted(ours)}: "
            "Fault means that the device takes the bench's major version for another one"
        )
    if theirs is None or theirs == ours:
        return None
    unaware = "the firmware" if theirs < ours else "this bench"
    return (
        f"CTRL was built for protocol {_dotted(theirs)}, this bench speaks {_dotted(ours)}: "
        f"{unaware} does not know what was added in between"
    )


def _dotted(version: tuple[int, int]) -> str:
    return ".".join(map(str, version))


class PlantServer:
    """The plant's side of the lockstep: see `can_bus.lockstep.Node`.

    Attributes:
        run: what it was made of.
        finished: the device has answered the end of the run.
        step: the sampling instant it is in.
        heard: something of CTRL came that it may use.
        late_answers: SYNC_Done to roll calls that were not the newest; a device that is slower than the calls.
    """

    def __init__(self, run: Run) -> None:
        self.run = run
        self.finished = False
        self.step = 0
        self.heard = False
        self.late_answers = 0
        self._phase = Phase.INIT
        self._turns = 0
        self._call = 0
        self._roll = Transmitter()
        self._transmitter = Transmitter()
        rest = (*REPORT, *HEARTBEATS, *TRUTH, *TOKEN)
        self._with_reading = Batch(self._transmitter, (*READING, *rest))
        self._without_reading = Batch(self._transmitter, rest)
        self._receiver = Receiver(message.name for message in dbc.load().messages if message.senders == ["CTRL"])
        self._patient = Body(run.patient, run.plans, run.steps, run.seed, run.variability)
        self._pump_faults = [fault for fault in run.faults if isinstance(fault, PumpFault)]
        sensor_faults = tuple(fault for fault in run.faults if isinstance(fault, Effect))
        self._sensor = Sensor(run.sensor, run.steps + 1, run.seed, run.patient.name, sensor_faults)
        self.pump = Pump(PumpSettings(basal_milliunits_per_h=round(run.patient.basal_u_per_h * 1000)))
        self._user = User(run.plans, run.seed, run.patient.name)
        self._mode = run.mode
        self._mode_asked = 0  # at this instant
        self._mode_commands = 1
        self._outbox: list[Frame] = []
        self._echoes: dict[int, int] = {}
        self._version: tuple[int, int] | None = None  # of the protocol the device was built for
        self._mode_seen: int | None = None

    @property
    def waiting_for(self) -> str:
        """What the plant is waiting for, in words."""
        what = {Phase.INIT: "the roll call", Phase.CONFIG: "the calibration", Phase.END: "the end of the run"}
        return f"CTRL to answer {what.get(self._phase, f'step {self.step}')} with SYNC_Done"

    # ---- turns

    def call_roll(self) -> list[Frame]:
        """The next roll call; to be repeated until `receive` has an answer."""
        self._call += 1
        major, minor = dbc.protocol_version()
        return [
            self._roll.frame("PLANT_Info", PlantProtocolMajor=major, PlantProtocolMinor=minor, PlantDbcCrc=dbc.crc32()),
            self._roll.frame("SYNC_Step", SyncPhase=Phase.INIT, StepIndex=self._call, SimTime=0),
        ]

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """Take one frame of the device.

        Raises:
            PlantError: the device speaks another protocol version, refused the calibration or the mode, or asked for
                more turns than any bolus needs.
        """
        check, name, values, _ = self._receiver.receive(frame)
        if check > Check.OK_SOME_LOST:
            return ()
        self.heard = True
        if name == "PUMP_BasalCmd":
            self._outbox += self.pump.command(values, self.step, self._transmitter)
        elif name == "PUMP_BolusCmd":
            self._outbox += self.pump.bolus(values, self.step, self._transmitter)
        elif name == "HB_CTRL":
            return self._hear_heartbeat(values)
        elif name == "SYNC_Done":
            return self._on_done(values)
        elif name == "CTRL_Status":
            self._mode_seen = values["CtrlMode"]
            self._user.hear(values["LastMealId"])
        elif name == "CTRL_Alarm":
            self._confirm(values)
        elif name == "CFG_ParamEcho":
            self._echoes[values["EchoIndex"]] = values["EchoRaw"]
        elif name == "CTRL_Info":
            self._version = stated_version(values)
        return ()

    def _hear_heartbeat(self, values: dict[str, int]) -> list[Frame]:
        """A device that starts anew in the middle of a run begins its E2E counters at 0, and has lost its turn."""
        if values["NmtCtrl"] != NMT_BOOT_UP or self._phase not in (Phase.STEP, Phase.END):
            return []
        self._receiver.reset()
        self._turns = 0
        time = self.step * STEP_SECONDS
        return [self._transmitter.frame("SYNC_Step", SyncPhase=self._phase, StepIndex=self.step, SimTime=time)]

    def _on_done(self, values: dict[str, int]) -> list[Frame]:
        expected = self._call if self._phase == Phase.INIT else self.step
        if values["DoneStepIndex"] != expected:
            if self._phase == Phase.INIT:
                self.late_answers += 1
                self._receiver.reset()  # the device counts from 0 again when it answers the next call
            return []
        if self._phase == Phase.INIT:
            warning = judge_version(self._version, values["DoneStatus"])
            if warning is not None:
                _log.warning("%s", warning)
            self._receiver.reset()
            return self._configure()
        if self._phase == Phase.CONFIG:
            self._check_calibration()
            return self._open_step()
        if self._phase == Phase.END:
            self.finished = True
            return []
        if values["DoneStatus"] == Done.CONTINUE:
            return self._next_turn()
        if self.step == self._mode_asked and self._mode_seen != self._mode:
            raise PlantError(f"CTRL did not take up mode {_mode_name(self._mode)}: {self._mode_found()}")
        self._advance()
        return self._open_step()

    def _configure(self) -> list[Frame]:
        names = codec.message("CFG_Param").pages
        frame = self._transmitter.frame
        self._phase = Phase.CONFIG
        return [
            frame("HB_PUMP", NmtPump=NMT_BOOT_UP, TogglePump=1, ResetCausePump=0, BootPump=0),
            frame("HB_CGM", NmtCgm=NMT_BOOT_UP, ToggleCgm=1, ResetCauseCgm=0, BootCgm=0),
            *(
                frame("CFG_Param", CfgIndex=index, **{names[index][0].name: raw})
                for index, raw in self.run.calibration.items()
            ),
            frame("MODE_Cmd", ModeRequest=self.run.mode, ModeCmdSeq=0, SuspendRequest=0),
            frame("SYNC_Step", SyncPhase=Phase.CONFIG, StepIndex=0, SimTime=0),
        ]

    def _check_calibration(self) -> None:
        names = codec.message("CFG_Param").pages
        for index, raw in self.run.calibration.items():
            sent = raw & 0x3FFFFFFF
            if self._echoes.get(index) != sent:
                found = self._echoes.get(index, "no echo")
                raise PlantError(
                    f"CTRL did not accept {names[index][0].name} (CfgIndex {index}): sent raw {sent}, echoed {found}"
                )

    def _mode_found(self) -> str:
        return "no CTRL_Status came" if self._mode_seen is None else f"it reports {_mode_name(self._mode_seen)}"

    def _next_turn(self) -> list[Frame]:
        self._turns += 1
        if self._turns > TURNS_PER_STEP:
            raise PlantError(f"CTRL asked for more than {TURNS_PER_STEP} turns in step {self.step}")
        frames = self._outbox
        self._outbox = []
        time = self.step * STEP_SECONDS + self._turns
        frames.append(self._transmitter.frame("SYNC_Step", SyncPhase=Phase.CONTINUE, StepIndex=self.step, SimTime=time))
        return frames

    def _open_step(self) -> list[Frame]:
        last = self.step == self.run.steps
        self._phase = Phase.END if last else Phase.STEP
        self._turns = 0
        if not last:
            self._patient.feel(self.step)
        frames = self._outbox
        self._outbox = []
        frames += self._confirm_pump_alarms()
        frames += self._fail_on_purpose()
        frames += self._switch_mode()
        if not last:
            frames += self._user.announce(self.step, self._patient.rescued, self._transmitter)
        frames += self.pump.report_alarms(self._transmitter)
        reading = self._read_sensor()
        frames += self._tell_sensor_faults()
        frames += self._sensor_status()
        regular = self._with_reading if reading else self._without_reading
        toggle = self.step & 1
        frames += regular.frames(
            [
                *reading,
                *self.pump.values(),
                *self.pump.heartbeat(),
                toggle,
                toggle,
                *self._truth(),
                self._phase,
                self.step,
                self.step * STEP_SECONDS,
            ]
        )
        return frames

    # ---- between two instants

    def rehearse(self) -> None:
        """Do an interval without a device, so that compiled code is loaded; this plant is of no use afterwards."""
        self._advance()

    def _advance(self) -> None:
        insulin, pramlintide = self.pump.deliver(self.step)
        for chamber in (self.pump.insulin, self.pump.pramlintide):
            if not mechanism.ledger_closes(chamber.words):
                raise PlantError(f"the pump's ledger does not close in step {self.step}: {chamber.words.tolist()}")
        self._patient.advance(self.step, insulin, pramlintide)
        self.step += 1

    def _read_sensor(self) -> tuple[int, ...]:
        """The raw values of READING; none when the sensor has dropped this sample."""
        sample = self._sensor.sample(self.step, self._patient.interstitial)
        if sample is None:
            return ()
        return (
            sample.state,
            GLUCOSE_UNKNOWN if sample.glucose is None else round(sample.glucose * 10),
            RATE_UNKNOWN if sample.rate is None else min(max(round(sample.rate * 100), -1020), 1020),
            sample.number,
            self.step % 256,
        )

    def _sensor_status(self) -> list[Frame]:
        status = self._sensor.status(self.step)
        if status is None:
            return []
        return [
            self._transmitter.frame(
                "CGM_Status",
                CgmFaultBits=status.fault_bits,
                CgmSessionId=status.session,
                CgmSensorAge=min(status.age_minutes, 65533),
                CgmNoise=min(round(status.noise * 2), 252),
                CgmBattery=round(status.battery * 2),
                CgmDropCount=status.dropped % 255,
            )
        ]

    def _confirm(self, alarm: dict[str, int]) -> None:
        """The user reads every alarm and confirms it."""
        if alarm["CtrlAlarmState"] == ALARM_PENDING:
            self._outbox.append(
                self._transmitter.frame(
                    "UI_AlarmAck", AlarmAckNode=1, AlarmAckAction=1, AlarmAckInstance=alarm["CtrlAlarmInstance"]
                )
            )

    def _switch_mode(self) -> list[Frame]:
        """Ask for the mode that a change of plan brings."""
        mode = next((plan.mode for plan in self.run.changes if plan.step == self.step), self._mode)
        if mode == self._mode:
            return []
        self._mode, self._mode_asked, self._mode_seen = mode, self.step, None
        number = self._mode_commands % MODE_SEQUENCES
        self._mode_commands += 1
        return [self._transmitter.frame("MODE_Cmd", ModeRequest=mode, ModeCmdSeq=number, SuspendRequest=0)]

    def _fail_on_purpose(self) -> list[Frame]:
        """Let the pump's faults act, and tell."""
        if not self._pump_faults:
            return []
        frames = []
        self.pump.insulin.mend()
        self.pump.pramlintide.mend()
        for fault in sorted(
            self._pump_faults, key=lambda fault: fault.active(self.step)
        ):  # what ends before what begins
            fault.act(self.pump, self.step)
            if fault.active(self.step):
                frames.append(fault.report(self.step))
        return frames

    def _tell_sensor_faults(self) -> list[Frame]:
        """What was done to the newest sample on purpose."""
        faults = self._sensor.faults_acting
        return [fault.report(self.step) for fault in faults]

    def _confirm_pump_alarms(self) -> list[Frame]:
        """The user confirms what the pump has shown since the last step."""
        frames = []
        for instance in self.pump.alarms.pending():
            self.pump.alarms.confirm(instance)
            frames.append(
                self._transmitter.frame("UI_AlarmAck", AlarmAckNode=2, AlarmAckAction=1, AlarmAckInstance=instance)
            )
        return frames

    def _truth(self) -> list[int]:
        """The raw values of TRUTH."""
        body, number = self._patient, self.step % 65536
        return [
            number, _raw(body.glucose, 0.02), _raw(body.interstitial, 0.02),
            number, _raw(body.plasma_insulin / PMOL_PER_L_PER_MU_PER_L, 0.02), _raw(body.plasma_pramlintide, 0.02),
            number, _raw(body.eta, 0.0001), _raw(body.q_sto, 4.0),
            number, _raw(body.rate_of_appearance, 0.001), _raw(body.carbs_starting(self.step), 0.02),
            number, *_ledger(self.pump.insulin.words),
            number, *_ledger(self.pump.pramlintide.words),
        ]  # fmt: skip


def _raw(value: float, scale: float) -> int:
    """A 16-bit raw value; what is beyond the range is shown at its end."""
    return min(max(round(value / scale), 0), 65535)


def _ledger(motor: mechanism.Words) -> tuple[int, int, int]:
    """Commanded, pending and lost strokes as the truth pages have them."""
    words = motor.tolist()
    commanded, pending, lost = (words[i] for i in (mechanism.COMMANDED, mechanism.PENDING, mechanism.LOST))
    return commanded % 65536, min(pending, 16383), lost % 16384


def _mode_name(code: int) -> str:
    choices = dbc.load().get_message_by_name("CTRL_Status").get_signal_by_name("CtrlMode").choices
    return str(choices.get(code, code))
