"""A device driven step by step: frames by hand, decoded answers.

    bench = Bench(device)               # roll call, calibration of adult#001, mode nma
    turn = bench.step(glucose=1500)     # one sampling instant: CGM, pump status and totals, token
    expect(turn.state == State.AUTO, "a device with good samples is in Auto")

Every turn is held against the rules of the lockstep and of E2E: nothing is said out of turn, every frame of CTRL has a
good CRC and the next counter, SYNC_Done is the last one and counts the others. The pump at this end obeys set-points to
the mU and knows no boluses; `loop.Loop` has the whole plant.
"""

import enum
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import dbc
from can_bus import codec
from can_bus.codec import Check, Receiver, Transmitter
from can_bus.faults.fields import repaired, with_raw
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, Done, Node, Phase
from firmware_sim.calibration import parameter_names
from plant_server.physiology import load_patient
from pumpbench.calibration import MODES, calibrate, with_crc
from pumpbench.signals import frame_text

NMA = MODES["nma"]


class State(enum.IntEnum):
    """CTRL_Status.CtrlState."""

    INIT = 0
    AUTO = 1
    DEGRADED = 2
    SAFE_BASAL = 3
    SUSPENDED = 4
    FAULT = 5
    DELIVERY_UNCERTAIN = 6


class Op(enum.IntEnum):
    """PUMP_BasalCmd.BasalOp."""

    SET_RATE = 1
    SUSPEND = 2
    RESUME_SCHEDULE = 3


GLUCOSE = 1200
"""0.1 mg/dL, the target of all adults: a firmware at rest asks for its schedule."""

HIGH = GLUCOSE + 800
"""0.1 mg/dL: calls for insulin above the schedule while it stays."""

SUSPEND = codec.choice("MODE_Cmd", "SuspendRequest", "Suspend")
RESUME = codec.choice("MODE_Cmd", "SuspendRequest", "Resume")
PENDING = codec.choice("CTRL_Alarm", "CtrlAlarmState", "Pending")

SIM_TIME_SNA = 268435455
"""SimTime of the steps after 8.5 years, which it cannot hold."""


class Violation(AssertionError):
    """The device broke a rule; the text says what was expected and what came."""


class Silent(Violation):
    """No answer in time, or the device is gone."""


def expect(holds: bool, rule: str) -> None:
    """Hold the device to a rule.

    Raises:
        Violation: it does not hold.
    """
    if not holds:
        raise Violation(rule)


SENT_BY_CTRL = tuple(message.name for message in dbc.load().messages if message.senders == ["CTRL"])

HEARD_BY_CTRL = tuple(each for each in dbc.load().messages if "CTRL" in each.receivers and each.name != "UDS_Request")
"""What CTRL receives; the diagnostics are a protocol of their own."""


@functools.cache
def _calibration(patient: str) -> tuple[tuple[int, int], ...]:
    return tuple(calibrate(load_patient(patient)).items())


def calibration(patient: str = "adult#001", **raws: int) -> dict[int, int]:
    """The calibration of a patient, index -> raw value with the CRC last; `raws` by signal name change it."""
    return changed(dict(_calibration(patient)), **raws)


def changed(flash: Mapping[int, int], **raws: int) -> dict[int, int]:
    """A calibration with these raw values by signal name, and the CRC that goes with them."""
    return with_crc(dict(flash) | {parameter_index(name): raw for name, raw in raws.items()})


def parameter_index(name: str) -> int:
    """CfgIndex of a parameter."""
    return next(index for index, known in parameter_names().items() if known == name)


