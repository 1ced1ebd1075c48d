"""The independent watch: silent over clean runs, and counting every hazard that is written into the frames."""

from collections import deque
from collections.abc import Callable
from functools import cache

import pytest
from bench import S2, Bench, calibration
from pumpbench.calibration import MODES
from pumpbench.hazards import Monitor
from pumpbench.hazards.monitor import CGM_LOST

import firmware_sim.ladder
from can_bus import codec
from can_bus.frame import Frame
from can_bus.lockstep import Done, Phase
from firmware_sim.firmware import Firmware
from firmware_sim.ladder import State
from plant_server.physiology import load_patient
from plant_server.scenario import load_scenario
from plant_server.server import PlantServer, Run

Tamper = Callable[[str, dict[str, int], int], bool]
"""Message name, its values, step -> whether the frame gets lost on its way to the device."""

COUNTED = ("H1", "H2", "H3", "H4", "H5", "H6", "H7", "H8")


def keep(_name: str, _values: dict[str, int], _step: int) -> bool:
    return False


def closed_loop(steps: int, lose: Tamper = keep, strategy: str = "s2") -> list[Frame]:
    """The device's bus over a run of plant and firmware."""
    patient = load_patient("adult#001")
    flash = calibration("adult#001")
    plant = PlantServer(Run(patient, load_scenario("validation-14d"), steps, 5, MODES[strategy], flash))
    firmware, log = Firmware(), []
    to_device = deque(plant.call_roll())
    while not plant.finished:
        answers = []
        for frame in to_device:
            message = codec.messages_by_id()[frame.can_id]
            if not lose(message.name, message.unpack(frame.data), plant.step):
                log.append(frame)
                answers += firmware.receive(frame)
        to_device.clear()
        for frame in answers:
            log.append(frame)
            to_device += plant.receive(frame)
    return log


@cache
def clean() -> tuple[Frame, ...]:
    return tuple(closed_loop(150))


def watched(frames: list[Frame] | tuple[Frame, ...]) -> dict[str, int]:
    monitor = Monitor()
    monitor.watch(frames)
    assert tuple(monitor.hazards) == COUNTED
    return monitor.hazards


def none_but(**expected: int) -> dict[str, int]:
    return dict.fromkeys(COUNTED, 0) | expected


def changed(frame: Frame, **values: int) -> Frame:
    """The same frame with other values, its counter kept and its CRC repaired."""
    message = codec.messages_by_id()[frame.can_id]
    word = int.from_bytes(frame.data, "little")
    for name, value in values.items():
        field = message.fields[name]
        word = word & ~(field.mask << field.shift) | (value & field.mask) << field.shift
    if not message.data_ids:
        return frame._replace(data=word.to_bytes(message.length, "little"))
    return frame._replace(data=codec.protect(message, word & ~0xFFF, frame.data[1] & 0xF))


def doctored(name: str, nth: int, where: Callable[[dict[str, int]], bool] = bool, **values: int) -> list[Frame]:
    """The clean run with one frame changed: the nth of this message, of those that fit."""
    frames = list(clean())
    message = codec.message(name)
    places = [i for i, f in enumerate(frames) if f.can_id == message.can_id and where(message.unpack(f.data))]
    frames[places[nth]] = changed(frames[places[nth]], **values)
    return frames


# ---- nothing where nothing is


@pytest.mark.parametrize("strategy", ["nma", "s2"])
def test_a_clean_run_has_no_hazard(strategy: str) -> None:
    assert watched(closed_loop(288, strategy=strategy)) == none_but()


@pytest.mark.parametrize(
    "name", ["CGM_Reading", "PUMP_Status", "PUMP_Delivered", "HB_CGM", "HB_PUMP", "PUMP_Ack", "UI_AlarmAck"]
)
@pytest.mark.parametrize("length", [1, 3, 4, 8, 16, 17, 40])
def test_lost_frames_of_any_message_are_no_hazard_to_this_firmware(name: str, length: int) -> None:
    assert watched(closed_loop(110, lambda n, _values, step: n == name and 40 <= step < 40 + length)) == none_but()


