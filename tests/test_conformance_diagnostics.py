"""The check of diagnostics: the reference passes it, and it can fail."""

from collections.abc import Callable

import pytest
from conformance_devices import expect_failed, expect_passed

from can_bus import codec
from can_bus.frame import Frame
from firmware_sim.firmware import Firmware
from firmware_sim.uds import Uds


def test_the_reference_passes() -> None:
    expect_passed("DIA-01")


def clears_insulin(device: Firmware) -> None:
    device._state[:] = [0] * len(device._state)


def lifts_a_limit(device: Firmware) -> None:
    device._calibration._active["CfgInsulinTdd"] = 0


def doses(device: Firmware) -> None:
    device._on_meal_announce({"MealKind": 1, "MealId": 3, "CarbsEst": 50, "MealOffset": 0})


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
