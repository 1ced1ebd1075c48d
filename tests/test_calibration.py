"""The calibration: flashed value by value, checked as a set, in force as a whole or not at all."""

import binascii
import random

import pytest
from bench import NMA, OPEN_LOOP, S2, Bench, calibration
from pumpbench.calibration import CalibrationError, Tuning, calibrate
from pumpbench.controller_model import ControllerModelError

from can_bus import codec
from can_bus.lockstep import Phase
from firmware_sim.alarms import Code
from firmware_sim.calibration import (
    CORE,
    LOWEST,
    NEEDED,
    SET_CRC_INDEX,
    UNSET,
    Calibration,
    parameter_names,
    set_crc,
)
from firmware_sim.control import layout
from firmware_sim.ladder import State
from firmware_sim.pump import Op
from plant_server.physiology import load_patient

NAMES = parameter_names()
INDEX = {name: index for index, name in NAMES.items()}
FIELDS = codec.message("CFG_Param").fields
MUST = sorted({*NEEDED, *(INDEX[name] for name in CORE.values() if name not in UNSET)})


def echoes(bench: Bench, flash: dict[int, int]) -> dict[int, dict[str, int]]:
    """Flash and hear the echoes by index."""
    turn = bench.configure(flash)
    assert turn.names == ["CFG_ParamEcho"] * len(flash) + ["SYNC_Done"]
    heard = turn.all("CFG_ParamEcho")
    assert [echo["EchoIndex"] for echo in heard] == list(flash)
    return {echo["EchoIndex"]: echo for echo in heard}


def flash_raw(bench: Bench, index: int, raw: int) -> dict[str, int]:
    """Flash one value the codec would refuse to pack; its echo."""
    message = codec.message("CFG_Param")
    (field,) = message.pages[index]
    word = message.pack({"CfgIndex": index, field.name: field.low}) & ~(field.mask << field.shift)
    frame = bench.frame("CFG_Param", CfgIndex=index, **{field.name: field.low})  # for its counter
    counter = frame.data[1] & 0xF
    data = codec.protect(message, word | (raw & field.mask) << field.shift, counter)
    bench.give(frame._replace(data=data))
    return bench.token(Phase.CONFIG, 0).one("CFG_ParamEcho")


# ---- the set as a whole


def test_a_complete_set_is_echoed_and_active() -> None:
    bench = Bench(flash={})
    flash = calibration()
    heard = echoes(bench, flash)
    for index, raw in flash.items():
        assert heard[index]["EchoRaw"] == raw & 0x3FFFFFFF, NAMES[index]
    assert heard[SET_CRC_INDEX]["EchoSetCrc"] == flash[SET_CRC_INDEX]
    assert bench.run(3).state == State.AUTO


def test_the_crc_is_ccitt_false_over_index_and_value() -> None:
    assert set_crc({}) == 0xFFFF
    values = {16: -5, 0: 1425}
    data = bytes([0]) + (1425).to_bytes(4, "little") + bytes([16]) + (-5).to_bytes(4, "little", signed=True)
    assert set_crc(values) == binascii.crc_hqx(data, 0xFFFF)
    assert binascii.crc_hqx(b"123456789", 0xFFFF) == 0x29B1  # the check value of CRC-16/CCITT-FALSE


def test_the_order_of_flashing_does_not_matter() -> None:
    flash = calibration()
    crc = flash.pop(SET_CRC_INDEX)
    indices = list(flash)
    random.Random(3).shuffle(indices)
    bench = Bench(flash={index: flash[index] for index in indices} | {SET_CRC_INDEX: crc})
    assert bench.run(3).state == State.AUTO


@pytest.mark.parametrize("missing", MUST, ids=lambda index: NAMES[index])
def test_an_incomplete_set_is_never_active(missing: int) -> None:
    flash = calibration()
    del flash[missing]
    flash[SET_CRC_INDEX] = set_crc({index: raw for index, raw in flash.items() if index != SET_CRC_INDEX})
    bench = Bench(flash={})
    heard = echoes(bench, flash)
    assert heard[SET_CRC_INDEX]["EchoRaw"] != flash[SET_CRC_INDEX]  # the CRC fits, the set is still not in force
    for _ in range(4):
        turn = bench.step()
        assert turn.state == State.INIT
        assert not turn.all("PUMP_BasalCmd")


