"""The checks of time: the reference passes each, and each can fail."""

from collections.abc import Sequence
from typing import Any

import pytest
from conformance_devices import Changed, Values, Wired, expect_failed, expect_passed
from pumpbench.conformance.suite import select

from can_bus import codec
from can_bus.frame import Frame
from can_bus.lockstep import STEP_SECONDS, Phase
from firmware_sim import caution, cgm, pump
from firmware_sim.cgm import Cgm
from firmware_sim.firmware import Firmware
from firmware_sim.ladder import Ladder
from firmware_sim.scheduler import Scheduler


@pytest.mark.parametrize("requirement", [each.id for each in select(["TIM"])])
def test_the_reference_passes(requirement: str) -> None:
    expect_passed(requirement)


def test_a_step_done_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    as_it_is = Firmware._on_token

    def eager(self: Firmware, values: Values) -> list[Frame]:
        if values["SyncPhase"] == Phase.STEP:
            self._step = None
            self._scheduler = Scheduler(self._tasks())
        return as_it_is(self, values)

    monkeypatch.setattr(Firmware, "_on_token", eager)
    expect_failed("TIM-01", "no command for step 11 after step 11; PUMP_BasalCmd came")


def test_a_repeated_step_that_leaves_a_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    as_it_is = Firmware._on_token

    def forgetful(self: Firmware, values: Values) -> list[Frame]:
        if self._step is not None and values["StepIndex"] < self._step:
            self._cgm.since_gap = self._state[0] = 0
            self._user.suspended = True
        return as_it_is(self, values)

    monkeypatch.setattr(Firmware, "_on_token", forgetful)
    expect_failed("TIM-01", "the same in the next step as without repeated ones; PUMP_BasalCmd came with")


def test_skipped_steps_that_do_not_age_insulin(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Firmware, "_catch_up", lambda *_: 0)
    expect_failed("TIM-02", "the insulin on board of as many steps without a sensor")


def test_skipped_steps_that_do_not_age_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    as_it_is = Ladder.update
    monkeypatch.setattr(Ladder, "update", lambda self, **how: as_it_is(self, **how | {"age": min(how["age"], 1)}))
    expect_failed("TIM-02", "DEGRADED after a jump by 4 steps; Auto came")


def test_a_late_sample_that_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cgm, "AGE_USABLE", 9)
    expect_failed("TIM-02", "SAFE_BASAL after a jump by 7 steps")


@pytest.mark.parametrize("steps", [0, 25])
def test_expiry(monkeypatch: pytest.MonkeyPatch, steps: int) -> None:
    monkeypatch.setattr(pump, "RATE_EXPIRES_AFTER", steps)
    expect_failed("TIM-02", f"a set-point that expires 1 to 24 steps after step 15; it was {steps}")


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("CLOCK_TOLERANCE", 59, "ClockJump with more than 60 s; with 60 s it was True"),
        ("CLOCK_TOLERANCE", 61, "ClockJump with more than 60 s; with 61 s it was False"),
        ("CLOCK_CAUTION", 2, "at most the schedule of 285 for 3 samples after the clock jumped by 61 s"),
        ("CLOCK_CAUTION", 9, "an end of the pause after 5 samples"),
    ],
)
def test_clock_jumps(monkeypatch: pytest.MonkeyPatch, name: str, value: int, text: str) -> None:
    monkeypatch.setattr(caution, name, value)
    expect_failed("TIM-03", text)


def beside_a_jump(monkeypatch: pytest.MonkeyPatch, what: Any) -> None:
    """A device that does something more when the clock jumps."""
    as_it_is = Firmware._run_step

    def run_step(self: Firmware, step: int, sim_time: int) -> None:
        if abs(sim_time - step * STEP_SECONDS) > caution.CLOCK_TOLERANCE:
            what(self)
        as_it_is(self, step, sim_time)

    monkeypatch.setattr(Firmware, "_run_step", run_step)


