"""The command that does a run, a new one or one that begins as a recorded one."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pumpbench.cli import options
from pumpbench.cli.options import Strategy
from pumpbench.cli.terminal import EXIT_USAGE, EXIT_WRONG, Failed, console, errors, progress_bar

if TYPE_CHECKING:
    from pumpbench.rig import Prepared, Request

CHANGES = ("faults", "strategy", "scenario", "days", "firmware", "bus")
"""Options that say what is different from the instant of --from on; not given, they are as recorded."""

RECORDED = (
    "patient",
    "seed",
    "sensor",
    "physiology",
    "pramlintide",
    "variability",
    "controller",
    "free_running",
    "speed",
)
"""Options of a run that nothing can change on its way."""

RESET_HOOK = "Command that switches a real device, before the run and at its faults: run with cut, start kept, ..."
RESET_LINE = "The same by a line of a serial port: dtr:PORT or rts:PORT, asserted = in reset."
FROM = "Begin as this recorded run up to hh:mm or days+hh:mm; faults, strategy, ... then hold from there on."


def run(
    context: typer.Context,
    patient: options.Patients = "adult#001",
    strategy: Annotated[Strategy, typer.Option(help="Mode of the controller.")] = Strategy.S2,
    scenario: options.Scenario = "validation-14d",
    days: options.Days = 1.0,
    seed: options.Seed = 1,
    bus: Annotated[
        str,
        typer.Option(
            help="hub, inproc, unix:/path, tcp:127.0.0.1:port, socketcan:vcan0, slcan:/dev/ttyACM0@500000, "
            "or any python-can interface:channel."
        ),
    ] = "hub",
    device_bus: Annotated[
        str | None, typer.Option(help="With --faults on a real bus: the device's side (default: vcan1 beside vcan0).")
    ] = None,
    faults: Annotated[Path | None, typer.Option(help="YAML file of faults, acting between device and plant.")] = None,
    firmware: Annotated[
        str | None,
        typer.Option(help="Command that starts another firmware; {bus} becomes its URL; none: it runs by itself."),
    ] = None,
    reset_hook: Annotated[str | None, typer.Option(help=RESET_HOOK)] = None,
    reset_line: Annotated[str | None, typer.Option(help=RESET_LINE)] = None,
    free_running: Annotated[bool, typer.Option(help="The device keeps its own time: do not wait for it.")] = False,
    speed: Annotated[float, typer.Option(help="Simulated seconds in a second of a free run.")] = 1.0,
    sensor: options.Sensor = "coloured",
    physiology: options.Physiology = None,
    pramlintide: options.Pramlintide = "P2",
    variability: options.Variability = "all",
    controller: options.Controller = None,
    origin: Annotated[str | None, typer.Option("--from", metavar="RUN@TIME", help=FROM)] = None,
    out: Annotated[Path | None, typer.Option(help="Run folder to write (default: below runs/).")] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace an existing run folder at --out.")] = False,
    serve: Annotated[
        int | None, typer.Option(help="Port at which Rerun's viewer shows the run while it is on.")
    ] = None,
    web: Annotated[int | None, typer.Option(help="And in a browser: port of the page, with --serve.")] = None,
    connect_timeout: Annotated[float, typer.Option(help="Seconds to wait for the firmware's first answer.")] = 20.0,
    step_timeout: options.StepTimeout = 10.0,
) -> None:
    """Run the closed loop: patient, firmware and recorder on one bus. Exit status 1 if a hazard was counted."""
    from can_bus.lockstep import STEPS_PER_DAY  # noqa: PLC0415
    from pumpbench import rig  # noqa: PLC0415
    from pumpbench.recorder import live  # noqa: PLC0415

    how: dict[str, Any] = {
        "device_bus": device_bus,
        "reset_hook": reset_hook,
        "reset_line": reset_line,
        "overwrite": overwrite or out is None,
        "serve": serve,
        "web": web,
        "connect_timeout": connect_timeout,
        "step_timeout": step_timeout,
    }
    if origin is not None:
        requests = [_forked(context, origin, out, how)]
    else:
        names = options.patients(patient)
        varying = rig.variability_sources(variability)
        requests = [
            rig.Request(
                patient=name,
                out=_run_folder(out, name, len(names) > 1, f"{strategy}-{scenario}-{days:g}d-seed{seed}"),
                strategy=strategy,
                scenario=scenario,
                steps=round(days * STEPS_PER_DAY),
                seed=seed,
                bus=bus,
                faults=faults,
                firmware=firmware,
                free_running=free_running,
                speed=speed,
                sensor=sensor,
                physiology=physiology,
                pramlintide=pramlintide,
                variability=varying,
                controller=controller,
                **how,
            )
            for name in names
        ]
    prepared = [rig.prepare(request) for request in requests]
    for line in live.where(serve, web):
        errors.print(line, markup=False)
    hazards = _print_outcomes(_execute(prepared))
    if hazards:
        raise Failed(EXIT_WRONG, f"{hazards} hazards were counted: see safety.hazards in metrics.json")


def _forked(context: typer.Context, origin: str, out: Path | None, how: dict[str, Any]) -> "Request":
    """The request of `pumpbench run --from ORIGIN`.

    Args:
        context: of the command, with its options.
        origin: RUN@TIME.
        out: the run folder to write; None: below runs/.
        how: fields of the request about how the run is done.

    Raises:
        Failed: an option that cannot be changed.
        ForkError, RunFolderError: see `pumpbench.fork`.
    """
    from can_bus.lockstep import STEPS_PER_DAY  # noqa: PLC0415
    from pumpbench import fork  # noqa: PLC0415

    given = {name: value for name, value in context.params.items() if _was_given(context, name)}
    for name in RECORDED:
        if name in given:
            raise Failed(
                EXIT_USAGE, f"--{name.replace('_', '-')} cannot change on the way: --from takes it from the record"
            )
    instant = fork.Instant.parse(origin)
    changes = {name: given[name] for name in CHANGES if name in given}
    if "days" in changes:
        changes["steps"] = round(changes.pop("days") * STEPS_PER_DAY)
    label = f"{Path(instant.name).name}-from-{instant.at}"
    return fork.fork(instant, out or Path("runs") / label, **changes, **how)


def _was_given(context: typer.Context, name: str) -> bool:
    """Whether an option stands on the command line; its default looks like any other value."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def _run_folder(out: Path | None, patient: str, several: bool, label: str) -> Path:
    name = patient.replace("#", "-").replace("/", "_")
    if out is None:
        return Path("runs") / f"{name}-{label}".replace("/", "_")
    return out / name if several else out


