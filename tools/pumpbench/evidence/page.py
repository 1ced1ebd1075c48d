"""The evidence page: one HTML file with everything in it, for a reader without this tool and without a network.

It carries no date: results know no wall clock, and the same folders give the same bytes. When it was made, by whom and
for which change, is said by whatever keeps it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined

from can_bus.lockstep import STEP_SECONDS
from pumpbench import catalogue, hazards, identity
from pumpbench.conformance.requirements import requirements
from pumpbench.evidence import conformance
from pumpbench.evidence.conformance import Result, ResultFile
from pumpbench.evidence.pictures import pictures
from pumpbench.evidence.run import Evidence, Info, Level, Verdict, load
from pumpbench.files import write_file
from pumpbench.runfolder import RunFolderError
from pumpbench.story import clock, notes


class Metric(NamedTuple):
    """A number of metrics.json for readers."""

    key: str
    name: str
    unit: str
    digits: int
    about: str


METRICS: Final = (
    Metric("tir_70_180", "time in range", "%", 1, "samples of true glucose from 70 to 180 mg/dL; target above 70 %"),
    Metric("tbr_70", "below 70", "%", 1, "samples below 70 mg/dL, those below 54 included; target below 4 %"),
    Metric("tbr_54", "below 54", "%", 1, "samples below 54 mg/dL, clinically significant; target below 1 %"),
    Metric("tar_180", "above 180", "%", 1, "samples above 180 mg/dL, those above 250 included; target below 25 %"),
    Metric("tar_250", "above 250", "%", 1, "samples above 250 mg/dL; target below 5 %"),
    Metric("mean_glucose", "mean glucose", "mg/dL", 1, "of true plasma glucose"),
    Metric("cv", "variation", "%", 1, "standard deviation over mean; 36 % and less is called stable"),
    Metric("gmi", "GMI", "%", 2, "glucose management indicator: the HbA1c that this mean goes with"),
    Metric("gri", "GRI", "", 1, "glycaemia risk index, 0 (best) to 100, lows weigh more than highs"),
    Metric("lbgi", "LBGI", "", 2, "low blood glucose index: below 1.1 is a low risk of hypoglycaemia"),
    Metric("hbgi", "HBGI", "", 2, "high blood glucose index: below 4.5 is a low risk of hyperglycaemia"),
    Metric("insulin_u_per_day", "insulin", "U/day", 2, "delivered, basal and boluses"),
    Metric("pramlintide_ug_per_day", "pramlintide", "µg/day", 1, "delivered, basal and boluses"),
)

COMPARED: Final = (
    "tir_70_180", "tbr_70", "tbr_54", "tar_180", "mean_glucose", "insulin_u_per_day", "pramlintide_ug_per_day",
)  # fmt: skip
"""Metrics in the overview and in comparisons."""

COUNTERS: Final = {
    "faults_injected": "injections of faults, as FAULT_Inject tells them",
    "frames_lost": "frames the device missed by their counters (its own count)",
    "e2e_errors": "frames whose checksum, length or id the device refused (its own count)",
    "sequence_errors": "frames the device refused as repeated or out of order (its own count)",
    "saturations": "additions that reached the end of their word (its own count)",
    "limiter_steps": "steps in which a limit of the device held a dose back",
}

SAME_RUN: Final = ("patient", "scenario", "seed", "steps", "sensor", "physiology", "pramlintide", "variability")
"""What runs have in common that can be compared step by step; the hashes of their parameters besides."""

SHORT_TIMELINE: Final = 60
"""A longer one is folded up, except on paper."""

BENCH: Final = ("pumpbench", "dbc_crc32")


@dataclass(frozen=True)
class LeftOut:
    """A folder that could not be read, and why."""

    folder: Path
    why: str


@dataclass(frozen=True)
class Material:
    """What a page is made of.

    Attributes:
        runs: in the order given.
        results: of `pumpbench conformance`, in the order given.
        left_out: folders that are no evidence.
    """

    runs: Sequence[Evidence]
    results: Sequence[Result] = ()
    left_out: Sequence[LeftOut] = ()

    def at(self, level: Level) -> list[tuple[str, str]]:
        """What the page shows at a level: its name there, and why."""
        verdicts = [(f"run {number}", f"{run.folder}: ", run.verdict) for number, run in enumerate(self.runs, 1)]
        verdicts += [(str(each.folder), "", Verdict(Level.BAD, f"left out: {each.why}")) for each in self.left_out]
        verdicts += [(link.result.file.name, "", link.verdict) for link in self.links]
        return [(name, f"{where}{verdict.text}") for name, where, verdict in verdicts if verdict.level == level]

    @property
    def links(self) -> list[Link]:
        """The results beside the runs."""
        return [_link(result, self.runs) for result in self.results]


def told(counts: Mapping[str, int]) -> str:
    """Counts of verdicts in a line."""
    return ", ".join(f"{count} {what}" for what, count in counts.items())


def collect(folders: Iterable[Path], files: Iterable[Path] = (), *, keep_going: bool = False) -> Material:
    """Read everything a page is to show.

    Args:
        folders: of runs.
        files: that `pumpbench conformance --json` wrote.
        keep_going: name folders that cannot be read on the page, instead of giving up.

    Raises:
        RunFolderError: a folder is missing, unfinished or damaged.
        FileError: a result file is.
    """
    runs: list[Evidence] = []
    left_out: list[LeftOut] = []
    for folder in folders:
        try:
            runs.append(load(folder))
        except RunFolderError as error:
            if not keep_going:
                raise
            left_out.append(LeftOut(folder, str(error)))
    return Material(runs, [conformance.load(file) for file in files], left_out)


def write(material: Material, out: Path) -> None:
    """Write the page, whole or not at all.

    Raises:
        OSError: it cannot be written.
    """
    write_file(out, render(material).encode())


def render(material: Material) -> str:
    """The page as HTML."""
    environment = Environment(
        loader=PackageLoader("pumpbench.evidence", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"number": number, "clock": clock, "flow": _flow, "mark": _mark}
    return environment.get_template("page.html.j2").render(
        material=material,
        sections=[_section(number, run) for number, run in enumerate(material.runs, 1)],
        groups=list(_comparisons(material.runs)),
        links=material.links,
        anchors={row.id: result for result in reversed(material.results) for row in result.content.requirements},
        hazards=list(_hazard_rows(material)),
        metrics=METRICS,
        compared=[metric for metric in METRICS if metric.key in COMPARED],
        counters=COUNTERS,
        bench=identity.versions(),
        short_timeline=SHORT_TIMELINE,
    )


# ------------------------------------------------------------------------------------------------------------ contents


def _section(number: int, run: Evidence) -> dict[str, Any]:
    """What the page tells of a run beyond the fields of `Evidence`."""
    events = [] if run.trace is None else notes(run.trace)
    rows = [(note.time_s, note.kind.lower(), note.what) for note in events]
    rows += [
        (entry["step"] * float(STEP_SECONDS), "hazard", f"{entry['hazard']}: {hazards.NAMES[entry['hazard']]}")
        for entry in run.safety.get("first_hazards", ())
    ]
    return {
        "id": f"run-{number}",
        "number": number,
        "run": run,
        "timeline": sorted(rows, key=lambda row: row[0]),
        "faults": [(fault, _purpose(fault)) for fault in run.info.faults],
        "pictures": [] if run.trace is None else pictures(run.trace, run.metrics),
        "alarms": [(alarm, None if math.isinf(alarm.end_s) else alarm.end_s) for alarm in run.alarms],
    }


def _purpose(fault: Mapping[str, Any]) -> tuple[str, str]:
    """What a fault does, and which hazards the catalogue says it puts to the test."""
    kind, message = str(fault.get("kind")), fault.get("message")
    try:
        what = catalogue.summary(kind)
    except KeyError:
        return "a kind that this version does not know", ""
    tested = {
        hazard
        for entry in catalogue.examples(kind)
        if message is None or getattr(entry.fault, "message", None) == message
        for hazard in entry.hazards
    }
    return what, " ".join(sorted(tested))


class Comparison(NamedTuple):
    """Runs that differ in firmware, strategy or faults alone; the first is what the others are held against."""

    title: str
    rows: list[tuple[int, Evidence]]


def _comparisons(runs: Sequence[Evidence]) -> Iterable[Comparison]:
    groups: dict[str, list[tuple[int, Evidence]]] = {}
    for number, run in enumerate(runs, 1):
        if run.trace is None or not run.info.parameters or run.info.seed is None:
            continue
        hashes = {name: value for name, value in run.info.parameters.items() if name != "calibration_sha256"}
        key = repr([getattr(run.info, name) for name in SAME_RUN] + sorted(hashes.items()))
        groups.setdefault(key, []).append((number, run))
    for group in groups.values():
        if len(group) > 1:
            info = group[0][1].info
            title = f"{info.patient}, {info.scenario}, seed {info.seed}, {info.steps} steps"
            yield Comparison(title, sorted(group, key=lambda row: bool(row[1].info.faults)))


class Link(NamedTuple):
    """A conformance result, what came of it, and whether it is of the firmware that made the runs."""

    result: Result
    verdict: Verdict


def _link(result: Result, runs: Sequence[Evidence]) -> Link:
    content = result.content
    asked = f"{len(content.requirements)} of {content.catalogue} requirements were asked about"
    longer = ", in the long form where there is one" if content.long else ""
    level, relation = _relation(content, runs)
    text = f"{result.file.name}: {told(result.counts)}; {asked}{longer}{relation}"
    return Link(result, Verdict(level if content.holds else Level.BAD, text))


def _relation(content: ResultFile, runs: Sequence[Evidence]) -> tuple[Level, str]:
    """Whether a result is of the firmware and the bench of the runs, and the same in words."""
    if not runs:
        return Level.GOOD, ""
    other, unknown = [], []
    for number, run in enumerate(runs, 1):
        ours, theirs = _firmware(run.info), _firmware(content)
        same_bench = all(getattr(run.info, key) == getattr(content, key) for key in BENCH)
        if not same_bench or (ours and theirs and ours != theirs):
            other.append(number)
        elif not (ours and theirs):
            unknown.append(number)
    if other:
        return Level.OPEN, f"; it is of another firmware or another bench than {_numbered(other)}"
    if unknown:
        return Level.OPEN, f"; it may be of another firmware than {_numbered(unknown)}: there are no hashes to compare"
    return Level.GOOD, f"; it is of the firmware and bench of {_numbered(range(1, len(runs) + 1))}"


def _numbered(numbers: Iterable[int]) -> str:
    shown = [str(number) for number in numbers]
    return f"run{'s' * (len(shown) > 1)} {', '.join(shown)}"


def _firmware(of: Info | ResultFile) -> tuple[Any, ...] | None:
    """What identifies a firmware: hashes of its files and what it says of itself; None if there is no hash."""
    return (sorted(of.firmware_sha256.values()), of.device) if of.firmware_sha256 else None


class HazardRow(NamedTuple):
    """A hazard and the requirements that control it.

    Attributes:
        name: H1 to H8.
        text: what it is.
        results: requirement and what came of it, the worst of all result files; "" without one.
    """

    name: str
    text: str
    results: list[tuple[str, str]]


def _hazard_rows(material: Material) -> Iterable[HazardRow]:
    for name, text in hazards.NAMES.items():
        found = {each.id: "" for each in requirements().values() if name in each.hazards}
        if material.results:
            found = {}
            for result in material.results:
                for row in result.content.requirements:
                    if name in row.hazards and (row.id not in found or row.broken):
                        found[row.id] = row.verdict.value
        yield HazardRow(name, text, list(found.items()))


# ------------------------------------------------------------------------------------------------------------ as text


def number(value: float | None, digits: int, *, sign: bool = False) -> str:
    """A number with a real minus sign; a dash for none."""
    if value is None:
        return "–"
    return f"{round(float(value), digits) + 0.0:{'+' if sign else ''}.{digits}f}".replace("-", "−")  # + 0.0: no -0.0


def _flow(value: Any) -> str:
    """A value as one line of YAML, as in a fault file."""
    return yaml.safe_dump(value, default_flow_style=True, width=math.inf, sort_keys=False, allow_unicode=True).strip()


MARKS: Final = {Level.GOOD: "✓", Level.OPEN: "?", Level.BAD: "✗"}


def _mark(level: Level) -> str:
    return MARKS[level]
