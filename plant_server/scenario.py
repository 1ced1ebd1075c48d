"""Scenarios: who eats what and when. Built in, or from a YAML or CSV file of one's own."""

import csv
import functools
import io
from pathlib import Path
from typing import Annotated, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from can_bus import yaml_file

DIRECTORY = Path(__file__).with_name("scenarios")

MINUTES_PER_DAY = 1440
SAMPLE_MINUTES = 5

EATING_MINUTES = 15
"""A meal is eaten at a constant rate over this time (default of the T1DMS simulator)."""


class ScenarioError(ValueError):
    """A scenario that does not exist or cannot be read; the text names the place and what was expected."""


class MealEntry(BaseModel):
    """One line of a scenario file."""

    model_config = ConfigDict(extra="forbid", str_strip_whitespace=True)

    day: Annotated[int, Field(ge=1, le=3650, description="1 is the first day")]
    type: Annotated[str, Field(pattern=r"^(Breakfast|Lunch|Dinner|Snack)$")]
    time: Annotated[str, Field(pattern=r"^([01]?\d|2[0-3]):[0-5]\d$", description="hh:mm")]
    carbs: Annotated[float, Field(gt=0, le=500, description="g")]

    @property
    def minute(self) -> int:
        """Minutes since the scenario's start."""
        hours, minutes = self.time.split(":")
        return (self.day - 1) * MINUTES_PER_DAY + int(hours) * 60 + int(minutes)


class ScenarioFile(BaseModel):
    """The layout of a scenario file in YAML."""

    model_config = ConfigDict(extra="forbid")

    meals: list[MealEntry]
    days: Annotated[int, Field(ge=1, le=3650)] | None = None


class Meal(NamedTuple):
    """A meal: the sampling instant it starts at, its kind, carbohydrate in g."""

    step: int
    kind: str
    carbs_g: float


class Scenario(NamedTuple):
    """Meals in order of time, over `days` days."""

    name: str
    days: int
    meals: tuple[Meal, ...]

    def meals_by_step(self) -> dict[int, list[Meal]]:
        """The meals that start at each sampling instant."""
        table: dict[int, list[Meal]] = {}
        for meal in self.meals:
            table.setdefault(meal.step, []).append(meal)
        return table


@functools.cache
def built_in() -> tuple[str, ...]:
    """Names of the scenarios that come with the package."""
    return ("fasting", *sorted(path.stem for path in DIRECTORY.glob("*.csv")))


def load_scenario(name: str) -> Scenario:
    """A built-in scenario by name, or one from a file.

    Args:
        name: `validation-14d` (Pons Torres et al. 2025, supplement, Table 2), `fasting`, or a path to a .yaml or .csv
            file with the columns day, type, time, carbs (or cho_g).

    Raises:
        ScenarioError: no such scenario or file, or a wrong entry in it.
    """
    if name == "fasting":
        return Scenario("fasting", 3650, ())
    if name in built_in():
        return _from_csv(DIRECTORY / f"{name}.csv", name)
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        return _from_yaml(path)
    if path.suffix == ".csv":
        return _from_csv(path, path.stem)
    raise ScenarioError(
        f"there is no scenario {name!r}; choose one of {', '.join(built_in())}, or give a .yaml or .csv file"
    )


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"cannot read the scenario {path}: {error}") from error


def _from_yaml(path: Path) -> Scenario:
    try:
        parsed = yaml_file.load(path, ScenarioFile)
    except yaml_file.FileError as error:
        raise ScenarioError(str(error)) from error
    return _scenario(path.stem, parsed.meals, parsed.days)


def _from_csv(path: Path, name: str) -> Scenario:
    rows = csv.DictReader(io.StringIO(_read(path)))
    entries = []
    for row in rows:
        place = f"{path}:{rows.line_num}"
        if "cho_g" in row:
            row["carbs"] = row.pop("cho_g")
        try:
            entries.append(MealEntry.model_validate(row))
        except ValidationError as error:
            first = error.errors()[0]
            raise ScenarioError(f"{place}: {first['loc'][0]}: {first['msg']} (found {first['input']!r})") from error
    return _scenario(name, entries, None)


def _scenario(name: str, entries: list[MealEntry], days: int | None) -> Scenario:
    meals = sorted(
        (Meal(round(entry.minute / SAMPLE_MINUTES), entry.type, entry.carbs) for entry in entries),
        key=lambda meal: meal.step,
    )
    last = max((entry.day for entry in entries), default=1)
    return Scenario(name, max(days or last, last), tuple(meals))
