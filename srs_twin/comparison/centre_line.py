"""Centre line and sides of the body, computed from recorded connector poses.

Between two connectors, a segment consists of an arc of constant curvature with half of
the rigid gap at each end (Fig. 35). Each half gap is straight and has the heading of
the adjacent connector.
"""

from __future__ import annotations

import numpy as np

from srs_twin.compute.arrays import Array
from srs_twin.robot.geometry import chord
from srs_twin.robot.spec import Geometry
from srs_twin.trajectory import Trajectory

_MIN_OVERLAP = 0.25
"""Minimum overlap between two parts of the body that is reported, in body widths.

Smaller overlaps may be artefacts, because the twin's collision geoms are chords that
lie up to 3 mm inside the arcs, and because contacts are not perfectly rigid.
"""
_MAX_SAMPLES = 200
"""Maximum number of samples searched for overlaps."""


def centre_lines(
    trajectory: Trajectory, geometry: Geometry, divisions: int = 8
) -> Array:
    """Return the centre line of every segment, ordered from the front.

    A centre line consists of the front connector, points on the arc, and the rear
    connector. The twin bends in a few hinges instead of an exact arc, so the computed
    rear end deviates from the recorded rear connector. The deviation is distributed
    evenly along the segment, so that both ends keep their recorded positions.

    Args:
        trajectory: recorded connector poses.
        geometry: robot geometry.
        divisions: number of chords per arc.

    Returns:
        Centre lines, shape (samples, segments, divisions + 3, 2), m.
    """
    theta = trajectory.stack("connector_heading")
    front = trajectory.position[:, :-1]
    rear = trajectory.position[:, 1:]
    bend = (theta[:, :-1] - theta[:, 1:])[..., None]
    fraction = np.linspace(0.0, 1.0, divisions + 1)
    heading = theta[:, :-1, None]
    chords = fraction * chord(bend * fraction, geometry.segment_length, 0.0)
    arc = chords[..., None] * _unit(heading - bend * fraction / 2)
    half_gap = geometry.rigid_gap / 2
    arc_start = front[:, :, None] - half_gap * _unit(heading)
    arc_points = arc_start - arc
    end = arc_points[:, :, -1:] - half_gap * _unit(theta[:, 1:, None])
    line = np.concatenate([front[:, :, None], arc_points, end], axis=2)
    weight = np.linspace(0.0, 1.0, divisions + 3)[:, None]
    return line + weight * (rear[:, :, None] - end)


def line_height(geometry: Geometry) -> float:
    """Return the height at which the centre line is drawn, m.

    It is at least half the body width, so that the body does not penetrate the floor.
    """
    return max(geometry.com_height, geometry.width / 2)


def connector_size(geometry: Geometry) -> tuple[float, float, float]:
    """Return length, width and height with which a connector is drawn, m.

    Connectors are visible even if the robot has no rigid gap.
    """
    track = geometry.half_track
    height = 0.7 * geometry.width
    return (
        max(geometry.rigid_gap / 2, 0.2 * track),
        max(2 * track - 0.4 * geometry.wheel_radius, height),
        height,
    )


def connector_places(trajectory: Trajectory, geometry: Geometry) -> Array:
    """Return the points at which connectors are drawn, shape (samples, N, 3), m."""
    height = np.full_like(trajectory.stack("x"), line_height(geometry))
    if trajectory.has("z"):
        height = trajectory.stack("z") + (line_height(geometry) - geometry.com_height)
    return np.concatenate([trajectory.position, height[..., None]], axis=-1)


def connector_orientations(trajectory: Trajectory) -> Array:
    """Return connector orientations as quaternions xyzw, shape (samples, N, 4)."""
    if trajectory.has("quaternion_w"):
        parts = [trajectory.stack(f"quaternion_{axis}") for axis in "xyzw"]
        return np.stack(parts, axis=-1)
    half = trajectory.stack("connector_heading") / 2
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)


