"""Plan views of paths and bodies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch, PathPatch, Polygon
from matplotlib.path import Path
from shapely import LineString

from srs_twin.robot.spec import Geometry, RobotSpec
from srs_twin.robot.world import MovableObject, World
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.plots.signals import body_line, goal_ring
from srs_twin.viewing.plots.style import (
    OBJECT_COLOR,
    Style,
    add_legend,
    drawing,
    finish_floor,
    panels,
    style_of,
)

_MAX_BODIES = 6
"""Maximum number of bodies drawn per run in a plan view."""

_MIN_SPACING = 1.35
"""Minimum distance between drawn bodies, in body lengths."""


@drawing
def plan_view(
    trajectories: Mapping[str, Trajectory], spec: RobotSpec, world: World | None = None
) -> Figure:
    """Plot centre-of-mass paths, and bodies at equally spaced times (Fig. 36).

    The bodies of the twin are filled, and the bodies of other plants are outlined.
    """
    world = world or World()
    times = strobe_times(trajectories, spec.geometry)
    objects = [
        line
        for run in trajectories.values()
        for line in object_outlines(run, times, world)
    ]
    low, high = bounds(trajectories, spec.geometry, times)
    corners = np.concatenate([[low, high], *objects])
    width, depth = np.ptp(corners, axis=0)
    figure, (axes,) = panels(float(np.clip(8.0 * depth / width + 1.2, 2.4, 7.0)))
    for index, (plant, run) in enumerate(trajectories.items()):
        draw_run(
            axes,
            run,
            style_of(plant, index),
            spec.geometry,
            times,
            filled=plant == "twin",
        )
    for outline in objects:
        axes.add_patch(
            Polygon(outline, fill=False, edgecolor=OBJECT_COLOR, linewidth=1.2)
        )
    axes.autoscale_view()
    circles = ((item.x, item.y, item.radius) for item in world.obstacles)
    polygons = (item.corners for item in world.polygons)
    for patch in obstacle_patches(circles, polygons):
        axes.add_artist(patch)  # add_patch would extend the view to distant obstacles
    listed = ", ".join(f"{time:.3g}" for time in times)
    title = (
        f"Plan view: paths of the centre of mass, bodies (dot: head) at t = {listed} s"
    )
    finish_floor(axes, title)
    add_legend(figure, "lower right", ncols=len(trajectories), fontsize=9)
    return figure


def strobe_times(
    trajectories: Mapping[str, Trajectory], geometry: Geometry
) -> list[float]:
    """Return equally spaced times (s) for drawing bodies with little overlap."""
    run = next(iter(trajectories.values()))
    end = min(float(trajectory.time[-1]) for trajectory in trajectories.values())
    distance = np.hypot(*(run.com - run.com[0]).T)
    spacing = _MIN_SPACING * geometry.body_length
    count = int(np.interp(end, run.time, distance) / spacing + 1e-6) + 1
    # The start and the end are drawn even if the snake has hardly moved.
    times = np.linspace(float(run.time[0]), end, int(np.clip(count, 2, _MAX_BODIES)))
    return [float(time) for time in times]


def samples_at(run: Trajectory, times: list[float]) -> list[Trajectory]:
    """Return a trajectory with a single sample for each of the given times (s)."""
    rows = np.searchsorted(run.time, np.array(times) - 1e-9).clip(max=len(run) - 1)
    return [
        Trajectory({name: column[[row]] for name, column in run.columns.items()})
        for row in rows
    ]


def draw_run(
    axes: Axes,
    run: Trajectory,
    style: Style,
    geometry: Geometry,
    times: list[float],
    *,
    filled: bool,
) -> None:
    """Draw the centre-of-mass path of a run, and the body at the given times (s)."""
    for sample in samples_at(run, times):
        draw_body(axes, sample, geometry, style, filled=filled)
    axes.plot(*run.com.T, **style.line)


def obstacle_patches(
    circles: Iterable[tuple[float, float, float]],
    polygons: Iterable[Iterable[tuple[float, float]]],
) -> list[Patch]:
    """Return Matplotlib patches for circles (x, y, radius) and polygons, in m."""
    style: dict[str, Any] = {"facecolor": "0.35", "zorder": 1}
    return [
        *(Circle((x, y), radius, **style) for x, y, radius in circles),
        *(Polygon(np.array(list(corners)), **style) for corners in polygons),
    ]


def object_outlines(
    run: Trajectory, times: list[float], world: World
) -> list[np.ndarray]:
    """Return the outlines of movable objects at the given times (s), each (k, 2), m.

    The outline of a cylinder includes a radial line that shows the orientation.
    """
    if not run.has("object_x_1"):
        return []
    outlines = []
    for sample in samples_at(run, times):
        for k, item in enumerate(world.objects, start=1):
            place = [sample[f"object_x_{k}"][0], sample[f"object_y_{k}"][0]]
            turn = float(sample[f"object_heading_{k}"][0])
            c = np.cos(turn)
            s = np.sin(turn)
            axes = np.array([[c, s], [-s, c]])
            outlines.append(_outline(item) @ axes + place)
    return outlines


def _outline(item: MovableObject) -> np.ndarray:
    if item.is_box:
        corners = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)])
        return np.asarray(corners * np.array(item.size) / 2)
    return np.vstack([np.zeros(2), goal_ring(0.0, 0.0, item.size[0])])


def draw_body(
    axes: Axes, sample: Trajectory, geometry: Geometry, style: Style, *, filled: bool
) -> None:
    """Draw the outline of a body and a dot at the head."""
    shape = LineString(body_line(sample, geometry)[0]).buffer(geometry.width / 2)
    # The outline of a body that touches itself has holes.
    rings = [np.asarray(ring.coords) for ring in (shape.exterior, *shape.interiors)]
    if filled:
        outline = Path.make_compound_path(*map(Path, rings))
        axes.add_patch(
            PathPatch(outline, facecolor=style.color, alpha=0.25, linewidth=0)
        )
    for ring in rings:
        axes.plot(
            *ring.T, color=style.color, linestyle=style.dash, linewidth=1.0, zorder=5
        )
    axes.plot(*sample.position[0, 0], "o", color=style.color, markersize=2.5, zorder=5)


def bounds(
    trajectories: Mapping[str, Trajectory], geometry: Geometry, times: list[float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return two opposite corners of a rectangle around the drawn bodies, m."""
    bodies = [
        row.position[0]
        for run in trajectories.values()
        for row in samples_at(run, times)
    ]
    points = np.concatenate(bodies)
    margin = 1.6 * geometry.half_track + geometry.width
    return points.min(axis=0) - margin, points.max(axis=0) + margin


@drawing
def lines_plot(lines: Mapping[str, np.ndarray]) -> Figure:
    """Plot named lines on the floor, each of shape (k, 2), m."""
    figure, (axes,) = panels(3.0)
    for name, points in lines.items():
        axes.plot(*points.T, label=name)
    finish_floor(axes)
    add_legend(axes, fontsize=9)
    return figure
