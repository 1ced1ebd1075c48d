"""Scenarios: who eats what and when, and what is told of it. Built in, or from a YAML or CSV file of one's own."""

import csv
import difflib
import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, model_validator

from can_bus import yaml_file
from can_bus.lockstep import STEPS_PER_DAY

from .scenarios.announcements import (
    Announcement,
    Kind,
    Policy,
    announcements,
    policy_of,
    rescue_announcement,
)
from .scenarios.announcing import Announcing
from .scenarios.camerlingo import camerlingo
from .scenarios.meals import MINUTES_PER_DAY, RESCUE, Meal, Scenario, planned
from .scenarios.misestimation import Kawamura
from .scenarios.rescue import RESCUE_EATING_MINUTES, Rescue, Rescuer
from .scenarios.tuning import tuning

__all__ = [
    "EATING_MINUTES",
    "MINUTES_PER_DAY",
    "RESCUE",
    "RESCUE_EATING_MINUTES",
    "Announcement",
    "Announcing",
    "Kind",
    "Meal",
    "Policy",
    "Rescue",
    "Rescuer",
    "Scenario",
    "ScenarioError",
    "announcements",
    "built_in",
    "load_scenario",
    "policy_of",
    "rescue_announcement",
]

VALIDATION = Path(__file__).with_name("scenarios") / "validation-14d.csv"

EATING_MINUTES = 15
"""A meal is eaten at a constant rate over this time (default of the T1DMS simulator)."""

DAYS_MAX = 3650
"""Of scenarios without an end of their own."""

GENERATED_DAYS = 14
"""Length of a generated scenario when nobody says how long."""

BUILT_IN = ("fasting", "six-hours", "validation-14d", "tuning", "camerlingo")

SIX_HOURS = ((60.0, "Breakfast", 50.0), (180.0, "Snack", 20.0), (270.0, "Lunch", 60.0))
"""Minute of the day, type, g: three meals before 06:00, told exactly and in time, for tests of a few hours."""

COLUMNS = ("day", "type", "time", "cho_g")
"""Of a CSV file; `carbs` is another name for the last."""


class ScenarioError(ValueError):
    """A scenario that does not exist or cannot be read; the text names the place and what was expected."""


def _clock(value: Any) -> int:
    match = re.fullmatch(r"(\d{1,2}):([0-5]\d)", value.strip()) if isinstance(value, str) else None
    if match is None or int(match[1]) > 23:
        raise ValueError('a time is "hh:mm" in quotes, 00:00 to 23:59')
    return int(match[1]) * 60 + int(match[2])


class MealEntry(BaseModel):
    """One line of a scenario file."""

    model_config = ConfigDict(extra="forbid", str_strip_whitespace=True)

    day: Annotated[int, Field(ge=1, le=DAYS_MAX)]  # 1 is the first day
    type: Literal["Breakfast", "Lunch", "Dinner", "Snack"]
    time: Annotated[int, BeforeValidator(_clock)]  # minutes; "hh:mm" in a file
    carbs: Annotated[float, Field(gt=0, le=500)]  # g

    @property
    def minute(self) -> int:
        """Minutes since the scenario's start."""
        return (self.day - 1) * MINUTES_PER_DAY + self.time


class ScenarioFile(BaseModel):
    """The layout of a scenario file in YAML.

    Attributes:
        meals: the meals; or
        based_on: the built-in scenario whose meals and habits these are.
        days: length; at least the last meal's day, at most that of a scenario it is based on.
        announcements: habits of telling, by default exact and in time (or those of `based_on`).
        rescue: sugar against lows, by default none.
    """

    model_config = ConfigDict(extra="forbid")

    meals: list[MealEntry] | None = None
    based_on: str | None = None
    days: Annotated[int, Field(ge=1, le=DAYS_MAX)] | None = None
    announcements: Announcing | None = None
    rescue: Rescue | None = None

    @model_validator(mode="after")
    def _one_source(self) -> "ScenarioFile":
        if (self.meals is None) == (self.based_on is None):
            raise ValueError("give the meals, or based_on with the name of a built-in scenario")
        if self.based_on is not None and self.based_on not in BUILT_IN:
            raise ValueError(f"based_on is one of {', '.join(BUILT_IN)}, found {self.based_on!r}")
        return self


def built_in() -> tuple[str, ...]:
    """Names of the scenarios that come with the package."""
    return BUILT_IN


