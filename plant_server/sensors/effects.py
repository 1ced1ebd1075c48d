"""What can happen to a sensor besides the error of its model: effects with parameters and a window of simulated time.

An effect is a value: it compares, prints, can be written in YAML, and does the same in every run. Effects stack in the
order of `EFFECTS`, whatever their order in a list: first those of the tissue, then (after the model's error) the
electrode's, the transmitter's and the radio's; several of one kind act in the order of the list. Random ones draw one
number per sampling instant of the whole run in advance, from a stream of their own named by kind and `name`: moving a
window, or switching another effect off, shifts nothing.

A sensor has its effects by itself (`SensorSettings.effects`), or somebody injects them as faults; the plant tells of
the latter alone, with FAULT_Inject, at every instant at which they act.

Magnitudes are parameters; where a default is from a source it is named, the others are chosen for this project.
"""

import enum
import math
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from can_bus import codec
from can_bus.faults import Time
from can_bus.lockstep import STEP_MINUTES, STEP_SECONDS, STEPS_PER_DAY

from ..injected import Injected
from .model import Array

STATE_OK, STATE_BELOW_RANGE, STATE_ABOVE_RANGE = 1, 4, 5
"""CGM_Reading.CgmState."""


class FaultBit(enum.IntFlag):
    """CGM_Status.CgmFaultBits."""

    NOISE = 1
    COMPRESSION = 2
    TELEMETRY = 4
    CALIBRATION = 8


class Stage(enum.IntEnum):
    """Where an effect acts, in the order of the signal's way."""

    TISSUE = 0  # on interstitial glucose
    ELECTRODE = 1  # on what the model made of it
    TRANSMITTER = 2  # on the number to be shown
    STATE = 3  # on whether there is a number
    RADIO = 4  # on whether it is sent


class Reading:
    """One sample on its way through the sensor."""

    __slots__ = ("bits", "extra_variance", "glucose", "sent", "state", "step")

    def __init__(self, step: int, glucose: float) -> None:
        self.step = step
        self.glucose = glucose  # mg/dL; interstitial until the model has acted
        self.state = STATE_OK
        self.sent = True
        self.bits = 0
        self.extra_variance = 0.0  # (mg/dL)^2 of noise the sensor knows of


class Memory:
    """What an effect carries from one instant to the next."""

    __slots__ = ("held",)

    def __init__(self) -> None:
        self.held: float | None = None  # mg/dL; before the window, what went past


class Effect(Injected):
    """Something that acts from `start` until before `end`, or to the end of the run; "hh:mm" or "days+hh:mm"."""

    NODE: ClassVar[str] = "CGM"
    MESSAGE: ClassVar[str | None] = "CGM_Reading"

    stage: ClassVar[Stage]
    bit: ClassVar[int] = 0
    random: ClassVar[bool] = False

    kind: str
    name: str = ""
    start: Time = 0
    end: Time | None = None

    @model_validator(mode="after")
    def _window(self) -> "Effect":
        if self.end is not None and self.end <= self.start:
            raise ValueError("end must be later than start")
        return self

    def active(self, step: int) -> bool:
        """Whether the window is open at this sampling instant."""
        now = step * STEP_SECONDS
        return now >= self.start and (self.end is None or now < self.end)

    def minutes_in(self, step: int) -> float:
        """Minutes since the window opened."""
        return (step * STEP_SECONDS - self.start) / 60

    def numbers(self, count: int, generator: np.random.Generator) -> Array:
        """One number for every instant of the run; what it means is the effect's own affair."""
        return np.zeros(count)

    def acts(self, step: int, number: float) -> bool:
        """Whether it changes anything at this sampling instant, with its number there."""
        return self.active(step)

    def act(self, reading: Reading, number: float, memory: Memory) -> None:
        """Change the reading of one instant within the window."""
        raise NotImplementedError


class Lag(Effect):
    """A first-order delay of the sensor, on top of the interstitial fluid's: minutes is its time constant."""

    CODE: ClassVar[int] = 40
    stage: ClassVar[Stage] = Stage.TISSUE

    kind: Literal["lag"] = "lag"
    minutes: Annotated[float, Field(gt=0, le=120)] = 5.0

    def act(self, reading: Reading, number: float, memory: Memory) -> None:
        """Follow the tissue, from where it was before the window."""
        before = reading.glucose if memory.held is None else memory.held
        memory.held = before + (1 - math.exp(-STEP_MINUTES / self.minutes)) * (reading.glucose - before)
        reading.glucose = memory.held