def test_sensor_and_pump_lost_together_are_no_hazard_either() -> None:
    def lose(name: str, _values: dict[str, int], step: int) -> bool:
        return name in ("CGM_Reading", "PUMP_Status", "PUMP_Delivered") and 40 <= step < 70

    assert watched(closed_loop(110, lose)) == none_but()


def test_a_user_who_suspends_is_no_hazard() -> None:
    bench = Bench(mode=S2)
    bench.run(10, 2000)
    bench.send("MODE_Cmd", ModeRequest=S2, ModeCmdSeq=1, SuspendRequest=1)
    for _ in range(12):
        assert bench.step(drop=True).state == State.SUSPENDED
    assert watched(bench.log) == none_but()


def test_a_late_sample_behind_a_newer_one_does_not_age_it() -> None:
    """The device has the newer one, and may dose on it for 15 min."""
    bench = Bench(mode=S2)
    bench.run(24, 2500)
    late = {"CgmSampleSeq": bench.k % 65535, "CgmSampleStep": bench.k % 256}
    bench.step(cgm=[])
    bench.step(cgm=[bench.sample(2500), bench.sample(2500, **late)])
    for _ in range(3):
        turn = bench.step(cgm=[])
        assert turn.state == State.AUTO
        assert turn.rate > bench.basal // 5
    assert watched(bench.log) == none_but()


def test_fields_the_monitor_cannot_read_do_not_stop_it() -> None:
    for phase in range(16):
        assert watched(doctored("SYNC_Step", 50, SyncPhase=phase))["H2"] == 0


# ---- one hazard, one count


def test_h2_a_rate_above_the_limit() -> None:
    assert watched(doctored("PUMP_BasalCmd", 50, InsulinRate=6001)) == none_but(H2=1)
    assert watched(doctored("PUMP_BasalCmd", 50, InsulinRate=6000)) == none_but()


@pytest.mark.parametrize("raw", [8001, 8190, 8191])
def test_h2_a_reserved_code(raw: int) -> None:
    assert watched(doctored("PUMP_BasalCmd", 50, InsulinRate=raw)) == none_but(H2=1)
    assert watched(doctored("PUMP_BasalCmd", 50, PramlintideRate=raw)) == none_but(H2=1)


def test_h3_a_sample_that_never_came() -> None:
    assert watched(doctored("CTRL_Status", 50, LastCgmSeq=999)) == none_but(H3=1)
    assert watched(doctored("CTRL_Status", 50, LastCgmSeq=51)) == none_but(H3=1)  # the one of the next step


@pytest.mark.parametrize(
    "values", [{"CgmState": 6}, {"CgmState": 0}, {"GlucoseConc": 199}, {"GlucoseConc": 8191}, {"CgmSampleStep": 51}]
)
def test_h3_a_sample_that_must_not_be_used(values: dict[str, int]) -> None:
    """Step 50 says it used its sample; what came could not be used."""
    assert watched(doctored("CGM_Reading", 50, **values)) == none_but(H3=1)


def test_h3_a_sample_whose_crc_was_wrong() -> None:
    sample = codec.message("CGM_Reading")
    frames = list(clean())
    place = [i for i, frame in enumerate(frames) if frame.can_id == sample.can_id][50]
    data = frames[place].data
    frames[place] = frames[place]._replace(data=data[:7] + bytes([data[7] ^ 1]))
    assert watched(frames)["H3"] == 1


def test_h4_pramlintide_without_insulin() -> None:
    assert watched(doctored("PUMP_BasalCmd", 50, InsulinRate=0, PramlintideRate=1)) == none_but(H4=1)
    assert watched(doctored("PUMP_BasalCmd", 50, InsulinRate=0, PramlintideRate=0)) == none_but()


def stale(lost: int) -> tuple[list[Frame], list[int]]:
    """A run whose sensor is gone from step 40 on, and where its commands of steps 40 and later are."""
    frames = closed_loop(60, lambda name, _values, step: name == "CGM_Reading" and 40 <= step < 40 + lost)
    places = [i for i, frame in enumerate(frames) if frame.can_id == codec.message("PUMP_BasalCmd").can_id]
    return frames, places[40:]


