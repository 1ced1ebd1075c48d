"""How a recording looks: the blueprints, one per reader."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from pumpbench.recording.columns import TIMELINE


def blueprint(
    start_s: float,
    end_s: float,
    *,
    gateway: bool = False,
    bus_top: float = 60.0,
    glucose_top: float = 320.0,
    lanes: int = 6,
) -> Any:
    """The layout of a recording as a `rerun.blueprint.Blueprint`, with all time axes linked.

    Args:
        start_s, end_s: simulated seconds the axes show at first.
        gateway: whether a second bus, the plant's, was recorded.
        bus_top: upper end of the axis of frames per step.
        glucose_top: upper end of the axis of glucose, mg/dL; the same for all runs that stay below it, to compare them.
        lanes: number of alarms, faults and states to make room for.
    """
    import rerun as rr  # noqa: PLC0415
    import rerun.blueprint as rrb  # noqa: PLC0415

    left_margin, right_margin = 0.17 * (end_s - start_s), 0.01 * (end_s - start_s)  # the legends stand on the left
    nanos = [round(time_s * 1e9) for time_s in (start_s - left_margin, end_s + right_margin)]
    window = rr.TimeRange(
        start=rr.TimeRangeBoundary.absolute(nanos=nanos[0]), end=rr.TimeRangeBoundary.absolute(nanos=nanos[1])
    )
    axis = rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)
    legend = rrb.PlotLegend(corner=rrb.Corner2D.LeftTop)
    tip = rrb.PlotInteraction(tooltip_mode="All")

    def plot(name: str, contents: Iterable[str], y_range: tuple[float, float] | None = None) -> Any:
        return rrb.TimeSeriesView(
            name=name,
            contents=[f"+ /{path}" for path in contents],
            axis_x=axis,
            axis_y=rrb.ScalarAxis(range=y_range) if y_range else None,
            plot_legend=legend,
            interaction=tip,
        )

    left = rrb.Vertical(
        plot("Glucose [mg/dL]", ["glucose/**", "limits/**"], (40, glucose_top)),
        plot("Insulin: commanded against delivered", ["insulin/**"]),
        plot("Pramlintide: commanded against delivered", ["pramlintide/**"]),
        plot("Stomach", ["stomach/**"]),
        rrb.StateTimelineView(
            name="Alarms, injected faults, states",
            contents=["+ /alarm/**", "+ /fault/**", "+ /state/**"],
            time_view=axis,
        ),
        row_shares=[3.4, 2.4, 2.4, 1.9, min(1.2 + 0.5 * lanes, 6.0)],
    )
    log_columns = rrb.TextLogColumns(
        timeline_columns=[rrb.components.TimelineColumn(TIMELINE, visible=False)], text_log_columns=["loglevel", "body"]
    )
    frame_columns = rrb.TextLogColumns(
        timeline_columns=[rrb.components.TimelineColumn(TIMELINE, visible=False)], text_log_columns=["loglevel", "body"]
    )
    tables = [rrb.TextLogView(name="Frames, device's bus", origin="/can/can0", columns=frame_columns)]
    if gateway:
        tables.append(rrb.TextLogView(name="Frames, plant's bus", origin="/can/can1", columns=frame_columns))
    tables.append(rrb.DataframeView(name="Raw", origin="/can/can0"))
    right = rrb.Vertical(
        rrb.TextLogView(name="Alarms, faults, meals, states", origin="/log", columns=log_columns),
        rrb.Tabs(
            plot("Bus: frames per step, firmware's counters", ["bus/**"], (0, bus_top)),
            plot("Plasma levels, insulin on board", ["body/**"]),
            active_tab=0,
        ),
        rrb.Tabs(*tables, rrb.TextDocumentView(name="Run", origin="/run"), active_tab=0),
        row_shares=[4, 3.5, 4],
    )
    return _linked(rrb, rr)(
        rrb.Horizontal(left, right, column_shares=[64, 36]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        rrb.TopPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
        window=window,
    )


def _linked(rrb: Any, rr: Any) -> Callable[..., Any]:
    """A blueprint class that also sets the range of the axis all views are linked to."""

    class LinkedBlueprint(rrb.Blueprint):  # type: ignore[misc]
        """The viewer keeps the linked range in a view of its own, whose id has been the same since 0.36."""

        _GLOBAL_VIEW = "view/5c0dca6a-e63f-9cf7-f657-2602590474cc/TimeAxis"

        def __init__(self, *parts: Any, window: Any, **options: Any) -> None:
            super().__init__(*parts, **options)
            self._window = window

        def _log_to_stream(self, stream: Any) -> None:
            super()._log_to_stream(stream)
            stream.log(self._GLOBAL_VIEW, rrb.TimeAxis(view_range=self._window))

    return LinkedBlueprint
