"""A run as a function, and what came of it as something to assert on.

    outcome = bench.run(patient="adult#003", strategy="s4", hours=6,
                        faults=[drop("CGM_Reading", start="02:00", end="02:40")])
    outcome.assert_alarm("CgmLost", after="02:00", within="00:25")
    outcome.assert_state("Degraded", at="02:25")
    outcome.assert_ledger_closes()

Times are simulated, "hh:mm[:ss]" or "days+hh:mm". On `inproc` nothing is written unless it is asked for; on any other
bus the run leaves its folder.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from can_bus.faults import clock, seconds
from can_bus.lockstep import STEP_SECONDS
from pumpbench import fork as forks
from pumpbench import rig
from pumpbench.capture import Capture
from pumpbench.events import AlarmEvent
from pumpbench.faults import Faults
from pumpbench.frames import Frames
from pumpbench.identity import stated
from pumpbench.outcome import measure
from pumpbench.rewind import join
from pumpbench.runfolder import RunFolder
from pumpbench.signals import frame_text, labels
from pumpbench.trace import Trace

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from pumpbench.replay import Replay

STEPS_PER_HOUR = 3600 // STEP_SECONDS
STROKE_SLACK = 1e-9

COUNTERS = ("frames_lost", "e2e_errors", "sequence_errors", "saturations", "limiter_steps")
"""Under `safety` in metrics.json."""


def run(
    *,
    patient: str = "adult#001",
    strategy: str = "s2",
    hours: float = 24.0,
    scenario: str = "validation-14d",
    seed: int = 1,
    faults: Iterable[Any] = (),
    sensor: str = "coloured",
    bus: str = "inproc",
    device_bus: str | None = None,
    firmware: str | None = None,
    out: Path | None = None,
    **more: Any,
) -> Outcome:
    """Do a run to its end.

    Args:
        patient, strategy, scenario, seed, sensor: as of `pumpbench run`.
        hours: simulated, rounded to steps of 5 min.
        faults: values of `pumpbench.faults`.
        bus: `inproc`, `hub`, or a URL.
        device_bus: the device's side, with faults on a bus that is no hub.
        firmware: command of another firmware; needs a bus.
        out: the run folder to write; on a bus it is made below the temporary folder if not given.
        more: further fields of `pumpbench.rig.Request`.

    Raises:
        RigError, PatientError, ScenarioError, SensorError, FileError: what is wrong with the arguments.
        NodeDied, MemberSilent, PlantError, BusLost: the run did not come to its end.
    """
    request = rig.Request(
        patient=patient,
        out=out or _folder(bus),
        strategy=strategy,
        scenario=scenario,
        steps=round(hours * STEPS_PER_HOUR),
        seed=seed,
        faults=Faults.of(faults),
        sensor=sensor,
        bus=bus,
        device_bus=device_bus,
        firmware=firmware,
        **more,
    )
    return _outcome(request, written=out is not None)


def _outcome(request: rig.Request, *, written: bool) -> Outcome:
    prepared = rig.prepare(request)
    if request.bus != "inproc":
        return Outcome.load(rig.execute(prepared))
    capture = Capture()
    rig.simulate(prepared, capture)
    frames = capture.finish()
    info = prepared.info | {"device": stated(capture.device_info())}
    outcome = Outcome.of(join(request.origin, frames) if request.origin else frames, info)
    if written:
        outcome.write(request.out, overwrite=request.overwrite)
    return outcome


class Fork:
    """An instant of a run, from which any number of others go on.

    Args:
        origin: the run, its folder, or that of a checkpoint.
        at: the instant, "hh:mm" or "days+hh:mm"; a checkpoint has one of its own.

    Raises:
        ForkError: it is none of this run, or the run cannot be done again.
        RunFolderError, CheckpointError: there is no such folder, or it was changed.
    """

    def __init__(self, origin: Outcome | Path, at: str | None = None) -> None:
        if isinstance(origin, Path):
            self.instant = forks.Instant.parse(str(origin) if at is None else f"{origin}@{at}")
            return
        if at is None:
            raise forks.ForkError("say at which instant: only a checkpoint has one of its own")
        info = {"trace_sha256": origin.frames.sha256(), **origin.info}
        self.instant = forks.Instant.of(str(origin.folder or "the run"), origin.frames, info, at)

    def run(
        self,
        *,
        faults: Iterable[Any] | None = None,
        strategy: str | None = None,
        scenario: str | None = None,
        hours: float | None = None,
        firmware: str | None = None,
        bus: str | None = None,
        out: Path | None = None,
        **more: Any,
    ) -> Outcome:
        """Go on to the end; what is not given stays as it was.

        Args:
            faults: instead of those that have not begun by the instant.
            strategy, scenario, firmware: from the instant on.
            hours: of the whole run.
            bus: another one.
            out: the run folder to write, as of `run`.
            more: further fields of `pumpbench.rig.Request` about how it is done.

        Raises:
            ForkError: what is wrong with the arguments.
            Diverged: the run did not begin as recorded.
            NodeDied, MemberSilent, PlantError, BusLost: it did not come to its end.
        """
        bus = bus or self.instant.info["bus"]
        request = forks.fork(
            self.instant,
            out or _folder(bus),
            faults=None if faults is None else Faults.of(faults),
            strategy=strategy,
            scenario=scenario,
            steps=None if hours is None else round(hours * STEPS_PER_HOUR),
            firmware=firmware,
            bus=bus,
            **more,
        )
        return _outcome(request, written=out is not None)


def fork(origin: Outcome | Path, at: str | None = None) -> Fork:
    """An instant of a run, to go on from: `bench.fork(RUN, at="2+03:00").run(faults=[...])`."""
    return Fork(origin, at)


def _folder(bus: str) -> Path:
    """Where a run goes when nobody has said."""
    return Path("unwritten") if bus == "inproc" else Path(tempfile.mkdtemp(prefix="pumpbench-run-")) / "run"


def replay(run: Path | Outcome, **keys: Any) -> Replay:
    """Feed what a recorded device heard into a firmware, without a plant; see `pumpbench.replay.replay`.

    Args:
        run: a run folder, a log in candump format, or what came of a run.
        keys: bus, firmware, ignore, keep_going, timeout, connect_timeout, reset_hook.

    Returns:
        The outcome, to be held to the record with `assert_same`.
    """
    from pumpbench.comparison.record import Record  # noqa: PLC0415
    from pumpbench.replay import replay as play  # noqa: PLC0415

    record = Record(run.title, run.frames, run.info) if isinstance(run, Outcome) else Record.load(Path(run))
    return play(record, **keys)


@dataclass(eq=False, repr=False)
class Outcome:
    """What came of a run.

    Attributes:
        frames: every frame of it.
        trace: decoded, one row per step.
        metrics: content of metrics.json.
        folder: the run folder, if there is one.
    """

    frames: Frames
    trace: Trace
    metrics: Mapping[str, Any]
    folder: Path | None = None
    info: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, frames: Frames, info: Mapping[str, Any]) -> Outcome:
        """From the frames of a run; `info` is what run.json will hold."""
        trace = Trace.from_frames(frames, info)
        return cls(frames, trace, measure(trace, frames), None, dict(info))

    @classmethod
    def load(cls, folder: Path) -> Outcome:
        """From a run folder.

        Raises:
            RunFolderError: it is not whole.
        """
        run = RunFolder.load(folder)
        return cls(run.frames, run.trace, run.metrics, folder, run.info)

    def write(self, out: Path, *, overwrite: bool = False) -> Path:
        """Write the run folder.

        Raises:
            RunFolderError: it could not be written.
        """
        folder = RunFolder.create(out, overwrite=overwrite)
        folder.write_all(self.frames, self.info, self.metrics, self.trace)
        self.folder = folder.path
        return folder.path

    def __repr__(self) -> str:
        return f"<Outcome of {self.title}>"

    # ---- what happened

    @property
    def safety(self) -> dict[str, Any]:
        """Counters, ledger and hazards."""
        found: dict[str, Any] = self.metrics["safety"]
        return found

    @property
    def hazards(self) -> dict[str, int]:
        """H1 to H8 with their counts; those that were not found are left out."""
        return {name: count for name, count in self.safety["hazards"].items() if count}

    @property
    def counters(self) -> dict[str, int]:
        """What the device counted: lost frames, E2E and sequence errors, saturations, steps with a limit."""
        return {name: self.safety[name] or 0 for name in COUNTERS}

    @property
    def alarms(self) -> list[AlarmEvent]:
        """Every change of an alarm, of CTRL and PUMP, in order."""
        return self.trace.alarms

    def raised(self, code: str | None = None, node: str | None = None) -> list[AlarmEvent]:
        """The alarms as they were raised: first events of instances, which a device without memory gives anew."""
        standing: set[tuple[str, int]] = set()
        found = []
        for event in self.trace.alarms:
            instance = event.node, event.instance
            first = instance not in standing
            (standing.discard if event.state == "Inactive" else standing.add)(instance)
            if first and code in (None, event.code) and node in (None, event.node):
                found.append(event)
        return found

    @property
    def glucose(self) -> NDArray[np.float64]:
        """True plasma glucose by step, mg/dL."""
        glucose: NDArray[np.float64] = self.trace.get("TruthGlucose")
        return glucose

    def minutes_below(self, level: float) -> float:
        """Simulated minutes with true glucose below this level, mg/dL."""
        return float(np.count_nonzero(self.glucose[:-1] < level)) * STEP_SECONDS / 60  # the end is no interval

    def minutes_above(self, level: float) -> float:
        """The same above it."""
        return float(np.count_nonzero(self.glucose[:-1] > level)) * STEP_SECONDS / 60

    def states(self) -> list[tuple[int, str]]:
        """Simulated seconds and name of every CtrlState the device took up, in order."""
        names = labels("CTRL_Status", "CtrlState")
        column = self.trace.get("CtrlState")
        changes: list[tuple[int, str]] = []
        for time, code in zip(self.trace.time_s.tolist(), column.tolist(), strict=True):
            if not math.isnan(code) and (not changes or names[int(code)] != changes[-1][1]):
                changes.append((int(time), names[int(code)]))
        return changes

    def state(self, at: str) -> str:
        """CtrlState that the device reported last at or before a time.

        Raises:
            ValueError: `at` is no time.
        """
        time = seconds(at)
        before = [name for since, name in self.states() if since <= time]
        return before[-1] if before else "nothing yet"

    @property
    def title(self) -> str:
        """Which run it was."""
        keys = ("patient", "strategy", "scenario", "seed", "bus", "firmware")
        return ", ".join(f"{key} {self.info[key]}" for key in keys if key in self.info)

    def frames_of(self, step: int, limit: int = 40) -> str:
        """The frames of an instant on the device's bus, decoded, one a line; what a turn asks for and its answer."""
        rows = np.flatnonzero((self.frames.step == step) & (self.frames.channel == 0))
        lines = [f"{self.frames.time_s[row]:12.6f}  {frame_text(self.frames.frame(int(row)))}" for row in rows[:limit]]
        return "\n".join([*lines, *([f"... and {len(rows) - limit} more"] if len(rows) > limit else [])])

    def story(self, limit: int = 12) -> str:
        """What went wrong, in order of time: hazards, faults, alarms, states; and the frames of the first hazard."""
        lines = [(int(step) * STEP_SECONDS, 0, f"HAZARD {name}") for step, name in self._hazards_by_step()]
        lines += [(int(span.start_s), 1, f"fault {span.label}") for span in self.trace.fault_spans()]
        lines += [
            (int(event.time_s), 2, f"{event.node} raises {event.code} ({event.priority})") for event in self.raised()
        ]
        lines += [(time, 3, f"CTRL is {name}") for time, name in self.states() if time > STEP_SECONDS]
        lines.sort()
        shown = [f"{clock(time)}  {text}" for time, _, text in lines[:limit]]
        shown += [f"... and {len(lines) - limit} more"] if len(lines) > limit else []
        hazards = self._hazards_by_step()
        if hazards:
            step, name = hazards[0]
            shown += [f"the frames of step {step}, in which {name} was found:", self.frames_of(step)]
        return "\n".join(shown)

    def _hazards_by_step(self) -> list[tuple[int, str]]:
        return [(entry["step"], entry["hazard"]) for entry in self.safety["first_hazards"]]

    # ---- what is to be shown

    def assert_no_hazards(self) -> None:
        """None of H1 to H8 was counted."""
        __tracebackhide__ = True
        assert not self.hazards, f"hazards were counted: {self.hazards}; first: {self._hazards_by_step()[0]}"

    def assert_ledger_closes(self) -> None:
        """Every stroke of both drugs is accounted for."""
        __tracebackhide__ = True
        for drug, ledger in self.safety["ledger"].items():
            assert ledger["closes"], f"the {drug} ledger does not close: {ledger}"

    def assert_state(self, name: str, *, at: str) -> None:
        """The device was in this CtrlState."""
        __tracebackhide__ = True
        found = self.state(at)
        assert found == name, f"CTRL was {found} at {at}, not {name}; its states: {self._told(self.states())}"

    def assert_back_to(self, name: str, *, after: str, within: str) -> None:
        """From `after` on the device takes up, or keeps, this CtrlState within a time, and is in it then."""
        __tracebackhide__ = True
        self.state(after)
        deadline = seconds(after) + seconds(within)
        found = self.state(clock(deadline))
        assert found == name, (
            f"CTRL was {found}, not {name}, {within} after {after}; its states: {self._told(self.states())}"
        )

    def assert_alarm(
        self, code: str, *, after: str = "00:00", within: str | None = None, node: str = "CTRL"
    ) -> AlarmEvent:
        """An alarm with this code was raised at or after a time, at most `within` later; returns it."""
        __tracebackhide__ = True
        begin = seconds(after)
        end = None if within is None else begin + seconds(within)
        raised = self.raised(node=node)
        for event in raised:
            if event.code == code and event.time_s >= begin and (end is None or event.time_s <= end):
                return event
        told = self._told([(int(event.time_s), event.code) for event in raised])
        limit = "" if within is None else f" within {within}"
        raise AssertionError(f"{node} did not raise {code}{limit} after {after}; it raised: {told}")

    def assert_no_alarm(self, code: str, *, after: str = "00:00", node: str = "CTRL") -> None:
        """No alarm with this code was raised at or after a time."""
        __tracebackhide__ = True
        begin = seconds(after)
        found = [event for event in self.raised(code, node) if event.time_s >= begin]
        assert not found, f"{node} raised {code} at {clock(int(found[0].time_s))}"

    def assert_dose_never_above(
        self,
        *,
        insulin_u_per_h: float | None = None,
        pramlintide_ug_per_h: float | None = None,
        insulin_bolus_u: float | None = None,
        pramlintide_bolus_ug: float | None = None,
        start: str = "00:00",
        end: str | None = None,
    ) -> None:
        """No rate and no bolus commanded in a window was above these."""
        __tracebackhide__ = True
        first, last = seconds(start), None if end is None else seconds(end)
        inside = (self.trace.time_s >= first) & (self.trace.time_s < (np.inf if last is None else last))
        for what, limit, column in (
            ("U/h of insulin", insulin_u_per_h, "InsulinRateCommanded"),
            ("ug/h of pramlintide", pramlintide_ug_per_h, "PramRateCommanded"),
            ("U of insulin at once", insulin_bolus_u, "InsulinBolusCommanded"),
            ("ug of pramlintide at once", pramlintide_bolus_ug, "PramBolusCommanded"),
        ):
            if limit is None:
                continue
            values = np.where(inside, np.nan_to_num(self.trace.get(column)), 0.0)
            row = int(np.argmax(values))
            assert values[row] <= limit + STROKE_SLACK, (
                f"{values[row]:g} {what} at {clock(int(self.trace.time_s[row]))}, above {limit:g}"
            )

    @staticmethod
    def _told(events: list[tuple[int, str]]) -> str:
        return ", ".join(f"{clock(time)} {name}" for time, name in events) or "nothing"
