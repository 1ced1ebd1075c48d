"""The commands that start one node of the bench, for people who bring the others."""

import contextlib
from pathlib import Path
from typing import Annotated, Any

import typer

from pumpbench.cli import options
from pumpbench.cli.options import Strategy
from pumpbench.cli.terminal import console


def firmware(context: typer.Context) -> None:
    """Start the reference firmware on a bus, for people who bring the plant."""
    from firmware_sim.__main__ import main as node  # noqa: PLC0415

    raise typer.Exit(node(context.args))


def gateway(context: typer.Context) -> None:
    """Join two buses, with faults in between."""
    from can_bus.gateway import main as node  # noqa: PLC0415

    raise typer.Exit(node(context.args))


def record(context: typer.Context) -> None:
    """Record a bus into a run folder, next to firmware it knows nothing about."""
    from pumpbench.recorder.__main__ import main as node  # noqa: PLC0415

    raise typer.Exit(node(context.args))


def plant(
    bus: Annotated[str, typer.Option(help="Bus URL the plant joins.")],
    host: Annotated[bool, typer.Option(help="Serve that URL as a hub, from this process.")] = False,
    patient: Annotated[str, typer.Option(help="Name of the virtual patient.")] = "adult#001",
    strategy: Annotated[Strategy, typer.Option(help="Mode to ask the firmware for.")] = Strategy.S2,
    scenario: options.Scenario = "validation-14d",
    days: options.Days = 1.0,
    seed: options.Seed = 1,
    sensor: options.Sensor = "coloured",
    connect_timeout: Annotated[float, typer.Option(help="Seconds to wait for a firmware.")] = 60.0,
    step_timeout: options.StepTimeout = 10.0,
) -> None:
    """Start the plant alone: patient, sensor, pump and user, for people who bring the firmware."""
    from can_bus.hub import Hub  # noqa: PLC0415
    from can_bus.lockstep import STEPS_PER_DAY  # noqa: PLC0415
    from can_bus.url import open_link  # noqa: PLC0415
    from plant_server.serve import serve  # noqa: PLC0415
    from plant_server.server import PlantServer  # noqa: PLC0415
    from pumpbench import rig  # noqa: PLC0415

    request = rig.Request(
        patient=patient,
        out=Path(),
        strategy=strategy,
        scenario=scenario,
        steps=round(days * STEPS_PER_DAY),
        seed=seed,
        sensor=sensor,
        bus=bus,
    )
    server = PlantServer(rig.prepare(request).run)
    with contextlib.ExitStack() as stack:
        if host:
            link: Any = stack.enter_context(stack.enter_context(Hub(bus)).local_link())
        else:
            link = stack.enter_context(open_link(bus))
        console.print(f"plant of {patient} on {bus}, waiting for the firmware")
        serve(server, link, connect_timeout=connect_timeout, step_timeout=step_timeout)
    console.print(f"done: {server.step} steps")
