"""Random campaigns of faults: cases by seed, a verdict for each, and what failed made as small as it goes.

Case n of a seed is always the same: patient, mode, scenario, length and one to four faults. A run fails when a hazard
is found or it breaks off. A failure is shrunk, one change at a time as long as it still fails in the same way: fewer
faults, a shorter run, narrower windows, plainer keys, a plainer patient. What is left is written as a test.
"""

import functools
import json
import random
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import TypeAdapter, ValidationError

from can_bus.faults import clock
from can_bus.lockstep import STEP_SECONDS
from plant_server.physiology import cohort
from pumpbench import faults as make
from pumpbench.calibration import MODES
from pumpbench.faults import AnyFault, call
from pumpbench.files import write_file
from pumpbench.parallel import in_parallel
from pumpbench.probe import Probe, Verdict, judge

CASES = "cases.jsonl"
SHRINK_AT_MOST = 150
"""Runs spent on making one failure smaller."""

FAULTS_AT_MOST = 4

ENDLESS = ("kill", "restart", "replacement")
"""Kinds that are drawn without an end."""

SCENARIOS = (("six-hours", 6.0), ("six-hours", 6.0), ("validation-14d", 24.0), ("camerlingo", 24.0))
"""And hours; the short one as often as both days together."""

TO_DEVICE = ("CGM_Reading", "CGM_Status", "PUMP_Status", "PUMP_Delivered", "PUMP_BolusState", "PUMP_Ack", "PUMP_Alarm",
             "MEAL_Announce", "UI_AlarmAck", "HB_PUMP", "HB_CGM", "PLANT_Truth")  # fmt: skip
FROM_DEVICE = ("PUMP_BasalCmd", "PUMP_BolusCmd", "CTRL_Status", "CTRL_Alarm", "CTRL_Diag", "HB_CTRL")
TRAFFIC = TO_DEVICE + FROM_DEVICE
"""What faults are aimed at: all but the lockstep and the calibration, without which there is no run."""

VALUES: dict[str, tuple[tuple[str, float], ...]] = {
    "CGM_Reading": (("GlucoseConc", 40), ("GlucoseConc", 90), ("GlucoseConc", 300), ("GlucoseConc", 400),
                    ("CgmState", 6), ("CgmSampleSeq", 7), ("CgmSampleStep", 3)),
    "PUMP_Status": (("PumpState", 5), ("InsulinReservoir", 0), ("PumpBattery", 0), ("PumpLastBasalSeq", 5)),
    "PUMP_Delivered": (("InsulinTotal", 0), ("InsulinTotal", 16000), ("PramTotal", 0), ("PumpBootCount", 3)),
    "PUMP_BolusState": (("BolusPhase", 0), ("BolusPhase", 3), ("BolusStateId", 9), ("BolusDeliveredRaw", 0)),
    "PUMP_Ack": (("AckResult", 0), ("AckResult", 3), ("AckId", 1), ("AckEchoRaw", 100), ("AckLimitRaw", 10)),
    "MEAL_Announce": (("CarbsEst", 120), ("MealId", 77)),
    "PUMP_BasalCmd": (("InsulinRate", 20), ("BasalCmdSeq", 3), ("BasalUntilStep", 100)),
    "PUMP_BolusCmd": (("BolusId", 5), ("InsulinBolus", 10), ("BolusUntilStep", 1)),
}  # fmt: skip
"""Signals worth forging, and physical values."""

_ADAPTER: TypeAdapter[Any] = TypeAdapter(AnyFault)


class Found(NamedTuple):
    """A failure: the case as drawn, what is left of it, and the verdict on that."""

    number: int
    drawn: Probe
    left: Probe
    verdict: Verdict


# ---- drawing


