"""Initial layout of a recording, with the scene on the left and plots on the right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from srs_twin.viewing.additions import FollowedSignal

TIMELINE = "sim_time"
"""Name of the timeline for the simulated time (s)."""

CAMERA_TARGET = "eye"
"""Entity inside `world/` that the camera follows."""

_PERIODS_SHOWN = 4
"""Number of gait periods that plots show around the time cursor."""

Rows = list[rrb.Container | rrb.View]


@dataclass(frozen=True)
class Layout:
    """Parameters for the viewer layout of one run.

    Attributes:
        start: mean start position of the plants, m, shape (2,).
        heading: initial heading, rad.
        body_length: body length, m.
        separation: twice the maximum distance of a plant from the mean position, m.
        period: gait period, s, or None if plots show the whole run instead of a few
            periods around the time cursor.
        compared: whether to plot the differences between the plants.
        signals: signals that are plotted above all other signals.
        speeds: limits of the speed axis, m/s, or None for automatic limits.
        events: whether the run has events.
        root: parent entity of the run in a recording of several runs.
        measured: quantities compared with a measured robot ("shape", "path", "bend").
    """

    plants: Sequence[str]
    segments: int
    start: np.ndarray
    heading: float
    body_length: float
    separation: float
    period: float | None = None
    compared: bool = False
    kind: str = "gait"
    signals: Sequence[FollowedSignal] = ()
    speeds: tuple[float, float] | None = None
    events: bool = False
    root: str = ""
    measured: Sequence[str] = ()

    @property
    def world(self) -> str:
        """Entity that contains the scene."""
        if self.root:
            return f"{self.root}/world"
        return "world"


def run_blueprint(layout: Layout) -> rrb.Blueprint:
    """Return the layout of one run, with plots that suit the kind of experiment."""
    rows = _plots(layout)
    shares = [2] * (len(rows) - 1) + [3]
    if layout.events:
        # There is no plant column, because the colour of an event shows the plant.
        columns = rrb.TextLogColumns(
            timeline_columns=[TIMELINE], text_log_columns=["loglevel", "body"]
        )
        rows.append(rrb.TextLogView(origin="events", name="Events", columns=columns))
        shares.append(2)
    plots = rrb.Vertical(*rows, row_shares=shares)
    return _with_collapsed_panels(
        rrb.Horizontal(scene_view(layout), plots, column_shares=[3, 2])
    )


def side_by_side_blueprint(layouts: Mapping[str, Layout]) -> rrb.Blueprint:
    """Return a layout that shows several runs, at most three in a row."""
    columns = []
    for name, layout in layouts.items():
        body = rrb.Tabs(
            _plot(f"{layout.root}/body/speed", "Speed (m/s)"),
            _plot(f"{layout.root}/body/heading", "Heading (rad)"),
            _plot(f"{layout.root}/module/1/bend", "Bend 1 (rad)"),
        )
        scene = scene_view(layout, name=name)
        columns.append(rrb.Vertical(scene, body, row_shares=[3, 1]))
    return _with_collapsed_panels(rrb.Grid(*columns, grid_columns=min(3, len(columns))))


def _with_collapsed_panels(contents: rrb.Horizontal | rrb.Grid) -> rrb.Blueprint:
    time_panel = rrb.TimePanel(timeline=TIMELINE, state="collapsed")
    return rrb.Blueprint(contents, time_panel, collapse_panels=True)


def _plots(layout: Layout) -> Rows:
    if layout.kind == "bench":
        return _bench_plots(layout)
    periods = _periods_axis(layout)
    bends = _modules(layout, "/bend", "Bend {} (rad)", axis_x=periods)
    body = _body_plots(layout)
    if layout.signals:
        plots: Rows = [
            _plot(f"follow/{signal.entity}", signal.title) for signal in layout.signals
        ]
        return [*plots, rrb.Tabs(*body, bends)]
    if layout.kind == "learning":
        chambers = _modules(layout, "/duty", "Duties {}")
    else:
        chambers = _modules(layout, "/pressure", _PRESSURES, axis_x=periods)
    return [bends, chambers, rrb.Tabs(*body)]


_PRESSURES = "Pressure {} (kPa)"


def _bench_plots(layout: Layout) -> Rows:
    both = ["+ $origin/bend/**", "+ $origin/sensed/**"]
    plots: Rows = [
        _modules(layout, "", "Bend {}, reference, readings (rad)", contents=both),
        _modules(layout, "/valve", "Valves {} (1: left)"),
        _modules(layout, "/pressure", _PRESSURES),
    ]
    if measured := _measured_plots(layout):
        # Bends come first, because bench experiments often measure nothing else.
        plots.append(rrb.Tabs(*reversed(measured)))
    return plots


def _body_plots(layout: Layout) -> list[rrb.TimeSeriesView]:
    axis = None if layout.speeds is None else rrb.ScalarAxis(range=layout.speeds)
    plots = [
        _plot("body/speed", "Speed (m/s)", axis_y=axis),
        _plot("body/heading", "Heading (rad)"),
    ]
    if layout.compared:
        plots.append(_plot("comparison", "Difference (mm)"))
    return plots + _measured_plots(layout)


def _measured_plots(layout: Layout) -> list[rrb.TimeSeriesView]:
    plots = []
    distances = [f"+ /measured/{name}/**" for name in layout.measured if name != "bend"]
    if distances:
        title = "Distance from the measured robot (mm)"
        plots.append(_plot("/", title, contents=distances))
    if "bend" in layout.measured:
        title = "Bends from the measured robot, RMS (rad)"
        plots.append(_plot("measured/bend", title))
    return plots


def _modules(layout: Layout, signal: str, name: str, **options: Any) -> rrb.Tabs:
    """Return tabs with one plot per module.

    The tab of the middle module is active, because the first module hardly shows
    differences between the plants.
    """
    views = [
        _plot(f"module/{j}{signal}", name.format(j), **options)
        for j in range(1, layout.segments + 1)
    ]
    title = name.partition(" {")[0]
    return rrb.Tabs(*views, active_tab=layout.segments // 2, name=title)


def scene_view(layout: Layout, name: str = "") -> rrb.Spatial3DView:
    """Return a 3-D view with a camera that follows the snakes from the right."""
    if not name:
        name = "Both plants, grid 0.1 m" if len(layout.plants) > 1 else "Grid 0.1 m"
    right = np.array([np.sin(layout.heading), -np.cos(layout.heading)])
    distance = max(
        1.25 * layout.body_length, 0.75 * (layout.body_length + layout.separation)
    )
    eye = layout.start + distance * right
    until_cursor = rrb.VisibleTimeRanges(
        timeline=TIMELINE,
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    return rrb.Spatial3DView(
        origin=layout.world,
        name=name,
        background=rrb.Background(color=[245, 246, 248]),
        line_grid=rrb.LineGrid3D(
            visible=True, spacing=0.1, stroke_width=1.0, color=[150, 155, 165, 110]
        ),
        eye_controls=rrb.EyeControls3D(
            position=[*eye, 0.96 * distance],
            look_target=[*layout.start, 0.0],
            eye_up=[0.0, 0.0, 1.0],
            tracking_entity=f"{layout.world}/{CAMERA_TARGET}",
        ),
        overrides={
            f"{layout.world}/{plant}/trail": until_cursor for plant in layout.plants
        },
    )


def _periods_axis(layout: Layout) -> rrb.TimeAxis | None:
    if layout.period is None:
        return None
    half = _PERIODS_SHOWN / 2 * layout.period
    ends = (
        rrb.TimeRangeBoundary.cursor_relative(rr.TimeInt(seconds=offset))
        for offset in (-half, half)
    )
    return rrb.TimeAxis(view_range=rrb.TimeRange(*ends))


def _plot(origin: str, name: str, **options: Any) -> rrb.TimeSeriesView:
    corner = rrb.PlotLegend(rrb.Corner2D.RightBottom)
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=corner, **options)
