"""Scene of a recording, with snakes, obstacles, contact forces and floor lines."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import rerun as rr

from srs_twin.comparison.centre_line import (
    connector_orientations,
    connector_places,
    connector_size,
    spatial_centre_lines,
)
from srs_twin.comparison.contacts import TOUCH_N
from srs_twin.robot.spec import Geometry, RobotSpec
from srs_twin.robot.world import World
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.additions import FloorLine
from srs_twin.viewing.plots.signals import (
    joined_lines,
    pressure_difference,
    wheel_centres,
    wheel_turns,
)
from srs_twin.viewing.plots.style import OBJECT_COLOR, Style, pressure_colors, rgb
from srs_twin.viewing.rerun.blueprint import TIMELINE

METRES_PER_NEWTON = 0.05
"""Length of force arrows per newton, m/N."""

FORCE_COLOR = "#d02020"
_FORCE_RADIUS_M = 0.002
_OBSTACLE_COLOR = (90, 90, 90)
_OBSTACLE_HEIGHT_M = 0.06


@dataclass(frozen=True)
class Entities:
    """Writer of Rerun entities that share sample times.

    Attributes:
        time: sample times, s.
        root: prefix of all entity names.
    """

    log: rr.RecordingStream
    time: np.ndarray
    root: str = ""

    def static(self, name: str, shape: rr.AsComponents) -> None:
        """Log static components, which override components logged by `send`."""
        self.log.log(f"{self.root}{name}", shape, static=True)

    def send(
        self, name: str, columns: rr.ComponentColumnList, count: int | np.ndarray = 1
    ) -> None:
        """Log columns that have `count` values per sample."""
        rows = columns.partition(np.broadcast_to(count, len(self.time)))
        self.log.send_columns(
            f"{self.root}{name}", [rr.TimeColumn(TIMELINE, duration=self.time)], rows
        )

    def line(
        self, name: str, values: np.ndarray, style: Style, *, steps: bool = False
    ) -> None:
        """Log a signal as a line.

        If `steps` is true, the signal is a step function, of which only changes and the
        last sample are logged.
        """
        entities = self
        mode = None
        if steps:
            changed = np.flatnonzero(np.append(True, values[1:] != values[:-1]))
            changes = np.append(changed, len(values) - 1)
            # A sample contains the value of the preceding interval.
            begins = np.append(np.maximum(changed - 1, 0), changes[-1])
            entities = replace(self, time=self.time[begins])
            values = values[changes]
            mode = rr.components.InterpolationMode.StepAfter
        line = rr.SeriesLines(
            colors=[style.rgb],
            names=[style.label],
            widths=[style.width],
            interpolation_mode=mode,
        )
        entities.static(name, line)
        entities.send(name, rr.Scalars.columns(scalars=np.asarray(values, dtype=float)))


def send_obstacles(to: Entities, world: World) -> None:
    """Log circles as `obstacles/round`, and polygons as `obstacles/straight`."""
    if circles := world.obstacles:
        upright = rr.Cylinders3D(
            centers=[(c.x, c.y, _OBSTACLE_HEIGHT_M / 2) for c in circles],
            lengths=[_OBSTACLE_HEIGHT_M] * len(circles),
            radii=[c.radius for c in circles],
            colors=[_OBSTACLE_COLOR],
        )
        to.static("obstacles/round", upright)
    if world.polygons:
        sides = [
            [(x, y, z) for x, y in (*polygon.corners, polygon.corners[0])]
            for polygon in world.polygons
            for z in (0.0, _OBSTACLE_HEIGHT_M)
        ]
        lines = rr.LineStrips3D(sides, colors=[_OBSTACLE_COLOR], radii=[0.003])
        to.static("obstacles/straight", lines)


def send_objects(to: Entities, run: Trajectory, world: World) -> None:
    """Log the movable objects of a run as `object_1`, `object_2` and so on."""
    if not run.has("object_x"):
        return
    half = _OBSTACLE_HEIGHT_M / 2
    for k, item in enumerate(world.objects, start=1):
        x = run[f"object_x_{k}"]
        y = run[f"object_y_{k}"]
        turn = run[f"object_heading_{k}"] / 2
        rotation = np.stack([0 * turn, 0 * turn, np.sin(turn), np.cos(turn)], axis=-1)
        shape: type[rr.Boxes3D | rr.Cylinders3D] = rr.Cylinders3D
        look: dict[str, object] = {"lengths": [2 * half], "radii": [item.size[0]]}
        if item.is_box:
            shape = rr.Boxes3D
            look = {"half_sizes": [[item.size[0] / 2, item.size[1] / 2, half]]}
        centres = at_height(np.stack([x, y], axis=-1), half)
        colors = [rgb(OBJECT_COLOR)]
        _send_solids(to, f"object_{k}", shape, centres, rotation, colors=colors, **look)


def send_contacts(to: Entities, run: Trajectory, height: float) -> None:
    """Log the forces that obstacles exert on a snake, as arrows.

    Each arrow starts at the centre of a connector, `height` (m) above the floor. The
    arrow shows the force on the connector and on the adjacent half segments. All
    samples are logged, because a contact may be shorter than the sample interval of the
    scene.
    """
    if not run.has("obstacle_force_x"):
        return
    force = np.stack(
        [run.stack("obstacle_force_x"), run.stack("obstacle_force_y")], axis=-1
    )
    touched = np.hypot(force[..., 0], force[..., 1]) > TOUCH_N
    in_contact = np.any(touched, axis=1)
    if not in_contact.any():
        return
    # The viewer shows the arrows until the next logged sample, so the first sample
    # after a contact must remove them.
    ended = np.append(False, in_contact[:-1]) & ~in_contact
    rows = np.flatnonzero(in_contact | ended)
    origins = at_height(run.position[rows][touched[rows]], height)
    vectors = at_height(METRES_PER_NEWTON * force[rows][touched[rows]], 0.0)
    look = rr.Arrows3D.from_fields(colors=[rgb(FORCE_COLOR)], radii=[_FORCE_RADIUS_M])
    to.static("contact", look)
    arrows = rr.Arrows3D.columns(origins=origins, vectors=vectors)
    replace(to, time=run.time[rows]).send("contact", arrows, touched[rows].sum(axis=1))


_LINE_HEIGHT_M = 0.001
"""Height above the floor at which lines do not flicker, m."""

CHORDS = 6
"""Number of capsules along the arc of a segment.

