"""Run the checks against a device and say of every requirement what came of it."""

import enum
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, get_args

from can_bus import codec
from can_bus.frame import Frame
from plant_server.server import PlantError
from pumpbench.calibration import MODES
from pumpbench.conformance.device import Device
from pumpbench.conformance.driver import Bench, Silent, Violation
from pumpbench.conformance.registry import MEALTIME, Check, Dut, Need, NotOffered, checks
from pumpbench.conformance.requirements import Requirement, requirements
from pumpbench.conformance.settings import Settings
from pumpbench.identity import stated

PRAMLINTIDE: tuple[Need, ...] = ("s1", "s2", "s3", "s4")

TESTER_PRESENT = bytes.fromhex("023E00").ljust(8, b"\xcc")
"""UDS TesterPresent in a single frame of ISO-TP: whoever has a server answers."""


class Verdict(enum.Enum):
    """What came of one requirement."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_APPLICABLE = "not applicable"
    ELSEWHERE = "tested elsewhere"
    OPEN = "not checked"
    NOT_RUN = "not run"


@dataclass(frozen=True)
class Result:
    """One requirement and its verdict.

    Attributes:
        text: why, in words; empty where it passed.
        seconds: of wall clock.
        frames: those on the device's bus in the check, where it failed.
    """

    requirement: Requirement
    verdict: Verdict
    text: str = ""
    seconds: float = 0.0
    frames: Sequence[Frame] = ()


class Report(NamedTuple):
    """All results, in the order of the catalogue, what the device can do, and what it says it is (CTRL_Info)."""

    results: list[Result]
    offers: frozenset[Need]
    device: Mapping[str, Any] | None = None

    def of(self, verdict: Verdict) -> list[Result]:
        """The results with one verdict."""
        return [each for each in self.results if each.verdict == verdict]

    @property
    def holds(self) -> bool:
        """Whether every requirement that was asked about is met or does not apply."""
        return not self.of(Verdict.FAILED) and not self.of(Verdict.NOT_RUN)


class NobodyThere(RuntimeError):
    """The device never answered a roll call."""


def select(names: Iterable[str]) -> list[Requirement]:
    """The requirements of these ids or groups of ids (`SEN-01`, `SEN`), in the order of the catalogue.

    Raises:
        ValueError: there is none of that name.
    """
    asked = list(names)
    for name in asked:
        if not any(known == name or known.startswith(f"{name}-") for known in requirements()):
            groups = ", ".join(dict.fromkeys(known[:3] for known in requirements()))
            raise ValueError(f"there is no requirement {name!r}; give ids such as SEN-01 or groups of {groups}")
    return [
        each
        for each in requirements().values()
        if not asked or any(each.id in (n, f"{n}-{each.id[4:]}") for n in asked)
    ]


def run(
    device: Device,
    settings: Settings,
    *,
    wanted: Sequence[Requirement] | None = None,
    memory: frozenset[Need] = frozenset({"nvm", "memory"}),
    long: bool = False,
    must: Iterable[str] = (),
    patience: float = 10.0,
    progress: Callable[[int, int], None] = lambda _done, _of: None,
) -> Report:
    """Check a device.

    Args:
        device: what is tested.
        settings: thresholds.
        wanted: the requirements to check; default: all.
        memory: of "nvm" and "memory" what holds, for this cannot be found by trying.
        long: use the long form of checks that have one.
        must: modes that it has to take up, whether or not it does.
        patience: seconds to wait for the first answer.
        progress: called with the number of requirements done and of all.

    Raises:
        NobodyThere: the device never answered.
        BusLost: the bus is gone.
    """
    wanted = list(requirements().values()) if wanted is None else wanted
    said = _await(device, patience)
    dut = Dut(device, settings, _offers(device, must, memory=memory), long=long)
    results: list[Result] = []
    gone = ""
    for number, requirement in enumerate(wanted):
        progress(number, len(wanted))
        found = checks().get(requirement.id)
        if gone and found is not None:
            results.append(Result(requirement, Verdict.NOT_RUN, gone))
            continue
        result = _without_check(requirement) if found is None else judge(dut, requirement, found)
        results.append(result)
        if result.verdict == Verdict.FAILED and not _revive(device):
            gone = f"since {requirement.id} the device answers nothing"
    progress(len(wanted), len(wanted))
    return Report(results, dut.offers, stated(said))


def _await(device: Device, patience: float) -> Mapping[str, int] | None:
    """Wait for the answer to a roll call; returns the CTRL_Info in it, if there is one."""
    over = time.monotonic() + patience
    while True:
        try:
            device.renew()
            said = Bench(device, start=False).call_roll().all("CTRL_Info")
        except Silent as silent:
            if time.monotonic() > over:
                raise NobodyThere(f"nobody answers the roll call on this bus: {silent}") from silent
        except Violation:
            return None  # somebody is there, though it breaks rules: the checks say which
        else:
            return said[0] if said else None


def _revive(device: Device) -> bool:
    """Whether the device still answers after a failed check, if need be once it was started anew."""
    for restart in (False, True):
        if restart and not device.can_restart:
            return False
        try:
            if restart:
                device.restart()
            device.renew()
            Bench(device, start=False).call_roll()
        except Silent:
            continue
        except Violation:
            return True
        return True
    return False


def _offers(device: Device, must: Iterable[str], *, memory: frozenset[Need]) -> frozenset[Need]:
    """What the device can do, by trying: modes it takes up, restarts, UDS."""
    asked = set(must)
    found: set[Need] = {
        name for name in get_args(Need) if name in MODES and (name in asked or _takes_up(device, MODES[name]))
    }
    if found.intersection(MEALTIME):
        found.add("boluses")
    if found.intersection(PRAMLINTIDE):
        found.add("pramlintide")
    if device.can_restart:
        found |= {"restart", *memory}
    try:
        if device.receive(Frame(codec.message("UDS_Request").can_id, TESTER_PRESENT)):
            found.add("uds")
    except Violation:
        pass  # it talks out of turn: the checks say so
    return frozenset(found)


def _takes_up(device: Device, mode: int) -> bool:
    try:
        device.renew()
        return Bench(device, mode=mode).step().status["CtrlMode"] == mode
    except Violation:
        return mode == MODES["nma"]  # the mode every device has to have: its checks tell what is wrong


def _without_check(requirement: Requirement) -> Result:
    if requirement.evidence is not None:
        return Result(requirement, Verdict.ELSEWHERE, requirement.evidence)
    return Result(requirement, Verdict.OPEN, requirement.open or "no check is written yet")


def judge(dut: Dut, requirement: Requirement, found: Check) -> Result:
    """Run one check."""
    missing = [need for need in found.needs if need not in dut.offers]
    if missing:
        return Result(requirement, Verdict.NOT_APPLICABLE, f"needs {', '.join(missing)}")
    began = time.monotonic()
    try:
        found.run(dut)
    except NotOffered as missing_here:
        return Result(requirement, Verdict.NOT_APPLICABLE, f"needs {missing_here}", time.monotonic() - began)
    except (Violation, PlantError) as error:
        took = time.monotonic() - began
        return Result(requirement, Verdict.FAILED, f"expected {error}", took, list(dut.record()))
    return Result(requirement, Verdict.PASSED, "", time.monotonic() - began)
