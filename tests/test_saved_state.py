"""What every part of the firmware writes to the non-volatile memory is what it takes back, word by word."""

import itertools
from typing import Any

import pytest
from bench import S2, Bench, calibration

from firmware_sim.alarms import Alarms, Code
from firmware_sim.bolus import Boluses, Drug, Op
from firmware_sim.calibration import Calibration, parameter_names
from firmware_sim.caution import Caution
from firmware_sim.cgm import Cgm
from firmware_sim.firmware import Firmware
from firmware_sim.meals import Meals
from firmware_sim.nvm import RamMemory
from firmware_sim.pump import Pump
from firmware_sim.user import REQUEST_RESUME, REQUEST_SUSPEND, User


def taken_back(part: Any, new: Any) -> Any:
    """A new part with the words of an old one; not one word is left over."""
    words = iter(part.save())
    new.restore(words)
    assert list(words) == []
    return new


@pytest.mark.parametrize("drugs", [(), (Drug.INSULIN,), (Drug.PRAMLINTIDE,), (Drug.INSULIN, Drug.PRAMLINTIDE)])
def test_boluses(drugs: tuple[Drug, ...]) -> None:
    boluses = Boluses()
    boluses.next_id = 41
    for place, drug in enumerate(drugs):
        boluses.start(drug, 100 + place, 7 + place)
        boluses._open[drug].remaining = 60 + place
        boluses._open[drug].committed = place == 0
    again = taken_back(boluses, Boluses())
    assert again.next_id == 41 + len(drugs)
    assert list(again._open) == list(drugs)
    for drug in drugs:
        old, new = boluses._open[drug], again._open[drug]
        assert (new.number, new.dose, new.until) == (old.number, old.dose, old.until)
        assert (new.committed, new.remaining) == (old.committed, old.remaining)
        assert (new.op, new.uncertain, new.sends, new.ack) == (Op.NONE, True, 0, None)
        assert again.remaining(drug) == (old.remaining if old.committed else 0)


def test_a_cancel_asks_anew_whatever_was_said_before() -> None:
    boluses = Boluses()
    boluses.start(Drug.INSULIN, 100, 7)
    boluses._open[Drug.INSULIN].sends = 3
    boluses._open[Drug.INSULIN].ack = (0, 100)
    boluses.cancel()
    bolus = boluses._open[Drug.INSULIN]
    assert (bolus.op, bolus.sends, bolus.ack) == (Op.CANCEL, 0, None)


def test_the_sensor() -> None:
    for sequence, taken, session, doubtful in ((5, 9, 3, True), (None, None, 255, False)):
        cgm = Cgm()
        cgm._sequence, cgm._taken, cgm._session, cgm.doubtful = sequence, taken, session, doubtful
        again = taken_back(cgm, Cgm())
        assert (again._sequence, again._taken, again._session, again.doubtful) == (sequence, taken, session, doubtful)
    cgm = Cgm()
    cgm._sequence = cgm._taken = 0  # zero is a number, not nothing
    again = taken_back(cgm, Cgm())
    assert (again._sequence, again._taken) == (0, 0)


def test_the_pump() -> None:
    names = ("_sequence", "_confirmed_total", "_pram_total", "_boot_count", "_estimated", "_commanded_rate")
    for values in ((17, 5001, 702, 3, 11, 290), (0, 0, 0, 0, 0, 0), (1022, None, None, None, 0, None)):
        pump = Pump()
        for name, value in zip(names, values, strict=True):
            setattr(pump, name, value)
        again = taken_back(pump, Pump())
        assert tuple(getattr(again, name) for name in names) == values
        assert not again.heard


@pytest.mark.parametrize("last", [None, 0, 254])
def test_meals(last: int | None) -> None:
    meals = Meals()
    meals.last = last
    again = taken_back(meals, Meals())
    assert again.last == last
    assert again.take() == (0, 0)


