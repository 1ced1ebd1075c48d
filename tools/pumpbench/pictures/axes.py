"""What the axes of every picture have in common: simulated time, means of an hour, a legend beside the plot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from can_bus.lockstep import STEP_SECONDS
from pumpbench.story import clock

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Array = NDArray[Any]

HOUR: Final = 3600.0
DAY: Final = 86400.0
LONG_RUN: Final = 2.5 * DAY
"""From here on doses are drawn as means over an hour."""


def binned(time_s: Array, values: Array, every: int) -> tuple[Array, Array]:
    """Edges and means of bins of `every` steps, over the steps that lead somewhere (all but the last instant)."""
    values = values[:-1]
    if not len(values):
        return np.array([0.0, STEP_SECONDS]), np.array([np.nan])
    bins = -(-len(values) // every)
    padded = np.full(bins * every, np.nan)
    padded[: len(values)] = values
    table = padded.reshape(bins, every)
    counts = (~np.isnan(table)).sum(axis=1)
    means = np.divide(np.nansum(table, axis=1), counts, out=np.full(bins, np.nan), where=counts > 0)
    edges = time_s[0] + STEP_SECONDS * np.minimum(np.arange(bins + 1) * every, len(values))
    return edges, means


def legend(axis: Any, handles: Sequence[list[Any]] = (), offset: float = 1.01) -> None:
    """Beside the plot, where it covers no data."""
    shown = handles or axis.get_legend_handles_labels()
    if shown[0]:
        axis.legend(
            *shown, loc="upper left", bbox_to_anchor=(offset, 1.02), frameon=False, fontsize=9, handlelength=1.6
        )


def time_axis(axis: Any, start_s: float, end_s: float) -> None:
    """Label an axis of simulated seconds as people read time: hh:mm, days in long runs."""
    span = end_s - start_s
    axis.set_xlim(start_s - 0.004 * span, end_s + 0.004 * span)
    if span <= 1.5 * HOUR:
        step = 600.0
    elif span <= 5 * HOUR:
        step = HOUR / 2
    elif span <= 9 * HOUR:
        step = HOUR
    elif span <= 1.5 * DAY:
        step = 2 * HOUR
    elif span <= LONG_RUN:
        step = 6 * HOUR
    else:
        step = DAY * max(1, round(span / DAY / 20))
    ticks = np.arange(np.ceil(start_s / step) * step, end_s + 1, step)
    if step >= DAY:
        texts = [f"d{tick / DAY:.0f}" for tick in ticks]
    elif span > 1.2 * DAY:
        texts = [clock(tick) for tick in ticks]
    else:
        texts = [clock(tick).split(" ")[1] for tick in ticks]
    axis.set_xticks(ticks, texts)
    where = (
        "day, from midnight" if step >= DAY else "simulated time, day hh:mm" if span > 1.2 * DAY else "simulated time"
    )
    axis.set_xlabel(where, fontsize=9, labelpad=2)