@dataclass
class Turn:
    """What the firmware said in one turn."""

    frames: list[Frame]
    said: list[tuple[str, dict[str, int]]] = field(default_factory=list)  # message name, raw values; in order

    def all(self, name: str) -> list[dict[str, int]]:
        """The frames of one message."""
        return [values for said, values in self.said if said == name]

    def one(self, name: str) -> dict[str, int]:
        """The only frame of one message.

        Raises:
            Violation: there is none, or more than one.
        """
        found = self.all(name)
        expect(len(found) == 1, f"one {name} in a turn; {len(found)} came, of {', '.join(self.names) or 'no frames'}")
        return found[0]

    def alarms(self, code: int | str) -> list[dict[str, int]]:
        """The alarm frames of one code, by number or by its name in the DBC."""
        return [alarm for alarm in self.all("CTRL_Alarm") if alarm["CtrlAlarmCode"] == alarm_code(code)]

    def pending(self, code: int | str) -> bool:
        """Whether an alarm of this code is told as pending."""
        return any(alarm["CtrlAlarmState"] == PENDING for alarm in self.alarms(code))

    @property
    def names(self) -> list[str]:
        """Names of all frames in order."""
        return [name for name, _ in self.said]

    @property
    def done(self) -> dict[str, int]:
        """SYNC_Done."""
        return self.one("SYNC_Done")

    @property
    def command(self) -> dict[str, int]:
        """PUMP_BasalCmd."""
        return self.one("PUMP_BasalCmd")

    @property
    def rate(self) -> int:
        """The commanded insulin rate, 0.005 U/h; a set-point must have been sent."""
        operation = self.command["BasalOp"]
        expect(operation == Op.SET_RATE, f"a set-point (BasalOp SetRate); BasalOp {operation} came")
        return self.command["InsulinRate"]

    @property
    def pramlintide(self) -> int:
        """The pramlintide rate (0.1 ug/h) that the pump runs after this turn: only a set-point has one."""
        return self.command["PramlintideRate"] if self.command["BasalOp"] == Op.SET_RATE else 0

    @property
    def status(self) -> dict[str, int]:
        """CTRL_Status."""
        return self.one("CTRL_Status")

    @property
    def iob(self) -> int:
        """InsulinOnBoard, 0.01 U."""
        return self.status["InsulinOnBoard"]

    @property
    def used(self) -> int:
        """CgmSampleSeq of the newest sample the device says it has used; 65535: none."""
        return self.status["LastCgmSeq"]

    @property
    def state(self) -> State:
        """CTRL_Status.CtrlState."""
        number = self.status["CtrlState"]
        expect(number in set(State), f"a CtrlState of the DBC; {number} came")
        return State(number)

    @property
    def state_name(self) -> str:
        """The state as the DBC calls it."""
        return _state_names().get(self.status["CtrlState"], str(self.status["CtrlState"]))

    @property
    def diag(self) -> dict[str, int]:
        """CTRL_Diag."""
        return self.one("CTRL_Diag")