def load_scenario(name: str, *, seed: int = 1, patient: str = "", days: float | None = None) -> Scenario:
    """A built-in scenario by name, or one from a file.

    Args:
        name: `validation-14d` (Pons Torres et al. 2025, supplement, Table 2), `tuning` (the same paper's), `camerlingo`
            (a generator of everyday meals), `fasting`, or a path to a .yaml file with the keys of `ScenarioFile` or to
            a .csv file with the columns day, type, time, cho_g.
        seed: of the run, for meals that are drawn.
        patient: name of the virtual patient, likewise.
        days: to generate, for a scenario that has no length of its own; a longer one begins like a shorter one.

    Raises:
        ScenarioError: no such scenario or file, or a wrong entry in it.
    """
    if name in BUILT_IN:
        return _built_in(name, seed, patient, days)
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        return _from_yaml(path, seed, patient, days)
    if path.suffix == ".csv":
        return _from_csv(path, path.stem)
    near = difflib.get_close_matches(name, BUILT_IN, 1)
    hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(BUILT_IN)}, or give a .yaml or .csv file"
    raise ScenarioError(f"there is no scenario {name!r}; {hint}")


def _built_in(name: str, seed: int, patient: str, days: float | None) -> Scenario:
    if name == "fasting":
        return Scenario("fasting", DAYS_MAX, ())
    if name == "six-hours":
        length = 1 if days is None else max(math.ceil(days), 1)
        meals = [
            (day * MINUTES_PER_DAY + minute, kind, carbs) for day in range(length) for minute, kind, carbs in SIX_HOURS
        ]
        return Scenario("six-hours", length, planned(meals, length))
    if name == "tuning":
        return tuning(seed, patient)
    if name == "camerlingo":
        length = GENERATED_DAYS if days is None else max(math.ceil(days), 1)
        if length > DAYS_MAX:
            raise ScenarioError(f"scenario camerlingo has at most {DAYS_MAX} days, asked for {length}")
        return camerlingo(seed, patient, length)
    return _from_csv(VALIDATION, name)._replace(announcing=Announcing(estimate=Kawamura()))


def _from_yaml(path: Path, seed: int, patient: str, days: float | None) -> Scenario:
    try:
        parsed = yaml_file.load(path, ScenarioFile)
    except yaml_file.FileError as error:
        raise ScenarioError(str(error)) from error
    if parsed.based_on is not None:
        base = _built_in(parsed.based_on, seed, patient, parsed.days or days)
        length = parsed.days or base.days
        if length > base.days:
            raise ScenarioError(f"{path}: days: scenario {base.name} has {base.days} days, asked for {length}")
        meals = tuple(meal for meal in base.meals if meal.step < length * STEPS_PER_DAY)
        scenario = Scenario(path.stem, length, meals, base.announcing)
    else:
        scenario = _scenario(path.stem, parsed.meals or [], parsed.days)
    return scenario._replace(announcing=parsed.announcements or scenario.announcing, rescue=parsed.rescue)


def _from_csv(path: Path, name: str) -> Scenario:
    """Read a CSV file; lines that begin with # are comments."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"cannot read the scenario {path}: {error}") from error
    numbered = [(k, line) for k, line in enumerate(lines, 1) if line.strip() and not line.startswith("#")]
    table = [(k, [cell.strip() for cell in cells]) for k, line in numbered for cells in csv.reader([line])]
    expected = f"expected the columns {','.join(COLUMNS)}"
    if not table:
        raise ScenarioError(f"{path}: {expected}, found nothing")
    names = ["carbs" if cell == "cho_g" else cell for cell in table[0][1]]
    if sorted(names) != sorted(MealEntry.model_fields):
        raise ScenarioError(f"{path}:{table[0][0]}: {expected}, found {','.join(table[0][1])}")
    entries = []
    for number, cells in table[1:]:
        if len(cells) != len(names):
            raise ScenarioError(f"{path}:{number}: {expected}, found {len(cells)} cells: {','.join(cells)}")
        try:
            entries.append(MealEntry.model_validate(dict(zip(names, cells, strict=True))))
        except ValidationError as error:
            first = error.errors()[0]
            place = f"{path}:{number}: {first['loc'][0]}"
            text = first["msg"].removeprefix("Value error, ")
            raise ScenarioError(f"{place}: {text} (found {first['input']!r})") from error
    return _scenario(name, entries, None)


def _scenario(name: str, entries: list[MealEntry], days: int | None) -> Scenario:
    last = max((entry.day for entry in entries), default=1)
    length = max(days or last, last)
    return Scenario(name, length, planned([(entry.minute, entry.type, entry.carbs) for entry in entries], length))
