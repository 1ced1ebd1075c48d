"""The command line: a module per command, or per group of commands that belong together.

They import what they need when they run, so that --help is quick.
"""

import signal
import sys
from collections.abc import Callable, Sequence
from typing import Annotated

import typer

from pumpbench import __version__
from pumpbench.cli import (
    benchmark,
    campaign,
    checkpoint,
    conformance,
    console,
    convert,
    diff,
    doctor,
    faults,
    identify_controller,
    nodes,
    replay,
    report,
    run,
    view,
)
from pumpbench.cli.statuses import Interrupted, status_of
from pumpbench.cli.terminal import errors

COMMANDS: Sequence[Callable[..., None]] = (
    run.run,
    checkpoint.checkpoint,
    campaign.campaign,
    campaign.study,
    faults.faults,
    faults.matrix,
    faults.hunt,
    conformance.conformance,
    doctor.doctor,
    nodes.plant,
    view.view,
    view.snapshot,
    diff.diff,
    replay.replay,
    report.report,
    convert.convert,
    console.console,
    identify_controller.identify_controller,
    benchmark.benchmark,
)
NODES: Sequence[Callable[..., None]] = (nodes.firmware, nodes.gateway, nodes.record)
"""Commands that read their options themselves, as `python -m` of their modules does."""

app = typer.Typer(
    name="pumpbench",
    help="A hardware-in-the-loop bench for insulin + pramlintide pump firmware. Research only, not a medical device.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # a usage error is a line, not a box
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"pumpbench {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print it.")] = False,
) -> None:
    pass


for command in COMMANDS:
    app.command()(command)
for node in NODES:
    app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True}, add_help_option=False)(
        node
    )


def main() -> None:
    """Entry point: every error of a kind we know is one line and an exit status."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    try:
        app()
    except Exception as error:
        status = status_of(error)
        if status is None:
            raise
        errors.print(f"pumpbench: {error}", markup=False)
        sys.exit(status)


def _interrupt(number: int, _frame: object) -> None:
    raise Interrupted(f"interrupted by {signal.Signals(number).name}")