def case(seed: int, index: int, modes: Sequence[str] = tuple(MODES), patients: Sequence[str] | None = None) -> Probe:
    """Case `index` of a seed."""
    rng = random.Random(f"{seed}/{index}")
    scenario, hours = rng.choice(
        (("six-hours", 6.0), ("six-hours", 6.0), ("validation-14d", 24.0), ("camerlingo", 24.0))
    )
    return Probe(
        patient=rng.choice(list(patients or cohort())),
        mode=rng.choice(list(modes)),
        seed=rng.randrange(1, 1000),
        scenario=scenario,
        hours=hours,
        faults=tuple(_draw(rng, hours) for _ in range(rng.choice((1, 1, 2, 2, 3, FAULTS_AT_MOST)))),
    )


def _draw(rng: random.Random, hours: float) -> Any:
    """A fault: any kind, anywhere in the run, with keys that fit."""
    while True:
        kind = rng.choice(list(make.KINDS))
        begin = rng.randrange(1, round(hours * 12))  # steps; the first one belongs to the start of the run
        length = rng.choice((1, 2, 3, 4, 6, 8, 12, 24, 48))
        keys = {"kind": kind, "start": clock(begin * STEP_SECONDS), **_KEYS.get(kind, _frame_keys)(rng)}
        if "end" in make.KINDS[kind].model_fields and kind not in ENDLESS:
            keys["end"] = clock((begin + length) * STEP_SECONDS)
        try:
            return _ADAPTER.validate_python(keys)
        except ValidationError:  # e.g. a signal the message does not have: draw again
            continue


def _frame_keys(rng: random.Random) -> dict[str, Any]:
    keys: dict[str, Any] = {"message": rng.choice(TRAFFIC)}
    choice = rng.randrange(6)
    if choice == 0:
        keys["probability"] = rng.choice((0.1, 0.3, 0.5, 0.9))
    elif choice == 1:
        keys["every"] = rng.choice((2, 3, 5))
    elif choice == 2:
        keys["count"] = rng.choice((1, 2, 3, 16))
    return keys


def _value_keys(rng: random.Random) -> dict[str, Any]:
    message = rng.choice(list(VALUES))
    signal, value = rng.choice(VALUES[message])
    return _frame_keys(rng) | {"message": message, "signal": signal, "value": value}


def _masquerade_keys(rng: random.Random) -> dict[str, Any]:
    message = rng.choice(list(VALUES))
    return _frame_keys(rng) | {"message": message, "values": dict([rng.choice(VALUES[message])])}


def _none(rng: random.Random) -> dict[str, Any]:
    return {}


def _drug(rng: random.Random) -> dict[str, Any]:
    return {"drug": rng.choice(("insulin", "pramlintide"))}