def test_what_is_not_known_is_minus_one_and_what_is_not_there_is_zero() -> None:
    """The layout of the memory is read by tools too: what stands for nothing is fixed."""
    assert Cgm().save() == [-1, -1, 255, 0, -1]
    assert Meals().save() == [-1]
    assert Pump().save() == [1022, -1, -1, -1, 0, -1]
    assert Boluses().save() == [0] * 13
    assert Alarms().save() == [0, 0]
    assert Calibration().save() == [0]


def test_alarms_use_no_instance_twice() -> None:
    alarms = Alarms()
    alarms.hold(Code.CGM_LOST, True, 0)
    alarms.hold(Code.PUMP_LOST, True, 0)
    again = taken_back(alarms, Alarms())
    again.hold(Code.E2E_FAULT, True, 0)
    assert [alarm["instance"] for alarm in again.listing()] == [2]
    assert [alarm["code"] for alarm in alarms.listing()] == ["pump_lost", "cgm_lost"]
    assert [alarm["priority"] for alarm in alarms.listing()] == ["high", "medium"]


def test_the_calibration_is_in_force_again() -> None:
    old = Bench(flash=calibration(CfgLowSuspend=650)).firmware._calibration  # type: ignore[attr-defined]
    new = taken_back(old, Calibration())
    assert new.active and new.intact
    assert new.parameters == old.parameters
    assert new.values == old.values
    assert new._active_crc == old._active_crc
    empty = taken_back(Calibration(), Calibration())
    assert not empty.active


def test_a_calibration_that_lost_a_parameter_is_not_in_force() -> None:
    words = Bench().firmware._calibration.save()  # type: ignore[attr-defined]
    names = parameter_names()
    place = next(k for k in range(1, len(words), 2) if names[words[k]] == "CfgBasal")
    cut = Calibration()
    cut.restore(iter([words[0] - 1, *words[1:place], *words[place + 2 :]]))
    assert not cut.active


def told(sequence: int, mode: int, request: int) -> dict[str, int]:
    return {"ModeCmdSeq": sequence, "ModeRequest": mode, "SuspendRequest": request}


def test_what_the_user_wants() -> None:
    user = User()
    assert not user.hear(told(7, 6, REQUEST_SUSPEND))
    again = taken_back(user, User())
    assert (again.mode, again.suspended) == (6, True)
    assert not again.hear(told(7, 2, REQUEST_RESUME))  # obeyed before the reset
    assert not again.hear(told(6, 2, REQUEST_RESUME))
    assert (again.mode, again.suspended, again.sequence_errors) == (6, True, 1)
    assert again.hear(told(8, 2, REQUEST_RESUME))
    assert taken_back(User(), User()).hear(told(200, 2, REQUEST_RESUME))  # any number may be the first one


def test_caution() -> None:
    caution = Caution()
    assert caution.check_clock(9, 9 * 300 + 61)
    for step in (0, 8, 9, 10, 11):
        assert not caution.held
        caution = taken_back(caution, Caution())
        caution.count_reset(step)
    caution = taken_back(caution, Caution())
    assert caution.held
    for step in (12, 13, 14):
        assert caution.clock_doubtful
        caution.sample(step)
    assert not caution.clock_doubtful


def test_the_firmware_as_a_whole() -> None:
    """Every word of `_save` comes back as the same word, but for the count of boots."""
    bench = Bench(mode=S2)
    for k in range(30):
        bench.step(1200 + 11 * k)
    words = bench.firmware._save()  # type: ignore[attr-defined]
    again = Firmware()
    again._restore(iter(words))
    after = again._save()
    assert [k for k, (a, b) in enumerate(zip(words, after, strict=True)) if a != b] == [1]
    assert after[1] == words[1] + 1
    assert len({*itertools.chain(words)}) > 60  # there was something to keep


def test_a_flipped_bit_is_the_one_that_was_asked_for() -> None:
    memory = RamMemory(4)
    memory.write(0, bytes(4))
    memory.flip(19)
    assert memory.read(0, 4) == bytes([0, 0, 8, 0])
