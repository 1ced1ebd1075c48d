"""Each fault of the wire: what arrives in place of what was sent, and what FAULT_Inject says of it."""

import pytest
from pydantic import ValidationError

from can_bus import codec, faults
from can_bus.codec import Check, Receiver, Transmitter
from can_bus.faults import Injector
from can_bus.faults.fields import condition
from can_bus.frame import CAN_EFF_FLAG, CAN_ERR_FLAG, CAN_RTR_FLAG, Frame
from can_bus.lockstep import Phase

CGM = codec.message("CGM_Reading")
BASAL = codec.message("PUMP_BasalCmd")
INJECT = codec.message("FAULT_Inject")
STEP = codec.message("SYNC_Step")


class Wire:
    """One direction through an injector: one CGM_Reading and one PUMP_Status in every step."""

    def __init__(self, *given: faults.Fault) -> None:
        self.injector = Injector(given)
        self.transmitter = Transmitter()
        self.sent: list[Frame] = []
        self.arrived: list[Frame] = []
        self.reports: list[dict[str, int]] = []
        self.step = 0

    def pass_on(self, frame: Frame) -> list[Frame]:
        self.sent.append(frame)
        passed, reports = self.injector.apply(frame, self.step * 300, "device")
        self.note(reports)
        self.arrived += passed
        return passed

    def note(self, frames: list[Frame]) -> None:
        self.reports += [INJECT.unpack(frame.data) for frame in frames if frame.can_id == INJECT.can_id]

    def run(self, steps: int, glucose: int = 1200) -> "Wire":
        for _ in range(steps):
            k = self.step
            reading = {"CgmState": 1, "GlucoseConc": glucose + k, "CgmSampleSeq": k, "CgmSampleStep": k % 256}
            self.pass_on(self.transmitter.frame("CGM_Reading", **reading))
            self.pass_on(self.transmitter.frame("PUMP_Status", PumpState=3))
            self.step += 1
        return self

    def sequence(self) -> list[int]:
        """CgmSampleSeq of the readings that arrived."""
        return [CGM.unpack(frame.data)["CgmSampleSeq"] for frame in self.readings()]

    def readings(self) -> list[Frame]:
        return [frame for frame in self.arrived if frame.can_id == CGM.can_id]

    def checks(self) -> list[Check]:
        """What a receiver of CGM_Reading makes of it all."""
        receiver = Receiver(["CGM_Reading"])
        checks = [receiver.receive(frame).check for frame in self.arrived]
        return [check for check in checks if check != Check.UNKNOWN]


def kinds(wire: Wire) -> set[str]:
    names = {code: label for label, code in KIND.items()}
    return {names[report["FaultKind"]] for report in wire.reports}


KIND = {
    label: codec.choice("FAULT_Inject", "FaultKind", label)
    for label in (
        "Drop", "Delay", "Duplicate", "CorruptRaw", "CorruptFixCrc", "Reorder", "Replay", "Stuck", "Babble", "BusOff",
        "WrongDlc", "ErrorFrame", "ClockDrift", "Masquerade", "CounterFreeze", "RemoteFrame", "ForeignId",
        "ExtendedId", "StuckValue", "Misroute", "ClockJump", "SlowTask",
    )
}  # fmt: skip
M = {"message": "CGM_Reading"}
WINDOW = {**M, "start": "00:15", "end": "00:30"}  # steps 3, 4, 5


# ---- which frames


@pytest.mark.parametrize(
    ("keys", "lost"),
    [
        ({}, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]),
        ({"start": "00:15", "end": "00:30"}, [3, 4, 5]),
        ({"nth": 3}, [2]),
        ({"nth": 2, "start": "00:15"}, [4]),
        ({"every": 4}, [3, 7]),
        ({"every": 2, "count": 3, "start": "00:10"}, [3, 5, 7]),
        ({"when": "CGM_Reading.GlucoseConc >= 120.5", "count": 2}, [6, 7]),  # by the frames before
        ({"when": "CGM_Reading.CgmState == Ok", "end": "00:20"}, [1, 2, 3]),
        ({"when": "CGM_Reading.CgmState != Ok"}, []),
        ({"when": "PUMP_Status.PumpState == Running", "count": 1}, [1]),
    ],
)
def test_a_fault_chooses_its_frames(keys: dict[str, object], lost: list[int]) -> None:
    wire = Wire(faults.Drop(**M, **keys)).run(10)
    assert [k for k in range(10) if k not in wire.sequence()] == lost
    assert [report["FaultParam"] for report in wire.reports] == lost


