"""One run with faults against its twin without them: for the matrix and the hunt."""

import functools
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from can_bus.lockstep import STEP_SECONDS, STEPS_PER_DAY
from pumpbench import bench
from pumpbench.closed_loop import Case, simulate
from pumpbench.closed_loop.result import GLUCOSE_SCALE

SIGNS = {
    "frames_lost": "LostFrameCount",
    "e2e_errors": "E2eErrorCount",
    "sequence_errors": "SequenceErrorCount",
    "saturations": "SaturationCount",
}
"""Counters under `safety` -> signals of CTRL_Diag."""

LOW, HIGH = 54.0, 250.0
"""mg/dL."""


class Probe(NamedTuple):
    """A run to be judged."""

    patient: str = "adult#001"
    mode: str = "s2"
    seed: int = 1
    scenario: str = "six-hours"
    hours: float = 6.0
    faults: tuple[Any, ...] = ()
    bus: str = "inproc"
    firmware: str | None = None

    @property
    def twin(self) -> "Probe":
        """The same without faults."""
        return self._replace(faults=())


class Verdict(NamedTuple):
    """What came of it.

    Attributes:
        hazards: H1 to H8 with their counts; those not found are left out.
        first: step and name of the first hazard.
        signs: alarms ("CTRL.CgmLost") and counters ("LostFrameCount") that the twin does not have.
        injected: actions of faults, as reported on the bus.
        low, high: minutes below 54 and above 250 mg/dL more than the twin.
        error: why the run did not come to its end, or "".
    """

    hazards: dict[str, int]
    first: tuple[int, str] | None
    signs: frozenset[str]
    injected: int
    low: float = 0.0
    high: float = 0.0
    error: str = ""

    @property
    def failed(self) -> bool:
        """A hazard was found, or the run broke off."""
        return bool(self.hazards) or bool(self.error)


class _Seen(NamedTuple):
    alarms: frozenset[str]
    counters: dict[str, int]
    low: float
    high: float


def run(probe: Probe) -> bench.Outcome:
    """Do the run of a probe.

    Raises:
        as `bench.run`.
    """
    return bench.run(
        patient=probe.patient,
        strategy=probe.mode,
        seed=probe.seed,
        scenario=probe.scenario,
        hours=probe.hours,
        faults=probe.faults,
        bus=probe.bus,
        firmware=probe.firmware,
    )


@functools.lru_cache(maxsize=256)
def _twin(probe: Probe) -> _Seen:
    return _seen(run(probe))


def _seen(outcome: bench.Outcome) -> _Seen:
    alarms = frozenset(f"{event.node}.{event.code}" for event in outcome.raised())
    return _Seen(alarms, outcome.counters, outcome.minutes_below(LOW), outcome.minutes_above(HIGH))


def judge(probe: Probe, *, signs: bool = True) -> Verdict:
    """Do a run and its twin, and compare. A run that breaks off is a verdict, not an error.

    Args:
        probe: the run.
        signs: whether anybody wants to know what showed the faults; if not, the twin is the compiled loop's, which has
            the same glucose to the last bit and takes a tenth of the time.
    """
    try:
        outcome = run(probe)
    except (RuntimeError, OSError) as error:  # NodeDied, PlantError, BusLost
        return Verdict({}, None, frozenset(), 0, error=f"{type(error).__name__}: {error}")
    found = _seen(outcome)
    firsts = outcome.safety["first_hazards"]
    first = (firsts[0]["step"], firsts[0]["hazard"]) if firsts else None
    if not signs:
        low, high = _compiled_twin(probe.twin)
        shown: frozenset[str] = frozenset()
    else:
        twin = _twin(probe.twin)
        low, high = twin.low, twin.high
        more = {SIGNS[name] for name in SIGNS if found.counters[name] > twin.counters[name]}
        shown = (found.alarms - twin.alarms) | more
    injected = outcome.safety["faults_injected"]
    return Verdict(outcome.hazards, first, shown, injected, found.low - low, found.high - high)


@functools.lru_cache(maxsize=256)
def _compiled_twin(probe: Probe) -> tuple[float, float]:
    """Minutes below and above of a run without faults."""
    steps = round(probe.hours * bench.STEPS_PER_HOUR)
    days = steps / STEPS_PER_DAY
    case = Case(probe.patient, mode=probe.mode, days=days, seed=probe.seed, scenario=probe.scenario)
    glucose = np.rint(simulate(case).glucose / GLUCOSE_SCALE) * GLUCOSE_SCALE  # as PLANT_Truth tells it
    low, high = (np.count_nonzero(beyond) * STEP_SECONDS / 60 for beyond in (glucose < LOW, glucose > HIGH))
    return float(low), float(high)


def signs_of(verdicts: Iterable[Verdict]) -> dict[str, int]:
    """How many runs showed each sign."""
    counts: dict[str, int] = {}
    for verdict in verdicts:
        for sign in verdict.signs:
            counts[sign] = counts.get(sign, 0) + 1
    return dict(sorted(counts.items(), key=lambda item: (-item[1], item[0])))
