"""The command that feeds a recorded run into a firmware."""

from pathlib import Path
from typing import Annotated

import typer

from pumpbench.cli import options
from pumpbench.cli.diff import IGNORE, OUT, RECORDS, tell
from pumpbench.cli.terminal import EXIT_DEAD, EXIT_WRONG, progress_bar


def replay(
    run: Annotated[Path, typer.Argument(metavar="RUN", help=RECORDS)],
    firmware: options.Device = None,
    bus: Annotated[
        str | None,
        typer.Option(
            help="inproc (the reference), hub, or the URL of the device's bus (default: hub with --firmware)."
        ),
    ] = None,
    ignore: Annotated[list[str] | None, typer.Option(help=IGNORE)] = None,
    keep_going: Annotated[
        bool, typer.Option("--keep-going", help="Compare on behind the first difference, with the recorded inputs.")
    ] = False,
    timeout: options.TurnTimeout = 5.0,
    connect_timeout: options.FirstTimeout = 10.0,
    reset_hook: options.DeviceHook = None,
    out: Annotated[Path | None, typer.Option(help=OUT)] = None,
    json_file: options.JsonReport = None,
) -> None:
    """Feed what a recorded device heard into a firmware. Exit status 1 if it answers otherwise, 3 if not at all."""
    from pumpbench import replay as replays  # noqa: PLC0415

    with progress_bar() as bar:
        outcome = replays.replay(
            run,
            bus=bus or ("inproc" if firmware is None else "hub"),
            firmware=firmware,
            ignore=ignore or (),
            keep_going=keep_going,
            timeout=timeout,
            connect_timeout=connect_timeout,
            reset_hook=reset_hook,
            progress=bar("turns"),
        )
    tell(outcome, outcome.report, out, json_file)
    if not outcome.same:
        raise typer.Exit(EXIT_WRONG if outcome.silent is None else EXIT_DEAD)
