"""The command that looks at a device before it is given a run."""

from pathlib import Path
from typing import Annotated

import typer

from pumpbench.cli.options import Strategy
from pumpbench.cli.terminal import EXIT_DEAD, EXIT_USAGE, EXIT_WRONG, Failed, console, errors


def doctor(
    bus: Annotated[
        str,
        typer.Option(
            help="hub (a private one), unix:/path, tcp:127.0.0.1:port, socketcan:can0, slcan:/dev/ttyACM0@500000."
        ),
    ] = "hub",
    firmware: Annotated[
        str | None,
        typer.Option(
            help="Command that starts the device; {bus} becomes its URL. Default: ours on hub, else it runs by itself."
        ),
    ] = None,
    host: Annotated[bool, typer.Option(help="Serve --bus as a hub, from this process.")] = False,
    strategy: Annotated[str, typer.Option(help=f"Mode to ask for: {', '.join(Strategy)}.")] = Strategy.NMA,
    steps: Annotated[int, typer.Option(help="Sampling instants to play.", min=1)] = 20,
    timeout: Annotated[float, typer.Option(help="Seconds to wait for an answer.", min=0.1)] = 10.0,
    json_file: Annotated[
        str | None, typer.Option("--json", help="Write what was found to this file; - is stdout.")
    ] = None,
) -> None:
    """Check the wiring and the device, one line per check. Exit status 1: a check failed, 3: the bus did."""
    import json  # noqa: PLC0415

    from rich.text import Text  # noqa: PLC0415

    from pumpbench.doctor.checkup import Mark, Request  # noqa: PLC0415
    from pumpbench.doctor.examine import examine  # noqa: PLC0415
    from pumpbench.files import write_file  # noqa: PLC0415

    if bus.startswith("inproc"):
        raise Failed(EXIT_USAGE, f"--bus {bus}: there is no wiring within one process; give the bus the device is on")
    if firmware == "none":
        raise Failed(EXIT_USAGE, "--firmware none: leave it out for a device that runs by itself, and name its --bus")
    with errors.status("asking the device"):
        report = examine(Request(bus, firmware, host, strategy, steps, timeout))
    if json_file == "-":
        print(json.dumps(report.as_json(), indent=2))
    else:
        styles = {Mark.PASSED: "green", Mark.FAILED: "bold red", Mark.WARNED: "yellow", Mark.SKIPPED: "dim"}
        for check in report.checks:
            line = Text.assemble((f"{check.mark:5}", styles[check.mark]), f"{check.name:12} {check.found}")
            console.print(line, soft_wrap=True)
            if check.advice and check.mark in (Mark.FAILED, Mark.WARNED):
                console.print(f"{'':18}-> {check.advice}", markup=False, soft_wrap=True)
    if json_file not in (None, "-"):
        write_file(Path(json_file), (json.dumps(report.as_json(), indent=2) + "\n").encode())
    if report.failed:
        names = ", ".join(check.name for check in report.failed)
        raise Failed(EXIT_DEAD if report.bus_failed else EXIT_WRONG, f"not passed: {names}")
