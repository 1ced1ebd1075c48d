"""The command line. Commands import what they need when they run, so that --help is quick."""

import contextlib
import signal
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from pumpbench import __version__
from pumpbench.cli_conformance import conformance
from pumpbench.cli_diff import diff
from pumpbench.cli_doctor import doctor
from pumpbench.cli_faults import faults_command, hunt, matrix
from pumpbench.cli_fork import checkpoint, forked
from pumpbench.cli_replay import replay
from pumpbench.cli_report import report
from pumpbench.cli_view import snapshot, view
from pumpbench.terminal import (
    EXIT_DEAD,
    EXIT_INTERRUPTED,
    EXIT_USAGE,
    EXIT_WRONG,
    Failed,
    console,
    errors,
    progress_bar,
)

app = typer.Typer(
    name="pumpbench",
    help="A hardware-in-the-loop bench for insulin + pramlintide pump firmware. Research only, not a medical device.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # a usage error is a line, not a box
    context_settings={"help_option_names": ["-h", "--help"]},
)
PATIENTS = "A name, a comma list, or all; file.csv#name or file.csv for patients of your own, with --controller."
SCENARIOS = "validation-14d, tuning, camerlingo, fasting, six-hours, or a YAML or CSV file."
SENSORS = "coloured, ideal, breton, facchinetti, dexcom-g5, dexcom-g6, vettoretti, or a YAML file."
PHYSIOLOGIES = "Equations: S2008, or S2013 with counter-regulation (default: what the patient's file says)."
PRAMLINTIDE = "Parameter set: P2, P4, moderate, conservative or strong; +type1 behind it for a lower bioavailability."
RESET_HOOK = "Command that switches a real device, before the run and at its faults: run with cut, start kept, ..."
RESET_LINE = "The same by a line of a serial port: dtr:PORT or rts:PORT, asserted = in reset."
FROM = "Begin as this recorded run up to hh:mm or days+hh:mm; faults, strategy, ... then hold from there on."
VARIABILITY = "What varies in the patient: all, none, or a comma list of k_abs, f, insulin_pk, circadian."


class Strategy(StrEnum):
    """The paper's seven modes."""

    NMA = "nma"
    SMA = "sma"
    MA = "ma"
    S1 = "s1"
    S2 = "s2"
    S3 = "s3"
    S4 = "s4"


def _version(wanted: bool) -> None:
    if wanted:
        console.print(f"pumpbench {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print it.")] = False,
) -> None:
    pass


@app.command()
def run(
    context: typer.Context,
    patient: Annotated[str, typer.Option(help=PATIENTS)] = "adult#001",
    strategy: Annotated[Strategy, typer.Option(help="Mode of the controller.")] = Strategy.S2,
    scenario: Annotated[str, typer.Option(help=SCENARIOS)] = "validation-14d",
    days: Annotated[float, typer.Option(help="Simulated days; rounded to steps of 5 min.", min=0.0)] = 1.0,
    seed: Annotated[int, typer.Option(help="Seed of everything random.", min=0)] = 1,
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
    sensor: Annotated[str, typer.Option(help=SENSORS)] = "coloured",
    physiology: Annotated[str | None, typer.Option(help=PHYSIOLOGIES)] = None,
    pramlintide: Annotated[str, typer.Option(help=PRAMLINTIDE)] = "P2",
    variability: Annotated[str, typer.Option(help=VARIABILITY)] = "all",
    controller: Annotated[Path | None, typer.Option(help="Controller models, by identify-controller.")] = None,
    origin: Annotated[str | None, typer.Option("--from", metavar="RUN@TIME", help=FROM)] = None,
    out: Annotated[Path | None, typer.Option(help="Run folder to write (default: below runs/).")] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace an existing run folder at --out.")] = False,
    serve: Annotated[
        int | None, typer.Option(help="Port at which Rerun's viewer shows the run while it is on.")
    ] = None,
    web: Annotated[int | None, typer.Option(help="And in a browser: port of the page, with --serve.")] = None,
    connect_timeout: Annotated[float, typer.Option(help="Seconds to wait for the firmware's first answer.")] = 20.0,
    step_timeout: Annotated[float, typer.Option(help="Seconds to wait for the firmware in a step.")] = 10.0,
) -> None:
    """Run the closed loop: patient, firmware and recorder on one bus. Exit status 1 if a hazard was counted."""
    from can_bus.lockstep import STEPS_PER_DAY  # noqa: PLC0415
    from pumpbench import rig  # noqa: PLC0415

    if origin is not None:
        requests = [
            forked(
                context,
                origin,
                out,
                device_bus=device_bus,
                reset_hook=reset_hook,
                reset_line=reset_line,
                overwrite=overwrite or out is None,
                serve=serve,
                web=web,
                connect_timeout=connect_timeout,
                step_timeout=step_timeout,
            )
        ]
        _run(requests)
        return
    names = _patients(patient)
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
            device_bus=device_bus,
            faults=faults,
            firmware=firmware,
            reset_hook=reset_hook,
            reset_line=reset_line,
            free_running=free_running,
            speed=speed,
            sensor=sensor,
            physiology=physiology,
            pramlintide=pramlintide,
            variability=varying,
            controller=controller,
            overwrite=overwrite or out is None,
            serve=serve,
            web=web,
            connect_timeout=connect_timeout,
            step_timeout=step_timeout,
        )
        for name in names
    ]
    _run(requests)


