"""The command that measures speed."""

from pathlib import Path
from typing import Annotated

import typer

from pumpbench.cli.terminal import console, errors


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
        before = markdown.read_text(encoding="utf-8") if markdown.exists() else ""
        markdown.write_text(page(figures, before), encoding="utf-8")
    table = Table(box=None, header_style="bold")
    for name in ("figure", "value", "unit", "ceiling", "ratio", "runs"):
        table.add_column(name, justify="left" if name in ("figure", "unit") else "right")
    for figure in figures:
        value, ceiling, ratio = (number(figure[name]) for name in ("value", "ceiling", "ratio"))
        table.add_row(figure["name"], value, figure["unit"], ceiling, ratio, str(figure["runs"]))
    console.print(table)
    if not any("vcan" in figure["name"] for figure in figures):
        errors.print("no vcan on this machine and tools/with_vcan could not provide one: its figures are missing")
