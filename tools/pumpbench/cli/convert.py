"""The command that writes a log in the format of another tool."""

from pathlib import Path
from typing import Annotated

import typer

from pumpbench.cli.terminal import console, errors


def convert(
    source: Annotated[Path, typer.Argument(metavar="RUN_OR_LOG", help="A run folder, or any log in candump format.")],
    out: Annotated[
        Path, typer.Argument(help="File to write: .blf, .asc, .trc, .csv, .log, .db, .txt; .mf4 with asammdf.")
    ],
    only: Annotated[str | None, typer.Option(help="Only this interface of the log, e.g. can0.")] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace an existing file.")] = False,
) -> None:
    """Convert bus.log or a candump log into the format of another tool, channels and time stamps kept."""
    from pumpbench import convert as converter  # noqa: PLC0415

    done = converter.convert(source, out, overwrite=overwrite, only=only)
    if done.left_out:
        errors.print(f"{out.suffix} has no remote or error frames: {done.left_out} were left out", markup=False)
    console.print(f"{done.frames} frames of {', '.join(done.channels) or 'no interface'}: {out}", soft_wrap=True)
