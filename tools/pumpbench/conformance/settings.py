"""The thresholds of the requirements that are choices of this project: one file, which a user can replace."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from can_bus import yaml_file

DEFAULT = Path(__file__).with_name("settings.yaml")
"""It says what each value means, with its unit."""


class Group(BaseModel):
    """Values of one group of requirements; all of them have to be there."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Sensor(Group):
    """SEN."""

    raise_age: int = Field(ge=0, le=6)
    low: int = Field(ge=0, le=100)
    high: int = Field(ge=400, le=800)
    jump: int = Field(gt=0)
    stuck: int = Field(ge=2, le=100)
    gap: int = Field(ge=0)
    settle: int = Field(ge=1)
    noise: int = Field(ge=0, le=125)
    low_factor: float = Field(ge=1)
    low_extra: float = Field(ge=0, le=100)


class E2e(Group):
    """E2E."""

    max_lost: int = Field(ge=0, le=14)
    window: int = Field(ge=2, le=14)
    errors: int = Field(ge=1)
    timeout: int = Field(gt=0)


class Commands(Group):
    """CMD."""

    sends: int = Field(ge=1)
    bolus_expiry: int = Field(ge=1, le=63)
    rate_expiry: int = Field(ge=1, le=63)
    renew: int = Field(ge=1)
    unlike: int = Field(ge=1)


class Limits(Group):
    """LIM."""

    basal_factor: float = Field(gt=0)
    low: int = Field(ge=40)
    ahead: int = Field(gt=0)
    tdd_factor: float = Field(gt=0)
    pramlintide_day: int = Field(gt=0)
    lockout: int = Field(ge=0)
    rise: float = Field(gt=0)


class Ladder(Group):
    """FAL."""

    degraded: int = Field(ge=1)
    safe: int = Field(ge=2)
    up: int = Field(ge=1)
    alarms_apart: int = Field(ge=0)
    pump_silent: int = Field(gt=0)


class Alarms(Group):
    """ALM."""

    out_within: int = Field(ge=1)
    high: tuple[str, ...] = Field(min_length=1)
    medium: tuple[str, ...] = Field(min_length=1)
    urgent_low: int = Field(ge=40)
    again: int = Field(gt=0)
    suspended_again: int = Field(gt=0)
    occluded: float = Field(gt=0)
    reservoir_low: int = Field(gt=0)
    pramlintide_low: int = Field(gt=0)
    battery_low: int = Field(gt=0, le=100)


class Drugs(Group):
    """TWO."""

    pramlintide_low: int = Field(ge=40)


class Time(Group):
    """TIM."""

    clock: int = Field(ge=0)
    caution: int = Field(ge=0)


class Reset(Group):
    """RST."""

    resets: int = Field(ge=2)
    iob_hold: int = Field(gt=0)


class Start(Group):
    """STA."""

    samples: int = Field(ge=1)


class User(Group):
    """USR."""

    carbs: int = Field(gt=0)
    offset: int = Field(ge=0, le=127)


class Diagnostics(Group):
    """DIA."""

    history: int = Field(gt=0)


class Settings(BaseModel):
    """All groups."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sensor: Sensor
    e2e: E2e
    commands: Commands
    limits: Limits
    ladder: Ladder
    alarms: Alarms
    drugs: Drugs
    time: Time
    reset: Reset
    start: Start
    user: User
    diagnostics: Diagnostics


def load(path: Path = DEFAULT) -> Settings:
    """Read a file of settings.

    Raises:
        FileError: it is missing, or says something wrong; with file, line and what was expected.
    """
    return yaml_file.load(path, Settings)