def test_what_is_random_is_random_by_seed() -> None:
    lost = [tuple(Wire(faults.Drop(**M, probability=0.3, seed=seed)).run(200).sequence()) for seed in (1, 1, 2)]
    assert lost[0] == lost[1] != lost[2]
    assert 110 < len(lost[0]) < 170
    two = Wire(faults.Drop(**M, probability=0.5), faults.Drop(**M, probability=0.5)).run(400)
    assert 60 < len(two.sequence()) < 140  # the second draws numbers of its own


def test_a_reading_without_a_value_is_neither_above_nor_below() -> None:
    below, above, is_sna = (condition(f"CGM_Reading.GlucoseConc {text}") for text in ("< 700", "> 0", "== SNA"))
    sna = {"CGM_Reading": {"GlucoseConc": 8191}}
    assert (below.holds(sna), above.holds(sna), is_sna.holds(sna)) == (False, False, True)
    some = {"CGM_Reading": {"GlucoseConc": 700}}
    assert (below.holds(some), above.holds(some), is_sna.holds(some)) == (True, True, False)
    assert condition("CGM_Reading.GlucoseConc <= 70").holds(some)
    assert not condition("CGM_Reading.GlucoseConc < 70").holds(some)
    assert not below.holds({})


# ---- what becomes of them


def test_lost() -> None:
    wire = Wire(faults.Drop(**WINDOW)).run(8)
    assert wire.sequence() == [0, 1, 2, 6, 7]
    assert wire.reports[0] == {
        "FaultTarget": 1, "FaultKind": KIND["Drop"], "FaultCanId": CGM.can_id, "FaultCount": 1, "FaultParam": 3,
    }  # fmt: skip


def test_late_by_steps() -> None:
    wire = Wire(faults.Delay(**WINDOW, steps=2)).run(10)
    status = [i for i, frame in enumerate(wire.arrived) if frame.can_id != CGM.can_id]
    came = {
        CGM.unpack(frame.data)["CgmSampleSeq"]: sum(i < at for i in status)
        for at, frame in enumerate(wire.arrived)
        if frame.can_id == CGM.can_id
    }
    assert came == {k: k + 2 * (k in (3, 4, 5)) for k in range(10)}
    assert wire.sequence() == [0, 1, 2, 3, 4, 6, 5, 7, 8, 9]  # ahead of what is sent then
    assert kinds(wire) == {"Delay"} and len(wire.reports) == 3


def test_late_by_milliseconds_is_behind_so_many_frames() -> None:
    wire = Wire(faults.Delay(**M, nth=2, ms=0.5)).run(4)
    names = [frame.can_id == CGM.can_id for frame in wire.arrived]
    assert names == [True, False, False, True, True, False, True, False]  # reading 1 behind status 1 and reading 2
    assert wire.sequence() == [0, 2, 1, 3]


def test_doubled() -> None:
    wire = Wire(faults.Duplicate(**M, nth=2, times=2)).run(3)
    assert wire.sequence() == [0, 1, 1, 1, 2]
    assert wire.checks() == [Check.OK, Check.OK, Check.REPEATED, Check.REPEATED, Check.OK]


def test_in_the_wrong_order() -> None:
    wire = Wire(faults.Reorder(**M, start="00:05")).run(8)
    assert wire.sequence() == [0, 1, 3, 2, 5, 4, 7, 6]


def test_replayed() -> None:
    wire = Wire(faults.Replay(**WINDOW, back=2)).run(8)
    assert wire.sequence() == [0, 1, 2, 1, 2, 3, 6, 7]
    first = Wire(faults.Replay(**M, back=5)).run(3)
    assert first.sequence() == [0, 1, 2] and not first.reports  # nothing to replay yet


