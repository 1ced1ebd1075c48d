"""The command that compares two runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pumpbench.cli import options
from pumpbench.cli.terminal import EXIT_USAGE, EXIT_WRONG, Failed, console

if TYPE_CHECKING:
    from pumpbench.comparison.report import Report
    from pumpbench.replay import Replay

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
    json_file: options.JsonReport = None,
) -> None:
    """Compare two runs frame by frame. Exit status 1 if they differ."""
    from pumpbench.comparison.align import Ignore, compare  # noqa: PLC0415
    from pumpbench.comparison.record import Record  # noqa: PLC0415
    from pumpbench.comparison.report import Report  # noqa: PLC0415

    left_out = Ignore.of(ignore or ())
    ours, theirs = Record.load(a), Record.load(b)
    if channel is not None and not all((record.frames.channel == channel).any() for record in (ours, theirs)):
        raise Failed(EXIT_USAGE, f"--channel {channel}: not both records have that bus")
    report = Report(compare(ours.frames, theirs.frames, left_out, channel), ours, theirs)
    tell(report, report, out, json_file)
    if not report.comparison.same:
        raise typer.Exit(EXIT_WRONG)


def tell(outcome: "Report | Replay", report: "Report", out: Path | None, json_file: str | None) -> None:
    """Print what came of a comparison, and keep it where that was asked for.

    Args:
        outcome: in words and for programs.
        report: of the two runs, to be kept.
        out: folder for it.
        json_file: for the outcome; "-" prints it in place of the words.
    """
    from pumpbench.comparison import folder  # noqa: PLC0415
    from pumpbench.files import write_file  # noqa: PLC0415

    if out is not None:
        folder.write(report, out)
    if json_file == "-":
        typer.echo(outcome.json(), nl=False)
        return
    if json_file is not None:
        write_file(Path(json_file), outcome.json().encode())
    console.print(outcome.text(), markup=False, soft_wrap=True)
    if out is not None:
        console.print(f"\n{folder.told(out)}", markup=False, soft_wrap=True)
