"""Devices for the tests of the conformance suite: the reference, and what is wrong with it on purpose."""

import functools
from collections.abc import Callable, Sequence

from pumpbench.conformance import settings, suite
from pumpbench.conformance.device import Device, InProcess
from pumpbench.conformance.reference import reference
from pumpbench.conformance.registry import Dut, Need, checks
from pumpbench.conformance.suite import Report, Result, Verdict

from can_bus import codec
from can_bus.faults.fields import repaired, with_raw
from can_bus.frame import Frame
from can_bus.lockstep import Node

Values = dict[str, int]
Change = Callable[[str, Values], Values | None]
"""From the name and the raw values of a frame to other values (CRC is made good), or None: the frame is lost."""


def as_it_is(_name: str, values: Values) -> Values:
    """No change."""
    return values


class Wired:
    """The reference behind something that hands on other frames than came, or more of them, or none."""

    def __init__(
        self,
        hears: Callable[[Frame], Sequence[Frame]] = lambda frame: [frame],
        says: Callable[[Frame], Sequence[Frame]] = lambda frame: [frame],
    ) -> None:
        self._device = reference()
        self._hears, self._says = hears, says
        self.can_restart = True
        self.finished = False

    def receive(self, frame: Frame) -> Sequence[Frame]:
        """What the device says to all that it hears."""
        return [said for heard in self._hears(frame) for said in self._said(self._device.receive(heard))]

    def _said(self, frames: Sequence[Frame]) -> list[Frame]:
        return [other for said in frames for other in self._says(said)]

    def restart(self, *how: object) -> Sequence[Frame]:
        """As the reference."""
        return self._said(self._device.restart(*how))  # type: ignore[arg-type]

    def renew(self) -> None:
        """As the reference."""
        self._device.renew()


class Changed(Wired):
    """The reference behind something that changes what it hears, or what it says."""

    def __init__(self, hears: Change = as_it_is, says: Change = as_it_is) -> None:
        super().__init__(lambda frame: _changed(frame, hears), lambda frame: _changed(frame, says))


def _changed(frame: Frame, change: Change) -> list[Frame]:
    message = codec.messages_by_id().get(frame.can_id)
    if message is None or len(frame.data) != message.length:
        return [frame]
    before = message.unpack(frame.data)
    after = change(message.name, dict(before))
    if after is None:
        return []
    return [frame if after == before else Frame(frame.can_id, repaired(message, with_raw(message, frame.data, after)))]


def built_from(node: Callable[[], Node]) -> InProcess:
    """A device made of a node of one's own; it forgets everything at a restart."""
    return InProcess(lambda _memory: node())


@functools.cache
def _offers() -> frozenset[Need]:
    return suite.run(reference(), settings.load(), wanted=[]).offers


def check_one(requirement: str, device: Device | None = None) -> Result:
    """The verdict on one requirement."""
    dut = Dut(device or reference(), settings.load(), _offers())
    return suite.judge(dut, suite.select([requirement])[0], checks()[requirement])


def check_all(device: Device, names: Sequence[str] = ()) -> Report:
    """All verdicts."""
    return suite.run(device, settings.load(), wanted=suite.select(names))


def expect_passed(requirement: str, device: Device | None = None) -> None:
    """The reference, or another device, passes."""
    result = check_one(requirement, device)
    assert result.verdict == Verdict.PASSED, result.text


def expect_failed(requirement: str, text: str, device: Device | None = None) -> None:
    """A device that is wrong fails, and the report says what was expected."""
    result = check_one(requirement, device)
    assert result.verdict == Verdict.FAILED, f"{result.verdict.value}: the check cannot see what is wrong"
    assert text in result.text, result.text
