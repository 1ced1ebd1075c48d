"""The command that makes a page of evidence of runs and conformance results."""

from pathlib import Path
from typing import Annotated

import typer

from pumpbench.cli.terminal import EXIT_USAGE, EXIT_WRONG, Failed, console, errors


def report(
    folders: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Run folders.")],
    conformance: Annotated[
        list[Path] | None,
        typer.Option(help="Result of `pumpbench conformance --json` (report.json of --out); may be repeated."),
    ] = None,
    out: Annotated[Path, typer.Option(help="The page to write.")] = Path("report.html"),
    keep_going: Annotated[
        bool, typer.Option(help="Name folders that cannot be read on the page, and go on; they make it red.")
    ] = False,
) -> None:
    """Make one HTML page of runs, as evidence: self-contained, worked out anew. Exit status 1 if something is red."""
    from pumpbench.evidence import page  # noqa: PLC0415
    from pumpbench.evidence.run import Level  # noqa: PLC0415

    if out.is_dir():
        raise Failed(EXIT_USAGE, f"{out} is a folder; give the name of the page to write")
    with errors.status("reading"):
        material = page.collect(folders, conformance or (), keep_going=keep_going)
        page.write(material, out)
    console.print(f"report: {out}", soft_wrap=True, markup=False)
    wrong = material.at(Level.BAD)
    if wrong:
        raise Failed(EXIT_WRONG, "; ".join(why for _, why in wrong))
