"""Firmware that is wrong in one way, as firmware has been wrong: conformance finds it, for the right requirement.

Each is the reference with one mistake. The whole suite runs against it, and what fails is just what is told here: the
requirement the mistake breaks, and those that speak of the same thing.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import pytest
from conformance_devices import Changed, Values, Wired, check_all
from pumpbench.conformance.device import Device
from pumpbench.conformance.reference import reference
from pumpbench.conformance.requirements import requirements
from pumpbench.conformance.suite import Report, Verdict

import firmware_sim.wire
from can_bus import codec
from can_bus.codec import Check, Received, Receiver
from can_bus.faults.fields import repaired
from can_bus.frame import Frame
from firmware_sim import bolus, cgm, pump
from firmware_sim.bolus import Boluses
from firmware_sim.cgm import Cgm
from firmware_sim.cgm import Verdict as Judged
from firmware_sim.control import layout
from firmware_sim.firmware import Firmware
from firmware_sim.ladder import Ladder, State
from firmware_sim.meals import Meals

Patch = pytest.MonkeyPatch

SLOW = {"SEN-10", "E2E-01", "E2E-05", "CMD-03", "LIM-09", "FAL-02", "FAL-03", "LED-01", "TWO-03", "RST-01", "NUM-01",
        "ROB-02", "ROB-03", "ROB-04", "TWO-01", "LIM-02", "LED-04", "CMD-02", "CMD-10"}  # fmt: skip
"""Two thirds of the time: run where a variant is to fail them, and with PUMPBENCH_NIGHTLY=1 on all."""


class Variant(NamedTuple):
    """A mistake.

    Attributes:
        name: in words.
        make: builds the device, after patching the reference if need be.
        breaks: the requirement it breaks.
        also: what speaks of the same thing.
        because: where it shows in every turn: words of which every failure's reason has some.
    """

    name: str
    make: Callable[[Patch], Device]
    breaks: str
    also: Sequence[str] = ()
    because: Sequence[str] = ()


# ---- the wire


class Deaf(Receiver):
    """Does not look at COUNTER."""

    def receive(self, frame: Frame) -> Received:
        received = super().receive(frame)
        if received.check not in (Check.REPEATED, Check.WRONG_SEQUENCE):
            return received
        return Received(Check.OK, received.name, codec.message(received.name).unpack(frame.data), 0)


class Trusting(Receiver):
    """Does not look at CHECKSUM."""

    def receive(self, frame: Frame) -> Received:
        message = codec.messages_by_id().get(frame.can_id)
        if message is None or len(frame.data) != message.length:
            return super().receive(frame)
        return super().receive(Frame(frame.can_id, repaired(message, frame.data)))


def with_receiver(kind: type[Receiver]) -> Callable[[Patch], Device]:
    def make(patch: Patch) -> Device:
        patch.setattr(firmware_sim.wire, "Receiver", kind)
        return reference()

    return make


def done_first(_patch: Patch) -> Device:
    """SYNC_Done leads the turn instead of ending it."""

    class Hasty(Wired):
        def receive(self, frame: Frame) -> Sequence[Frame]:
            said = super().receive(frame)
            last = codec.message("SYNC_Done").can_id
            return sorted(said, key=lambda each: each.can_id != last)

    return Hasty()


# ---- the sensor


def ageless(patch: Patch) -> Device:
    """Takes the newest sample for a fresh one, however old it is."""
    patch.setattr(cgm, "AGE_USABLE", 255)
    patch.setattr(Cgm, "age", lambda self, _step: cgm.NEVER if self._taken is None else 0)
    return reference()


def forgetful_of_numbers(patch: Patch) -> Device:
    """Takes a sample that was there already for a new one."""

    def judge(self: Cgm, samples: list[dict[str, int]], step: int, judge: Any = Cgm.judge) -> Judged:
        if samples and self._sequence is not None and samples[0]["CgmSampleSeq"] <= self._sequence:
            self._sequence = samples[0]["CgmSampleSeq"] - 1
        verdict: Judged = judge(self, samples, step)
        return verdict

    patch.setattr(Cgm, "judge", judge)
    return reference()


def goes_on_without_samples(patch: Patch) -> Device:
    """Stays in Auto when the sensor is silent."""
    patch.setattr(Ladder, "_next_rung", lambda *_: State.AUTO)
    return reference()


# ---- doses


def new_number_for_every_try(patch: Patch) -> Device:
    """A command of a bolus that was not answered is sent again under another BolusId."""

    def listen(self: Boluses, listen: Any = Boluses._listen) -> None:
        for open_bolus in self._open.values():
            if open_bolus.op != bolus.Op.NONE and open_bolus.ack is None:
                open_bolus.number = self.next_id
                self.next_id = (self.next_id + 1) % bolus.IDS
        listen(self)

    patch.setattr(Boluses, "_listen", listen)
    return reference()


def does_not_compare_the_echo(patch: Patch) -> Device:
    """Commits whatever the pump says it has understood."""

    def advance(self: Boluses, drug: Any, one: Any, result: int, _echo: int, advance: Any = Boluses._advance) -> None:
        advance(self, drug, one, result, one.dose)

    patch.setattr(Boluses, "_advance", advance)
    return reference()


def wraps_at_12_7(_patch: Patch) -> Device:
    """A rate in a byte and a bit, as in pumps of old: 12.7 U/h and no more, then from the beginning."""

    def says(name: str, values: Values) -> Values:
        return values | {"InsulinRate": values["InsulinRate"] % 2540} if name == "PUMP_BasalCmd" else values

    return Changed(says=says)


def expires_late(patch: Patch) -> Device:
    """Set-points that hold for hours; the pump refuses them."""
    patch.setattr(pump, "RATE_EXPIRES_AFTER", 30)
    return reference()


def pramlintide_without_insulin(_patch: Patch) -> Device:
    """Pramlintide goes on while insulin is suspended."""
    last = {"PramlintideRate": 0}

    def says(name: str, values: Values) -> Values:
        if name != "PUMP_BasalCmd" or values["BasalOp"] != pump.Op.SET_RATE:
            return values
        if values["InsulinRate"] == 0:
            return values | last
        last["PramlintideRate"] = values["PramlintideRate"]
        return values

    return Changed(says=says)


def silent_limits(_patch: Patch) -> Device:
    """Cuts doses and tells nobody."""

    def says(name: str, values: Values) -> Values | None:
        if name == "CTRL_Status":
            return values | {"LimiterBits": 0}
        return values

    return Changed(says=says)


def two_boluses_for_one_meal(patch: Patch) -> Device:
    """Acts on an announcement as often as it comes."""

    def hear(self: Meals, values: dict[str, int], hear: Any = Meals.hear) -> None:
        self.last = None
        hear(self, values)

    patch.setattr(Meals, "hear", hear)
    return reference()


# ---- memory


def nothing_on_board_after_a_reset(patch: Patch) -> Device:
    """Forgets the insulin on board when the power fails."""

    def restore(self: Firmware, words: Iterator[int], restore: Any = Firmware._restore) -> None:
        restore(self, words)
        for word in (layout.IOB_1, layout.IOB_2):
            self._state[word] = 0

    patch.setattr(Firmware, "_restore", restore)
    return reference()


VARIANTS = (
    Variant("double bolus on retry", new_number_for_every_try, "CMD-02"),
    Variant("echo ignored", does_not_compare_the_echo, "CMD-01", ["TWO-06"]),
    Variant("counter ignored", with_receiver(Deaf), "E2E-02", ["E2E-03", "TIM-01"]),
    Variant(
        "CRC ignored", with_receiver(Trusting), "E2E-01", ["E2E-03", "E2E-05", "ALM-01", "ALM-02", "ALM-03", "ROB-02"]
    ),
    Variant(
        "stale CGM used",
        ageless,
        "SEN-01",
        [
            "SEN-02",
            "SEN-08",
            "E2E-04",
            "E2E-07",
            "FAL-01",
            "FAL-02",
            "FAL-03",
            "ALM-02",
            "ALM-03",
            "ALM-04",
            "TIM-02",
            "TIM-04",
            "RST-01",
            "USR-05",
            "TWO-01",
        ],
    ),
    Variant("replayed sample used", forgetful_of_numbers, "SEN-03", ["E2E-04", "RST-01"]),
    Variant("wrap at 12.7 U/h", wraps_at_12_7, "NUM-02", ["ALM-01"]),
    Variant("IOB lost on reset", nothing_on_board_after_a_reset, "RST-01", ["RST-02"]),
    Variant("expiry ignored", expires_late, "CMD-08", ["CMD-09", "TIM-02", "TIM-04", "TIM-05", "RST-05"]),
    Variant(
        "basal kept after CGM loss",
        goes_on_without_samples,
        "FAL-02",
        ["SEN-01", "E2E-07", "FAL-01", "FAL-03", "ALM-03", "TIM-02", "TIM-04", "USR-05", "TWO-01"],
    ),
    Variant("pramlintide kept in suspend", pramlintide_without_insulin, "TWO-01", ["TWO-02"]),
    Variant("silent limit", silent_limits, "LIM-09", ["SEN-01", "NUM-04"]),
    Variant("SYNC_Done before the command", done_first, "TIM-05", because=("SYNC_Done", "no echo")),
    Variant("a meal acted on twice", two_boluses_for_one_meal, "USR-01"),
)


def report(variant: Variant, patch: Patch) -> Report:
    """All verdicts on a variant."""
    left_out = set() if os.environ.get("PUMPBENCH_NIGHTLY") == "1" else SLOW - {variant.breaks, *variant.also}
    return check_all(variant.make(patch), [name for name in requirements() if name not in left_out])


@pytest.mark.parametrize(
    "variant",
    [
        pytest.param(variant, id=variant.name, marks=[pytest.mark.nightly] if number % 2 else [])
        for number, variant in enumerate(VARIANTS)
    ],
)
def test_a_variant_fails_for_the_right_reason(variant: Variant, monkeypatch: Patch) -> None:
    found = report(variant, monkeypatch)
    failed = {each.requirement.id: each.text for each in found.of(Verdict.FAILED)}
    assert variant.breaks in failed
    assert not found.of(Verdict.NOT_RUN)
    if variant.because:
        assert all(any(word in text for word in variant.because) for text in failed.values()), failed
    else:
        assert set(failed) == {variant.breaks, *variant.also}, failed
