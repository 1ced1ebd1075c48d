"""The plant as a node: roll call, calibration, turns, and what it refuses."""

from collections.abc import Sequence

import pytest
from pumpbench.calibration import MODES, calibrate

import dbc
from can_bus import codec
from can_bus.codec import Receiver, Transmitter
from can_bus.frame import Frame
from can_bus.lockstep import TURNS_PER_STEP, Done, Phase, Turn
from firmware_sim.firmware import Firmware
from plant_server import serve
from plant_server.physiology import load_patient
from plant_server.scenario import load_scenario
from plant_server.server import PlantError, PlantServer, Run

PATIENT = load_patient("adult#001")
EVERYTHING = [message.name for message in dbc.load().messages]


def new_plant(steps: int = 4, mode: str = "nma") -> PlantServer:
    return PlantServer(Run(PATIENT, load_scenario("fasting"), steps, 1, MODES[mode], calibrate(PATIENT)))


class Device:
    """Answers by hand."""

    def __init__(self, plant: PlantServer) -> None:
        self.plant = plant
        self.transmitter = Transmitter()
        self.receiver = Receiver(EVERYTHING)

    def decode(self, frames: list[Frame]) -> list[tuple[str, dict[str, int]]]:
        found = [self.receiver.receive(frame) for frame in frames]
        assert all(one.check == 0 for one in found)
        return [(one.name, one.values) for one in found]

    def say(self, name: str, **values: int) -> list[tuple[str, dict[str, int]]]:
        return self.decode(list(self.plant.receive(self.transmitter.frame(name, **values))))

    def done(self, step: int, status: Done = Done.OK) -> list[tuple[str, dict[str, int]]]:
        return self.say("SYNC_Done", DoneStatus=status, DoneStepIndex=step, TxCount=1)

    def join(self, mode: str = "nma") -> list[tuple[str, dict[str, int]]]:
        """Roll call and calibration; returns the batch of step 0."""
        self.decode(self.plant.call_roll())
        self.receiver.reset()
        for name, values in self.done(1):
            if name == "CFG_Param":
                raw = next(value for key, value in values.items() if key != "CfgIndex")
                self.say("CFG_ParamEcho", EchoIndex=values["CfgIndex"], EchoRaw=raw & 0x3FFFFFFF, EchoSetCrc=0)
        return self.done(0)


def test_a_run_is_roll_call_calibration_steps_and_an_end() -> None:
    device = Device(new_plant(steps=2))
    assert [name for name, _ in device.decode(device.plant.call_roll())] == ["PLANT_Info", "SYNC_Step"]
    assert [values["StepIndex"] for _, values in device.decode(device.plant.call_roll())[1:]] == [2]
    assert device.done(1) == []  # the answer to an older call
    device = Device(new_plant(steps=2))
    batch = device.join()
    names = [name for name, _ in batch]
    assert names[-1] == "SYNC_Step"
    assert names.index("CGM_Reading") < names.index("PUMP_Status")
    assert names.count("PLANT_Truth") == 6
    assert {"PUMP_Status", "PUMP_Delivered", "PUMP_BolusState", "HB_PUMP", "HB_CGM"} < set(names)
    device.say("CTRL_Status", CtrlMode=MODES["nma"], CtrlState=1)
    assert device.done(0)[-1][1] == {"SyncPhase": Phase.STEP, "StepIndex": 1, "SimTime": 300}
    assert device.done(1)[-1][1] == {"SyncPhase": Phase.END, "StepIndex": 2, "SimTime": 600}
    assert not device.plant.finished
    assert device.done(2) == []
    assert device.plant.finished


