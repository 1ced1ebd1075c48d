"""What checks of boluses share: what a device said of them, a wire that forges content, power that fails.

loop = dut.loop(meal_mode(dut), [(6, 30.0)], steps=12)
loop.to_device = Forged(lambda name, values: [], "PUMP_Ack")        # every acknowledgement is lost
commands(loop.play())
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from can_bus import codec
from can_bus.faults.fields import repaired, with_raw
from can_bus.frame import Frame
from can_bus.lockstep import Node
from pumpbench.conformance.driver import changed
from pumpbench.conformance.loop import Loop, Values
from pumpbench.conformance.registry import MEALTIME, Dut

INSULIN, PRAMLINTIDE = 1, 2
"""PUMP_BolusCmd.BolusHormone."""

DRUGS = {INSULIN: "insulin", PRAMLINTIDE: "pramlintide"}

DOSE = {INSULIN: "InsulinBolus", PRAMLINTIDE: "PramlintideBolus"}

PROGRAM, COMMIT, CANCEL = 1, 2, 3
"""PUMP_BolusCmd.BolusOp."""

ACCEPTED, DUPLICATE = 0, 1
"""PUMP_Ack.AckResult."""

ACK_OF = {(INSULIN, PROGRAM): 2, (INSULIN, COMMIT): 3, (PRAMLINTIDE, PROGRAM): 4, (PRAMLINTIDE, COMMIT): 5}
"""PUMP_Ack.AckFor of the stages of a bolus."""

PROGRAM_ACKS = {ACK_OF[drug, PROGRAM]: drug for drug in DRUGS}
COMMIT_ACKS = {ACK_OF[drug, COMMIT]: drug for drug in DRUGS}


FIRST = 6
"""Step of the first meal: the device is in Auto by then."""


def meal_mode(dut: Dut) -> str:
    """A mode of this device that answers a meal with a bolus, insulin alone if there is a choice; it has "boluses"."""
    return next(name for name in MEALTIME if name in dut.offers)


def carbs_mode(dut: Dut) -> str | None:
    """A mode with boluses for announced carbohydrates, if the device has one."""
    return next((name for name in ("ma", "s3") if name in dut.offers), None)


class Command(NamedTuple):
    """A PUMP_BolusCmd as the device said it.

    Attributes:
        at: its place in `Loop.heard`.
        step: of the run.
        drug, op, number, dose, until: its fields, raw.
    """

    at: int
    step: int
    drug: int
    op: int
    number: int
    dose: int
    until: int

    @property
    def ahead(self) -> int:
        """Steps from now to its expiry, modulo 256."""
        return (self.until - self.step) % 256


def commands(loop: Loop, op: int | None = None, drug: int | None = None) -> list[Command]:
    """The bolus commands of a run in order, those of one operation or one drug."""
    found = [
        Command(
            at,
            step,
            values["BolusHormone"],
            values["BolusOp"],
            values["BolusId"],
            values.get(DOSE.get(values["BolusHormone"], ""), 0),
            values["BolusUntilStep"],
        )
        for at, (step, name, values) in enumerate(loop.heard)
        if name == "PUMP_BolusCmd"
    ]
    return [each for each in found if op in (None, each.op) and drug in (None, each.drug)]


def programs(loop: Loop, drug: int | None = None) -> list[Command]:
    """The first Program of every bolus."""
    first: dict[tuple[int, int], Command] = {}
    for each in commands(loop, PROGRAM, drug):
        first.setdefault((each.drug, each.number), each)
    return list(first.values())


def bolus_steps(loop: Loop, *operations: int) -> list[int]:
    """Steps in which a PUMP_BolusCmd with one of these operations was sent."""
    return [each.step for each in commands(loop) if each.op in operations]


def flash(loop: Loop, **raws: int) -> None:
    """Give the device another calibration, by signal name, for a run that has not begun."""
    loop.plant.run = loop.plant.run._replace(calibration=changed(loop.plant.run.calibration, **raws))


Change = Callable[[str, Values], Sequence[Values]]
"""From name and raw values of a frame to those of the frames that arrive instead, in any bits the fields have."""


class Forged:
    """A wire on which some messages are written anew, with counters of their own: only their content tells.

    Args:
        change: what becomes of them; CRC and COUNTER are made good.
        messages: which; all others pass as they are.
    """

    def __init__(self, change: Change, *messages: str) -> None:
        self._change = change
        self._counters = dict.fromkeys(messages, 0)

    def __call__(self, name: str, values: Values, _frame: Frame) -> Sequence[Frame] | None:
        """What arrives in place of a frame."""
        return [self._frame(name, each) for each in self._change(name, values)] if name in self._counters else None

    def _frame(self, name: str, values: Values) -> Frame:
        message, counter = codec.message(name), self._counters[name]
        self._counters[name] = (counter + 1) % 16
        return Frame(message.can_id, repaired(message, with_raw(message, bytes(message.length), values), counter))


class PowerCut:
    """A device whose power fails once and comes back, its memory kept.

    Args:
        dut: can be restarted.
        device: the same, as a loop sees it.
        when: whether power fails in place of hearing this frame (name, raw values); asked until it is so.
    """

    finished = False

    def __init__(self, dut: Dut, device: Node, when: Callable[[str, Values], bool]) -> None:
        self._dut, self._device, self._when = dut, device, when
        self._done = False

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """What the device says, be it that it has started."""
        message = codec.messages_by_id().get(frame.can_id)
        if not self._done and message is not None and self._when(message.name, message.unpack(frame.data)):
            self._done = True
            return self._dut.restart()
        return self._device.receive(frame)
