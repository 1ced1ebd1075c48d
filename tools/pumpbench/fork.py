"""A run that begins as a recorded one and goes on otherwise: what may be changed, and what the record says of the rest.

    pumpbench run --from RUN@2+03:00 --faults other.yaml --out fork

How the beginning is done again is in `pumpbench.rewind`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from can_bus.faults import Fault as WireFault
from can_bus.faults import NodeFault, clock, seconds
from can_bus.lockstep import STEP_SECONDS
from pumpbench import rig
from pumpbench.faults import AnyFault, Faults, load
from pumpbench.frames import Frames
from pumpbench.identity import BUILT_IN, firmware_sha256, other_dbc
from pumpbench.rewind import Origin
from pumpbench.rig import Change, Request
from pumpbench.runfolder import RunFolder


class ForkError(ValueError):
    """A run cannot be forked like this; the text says what was expected."""


@dataclass(frozen=True, eq=False)
class Instant:
    """An instant of a recorded run.

    Attributes:
        name: of the run, for people.
        frames: its record.
        info: its run.json.
        step: the instant.
        state: that of a checkpoint at this instant, if it is from one.
    """

    name: str
    frames: Frames
    info: Mapping[str, Any]
    step: int
    state: Mapping[str, Any] | None = None

    @classmethod
    def of(
        cls, name: str, frames: Frames, info: Mapping[str, Any], at: str, state: Mapping[str, Any] | None = None
    ) -> "Instant":
        """An instant by its time, hh:mm or days+hh:mm.

        Raises:
            ForkError: it is none of this run, or the run is none that can be done again.
        """
        if info.get("free_running"):
            raise ForkError(f"{name} was a free run: no two of these are the same, so none can be forked")
        foreign = other_dbc(info)
        if foreign is not None:
            raise ForkError(f"{name} {foreign}")
        try:
            time = seconds(at)
        except ValueError as error:
            raise ForkError(f"{name}@{at}: {error}") from None
        if time % STEP_SECONDS:
            raise ForkError(f"{name}@{at}: the instants of a run are 5 min apart; give a multiple, e.g. {_near(time)}")
        if "steps" not in info:
            raise ForkError(f"{name}: its run.json does not say how long the run was; was its bus only listened to?")
        last = int(info["steps"])
        if time > last * STEP_SECONDS:
            raise ForkError(f"{name}@{at}: the run has instants from 00:00 to {clock(last * STEP_SECONDS)}")
        return cls(name, frames, info, time // STEP_SECONDS, state)

    @classmethod
    def parse(cls, text: str) -> "Instant":
        """RUN@TIME, where RUN is a run folder; or a checkpoint, whose time need not be given.

        Raises:
            ForkError: see `of`, or the text is not like this.
            RunFolderError: there is no such run, it is unfinished, or its record was changed.
            CheckpointError: there is no such checkpoint, it was changed, or other programs have taken it.
        """
        from pumpbench import checkpoint  # noqa: PLC0415

        folder, mark, at = text.rpartition("@")
        for place, time in ((text, None), (folder, at)):
            if place and (Path(place) / checkpoint.CHECKPOINT).exists():
                return checkpoint.load(Path(place), time)
        if not mark or not folder:
            raise ForkError(
                f"--from {text!r}: expected RUN@hh:mm or RUN@days+hh:mm, RUN being a run folder, "
                "or the folder of a checkpoint"
            )
        run = RunFolder.load(Path(folder))
        return cls.of(folder, run.frames, run.info, at)

    @property
    def at(self) -> str:
        """As a time, the shortest text of it."""
        return clock(self.time)

    @property
    def time(self) -> int:
        """Simulated seconds."""
        return self.step * STEP_SECONDS


def _near(time: int) -> str:
    return clock(time - time % STEP_SECONDS)


def fork(
    instant: Instant,
    out: Path,
    *,
    faults: Path | Faults | None = None,
    strategy: str | None = None,
    scenario: str | None = None,
    steps: int | None = None,
    firmware: str | None = None,
    bus: str | None = None,
    **more: Any,
) -> Request:
    """The request of a run that goes on otherwise; what is not given stays as it was.

    Args:
        instant: where it begins to be another run.
        out: the run folder to write, with the whole run in it.
        faults: instead of those that have not begun by then.
        strategy: switched to at that instant (MODE_Cmd); the calibration stays.
        scenario: whose meals and habits hold from then on.
        steps: length of the whole run.
        firmware: another one, which hears the record and answers from then on; `built-in` is the reference.
        bus: another one.
        more: further fields of `pumpbench.rig.Request` about how the run is done, not about what it is.

    Raises:
        ForkError: what is wrong.
        FileError, PatientError, ScenarioError, SensorError, RigError: a file that the run used is not there any more.
    """
    info = instant.info
    length = int(info["steps"]) if steps is None else steps
    if length <= instant.step:
        raise ForkError(
            f"{instant.name}@{clock(instant.time)}: nothing comes after the end at {clock(length * STEP_SECONDS)}; "
            "give more --days"
        )
    recorded = _recorded(instant, bus or info["bus"])
    changed = recorded.changes
    if strategy is not None or scenario is not None:
        changed = _changed(recorded, instant.step, strategy, scenario)
    given = load(faults) if isinstance(faults, Path) else faults
    since = info.get("fork", {}).get("firmware_since")
    if firmware is not None:
        since = instant.step
    elif firmware_sha256(recorded.firmware) != info.get("firmware_sha256"):
        raise ForkError(
            f"{instant.name}: the files of its firmware ({info['firmware']}) are not what they were when the run was "
            "made; give --firmware to go on with the one that is there now"
        )
    elif since is not None and since > instant.step:
        raise ForkError(
            f"{instant.name}@{clock(instant.time)}: its firmware answers from {clock(since * STEP_SECONDS)} on only; "
            "choose a later instant, or fork the run that it comes from"
        )
    return replace(
        recorded,
        out=out,
        steps=length,
        faults=recorded.faults if given is None else _faults(instant, given),
        firmware=recorded.firmware if firmware is None else None if firmware == BUILT_IN else firmware,
        origin=Origin(instant.frames, instant.step, since, info, instant.state),
        changes=changed,
        **more,
    )


def _recorded(instant: Instant, bus: str) -> Request:
    """The request that the run was made from.

    Raises:
        ForkError: one of its files has changed since.
    """
    info = instant.info
    try:
        request = Request(
            patient=info["patient"],
            out=Path(),
            strategy=info["strategy"],
            scenario=info.get("scenario_file", info["scenario"]),
            steps=int(info["steps"]),
            seed=info["seed"],
            bus=bus,
            faults=_faults_of(info),
            firmware=None if info["firmware"] == BUILT_IN else info["firmware"],
            sensor=info["sensor"],
            physiology=info["physiology"],
            pramlintide=info["pramlintide"],
            variability=tuple(info["variability"]),
            origin=Origin(instant.frames, 0),
            changes=tuple(Change(each["step"], each["strategy"], each["scenario"]) for each in info.get("changes", ())),
        )
    except (KeyError, TypeError, ValidationError) as error:
        raise ForkError(f"{instant.name}: its run.json does not say what the run was made of ({error})") from None
    now = rig.prepare(replace(request, bus="hub", firmware=None, faults=None)).info
    for name, value in info["parameters"].items():
        if now["parameters"].get(name) != value:
            what = name.removesuffix("_sha256")
            raise ForkError(f"{instant.name}: its {what} is not what it was when the run was made")
    if now.get("changes", []) != info.get("changes", []):
        raise ForkError(f"{instant.name}: a scenario of it is not what it was when the run was made")
    return request


def _faults_of(info: Mapping[str, Any]) -> Faults:
    return Faults.of(TypeAdapter(list[AnyFault]).validate_python(info["faults"]))


def _changed(recorded: Request, step: int, strategy: str | None, scenario: str | None) -> tuple[Change, ...]:
    """The changes of a run with one more, which holds to the end in what it changes."""
    changes = [Change(0, recorded.strategy, recorded.scenario), *recorded.changes]
    now = [change for change in changes if change.step <= step][-1]
    later = [now._replace(step=step), *(change for change in changes if change.step > step)]
    held = [each._replace(strategy=strategy or each.strategy, scenario=scenario or each.scenario) for each in later]
    return (*(change for change in changes[1:] if change.step < step), *held)


def _faults(instant: Instant, given: Faults) -> Faults:
    """The faults of a run that have begun by an instant, which stay to their end, and others from there on.

    Raises:
        ForkError: one of the others begins before it.
    """
    for fault in (*given.wire, *given.pump, *given.sensor):
        if fault.start < instant.time:
            raise ForkError(
                f"{fault.kind} starts at {clock(fault.start)}, before the fork at {clock(instant.time)}: "
                "what was until then is recorded, and stays"
            )
    old = _faults_of(instant.info)
    wire = _placed(old.wire, 0)
    first = 1 + max((fault.place for fault in wire if fault.place is not None), default=-1)
    begun = [fault for fault in (*wire, *old.pump, *old.sensor) if fault.start < instant.time]
    return Faults.of((*begun, *_placed(given.wire, first), *given.pump, *given.sensor))


def _placed(faults: tuple[WireFault, ...], first: int) -> list[WireFault]:
    """The faults with the place that their random numbers belong to: those of the device have none."""
    placed: list[WireFault] = []
    number = first
    for fault in faults:
        if isinstance(fault, NodeFault):
            placed.append(fault)
            continue
        placed.append(fault if fault.place is not None else fault.model_copy(update={"place": number}))
        number += 1
    return placed
