"""The command that compares two runs."""

from pathlib import Path
from typing import Annotated

import typer

from pumpbench.terminal import EXIT_USAGE, EXIT_WRONG, Failed, console

RECORDS = "A run folder, or a log in candump format."
IGNORE = "MESSAGE or MESSAGE.Signal that may differ; own: what every firmware counts for itself. May be repeated."
OUT = "Folder for the report, a recording of both for Rerun's viewer, and a picture."


def diff(
    a: Annotated[Path, typer.Argument(metavar="A", help=RECORDS)],
    b: Annotated[Path, typer.Argument(metavar="B", help=RECORDS)],
    ignore: Annotated[list[str] | None, typer.Option(help=IGNORE)] = None,
    channel: Annotated[
        int | None, typer.Option(help="Compare this bus only: 0 the device's, 1 the plant's.", min=0, max=1)
    ] = None,
    out: Annotated[Path | None, typer.Option(help=OUT)] = None,
    json_file: Annotated[str | None, typer.Option("--json", help="Write the report to this file; - is stdout.")] = None,
) -> None:
    """Compare two runs frame by frame. Exit status 1 if they differ."""
    from pumpbench.comparison import folder  # noqa: PLC0415
    from pumpbench.comparison.align import Ignore, compare  # noqa: PLC0415
    from pumpbench.comparison.record import Record  # noqa: PLC0415
    from pumpbench.comparison.report import Report  # noqa: PLC0415
    from pumpbench.files import write_file  # noqa: PLC0415

    left_out = Ignore.of(ignore or ())
    ours, theirs = Record.load(a), Record.load(b)
    if channel is not None and not all((record.frames.channel == channel).any() for record in (ours, theirs)):
        raise Failed(EXIT_USAGE, f"--channel {channel}: not both records have that bus")
    report = Report(compare(ours.frames, theirs.frames, left_out, channel), ours, theirs)
    if out is not None:
        folder.write(report, out)
    if json_file == "-":
        typer.echo(report.json(), nl=False)
    else:
        if json_file is not None:
            write_file(Path(json_file), report.json().encode())
        console.print(report.text(), markup=False, soft_wrap=True)
        if out is not None:
            console.print(f"\n{folder.told(out)}", markup=False, soft_wrap=True)
    if not report.comparison.same:
        raise typer.Exit(EXIT_WRONG)
