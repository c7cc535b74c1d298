"""How a recording opens: the scene on the left; beside it bends, pressures and, larger, speed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from srs_twin.viewing.additions import FollowedSignal

TIMELINE = "sim_time"
_PERIODS_SHOWN = 4

Rows = list[rrb.Container | rrb.View]


@dataclass(frozen=True)
class Layout:
    """What the views depend on.

    Attributes:
        plants: names under `world/`.
        eye: entity under `world/` that the camera follows.
        segments: number of modules.
        start: where it starts, (2,), m.
        heading: in which direction the snakes start, rad.
        body_length: m.
        apart: greatest distance between two centres of mass, m; all of them stay in the picture.
        period: of the gait, s; plots show a few of them around the cursor. None: they show the whole run.
        compared: whether there are differences of the plants to plot.
        kind: of the experiment; the plots that matter for it are shown.
        signals: of an extension, plotted first.
        speeds: ends of the axis of speed, m/s; None: the viewer chooses.
        events: whether there is anything in the text log.
        root: entity above all of them, where several runs are in one recording.
        measured: of what there are differences from a measured robot: shape, path, bend.
    """

    plants: Sequence[str]
    eye: str
    segments: int
    start: np.ndarray
    heading: float
    body_length: float
    apart: float
    period: float | None
    compared: bool
    kind: str = "gait"
    signals: Sequence[FollowedSignal] = ()
    speeds: tuple[float, float] | None = None
    events: bool = False
    root: str = ""
    measured: Sequence[str] = ()

    @property
    def world(self) -> str:
        """The entity of everything on the floor."""
        return f"{self.root}/world" if self.root else "world"


def run_blueprint(layout: Layout) -> rrb.Blueprint:
    """Return the layout of one run: the scene, and beside it the plots that matter for such an experiment."""
    rows = _rows(layout)
    shares = [2] * (len(rows) - 1) + [3]
    if layout.events:
        # Whose event it is its colour says.
        columns = rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["loglevel", "body"])
        rows.append(rrb.TextLogView(origin="events", name="Events", columns=columns))
        shares.append(2)
    return _opened(
        rrb.Horizontal(scene_view(layout), rrb.Vertical(*rows, row_shares=shares), column_shares=[3, 2])
    )


def side_by_side_blueprint(layouts: Mapping[str, Layout]) -> rrb.Blueprint:
    """Return the layout of several runs: each one's scene above its speed, three in a row at most.

    Args:
        layouts: name of a run → its layout, with its root.
    """
    columns = []
    for name, layout in layouts.items():
        body = rrb.Tabs(
            _plot(f"{layout.root}/body/speed", "Speed (m/s)"),
            _plot(f"{layout.root}/body/heading", "Heading (rad)"),
            _plot(f"{layout.root}/module/1/bend", "Bend 1 (rad)"),
        )
        columns.append(rrb.Vertical(scene_view(layout, name=name), body, row_shares=[3, 1]))
    return _opened(rrb.Grid(*columns, grid_columns=min(3, len(columns))))


def _opened(shown: rrb.Horizontal | rrb.Grid) -> rrb.Blueprint:
    return rrb.Blueprint(
        shown,
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _rows(layout: Layout) -> Rows:
    """Return the plots that matter for a kind of experiment."""

    def modules(signal: str, name: str, **options: Any) -> rrb.Tabs:
        """Return a tab a module, the middle one open: the plants hardly differ in the first."""
        numbers = range(1, layout.segments + 1)
        views = [_plot(f"module/{j}{signal}", name.format(j), **options) for j in numbers]
        return rrb.Tabs(*views, active_tab=layout.segments // 2, name=name.partition(" {")[0])

    axis = _last_periods(layout)
    bends = modules("/bend", "Bend {} (rad)", axis_x=axis)
    pressures = "Pressure {} (kPa)"
    # How far the plants are from the measured robot: on a bench there may be bends alone.
    distances = [f"+ /measured/{name}/**" for name in layout.measured if name != "bend"]
    measured = [_plot("/", "Distance from the measured robot (mm)", contents=distances)] if distances else []
    if "bend" in layout.measured:
        measured.append(_plot("measured/bend", "Bends from the measured robot, RMS (rad)"))
    upright = None if layout.speeds is None else rrb.ScalarAxis(range=layout.speeds)
    body = [_plot("body/speed", "Speed (m/s)", axis_y=upright), _plot("body/heading", "Heading (rad)")]
    if layout.compared:
        body.append(_plot("comparison", "Difference (mm)"))
    body += measured
    if layout.kind == "bench":
        both = ["+ $origin/bend/**", "+ $origin/sensed/**"]
        return [
            modules("", "Bend {}, reference, readings (rad)", contents=both),
            modules("/valve", "Valves {} (1: left)"),
            modules("/pressure", pressures),
            *([rrb.Tabs(*reversed(measured))] if measured else []),
        ]
    if layout.signals:
        plots = [_plot(f"follow/{signal.entity}", signal.title) for signal in layout.signals]
        return [*plots, rrb.Tabs(*body, bends)]
    learns = layout.kind == "learning"
    duties = modules("/duty", "Duties {}")
    return [bends, duties if learns else modules("/pressure", pressures, axis_x=axis), rrb.Tabs(*body)]


def scene_view(layout: Layout, name: str = "") -> rrb.Spatial3DView:
    """Return the 3-D view: the eye goes along on the snakes' right; trails reach back from the cursor."""
    name = name or ("Both plants, grid 0.1 m" if len(layout.plants) > 1 else "Grid 0.1 m")
    right = np.array([np.sin(layout.heading), -np.cos(layout.heading)])
    away = max(1.25 * layout.body_length, 0.75 * (layout.body_length + layout.apart))
    eye = layout.start + away * right
    so_far = rrb.VisibleTimeRanges(
        timeline=TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    return rrb.Spatial3DView(
        origin=layout.world,
        name=name,
        background=rrb.Background(color=[245, 246, 248]),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.1, stroke_width=1.0, color=[150, 155, 165, 110]),
        eye_controls=rrb.EyeControls3D(
            position=[*eye, 0.96 * away],
            look_target=[*layout.start, 0.0],
            eye_up=[0.0, 0.0, 1.0],
            tracking_entity=f"{layout.world}/{layout.eye}",
        ),
        overrides={f"{layout.world}/{plant}/trail": so_far for plant in layout.plants},
    )


def _last_periods(layout: Layout) -> rrb.TimeAxis | None:
    """Return a time axis of a few gait periods around the cursor; None without a gait."""
    if layout.period is None:
        return None
    half = _PERIODS_SHOWN / 2 * layout.period
    ends = (rrb.TimeRangeBoundary.cursor_relative(rr.TimeInt(seconds=each)) for each in (-half, half))
    return rrb.TimeAxis(view_range=rrb.TimeRange(*ends))


def _plot(
    origin: str,
    name: str,
    *,
    axis_x: rrb.TimeAxis | None = None,
    axis_y: rrb.ScalarAxis | None = None,
    contents: Sequence[str] | str = "$origin/**",
) -> rrb.TimeSeriesView:
    corner = rrb.PlotLegend(rrb.Corner2D.RightBottom)
    return rrb.TimeSeriesView(
        origin=origin, name=name, plot_legend=corner, axis_x=axis_x, axis_y=axis_y, contents=contents
    )