class CompressionLow(Effect):
    """Someone lies on the sensor: it reads `depth` (a share of 1) too low, in and out over `ramp_minutes`.

    With a window of a night and `per_day` unset, the window itself is the episode. With `per_day`, episodes of
    `minutes` (half to one and a half of it) begin at random within the window, that many per day. Emami, Rabasa-Lhoret
    and Haidar (Enhancing glucose sensor models: modeling the drop-outs, Diabetes Technol Ther 2015) estimated 1.71 such
    dips per day in 15 subjects.
    """

    CODE: ClassVar[int] = 41
    stage: ClassVar[Stage] = Stage.TISSUE
    bit: ClassVar[int] = FaultBit.COMPRESSION
    random: ClassVar[bool] = True

    kind: Literal["compression_low"] = "compression_low"
    depth: Annotated[float, Field(gt=0, le=1)] = 0.4
    ramp_minutes: Annotated[float, Field(ge=5, le=60)] = 10.0
    per_day: Annotated[float, Field(gt=0, le=48)] | None = None
    minutes: Annotated[float, Field(ge=10, le=480)] = 40.0
    noticed: bool = False

    @model_validator(mode="after")
    def _ends(self) -> "CompressionLow":
        if self.per_day is None and self.end is None:
            raise ValueError("give the episode's end, or per_day for episodes at random")
        return self

    def numbers(self, count: int, generator: np.random.Generator) -> Array:
        """Share of `depth` at every instant, for episodes at random."""
        share = np.zeros(count)
        if self.per_day is None:
            return share
        begins, lengths = generator.random((count, 2)).T
        free = 0
        for k in np.flatnonzero(begins < self.per_day / STEPS_PER_DAY).tolist():
            if k < free:
                continue
            length = self.minutes * (0.5 + lengths[k])
            minutes = np.arange(0.0, length, STEP_MINUTES)[: count - k]
            share[k : k + len(minutes)] = self._shape(minutes, length - minutes)
            free = k + len(minutes)
        return share

    def _shape(self, since: Array, left: Array) -> Array:
        return np.minimum(1.0, np.minimum(since + STEP_MINUTES, left) / self.ramp_minutes)

    def acts(self, step: int, number: float) -> bool:
        """In the episode, or in one of those at random."""
        return self.active(step) and (self.per_day is None or number > 0)

    def act(self, reading: Reading, number: float, memory: Memory) -> None:
        """Press."""
        if self.per_day is None:
            assert self.end is not None
            left = (self.end - reading.step * STEP_SECONDS) / 60
            number = float(self._shape(np.array(self.minutes_in(reading.step)), np.array(left)))
        if number > 0:
            reading.glucose *= 1 - self.depth * number
            reading.bits |= self.bit if self.noticed else 0


class Bias(Effect):
    """A wrong calibration: gain * reading + offset (mg/dL)."""

    CODE: ClassVar[int] = 42
    stage: ClassVar[Stage] = Stage.ELECTRODE
    bit: ClassVar[int] = FaultBit.CALIBRATION

    kind: Literal["bias"] = "bias"
    gain: Annotated[float, Field(ge=0, le=10)] = 1.0
    offset: Annotated[float, Field(ge=-800, le=800)] = 0.0
    noticed: bool = False

    def act(self, reading: Reading, number: float, memory: Memory) -> None:
        """Miscalibrate."""
        reading.glucose = self.gain * reading.glucose + self.offset
        reading.bits |= self.bit if self.noticed else 0


class Drift(Effect):
    """An error that grows with the time since `start`: offset_per_hour in mg/dL, gain_per_hour as a share of 1."""

    CODE: ClassVar[int] = 43
    stage: ClassVar[Stage] = Stage.ELECTRODE
    bit: ClassVar[int] = FaultBit.CALIBRATION

    kind: Literal["drift"] = "drift"
    offset_per_hour: Annotated[float, Field(ge=-400, le=400)] = 0.0
    gain_per_hour: Annotated[float, Field(ge=-1, le=1)] = 0.0
    noticed: bool = False

    def act(self, reading: Reading, number: float, memory: Memory) -> None:
        """Wander off."""
        hours = self.minutes_in(reading.step) / 60
        reading.glucose = reading.glucose * max(1 + self.gain_per_hour * hours, 0.0) + self.offset_per_hour * hours
        reading.bits |= self.bit if self.noticed else 0