def _execute(prepared: "list[Prepared]") -> list[Path]:
    from pumpbench import rig  # noqa: PLC0415

    folders = []
    with progress_bar() as begin:
        for one in prepared:
            told = begin(f"{one.request.patient} {one.request.strategy}")
            folders.append(rig.execute(one, told))
    return folders


def _print_outcomes(folders: list[Path]) -> int:
    """Print one line per run and where its recording is; returns the number of hazards."""
    import json  # noqa: PLC0415

    from rich.table import Table  # noqa: PLC0415

    table = Table(box=None, header_style="bold")
    for name in ("patient", "mode", "TIR %", "<70 %", ">180 %", "mean", "CV %", "U/day", "ug/day", "alarms", "hazards"):
        table.add_column(name, justify="left" if name in ("patient", "mode") else "right")
    total = 0
    for folder in folders:
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
        info = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        hazards = sum(count or 0 for count in metrics["safety"]["hazards"].values())
        total += hazards
        keys = ("tir_70_180", "tbr_70", "tar_180", "mean_glucose", "cv", "insulin_u_per_day", "pramlintide_ug_per_day")
        table.add_row(
            info["patient"],
            info["strategy"],
            *(f"{metrics[key]:.1f}" for key in keys),
            str(metrics["safety"]["alarms"]),
            str(hazards),
        )
    console.print(table)
    for folder in folders:
        console.print(f"recording: {folder / 'recording.rrd'}   picture: {folder / 'summary.png'}", soft_wrap=True)
    return total
