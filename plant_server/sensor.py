"""A continuous glucose sensor: the model of its error, what happens to it, its range and age, what it says of itself.

Everything random is drawn in advance for a whole run, from (seed, patient, purpose), so that all strategies meet the
same realisation. The models are in `sensors/`, one per file; what can happen to any of them is in
`sensors/effects.py`.
"""

import difflib
import itertools
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from can_bus import yaml_file
from can_bus.lockstep import STEP_MINUTES, STEPS_PER_DAY

from .sensors import MODELS, AnyModel, Wear
from .sensors.coloured import Coloured
from .sensors.effects import (
    EFFECTS,
    STATE_ABOVE_RANGE,
    STATE_BELOW_RANGE,
    STATE_OK,
    AnyEffect,
    Effect,
    Memory,
    Reading,
    Replacement,
    Stage,
    state_code,
)
from .streams import stream

__all__ = [
    "STATE_ABOVE_RANGE",
    "STATE_BELOW_RANGE",
    "STATE_OK",
    "Sample",
    "Sensor",
    "SensorError",
    "SensorSettings",
    "Status",
    "load_sensor",
]

STATUS_EVERY = 12
"""Instants between two CGM_Status (DBC: once an hour)."""

NUMBERS = 65535
"""CgmSampleSeq runs from 0 to 65534."""

SESSIONS = 255
"""CgmSessionId runs from 0 to 254."""


class SensorError(ValueError):
    """There is no such sensor, or its file is wrong; the text names the place and what was expected."""


class Sample(NamedTuple):
    """What the sensor says of one instant."""

    state: int  # CgmState
    glucose: float | None  # mg/dL; None: no number
    rate: float | None  # mg/dL per minute since the sample before; None: unknown
    number: int  # CgmSampleSeq


class Status(NamedTuple):
    """What the sensor says of itself."""

    fault_bits: int
    session: int  # another one after a replacement
    age_minutes: int  # since insertion
    noise: float  # mg/dL, standard deviation
    battery: float  # percent, of the transmitter
    dropped: int  # samples it failed to send since the start of the run


def _multiple(minutes: int) -> int:
    if minutes % STEP_MINUTES:
        raise ValueError(f"the bench's instants are {STEP_MINUTES} min apart; give a multiple")
    return minutes