@pytest.mark.parametrize(
    ("fault", "kind", "check"),
    [
        (faults.FlipBits(**WINDOW, bits=(20,)), "CorruptRaw", Check.ERROR),
        (faults.FlipBits(**WINDOW, bits=(0,)), "CorruptRaw", Check.ERROR),
        (faults.FlipBits(**WINDOW, random=3), "CorruptRaw", Check.ERROR),
        (faults.FlipBits(**WINDOW, bits=(20,), repair_crc=True), "CorruptFixCrc", Check.OK),
        (faults.SetValue(**WINDOW, signal="GlucoseConc", value=39, repair_crc=False), "CorruptRaw", Check.ERROR),
        (faults.SetValue(**WINDOW, signal="GlucoseConc", value=39), "CorruptFixCrc", Check.OK),
        (faults.StuckFrame(**WINDOW), "Stuck", Check.REPEATED),
        (faults.FrozenCounter(**WINDOW), "CounterFreeze", Check.REPEATED),
        (faults.StuckValue(**WINDOW, signal="GlucoseConc"), "StuckValue", Check.OK),
        (faults.WrongLength(**WINDOW, length=7), "WrongDlc", Check.MALFORMED),
        (faults.WrongLength(**WINDOW, length=0), "WrongDlc", Check.MALFORMED),
        (faults.RemoteFrame(**WINDOW), "RemoteFrame", Check.MALFORMED),
        (faults.ExtendedId(**WINDOW), "ExtendedId", Check.MALFORMED),
    ],
)
def test_damage_and_what_a_receiver_sees(fault: faults.Fault, kind: str, check: Check) -> None:
    wire = Wire(fault).run(8)
    checks = wire.checks()
    assert len(checks) == 8 and checks[:3] == [Check.OK] * 3 and checks[-1] == Check.OK
    assert checks[4:6] == [check] * 2
    assert checks[3] in (check, Check.OK)  # of what stands still the first one is good
    assert kinds(wire) == {kind} and [report["FaultParam"] for report in wire.reports] == [3, 4, 5]


def test_bits_are_those_of_the_payload() -> None:
    wire = Wire(faults.FlipBits(**M, nth=1, bits=(0, 63))).run(1)
    (sent, arrived) = (wire.sent[0].data, wire.arrived[0].data)
    assert bytes(a ^ b for a, b in zip(sent, arrived, strict=True)) == bytes([1, 0, 0, 0, 0, 0, 0, 0x80])


def test_values_are_physical_or_named() -> None:
    for keys, raw in (
        ({"signal": "GlucoseConc", "value": 54.3}, 543),
        ({"signal": "GlucoseConc", "value": "SNA"}, 8191),
        ({"signal": "CgmState", "value": "SensorFault"}, 6),
        ({"signal": "GlucoseConc", "add": -20.0}, 1000),
        ({"signal": "GlucoseConc", "add": -800.0}, 0),
        ({"signal": "GlucoseConc", "add": 800.0}, 8000),
        ({"signal": "GlucoseRate", "value": -2.0}, -200),
    ):
        wire = Wire(faults.SetValue(**M, **keys)).run(1)
        assert CGM.unpack(wire.arrived[0].data)[str(keys["signal"])] == raw
        assert wire.checks() == [Check.OK]


def test_a_signal_of_another_page_is_left_alone() -> None:
    injector = Injector([faults.SetValue(message="PLANT_Truth", signal="TruthEta", value=0.5)])
    glucose = Transmitter().frame("PLANT_Truth", TruthSel=0, TruthStep=1, TruthGlucose=5000)
    assert injector.apply(glucose, 0, "device") == ([glucose], [])
    eta = Transmitter().frame("PLANT_Truth", TruthSel=2, TruthStep=1, TruthEta=0)
    passed, reports = injector.apply(eta, 0, "device")
    assert codec.message("PLANT_Truth").unpack(passed[0].data)["TruthEta"] == 5000 and len(reports) == 1


def test_a_value_stands_still_with_a_living_counter() -> None:
    wire = Wire(faults.StuckValue(**WINDOW, signal="GlucoseConc")).run(8)
    glucose = [CGM.unpack(frame.data)["GlucoseConc"] for frame in wire.readings()]
    assert glucose == [1200, 1201, 1202, 1203, 1203, 1203, 1206, 1207]
    assert wire.sequence() == list(range(8))


def test_under_another_id() -> None:
    wire = Wire(faults.Misroute(**M, onto="PUMP_Status", nth=1)).run(1)
    status = codec.message("PUMP_Status")
    assert [frame.can_id for frame in wire.arrived] == [CGM.can_id, status.can_id, status.can_id]
    assert wire.arrived[1].data == wire.arrived[0].data
    receiver = Receiver(["PUMP_Status"])
    assert [receiver.receive(frame).check for frame in wire.arrived[1:]] == [Check.ERROR, Check.OK]


def test_forged_frames_pass_every_check_and_the_true_one_does_not() -> None:
    wire = Wire(faults.Masquerade(**M, nth=2, values={"GlucoseConc": 350.0})).run(4)
    glucose = [CGM.unpack(frame.data)["GlucoseConc"] for frame in wire.readings()]
    assert glucose == [1200, 1201, 3500, 1202, 1203]
    assert wire.checks() == [Check.OK, Check.OK, Check.OK, Check.REPEATED, Check.OK]


