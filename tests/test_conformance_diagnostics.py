"""The check of diagnostics: the reference passes it, and it can fail."""

from collections.abc import Callable

import pytest
from conformance_devices import expect_failed, expect_passed

from can_bus import codec
from can_bus.frame import Frame
from firmware_sim import history
from firmware_sim.alarms import Alarms
from firmware_sim.firmware import Firmware
from firmware_sim.uds import Uds


def test_the_reference_passes() -> None:
    expect_passed("DIA-01")


def clears_insulin(device: Firmware) -> None:
    device._state[:] = [0] * len(device._state)


def lifts_a_limit(device: Firmware) -> None:
    device._calibration._active["CfgInsulinTdd"] = 0


def doses(device: Firmware) -> None:
    device._meals.hear({"MealKind": 1, "MealId": 3, "CarbsEst": 50, "MealOffset": 0})


@pytest.mark.parametrize("service", [0x14, 0x2E, 0x2F, 0x31, 0x3D])
@pytest.mark.parametrize("what", [clears_insulin, lifts_a_limit, doses])
def test_a_service_that_does_something(
    monkeypatch: pytest.MonkeyPatch, service: int, what: Callable[[Firmware], None]
) -> None:
    as_it_is = Uds.answer

    def answer(self: Uds, request: bytes) -> bytes:
        if request[0] == service and isinstance(self._device, Firmware):
            what(self._device)
        return as_it_is(self, request)

    monkeypatch.setattr(Uds, "answer", answer)
    expect_failed("DIA-01", "whatever a tester asks for")


def test_other_frames_out_of_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    command = Frame(codec.message("PUMP_BolusCmd").can_id, bytes(8))
    monkeypatch.setattr(Firmware, "_diagnose", lambda *_: [command])
    expect_failed("DIA-01", "nothing but UDS_Response out of turn; PUMP_BolusCmd")


# ---- DIA-02


def test_the_reference_keeps_a_history() -> None:
    expect_passed("DIA-02")


def forget(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history.History, "_load", lambda *_: None)


def no_alarms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Alarms, "bits", 0)


def no_boluses(monkeypatch: pytest.MonkeyPatch) -> None:
    as_it_is = Firmware._record
    monkeypatch.setattr(Firmware, "_record", lambda self, step: as_it_is(self, step)._replace(bolus=0))


def short_records(monkeypatch: pytest.MonkeyPatch) -> None:
    as_it_is = history.pack
    monkeypatch.setattr("firmware_sim.uds.pack", lambda record: as_it_is(record)[:-1])


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (forget, "a first frame for DID 0x4000; 03 7f 22 31"),
        (no_alarms, "the record of step 1 to say what was on the bus: alarms"),
        (no_boluses, "the record of step 8 to say what was on the bus: bolus"),
        (short_records, "39 bytes in answer to DID 0x4000; 38 came"),
    ],
)
def test_a_history_that_is_none(
    monkeypatch: pytest.MonkeyPatch, wrong: Callable[[pytest.MonkeyPatch], None], text: str
) -> None:
    wrong(monkeypatch)
    expect_failed("DIA-02", text)
