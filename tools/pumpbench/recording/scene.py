"""What of a run its looks depend on; it travels in the recording, so that the file is enough to make other looks."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from can_bus.lockstep import STEP_SECONDS
from pumpbench.closeups import CloseUp, close_ups
from pumpbench.story import LANES

if TYPE_CHECKING:
    from pumpbench.frames import Frames
    from pumpbench.trace import Trace

PROPERTY: Final = "scene"
"""Name of the recording's property that holds it, as JSON."""

FRAME_MS: Final = 0.27
"""A frame of eight bytes at 500 kbit/s."""

GLUCOSE: Final = ("TruthGlucose", "GlucoseConc")


@dataclass(frozen=True)
class Scene:
    """Facts about a run.

    Attributes:
        start_s, end_s: simulated seconds of its first and last instant.
        gateway: whether a second bus, the plant's, was recorded.
        glucose_top: upper end of the axis of glucose, mg/dL; the same for all runs that stay below it, to compare them.
        insulin_top, pram_top: upper ends of the axes of doses, U/h and µg/h (or U and µg).
        frames_top: upper end of the axis of frames per step: the calibration is not what one looks for.
        lanes: number of alarms, faults and states to make room for.
        close_ups: where to look closer.
    """

    start_s: float = 0.0
    end_s: float = 86400.0
    gateway: bool = True
    glucose_top: float = 320.0
    insulin_top: float = 10.0
    pram_top: float = 100.0
    frames_top: float = 50.0
    lanes: int = 6
    close_ups: tuple[CloseUp, ...] = ()

    @classmethod
    def of(cls, trace: Trace, frames: Frames) -> Scene:
        """From a run."""
        start_s, end_s = (float(trace.time_s[row]) for row in (0, -1)) if len(trace) else (0.0, 0.0)
        states = sum(signal in trace.columns for signal, _, _ in LANES)
        states += sum(bool(np.nan_to_num(trace.get(f"{drug}Occlusion")).any()) for drug in ("Insulin", "Pram"))
        faults, alarms = {span.label for span in trace.fault_spans()}, {(a.code, a.node) for a in trace.alarms}
        return cls(
            start_s=start_s,
            end_s=max(end_s, start_s + STEP_SECONDS),
            gateway=bool(np.any(frames.channel == 1)),
            glucose_top=max(320.0, _most(trace, *GLUCOSE) + 20),
            insulin_top=_dose_top(trace, "Insulin"),
            pram_top=_dose_top(trace, "Pram"),
            frames_top=_round_up(1.5 * _usual_frames(frames)),
            lanes=states + len(faults) + len(alarms),
            close_ups=tuple(close_ups(trace)),
        )

    def as_json(self) -> str:
        """For the recording."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Scene:
        """From the recording.

        Raises:
            ValueError, TypeError, KeyError: it is none.
        """
        content: dict[str, Any] = json.loads(text)
        content["close_ups"] = tuple(CloseUp(**each) for each in content["close_ups"])
        return cls(**content)


def _most(trace: Trace, *columns: str) -> float:
    return max(float(np.nanmax(np.append(trace.get(name), 0.0))) for name in columns)


def _dose_top(trace: Trace, drug: str) -> float:
    commanded = _most(trace, f"{drug}RateCommanded", f"{drug}BolusCommanded", f"{drug}BolusDelivered")
    return _round_up(max(commanded, float(np.nanmax(np.append(trace.basal_delivered(drug), 0.0)))))


def _round_up(value: float) -> float:
    """The next of 1, 2, 5, 10, 20, ... : an axis that ends there has a label there."""
    decade = 10.0 ** math.floor(math.log10(max(value, 1.0)))
    return next(decade * step for step in (1, 2, 5, 10) if value <= decade * step)


def _usual_frames(frames: Frames) -> float:
    """Frames of the device's bus in the usual step."""
    counts = np.bincount(frames.step[frames.channel == 0]) if len(frames) else np.zeros(0)
    return float(np.median(counts[counts > 0])) if counts.any() else 20.0


def scene_of(rrd: Path) -> Scene:
    """The scene of a recording.

    Raises:
        ValueError: it holds none; the text names the file.
    """
    from rerun.chunk import RrdReader  # noqa: PLC0415

    try:
        for chunk in RrdReader(rrd).stream().filter(content=f"/__properties/{PROPERTY}"):
            for name, column in zip(chunk.to_record_batch().schema.names, chunk.to_record_batch().columns, strict=True):
                if name == "json":
                    return Scene.from_json(column[0].as_py()[0])
    except (RuntimeError, ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{rrd} is no recording of pumpbench: {error}") from None
    raise ValueError(f"{rrd} does not say how it can be shown: another program, or an older pumpbench, wrote it")
