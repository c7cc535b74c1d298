"""The scene of a recording as whole columns: snakes, obstacles and their forces, the plan."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import rerun as rr

from srs_twin.comparison.centre_line import centre_lines
from srs_twin.comparison.contacts import TOUCH_N
from srs_twin.robot.spec import Geometry
from srs_twin.robot.world import World
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.additions import FloorLine
from srs_twin.viewing.plots.signals import body_line, pressure_difference, wheel_centres, wheel_turns
from srs_twin.viewing.plots.style import Style, pressure_colors, rgb
from srs_twin.viewing.rerun.blueprint import TIMELINE

METRES_PER_NEWTON = 0.05
"""Length of the arrows, the same in every recording; the lightest robot weighs about 2 N."""
FORCE_COLOR = "#d02020"
_FORCE, _FORCE_RADIUS = rgb(FORCE_COLOR), 0.002
_OBSTACLE, _HEIGHT = (90, 90, 90), 0.06


@dataclass(frozen=True)
class Entities:
    """Entities of a recording with the same samples: all that is logged goes through here.

    Attributes:
        log: where they are sent.
        time: of the samples, shape (samples,), s.
        root: path before their names, `world/<plant>/`.
    """

    log: rr.RecordingStream
    time: np.ndarray
    root: str = ""

    def fixed(self, name: str, shape: rr.AsComponents) -> None:
        """Log what stays the same (a component must not also be sent by `moving`: fixed ones win)."""
        self.log.log(f"{self.root}{name}", shape, static=True)

    def moving(self, name: str, columns: rr.ComponentColumnList, count: int | np.ndarray = 1) -> None:
        """Send columns with `count` values a sample."""
        rows = columns.partition(np.broadcast_to(count, len(self.time)))
        self.log.send_columns(f"{self.root}{name}", [rr.TimeColumn(TIMELINE, duration=self.time)], rows)

    def line(self, name: str, values: np.ndarray, style: Style, *, steps: bool = False) -> None:
        """Send a signal; of one in steps only the samples at which it changes, and the last."""
        entities = self
        if steps:
            kept = np.append(np.flatnonzero(np.append(True, values[1:] != values[:-1])), len(values) - 1)
            # What a sample says has held since the one before.
            since = np.append(np.maximum(kept[:-1] - 1, 0), kept[-1])
            entities, values = replace(self, time=self.time[since]), values[kept]
        mode = rr.components.InterpolationMode.StepAfter if steps else None
        colors, names, widths = [style.rgb], [style.label], [style.width]
        line = rr.SeriesLines(colors=colors, names=names, widths=widths, interpolation_mode=mode)
        entities.fixed(name, line)
        entities.moving(name, rr.Scalars.columns(scalars=np.asarray(values, dtype=float)))


def send_obstacles(to: Entities, world: World) -> None:
    """Log what stands on the floor: `world/obstacles/round` and `world/obstacles/straight`."""
    if circles := world.obstacles:
        upright = rr.Cylinders3D(
            centers=[(c.x, c.y, _HEIGHT / 2) for c in circles],
            lengths=[_HEIGHT] * len(circles),
            radii=[c.radius for c in circles],
            colors=[_OBSTACLE],
        )
        to.fixed("obstacles/round", upright)
    if world.polygons:
        sides = [
            [(x, y, z) for x, y in (*each.corners, each.corners[0])]
            for each in world.polygons
            for z in (0.0, _HEIGHT)
        ]
        lines = rr.LineStrips3D(sides, colors=[_OBSTACLE], radii=[0.003])
        to.fixed("obstacles/straight", lines)


def send_contacts(to: Entities, run: Trajectory, height: float) -> None:
    """Log the forces of obstacles on one snake as `contact`; nothing where nothing was touched.

    An arrow begins at a connector's centre and is the force on it and on the halves of its segments. Every
    recorded sample counts, for a touch may be shorter than what shapes are thinned to.

    Args:
        to: entities of the snake, one row a sample of the run.
        run: with ``obstacle_force_x_1…`` and ``obstacle_force_y_1…`` where there were obstacles.
        height: of the arrows above the floor, m.
    """
    if not run.has("obstacle_force_x"):
        return
    force = np.stack([run.stack("obstacle_force_x"), run.stack("obstacle_force_y")], axis=-1)
    touched = np.hypot(force[..., 0], force[..., 1]) > TOUCH_N
    some = touched.any(axis=1)
    if not some.any():
        return
    # A viewer shows the last row until the next: the first sample without a touch takes the arrows away.
    ended = np.append(False, some[:-1]) & ~some
    rows = np.flatnonzero(some | ended)
    origins = _at_height(run.position[rows][touched[rows]], height)
    vectors = _at_height(METRES_PER_NEWTON * force[rows][touched[rows]], 0.0)
    to.fixed("contact", rr.Arrows3D.from_fields(colors=[_FORCE], radii=[_FORCE_RADIUS]))
    arrows = rr.Arrows3D.columns(origins=origins, vectors=vectors)
    replace(to, time=run.time[rows]).moving("contact", arrows, touched[rows].sum(axis=1))


_LOW = 0.001


PIECES = 6
"""Capsules an arc; at 90° each stands for 15°, where the rounded ends still hide the corners."""
Rgba = tuple[int, int, int, int]
_GHOST_ALPHA = 120
_PLATES: Rgba = (70, 74, 82, 255)
_WHEELS: Rgba = (28, 30, 34, 255)
_SPOKES: Rgba = (200, 202, 206, 255)


def send_snake(to: Entities, snake: Trajectory, geometry: Geometry, style: Style, *, ghost: bool) -> None:
    """Log one snake: a ghost is see-through and of one colour, the other shows its pressures."""
    ghostly = (*style.rgb, _GHOST_ALPHA)
    if ghost:
        _send_hull(to, snake, geometry, ghostly)
    else:
        _send_tubes(to, snake, geometry)
    plates, wheels = (ghostly, ghostly) if ghost else (_PLATES, _WHEELS)
    _send_connectors(to, snake, geometry, [(*style.rgb, plates[3])] + [plates] * (geometry.connectors - 1))
    _send_wheels(to, snake, geometry, wheels)
    if not ghost:
        _send_spokes(to, snake, geometry)
    _send_trail(to, snake, style)


def _send_tubes(to: Entities, snake: Trajectory, geometry: Geometry) -> None:
    """Log each segment as capsules along its centre line, in the colour of its pressure difference."""
    lines = centre_lines(snake, geometry, PIECES)
    colors = pressure_colors(pressure_difference(snake))
    for j in range(geometry.segments):
        name, line = f"body/segment_{j + 1}", lines[:, j]
        step = np.diff(line, axis=1)
        # The chords of an arc hardly change as it bends (0.3 % at 90°), so their lengths are logged once.
        lengths = np.hypot(*step[0].T)
        tube = rr.Capsules3D.from_fields(lengths=lengths, radii=[geometry.width / 2], fill_mode="solid")
        to.fixed(name, tube)
        poses = rr.Capsules3D.columns(
            translations=_at_height(line[:, :-1], line_height(geometry)),
            quaternions=_along(np.arctan2(step[..., 1], step[..., 0])),
        )
        to.moving(name, poses, step.shape[1])
        to.moving(name, rr.Capsules3D.columns(colors=_packed(colors[:, j])))


def _send_hull(to: Entities, snake: Trajectory, geometry: Geometry, color: Rgba) -> None:
    """Log the body as one six-sided tube; capsules overlap and would not look see-through."""
    line = body_line(snake, geometry, PIECES)
    along = np.gradient(line, axis=1)
    left = np.stack([-along[..., 1], along[..., 0]], axis=-1) / np.linalg.norm(along, axis=-1, keepdims=True)
    angle = np.arange(6) * np.pi / 3
    # A little thinner than the other body, so that two at the same place do not flicker.
    radius = 0.46 * geometry.width
    side = line[:, :, None] + radius * np.cos(angle)[:, None] * left[:, :, None]
    up = np.broadcast_to(line_height(geometry) + radius * np.sin(angle), side.shape[:-1])
    vertices = np.concatenate([side, up[..., None]], axis=-1).astype(np.float32)
    triangles = _tube_triangles(line.shape[1])
    hull = rr.Mesh3D.from_fields(triangle_indices=triangles, albedo_factor=color, face_rendering="front")
    to.fixed("body", hull)
    to.moving("body", rr.Mesh3D.columns(vertex_positions=vertices.reshape(-1, 3)), 6 * line.shape[1])


def _tube_triangles(rings: int) -> np.ndarray:
    """Return the triangles between rings of six vertices, shape (n, 3), counter-clockwise from outside."""
    ring, corner = np.meshgrid(np.arange(rings - 1), np.arange(6), indexing="ij")
    here, after = 6 * ring + corner, 6 * ring + (corner + 1) % 6
    quads = np.stack([here, here + 6, after, after, here + 6, after + 6], axis=-1)
    return quads.reshape(-1, 3)


def _send_connectors(to: Entities, snake: Trajectory, geometry: Geometry, colors: list[Rgba]) -> None:
    track, radius = geometry.half_track, geometry.wheel_radius
    half = [max(geometry.rigid_gap / 4, 0.1 * track), track - 0.2 * radius, 0.35 * geometry.width]
    theta = snake.stack("theta")
    nothing = np.zeros_like(theta)
    turn = np.stack([nothing, nothing, np.sin(theta / 2), np.cos(theta / 2)], axis=-1)
    places = _at_height(snake.position, line_height(geometry))
    _send_solids(to, "connectors", rr.Boxes3D, places, turn, half_sizes=[half], colors=colors)


def _send_wheels(to: Entities, snake: Trajectory, geometry: Geometry, color: Rgba) -> None:
    radius, axle = geometry.wheel_radius, np.repeat(snake.stack("theta") + np.pi / 2, 2, axis=1)
    places = _at_height(wheel_centres(snake, geometry), radius)
    size: dict[str, Any] = {"lengths": [0.4 * radius], "radii": [radius]}
    _send_solids(to, "wheels", rr.Cylinders3D, places, _along(axle), colors=[color], **size)


def _send_spokes(to: Entities, snake: Trajectory, geometry: Geometry) -> None:
    """Log a bar across each wheel, a little wider than that, by which one sees it turn."""
    radius = geometry.wheel_radius
    half = [0.85 * radius, 0.22 * radius, 0.13 * radius]
    yaw, turn = snake.stack("theta")[:, :, None] / 2, wheel_turns(snake, geometry) / 2
    c, s = np.cos(yaw), np.sin(yaw)
    pose = np.stack([-s * np.sin(turn), c * np.sin(turn), s * np.cos(turn), c * np.cos(turn)], axis=-1)
    places = _at_height(wheel_centres(snake, geometry), radius)
    _send_solids(to, "spokes", rr.Boxes3D, places, pose, half_sizes=[half], colors=[_SPOKES])


def _send_solids(
    to: Entities, name: str, shape: Any, places: np.ndarray, turns: np.ndarray, **looks: Any
) -> None:
    """Log equally many solids a sample, at places (n, 3) and turned by quaternions (…, 4), xyzw."""
    to.fixed(name, shape.from_fields(fill_mode="solid", **looks))
    poses = shape.columns(centers=places, quaternions=turns.reshape(-1, 4).astype(np.float32))
    to.moving(name, poses, len(places) // len(to.time))


def _send_trail(to: Entities, snake: Trajectory, style: Style) -> None:
    """Log the centre of mass, and its trail as a short line a sample: the view shows those so far."""
    ends = np.stack([np.concatenate([snake.com[:1], snake.com[:-1]]), snake.com], axis=1)
    strips = _at_height(ends, 0.002).reshape(-1, 2, 3)
    to.fixed("trail", rr.LineStrips3D.from_fields(colors=[style.rgb], radii=[0.002]))
    to.moving("trail", rr.LineStrips3D.columns(strips=strips))
    to.fixed("com", rr.Points3D.from_fields(colors=[style.rgb], radii=[0.004]))
    to.moving("com", rr.Points3D.columns(positions=_at_height(snake.com, 0.003)))


def line_height(geometry: Geometry) -> float:
    """Return how high the centre line is drawn, m; a body wider than it is high must not sink in."""
    return max(geometry.com_height, geometry.width / 2)


def send_lines(to: Entities, lines: Iterable[FloorLine]) -> None:
    """Log lines on the floor."""
    for line in lines:
        strips = [_at_height(strip, _LOW) for strip in line.strips]
        to.fixed(line.name, rr.LineStrips3D(strips, colors=[rgb(line.color)], radii=[line.radius]))


def _at_height(points: np.ndarray, height: float) -> np.ndarray:
    """Return (…, 2) points as (n, 3) at one height, float32."""
    flat = points.reshape(-1, 2)
    return np.column_stack([flat, np.full(len(flat), height)]).astype(np.float32)


def _along(yaw: np.ndarray) -> np.ndarray:
    """Return quaternions (n, 4), xyzw, that lay +z (the axis of capsules) along a yaw in the floor."""
    s, c = np.sin(yaw / 2), np.cos(yaw / 2)
    return (np.sqrt(0.5) * np.stack([-s, c, s, c], axis=-1)).reshape(-1, 4).astype(np.float32)


def _packed(rgba: np.ndarray) -> np.ndarray:
    """Return (n, 4) bytes as 0xRRGGBBAA, which Rerun takes without a copy per colour."""
    return np.ascontiguousarray(rgba).view(">u4").reshape(-1).astype(np.uint32)
