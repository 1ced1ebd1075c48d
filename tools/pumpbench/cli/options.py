"""Options that several commands take alike, and what becomes of their text."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from pumpbench.cli.terminal import EXIT_USAGE, Failed


class Strategy(StrEnum):
    """The paper's seven modes, as in `pumpbench.calibration.MODES`, which takes too long to import for --help."""

    NMA = "nma"
    MA = "ma"
    SMA = "sma"
    S1 = "s1"
    S2 = "s2"
    S3 = "s3"
    S4 = "s4"


MODES = f"Comma list of {', '.join(Strategy)}; or all."
PATIENTS = "A name, a comma list, or all; file.csv#name or file.csv for patients of your own, with --controller."
SCENARIOS = "validation-14d, tuning, camerlingo, fasting, six-hours, or a YAML or CSV file."
SENSORS = "coloured, ideal, breton, facchinetti, dexcom-g5, dexcom-g6, vettoretti, or a YAML file."

# ---- of runs

Patients = Annotated[str, typer.Option(help=PATIENTS)]
Modes = Annotated[str, typer.Option(help=MODES)]
Scenario = Annotated[str, typer.Option(help=SCENARIOS)]
Days = Annotated[float, typer.Option(help="Simulated days; rounded to steps of 5 min.", min=0.0)]
Seed = Annotated[int, typer.Option(help="Seed of everything random.", min=0)]
Sensor = Annotated[str, typer.Option(help=SENSORS)]
Physiology = Annotated[
    str | None,
    typer.Option(help="Equations: S2008, or S2013 with counter-regulation (default: what the patient's file says)."),
]
Pramlintide = Annotated[
    str,
    typer.Option(
        help="Parameter set: P2, P4, moderate, conservative or strong; +type1 behind it for a lower bioavailability."
    ),
]
Variability = Annotated[
    str, typer.Option(help="What varies in the patient: all, none, or a comma list of k_abs, f, insulin_pk, circadian.")
]
Controller = Annotated[Path | None, typer.Option(help="Controller models, by identify-controller.")]
StepTimeout = Annotated[float, typer.Option(help="Seconds to wait for the firmware in a step.")]

# ---- of many runs

Workers = Annotated[int | None, typer.Option(help="Processes on this machine (default: one per CPU).", min=1)]
Cluster = Annotated[
    str | None, typer.Option(help="A dask scheduler to hand the runs to instead, e.g. tcp://127.0.0.1:8786.")
]
Via = Annotated[
    str,
    typer.Option(help="compiled, or a bus (inproc, hub, socketcan:vcan0): the same runs through the nodes themselves."),
]

# ---- of a device without a plant

Device = Annotated[
    str | None,
    typer.Option(help='Command that starts the device, "{bus}" and "{nvm}" in it; none: it runs by itself.'),
]
TurnTimeout = Annotated[float, typer.Option(help="Seconds to wait for the end of a turn.", min=0.05)]
FirstTimeout = Annotated[float, typer.Option(help="Seconds to wait for the first answer.", min=0.1)]
DeviceHook = Annotated[str | None, typer.Option(help="Command that resets a device that runs by itself.")]

# ---- of what is written

JsonReport = Annotated[str | None, typer.Option("--json", help="Write the report to this file; - is stdout.")]


def patients(text: str) -> list[str]:
    """The names of `--patient`.

    Raises:
        PatientError: a file cannot be read.
    """
    from plant_server.physiology import cohort, patients_of  # noqa: PLC0415

    if text == "all":
        return list(cohort())
    names = []
    for name in names_in(text):
        names += [f"{name}#{row}" for row in patients_of(Path(name))] if name.endswith(".csv") else [name]
    return names


def modes(text: str) -> list[str]:
    """The names of `--modes`.

    Raises:
        Failed: there is no such mode.
    """
    known = [mode.value for mode in Strategy]
    names = known if text == "all" else names_in(text)
    for name in names:
        if name not in known:
            raise Failed(EXIT_USAGE, f"there is no mode {name!r}; choose of {', '.join(known)}, or all")
    return names


def names_in(text: str) -> list[str]:
    """The names in a comma list."""
    return [name.strip() for name in text.split(",")]