_KEYS: dict[str, Callable[[random.Random], dict[str, Any]]] = {
    "delay": lambda rng: _frame_keys(rng) | rng.choice(({"steps": rng.choice((1, 2, 3, 5))}, {"ms": 20})),
    "duplicate": lambda rng: _frame_keys(rng) | {"times": rng.choice((1, 2, 16))},
    "reorder": lambda rng: {"message": rng.choice(TRAFFIC), "every": rng.choice((2, 3))},
    "replay": lambda rng: _frame_keys(rng) | {"back": rng.choice((1, 2, 4, 16))},
    "flip_bits": lambda rng: _frame_keys(rng) | {"random": rng.choice((1, 2, 5)), "repair_crc": rng.random() < 0.5},
    "set_value": lambda rng: _value_keys(rng) | {"repair_crc": rng.random() < 0.7},
    "stuck_value": lambda rng: {key: value for key, value in _value_keys(rng).items() if key != "value"},
    "wrong_length": lambda rng: _frame_keys(rng) | {"length": rng.randrange(9)},
    "misroute": lambda rng: _frame_keys(rng) | {"onto": rng.choice(TRAFFIC)},
    "masquerade": _masquerade_keys,
    "babble": lambda rng: (
        rng.choice(({"message": rng.choice(TRAFFIC)}, {"id": rng.randrange(2048)}))
        | {"frames": rng.choice((1, 10, 100, 600)), "side": rng.choice(("device", "plant"))}
    ),
    "foreign_id": lambda rng: {"side": rng.choice(("device", "plant"))},
    "error_frames": lambda rng: {"frames": rng.choice((1, 50))},
    "bus_off": _none,
    "clock_jump": lambda rng: {"seconds": rng.choice((-86400, -3600, -300, 61, 300, 3600, 86400))},
    "clock_drift": lambda rng: {"ppm": rng.choice((-50_000, 10_000, 100_000))},
    "day_change": lambda rng: {"days": rng.choice((-1, 1, 30))},
    "restart": lambda rng: (
        {"memory": rng.choice(("kept", "kept", "torn", "lost"))}
        | rng.choice(({}, {}, {"after_frames": rng.randrange(8)}))
    ),
    "kill": _none,
    "hang": _none,
    "slow_task": lambda rng: {"task": rng.randrange(7), "work": rng.choice((10, 1000))},
    "occlusion": lambda rng: _drug(rng) | {"lost": rng.random() < 0.5},
    "air_bubble": lambda rng: _drug(rng) | {"strokes": rng.choice((1, 20, 200))},
    "empty_reservoir": _drug,
    "low_battery": lambda rng: {"percent": rng.choice((0, 1, 15))},
    "missed_strokes": lambda rng: _drug(rng) | {"every": rng.choice((1, 2, 10))},
    "double_strokes": lambda rng: _drug(rng) | {"every": rng.choice((1, 2, 10))},
    "slow_motor": lambda rng: _drug(rng) | {"strokes_per_30s": rng.choice((1, 3))},
    "lag": lambda rng: {"minutes": rng.choice((5, 20, 60))},
    "compression_low": lambda rng: {"depth": rng.choice((0.2, 0.4, 0.8))},
    "bias": lambda rng: {"gain": rng.choice((0.6, 0.8, 1.2, 1.5)), "offset": rng.choice((-30, 0, 30))},
    "drift": lambda rng: {"offset_per_hour": rng.choice((-40, -10, 10, 40))},
    "noise": lambda rng: {"sd": rng.choice((5, 20, 60))},
    "stuck": _none,
    "state": lambda rng: {"state": rng.choice(("Warmup", "SensorFault", "BelowRange", "AboveRange"))},
    "drop_out": lambda rng: {"probability": rng.choice((0.1, 0.5, 0.9))},
    "replacement": _none,
}
"""Keys of a kind but for its window; those not named take a message only."""


# ---- shrinking


def shrink(
    probe: Probe, verdict: Verdict, judged: Callable[[Probe], Verdict] = judge, tries: int = SHRINK_AT_MOST
) -> tuple[Probe, Verdict]:
    """The smallest case near this one that fails in the same way.

    Args:
        probe: a case that fails.
        verdict: on it.
        judged: gives verdicts.
        tries: runs at most.

    Returns:
        What is left, and the verdict on it; the case itself if nothing can go.
    """
    wanted = _way(verdict)
    left = tries
    progress = True
    while progress and left > 0:
        progress = False
        for smaller in _smaller(probe, verdict):
            if left == 0:
                break
            left -= 1
            found = judged(smaller)
            if _way(found) & wanted:
                probe, verdict, progress = smaller, found, True
                break
    return probe, verdict


def _way(verdict: Verdict) -> frozenset[str]:
    """In which ways a run failed."""
    return frozenset(verdict.hazards) | ({verdict.error.partition(":")[0]} if verdict.error else set())