def spatial_centre_lines(
    trajectory: Trajectory, geometry: Geometry, divisions: int
) -> Array:
    """Return the centre line of every segment in space.

    The centre lines are cubic curves between the connectors. At each end, the curve is
    tangent to the axis of the connector.

    Args:
        trajectory: recorded connector poses.
        geometry: robot geometry.
        divisions: number of chords per arc.

    Returns:
        Centre lines, shape (samples, segments, divisions + 3, 3), m.
    """
    if not trajectory.has("z"):
        flat = centre_lines(trajectory, geometry, divisions)
        height = np.full_like(flat[..., :1], line_height(geometry))
        return np.concatenate([flat, height], axis=-1)
    place = connector_places(trajectory, geometry)
    x, y, z, w = np.moveaxis(connector_orientations(trajectory), -1, 0)
    axis = np.stack(
        [1 - 2 * (y**2 + z**2), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1
    )
    t = np.linspace(0.0, 1.0, divisions + 3)[:, None]
    front = place[:, :-1, None]
    rear = place[:, 1:, None]
    tangents = -geometry.pitch * axis
    blend = t**2 * (3 - 2 * t)
    curve = (
        t * (1 - t) ** 2 * tangents[:, :-1, None]
        + t**2 * (t - 1) * tangents[:, 1:, None]
    )
    return front + blend * (rear - front) + curve


def body_sides(trajectory: Trajectory, geometry: Geometry, divisions: int = 8) -> Array:
    """Return points on both sides of the body, shape (samples, points, 2), m."""
    theta = trajectory.stack("connector_heading")
    front = theta[:, :-1, None]
    rear = theta[:, 1:, None]
    arc = front - (front - rear) * np.linspace(0.0, 1.0, divisions + 1)
    headings = np.concatenate([front, arc, rear], axis=2)
    lines = centre_lines(trajectory, geometry, divisions)
    return offset_to_sides(lines, headings, geometry.width / 2).reshape(
        len(lines), -1, 2
    )


def offset_to_sides(points: Array, heading: Array, half_width: float) -> Array:
    """Return points offset to the left, followed by points offset to the right.

    Args:
        points: points, shape (…, k, 2), m.
        heading: direction of the line, shape (…, k), rad.
        half_width: offset, m.
    """
    offset = half_width * np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    return np.concatenate([points + offset, points - offset], axis=-2)


def body_overlap(trajectory: Trajectory, geometry: Geometry) -> float:
    """Return the maximum overlap between two parts of a planar body, m.

    Self-contacts are simulated only by the twin in a world with objects. At most 200
    samples are searched. Samples in which the connector headings span less than π are
    skipped, because such a body cannot touch itself. Points are compared if their
    distance along the body exceeds twice the body width. An overlap below a quarter of
    the width is returned as 0.
    """
    curled = np.flatnonzero(
        np.ptp(trajectory.stack("connector_heading"), axis=1) > np.pi
    )
    if trajectory.has("z") or not len(curled):
        return 0.0
    rows = curled[:: -(-len(curled) // _MAX_SAMPLES)]
    samples = Trajectory(
        {name: column[rows] for name, column in trajectory.columns.items()}
    )
    lines = centre_lines(samples, geometry).reshape(len(rows), -1, 2)
    steps = np.hypot(*np.moveaxis(np.diff(lines, axis=1), -1, 0))
    along = np.concatenate([np.zeros((len(rows), 1)), np.cumsum(steps, axis=1)], axis=1)
    largest = 0.0
    for line, s in zip(lines, along, strict=True):
        distance = np.hypot(*(line[:, None] - line).transpose(2, 0, 1))
        apart = np.abs(s[:, None] - s) > 2 * geometry.width
        largest = max(
            largest, geometry.width - float(distance[apart].min(initial=np.inf))
        )
    if largest >= _MIN_OVERLAP * geometry.width:
        return largest
    return 0.0


def _unit(angle: Array) -> Array:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