def test_a_device_that_is_slow_to_answer_the_roll_call_is_taken_all_the_same() -> None:
    """Every call is a new life for it, whose first answer has the counter of the one before."""
    plant, firmware = new_plant(), Firmware()
    calls = [frame for _ in range(3) for frame in plant.call_roll()]
    answers = [answer for frame in calls for answer in firmware.receive(frame)]
    batches = [list(plant.receive(answer)) for answer in answers]
    assert [bool(batch) for batch in batches] == [False] * (len(answers) - 1) + [True]
    assert codec.message("CFG_Param").can_id in {frame.can_id for frame in batches[-1]}


def test_answers_to_older_calls_that_a_serial_line_held_back_do_not_spoil_the_newest() -> None:
    """A device begins its counters anew with every roll call: what it says is no repetition."""
    device = Device(new_plant())
    for _ in range(3):
        device.plant.call_roll()
    for call in (1, 2):
        device.transmitter = Transmitter()
        assert device.done(call) == []
    device.transmitter = Transmitter()
    assert [name for name, _ in device.done(3)][-1] == "SYNC_Step"


class SlowLine:
    """A firmware that hears and is heard later, by a clock of its own."""

    url, carries_errors = "slow", True

    def __init__(self, delay: float) -> None:
        self.delay, self.now = delay, 0.0
        self.firmware = Firmware()
        self.coming: list[tuple[float, Frame]] = []

    def monotonic(self) -> float:
        return self.now

    def send(self, frames: Sequence[Frame]) -> None:
        said = [answer for frame in frames for answer in self.firmware.receive(frame)]
        self.coming += [(self.now + self.delay, frame) for frame in said]

    def recv(self, timeout: float) -> list[Frame]:
        self.now = min([self.now + timeout, *(max(due, self.now) for due, _ in self.coming)])
        there = [frame for due, frame in self.coming if due <= self.now]
        self.coming = [(due, frame) for due, frame in self.coming if due > self.now]
        return there


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.12, 0.5])
def test_a_device_slower_than_the_roll_is_called_is_heard(delay: float, monkeypatch: pytest.MonkeyPatch) -> None:
    line = SlowLine(delay)
    monkeypatch.setattr(serve.time, "monotonic", line.monotonic)
    plant = new_plant(steps=2)
    serve.serve(plant, line)
    assert plant.finished


def test_the_pump_answers_at_the_head_of_the_next_batch() -> None:
    device = Device(new_plant())
    device.join()
    device.say("CTRL_Status", CtrlMode=MODES["nma"], CtrlState=1)
    assert (
        device.say("PUMP_BasalCmd", BasalOp=1, BasalCmdSeq=0, InsulinRate=200, PramlintideRate=0, BasalUntilStep=3)
        == []
    )
    batch = device.done(0)
    assert [name for name, _ in batch[:2]] == ["PUMP_Ack", "PUMP_Ack"]
    assert [values["AckFor"] for _, values in batch[:2]] == [1, 8]


def test_continue_gives_another_turn_in_the_same_instant() -> None:
    device = Device(new_plant())
    device.join()
    device.say("CTRL_Status", CtrlMode=MODES["nma"], CtrlState=1)
    device.say("PUMP_BasalCmd", BasalOp=1, BasalCmdSeq=0, InsulinRate=200, PramlintideRate=0, BasalUntilStep=3)
    turn = device.done(0, Done.CONTINUE)
    assert [name for name, _ in turn] == ["PUMP_Ack", "PUMP_Ack", "SYNC_Step"]
    assert turn[-1][1] == {"SyncPhase": Phase.CONTINUE, "StepIndex": 0, "SimTime": 1}
    assert device.plant.step == 0
    for _ in range(TURNS_PER_STEP - 1):
        device.done(0, Done.CONTINUE)
    with pytest.raises(PlantError, match="more than 32 turns in step 0"):
        device.done(0, Done.CONTINUE)


