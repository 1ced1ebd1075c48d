"""The command that talks to a firmware's serial console."""

import sys
from typing import Annotated

import typer

from pumpbench.cli.terminal import EXIT_DEAD, Failed


def console(
    port: Annotated[str, typer.Argument(help="The firmware's console: a pty's path or link, a device, a URL.")],
    command: Annotated[list[str] | None, typer.Option(help="Run this instead; may be given several times.")] = None,
    timeout: Annotated[float, typer.Option(help="Seconds to wait for an answer.", min=0.1)] = 5.0,
) -> None:
    """Talk to the serial console of a running firmware; lines from a pipe are commands."""
    from pumpbench.console import ConsoleError, interactive, script  # noqa: PLC0415

    try:
        if command:
            status = script(port, command, timeout)
        elif sys.stdin.isatty():
            status = interactive(port, timeout)
        else:
            status = script(port, sys.stdin, timeout)
    except ConsoleError as error:
        raise Failed(error.status, str(error)) from None
    except OSError as error:
        raise Failed(EXIT_DEAD, f"{port}: the device is gone ({error})") from None
    raise typer.Exit(status)