def _run(requests: list[Any]) -> None:
    from pumpbench import live, rig  # noqa: PLC0415

    prepared = [rig.prepare(request) for request in requests]
    for line in live.where(requests[0].serve, requests[0].web):
        errors.print(line, markup=False)
    folders = _execute(prepared)
    hazards = _print_outcomes(folders)
    if hazards:
        raise Failed(EXIT_WRONG, f"{hazards} hazards were counted: see safety.hazards in metrics.json")


def _patients(text: str) -> list[str]:
    from plant_server.physiology import cohort, patients_of  # noqa: PLC0415

    if text == "all":
        return list(cohort())
    names = []
    for name in (part.strip() for part in text.split(",")):
        names += [f"{name}#{row}" for row in patients_of(Path(name))] if name.endswith(".csv") else [name]
    return names


def _run_folder(out: Path | None, patient: str, several: bool, label: str) -> Path:
    name = patient.replace("#", "-").replace("/", "_")
    if out is None:
        return Path("runs") / f"{name}-{label}".replace("/", "_")
    return out / name if several else out


def _execute(prepared: list[Any]) -> list[Path]:
    import dataclasses  # noqa: PLC0415

    from pumpbench import rig  # noqa: PLC0415

    folders = []
    with progress_bar() as progress:
        for one in prepared:
            show = progress(f"{one.request.patient} {one.request.strategy}")
            steps = one.request.steps
            request = dataclasses.replace(one.request, progress=lambda step, show=show, of=steps: show(step, of))
            folders.append(rig.execute(dataclasses.replace(one, request=request)))
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


@app.command()
def identify_controller(
    patients: Annotated[str, typer.Argument(help="A name, a comma list, or all; file.csv#name or file.csv.")],
    out: Annotated[Path, typer.Option(help="CSV file to write, for --controller.")],
    physiology: Annotated[str | None, typer.Option(help=PHYSIOLOGIES)] = None,
    overwrite: Annotated[bool, typer.Option(help="Replace an existing file at --out.")] = False,
) -> None:
    """Identify what the controller must know of patients: K, tau and CIR from their responses to a meal and insulin."""
    from rich.table import Table  # noqa: PLC0415

    from plant_server.physiology import load_patient  # noqa: PLC0415
    from pumpbench.controller_model import COLUMNS, identify, write_models  # noqa: PLC0415

    if out.exists() and not overwrite:
        raise Failed(EXIT_USAGE, f"{out} exists already; give --overwrite to replace it")
    loaded = [load_patient(name, physiology=physiology) for name in _patients(patients)]
    with errors.status("identifying"):
        models = identify(loaded)
    write_models(out, models)
    table = Table(box=None, header_style="bold")
    for name in COLUMNS:
        table.add_column(name, justify="left" if name == "patient" else "right")
    for model in models:
        table.add_row(model.patient, *(f"{value:.5g}" for value in model[1:]))
    console.print(table)


