"""DIA-02: doses, states, limits, alarms, resets of the last 24 h, held against the bus, after a loss of power too."""

import copy
from collections import defaultdict
from pathlib import Path

import pytest
from bench import S2, Bench
from hypothesis import given
from hypothesis import strategies as st
from pair import Pair, Values
from test_uds import CONFIG, Line
from udsoncan.client import Client
from udsoncan.exceptions import NegativeResponseException

from can_bus.codec import Transmitter
from can_bus.lockstep import Turn
from firmware_sim.__main__ import main
from firmware_sim.alarms import Code
from firmware_sim.console import Console, FirmwareView
from firmware_sim.firmware import NVM_BYTES, NVM_WORDS, Cause, Firmware
from firmware_sim.history import AREA, PACKED, SIZE, STEPS, WIDTHS, History, Record, pack, unpack
from firmware_sim.ladder import State
from firmware_sim.nvm import NvmError, PowerLost, RamMemory, memory_size
from firmware_sim.pump import Op, Pump
from firmware_sim.uds import DIDS_AT_MOST, HISTORY_DID

MEALS = [(20, 60.0), (100, 80.0), (200, 50.0), (260, 70.0)]
DAY = 300
"""More than the ring holds."""


def record(step: int, **values: int) -> Record:
    return Record(*[step, *[0] * (len(Record._fields) - 1)])._replace(**values)


# ---- the ring


@given(st.tuples(*[st.integers(-(1 << 8 * width - 1), (1 << 8 * width - 1) - 1) for width in WIDTHS]))
def test_a_record_comes_back_from_its_bytes(values: tuple[int, ...]) -> None:
    packed = pack(Record(*values))
    assert len(packed) == PACKED == 36
    assert unpack(packed) == Record(*values)


def test_what_does_not_fit_stands_at_its_limit() -> None:
    record_ = unpack(pack(record(7, bolus=40000, state=-200, delivered=1 << 40)))
    assert (record_.bolus, record_.state, record_.delivered) == (32767, -128, (1 << 31) - 1)
    assert record_.step == 7


def test_the_ring_holds_a_day_and_not_more() -> None:
    memory = RamMemory(AREA + 5)
    history = History(memory, 5)
    assert list(history.records()) == []
    for step in range(700):
        history.write(record(step, rate=step))
    expected = [record(step, rate=step) for step in range(412, 700)]
    assert list(history.records()) == expected
    assert list(History(memory, 5).records()) == expected
    assert memory.read(0, 5) == b"\xff" * 5
    assert history.at(699 % STEPS) == expected[-1]


def test_what_is_older_than_a_day_is_not_shown_after_a_gap() -> None:
    history = History(None, 0)
    for step in (*range(100), 350):
        history.write(record(step))
    assert [each.step for each in history.records()] == [*range(63, 100), 350]
    assert history.at(62) == record(350)  # the place of step 62 as well
    assert history.at(61) is None and history.at(63) == record(63)


def test_the_same_record_is_written_once_and_a_later_one_of_the_step_replaces_it() -> None:
    memory = RamMemory(AREA)
    history = History(memory, 0)
    for bolus in (0, 0, 500, 500):
        history.write(record(3, bolus=bolus))
    assert memory.writes == 2
    assert list(History(memory, 0).records()) == [record(3, bolus=500)]


@pytest.mark.parametrize("garbage", [False, True])
def test_a_torn_write_loses_the_record_that_is_written_and_no_other(garbage: bool) -> None:
    whole = RamMemory(AREA, torn_garbage=garbage)
    history = History(whole, 0)
    for step in range(STEPS):
        history.write(record(step, rate=step))
    for cut in range(SIZE):
        memory = copy.deepcopy(whole)
        torn = History(memory, 0)
        memory.power_fails_after(cut)
        with pytest.raises(PowerLost):
            torn.write(record(STEPS + 40, rate=7))
        found = list(History(memory, 0).records())
        others = [record(step, rate=step) for step in range(STEPS) if step != 40]
        assert [each for each in found if each.step != 40] == others, cut
        assert len(found) <= STEPS - (cut > 3), cut  # the first bytes of both are the same