def _smaller(probe: Probe, verdict: Verdict) -> Iterator[Probe]:
    """Cases a little smaller than this one, the greatest gain first."""
    for index in range(len(probe.faults)):
        if len(probe.faults) > 1:
            yield probe._replace(faults=probe.faults[:index] + probe.faults[index + 1 :])
    if verdict.first is not None:
        hours = max(round((verdict.first[0] + 2) / 12, 2), 1.0)
        if hours < probe.hours:
            yield probe._replace(hours=hours)
    if probe.hours > 1:
        yield probe._replace(hours=max(round(probe.hours / 2, 2), 1.0))
    for index, fault in enumerate(probe.faults):
        for plainer in _plainer(fault):
            yield probe._replace(faults=(*probe.faults[:index], plainer, *probe.faults[index + 1 :]))
    for plain in ({"scenario": "fasting"}, {"patient": "adult#001"}, {"seed": 1}, {"mode": "nma"}):
        if any(getattr(probe, name) != value for name, value in plain.items()):
            yield probe._replace(**plain)


def _plainer(fault: Any) -> Iterator[Any]:
    """The fault with a shorter window, or with one key left out."""
    keys = fault.model_dump(mode="json", exclude_defaults=True) | {"kind": fault.kind}
    end = getattr(fault, "end", None)
    if end is not None and end - fault.start > STEP_SECONDS:
        middle = (fault.start + end) // 2 // STEP_SECONDS * STEP_SECONDS
        for narrower in ({"end": clock(middle)}, {"start": clock(middle)}):
            yield from _valid(keys | narrower)
    for name in keys:
        if name not in ("kind", "start", "end", "message"):
            yield from _valid({key: value for key, value in keys.items() if key != name})


def _valid(keys: dict[str, Any]) -> Iterator[Any]:
    try:
        yield _ADAPTER.validate_python(keys)
    except ValidationError:
        return


# ---- keeping


def as_test(found: Found, seed: int) -> str:
    """A test file that fails as long as what was found is there."""
    probe, verdict = found.left, found.verdict
    if verdict.first is not None:
        what = f"{verdict.first[1]} at {clock(verdict.first[0] * STEP_SECONDS)}"
    else:
        what = verdict.error or "nothing"
    lines = ",\n".join(f"            {call(fault)}" for fault in probe.faults)
    return f'''"""Found by `pumpbench hunt --seed {seed}`, case {found.number}: {what}."""

from pumpbench import faults


def test_seed_{seed}_case_{found.number}(bench):
    outcome = bench.run(
        patient="{probe.patient}",
        strategy="{probe.mode}",
        seed={probe.seed},
        scenario="{probe.scenario}",
        hours={probe.hours:g},
        faults=[
{lines},
        ],
    )
    outcome.assert_no_hazards()
    outcome.assert_ledger_closes()
'''


class Log:
    """The verdicts of a hunt, a line each, as they come: what was judged is not judged again."""

    def __init__(self, folder: Path, heading: dict[str, Any]) -> None:
        """Open or go on.

        Raises:
            HuntError: the folder holds another hunt, or a line that is none.
        """
        self._path = folder / CASES
        self.done: dict[int, dict[str, Any]] = {}
        if self._path.exists():
            self._read(heading)
        if not self._path.exists() or not self._path.stat().st_size:
            folder.mkdir(parents=True, exist_ok=True)
            self._append(heading)

    def _read(self, heading: dict[str, Any]) -> None:
        text = self._path.read_text(encoding="utf-8")
        whole = text[: text.rfind("\n") + 1]
        if whole != text:  # the last line was cut off, and the next one must not be written behind it
            write_file(self._path, whole.encode())
        for number, line in enumerate(whole.splitlines(), 1):
            try:
                entry = json.loads(line)
            except ValueError:
                raise HuntError(f"{self._path}:{number}: not a verdict: {line[:60]!r}") from None
            if number == 1 and entry != heading:
                raise HuntError(f"{self._path} is of another hunt ({entry}); choose another --out")
            if number > 1 and isinstance(entry, dict) and "case" in entry:
                self.done[entry["case"]] = entry

    def _append(self, entry: dict[str, Any]) -> None:
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry) + "\n")

    def add(self, index: int, verdict: Verdict) -> None:
        """Note a verdict."""
        entry = {"case": index, "hazards": verdict.hazards, "error": verdict.error, "injected": verdict.injected,
                 "low": verdict.low, "high": verdict.high}  # fmt: skip
        self.done[index] = entry
        self._append(entry)


