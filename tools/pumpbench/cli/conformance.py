"""The command that checks a firmware against the requirements."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pumpbench.cli import options
from pumpbench.cli.terminal import EXIT_DEAD, EXIT_USAGE, EXIT_WRONG, Failed, console, errors, progress_bar

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pumpbench.conformance.requirements import Requirement
    from pumpbench.conformance.suite import Report


def conformance(
    bus: Annotated[str, typer.Option(help="inproc (the reference), hub, or the URL of the device's bus.")] = "inproc",
    firmware: options.Device = None,
    only: Annotated[str, typer.Option(help="Comma list of requirements or groups: SEN-01,FAL (default: all).")] = "",
    modes: Annotated[str, typer.Option(help="Modes the device must take up, a comma list (default: as found).")] = "",
    settings: Annotated[
        Path | None, typer.Option(help="Thresholds in a YAML file, instead of the bench's own.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the report, JUnit XML and logs of failures.")] = None,
    junit: Annotated[Path | None, typer.Option(help="Write JUnit XML to this file.")] = None,
    markdown: Annotated[Path | None, typer.Option(help="Write requirement -> check -> result to this page.")] = None,
    json_file: options.JsonReport = None,
    timeout: options.TurnTimeout = 5.0,
    connect_timeout: options.FirstTimeout = 10.0,
    reset_hook: options.DeviceHook = None,
    long: Annotated[bool, typer.Option(help="The long form of the checks that have one.")] = False,
    list_only: Annotated[bool, typer.Option("--list", help="Show the requirements and how each is checked.")] = False,
) -> None:
    """Check a firmware against the numbered requirements. Exit status 1 if one does not hold, 3 if nobody answers."""
    from pumpbench.conformance import report as reports  # noqa: PLC0415
    from pumpbench.conformance import settings as thresholds  # noqa: PLC0415
    from pumpbench.conformance import suite  # noqa: PLC0415
    from pumpbench.conformance.connect import connected  # noqa: PLC0415
    from pumpbench.files import write_file  # noqa: PLC0415
    from pumpbench.identity import firmware_sha256  # noqa: PLC0415

    try:
        wanted = suite.select(_names(only))
    except ValueError as error:
        raise Failed(EXIT_USAGE, str(error)) from error
    if list_only:
        _list(wanted)
        return
    must = options.modes(modes) if modes else []
    limits = thresholds.load(settings or thresholds.DEFAULT)
    try:
        with (
            connected(bus, firmware, timeout=timeout, reset_hook=reset_hook) as (device, memory),
            progress_bar() as bar,
        ):
            report = suite.run(
                device, limits, wanted=wanted, memory=memory, long=long, patience=connect_timeout, must=must,
                progress=bar("conformance"),
            )  # fmt: skip
    except suite.NobodyThere as error:
        raise Failed(EXIT_DEAD, str(error)) from error
    about = {
        "bus": bus,
        "firmware": firmware or "reference",
        "firmware_sha256": firmware_sha256(firmware),
        "only": only,
        "modes": must,
        "long": long,
        "settings": limits.model_dump(),
    }
    if out is not None:
        reports.write(report, out, about)
    if junit is not None:
        write_file(junit, reports.as_junit(report))
    if markdown is not None:
        write_file(markdown, reports.as_markdown(report, "Conformance").encode())
    if json_file == "-":
        typer.echo(reports.as_json(report, about), nl=False)
    else:
        if json_file is not None:
            write_file(Path(json_file), reports.as_json(report, about).encode())
        _show(report)
    if not report.holds:
        raise Failed(EXIT_WRONG, f"{reports.summary(report)}{f'; logs in {out}' if out is not None else ''}")


def _names(text: str) -> list[str]:
    return [name.strip().upper() for name in text.split(",") if name.strip()]


def _list(wanted: "Sequence[Requirement]") -> None:
    from pumpbench.conformance.registry import checks  # noqa: PLC0415

    for each in wanted:
        found = checks().get(each.id)
        how = found.how if found is not None else each.evidence or each.open or "no check is written yet"
        needs = f" (needs {', '.join(found.needs)})" if found is not None and found.needs else ""
        console.print(f"{each.id}  {each.text}", markup=False, soft_wrap=True)
        console.print(f"        {' '.join(each.hazards)}; {how}{needs}", markup=False, soft_wrap=True)


def _show(report: "Report") -> None:
    from rich.table import Table  # noqa: PLC0415

    from pumpbench.conformance import report as reports  # noqa: PLC0415
    from pumpbench.conformance.suite import Verdict  # noqa: PLC0415

    table = Table(box=None, header_style="bold")
    for name in ("", "result", "requirement"):
        table.add_column(name, no_wrap=name != "requirement")
    colours = {Verdict.PASSED: "green", Verdict.FAILED: "red", Verdict.NOT_RUN: "red"}
    for each in report.results:
        mark = f"[{colours.get(each.verdict, 'yellow')}]{reports.MARKS[each.verdict]}[/]"
        text = each.requirement.text if each.verdict == Verdict.PASSED else f"{each.requirement.text} -> {each.text}"
        table.add_row(each.requirement.id, mark, text.replace("[", "\\["))
    console.print(table)
    for each in report.of(Verdict.FAILED):
        errors.print(f"\n{reports.story(each)}", markup=False)
    console.print(f"\n{reports.summary(report)}; the device offers {', '.join(sorted(report.offers))}")