def test_every_parameter_of_the_core_is_fed() -> None:
    assert set(CORE) == {word.name for word in layout.PARAMETERS}
    assert set(CORE.values()) <= set(INDEX)
    for word in layout.PARAMETERS:
        field = FIELDS[CORE[word.name]]
        low = max(field.low, LOWEST.get(field.name, field.low))
        # what a frame can carry past the checks lies within the range the core is proven for
        assert word.low <= low, word.name
        assert field.high <= word.high, word.name


@pytest.mark.parametrize("change", [1, -1, 0x8000])
def test_a_wrong_crc_activates_nothing(change: int) -> None:
    flash = calibration()
    flash[SET_CRC_INDEX] = (flash[SET_CRC_INDEX] + change) & 0xFFFF
    bench = Bench(flash={})
    heard = echoes(bench, flash)
    assert heard[SET_CRC_INDEX]["EchoRaw"] == 0
    assert not bench.step().all("PUMP_BasalCmd")


def test_before_calibration_there_is_no_command_at_all() -> None:
    bench = Bench(flash={}, mode=NMA)
    for k in range(8):
        turn = bench.step(2500, drop=k > 4)
        assert turn.names == ["CTRL_Status", "CTRL_Diag", "HB_CTRL", "SYNC_Done"]
        assert turn.state == State.INIT
        assert turn.status["InsulinOnBoard"] == turn.status["LimiterBits"] == 0


def test_values_stay_out_of_force_until_the_crc_has_come() -> None:
    bench = Bench(mode=OPEN_LOOP)
    rate = bench.run(3).rate
    new = calibration(CfgBasal=bench.basal + 500)
    echoes(bench, {0: new[0]})
    assert bench.run(2).rate == rate
    echoes(bench, {SET_CRC_INDEX: new[SET_CRC_INDEX]})
    assert bench.step().rate == rate + 100


def test_the_echo_tells_the_crc_of_the_active_set() -> None:
    """Also while a later, incomplete or mistaken set is being flashed."""
    bench = Bench(mode=OPEN_LOOP)
    active = bench.flash[SET_CRC_INDEX]
    new = calibration(CfgBasal=bench.basal + 500)
    heard = echoes(bench, {0: new[0], SET_CRC_INDEX: new[SET_CRC_INDEX] ^ 1})
    assert heard[0]["EchoSetCrc"] == new[SET_CRC_INDEX]
    assert heard[SET_CRC_INDEX]["EchoRaw"] == active
    heard = echoes(bench, {SET_CRC_INDEX: new[SET_CRC_INDEX]})
    assert heard[SET_CRC_INDEX]["EchoRaw"] == new[SET_CRC_INDEX]


def test_a_roll_call_forgets_the_calibration() -> None:
    bench = Bench()
    assert bench.run(3).state == State.AUTO
    bench.call_roll()
    assert not bench.step().all("PUMP_BasalCmd")


# ---- single values


@pytest.mark.parametrize("name", [name for name in INDEX if name != "CfgSetCrc"])
def test_values_out_of_range_are_refused_not_clipped(name: str) -> None:
    """Every code the field can carry next to its limits; the echo shows what stays in force."""
    index, field = INDEX[name], FIELDS[name]
    bench = Bench(flash={})
    low = max(field.low, LOWEST.get(name, field.low))
    good = (low + field.high) // 2
    assert flash_raw(bench, index, good)["EchoRaw"] == good & 0x3FFFFFFF
    smallest = -(field.sign or 0)
    largest = field.mask >> 1 if field.sign else field.mask
    for raw in {low, field.high, low + 1, field.high - 1}:
        assert flash_raw(bench, index, raw)["EchoRaw"] == raw & 0x3FFFFFFF
    assert flash_raw(bench, index, good)["EchoRaw"] == good & 0x3FFFFFFF
    for raw in {low - 1, field.high + 1, smallest, largest, field.high + 2, 0}:
        if smallest <= raw <= largest and not low <= raw <= field.high:
            assert flash_raw(bench, index, raw)["EchoRaw"] == good & 0x3FFFFFFF, raw


@pytest.mark.parametrize(
    ("name", "raw"), [("CfgBasal", 0), ("CfgGlucoseTarget", 599), ("CfgMealGain", 0), ("CfgInsulinGain", 9999)]
)
def test_implausible_values_are_refused(name: str, raw: int) -> None:
    bench = Bench(flash={})
    assert flash_raw(bench, INDEX[name], raw)["EchoRaw"] == 0
    flash = calibration(**{name: raw})
    heard = echoes(bench, flash)
    assert heard[SET_CRC_INDEX]["EchoSetCrc"] != flash[SET_CRC_INDEX]
    assert not bench.step().all("PUMP_BasalCmd")