At a bend of 90°, each capsule covers 15°, and the round capsule ends hide the corners.
"""

Rgba = tuple[int, int, int, int]
_GHOST_ALPHA = 120
_MAX_TRACKS = 20_000
"""Maximum number of points that mark floor contacts of a spatial snake."""
_CONNECTOR_COLOR: Rgba = (70, 74, 82, 255)
_WHEEL_COLOR: Rgba = (28, 30, 34, 255)
_SPOKE_COLOR: Rgba = (200, 202, 206, 255)


def send_snake(
    to: Entities, snake: Trajectory, spec: RobotSpec, style: Style, *, ghost: bool
) -> None:
    """Log a snake and its path.

    A ghost is drawn in the colour of its plant. Other snakes are coloured by pressure
    difference.
    """
    geometry = spec.geometry
    if ghost:
        connectors = wheels = (*style.rgb, _GHOST_ALPHA)
        _send_body_mesh(to, snake, geometry, connectors)
    else:
        connectors = _CONNECTOR_COLOR
        wheels = _WHEEL_COLOR
        _send_tubes(to, snake, geometry)
    head = (*style.rgb, connectors[3])
    colors = [head] + [connectors] * (geometry.connectors - 1)
    _send_connectors(to, snake, geometry, colors)
    if spec.skin is None:
        _send_wheels(to, snake, geometry, wheels)
        if not ghost:
            _send_spokes(to, snake, geometry)
    if spec.is_spatial:
        _send_tracks(to, snake, style)
    _send_trail(to, snake, style)


def _send_tracks(to: Entities, snake: Trajectory, style: Style) -> None:
    places = snake.position[snake.stack("load") > 0.0]
    step = max(1, math.ceil(len(places) / _MAX_TRACKS))
    points = at_height(places[::step], _LINE_HEIGHT_M)
    tracks = rr.Points3D(points, colors=[style.rgb], radii=[_FORCE_RADIUS_M])
    to.static("tracks", tracks)


def _send_tubes(to: Entities, snake: Trajectory, geometry: Geometry) -> None:
    lines = spatial_centre_lines(snake, geometry, CHORDS)
    colors = pressure_colors(pressure_difference(snake))
    for j in range(geometry.segments):
        name = f"body/segment_{j + 1}"
        line = lines[:, j]
        step = np.diff(line, axis=1)
        # Chord lengths are logged once, as they vary by only 0.3 % for bends up to 90°.
        lengths = np.linalg.norm(step[0], axis=-1)
        tube = rr.Capsules3D.from_fields(
            lengths=lengths, radii=[geometry.width / 2], fill_mode="solid"
        )
        to.static(name, tube)
        poses = rr.Capsules3D.columns(
            translations=line[:, :-1].reshape(-1, 3).astype(np.float32),
            quaternions=_along(step),
        )
        to.send(name, poses, step.shape[1])
        to.send(name, rr.Capsules3D.columns(colors=_packed(colors[:, j])))


def _send_body_mesh(
    to: Entities, snake: Trajectory, geometry: Geometry, color: Rgba
) -> None:
    """Log the body as one hexagonal tube, because overlapping capsules look opaque."""
    lines = spatial_centre_lines(snake, geometry, CHORDS)
    has_gaps = geometry.rigid_gap > 0 or snake.has("z")
    line = joined_lines(lines, has_gaps=has_gaps)
    tangent = np.gradient(line, axis=1)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    left = np.cross([0.0, 0.0, 1.0], tangent)
    left /= np.maximum(np.linalg.norm(left, axis=-1, keepdims=True), 1e-9)
    up = np.cross(tangent, left)
    # Coincident surfaces would flicker, so the ghost is thinner than the other snake.
    radius = 0.46 * geometry.width
    angle = np.arange(6)[:, None] * np.pi / 3
    around = np.cos(angle) * left[:, :, None] + np.sin(angle) * up[:, :, None]
    vertices = (line[:, :, None] + radius * around).astype(np.float32)
    triangles = _tube_triangles(line.shape[1])
    mesh = rr.Mesh3D.from_fields(
        triangle_indices=triangles, albedo_factor=color, face_rendering="front"
    )
    to.static("body", mesh)
    columns = rr.Mesh3D.columns(vertex_positions=vertices.reshape(-1, 3))
    to.send("body", columns, 6 * line.shape[1])


def _tube_triangles(rings: int) -> np.ndarray:
    """Return outward-facing triangles between hexagonal rings."""
    ring, corner = np.meshgrid(np.arange(rings - 1), np.arange(6), indexing="ij")
    first = 6 * ring + corner
    second = 6 * ring + (corner + 1) % 6
    quads = np.stack([first, first + 6, second, second, first + 6, second + 6], axis=-1)
    return quads.reshape(-1, 3)


def _send_connectors(
    to: Entities, snake: Trajectory, geometry: Geometry, colors: list[Rgba]
) -> None:
    half = [size / 2 for size in connector_size(geometry)]
    centres = connector_places(snake, geometry).reshape(-1, 3).astype(np.float32)
    _send_solids(
        to,
        "connectors",
        rr.Boxes3D,
        centres,
        connector_orientations(snake),
        half_sizes=[half],
        colors=colors,
    )


def _send_wheels(
    to: Entities, snake: Trajectory, geometry: Geometry, color: Rgba
) -> None:
    radius = geometry.wheel_radius
    axle = np.repeat(snake.stack("connector_heading") + np.pi / 2, 2, axis=1)
    _send_solids(
        to,
        "wheels",
        rr.Cylinders3D,
        at_height(wheel_centres(snake, geometry), radius),
        _yaw_quaternions(axle),
        lengths=[0.4 * radius],
        radii=[radius],
        colors=[color],
    )


def _send_spokes(to: Entities, snake: Trajectory, geometry: Geometry) -> None:
    radius = geometry.wheel_radius
    half = [0.85 * radius, 0.22 * radius, 0.13 * radius]
    yaw = snake.stack("connector_heading")[:, :, None] / 2
    turn = wheel_turns(snake, geometry) / 2
    c = np.cos(yaw)
    s = np.sin(yaw)
    cos = np.cos(turn)
    sin = np.sin(turn)
    rotation = np.stack([-s * sin, c * sin, s * cos, c * cos], axis=-1)
    _send_solids(
        to,
        "spokes",
        rr.Boxes3D,
        at_height(wheel_centres(snake, geometry), radius),
        rotation,
        half_sizes=[half],
        colors=[_SPOKE_COLOR],
    )


def _send_solids(
    to: Entities,
    name: str,
    shape: type[rr.Boxes3D | rr.Cylinders3D],
    centres: np.ndarray,
    rotations: np.ndarray,
    **appearance: Any,
) -> None:
    to.static(name, shape.from_fields(fill_mode="solid", **appearance))
    poses = shape.columns(
        centers=centres, quaternions=rotations.reshape(-1, 4).astype(np.float32)
    )
    to.send(name, poses, len(centres) // len(to.time))


def _send_trail(to: Entities, snake: Trajectory, style: Style) -> None:
    before = np.concatenate([snake.com[:1], snake.com[:-1]])
    ends = np.stack([before, snake.com], axis=1)
    strips = at_height(ends, 0.002).reshape(-1, 2, 3)
    to.static("trail", rr.LineStrips3D.from_fields(colors=[style.rgb], radii=[0.002]))
    to.send("trail", rr.LineStrips3D.columns(strips=strips))
    to.static("com", rr.Points3D.from_fields(colors=[style.rgb], radii=[0.004]))
    to.send("com", rr.Points3D.columns(positions=at_height(snake.com, 0.003)))


def send_lines(to: Entities, lines: Iterable[FloorLine]) -> None:
    """Log lines on the floor."""
    for line in lines:
        strips = [at_height(strip, _LINE_HEIGHT_M) for strip in line.strips]
        colors = [rgb(line.color)]
        shape = rr.LineStrips3D(strips, colors=colors, radii=[line.radius])
        to.static(line.name, shape)


def at_height(points: np.ndarray, height: float) -> np.ndarray:
    """Add a height (m) to points of shape (…, 2). The result has shape (n, 3)."""
    flat = points.reshape(-1, 2)
    return np.column_stack([flat, np.full(len(flat), height)]).astype(np.float32)


def _along(steps: np.ndarray) -> np.ndarray:
    """Return quaternions xyzw, shape (n, 4), that rotate the z axis onto each step."""
    # Without a rigid gap, the first and last steps of a segment have length 0.
    length = np.maximum(np.linalg.norm(steps, axis=-1, keepdims=True), 1e-12)
    x, y, z = np.moveaxis(steps / length, -1, 0)
    turn = np.stack([-y, x, 0.0 * x, 1.0 + z], axis=-1)
    turn /= np.maximum(np.linalg.norm(turn, axis=-1, keepdims=True), 1e-9)
    return turn.reshape(-1, 4).astype(np.float32)


def _yaw_quaternions(yaw: np.ndarray) -> np.ndarray:
    """Return quaternions xyzw, shape (n, 4), that lay the z axis flat at each yaw."""
    s = np.sin(yaw / 2)
    c = np.cos(yaw / 2)
    turns: np.ndarray = np.sqrt(0.5) * np.stack([-s, c, s, c], axis=-1)
    return turns.reshape(-1, 4).astype(np.float32)


def _packed(rgba: np.ndarray) -> np.ndarray:
    """Pack RGBA bytes, shape (n, 4), into integers 0xRRGGBBAA, shape (n,)."""
    return np.ascontiguousarray(rgba).view(">u4").reshape(-1).astype(np.uint32)
