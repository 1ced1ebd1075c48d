"""How a recording looks: a tab for each of its readers, made of a few parts.

The whole day, the bus, the patient, and a close-up of every fault and alarm. The tabs of the whole run share one time
axis: moving one plot moves all. A close-up has a window of its own, and that the viewer has only for plots that are not
linked: it has one linked window, not one for each tab.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final

import rerun as rr
import rerun.blueprint as rrb

from pumpbench.closeups import CloseUp
from pumpbench.recording.columns import TIMELINE
from pumpbench.recording.scene import FRAME_MS, Scene

Window = tuple[float, float]
"""Simulated seconds, from and to."""

LAYOUTS: Final = ("day", "bus", "patient")
"""The tabs that every recording has; those of close-ups follow."""

LEGEND_SHARE: Final = 0.17
"""Of a plot's width, kept free of data on the left, where the legend stands."""


class LayoutError(ValueError):
    """A tab or view that there is not; the text names those there are."""


class Blueprint(rrb.Blueprint):  # type: ignore[misc]
    """A blueprint with a linked window. The viewer keeps it in a view of its own.

    That view's id has been the same since 0.36.
    """

    _GLOBAL_VIEW = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"

    def __init__(self, *parts: Any, window: Any, **options: Any) -> None:
        super().__init__(*parts, **options)
        self._window = window

    def _log_to_stream(self, stream: Any) -> None:
        super()._log_to_stream(stream)
        stream.log(self._GLOBAL_VIEW, rrb.TimeAxis(view_range=self._window))


def blueprint(scene: Scene, layout: str = "day", window: Window | None = None, view: str | None = None) -> Blueprint:
    """The looks of a recording as a `rerun.blueprint.Blueprint`.

    Args:
        scene: the run.
        layout: the tab in front: one of `LAYOUTS`, or the name of a close-up.
        window: what the linked time axes show at first; the whole run when left out.
        view: name of the one view of that tab to be shown, and nothing else.

    Raises:
        LayoutError: there is no such tab or view, or a close-up is given another window.
    """
    names = [*LAYOUTS, *(closeup.name for closeup in scene.close_ups)]
    if layout not in names:
        raise LayoutError(f"no layout {layout!r}; there are {', '.join(names)}")
    if layout not in LAYOUTS and window is not None:
        raise LayoutError(f"{layout!r} has a window of its own; the others are {', '.join(LAYOUTS)}")
    tabs = [day(scene), bus(scene), patient(scene)]
    tabs += [close_up(scene, closeup, number) for number, closeup in enumerate(scene.close_ups, 1)]
    chosen = names.index(layout)
    root = rrb.Tabs(*tabs, active_tab=chosen) if view is None else _view(tabs[chosen], view)
    return linked(root, window or (scene.start_s, scene.end_s))


def live_blueprint(scene: Scene, shown_s: float) -> Blueprint:
    """The looks of a recording that grows: its last simulated seconds, as far as the viewer follows.

    Args:
        scene: what is known of the run.
        shown_s: how many.
    """
    return linked(rrb.Tabs(day(scene), bus(scene), patient(scene)), (-shown_s, 0.0), live=True)


def _view(tab: Any, name: str) -> Any:
    found = {view.name: view for view in views(tab)}
    if name not in found:
        raise LayoutError(f"no view {name!r} in {tab.name}; there are {', '.join(found)}")
    return found[name]


def views(part: Any) -> list[Any]:
    """All views of a container, or the view itself."""
    return [part] if isinstance(part, rrb.View) else [view for each in part.contents for view in views(each)]


# ---------------------------------------------------------------------------------------------------------------- tabs


def day(scene: Scene) -> Any:
    """The whole run: glucose, both drugs, what was wrong, and what happened in words."""
    left = rrb.Vertical(
        *_loop(scene),
        lanes("Alarms, injected faults, states", ["alarm/**", "fault/**", "state/**"]),
        row_shares=[3.4, 2.2, 2.2, _lane_share(scene)],
    )
    right = rrb.Vertical(
        log("What happened", "log"),
        rrb.Tabs(*_tables(scene), rrb.TextDocumentView(name="Outcome and run", origin="/run"), active_tab=0),
        row_shares=[4, 4],
    )
    return rrb.Horizontal(left, right, column_shares=[66, 34], name="Day" if scene.end_s <= 1.5 * 86400 else "All days")


def bus(scene: Scene) -> Any:
    """The wire: how much, which messages, what was damaged or missed, and every frame."""
    left = rrb.Vertical(
        plot("Frames per step", ["bus/frames/**"], _from_zero(scene.frames_top)),
        plot("Time they take at 500 kbit/s [ms per step]", ["bus/load/**"], _from_zero(FRAME_MS * scene.frames_top)),
        plot("Errors: damaged frames, counters of the firmware", ["bus/errors/**"]),
        lanes("Injected faults, states", ["fault/**", "state/**"]),
        row_shares=[2, 2, 2.4, 3],
    )
    rates = [lanes("Messages per step, device's bus", ["rate/can0/**"])]
    if scene.gateway:
        rates.append(lanes("Messages per step, plant's bus", ["rate/can1/**"]))
    right = rrb.Vertical(rrb.Tabs(*rates, active_tab=0), rrb.Tabs(*_tables(scene), active_tab=0), row_shares=[7, 3])
    return rrb.Horizontal(left, right, column_shares=[50, 50], name="Bus")