def test_alarms_are_confirmed_by_the_user() -> None:
    device = Device(new_plant())
    device.join()
    device.say("CTRL_Status", CtrlMode=MODES["nma"], CtrlState=1)
    device.say(
        "CTRL_Alarm", CtrlAlarmState=1, CtrlAlarmPriority=2, CtrlAlarmCode=1, CtrlAlarmInstance=9, CtrlAlarmAux=0
    )
    assert ("UI_AlarmAck", {"AlarmAckNode": 1, "AlarmAckAction": 1, "AlarmAckInstance": 9}) in device.done(0)


def test_another_protocol_version_is_refused_by_name() -> None:
    device = Device(new_plant())
    device.decode(device.plant.call_roll())
    device.say("CTRL_Info", CtrlProtocolMajor=2, CtrlProtocolMinor=5, FirmwareMajor=1, FirmwareMinor=0, FirmwareBuild=0)
    with pytest.raises(PlantError, match=r"built for protocol 2\.5, this bench speaks 1\.\d"):
        device.done(1)


def test_a_refused_parameter_is_named() -> None:
    plant = new_plant()
    device = Device(plant)
    device.decode(plant.call_roll())
    device.receiver.reset()
    device.done(1)
    device.say("CFG_ParamEcho", EchoIndex=0, EchoRaw=1, EchoSetCrc=0)
    with pytest.raises(PlantError, match=r"CTRL did not accept CfgBasal \(CfgIndex 0\): sent raw 1425, echoed 1"):
        device.done(0)


@pytest.mark.parametrize("reported", [None, 6])
def test_a_mode_not_taken_up_is_named(reported: int | None) -> None:
    device = Device(new_plant())
    device.join()
    if reported is not None:
        device.say("CTRL_Status", CtrlMode=reported, CtrlState=1)
    found = "no CTRL_Status came" if reported is None else "it reports PramS2_RatioNMA"
    with pytest.raises(PlantError, match=f"did not take up mode InsulinNMA: {found}"):
        device.done(0)


def test_frames_that_fail_their_check_do_nothing() -> None:
    device = Device(new_plant())
    device.join()
    device.say("CTRL_Status", CtrlMode=MODES["nma"], CtrlState=1)
    frame = device.transmitter.frame("SYNC_Done", DoneStatus=0, DoneStepIndex=0, TxCount=1)
    for index in range(8):
        for bit in range(8):
            data = bytearray(frame.data)
            data[index] ^= 1 << bit
            assert device.plant.receive(Frame(frame.can_id, bytes(data))) == ()
    assert device.plant.step == 0


def test_a_fasting_patient_on_the_schedule_stays_where_it_is() -> None:
    """The stored schedule is the operating point's basal: 24 h of it move glucose by the pump's rounding only."""
    plant = PlantServer(Run(PATIENT, load_scenario("fasting"), 288, 1, MODES["nma"], calibrate(PATIENT), "ideal", ()))
    frames = list(plant.call_roll())
    firmware = Firmware()
    receiver = Receiver(["PLANT_Truth"])
    glucose = []
    while frames:
        answers = [answer for frame in frames for answer in firmware.receive(frame)]
        frames = [sent for frame in answers for sent in plant.receive(frame)]
        for frame in frames:
            values = receiver.receive(frame).values
            if "TruthGlucose" in values:
                glucose.append(values["TruthGlucose"] * 0.02)
    assert plant.finished
    assert len(glucose) == 289
    assert glucose[0] == pytest.approx(120.0, abs=0.02)
    assert max(abs(value - 120.0) for value in glucose) < 3.0


def test_a_turn_counts_what_it_sends() -> None:
    turn = Turn(Transmitter())
    turn.send("HB_CTRL", NmtCtrl=5, ToggleCtrl=0, ResetCauseCtrl=0, BootCtrl=0)
    frames = turn.close(7)
    (done,) = [one for one in map(Receiver(["SYNC_Done"]).receive, frames) if one.name == "SYNC_Done"]
    assert (done.values["TxCount"], done.values["DoneStepIndex"]) == (2, 7)
    assert len(turn.close(8)) == 1