WORKERS = "Processes on this machine (default: one per CPU)."
CLUSTER = "A dask scheduler to hand the runs to instead, e.g. tcp://127.0.0.1:8786."
VIA = "compiled, or a bus (inproc, hub, socketcan:vcan0): the same runs through the nodes themselves."


@app.command()
def campaign(
    out: Annotated[Path, typer.Option(help="Folder of the results; what is there already is not run again.")],
    patient: Annotated[str, typer.Option(help=PATIENTS)] = "all",
    modes: Annotated[str, typer.Option(help="Comma list of nma, sma, ma, s1, s2, s3, s4; or all.")] = "all",
    seeds: Annotated[str, typer.Option(help="Comma list of seeds and ranges, e.g. 1-10,42.")] = "1",
    days: Annotated[int, typer.Option(help="Simulated days of every run.", min=1)] = 14,
    scenario: Annotated[str, typer.Option(help=SCENARIOS + " Comma list.")] = "validation-14d",
    parameter: Annotated[
        list[str] | None, typer.Option("--set", help="NAME=V1,V2: values of a tuning parameter; may be repeated.")
    ] = None,
    sensor: Annotated[str, typer.Option(help=SENSORS)] = "coloured",
    pramlintide: Annotated[str, typer.Option(help=PRAMLINTIDE)] = "P2",
    variability: Annotated[str, typer.Option(help=VARIABILITY)] = "all",
    physiology: Annotated[str | None, typer.Option(help=PHYSIOLOGIES)] = None,
    controller: Annotated[Path | None, typer.Option(help="Controller models, by identify-controller.")] = None,
    workers: Annotated[int | None, typer.Option(help=WORKERS, min=1)] = None,
    cluster: Annotated[str | None, typer.Option(help=CLUSTER)] = None,
    via: Annotated[str, typer.Option(help=VIA)] = "compiled",
) -> None:
    """Many runs: patients x modes x scenarios x seeds x parameters. Writes OUT/results.parquet, one row per run."""
    from plant_server.physiology import load_patient  # noqa: PLC0415
    from pumpbench import campaign as campaigns  # noqa: PLC0415
    from pumpbench.rig import controller_model, variability_sources  # noqa: PLC0415

    chosen = [mode.value for mode in Strategy] if modes == "all" else [mode.strip() for mode in modes.split(",")]
    varying, tunings = variability_sources(variability), campaigns.parameter_grid(parameter or [])
    jobs = []
    for name in _patients(patient):
        own = load_patient(name, physiology=physiology, pramlintide=pramlintide)
        for each in scenario.split(","):
            jobs += campaigns.grid(
                [name],
                chosen,
                campaigns.seed_list(seeds),
                days,
                tunings=tunings,
                scenario=each.strip(),
                sensor=sensor,
                pramlintide=pramlintide,
                variability=varying,
                physiology=physiology,
                model=controller_model(name, own, controller),
            )
    with progress_bar() as progress:
        results = campaigns.execute(
            jobs, out / "results", workers=workers, cluster=cluster, via=via, progress=progress("runs")
        )
    path = results.write(jobs, out / "results.parquet")
    console.print(f"{len(jobs)} runs: {path}", soft_wrap=True)