def test_a_clock_that_ages_samples(monkeypatch: pytest.MonkeyPatch) -> None:
    beside_a_jump(monkeypatch, lambda device: device._wire._batch["CGM_Reading"].clear())
    expect_failed("TIM-03", "with a clock 61 s off")


def test_a_clock_that_forgets_a_bolus(monkeypatch: pytest.MonkeyPatch) -> None:
    beside_a_jump(monkeypatch, lambda device: device._boluses._open.clear())
    expect_failed("TIM-03", "the same insulin on board with the clock 3600 s off, [390, 377]; [390, 37] came")


def test_a_clock_that_makes_a_bolus_uncertain(monkeypatch: pytest.MonkeyPatch) -> None:
    def in_doubt(device: Firmware) -> None:
        device._wire._batch["PUMP_BolusState"].clear()
        for bolus in device._boluses._open.values():
            bolus.uncertain = True

    beside_a_jump(monkeypatch, in_doubt)
    expect_failed("TIM-03", "the same states and bolus with the clock 3600 s off")


def seven_bits(name: str, values: Values) -> Values:
    """Of a device that takes CgmSampleStep for a number of seven bits."""
    return values | {"CgmSampleStep": values["CgmSampleStep"] & 127} if name == "CGM_Reading" else values


def never_round(name: str, values: Values) -> Values:
    """Of a device whose set-points do not expire beyond step 127."""
    if name == "PUMP_BasalCmd" and values["BasalUntilStep"] < 8:
        return values | {"BasalUntilStep": 127}
    return values


def never_past(name: str, values: Values) -> Values:
    """Of a device whose boluses do not expire at step 0."""
    if name == "PUMP_BolusCmd" and values["BolusUntilStep"] == 0:
        return values | {"BolusUntilStep": 99}
    return values


@pytest.mark.parametrize(
    ("device", "text"),
    [
        ({"hears": seven_bits}, "Auto in step 131 with good samples"),
        ({"says": never_round}, "a set-point that expires 1 to 24 steps after step 127"),
        ({"says": never_past}, "a bolus in step 255 that expires within 2 steps; [100] came"),
    ],
)
def test_numbers_that_wrap(device: dict[str, Any], text: str) -> None:
    expect_failed("TIM-04", text, Changed(**device))


def test_an_age_that_wraps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Cgm, "age", lambda self, step: 99 if self._taken is None else step % 256 - self._taken % 256)
    expect_failed("TIM-04", "Auto up to age 3, over step 256; at age 4 Auto was True")


def test_an_alarm_at_the_wrap() -> None:
    def nervous(name: str, values: Values) -> Values:
        return values | {"SimTime": values["StepIndex"] % 256 * 300} if name == "SYNC_Step" else values

    expect_failed("TIM-04", "no alarm in steps 250 to 264", Changed(nervous))


class Hasty(Wired):
    """It says SYNC_Done first."""

    def receive(self, frame: Frame) -> Sequence[Frame]:
        said = super().receive(frame)
        return [*said[-1:], *said[:-1]]


def test_a_turn_that_is_closed_too_early() -> None:
    expect_failed("TIM-05", "SYNC_Done last in a turn", Hasty())


def test_frames_that_are_not_counted() -> None:
    def few(name: str, values: Values) -> Values:
        return values | {"TxCount": values["TxCount"] - 1} if name == "SYNC_Done" else values

    expect_failed("TIM-05", "TxCount", Changed(says=few))


def test_old_samples_in_a_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    as_it_is = Cgm.judge
    monkeypatch.setattr(Cgm, "judge", lambda self, samples, step: as_it_is(self, samples[:1], step))
    expect_failed("TIM-05", "the newest sample is used after three tokens were missed")


def test_a_flood_that_is_too_much() -> None:
    heard: list[int] = []

    def overwhelmed(frame: Frame) -> Sequence[Frame]:
        heard.append(frame.can_id)
        if frame.can_id == codec.message("SYNC_Step").can_id:
            heard.clear()
        return [] if len(heard) > 300 else [frame]

    expect_failed("TIM-05", "the newest sample is used after 600 frames", Wired(overwhelmed))