def test_several_faults_on_one_frame_act_in_their_order() -> None:
    wire = Wire(
        faults.Duplicate(**M, nth=1),
        faults.SetValue(**M, signal="GlucoseConc", value=50),
        faults.Drop(**M, start="00:05"),
    ).run(2)
    glucose = [CGM.unpack(frame.data)["GlucoseConc"] for frame in wire.readings()]
    assert glucose == [500, 1200]  # the second of two equal ones is left as it is
    assert [report["FaultKind"] for report in wire.reports] == [
        KIND["Duplicate"], KIND["CorruptFixCrc"], KIND["CorruptFixCrc"], KIND["Drop"],
    ]  # fmt: skip


# ---- the clock


@pytest.mark.parametrize(
    ("fault", "told"),
    [
        (faults.ClockJump(seconds=3600, start="00:10", end="00:20"), [0, 300, 4200, 4500, 1200, 1500]),
        (faults.ClockJump(seconds=-900, start="00:10", end="00:20"), [0, 300, 0, 0, 1200, 1500]),
        (faults.ClockDrift(ppm=100_000, start="00:05"), [0, 300, 630, 960, 1290, 1620]),
        (faults.DayChange(days=1, start="00:15"), [0, 300, 600, 87300, 87600, 87900]),
    ],
)
def test_the_time_that_is_told(fault: faults.Fault, told: list[int]) -> None:
    injector, transmitter, receiver = Injector([fault]), Transmitter(), Receiver(["SYNC_Step"])
    found = []
    for k in range(6):
        frame = transmitter.frame("SYNC_Step", SyncPhase=Phase.STEP, StepIndex=k, SimTime=300 * k)
        passed, reports = injector.apply(frame, 300 * k, "device")
        check, _, values, _ = receiver.receive(passed[0])
        assert check == Check.OK and values["StepIndex"] == k
        assert bool(reports) == (values["SimTime"] != 300 * k)
        found.append(values["SimTime"])
    assert found == told
    config = transmitter.frame("SYNC_Step", SyncPhase=Phase.CONFIG, StepIndex=0, SimTime=0)
    assert injector.apply(config, 900, "device") == ([config], [])


# ---- the bus


def barrier(injector: Injector, steps: int, side: str = "device") -> list[list[Frame]]:
    return [injector.barrier(300 * k, side) for k in range(steps)]


def test_a_babbling_node() -> None:
    put = barrier(Injector([faults.Babble(frames=3, start="00:05", every=2)]), 6)
    assert [len(frames) for frames in put] == [0, 4, 0, 4, 0, 4]
    report, *babble = put[1]
    assert INJECT.unpack(report.data) == {
        "FaultTarget": 5, "FaultKind": KIND["Babble"], "FaultCanId": 0, "FaultCount": 3, "FaultParam": 1,
    }  # fmt: skip
    assert {frame.can_id for frame in babble} == {0} and len({frame.data for frame in babble}) == 3
    again = barrier(Injector([faults.Babble(frames=3, start="00:05", every=2)]), 6)
    assert again == put
    named = barrier(Injector([faults.Babble(message="PUMP_Ack", frames=2)]), 1)[0]
    ack = codec.message("PUMP_Ack")
    assert [(frame.can_id, len(frame.data)) for frame in named[1:]] == [(ack.can_id, ack.length)] * 2


def test_further_turns_of_a_step_get_no_more() -> None:
    injector = Injector([faults.ForeignId(id=0x7FF, data="ff")])
    assert injector.barrier(300, "device")[1:] == [Frame(0x7FF, b"\xff")]
    assert injector.barrier(301, "device") == []
    assert injector.barrier(600, "plant") == []
    toward_plant = Injector([faults.ForeignId(side="plant")])
    assert toward_plant.barrier(0, "device") == []
    assert [frame.can_id for frame in toward_plant.barrier(0, "plant")] == [INJECT.can_id, 0x555]


def test_error_frames() -> None:
    (put,) = barrier(Injector([faults.ErrorFrames(frames=2)]), 1)
    assert [frame.is_error for frame in put] == [False, True, True]
    assert KIND["ErrorFrame"] == INJECT.unpack(put[0].data)["FaultKind"]


