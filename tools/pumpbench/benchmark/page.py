"""docs/performance.md: the figures of one run of the benchmark, with the machine they were measured on."""

import importlib.metadata
import os
import platform
from collections.abc import Sequence
from pathlib import Path

from pumpbench import __version__
from pumpbench.benchmark.figure import Figure

PACKAGES = ("numpy", "numba", "python-can", "cantools", "pyarrow", "rerun-sdk")

INTRO = """# Performance

Written by `pumpbench benchmark --markdown docs/performance.md`; nothing here is typed by hand, and no test depends on
it. A figure is the median of its runs beside a ceiling or a peer **of the same run on the same machine**, so the ratio
means more than the value.

| figure | what it is | beside |
|---|---|---|
| `plant/alone` | the patient's integration in calls of 5 min | one call per day |
| `closed-loop/compiled`, `/2` | whole runs as campaigns make them, one core and two | plant alone; twice one core |
| `closed-loop/inproc`, `hub`, `vcan` | plant, firmware, recorder on a bus | plant alone; a round trip per frame |
| `closed-loop/BUS/exchange` | the same | the bare exchange of a step's frames as batches on raw sockets |
| `round-trips/...` | a frame there and one back | raw sockets of that bus |
| `codec/pack`, `unpack` | one frame, raw integers | cantools without scaling |
| `codec/protected` | packing, counter and checksum | the checksum alone, in C |
| `recorder/listening` | a run with the recorder | the same run without |
| `recorder/beside`, `watched` | a run on a hub, the recorder a process, and watched | the same run without |
| `recorder/writing` | the run folder, recording and picture included | the run itself |
| `start/...` | starts of a process | a bare Python |
| `memory/campaign` | resident memory after ten adults in seven modes, 14 days | what a study may take |
| `scaling/ten patients` | ten patients one after the other | one patient ten times |
| `plant/vs-simglucose` | speed and agreement | simglucose on the same day |
"""


def machine() -> str:
    """One line: processor, cores, system, versions."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.partition(":")[2].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        cpu = names[0] if names else cpu
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in PACKAGES)
    return (
        f"{cpu}, {os.cpu_count()} CPUs, {platform.system()} {platform.release()}, Python {platform.python_version()}, "
        f"pumpbench {__version__}; {versions}."
    )


def number(value: float) -> str:
    """Three digits at least, and no more behind the point than that takes."""
    return f"{value:,.1f}" if abs(value) >= 10.0 else f"{value:.3g}"


def page(figures: Sequence[Figure], before: str = "") -> str:
    """The whole page; what stands behind the figures of the page `before` is others', and stays."""
    rows = [
        f"| `{each['name']}` | {number(each['value'])} | {each['unit']} | {number(each['ceiling'])} "
        f"| {number(each['ratio'])} | {each['runs']} |"
        for each in figures
    ]
    table = ["| figure | value | unit | ceiling or peer | ratio | runs |", "|---|---:|---|---:|---:|---:|", *rows]
    _, heading, kept = before.partition("\n## Measured\n")[2].partition("\n## ")
    return f"{INTRO}\n## Measured\n{machine()}\n\n" + "\n".join(table) + f"\n{heading}{kept}"
