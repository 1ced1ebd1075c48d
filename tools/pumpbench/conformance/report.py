"""What came of the checks, for a terminal, for CI and for a file beside the release."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from can_bus.frame import Frame
from pumpbench.conformance.registry import checks
from pumpbench.conformance.requirements import Requirement, requirements
from pumpbench.conformance.suite import Report, Result, Verdict
from pumpbench.files import write_file
from pumpbench.identity import versions
from pumpbench.signals import frame_text

SHOWN = 16
"""Frames before a failure that a report shows; the log has all."""

MARKS = {
    Verdict.PASSED: "pass",
    Verdict.FAILED: "FAIL",
    Verdict.NOT_APPLICABLE: "n/a",
    Verdict.ELSEWHERE: "see",
    Verdict.OPEN: "open",
    Verdict.NOT_RUN: "not run",
}


def summary(report: Report) -> str:
    """The counts in a line."""
    counts = [(len(report.of(verdict)), verdict.value) for verdict in Verdict]
    return ", ".join(f"{count} {what}" for count, what in counts if count)


def story(result: Result) -> str:
    """A failure in words: the requirement, what was expected and what came, and the last frames."""
    rows = [f"{result.requirement.id}: {result.requirement.text}", f"  {result.text}"]
    if result.frames:
        rows.append(f"  the last {min(SHOWN, len(result.frames))} of {len(result.frames)} frames:")
        rows += [f"    {frame_text(frame)}" for frame in result.frames[-SHOWN:]]
    return "\n".join(rows)


def log(frames: Sequence[Frame]) -> str:
    """The frames of a check in the format of candump, a millisecond apart."""
    return "".join(
        f"({number / 1000:.6f}) can0 {frame.identifier:03X}#{frame.data.hex().upper()}\n"
        for number, frame in enumerate(frames)
    )


def as_json(report: Report, about: dict[str, Any]) -> str:
    """Everything, machine-readable; it stands alone, so requirements and checks are told in words, too."""
    content = {
        **versions(),
        **about,
        "device": report.device,
        "offers": sorted(report.offers),
        "holds": report.holds,
        "catalogue": len(requirements()),
        "requirements": [
            {
                "id": each.requirement.id,
                "verdict": each.verdict.value,
                "text": each.text,
                "seconds": round(each.seconds, 3),
                "requirement": each.requirement.text,
                "group": each.requirement.group,
                "hazards": list(each.requirement.hazards),
                "source": each.requirement.source,
                "binds": each.requirement.binds,
                "check": _how(each.requirement),
            }
            for each in report.results
        ],
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def as_junit(report: Report) -> bytes:
    """A suite of JUnit: a test case per requirement; what does not apply or was not run is skipped."""
    suite = ElementTree.Element(
        "testsuite",
        name="pumpbench conformance",
        tests=str(len(report.results)),
        failures=str(len(report.of(Verdict.FAILED))),
        skipped=str(sum(each.verdict not in (Verdict.PASSED, Verdict.FAILED) for each in report.results)),
    )
    for each in report.results:
        case = ElementTree.SubElement(
            suite,
            "testcase",
            classname=f"conformance.{each.requirement.group.replace(' ', '_')}",
            name=f"{each.requirement.id} {each.requirement.text}",
            time=f"{each.seconds:.3f}",
        )
        if each.verdict == Verdict.FAILED:
            ElementTree.SubElement(case, "failure", message=_clean(each.text)).text = _clean(story(each))
        elif each.verdict != Verdict.PASSED:
            ElementTree.SubElement(case, "skipped", message=_clean(f"{each.verdict.value}: {each.text}"))
    ElementTree.indent(suite)
    return (
        b'<?xml version="1.0" encoding="utf-8"?>\n' + ElementTree.tostring(suite, encoding="unicode").encode() + b"\n"
    )


def _clean(text: str) -> str:
    """Without the control characters that XML cannot hold."""
    return "".join(letter if letter.isprintable() or letter in "\n\t" else "?" for letter in text)


def _how(requirement: Requirement) -> str:
    """How a requirement is checked, or where it is shown instead."""
    found = checks().get(requirement.id)
    return found.how if found is not None else (requirement.evidence or "")


def as_markdown(report: Report, title: str) -> str:
    """The table requirement -> check -> result."""
    rows = [
        f"# {title}",
        "",
        f"{summary(report)}.",
        "",
        "| | requirement | check | hazards | result |",
        "|---|---|---|---|---|",
    ]
    for each in report.results:
        how = _how(each.requirement)
        hazards = " ".join(each.requirement.hazards)
        result = each.verdict.value + (f": {each.text}" if each.text else "")
        cells = (each.requirement.id, each.requirement.text, how, hazards, result)
        rows.append("| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |")
    return "\n".join(rows) + "\n"


def write(report: Report, out: Path, about: dict[str, Any]) -> None:
    """A folder with report.json, junit.xml, report.md, and for each failed requirement its story and candump log.

    Raises:
        OSError: it cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    for old in [*out.glob("???-??.log"), *out.glob("???-??.txt")]:
        old.unlink()  # of an earlier run, whose failures may be mended
    write_file(out / "report.json", as_json(report, about).encode())
    write_file(out / "junit.xml", as_junit(report))
    write_file(out / "report.md", as_markdown(report, "Conformance").encode())
    for each in report.of(Verdict.FAILED):
        write_file(out / f"{each.requirement.id}.txt", (story(each) + "\n").encode())
        write_file(out / f"{each.requirement.id}.log", log(each.frames).encode())