@app.command()
def study(
    out: Annotated[Path, typer.Option(help="Folder of the report; an interrupted study goes on there.")],
    days: Annotated[int, typer.Option(help="Simulated days of every run; the paper has 14.", min=1, max=14)] = 14,
    patient: Annotated[str, typer.Option(help=PATIENTS)] = "all",
    seeds: Annotated[str, typer.Option(help="Seeds of the validation.")] = "1001-1010",
    controller: Annotated[Path | None, typer.Option(help="Controller models, by identify-controller.")] = None,
    workers: Annotated[int | None, typer.Option(help=WORKERS, min=1)] = None,
    cluster: Annotated[str | None, typer.Option(help=CLUSTER)] = None,
    via: Annotated[str, typer.Option(help=VIA)] = "compiled",
    quick: Annotated[bool, typer.Option(help="Without the second pramlintide set and the sensitivities.")] = False,
) -> None:
    """The paper's study: tuning, Tables 2 and 3, figures, report.html, and how far from the paper it all is."""
    from plant_server.physiology import load_patient  # noqa: PLC0415
    from pumpbench import campaign as campaigns  # noqa: PLC0415
    from pumpbench.rig import controller_model  # noqa: PLC0415

    try:
        from pumpbench.study import plan, run  # noqa: PLC0415
    except ImportError as error:
        raise Failed(EXIT_USAGE, f"{error.name} is missing: pip install 'pumpbench[study]'") from None
    names = tuple(_patients(patient))
    models = {name: controller_model(name, load_patient(name), controller) for name in names}
    with progress_bar() as progress:
        settings = run.Settings(
            out, plan.Cohort(names, models), days, tuple(campaigns.seed_list(seeds)), workers, cluster, via, quick
        )
        say = progress("study")
        report = run.Study(settings, lambda text: errors.print(text, markup=False), say).run()
    console.print(f"report: {report}", soft_wrap=True)


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True}, add_help_option=False)
def firmware(context: typer.Context) -> None:
    """Start the reference firmware on a bus, for people who bring the plant."""
    from firmware_sim.__main__ import main as node  # noqa: PLC0415

    raise typer.Exit(node(context.args))


@app.command(name="console")
def console_command(
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


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True}, add_help_option=False)
def gateway(context: typer.Context) -> None:
    """Join two buses, with faults in between."""
    from can_bus.gateway import main as node  # noqa: PLC0415

    raise typer.Exit(node(context.args))


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True}, add_help_option=False)
def record(context: typer.Context) -> None:
    """Record a bus into a run folder, next to firmware it knows nothing about."""
    from pumpbench.recorder import main as node  # noqa: PLC0415

    raise typer.Exit(node(context.args))


