"""The commands about faults: the catalogue, the matrix and the hunt."""

from pathlib import Path
from typing import Annotated, Any

import typer

from pumpbench.cli import options
from pumpbench.cli.terminal import EXIT_USAGE, EXIT_WRONG, Failed, console, errors, progress_bar

JOBS = "Processes (default: one per CPU)."


def faults(
    kind: Annotated[str | None, typer.Argument(help="A kind, for its keys and examples (default: list all).")] = None,
) -> None:
    """The catalogue of faults: what each does, what it puts to the test, who notices."""
    from rich.table import Table  # noqa: PLC0415

    from pumpbench import catalogue  # noqa: PLC0415
    from pumpbench.faults import KINDS  # noqa: PLC0415

    if kind is None:
        table = Table(box=None, header_style="bold")
        table.add_column("kind", no_wrap=True)
        table.add_column("what it does")
        for name in KINDS:
            table.add_row(name, catalogue.summary(name))
        console.print(table)
        console.print("`pumpbench faults KIND` shows its keys and examples; docs/faults.md has them all.")
        return
    if kind not in KINDS:
        import difflib  # noqa: PLC0415

        near = difflib.get_close_matches(kind, list(KINDS), 3)
        hint = f"did you mean {' or '.join(near)}?" if near else f"there are {', '.join(KINDS)}"
        raise Failed(EXIT_USAGE, f"there is no kind of fault {kind!r}; {hint}")
    console.print(catalogue.describe(kind), markup=False, soft_wrap=True)
    console.print()
    for name, text in catalogue.parameters(kind).items():
        console.print(f"  {name:12} {text}", markup=False, soft_wrap=True)
    for entry in catalogue.examples(kind):
        console.print(f"\n# {entry.name}: puts {', '.join(entry.hazards)} to the test, {entry.noticed}", soft_wrap=True)
        console.print(catalogue.as_file(entry), markup=False, soft_wrap=True, end="")


def matrix(
    seeds: Annotated[int, typer.Option(help="Seeds of every entry in every mode.", min=1)] = 20,
    modes: options.Modes = "all",
    jobs: Annotated[int | None, typer.Option(help=JOBS, min=1)] = None,
    markdown: Annotated[Path | None, typer.Option(help="Write the table to this page.")] = None,
) -> None:
    """Every fault of the catalogue in every mode: no hazard, and what can be seen is seen. Exit status 1 if not."""
    from pumpbench import matrix as matrices  # noqa: PLC0415
    from pumpbench.files import write_file  # noqa: PLC0415
    from pumpbench.parallel import cpus  # noqa: PLC0415

    with progress_bar() as progress:
        cells = matrices.run(seeds, options.modes(modes), jobs=jobs or cpus(), told=progress("matrix"))
    wrong = [cell for cell in cells if cell.wrong]
    for cell in wrong[:20]:
        errors.print(f"{cell.entry.name}, mode {cell.mode}, seed {cell.seed}: {cell.wrong}", markup=False)
    outdated = matrices.outdated(cells)
    for name, signs in outdated.items():
        errors.print(f"{name}: seen in every run, by {', '.join(sorted(signs))}: the catalogue says nothing is")
    if markdown is not None:
        write_file(markdown, matrices.page(cells).encode())
    console.print(f"{len(cells)} runs, {len(wrong)} of them wrong")
    if wrong or outdated:
        raise Failed(EXIT_WRONG, f"{len(wrong)} of {len(cells)} runs and {len(outdated)} reasons were wrong")


def hunt(
    out: Annotated[Path, typer.Option(help="Folder of the verdicts and of the tests; an interrupted hunt goes on.")],
    runs: Annotated[int, typer.Option(help="Cases of this seed, counted from 0.", min=1)] = 1000,
    seed: Annotated[int, typer.Option(help="Of everything that is drawn.", min=0)] = 1,
    modes: options.Modes = "all",
    jobs: Annotated[int | None, typer.Option(help=JOBS, min=1)] = None,
    bus: Annotated[str, typer.Option(help="inproc, hub, or a URL.")] = "inproc",
    firmware: Annotated[str | None, typer.Option(help='Another firmware, on a bus; "{bus}" becomes its URL.')] = None,
    max_low: Annotated[
        float | None, typer.Option(help="Minutes below 54 mg/dL, more than without the faults, that are a failure.")
    ] = None,
    max_high: Annotated[float | None, typer.Option(help="The same above 250 mg/dL.")] = None,
) -> None:
    """Hunt for faults that do harm: random ones, by seed; what fails is shrunk and written as a test. Exit status 1."""
    from pumpbench import hunt as hunts  # noqa: PLC0415
    from pumpbench.parallel import cpus  # noqa: PLC0415

    processes = (jobs or cpus()) if bus in ("inproc", "hub") else 1  # a bus of somebody's has room for one run
    settings = hunts.Settings(out, runs, seed, tuple(options.modes(modes)), processes, bus, firmware, max_low, max_high)
    with progress_bar() as progress:
        result = hunts.run(settings, progress("hunt"), _tell)
    console.print(f"{result.runs} cases, {result.injected} faults at work, {result.failed} failures")
    for name, worst in (("below 54", result.lowest), ("above 250", result.highest)):
        if worst:
            told = ", ".join(f"case {case}: {minutes:+.0f} min" for case, minutes in worst)
            console.print(f"most time {name} mg/dL against the same run without faults: {told}", soft_wrap=True)
    if result.failed:
        raise Failed(EXIT_WRONG, f"{result.failed} of {result.runs} cases failed; their tests are in {out}")


def _tell(found: Any, path: Path) -> None:
    kinds = ", ".join(fault.kind for fault in found.left.faults)
    what = found.verdict.error or ", ".join(found.verdict.hazards) or "the outcome"
    errors.print(f"case {found.number}: {what}; left of it: {kinds} -> {path}", markup=False)
