"""The command that stores an instant of a run."""

from pathlib import Path
from typing import Annotated

import typer

from pumpbench.cli.terminal import console


def checkpoint(
    instant: Annotated[str, typer.Argument(metavar="RUN@TIME", help="A run folder, and hh:mm or days+hh:mm.")],
    out: Annotated[Path, typer.Option(help="Folder to write.")],
) -> None:
    """Store an instant of a run: what led there, and the state of every node. Give the folder to run --from."""
    from pumpbench import checkpoint as checkpoints  # noqa: PLC0415
    from pumpbench import fork  # noqa: PLC0415

    checkpoints.take(fork.Instant.parse(instant), out)
    console.print(f"checkpoint of {instant}: {out}", soft_wrap=True)