class Noise(Effect):
    """More noise, of standard deviation `sd` (mg/dL); `correlation` is that of one 5-min sample with the next."""

    CODE: ClassVar[int] = 44
    stage: ClassVar[Stage] = Stage.ELECTRODE
    bit: ClassVar[int] = FaultBit.NOISE
    random: ClassVar[bool] = True

    kind: Literal["noise"] = "noise"
    sd: Annotated[float, Field(gt=0, le=200)] = 15.0
    correlation: Annotated[float, Field(ge=0, lt=1)] = 0.0
    noticed: bool = True

    def numbers(self, count: int, generator: np.random.Generator) -> Array:
        """The noise at every instant, in mg/dL."""
        white = (generator.standard_normal(count) * self.sd).tolist()
        fresh = (1 - self.correlation**2) ** 0.5
        noise = white[:1]
        for w in white[1:]:
            noise.append(self.correlation * noise[-1] + fresh * w)
        return np.array(noise)

    def act(self, reading: Reading, number: float, memory: Memory) -> None:
        """Rustle."""
        reading.glucose += number
        if self.noticed:
            reading.bits |= self.bit
            reading.extra_variance += self.sd**2


class Stuck(Effect):
    """The number stands still, on `value` (mg/dL) or on the last one before; numbering and sending go on."""

    CODE: ClassVar[int] = 45
    stage: ClassVar[Stage] = Stage.TRANSMITTER

    kind: Literal["stuck"] = "stuck"
    value: Annotated[float, Field(ge=0, le=800)] | None = None

    def act(self, reading: Reading, number: float, memory: Memory) -> None:
        """Hold."""
        if memory.held is None:
            memory.held = reading.glucose
        reading.glucose = memory.held if self.value is None else self.value


class State(Effect):
    """The sensor says that it has no reading, and why; the number is SNA."""

    CODE: ClassVar[int] = 46
    stage: ClassVar[Stage] = Stage.STATE

    kind: Literal["state"] = "state"
    state: Literal["Warmup", "CalibrationNeeded", "TempInvalid", "SensorFault", "Expired"] = "SensorFault"

    def act(self, reading: Reading, number: float, memory: Memory) -> None:
        """Say so."""
        reading.state = state_code(self.state)


class DropOut(Effect):
    """Samples the transmitter fails to send: each with `probability`, `mean_samples` in a row on average.

    What is lost stays lost, its number (CgmSampleSeq) is left out, and CgmDropCount counts it.
    """

    CODE: ClassVar[int] = 47
    stage: ClassVar[Stage] = Stage.RADIO
    bit: ClassVar[int] = FaultBit.TELEMETRY
    random: ClassVar[bool] = True

    kind: Literal["drop_out"] = "drop_out"
    probability: Annotated[float, Field(gt=0, le=1)] = 1.0
    mean_samples: Annotated[float, Field(ge=1, le=1000)] = 1.0
    noticed: bool = True

    def numbers(self, count: int, generator: np.random.Generator) -> Array:
        """1 where a sample is lost: a chain of two states, with the long-run share and the mean length asked for."""
        if self.probability == 1:
            return np.ones(count)
        stay = 1 - 1 / self.mean_samples
        begin = min(self.probability * (1 - stay) / (1 - self.probability), 1.0)
        lost = []
        last = False
        for k, u in enumerate(generator.random(count).tolist()):
            last = u < (self.probability if k == 0 else stay if last else begin)
            lost.append(float(last))
        return np.array(lost)

    def acts(self, step: int, number: float) -> bool:
        """Where a sample is lost."""
        return self.active(step) and number > 0

    def act(self, reading: Reading, number: float, memory: Memory) -> None:
        """Lose it."""
        if number > 0:
            reading.sent = False
            reading.bits |= self.bit if self.noticed else 0


class Replacement(Effect):
    """A new sensor is inserted at `start`: a new session, a new age, a new draw of a model that has one per sensor."""

    CODE: ClassVar[int] = 48
    stage: ClassVar[Stage] = Stage.STATE

    kind: Literal["replacement"] = "replacement"
    end: None = None

    @property
    def first_step(self) -> int:
        """The sampling instant at which the new sensor is there."""
        return -(-self.start // STEP_SECONDS)

    def acts(self, step: int, number: float) -> bool:
        """Once."""
        return step == self.first_step

    def act(self, reading: Reading, number: float, memory: Memory) -> None:
        """Nothing: the sensor's wear knows of it."""


EFFECTS: dict[str, type[Effect]] = {
    "lag": Lag,
    "compression_low": CompressionLow,
    "bias": Bias,
    "drift": Drift,
    "noise": Noise,
    "stuck": Stuck,
    "replacement": Replacement,
    "state": State,
    "drop_out": DropOut,
}
"""By kind, in the order in which they act."""

AnyEffect = Annotated[
    Lag | CompressionLow | Bias | Drift | Noise | Stuck | State | DropOut | Replacement, Field(discriminator="kind")
]
"""An effect in a file."""


def state_code(name: str) -> int:
    """CGM_Reading.CgmState of a name."""
    return codec.choice("CGM_Reading", "CgmState", name)
