"""The command that finds the controller's models of patients."""

from pathlib import Path
from typing import Annotated

import typer

from pumpbench.cli import options
from pumpbench.cli.terminal import EXIT_USAGE, Failed, console, errors


def identify_controller(
    patients: Annotated[str, typer.Argument(help="A name, a comma list, or all; file.csv#name or file.csv.")],
    out: Annotated[Path, typer.Option(help="CSV file to write, for --controller.")],
    physiology: options.Physiology = None,
    overwrite: Annotated[bool, typer.Option(help="Replace an existing file at --out.")] = False,
) -> None:
    """Identify what the controller must know of patients: K, tau and CIR from their responses to a meal and insulin."""
    from rich.table import Table  # noqa: PLC0415

    from plant_server.physiology import load_patient  # noqa: PLC0415
    from pumpbench.controller_model import COLUMNS, identify, write_models  # noqa: PLC0415

    if out.exists() and not overwrite:
        raise Failed(EXIT_USAGE, f"{out} exists already; give --overwrite to replace it")
    loaded = [load_patient(name, physiology=physiology) for name in options.patients(patients)]
    with errors.status("identifying"):
        models = identify(loaded)
    write_models(out, models)
    table = Table(box=None, header_style="bold")
    for name in COLUMNS:
        table.add_column(name, justify="left" if name == "patient" else "right")
    for model in models:
        table.add_row(model.patient, *(f"{value:.5g}" for value in model[1:]))
    console.print(table)