def test_off_the_bus_nothing_passes_but_the_lockstep() -> None:
    wire = Wire(faults.BusOff(start="00:15", end="00:30")).run(8)
    assert wire.sequence() == [0, 1, 2, 6, 7]
    assert len(wire.arrived) == 10 and kinds(wire) == {"BusOff"}
    token = wire.transmitter.frame("SYNC_Step", SyncPhase=Phase.STEP, StepIndex=4, SimTime=1200)
    assert wire.injector.apply(token, 1200, "device") == ([token], [])
    done = wire.transmitter.frame("SYNC_Done")
    assert wire.injector.apply(done, 1200, "plant") == ([done], [])
    command = wire.transmitter.frame("PUMP_BasalCmd")
    assert wire.injector.apply(command, 1200, "plant")[0] == []
    put = barrier(Injector([faults.BusOff(start="00:15", end="00:30")]), 8)
    errors = [(k, frame.can_id) for k, frames in enumerate(put) for frame in frames if frame.is_error]
    assert errors == [(3, CAN_ERR_FLAG | 0x40), (6, CAN_ERR_FLAG | 0x100)]


def test_a_slow_task_is_asked_for_over_uds() -> None:
    (put,) = barrier(Injector([faults.SlowTask(task=4, work=0x1234)]), 1)
    request = codec.message("UDS_Request").can_id
    assert put[1:] == [
        Frame(request, bytes.fromhex("0210830000000000")), Frame(request, bytes.fromhex("0731810201041234")),
    ]  # fmt: skip
    assert INJECT.unpack(put[0].data)["FaultTarget"] == 3


def test_flags_are_those_of_linux() -> None:
    remote = Wire(faults.RemoteFrame(**M)).run(1).arrived[0]
    assert remote == Frame(CGM.can_id | CAN_RTR_FLAG, bytes(8))
    assert Wire(faults.ExtendedId(**M)).run(1).arrived[0].can_id == CGM.can_id | CAN_EFF_FLAG


# ---- what makes no fault


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: faults.Delay(**M), "give either steps or ms"),
        (lambda: faults.Delay(**M, steps=1, ms=2), "give either steps or ms"),
        (lambda: faults.FlipBits(**M), "give either bits or random"),
        (lambda: faults.FlipBits(message="HB_CTRL", bits=[16]), "HB_CTRL has 16 bits"),
        (lambda: faults.SetValue(**M, signal="Glucose", value=1), "no signal of this name; did you mean"),
        (lambda: faults.Reorder(message="SYNC_Done"), "SYNC_Done passes the turn on"),
        (lambda: faults.Delay(message="SYNC_Step", ms=3), "SYNC_Step passes the turn on"),
        (lambda: faults.SetValue(**M, signal="GlucoseConc"), "give either value or add"),
        (lambda: faults.SetValue(**M, signal="GlucoseConc", value=900), "CGM_Reading.GlucoseConc holds 0 to 800 mg/dL"),
        (lambda: faults.SetValue(**M, signal="CgmState", value="Okay"), "did you mean Ok"),
        (lambda: faults.SetValue(**M, signal="CgmSampleStep", value="Ok"), "has no named values; give a number"),
        (lambda: faults.StuckValue(**M, signal="COUNTER"), "CGM_Reading has no signal of this name"),
        (lambda: faults.FrozenCounter(message="HB_CTRL"), "HB_CTRL has no COUNTER"),
        (lambda: faults.WrongLength(**M, length=8), "8 bytes is what CGM_Reading has"),
        (lambda: faults.Misroute(**M, onto="CGM_Reading"), "onto must be another message"),
        (lambda: faults.Masquerade(**M, values={"GlucoseConc": 900}), "holds 0 to 800"),
        (lambda: faults.Babble(message="PUMP_Ack", id=3), "give either message or id"),
        (lambda: faults.ForeignId(id=0x100), "0x100 is CGM_Reading in the DBC"),
        (lambda: faults.ForeignId(data="0g"), "up to 8 bytes in hexadecimal"),
        (lambda: faults.ForeignId(data="00" * 9), "up to 8 bytes in hexadecimal"),
        (lambda: faults.Drop(**M, when="GlucoseConc < 3"), 'a condition is "Message.Signal"'),
        (lambda: faults.Drop(**M, when="CGM_Readng.GlucoseConc < 3"), "did you mean CGM_Reading"),
        (lambda: faults.Drop(**M, when="CGM_Reading.GlucoseConc < 900"), "holds 0 to 800"),
        (lambda: faults.Drop(**M, when=3), "a condition is text"),
        (lambda: faults.Drop(**M, end="00:00"), "end must be later than start"),
        (lambda: faults.Restart(start="00:05", end="00:10", after_frames=1), "give either after_frames or end"),
        (lambda: faults.ClockJump(message="CGM_Reading"), "Input should be 'SYNC_Step'"),
    ],
)  # fmt: skip
def test_bad_values_are_told(make, expected: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValidationError) as error:
        make()
    assert expected in str(error.value)