@app.command()
def plant(
    bus: Annotated[str, typer.Option(help="Bus URL the plant joins.")],
    host: Annotated[bool, typer.Option(help="Serve that URL as a hub, from this process.")] = False,
    patient: Annotated[str, typer.Option(help="Name of the virtual patient.")] = "adult#001",
    strategy: Annotated[Strategy, typer.Option(help="Mode to ask the firmware for.")] = Strategy.S2,
    scenario: Annotated[str, typer.Option(help=SCENARIOS)] = "validation-14d",
    days: Annotated[float, typer.Option(help="Simulated days.", min=0.0)] = 1.0,
    seed: Annotated[int, typer.Option(help="Seed of everything random.", min=0)] = 1,
    sensor: Annotated[str, typer.Option(help=SENSORS)] = "coloured",
    connect_timeout: Annotated[float, typer.Option(help="Seconds to wait for a firmware.")] = 60.0,
    step_timeout: Annotated[float, typer.Option(help="Seconds to wait for the firmware in a step.")] = 10.0,
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


@app.command()
def benchmark(
    json_file: Annotated[
        str | None, typer.Option("--json", help="Write the figures to this file; - is stdout.")
    ] = None,
    markdown: Annotated[
        Path | None, typer.Option(help="Write them as a page, with this machine's description.")
    ] = None,
    quick: Annotated[bool, typer.Option(help="One short run of each: to see that it works, not to quote.")] = False,
    peers: Annotated[
        bool, typer.Option(help="Beside simglucose too, which pip installs into a cache at the first time.")
    ] = True,
    only_vcan: Annotated[bool, typer.Option(help="Only the figures of a kernel's vcan0.", hidden=True)] = False,
) -> None:
    """Measure speed: each figure beside its ceiling, in one run."""
    from rich.table import Table  # noqa: PLC0415

    from pumpbench.benchmark.closed_loop import all_figures, as_json  # noqa: PLC0415
    from pumpbench.benchmark.page import number, page  # noqa: PLC0415

    with errors.status("measuring"):
        figures = all_figures(quick=quick, only_vcan=only_vcan, peers=peers)
    if json_file == "-":
        print(as_json(figures))
        return
    if json_file:
        Path(json_file).write_text(as_json(figures) + "\n", encoding="utf-8")
    if markdown:
        markdown.write_text(page(figures), encoding="utf-8")
    table = Table(box=None, header_style="bold")
    for name in ("figure", "value", "unit", "ceiling", "ratio", "runs"):
        table.add_column(name, justify="left" if name in ("figure", "unit") else "right")
    for figure in figures:
        value, ceiling, ratio = (number(figure[name]) for name in ("value", "ceiling", "ratio"))
        table.add_row(figure["name"], value, figure["unit"], ceiling, ratio, str(figure["runs"]))
    console.print(table)
    if not any("vcan" in figure["name"] for figure in figures):
        errors.print("no vcan on this machine and tools/with_vcan could not provide one: its figures are missing")


@app.command()
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


app.command(name="faults")(faults_command)
app.command()(matrix)
app.command()(hunt)
app.command()(conformance)
app.command()(report)
app.command()(diff)
app.command()(replay)
app.command()(doctor)
app.command()(checkpoint)
app.command()(view)
app.command()(snapshot)


class Interrupted(Exception):
    """Ctrl-C or SIGTERM."""


def _interrupt(number: int, _frame: object) -> None:
    raise Interrupted(f"interrupted by {signal.Signals(number).name}")


def main() -> None:
    """Entry point: every error of a kind we know is one line and an exit status."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)
    try:
        app()
    except Exception as error:
        status = _status(error)
        if status is None:
            raise
        errors.print(f"pumpbench: {error}", markup=False)
        sys.exit(status)


STATUS_OF = {
    "can_bus.address.BusUrlError": EXIT_USAGE,
    "can_bus.codec.CodecError": EXIT_USAGE,
    "can_bus.yaml_file.FileError": EXIT_USAGE,
    "plant_server.physiology.patients.PatientError": EXIT_USAGE,
    "plant_server.scenario.ScenarioError": EXIT_USAGE,
    "plant_server.sensor.SensorError": EXIT_USAGE,
    "pumpbench.calibration.CalibrationError": EXIT_USAGE,
    "pumpbench.campaign.CampaignError": EXIT_USAGE,
    "pumpbench.checkpoint.CheckpointError": EXIT_USAGE,
    "pumpbench.closed_loop.case.CaseError": EXIT_USAGE,
    "pumpbench.comparison.record.RecordError": EXIT_USAGE,
    "pumpbench.controller_model.ControllerModelError": EXIT_USAGE,
    "pumpbench.convert.ConvertError": EXIT_USAGE,
    "pumpbench.fork.ForkError": EXIT_USAGE,
    "pumpbench.hunt.HuntError": EXIT_USAGE,
    "pumpbench.recording.tool.RecordingError": EXIT_USAGE,
    "pumpbench.replay.ReplayError": EXIT_USAGE,
    "pumpbench.rig.RigError": EXIT_USAGE,
    "pumpbench.runfolder.RunFolderError": EXIT_USAGE,
    "plant_server.serve.MemberSilent": EXIT_DEAD,
    "plant_server.server.PlantError": EXIT_DEAD,
    "pumpbench.campaign.ClusterError": EXIT_DEAD,
    "pumpbench.closed_loop.result.LoopError": EXIT_DEAD,
    "pumpbench.rewind.Diverged": EXIT_DEAD,
    "pumpbench.rig.NodeDied": EXIT_DEAD,
    "pumpbench.runfolder.NotWritten": EXIT_DEAD,
    "can.exceptions.CanError": EXIT_DEAD,
    "builtins.OSError": EXIT_DEAD,
}
"""Exit status of the errors we know, by the class's name: an import for each would cost every error line seconds."""


def _status(error: Exception) -> int | None:
    """The exit status of an error, None for one that is our own mistake and deserves its traceback."""
    if isinstance(error, Failed):
        return error.status
    if isinstance(error, Interrupted):
        return EXIT_INTERRUPTED
    names = (f"{kind.__module__}.{kind.__qualname__}" for kind in type(error).__mro__)
    return next((STATUS_OF[name] for name in names if name in STATUS_OF), None)


if __name__ == "__main__":
    main()