def patient(scene: Scene) -> Any:
    """The body: what was eaten, how it leaves the stomach, and both drugs in the blood."""
    left = rrb.Vertical(
        glucose(scene),
        plot("Stomach: content [g]", ["stomach/content"]),
        plot("Emptying η [% of the normal rate]", ["stomach/eta"], (0, 105)),
        plot("Glucose appearing from the gut [mg/kg/min]", ["stomach/appearance"]),
        row_shares=[3, 2, 2, 2],
    )
    right = rrb.Vertical(
        plot("Insulin in plasma [mU/L]", ["body/plasma_insulin"]),
        plot("Insulin on board, as the firmware counts it [U]", ["body/insulin_on_board"]),
        plot("Pramlintide in plasma [pmol/L]", ["body/plasma_pramlintide"]),
        lanes("Alarms, injected faults", ["alarm/**", "fault/**"]),
        row_shares=[2, 2, 2, 2],
    )
    return rrb.Horizontal(left, right, column_shares=[50, 50], name="Patient")


def close_up(scene: Scene, closeup: CloseUp, number: int) -> Any:
    """A fault or an alarm, an hour before and after: the loop around it, and what happened with its times."""
    window = closeup.start_s, closeup.end_s
    left = rrb.Vertical(
        *_loop(scene, window),
        lanes("Alarms, injected faults, states", ["alarm/**", "fault/**", "state/**"], window),
        row_shares=[3.4, 2.2, 2.2, _lane_share(scene)],
    )
    right = rrb.Vertical(
        rrb.TextDocumentView(name="What happened", origin=f"/closeup/{number}"),
        lanes("Messages per step, device's bus", ["rate/can0/**"], window),
        row_shares=[5, 4],
    )
    return rrb.Horizontal(left, right, column_shares=[66, 34], name=closeup.name)


def _loop(scene: Scene, window: Window | None = None) -> list[Any]:
    return [
        glucose(scene, window),
        plot("Insulin: commanded against delivered [U/h, U]", ["insulin/**"], _from_zero(scene.insulin_top), window),
        plot(
            "Pramlintide: commanded against delivered [µg/h, µg]",
            ["pramlintide/**"],
            _from_zero(scene.pram_top),
            window,
        ),
    ]


def _from_zero(top: float) -> tuple[float, float]:
    return -0.03 * top, 1.08 * top


def _tables(scene: Scene) -> list[Any]:
    tables = [log("Frames, device's bus", "can/can0")]
    return [*tables, log("Frames, plant's bus", "can/can1")] if scene.gateway else tables


def _lane_share(scene: Scene) -> float:
    return min(1.2 + 0.5 * scene.lanes, 6.0)


# --------------------------------------------------------------------------------------------------------------- parts


def glucose(scene: Scene, window: Window | None = None) -> Any:
    """Glucose against CGM, on the same scale in all runs."""
    return plot("Glucose [mg/dL]", ["glucose/**", "limits/**"], (40, scene.glucose_top), window)


def plot(
    name: str, contents: Iterable[str], y_range: tuple[float, float] | None = None, window: Window | None = None
) -> Any:
    """A plot of entities (`insulin/**`); without a window its time axis is linked to all others."""
    return rrb.TimeSeriesView(
        name=name,
        contents=[f"+ /{path}" for path in contents],
        axis_x=_axis(window),
        axis_y=rrb.ScalarAxis(range=y_range) if y_range else None,
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),
        interaction=rrb.PlotInteraction(tooltip_mode="All"),
    )


def lanes(name: str, contents: Iterable[str], window: Window | None = None) -> Any:
    """States as lanes, the entities from top to bottom in alphabetical order."""
    return rrb.StateTimelineView(name=name, contents=[f"+ /{path}" for path in contents], time_view=_axis(window))


def log(name: str, origin: str) -> Any:
    """Lines of text; it follows the time cursor. The viewer's column of times is too narrow, the text has them."""
    columns = rrb.TextLogColumns(
        timeline_columns=[rrb.components.TimelineColumn(TIMELINE, visible=False)], text_log_columns=["loglevel", "body"]
    )
    return rrb.TextLogView(name=name, origin=f"/{origin}", columns=columns)


def linked(root: Any, window: Window, *, live: bool = False) -> Blueprint:
    """A blueprint whose linked time axes begin with a window; if `live`, one that goes along with the newest data."""
    return Blueprint(
        root,
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following" if live else "paused"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.TopPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
        window=_range(window, relative=live),
    )


def _axis(window: Window | None) -> Any:
    if window is None:
        return rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    return rrb.TimeAxis(link=rrb.components.LinkAxis.Independent, view_range=_range(window))


def _range(window: Window, *, relative: bool = False) -> Any:
    """The range of an axis; if `relative`, to the time cursor."""
    start_s, end_s = window
    span = end_s - start_s
    nanos: Sequence[int] = [round(time_s * 1e9) for time_s in (start_s - LEGEND_SHARE * span, end_s + 0.01 * span)]
    boundary = rr.TimeRangeBoundary.cursor_relative if relative else rr.TimeRangeBoundary.absolute
    start, end = (boundary(nanos=each) for each in nanos)
    return rr.TimeRange(start=start, end=end)