def _range(value: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= value[0] < value[1] <= 800:
        raise ValueError("a range is [low, high] within 0 to 800 mg/dL")
    return value


class SensorSettings(BaseModel):
    """A sensor and what happens to it; the layout of a sensor file.

    Attributes:
        model: the error, see `sensors/`.
        sample_minutes: between two readings; a reading is sent when there is one, nothing in between.
        range: mg/dL that can be shown; beyond, the state is BelowRange or AboveRange.
        lifetime_days: of one sensor; by default the model's, for ever if it has none.
        renew: at the end of its life a new sensor is inserted, and a new battery; otherwise the state is Expired, and
            nothing is sent when the battery is empty.
        warmup_minutes: state Warmup after an insertion (the paper has none; a Dexcom G6 takes 120).
        worn_minutes: for how long the first sensor was worn before the run.
        battery_days: life of the transmitter's battery, which falls linearly.
        battery_percent: of that battery at the start.
        effects: see `sensors/effects.py`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    model: AnyModel = Coloured()
    sample_minutes: Annotated[int, Field(ge=STEP_MINUTES, le=60), AfterValidator(_multiple)] = STEP_MINUTES
    range: Annotated[tuple[float, float], AfterValidator(_range)] = (40.0, 400.0)
    lifetime_days: Annotated[float, Field(gt=0, le=3650)] | None = None
    renew: bool = True
    warmup_minutes: Annotated[int, Field(ge=0, le=24 * 60)] = 0
    worn_minutes: Annotated[int, Field(ge=0, le=365 * 24 * 60)] = 0
    battery_days: Annotated[float, Field(gt=0, le=3650)] = 90.0
    battery_percent: Annotated[float, Field(ge=0, le=100)] = 100.0
    effects: tuple[AnyEffect, ...] = ()

    @model_validator(mode="after")
    def _told_apart(self) -> "SensorSettings":
        for one, other in itertools.combinations(self.effects, 2):
            if one.random and (one.kind, one.name) == (other.kind, other.name) and _overlap(one, other):
                raise ValueError(
                    f"two effects {one.kind} at the same time draw the same random numbers; give them different names"
                )
        return self

    def wear(self, count: int) -> Wear:
        """Which sensor is worn at each of `count` sampling instants, and for how long."""
        lifetime = self.lifetime_days or self.model.lifetime_days
        life = round(lifetime * STEPS_PER_DAY) if lifetime and self.renew else None
        inserted = {effect.first_step for effect in self.effects if isinstance(effect, Replacement)}
        wear = Wear.whole_run(count)
        session, age = 0, self.worn_minutes // STEP_MINUTES
        if life is None and not inserted:
            return Wear(wear.session, wear.age + age)
        for k in range(count):
            if k in inserted or (life is not None and age >= life):
                session, age = session + 1, 0
            wear.session[k], wear.age[k] = session, age
            age += 1
        return wear


def _overlap(one: Effect, other: Effect) -> bool:
    return (other.end is None or one.start < other.end) and (one.end is None or other.start < one.end)


def load_sensor(name: str) -> SensorSettings:
    """A sensor by the name of its model, or from a YAML file with the keys of `SensorSettings`.

    Raises:
        SensorError: no such sensor or file, or a wrong entry in it.
    """
    if name in MODELS:
        return SensorSettings.model_validate({"model": name})
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        try:
            return yaml_file.load(path, SensorSettings)
        except yaml_file.FileError as error:
            raise SensorError(str(error)) from error
    near = difflib.get_close_matches(name, MODELS, 1)
    hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(MODELS)}, or give a .yaml file"
    raise SensorError(f"there is no sensor {name!r}; {hint}")


class _Running:
    """An effect at work in one run."""

    def __init__(self, effect: Effect, numbers: list[float], *, fault: bool) -> None:
        self.effect = effect
        self.fault = fault
        self.numbers = numbers
        self.memory = Memory()


class Sensor:
    """One sensor on one patient over one run."""

    def __init__(
        self, settings: SensorSettings | str, count: int, seed: int, patient: str, faults: tuple[Effect, ...] = ()
    ) -> None:
        """Draw the errors of `count` sampling instants.

        Args:
            settings: the sensor, or what `load_sensor` takes.
            count: sampling instants, both ends included.
            seed: of the run.
            patient: name of the virtual patient.
            faults: effects that somebody injects, besides those of the settings.

        Raises:
            SensorError: see `load_sensor`.
        """
        settings = load_sensor(settings) if isinstance(settings, str) else settings
        own = len(settings.effects)
        self.settings = settings.model_copy(update={"effects": (*settings.effects, *faults)})
        self.wear = self.settings.wear(count)
        self.errors = self.settings.model.draw(
            self.wear, lambda purpose: stream(seed, patient, f"cgm {purpose}" if purpose else "cgm")
        )
        self._gain, self._offset = self.errors.gain.tolist(), self.errors.offset.tolist()
        self._session = self.wear.session.tolist()
        self._before: list[_Running] = []
        self._after: list[_Running] = []
        self._last_stages: list[_Running] = []
        order = list(EFFECTS)
        effects = enumerate(self.settings.effects)
        for place, effect in sorted(effects, key=lambda each: (each[1].stage, order.index(each[1].kind))):
            numbers = effect.numbers(count, stream(seed, patient, f"cgm effect {effect.kind} {effect.name}"))
            self._place(effect).append(_Running(effect, numbers.tolist(), fault=place >= own))
        self._faults = [running for running in (*self._before, *self._after, *self._last_stages) if running.fault]
        self.faults_acting: list[Effect] = []  # of `faults`, on the newest sample
        self._every = self.settings.sample_minutes // STEP_MINUTES
        self._states = self._forced_states()
        self._last: float | None = None  # mg/dL, the sample before
        self._bits = 0  # fault bits since the last status
        self._told = 0  # fault bits in the last status
        self._extra_variance = 0.0
        self._dropped = 0
        self._status_due = True

    def _place(self, effect: Effect) -> list[_Running]:
        if effect.stage == Stage.TISSUE:
            return self._before
        return self._after if effect.stage <= Stage.TRANSMITTER else self._last_stages

    def _forced_states(self) -> dict[int, int]:
        """The instants at which the sensor is not ready or has expired."""
        settings = self.settings
        states = {}
        if settings.warmup_minutes:
            ready = settings.warmup_minutes / STEP_MINUTES
            states = dict.fromkeys(np.flatnonzero(self.wear.age < ready).tolist(), state_code("Warmup"))
        lifetime = settings.lifetime_days or settings.model.lifetime_days
        if lifetime and not settings.renew:
            old = np.flatnonzero(self.wear.age >= lifetime * STEPS_PER_DAY)
            states |= dict.fromkeys(old.tolist(), state_code("Expired"))
        return states

    @property
    def additive_only(self) -> bool:
        """Whether a reading is no more than gain * interstitial + offset within the range, at every instant."""
        return not self.settings.effects and not self._states and self._every == 1

    def sample(self, step: int, interstitial: float) -> Sample | None:
        """The reading at sampling instant `step` of interstitial glucose in mg/dL; None when nothing is sent.

        To be called once for every instant, in order.
        """
        if self._faults:
            self.faults_acting = self._acting(step)
        reading = Reading(step, interstitial)
        if self._before:
            self._run(self._before, reading)
        reading.glucose = self._gain[step] * reading.glucose + self._offset[step]
        if self._after:
            self._run(self._after, reading)
        if self._states:
            reading.state = self._states.get(step, STATE_OK)
        if self._last_stages:
            self._run(self._last_stages, reading)
        self._extra_variance = reading.extra_variance
        if step and self._session[step] != self._session[step - 1]:
            self._last = None
            self._status_due = True
        if reading.bits:
            self._bits |= reading.bits
            self._status_due |= bool(reading.bits & ~self._told)
        if step % self._every:
            return None
        sample = self._show(reading)
        if not reading.sent or self.battery(step) <= 0:
            self._dropped += 1
            return None
        return sample

    @staticmethod
    def _run(effects: list[_Running], reading: Reading) -> None:
        for running in effects:
            if running.effect.active(reading.step):
                running.effect.act(reading, running.numbers[reading.step], running.memory)
            else:
                running.memory.held = reading.glucose

    def _acting(self, step: int) -> list[Effect]:
        """The injected effects that do something to what is sent at this instant, or to the sensor itself."""
        due = step % self._every == 0 and self.battery(step) > 0
        return [
            running.effect
            for running in self._faults
            if running.effect.acts(step, running.numbers[step]) and (due or isinstance(running.effect, Replacement))
        ]

    def _show(self, reading: Reading) -> Sample:
        state, glucose = reading.state, reading.glucose
        low, high = self.settings.range
        number = reading.step // self._every % NUMBERS
        if state != STATE_OK:
            self._last = None
            return Sample(state, None, None, number)
        if glucose < low:
            state, glucose = STATE_BELOW_RANGE, low
        elif glucose > high:
            state, glucose = STATE_ABOVE_RANGE, high
        rate = None if self._last is None else (glucose - self._last) / self.settings.sample_minutes
        self._last = glucose if state == STATE_OK else None
        return Sample(state, glucose, rate, number)

    def status(self, step: int) -> Status | None:
        """What the sensor says of itself at this instant, after `sample`; None when it says nothing.

        Once an hour, and at once after a replacement and for a fault bit that the last one did not have; a bit tells
        what was since the last one. What falls into a drop-out follows as soon as something can be sent.
        """
        self._status_due |= step % STATUS_EVERY == 0
        if not self._status_due or self.battery(step) <= 0 or self._silent(step):
            return None
        self._status_due = False
        self._told, self._bits = self._bits, 0
        return Status(
            fault_bits=self._told,
            session=self._session[step] % SESSIONS,
            age_minutes=int(self.wear.age[step]) * STEP_MINUTES,
            noise=float((self.errors.noise_sd[step] ** 2 + self._extra_variance) ** 0.5),
            battery=self.battery(step),
            dropped=self._dropped,
        )

    def _silent(self, step: int) -> bool:
        return any(
            running.effect.stage == Stage.RADIO and running.effect.active(step) and running.numbers[step] > 0
            for running in self._last_stages
        )

    def battery(self, step: int) -> float:
        """Percent left in the transmitter's battery."""
        left = self.settings.battery_percent - 100 * step / (self.settings.battery_days * STEPS_PER_DAY)
        if left > 0 or not self.settings.renew:
            return max(left, 0.0)
        return left % 100 or 100.0
