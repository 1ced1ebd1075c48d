"""The commands that do many runs: any grid of them, and the paper's study."""

from pathlib import Path
from typing import Annotated

import typer

from pumpbench.cli import options
from pumpbench.cli.terminal import EXIT_USAGE, Failed, console, errors, progress_bar


def campaign(
    out: Annotated[Path, typer.Option(help="Folder of the results; what is there already is not run again.")],
    patient: options.Patients = "all",
    modes: options.Modes = "all",
    seeds: Annotated[str, typer.Option(help="Comma list of seeds and ranges, e.g. 1-10,42.")] = "1",
    days: Annotated[int, typer.Option(help="Simulated days of every run.", min=1)] = 14,
    scenario: Annotated[str, typer.Option(help=f"{options.SCENARIOS} Comma list.")] = "validation-14d",
    parameter: Annotated[
        list[str] | None, typer.Option("--set", help="NAME=V1,V2: values of a tuning parameter; may be repeated.")
    ] = None,
    sensor: options.Sensor = "coloured",
    pramlintide: options.Pramlintide = "P2",
    variability: options.Variability = "all",
    physiology: options.Physiology = None,
    controller: options.Controller = None,
    workers: options.Workers = None,
    cluster: options.Cluster = None,
    via: options.Via = "compiled",
) -> None:
    """Many runs: patients x modes x scenarios x seeds x parameters. Writes OUT/results.parquet, one row per run."""
    from plant_server.physiology import load_patient  # noqa: PLC0415
    from pumpbench import campaign as campaigns  # noqa: PLC0415
    from pumpbench.controller_model import model_of  # noqa: PLC0415
    from pumpbench.rig import variability_sources  # noqa: PLC0415

    varying, tunings = variability_sources(variability), campaigns.parameter_grid(parameter or [])
    jobs = []
    for name in options.patients(patient):
        own = load_patient(name, physiology=physiology, pramlintide=pramlintide)
        for each in options.names_in(scenario):
            jobs += campaigns.grid(
                [name],
                options.modes(modes),
                campaigns.seed_list(seeds),
                days,
                tunings=tunings,
                scenario=each,
                sensor=sensor,
                pramlintide=pramlintide,
                variability=varying,
                physiology=physiology,
                model=model_of(own, controller, name),
            )
    with progress_bar() as progress:
        results = campaigns.execute(
            jobs, out / "results", workers=workers, cluster=cluster, via=via, progress=progress("runs")
        )
    path = results.write(jobs, out / "results.parquet")
    console.print(f"{len(jobs)} runs: {path}", soft_wrap=True)


def study(
    out: Annotated[Path, typer.Option(help="Folder of the report; an interrupted study goes on there.")],
    days: Annotated[int, typer.Option(help="Simulated days of every run; the paper has 14.", min=1, max=14)] = 14,
    patient: options.Patients = "all",
    seeds: Annotated[str, typer.Option(help="Seeds of the validation.")] = "1001-1010",
    controller: options.Controller = None,
    workers: options.Workers = None,
    cluster: options.Cluster = None,
    via: options.Via = "compiled",
    quick: Annotated[bool, typer.Option(help="Without the second pramlintide set and the sensitivities.")] = False,
) -> None:
    """The paper's study: tuning, Tables 2 and 3, figures, report.html, and how far from the paper it all is."""
    from plant_server.physiology import load_patient  # noqa: PLC0415
    from pumpbench import campaign as campaigns  # noqa: PLC0415
    from pumpbench.controller_model import model_of  # noqa: PLC0415

    try:
        from pumpbench.study import plan, run  # noqa: PLC0415
    except ImportError as error:
        raise Failed(EXIT_USAGE, f"{error.name} is missing: pip install 'pumpbench[study]'") from None
    names = tuple(options.patients(patient))
    models = {name: model_of(load_patient(name), controller, name) for name in names}
    with progress_bar() as progress:
        settings = run.Settings(
            out, plan.Cohort(names, models), days, tuple(campaigns.seed_list(seeds)), workers, cluster, via, quick
        )
        say = progress("study")
        report = run.Study(settings, lambda text: errors.print(text, markup=False), say).run()
    console.print(f"report: {report}", soft_wrap=True)