@pytest.mark.parametrize("age", range(1, 12))
def test_h4_above_the_schedule_on_a_stale_sample(age: int) -> None:
    frames, places = stale(19)
    basal = calibration()[0]
    for rate, above in ((basal // 5, False), (basal // 5 + 1, True)):
        frames[places[age - 1]] = changed(
            frames[places[age - 1]], BasalOp=1, InsulinRate=rate, PramlintideRate=0, BasalUntilStep=0
        )
        expected = 0 if not above or age <= 3 else 1 if age < 7 else 2  # above, and not the schedule
        assert watched(frames)["H4"] == expected


@pytest.mark.parametrize(
    ("values", "age", "count"),
    [
        ({"BasalOp": 1, "InsulinRate": 0, "PramlintideRate": 0}, 7, 1),
        ({"BasalOp": 1, "InsulinRate": 0, "PramlintideRate": 0}, 6, 0),
        ({"BasalOp": 1, "InsulinRate": 284, "PramlintideRate": 0}, 9, 1),
        ({"BasalOp": 1, "InsulinRate": 285, "PramlintideRate": 5}, 9, 1),
        ({"BasalOp": 1, "InsulinRate": 285, "PramlintideRate": 0}, 9, 0),
        ({"BasalOp": 2}, 9, 1),
        ({"BasalOp": 2}, 6, 0),
        ({"BasalOp": 3}, 9, 0),
    ],
)
def test_h4_anything_but_the_schedule_after_half_an_hour(values: dict[str, int], age: int, count: int) -> None:
    assert calibration()[0] // 5 == 285
    frames, places = stale(19)
    frames[places[age - 1]] = changed(frames[places[age - 1]], **values)
    assert watched(frames)["H4"] == count


def test_h4_dosing_before_any_sample() -> None:
    frames = closed_loop(10, lambda name, _values, _step: name == "CGM_Reading")
    assert watched(frames) == none_but()
    place = next(i for i, frame in enumerate(frames) if frame.can_id == codec.message("PUMP_BasalCmd").can_id)
    frames[place] = changed(frames[place], BasalOp=1, InsulinRate=400, PramlintideRate=0)
    assert watched(frames)["H4"] == 2  # above the schedule, and not the schedule


@pytest.mark.parametrize(
    ("page", "values"),
    [
        (4, {"TruthInsulinCommanded": 60000}),
        (4, {"TruthInsulinPending": 9000}),
        (4, {"TruthInsulinLost": 9000}),
        (5, {"TruthPramCommanded": 60000}),
        (5, {"TruthPramPending": 9000}),
        (5, {"TruthPramLost": 9000}),
    ],
)
def test_h6_a_stroke_that_is_not_accounted_for(page: int, values: dict[str, int]) -> None:
    frames = doctored("PLANT_Truth", 60, where=lambda truth: truth["TruthSel"] == page, **values)
    assert watched(frames) == none_but(H6=1)


def test_h6_totals_that_are_no_whole_strokes() -> None:
    delivered = codec.message("PUMP_Delivered")
    total = [delivered.unpack(f.data)["InsulinTotal"] for f in clean() if f.can_id == delivered.can_id][60]
    assert watched(doctored("PUMP_Delivered", 60, InsulinTotal=total + 1)) == none_but(H6=1)
    assert watched(doctored("PUMP_Delivered", 60, InsulinTotal=total + 50)) == none_but(H6=1)


def test_h6_is_not_judged_without_the_totals_of_the_step() -> None:
    can_id = codec.message("PUMP_Delivered").can_id
    frames = list(clean())
    places = [i for i, frame in enumerate(frames) if frame.can_id == can_id]
    del frames[places[60]]
    assert watched(frames) == none_but()


def test_h7_a_lost_sensor_without_an_alarm() -> None:
    alarm = codec.message("CTRL_Alarm").can_id
    frames, _ = stale(10)
    assert watched(frames) == none_but()
    silent = [frame for frame in frames if frame.can_id != alarm]
    assert watched(silent)["H7"] == 7  # ages 5 to 10, and the first sample again was refused for its counter


def test_h7_an_alarm_that_ends_too_early() -> None:
    alarm = codec.message("CTRL_Alarm")
    frames, _ = stale(10)
    alarms = [i for i, frame in enumerate(frames) if frame.can_id == alarm.can_id]
    first = next(i for i in alarms if alarm.unpack(frames[i].data)["CtrlAlarmCode"] == CGM_LOST)
    rest = [frame for frame in frames[first + 1 :] if frame.can_id != alarm.can_id]
    assert watched(frames[: first + 1] + rest) == none_but()  # it was raised, and never ended
    ended = [*frames[:first], changed(frames[first], CtrlAlarmState=0), *rest]
    assert watched(ended)["H7"] == 7


# ---- boluses

PROGRAM, COMMIT, CANCEL = 1, 2, 3
IDLE, PROGRAMMED, DELIVERING, DONE, ABORTED = range(5)
MAX_BOLUS, MAX_PRAM = 1500, 300


class Bolusing:
    """The frames about boluses of a run, written by hand."""

    def __init__(self) -> None:
        self.monitor = Monitor()
        self.transmitter = codec.Transmitter()
        self.device = codec.Transmitter()
        self.step = 0
        self.watch(self.transmitter, "CFG_Param", CfgIndex=4, CfgMaxBolus=MAX_BOLUS)
        self.watch(self.transmitter, "CFG_Param", CfgIndex=7, CfgPramBolus=MAX_PRAM)
        self.token()

    def watch(self, transmitter: codec.Transmitter, name: str, **values: int) -> None:
        self.monitor.watch([transmitter.frame(name, **values)])

    def token(self, phase: Phase = Phase.STEP) -> None:
        self.watch(self.transmitter, "SYNC_Step", SyncPhase=phase, StepIndex=self.step, SimTime=self.step * 300)

    def cmd(self, op: int, number: int, dose: int = 200, *, until: int | None = None, drug: int = 1) -> None:
        values = {"BolusHormone": drug, "BolusOp": op, "BolusId": number}
        values["BolusUntilStep"] = (self.step + 1 if until is None else until) % 256
        self.watch(
            self.device, "PUMP_BolusCmd", **values, **{"InsulinBolus" if drug == 1 else "PramlintideBolus": dose}
        )

    def ack(self, purpose: int, number: int, result: int = 0) -> None:
        values = {"AckFor": purpose, "AckResult": result, "AckId": number, "AckEchoRaw": 200, "AckLimitRaw": 3000}
        self.watch(self.device, "SYNC_Done", DoneStatus=Done.CONTINUE, DoneStepIndex=self.step, TxCount=1)
        self.watch(self.transmitter, "PUMP_Ack", **values)
        self.token(Phase.CONTINUE)

    def give(self, number: int, dose: int = 200) -> None:
        self.cmd(PROGRAM, number, dose)
        self.ack(2, number)
        self.cmd(COMMIT, number, dose)
        self.ack(3, number)

    def next(self, *states: tuple[int, int, int], state: int = 1, programmed: int = 200) -> None:
        """The device is done; the next instant opens with these phases, ids and delivered doses of insulin."""
        self.watch(self.device, "CTRL_Status", CtrlMode=3, CtrlState=state, InsulinOnBoard=0, LimiterBits=0)
        self.watch(self.device, "SYNC_Done", DoneStatus=Done.OK, DoneStepIndex=self.step, TxCount=1)
        self.step += 1
        for phase, number, delivered in states:
            values = {"BolusPhase": phase, "BolusStateId": number, "BolusDeliveredRaw": delivered}
            self.watch(
                self.transmitter, "PUMP_BolusState", BolusStateHormone=1, BolusProgrammedRaw=programmed, **values
            )
        self.token()

    @property
    def found(self) -> dict[str, int]:
        return {name: count for name, count in self.monitor.hazards.items() if count}


def test_boluses_in_good_order_are_no_hazard() -> None:
    bus = Bolusing()
    bus.next((IDLE, 65535, 0), programmed=0)
    bus.give(1)
    bus.next((DELIVERING, 1, 150))
    bus.cmd(COMMIT, 1)  # a retry
    bus.ack(3, 1, 1)
    bus.next((DONE, 1, 200))
    bus.give(2)
    bus.next((ABORTED, 2, 50))
    bus.next((ABORTED, 2, 120))  # what an occlusion had held back
    bus.give(3)
    bus.next((DONE, 3, 200))
    assert bus.found == {}


def test_ids_and_expiry_wrap_without_a_hazard() -> None:
    bus = Bolusing()
    bus.step = 254
    bus.next((DONE, 65533, 200))
    for number in (65534, 0, 1):
        bus.give(number)
        bus.next((DONE, number, 200))
    assert bus.found == {}


def test_h1_more_than_was_programmed() -> None:
    bus = Bolusing()
    bus.give(1)
    bus.next((DONE, 1, 205))
    assert bus.found == {"H1": 1}


@pytest.mark.parametrize("after", [(DELIVERING, 1, 200), (DONE, 1, 50), (PROGRAMMED, 1, 200)])
def test_h1_an_id_that_begins_once_more(after: tuple[int, int, int]) -> None:
    bus = Bolusing()
    bus.give(1)
    bus.next((DONE, 1, 200))
    bus.next(after)
    assert bus.found == {"H1": 1}


def test_h1_an_id_that_comes_back_after_another_one() -> None:
    bus = Bolusing()
    bus.give(1)
    bus.next((DONE, 1, 200))
    bus.give(2)
    bus.next((DONE, 2, 200))
    bus.next((DONE, 1, 200))
    assert bus.found == {"H1": 1}
    bus.next((DONE, 1, 200))
    assert bus.found == {"H1": 1}


def test_h1_a_commit_that_is_accepted_twice() -> None:
    bus = Bolusing()
    bus.give(1)
    bus.ack(3, 1)
    assert bus.found == {"H1": 1}
    bus.ack(5, 1)  # the other drug's ids are its own
    assert bus.found == {"H1": 1}


@pytest.mark.parametrize(("steps", "count"), [(1, 0), (2, 1), (3, 1)])
def test_h1_a_commit_accepted_after_its_expiry(steps: int, count: int) -> None:
    bus = Bolusing()
    bus.cmd(PROGRAM, 1)  # valid until step 1
    for _ in range(steps):
        bus.next()
    bus.cmd(COMMIT, 1, until=1)
    bus.ack(3, 1)
    assert bus.found.get("H1", 0) == count
    bus.next((DELIVERING, 1, 100))
    assert bus.found.get("H1", 0) == count  # seen twice, counted once


def test_h1_an_answer_that_is_late_is_no_late_bolus() -> None:
    bus = Bolusing()
    bus.cmd(PROGRAM, 1)
    bus.cmd(COMMIT, 1)
    bus.next((DELIVERING, 1, 100))
    bus.next((DONE, 1, 200))
    bus.next((DONE, 1, 200))
    bus.ack(3, 1)
    assert bus.found == {}


@pytest.mark.parametrize("meanwhile", [(PROGRAMMED, 2, 0), (DONE, 1, 200)])
def test_h1_a_bolus_that_begins_after_its_expiry_without_an_answer(meanwhile: tuple[int, int, int]) -> None:
    bus = Bolusing()
    bus.give(1)
    bus.next((DONE, 1, 200))
    bus.cmd(PROGRAM, 2)  # valid until step 2
    bus.cmd(COMMIT, 2)
    bus.next(meanwhile)
    bus.next(meanwhile)
    assert bus.found == {}
    bus.next((DONE, 2, 200))
    assert bus.found == {"H1": 1}


@pytest.mark.parametrize(("drug", "limit"), [(1, MAX_BOLUS), (2, MAX_PRAM)])
def test_h2_a_bolus_above_the_limit(drug: int, limit: int) -> None:
    bus = Bolusing()
    bus.cmd(PROGRAM, 1, limit, drug=drug)
    assert bus.found == {}
    for op in (PROGRAM, PROGRAM, COMMIT):
        bus.cmd(op, 2, limit + 1, drug=drug)
    assert bus.found == {"H2": 1}
    bus.ack(3 if drug == 1 else 5, 2, 3)  # OverLimit
    bus.cmd(CANCEL, 3, 4095, drug=drug)
    bus.cmd(PROGRAM, 4, 4095, drug=drug)
    assert bus.found == {"H2": 2}


def test_h5_a_new_bolus_before_the_last_commit_is_answered() -> None:
    for answer in (False, True):
        bus = Bolusing()
        bus.cmd(PROGRAM, 1)
        bus.cmd(COMMIT, 1)
        bus.cmd(PROGRAM, 1)  # a retry is no new one
        if answer:
            bus.ack(3, 1, 4)  # refused: it is known that nothing was given
        bus.cmd(PROGRAM, 2, drug=2)
        assert bus.found == ({} if answer else {"H5": 1})


def test_h5_only_the_answer_to_the_commit_of_that_id_and_drug_settles_it() -> None:
    bus = Bolusing()
    bus.cmd(PROGRAM, 1)
    bus.cmd(COMMIT, 1)
    bus.ack(2, 1)
    bus.ack(5, 1)
    bus.ack(3, 0)
    bus.cmd(PROGRAM, 2)
    assert bus.found == {"H5": 1}


@pytest.mark.parametrize(
    ("states", "count"),
    [([], 1), ([(DELIVERING, 1, 5)], 0), ([(DONE, 1, 200)], 0), ([(ABORTED, 1, 0)], 0), ([(PROGRAMMED, 1, 0)], 1)],
)
def test_h5_the_pumps_state_settles_an_uncertain_bolus(states: list[tuple[int, int, int]], count: int) -> None:
    bus = Bolusing()
    bus.cmd(PROGRAM, 1)
    bus.cmd(COMMIT, 1)
    bus.next(*states, state=6)
    bus.cmd(PROGRAM, 2)
    assert bus.found.get("H5", 0) == count


def test_h5_a_bolus_the_pump_never_heard_of_is_settled_by_its_expiry() -> None:
    bus = Bolusing()
    bus.cmd(PROGRAM, 1)
    bus.cmd(COMMIT, 1)
    bus.next((IDLE, 65535, 0), state=6, programmed=0)  # step 1: it may still come
    assert not bus.monitor._boluses._sent[1].settled
    bus.next((IDLE, 65535, 0), state=6, programmed=0)
    bus.cmd(PROGRAM, 2)
    assert bus.found == {}


def test_h5_a_device_that_says_it_is_uncertain_and_doses() -> None:
    bus = Bolusing()
    bus.give(1)
    bus.next((DONE, 1, 200), state=6)
    bus.next(state=6)  # and hears nothing of the pump since
    bus.cmd(PROGRAM, 2)
    assert bus.found == {"H5": 1}


def test_a_device_that_hears_of_its_boluses_again_may_dose() -> None:
    bus = Bolusing()
    bus.give(1)
    bus.next((DONE, 1, 200), state=6)
    bus.next((DONE, 1, 200), state=6)
    bus.cmd(PROGRAM, 2)
    assert bus.found == {}


def test_unknown_drugs_and_phases_do_not_stop_the_monitor() -> None:
    bus = Bolusing()
    for drug in range(16):
        bus.watch(bus.device, "PUMP_BolusCmd", BolusHormone=drug, BolusOp=9, BolusId=1, BolusUntilStep=0)
        for phase in range(16):
            fields = {"BolusStateHormone": drug, "BolusPhase": phase, "BolusStateId": 65535}
            bus.watch(bus.transmitter, "PUMP_BolusState", **fields, BolusDeliveredRaw=0, BolusProgrammedRaw=0)
    assert bus.found == {}


# ---- resets


def test_a_device_that_starts_anew_is_heard_at_once() -> None:
    for boot in (False, True):
        bus = Bolusing()
        for _ in range(5):
            bus.next()
        bus.device = codec.Transmitter()  # its counters begin at 0
        if boot:
            bus.watch(bus.device, "HB_CTRL", NmtCtrl=0, ToggleCtrl=0, ResetCauseCtrl=0, BootCtrl=1)
        bus.next(state=6)
        assert (bus.monitor._state == 6) is boot


def test_h6_totals_that_begin_anew_after_a_reset_of_the_pump() -> None:
    transmitter, monitor = codec.Transmitter(), Monitor()

    def tell(boot: int, total: int, commanded: int) -> dict[str, int]:
        monitor.watch(
            [
                transmitter.frame("PUMP_Delivered", PumpBootCount=boot, InsulinTotal=total * 50, PramTotal=0),
                transmitter.frame("PLANT_Truth", TruthSel=4, TruthStep=0, TruthInsulinCommanded=commanded,
                                  TruthInsulinPending=0, TruthInsulinLost=0),
            ]
        )  # fmt: skip
        return monitor.hazards

    assert tell(0, 100, 100)["H6"] == 0
    assert tell(1, 0, 110)["H6"] == 0
    assert tell(1, 7, 117)["H6"] == 0
    assert tell(1, 8, 119)["H6"] == 1
    assert tell(1, 0, 120)["H6"] == 2  # totals that fall without a reset


# ---- a firmware that is wrong


def test_a_firmware_that_goes_down_too_late_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(firmware_sim.ladder, "AGE_DEGRADED", 6)
    monkeypatch.setattr(firmware_sim.firmware, "AGE_DEGRADED", 6)
    monkeypatch.setattr(firmware_sim.allowance, "stale_age", lambda _: 6)
    bench = Bench(mode=S2)
    bench.run(24, 2500)
    for _ in range(12):
        bench.step(drop=True)
    assert watched(bench.log) == none_but(H4=2, H7=1)


def test_a_firmware_that_takes_old_samples_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(firmware_sim.cgm, "AGE_USABLE", 5)
    bench = Bench(mode=S2)
    bench.run(24, 2500)
    for _ in range(3):
        old = {"CgmSampleStep": (bench.k - 5) % 256}
        bench.step(cgm=[bench.sample(2500, **old)])
    assert watched(bench.log)["H3"] == 3


def test_a_step_in_several_turns_is_judged_once_at_its_end() -> None:
    """The device asks for further turns: its command may come in any of them."""
    frames = []
    plant, device = codec.Transmitter(), codec.Transmitter()
    for frame in clean():
        name = codec.messages_by_id()[frame.can_id].name
        values = codec.message(name).unpack(frame.data)
        if name == "SYNC_Step":
            step = values["StepIndex"]
            frames.append(plant.frame(name, **values))
            if values["SyncPhase"] == Phase.STEP:
                frames.append(device.frame("SYNC_Done", DoneStatus=Done.CONTINUE, DoneStepIndex=step, TxCount=1))
                frames.append(
                    plant.frame(name, SyncPhase=Phase.CONTINUE, StepIndex=step, SimTime=values["SimTime"] + 1)
                )
        else:
            frames.append(device.frame(name, **values) if name == "SYNC_Done" else frame)
    assert watched(frames) == none_but()
    place = [i for i, frame in enumerate(frames) if frame.can_id == codec.message("PUMP_BasalCmd").can_id][50]
    frames[place] = changed(frames[place], InsulinRate=6001)
    assert watched(frames) == none_but(H2=1)


def test_the_safety_part_repeats_the_devices_own_counts() -> None:
    monitor = Monitor()
    monitor.watch(closed_loop(60, lambda name, _values, step: name == "CGM_Reading" and step in (20, 30, 31)))
    safety = monitor.safety({"closes": True})
    assert safety["frames_lost"] == 3
    assert safety["e2e_errors"] == safety["sequence_errors"] == safety["saturations"] == 0
    assert safety["ledger"] == {"closes": True}
    # what this bench cannot yet observe is not known, which is not the same as none
    assert safety["hazards"] == none_but()


# ---- H8: state lost over a reset


class Restarting:
    """A device that says something, starts anew, and says something else."""

    def __init__(self) -> None:
        self.monitor = Monitor()
        self.plant, self.device = codec.Transmitter(), codec.Transmitter()
        self.step = -1

    def says(self, *, mode: int = 3, iob: int = 400, meal: int = 7) -> None:
        self.step += 1
        token = self.plant.frame("SYNC_Step", SyncPhase=Phase.STEP, StepIndex=self.step, SimTime=self.step * 300)
        status = {"CtrlMode": mode, "CtrlState": 1, "InsulinOnBoard": iob, "LimiterBits": 0, "LastMealId": meal}
        self.monitor.watch([token, self.device.frame("CTRL_Status", **status)])

    def bolus(self, dose: int) -> None:
        fields = {"BolusHormone": 1, "BolusOp": 2, "BolusId": 3, "BolusUntilStep": self.step + 1, "InsulinBolus": dose}
        self.monitor.watch([self.device.frame("PUMP_BolusCmd", **fields)])

    def delivered(self, dose: int) -> None:
        fields = {"BolusStateHormone": 1, "BolusPhase": 3, "BolusStateId": 3, "BolusProgrammedRaw": dose}
        self.monitor.watch([self.plant.frame("PUMP_BolusState", BolusDeliveredRaw=dose, **fields)])

    def boots(self) -> None:
        self.device = codec.Transmitter()
        boot = self.device.frame("HB_CTRL", NmtCtrl=0, ToggleCtrl=0, ResetCauseCtrl=1, BootCtrl=1)
        self.monitor.watch([boot])

    @property
    def lost(self) -> int:
        return self.monitor.hazards["H8"]


@pytest.mark.parametrize(
    ("after", "lost"),
    [
        ({}, 0),
        ({"mode": 0}, 1),
        ({"iob": 251}, 0),
        ({"iob": 249}, 1),
        ({"iob": 0}, 1),
        ({"meal": 8}, 0),
        ({"meal": 6}, 1),
        ({"meal": 255}, 1),
    ],
)
def test_h8_what_a_device_forgets_over_a_reset(after: dict[str, int], lost: int) -> None:
    bus = Restarting()
    bus.says()
    bus.boots()
    bus.says(**after)
    bus.says(**after)
    assert bus.lost == lost


@pytest.mark.parametrize(
    ("told", "iob", "lost"),
    [
        (False, 400, 0),  # counted twice as long as the device cannot know: by the total, and as perhaps still to come
        (False, 249, 1),  # less than what the total says is a loss
        (True, 400, 0),
        (True, 249, 1),
        (True, 0, 1),
    ],
)
def test_h8_a_bolus_that_is_not_settled_may_be_counted_twice_but_not_forgotten(told: bool, iob: int, lost: int) -> None:
    bus = Restarting()
    bus.says(iob=0)
    bus.bolus(400)
    bus.says(iob=800)
    bus.boots()
    if told:
        bus.delivered(400)
    bus.says(iob=iob)
    assert bus.lost == lost


def test_h8_what_a_device_heard_just_before_a_reset_it_may_have_to_hear_again() -> None:
    bus = Restarting()
    bus.says(iob=0)
    bus.bolus(400)
    bus.says(iob=400)
    bus.delivered(400)
    bus.boots()
    bus.says(iob=800)
    bus.boots()
    bus.delivered(400)
    bus.says(iob=400)
    assert bus.lost == 0


def test_h8_a_bolus_that_came_to_nothing_is_no_loss() -> None:
    bus = Restarting()
    bus.says(iob=0)
    bus.bolus(400)
    bus.says(iob=400)
    bus.boots()
    bus.says(iob=0)
    assert bus.lost == 0


def test_without_a_reset_nothing_is_lost_and_a_mode_that_was_asked_for_is_none() -> None:
    bus = Restarting()
    bus.says()
    bus.says(mode=2, iob=0, meal=255)
    assert bus.lost == 0
    bus.boots()
    bus.monitor.watch([bus.plant.frame("MODE_Cmd", ModeRequest=4, ModeCmdSeq=1, SuspendRequest=0)])
    bus.says(mode=4, iob=0, meal=255)
    assert bus.lost == 0
