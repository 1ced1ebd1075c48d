"""simglucose beside our virtual patient: the same adults, the same day, each in a Python of its own.

simglucose 0.2.11 (MIT) has the equations and the adults that `plant_server.physiology` started from. In these figures
the "ceiling" is not what the machine could do but the peer:

- `plant/vs-simglucose`: patient-days per second, ours in calls of one sampling interval as the bench makes them; the
  ceiling is simglucose's `T1DPatient.step` over the same days, measured in turn with ours; ratio = ours / theirs.
- `plant/vs-simglucose/error`: the greatest difference in plasma or subcutaneous glucose at any 5-min sample of those
  days, mg/dL; the ceiling is what we allow, `ALLOWED_ERROR`; ratio = value / ceiling.

What has to be made equal for that comparison, because the two differ by design: simglucose lets the size of a meal
grow while it is eaten, 5 g/min (the bench knows it when the meal starts); its insulin is U per minute (ours U per
30 s); its adults start at their own basal glucose, from rounded steady states (so we start from its numbers).

It is installed once, by pip, into `$PUMPBENCH_CACHE/simglucose` (else below `$XDG_CACHE_HOME/pumpbench`, else
`~/.cache/pumpbench`); it needs Python 3.11, as it does not import on later ones. Where it cannot be had, `compare` says
so in one line and gives no figures.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from plant_server import physiology
from plant_server.mechanism import SUBSTEPS
from plant_server.physiology import states as st
from pumpbench.benchmark.figure import Figure

VERSION: Final = "0.2.11"
REQUIREMENTS: Final = (f"simglucose=={VERSION}", "gym==0.9.4", "setuptools<81", "numpy<3", "pandas<4", "scipy<2")
"""What pip is asked for; pkg_resources, which simglucose imports, is certain only before setuptools 81."""

PYTHON: Final = (3, 11)
ALLOWED_ERROR: Final = 0.05  # mg/dL
ADULTS: Final = ("adult#001", "adult#006", "adult#009")

MINUTES: Final = 1440
EACH_MINUTES: Final = 5
EATING_G_PER_MIN: Final = 5.0
MEALS: Final = {7 * 60: 48.0, 10 * 60 + 30: 12.5, 13 * 60: 73.0, 13 * 60 + 30: 20.0, 19 * 60: 85.0}
"""Minute -> g: some not a multiple of what is eaten in a minute, some into a stomach that is not empty."""

_DAY: Final = Path(__file__).with_name("simglucose_day.py")
_COMPLETE: Final = "pumpbench-complete.json"
_INSTALL_SECONDS: Final = 900.0
_DAY_SECONDS: Final = 300.0

# simglucose's order of its thirteen states
_STATES: Final = (
    *(st.Q_STO1, st.Q_STO2, st.Q_GUT, st.GP, st.GT, st.IP, st.X, st.I1, st.XL, st.IL, st.ISC1, st.ISC2, st.GS),
)

Array = npt.NDArray[np.float64]


class PeerError(RuntimeError):
    """simglucose cannot be had, or did not do its day; the text is one line."""


class Day(NamedTuple):
    """What happens to a patient in one day, minute by minute."""

    carbs_g: Array  # announced; eaten 5 g/min
    insulin_u: Array


class Trace(NamedTuple):
    """What came of it: seconds it took, and glucose (mg/dL) each 5 min from minute 0."""

    seconds: float
    state: list[float]
    plasma: list[float]
    subcutaneous: list[float]


# ---- its environment


def cache_directory(environment: Mapping[str, str] = os.environ) -> Path:
    """Where simglucose's environment is, or goes."""
    if environment.get("PUMPBENCH_CACHE"):
        return Path(environment["PUMPBENCH_CACHE"]) / "simglucose"
    return Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "pumpbench" / "simglucose"


def find_python() -> str:
    """A Python on which simglucose works.

    Raises:
        PeerError: there is none.
    """
    if sys.version_info[:2] == PYTHON:
        return sys.executable
    found = shutil.which("python{}.{}".format(*PYTHON))
    if found is None:
        raise PeerError("it needs Python {}.{}, and there is none on the PATH".format(*PYTHON))
    return found