@pytest.mark.parametrize("place", range(0, 8 * SIZE, 7))
def test_a_flipped_bit_costs_one_record(place: int) -> None:
    memory = RamMemory(AREA)
    history = History(memory, 0)
    for step in range(5):
        history.write(record(step))
    memory.flip(8 * 2 * SIZE + place)
    assert [each.step for each in History(memory, 0).records()] == [0, 1, 3, 4]


def test_a_record_of_another_layout_or_place_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = RamMemory(AREA)
    History(memory, 0).write(record(3))
    memory.write(9 * SIZE, memory.read(3 * SIZE, SIZE))
    assert [each.step for each in History(memory, 0).records()] == [3]
    monkeypatch.setattr("firmware_sim.history.LAYOUT", 2)
    assert list(History(memory, 0).records()) == []


# ---- a day against the bus


def of_the_bus(pair: Pair) -> dict[int, dict[str, int]]:
    """What the frames say of each step, by the fields of a record."""
    said: dict[int, dict[str, int]] = defaultdict(
        lambda: {"op": 0, "rate": 0, "pram_rate": 0, "bolus": 0, "pram_bolus": 0}
    )
    step, seen, glucose, totals = -1, set[int](), -1, (-1, -1)
    alarms: dict[int, int] = {}  # CtrlAlarmCode -> newest state
    for _, name, values in pair.heard:
        if name == "CGM_Reading":
            glucose = values["GlucoseConc"]
        elif name == "PUMP_Delivered":
            newest = values["InsulinTotal"], values["PramTotal"]
            of_step = (-1, 0) if totals[0] < 0 else (newest[0] - totals[0], newest[1] - totals[1])
            totals = newest
        elif name == "SYNC_Step" and values["SyncPhase"] == 1:
            step = values["StepIndex"]
            said[step] |= {"step": step, "glucose": glucose}
            said[step]["delivered"], said[step]["pram_delivered"] = of_step
        elif name == "PUMP_BasalCmd":
            rates = values["InsulinRate"], values["PramlintideRate"]
            said[step]["op"] = values["BasalOp"]
            said[step]["rate"], said[step]["pram_rate"] = rates if values["BasalOp"] == Op.SET_RATE else (0, 0)
        elif name == "PUMP_BolusCmd" and values["BolusOp"] == 2 and values["BolusId"] not in seen:
            seen.add(values["BolusId"])
            insulin = values["BolusHormone"] == 1
            said[step]["bolus" if insulin else "pram_bolus"] = values["InsulinBolus" if insulin else "PramlintideBolus"]
        elif name == "CTRL_Alarm":
            alarms[values["CtrlAlarmCode"]] = values["CtrlAlarmState"]
        elif name == "CTRL_Status":
            said[step] |= {"state": values["CtrlState"], "mode": values["CtrlMode"]}
            said[step] |= {"iob": values["InsulinOnBoard"], "limiters": values["LimiterBits"]}
            said[step]["alarms"] = sum(1 << code for code, state in alarms.items() if state)
        elif name == "HB_CTRL":
            said[step] |= {"boots": values["BootCtrl"], "cause": values["ResetCauseCtrl"]}
    return {step: {name: fields[name] for name in Record._fields} for step, fields in said.items() if "state" in fields}


def of_the_history(firmware: Firmware) -> dict[int, dict[str, int]]:
    return {each.step: each._asdict() for each in firmware.history()}


@pytest.mark.parametrize("mode", ["s1", "s3"])
def test_a_whole_day_is_what_was_on_the_bus_and_power_takes_none_of_it(mode: str) -> None:
    pair = Pair(mode, MEALS, DAY)
    silent = range(150, 156)
    pair.to_device = lambda name, _values, _frame: (
        [] if name in ("CGM_Reading", "PUMP_Status") and pair.plant.step in silent else None
    )
    pair.play()
    expected = {step: fields for step, fields in of_the_bus(pair).items() if step >= DAY - STEPS}
    for step in (*silent, 156, 157):  # what was lost on the way the device does not know
        expected[step]["glucose"] = pair.firmware._history.at(step).glucose  # type: ignore[union-attr]
    found = of_the_history(pair.firmware)
    assert len(found) == STEPS
    for step, fields in expected.items():
        assert found[step] == fields, step
    assert sum(fields["bolus"] > 0 for fields in found.values()) >= (3 if mode == "s3" else 0)
    assert sum(fields["pram_bolus"] > 0 for fields in found.values()) >= 3
    assert {State.AUTO, State.DEGRADED, State.DELIVERY_UNCERTAIN} <= {State(each["state"]) for each in found.values()}
    assert any(fields["alarms"] >> Code.CGM_LOST & 1 for fields in found.values())
    assert any(fields["limiters"] for fields in found.values())
    assert of_the_history(Firmware(pair.memory)) == found


