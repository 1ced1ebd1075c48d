"""What of two runs is shown as lanes: states, faults and alarms of both, and the messages that differ."""

from __future__ import annotations

from typing import Final

from pumpbench.comparison import account
from pumpbench.comparison.align import Kind
from pumpbench.comparison.report import Report
from pumpbench.pictures.lanes import Bar, Lane, lanes_of

COLOURS: Final = ("#2f7fd6", "#e07b00")
"""Of A and of B, in pictures and recordings alike; both can be read on white and on black."""

WIDTHS: Final = (4.0, 1.5)
"""Of their lines: A shows on both sides of B where they are the same."""

PARTED: Final = "#d62f2a"
APART: Final = "#8a5fb0"

KINDS: Final[dict[Kind, str]] = {"changed": PARTED, "missing": COLOURS[0], "extra": COLOURS[1], "moved": "#8a8a8a"}
"""Where only one of the runs has the frames, the lane has the colour of that run."""

MAX_LANES: Final = 8
"""Messages with a lane of their own; the report counts all of them."""


def words(report: Report) -> dict[Kind, str]:
    """How a message differs, as a lane says it."""
    a, b = report.names
    return {"changed": "differs", "missing": f"only {a}", "extra": f"only {b}", "moved": "moved"}


def state_lanes(report: Report) -> list[Lane]:
    """The firmware's state in A and in B; of pump, sensor, faults and alarms what is not the same in both."""
    sides = [{lane.name: lane for lane in lanes_of(record.trace)} for record in (report.a, report.b)]
    found = []
    for what in dict.fromkeys(name for side in sides for name in side):
        lanes = [side.get(what, Lane(what, [])) for side in sides]
        if what == "firmware" or lanes[0] != lanes[1]:
            found += [Lane(f"{what}, {name}", lane.bars) for name, lane in zip(report.names, lanes, strict=True)]
    return found


def message_lanes(report: Report) -> list[Lane]:
    """The messages that differ first, and when."""
    named = words(report)
    return [
        Lane(message, [Bar(run.start_s, run.end_s, named[run.kind], KINDS[run.kind]) for run in runs])
        for message, runs in [*account.stretches(report.comparison).items()][:MAX_LANES]
    ]