def environment_python(place: Path | None = None) -> Path:
    """The Python of simglucose's environment, which is made if it is not there yet.

    The environment is built beside its place and moved there when it is complete, so that what is there can be used.

    Raises:
        PeerError: it could not be made.
    """
    place = place or cache_directory()
    if _is_complete(place):
        return _python_of(place)
    base = find_python()
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        building = Path(tempfile.mkdtemp(prefix=f"{place.name}-", dir=place.parent))
    except OSError as error:
        raise PeerError(f"cannot write to {place.parent}: {error.strerror}") from error
    try:
        _command([base, "-m", "venv", str(building)], _INSTALL_SECONDS)
        pip = [str(_python_of(building)), "-m", "pip", "install", "--quiet", "--no-input", "--retries", "1"]
        _command([*pip, "--disable-pip-version-check", *REQUIREMENTS], _INSTALL_SECONDS)
        _command([str(_python_of(building)), "-c", "import simglucose.patient.t1dpatient"], _DAY_SECONDS)
        (building / _COMPLETE).write_text(json.dumps(REQUIREMENTS), encoding="utf-8")
        _move(building, place)
    except OSError as error:
        raise PeerError(f"cannot write to {place.parent}: {error.strerror}") from error
    finally:
        shutil.rmtree(building, ignore_errors=True)
    return _python_of(place)


def _python_of(place: Path) -> Path:
    return place / "bin" / "python"


def _is_complete(place: Path) -> bool:
    with suppress(OSError, ValueError):
        made_for = json.loads((place / _COMPLETE).read_text(encoding="utf-8"))
        return bool(made_for == list(REQUIREMENTS) and _python_of(place).exists())
    return False


def _move(building: Path, place: Path) -> None:
    """Put a complete environment in place; one that another process has put there meanwhile is as good."""
    for _ in range(3):
        try:
            building.rename(place)
        except OSError:
            if _is_complete(place):
                return
            # an old or broken one: out of the way first, so that nobody sees half of it
            aside = Path(tempfile.mkdtemp(prefix=f"{place.name}-old-", dir=place.parent))
            with suppress(OSError):
                place.rename(aside / place.name)
            shutil.rmtree(aside, ignore_errors=True)
        else:
            return
    raise PeerError(f"cannot put its environment at {place}")


def _command(command: list[str], seconds: float, text: str | None = None) -> str:
    """Run a command of the peer's, away from our own environment; returns its output."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    try:
        done = subprocess.run(
            command,
            input=text,
            stdin=subprocess.DEVNULL if text is None else None,
            capture_output=True,
            text=True,
            env=environment,
            timeout=seconds,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise PeerError(f"{_what(command)} took more than {seconds:g} s") from None
    except OSError as error:
        raise PeerError(f"{_what(command)} cannot be started: {error.strerror}") from error
    if done.returncode:
        said = (done.stderr.strip() or done.stdout.strip() or f"status {done.returncode}").splitlines()
        errors = [line for line in said if line.startswith("ERROR")]
        raise PeerError(f"{_what(command)} failed: {(errors or said)[-1].strip()}")
    return done.stdout


def _what(command: list[str]) -> str:
    return {"-m": f"python {' '.join(command[1:3])}", "-c": "its import"}.get(command[1], "its day")


# ---- the day, here and there


def a_day(basal_u_per_h: float, carb_ratio_g_per_u: float, meals: Mapping[int, float] = MEALS) -> Day:
    """Meals with a bolus each, one minute long, on a basal rate that changes every half hour.

    Args:
        basal_u_per_h: insulin that holds the patient.
        carb_ratio_g_per_u: grams covered by one unit.
        meals: minute of the day -> grams.
    """
    carbs = np.zeros(MINUTES)
    half_hours = np.arange(MINUTES) // 30
    insulin = basal_u_per_h / 60.0 * (1.0 + 0.3 * np.sin(1.7 * half_hours))
    for minute, grams in meals.items():
        carbs[minute] += grams
        insulin[minute] += grams / carb_ratio_g_per_u
    return Day(carbs, insulin)


def eaten(carbs_g: Array) -> Array:
    """Grams eaten in each minute: what was announced, 5 g/min, as simglucose does it."""
    out = np.zeros_like(carbs_g)
    left = 0.0
    for minute, announced in enumerate(carbs_g):
        left += announced
        out[minute] = min(EATING_G_PER_MIN, left)
        left = max(0.0, left - out[minute])
    return out


def our_trace(patient: physiology.Patient, day: Day, state: list[float]) -> Trace:
    """The day with our equations and integration, from simglucose's initial state and by its meal rule."""
    p = patient.params
    x = patient.x0.copy()
    x[list(_STATES)] = state
    grams = eaten(day.carbs_g)
    plasma, subcutaneous = [physiology.glucose(x, p)], [physiology.interstitial(x, p)]
    steps = round(1.0 / physiology.STEP_MIN)
    nothing = np.zeros(steps)
    before = so_far = 0.0
    started = time.perf_counter()
    for minute in range(len(grams)):
        if grams[minute] > 0.0:
            if minute == 0 or grams[minute - 1] == 0.0:
                before, so_far = physiology.q_sto(x, p), 0.0
            so_far += grams[minute]
            x[st.D] = before + 1000.0 * so_far
        insulin = np.full(steps, day.insulin_u[minute] / steps)
        carbs = np.full(steps, 1000.0 * grams[minute] / steps)
        physiology.advance(x, p, float(minute), insulin, nothing, carbs)
        if (minute + 1) % EACH_MINUTES == 0:
            plasma.append(physiology.glucose(x, p))
            subcutaneous.append(physiology.interstitial(x, p))
    return Trace(time.perf_counter() - started, state, plasma, subcutaneous)


