"""The pictures of a run for the page: the whole of it, and a close-up of each thing worth one."""

from __future__ import annotations

import base64
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pumpbench.pictures.summary import write_close_ups, write_summary
from pumpbench.runfolder import SUMMARY
from pumpbench.story import clock
from pumpbench.trace import Trace


class Picture(NamedTuple):
    """A PNG as a data URL, with what stands below it and what is read out instead of it."""

    url: str
    caption: str
    alt: str


def pictures(trace: Trace, metrics: Mapping[str, Any]) -> list[Picture]:
    """Draw a run: all of it, then its close-ups in order of time."""
    shown = (
        "True glucose and CGM, insulin and pramlintide commanded and delivered, states of firmware, pump and sensor, "
        "faults, alarms"
    )
    with tempfile.TemporaryDirectory(prefix="pumpbench-") as name:
        folder = Path(name)
        write_summary(trace, folder / SUMMARY, metrics)
        whole = _url(folder / SUMMARY)
        found = [Picture(whole, f"The whole run. {shown}.", f"The whole run: {shown.lower()} over time")]
        for closeup, path in write_close_ups(trace, folder):
            span = f"from {clock(closeup.start_s)} to {clock(closeup.end_s)}"
            found.append(Picture(_url(path), f"{closeup.name}: {span}.", f"Close-up {span}: {closeup.name}"))
    return found


def _url(path: Path) -> str:
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"