class Bench:
    """The other end of a device's wire: roll call, calibration, sensor, pump, user and time."""

    def __init__(
        self,
        firmware: Node,
        *,
        patient: str = "adult#001",
        mode: int = NMA,
        flash: dict[int, int] | None = None,
        start: bool = True,
    ) -> None:
        """Put a device on the bench.

        Args:
            firmware: the device.
            patient: whose calibration to flash.
            mode: CtrlMode to ask for.
            flash: another calibration; {} for none at all.
            start: call the roll and flash; otherwise the caller does.
        """
        self.firmware = firmware
        self.flash = calibration(patient) if flash is None else flash
        self.basal = self.flash.get(0, 0)  # 0.001 U/h
        self.schedule = self.basal // 5  # 0.005 U/h, as in InsulinRate
        self.log: list[Frame] = []  # everything on the bus, both directions, in order
        self.k = 0  # the next step
        self.total = 0  # 1/12 mU delivered
        self.pram_total = 0  # 1/12 of 0.01 ug
        self.boot_count = 0
        self._rate = self.basal  # 0.001 U/h, what the pump is doing
        self._pram_rate = 0  # 0.01 ug/h
        self._calls = 0
        self._roll = Transmitter()
        self.transmitter = Transmitter()
        self.receiver = Receiver(SENT_BY_CTRL)
        if start:
            self.call_roll()
            self.configure(self.flash, mode)

    # ---- frames

    def frame(self, name: str, **values: int) -> Frame:
        """Build a frame of any node but CTRL; its counter goes on even if the frame is never sent."""
        return self.transmitter.frame(name, **values)

    def forge(self, frame: Frame, **raws: int) -> Frame:
        """The frame with any bits in these fields, its CRC repaired: what only plausibility can catch."""
        message = codec.messages_by_id()[frame.can_id]
        return Frame(frame.can_id, repaired(message, with_raw(message, frame.data, raws)))

    def give(self, *frames: Frame) -> None:
        """Frames for the firmware to hear; it must keep silent, for it is not its turn."""
        for frame in frames:
            self.log.append(frame)
            said = self.firmware.receive(frame)
            if said:
                raise Violation(f"silence out of turn; after {frame_text(frame)} came {_texts(said)}")

    def reboot(self, said: Sequence[Frame]) -> None:
        """The device was started anew and has said this: its counters begin again."""
        self.receiver = Receiver(SENT_BY_CTRL)
        self.listen(said)

    def send(self, name: str, **values: int) -> None:
        """Build a frame and give it."""
        self.give(self.frame(name, **values))

    def token(self, phase: int, step: int, time: int = 0) -> Turn:
        """Give the turn and hear what is said."""
        return self.hand_over(self.frame("SYNC_Step", SyncPhase=phase, StepIndex=step, SimTime=time), step)

    def hand_over(self, token: Frame, step: int) -> Turn:
        """Give the turn with a frame of one's own."""
        self.log.append(token)
        return self.check(self.listen(self.firmware.receive(token)), step)

    def check(self, turn: Turn, step: int) -> Turn:
        """Whether a turn is closed as it should be."""
        if not turn.names:
            raise Silent(f"an answer to the token of step {step}; none came")
        expect(turn.names[-1] == "SYNC_Done", f"SYNC_Done last in a turn; {', '.join(turn.names)} came")
        index, count = turn.done["DoneStepIndex"], turn.done["TxCount"]
        expect(index == step, f"SYNC_Done for step {step}; it names {index}")
        expect(count == len(turn.frames), f"TxCount {len(turn.frames)}, the frames of this turn; {count} came")
        return turn

    def listen(self, frames: Sequence[Frame]) -> Turn:
        """Check and decode what the firmware said."""
        turn = Turn(list(frames))
        for frame in frames:
            check, name, values, _ = self.receiver.receive(frame)
            if check != Check.OK:
                wrong = "is not a frame of CTRL" if check == Check.UNKNOWN else f"fails: {check.name}"
                raise Violation(f"frames of CTRL with good CRC and the next counter; {frame_text(frame)} {wrong}")
            turn.said.append((name, values))
        self.log += frames
        return turn

    # ---- the run

    def call_roll(self, version: tuple[int, int] | None = None) -> Turn:
        """Call the roll until it is answered; the counters of both sides start anew after it.

        In the middle of a run the first call comes with a counter the firmware did not expect.
        """
        major, minor = version or dbc.protocol_version()
        for _ in range(3):
            self._calls += 1
            self.give(
                self._roll.frame(
                    "PLANT_Info", PlantProtocolMajor=major, PlantProtocolMinor=minor, PlantDbcCrc=dbc.crc32()
                )
            )
            token = self._roll.frame("SYNC_Step", SyncPhase=Phase.INIT, StepIndex=self._calls, SimTime=0)
            self.log.append(token)
            answer = self.firmware.receive(token)
            if answer:
                break
        else:
            raise Silent("an answer to one of three roll calls; none came")
        self.receiver = Receiver(SENT_BY_CTRL)
        turn = self.check(self.listen(answer), self._calls)
        self.transmitter, self.receiver = Transmitter(), Receiver(SENT_BY_CTRL)
        return turn

    def configure(self, flash: dict[int, int], mode: int | None = None) -> Turn:
        """Flash parameters, ask for a mode, and give the turn for it."""
        names = parameter_names()
        for index, raw in flash.items():
            self.send("CFG_Param", CfgIndex=index, **{names[index]: raw})
        if mode is not None:
            self.request(0, 0, mode)
        turn = self.token(Phase.CONFIG, 0)
        status = turn.done["DoneStatus"]
        expect(status == Done.OK, f"DoneStatus Ok after the calibration; {status} came")
        return turn

    @property
    def number(self) -> int:
        """CgmSampleSeq of the step to come."""
        return self.k % 65535

    def sample(self, glucose: int = GLUCOSE, **values: int) -> Frame:
        """CGM_Reading of the step to come, or with fields of one's own."""
        fields = {"CgmState": 1, "GlucoseConc": glucose, "CgmSampleSeq": self.number, "CgmSampleStep": self.k % 256}
        return self.frame("CGM_Reading", **(fields | values))

    def status(self, **values: int) -> Frame:
        """PUMP_Status of the step to come, or with fields of one's own."""
        fields = {"PumpState": 3, "InsulinReservoir": 2000, "PramReservoir": 2000, "PumpBattery": 90}
        return self.frame("PUMP_Status", **(fields | values))

    def delivered(self, **values: int) -> Frame:
        """PUMP_Delivered of the step to come, or with fields of one's own."""
        totals = {"InsulinTotal": self.total // 12, "PramTotal": self.pram_total // 12}
        fields = {"PumpBootCount": self.boot_count, **totals}
        return self.frame("PUMP_Delivered", **(fields | values))

    def step(
        self,
        glucose: int = GLUCOSE,
        *,
        cgm: Sequence[Frame] | None = None,
        drop: bool = False,
        status: bool = True,
        totals: Frame | bool = True,
        also: Sequence[Frame] = (),
    ) -> Turn:
        """One sampling instant and the five minutes after it.

        Args:
            glucose: 0.1 mg/dL, what the sensor says.
            cgm: what arrives of the sensor instead.
            drop: the sensor's frame is lost on its way.
            status: whether the pump's status arrives.
            totals: PUMP_Delivered, or whether it arrives.
            also: further frames before the token.
        """
        if cgm is None:
            sample = self.sample(glucose)
            cgm = () if drop else (sample,)
        state = self.status()
        total = self.delivered() if isinstance(totals, bool) else totals
        frames = [*cgm, *([state] if status else ()), *([total] if totals is not False else ()), *also]
        return self.instant(*frames)

    def instant(self, *frames: Frame, off: int = 0) -> Turn:
        """One step with just these frames, and a clock that is so many seconds off."""
        self.give(*frames)
        turn = self.token(Phase.STEP, self.k, min(self.k * STEP_SECONDS + off, SIM_TIME_SNA))
        self.obey(turn)
        self.k += 1
        return turn

    def request(self, number: int, suspend: int, mode: int = NMA) -> None:
        """The user suspends, resumes, or only asks for a mode (`suspend` 0)."""
        self.send("MODE_Cmd", ModeRequest=mode, ModeCmdSeq=number, SuspendRequest=suspend)

    def confirm(self, turn: Turn) -> None:
        """The user confirms whatever is pending."""
        for alarm in turn.all("CTRL_Alarm"):
            if alarm["CtrlAlarmState"] == PENDING:
                self.send("UI_AlarmAck", AlarmAckNode=1, AlarmAckAction=1, AlarmAckInstance=alarm["CtrlAlarmInstance"])

    def commanded(self, turn: Turn) -> float:
        """The insulin rate (0.005 U/h) that the pump runs after this turn: the set-point, none, or its own schedule."""
        command = turn.command
        rates = {Op.SET_RATE: float(command["InsulinRate"]), Op.SUSPEND: 0.0, Op.RESUME_SCHEDULE: self.basal / 5}
        expect(command["BasalOp"] in rates, f"SetRate, Suspend or ResumeSchedule; BasalOp {command['BasalOp']} came")
        return rates[Op(command["BasalOp"])]

    def obey(self, turn: Turn) -> None:
        """The pump takes the commands of a turn, and runs for five minutes."""
        for command in turn.all("PUMP_BasalCmd"):
            rates = {Op.SET_RATE: command["InsulinRate"] * 5, Op.SUSPEND: 0, Op.RESUME_SCHEDULE: self.basal}
            self._rate = rates[Op(command["BasalOp"])]
            self._pram_rate = command["PramlintideRate"] * 10 if command["BasalOp"] == Op.SET_RATE else 0
        self.total += self._rate
        self.pram_total += self._pram_rate

    def raised(self, code: int | str) -> list[dict[str, int]]:
        """All alarm frames of one code on this bench so far."""
        said = [frame for frame in self.log if frame.can_id == codec.message("CTRL_Alarm").can_id]
        decoded = [codec.message("CTRL_Alarm").unpack(frame.data) for frame in said]
        return [alarm for alarm in decoded if alarm["CtrlAlarmCode"] == alarm_code(code)]

    def run(self, steps: int, glucose: int = GLUCOSE) -> Turn:
        """Several undisturbed steps, at least one; the last one's turn."""
        for _ in range(steps):
            turn = self.step(glucose)
        return turn


def alarm_code(code: int | str) -> int:
    """CtrlAlarmCode by number or by its name in the DBC."""
    return codec.choice("CTRL_Alarm", "CtrlAlarmCode", code) if isinstance(code, str) else code


@functools.cache
def _state_names() -> dict[int, str]:
    choices = dbc.load().get_message_by_name("CTRL_Status").get_signal_by_name("CtrlState").choices or {}
    return {int(number): str(name) for number, name in choices.items()}


def _texts(frames: Sequence[Frame]) -> str:
    return "; ".join(frame_text(frame) for frame in frames[:3])