@pytest.mark.parametrize(
    ("left", "lost"),
    [(700, set()), (SIZE + 2, set()), (SIZE, {250}), (SIZE - 1, {250}), (20, {250}), (1, {250}), (0, set())],
)
def test_a_cut_in_the_middle_of_the_day_costs_the_record_being_written_at_most(left: int, lost: set[int]) -> None:
    """So many bytes before the end of what a step writes: its state, the CRC of that, the record of the history."""
    pair = Pair("s3", MEALS, DAY)
    written: dict[int, int] = {}  # bytes before a step

    def cut_once(name: str, values: Values, _frame: object) -> None:
        if name == "SYNC_Step" and pair.boots == 0:
            step = values["StepIndex"]
            written[step] = pair.memory.bytes_written
            if step == 250:
                pair.memory.power_fails_after(written[250] - written[249] - left)

    pair.to_device = cut_once
    pair.play()
    assert pair.boots == 1
    on_the_bus, found = of_the_bus(pair), of_the_history(pair.firmware)
    assert set(range(DAY - STEPS, DAY)) - set(found) == lost
    for step in set(found) - set(range(250, 253)):
        assert found[step] == on_the_bus[step], step
    for step in set(found) & set(range(250, 253)):  # what was on its way is lost, and settled when totals come again
        unknown = {"glucose": -1, "delivered": 0}
        if step > 250 or left > SIZE:
            assert found[step] | unknown == on_the_bus[step] | unknown, step
    assert [found[step]["boots"] for step in (249, 253, 299)] == [0, 1, 1]
    assert found[253]["cause"] == Cause.BROWN_OUT and found[253]["alarms"] >> Code.NODE_RESET & 1
    if not lost:
        totals = [
            sum(fields["delivered"] for step, fields in of.items() if 12 <= step < 290) for of in (found, on_the_bus)
        ]
        assert totals[0] == pytest.approx(totals[1], abs=20)


def test_a_commit_that_went_out_before_the_cut_is_in_the_history() -> None:
    """A step with a bolus has several turns; the record is there after each of them."""
    pair = Pair("s3", [(20, 60.0)], 40)

    def cut_at_the_answer(name: str, values: Values, _frame: object) -> None:
        if name == "PUMP_Ack" and values["AckFor"] == 3 and pair.boots == 0:
            pair.cut_at_frame = pair.frames_in

    pair.to_device = cut_at_the_answer
    pair.play()
    assert pair.boots == 1
    step = next(each.step for each in pair.firmware.history() if each.boots) - 1
    record_ = pair.firmware._history.at(step)
    assert record_ is not None and (record_.bolus, record_.boots) == (next(iter(pair.commits(1).values())), 0)


def test_the_rate_is_what_was_sent_not_what_was_asked_for() -> None:
    pump, turn = Pump(), Turn(Transmitter())
    pump.rate_limit = 100
    assert pump.command(turn, Op.SET_RATE, 3, 200, 50)
    assert (pump.set_point, pump.set_point_step) == ((Op.SET_RATE, 100, 25), 3)
    pump.command(turn, Op.SUSPEND, 4)
    assert (pump.set_point, pump.set_point_step) == ((Op.SUSPEND, 0, 0), 4)


def test_a_run_begins_without_the_history_of_the_one_before() -> None:
    memory = RamMemory(NVM_BYTES)
    Bench(mode=S2, firmware=Firmware(memory)).run(30)
    assert len(Firmware(memory).history()) == 30
    Bench(mode=S2, firmware=Firmware(memory)).run(3)
    assert [each.step for each in Firmware(memory).history()] == [0, 1, 2]