def our_rate(patient: physiology.Patient, day: Day, days: int) -> float:
    """Patient-days per second of ours over `days` such days, in calls of one sampling interval."""
    p = patient.params
    x = patient.x0.copy()
    per_minute = round(1.0 / physiology.STEP_MIN)
    insulin = np.repeat(day.insulin_u / per_minute, per_minute).reshape(-1, SUBSTEPS)
    carbs = np.repeat(1000.0 * eaten(day.carbs_g) / per_minute, per_minute).reshape(-1, SUBSTEPS)
    nothing = np.zeros(SUBSTEPS)
    announced = 1000.0 * day.carbs_g.reshape(len(insulin), -1).sum(axis=1)
    minutes = SUBSTEPS * physiology.STEP_MIN
    started = time.perf_counter()
    for _ in range(days):
        for call in range(len(insulin)):
            if announced[call]:
                physiology.begin_meal(x, p, announced[call])
            physiology.advance(x, p, call * minutes, insulin[call], nothing, carbs[call])
    return days / (time.perf_counter() - started)


def their_trace(python: Path, name: str, day: Day) -> Trace:
    """The day with simglucose, in its own process.

    Raises:
        PeerError: it failed.
    """
    asked = {"patient": name, "carbs_g": day.carbs_g.tolist(), "insulin_u": day.insulin_u.tolist()}
    text = _command([str(python), str(_DAY)], _DAY_SECONDS, json.dumps(asked))
    try:
        return Trace(**json.loads(text))
    except (TypeError, ValueError):
        raise PeerError(f"its day gave no trace: {text[:60]!r}") from None


def difference(ours: Trace, theirs: Trace) -> float:
    """The greatest difference in glucose, mg/dL."""
    return max(
        float(np.abs(np.subtract(ours.plasma, theirs.plasma)).max()),
        float(np.abs(np.subtract(ours.subcutaneous, theirs.subcutaneous)).max()),
    )


# ---- the figures


def compare(
    *, runs: int = 3, days: int = 100, say: Callable[[str], None] = lambda line: print(line, file=sys.stderr)
) -> list[Figure]:
    """Both figures, over as many of `ADULTS` as there are runs; none, and one line to `say`, without simglucose."""
    try:
        python = environment_python()
        rates, peer_rates, errors = [], [], []
        for name in ADULTS[: max(1, runs)]:
            patient = physiology.load_patient(name, basal_glucose=None)
            day = a_day(patient.basal_u_per_h, patient.carb_ratio_g_per_u)
            our_rate(patient, day, 1)
            rates.append(our_rate(patient, day, days))
            theirs = their_trace(python, name, day)
            peer_rates.append(1.0 / theirs.seconds)
            errors.append(difference(our_trace(patient, day, theirs.state), theirs))
    except PeerError as error:
        say(f"no figures beside simglucose: {error}")
        return []
    return [speed_figure(rates, peer_rates), error_figure(errors)]


def speed_figure(rates: list[float], peer_rates: list[float]) -> Figure:
    """Ours beside simglucose's, medians."""
    value, ceiling = median(rates), median(peer_rates)
    return Figure(
        name="plant/vs-simglucose",
        value=round(value, 2),
        unit="patient-days/s",
        ceiling=round(ceiling, 4),
        ratio=round(value / ceiling, 3),
        runs=len(rates),
    )


def error_figure(errors: list[float]) -> Figure:
    """The greatest of the differences beside what is allowed."""
    value = max(errors)
    return Figure(
        name="plant/vs-simglucose/error",
        value=float(f"{value:.3g}"),
        unit="mg/dL",
        ceiling=ALLOWED_ERROR,
        ratio=float(f"{value / ALLOWED_ERROR:.3g}"),
        runs=len(errors),
    )