def test_an_index_without_a_parameter_is_answered_and_changes_nothing() -> None:
    bench = Bench(flash=calibration(), mode=OPEN_LOOP)
    rate = bench.run(3).rate
    message = codec.message("CFG_Param")
    for index in sorted(set(range(64)) - set(NAMES)):
        frame = bench.frame("CFG_Param", CfgIndex=0, CfgBasal=1)
        word = index << 12 | 0x3FFF << 18
        bench.give(frame._replace(data=codec.protect(message, word, frame.data[1] & 0xF)))
        echo = bench.token(Phase.CONFIG, 0).one("CFG_ParamEcho")
        assert (echo["EchoIndex"], echo["EchoRaw"]) == (index, 0)
        assert echo["EchoSetCrc"] == bench.flash[SET_CRC_INDEX]
    assert bench.run(2).rate == rate


@pytest.mark.parametrize("name", [name for name in UNSET if INDEX[name] not in MUST])
def test_an_unset_limit_counts_as_the_tight_one(name: str) -> None:
    flash = calibration()
    del flash[INDEX[name]]
    flash[SET_CRC_INDEX] = set_crc({index: raw for index, raw in flash.items() if index != SET_CRC_INDEX})
    bench = Bench(flash=flash, mode=S2)
    turn = bench.run(4, 2000)
    assert turn.state == State.AUTO
    if name == "CfgBasalFactor":
        assert turn.rate <= bench.basal // 5
        assert turn.status["LimiterBits"] & layout.LIMITER_MAX_BASAL
        assert turn.alarms(Code.DOSE_LIMITED)
    else:
        assert turn.rate > bench.basal // 5
    if name == "CfgPramTdd":
        assert turn.command["PramlintideRate"] == 0


@pytest.mark.parametrize("limit", [1500, 2000, 4321])
def test_the_largest_rate_is_kept(limit: int) -> None:
    bench = Bench(flash=calibration(CfgMaxBasal=limit))
    rates = [bench.step(8000).command for _ in range(12)]
    assert max(command["InsulinRate"] for command in rates if command["BasalOp"] == Op.SET_RATE) == limit // 5


# ---- the tool on the clinic's PC


def test_values_are_what_the_patient_and_the_tuning_say() -> None:
    patient = load_patient("adult#003")
    tuning = Tuning(pram_ratio=6.5, max_basal=12.5, gain=0.5)
    raws = calibrate(patient, tuning)
    assert raws[INDEX["CfgBasal"]] == round(patient.basal_u_per_h * 1000)
    assert raws[INDEX["CfgGlucoseTarget"]] == 1200
    assert raws[INDEX["CfgPramRatio"]] == 650
    assert raws[INDEX["CfgMaxBasal"]] == 12500
    assert raws[INDEX["CfgMealGain"]] == 754677
    assert raws[INDEX["CfgInsulinGain"]] == 8125756
    assert raws[INDEX["CfgObserverGain"]] == round(0.5 * 754.677 / 8125.756 * 1e7)
    assert list(raws)[-1] == SET_CRC_INDEX
    assert raws[SET_CRC_INDEX] == set_crc({index: raw for index, raw in raws.items() if index != SET_CRC_INDEX})


def test_all_ten_adults_can_be_calibrated() -> None:
    for number in range(1, 11):
        bench = Bench(patient=f"adult#{number:03d}")
        assert bench.run(3).state == State.AUTO


@pytest.mark.parametrize(
    ("changes", "what"),
    [({"max_basal": 61.0}, "CfgMaxBasal"), ({"pram_ratio": -1.0}, "CfgPramRatio"), ({"theta": 0.01}, "CfgLead1B0")],
)
def test_a_value_that_does_not_fit_is_named(changes: dict[str, float], what: str) -> None:
    with pytest.raises(CalibrationError, match=what):
        calibrate(load_patient("adult#001"), Tuning(**changes))


def test_a_patient_without_a_model_is_named() -> None:
    from dataclasses import replace

    with pytest.raises(ControllerModelError, match="nobody"):
        calibrate(replace(load_patient("adult#001"), name="nobody"))


def test_before_a_calibration_every_parameter_is_zero() -> None:
    assert set(Calibration().parameters) == {0}
