"""How a recording opens: the scene on the left, bends, pressures and speed beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from srs_twin.viewing.plots.signals import Kind

TIMELINE = "sim_time"
_PERIODS_SHOWN = 4

Rows = list[rrb.Container | rrb.View]


@dataclass(frozen=True)
class Layout:
    """What the views depend on.

    Attributes:
        plants: names under `world/`; the eye follows the twin, else the first.
        segments: number of modules.
        start: where the followed snake starts, (2,), m.
        heading: in which direction it starts, rad.
        body_length: m.
        period: of the gait, s; plots show a few of them around the cursor. None: they show the whole run.
        compared: whether there are differences of the plants to plot.
        kind: of the experiment; the plots that matter for it are shown.
        events: whether there is anything in the text log.
        root: entity above all of them, where several runs are in one recording.
        measured: of what there are differences from a measured robot: shape, path, bend.
    """

    plants: Sequence[str]
    segments: int
    start: np.ndarray
    heading: float
    body_length: float
    period: float | None
    compared: bool
    kind: Kind = "gait"
    events: bool = False
    root: str = ""
    measured: Sequence[str] = ()

    @property
    def world(self) -> str:
        """The entity of everything on the floor."""
        return f"{self.root}/world" if self.root else "world"

    @property
    def followed(self) -> str:
        """The plant that the eye follows."""
        return "twin" if "twin" in self.plants else self.plants[0]


def run_blueprint(layout: Layout) -> rrb.Blueprint:
    """Return the layout of one run: the scene, and beside it the plots that matter for such an experiment."""
    rows = _rows(layout)
    shares = [3] * (len(rows) - 1) + [2]
    if layout.events:
        columns = rrb.TextLogColumns(
            timeline_columns=[TIMELINE], text_log_columns=["loglevel", "entitypath", "body"]
        )
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
            _plot(f"{layout.root}/body/speed", "CoM speed, forward (m/s)"),
            _plot(f"{layout.root}/body/heading", "Heading (rad)"),
            _plot(f"{layout.root}/module/1/bend", "Bend of module 1 (rad)"),
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

    def modules(signal: str, name: str, legends: int = layout.segments, **options: Any) -> rrb.Container:
        """Return a plot a module: up to four stand side by side, more of them in tabs."""
        views = [
            _plot(f"module/{j}{signal}", name.format(j), legend=j <= legends, **options)
            for j in range(1, layout.segments + 1)
        ]
        return rrb.Tabs(*views) if len(views) > 4 else rrb.Grid(*views, grid_columns=min(2, len(views)))

    axis = _last_periods(layout)
    bends = modules("/bend", "Bend of module {} (rad)", 0, axis_x=axis)
    pressures = "p+ minus p- of module {} (kPa)"
    # How far the plants are from the measured robot: on a bench there may be bends alone.
    distances = [f"+ /measured/{name}/**" for name in layout.measured if name != "bend"]
    measured = [_plot("/", "Distance from the measured robot (mm)", contents=distances)] if distances else []
    if "bend" in layout.measured:
        measured.append(_plot("measured/bend", "Bends from the measured robot, RMS (rad)"))
    body = [_plot("body/speed", "CoM speed, forward (m/s)"), _plot("body/heading", "Heading (rad)")]
    if layout.compared:
        body.append(_plot("comparison", "Difference of the plants (mm)"))
    body += measured
    if layout.kind == "bench":
        both = ["+ $origin/bend/**", "+ $origin/sensed/**"]
        return [
            modules("", "Bend of module {}, reference and readings (rad)", contents=both),
            modules("/valve", "Valves of module {} (1: to the left)"),
            modules("/pressure", pressures),
            *([rrb.Tabs(*reversed(measured))] if measured else []),
        ]
    if layout.kind == "following":
        return [
            _plot("follow/cross_track", "Distance from the path, left positive (mm)"),
            _plot("follow/offset", "Offset commanded"),
            rrb.Tabs(*body, bends),
        ]
    learns = layout.kind == "learning"
    duties = modules("/duty", "Duties of module {}", 1)
    return [bends, duties if learns else modules("/pressure", pressures, 0, axis_x=axis), rrb.Tabs(*body)]


def scene_view(layout: Layout, name: str = "") -> rrb.Spatial3DView:
    """Return the 3-D view: the eye goes along on the snake's right; trails reach back from the cursor."""
    name = name or ("Both plants on the floor" if len(layout.plants) > 1 else "On the floor")
    right = np.array([np.sin(layout.heading), -np.cos(layout.heading)])
    eye = layout.start + 1.25 * layout.body_length * right
    so_far = rrb.VisibleTimeRanges(
        timeline=TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    return rrb.Spatial3DView(
        origin=layout.world,
        name=name,
        background=rrb.Background(color=[245, 246, 248]),
        line_grid=rrb.LineGrid3D(visible=True, spacing=0.1, stroke_width=1.0, color=[150, 155, 165, 110]),
        eye_controls=rrb.EyeControls3D(
            position=[*eye, 1.2 * layout.body_length],
            look_target=[*layout.start, 0.0],
            eye_up=[0.0, 0.0, 1.0],
            tracking_entity=f"{layout.world}/{layout.followed}/com",
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
    legend: bool = True,
    axis_x: rrb.TimeAxis | None = None,
    contents: Sequence[str] | str = "$origin/**",
) -> rrb.TimeSeriesView:
    corner = rrb.PlotLegend(rrb.Corner2D.RightBottom, visible=legend)
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=corner, axis_x=axis_x, contents=contents)