def test_without_a_memory_it_lasts_as_long_as_the_device() -> None:
    bench = Bench(mode=S2)
    bench.run(3)
    assert [each.step for each in bench.firmware.history()] == [0, 1, 2]  # type: ignore[attr-defined]


# ---- the memory of before


def test_a_memory_without_room_for_it_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(NvmError, match=f"{memory_size(NVM_WORDS)} bytes, but the firmware needs {NVM_BYTES} bytes"):
        Firmware(RamMemory(memory_size(NVM_WORDS)))
    path = tmp_path / "nvm"
    path.write_bytes(bytes(memory_size(NVM_WORDS)))
    with pytest.raises(SystemExit) as end:
        main(["--bus", "unix:/nowhere", "--nvm", str(path)])
    assert end.value.code == 2
    assert f"a memory of {NVM_BYTES} bytes was expected" in capsys.readouterr().err


# ---- reading it


@pytest.fixture(scope="module")
def device() -> Firmware:
    return Pair("s3", MEALS, DAY).play().firmware


def test_a_tester_reads_the_whole_day(device: Firmware) -> None:
    tool = Client(Line(device), config=CONFIG)
    assert int.from_bytes(tool.read_data_by_identifier_first(0x0120), "big") == STEPS
    found: list[Record] = []
    for first in range(0, STEPS, DIDS_AT_MOST):
        asked = [HISTORY_DID + place for place in range(first, first + DIDS_AT_MOST)]
        tool.conn.send(b"\x22" + b"".join(did.to_bytes(2, "big") for did in asked))
        answer = tool.conn.wait_frame(exception=True)
        assert len(answer) == 1 + DIDS_AT_MOST * (2 + PACKED)
        for place, did in enumerate(asked):
            start = 1 + place * (2 + PACKED)
            assert int.from_bytes(answer[start : start + 2], "big") == did
            found.append(unpack(answer[start + 2 : start + 2 + PACKED]))
            assert found[-1].step % STEPS == did - HISTORY_DID
    assert sorted(found) == list(device.history())


def test_a_place_without_a_record_is_left_out() -> None:
    bench = Bench(mode=S2)
    bench.run(3)
    assert isinstance(bench.firmware, Firmware)
    tool = Client(Line(bench.firmware), config=CONFIG)
    for did in (HISTORY_DID + 3, HISTORY_DID - 1, HISTORY_DID + STEPS):
        with pytest.raises(NegativeResponseException) as refused:
            tool.read_data_by_identifier_first(did)
        assert refused.value.response.code == 0x31
    assert unpack(tool.read_data_by_identifier_first(HISTORY_DID + 2)).step == 2
    assert tool.read_data_by_identifier_first(0x0120) == b"\x00\x03"


def say(console: Console, line: str) -> list[str]:
    return console.feed(f"{line}\r".encode()).decode().splitlines()


def test_the_console_lists_it(device: Firmware) -> None:
    console = Console(FirmwareView(device))
    console.feed(b"echo off\r")
    lines = say(console, "history 288")
    assert lines[-1] == "OK" and len(lines) == STEPS + 1
    rows = [dict(pair.split("=") for pair in line.split(" ")) for line in lines[:-1]]
    for row, each in zip(rows, device.history(), strict=True):
        assert list(row) == list(Record._fields)
        assert row["state"] == State(each.state).name.lower()
        names = {code.name.lower() for code in Code if each.alarms >> code & 1} or {"none"}
        assert set(row["alarms"].split(",")) == names
        for name in set(Record._fields) - {"state", "alarms"}:
            assert int(row[name]) == getattr(each, name)
    assert say(console, "history") == lines[-13:]
    assert say(console, "history 3") == lines[-4:]
    for wrong in ("0", "289", "-1", "x", "3 4"):
        assert say(console, f"history {wrong}") == ["ERR 2 usage: history [N], N from 1 to 288"]
    console = Console(Firmware())
    console.feed(b"echo off\r")
    assert say(console, "history") == ["OK"]