class HuntError(ValueError):
    """A hunt that cannot go on; the text says why."""


def keep(found: Found, seed: int, folder: Path) -> Path:
    """Write the test of a failure; returns its file."""
    path = folder / f"test_hunt_{seed}_{found.number}.py"
    write_file(path, as_test(found, seed).encode())
    return path


# ---- a hunt


class Settings(NamedTuple):
    """A hunt as asked for.

    Attributes:
        out: folder of the verdicts and of the tests.
        runs: cases, from number 0 on.
        seed: of everything that is drawn.
        modes: to draw from.
        jobs: processes.
        bus, firmware: of every run.
        max_low, max_high: minutes below 54 and above 250 mg/dL, more than the twin, that are a failure; None: none are.
    """

    out: Path
    runs: int
    seed: int = 1
    modes: tuple[str, ...] = tuple(MODES)
    jobs: int = 1
    bus: str = "inproc"
    firmware: str | None = None
    max_low: float | None = None
    max_high: float | None = None


class Result(NamedTuple):
    """What a hunt came to."""

    runs: int
    injected: int
    failed: int
    lowest: list[tuple[int, float]]  # case and minutes below 54 mg/dL more than its twin, the worst first
    highest: list[tuple[int, float]]


WORST = 5


def run(
    settings: Settings,
    told: Callable[[int, int], None] = lambda done, total: None,
    caught: Callable[[Found, Path], None] = lambda found, path: None,
) -> Result:
    """Judge the cases that were not judged yet, shrink what fails, keep it.

    Args:
        settings: of the hunt.
        told: called with cases done and their number.
        caught: called with every failure and its test.

    Raises:
        HuntError: the folder holds another hunt.
    """
    limits = {"max_low": settings.max_low, "max_high": settings.max_high}
    heading = {"seed": settings.seed, "modes": list(settings.modes), "bus": settings.bus,
               "firmware": settings.firmware, **limits}  # fmt: skip
    log = Log(settings.out, heading)
    open_cases = [index for index in range(settings.runs) if index not in log.done]
    already = settings.runs - len(open_cases)
    probes = [
        case(settings.seed, index, settings.modes)._replace(bus=settings.bus, firmware=settings.firmware)
        for index in open_cases
    ]
    judged = functools.partial(_judge_within, settings.max_low, settings.max_high)
    verdicts = in_parallel(judged, probes, settings.jobs, lambda done: told(already + done, settings.runs))
    for index, probe, verdict in zip(open_cases, probes, verdicts, strict=True):
        if verdict.failed:
            found = Found(index, probe, *shrink(probe, verdict, judged))
            caught(found, keep(found, settings.seed, settings.out))
        log.add(index, verdict)  # after its test is kept: what was cut off in between is judged again
    return _result([log.done[index] for index in range(settings.runs)])


def _judge_within(max_low: float | None, max_high: float | None, probe: Probe) -> Verdict:
    verdict = judge(probe, signs=False)
    over = [
        f"{minutes:g} min {what} mg/dL"
        for minutes, limit, what in ((verdict.low, max_low, "below 54"), (verdict.high, max_high, "above 250"))
        if limit is not None and minutes > limit
    ]
    return verdict._replace(error=f"Outcome: {', '.join(over)}") if over and not verdict.error else verdict


def _result(entries: Sequence[dict[str, Any]]) -> Result:
    def worst(name: str) -> list[tuple[int, float]]:
        ranked = sorted(entries, key=lambda entry: -entry[name])[:WORST]
        return [(entry["case"], entry[name]) for entry in ranked if entry[name] > 0]

    return Result(
        len(entries),
        sum(entry["injected"] for entry in entries),
        sum(bool(entry["hazards"] or entry["error"]) for entry in entries),
        worst("low"),
        worst("high"),
    )
