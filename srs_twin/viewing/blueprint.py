"""How a recording opens: the scene on the left, bends, pressures and speed beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

TIMELINE = "sim_time"
_PERIODS_SHOWN = 4


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
        root: entity above all of them, where several runs are in one recording.
        measured: whether there are differences from a measured robot.
    """

    plants: Sequence[str]
    segments: int
    start: np.ndarray
    heading: float
    body_length: float
    period: float | None
    compared: bool
    root: str = ""
    measured: bool = False

    @property
    def world(self) -> str:
        """The entity of everything on the floor."""
        return f"{self.root}/world" if self.root else "world"

    @property
    def followed(self) -> str:
        """The plant that the eye follows."""
        return "twin" if "twin" in self.plants else self.plants[0]


def run_blueprint(layout: Layout) -> rrb.Blueprint:
    """Return the layout of one run: up to four modules stand side by side, more of them in tabs."""
    modules = range(1, layout.segments + 1)
    bends = [_gait_plot(layout, j, "bend", f"Bend of module {j} (rad)") for j in modules]
    pressures = [_gait_plot(layout, j, "pressure", f"p+ minus p- of module {j} (kPa)") for j in modules]
    body = [plot("body/speed", "CoM speed, forward (m/s)"), plot("body/heading", "Heading (rad)")]
    if layout.compared:
        body.append(plot("comparison", "Difference of the plants (mm)"))
    if layout.measured:
        body.append(plot("measured", "Distance from the measured robot (mm)"))
    return rrb.Blueprint(
        rrb.Horizontal(
            scene_view(layout),
            rrb.Vertical(
                _side_by_side(bends), _side_by_side(pressures), rrb.Tabs(*body), row_shares=[3, 3, 2]
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


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


def _gait_plot(layout: Layout, module: int, signal: str, name: str) -> rrb.TimeSeriesView:
    origin = f"module/{module}/{signal}"
    if layout.period is None:
        return plot(origin, name, legend=False)
    half = rr.TimeInt(seconds=_PERIODS_SHOWN / 2 * layout.period)
    back = rr.TimeInt(seconds=-_PERIODS_SHOWN / 2 * layout.period)
    shown = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.cursor_relative(back), end=rrb.TimeRangeBoundary.cursor_relative(half)
    )
    axis = rrb.TimeAxis(view_range=shown)
    return plot(origin, name, legend=False, axis_x=axis)


def plot(
    origin: str, name: str, *, legend: bool = True, axis_x: rrb.TimeAxis | None = None
) -> rrb.TimeSeriesView:
    """Return a plot over time of what lies beneath an entity."""
    corner = rrb.PlotLegend(rrb.Corner2D.RightBottom, visible=legend)
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=corner, axis_x=axis_x)


def _side_by_side(views: Sequence[rrb.TimeSeriesView]) -> rrb.Grid | rrb.Tabs:
    if len(views) > 4:
        return rrb.Tabs(*views)
    return rrb.Grid(*views, grid_columns=min(2, len(views)))
