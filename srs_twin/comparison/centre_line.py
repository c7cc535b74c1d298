"""Centre line and sides of the body, computed from recorded connector poses.

Each segment lies between two connectors. It consists of an arc of constant curvature
and two straight parts, each as long as half the rigid gap and aligned with the adjacent
connector (Fig. 35).
"""

from __future__ import annotations

import numpy as np

from srs_twin.compute.arrays import Array
from srs_twin.robot.geometry import chord
from srs_twin.robot.spec import Geometry
from srs_twin.trajectory import Trajectory

_MIN_OVERLAP = 0.25
"""Minimum reported overlap between two parts of the body, in body widths.

Smaller overlaps may be artefacts. The collision geoms of the twin are chords that lie
up to 3 mm inside the arcs, and contacts are not perfectly rigid.
"""
_MAX_SAMPLES = 200
"""Maximum number of samples that are searched for overlaps."""


def centre_lines(
    trajectory: Trajectory, geometry: Geometry, divisions: int = 8
) -> Array:
    """Return the centre line of every segment, starting with the front segment.

    The points of a centre line are the front connector, points on the arc, and the rear
    connector. The twin bends at a few hinges and not along an exact arc, so the
    computed rear end deviates from the recorded rear connector. This deviation is
    distributed evenly along the line.

    Args:
        trajectory: run with recorded connector poses.
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

    The height is at least half the body width, so that the drawn body does not
    penetrate the floor.
    """
    return max(geometry.com_height, geometry.width / 2)


def connector_size(geometry: Geometry) -> tuple[float, float, float]:
    """Return the length, width and height of a drawn connector, m."""
    track = geometry.half_track
    height = 0.7 * geometry.width
    return (
        max(geometry.rigid_gap / 2, 0.2 * track),
        max(2 * track - 0.4 * geometry.wheel_radius, height),
        height,
    )


def connector_places(trajectory: Trajectory, geometry: Geometry) -> Array:
    """Return the positions of the N drawn connectors, shape (samples, N, 3), m."""
    height = np.full_like(trajectory.stack("x"), line_height(geometry))
    if trajectory.has("z"):
        height = trajectory.stack("z") + (line_height(geometry) - geometry.com_height)
    return np.concatenate([trajectory.position, height[..., None]], axis=-1)


def connector_orientations(trajectory: Trajectory) -> Array:
    """Return connector orientations as xyzw quaternions, shape (samples, N, 4)."""
    if trajectory.has("quaternion_w"):
        parts = [trajectory.stack(f"quaternion_{axis}") for axis in "xyzw"]
        return np.stack(parts, axis=-1)
    half = trajectory.stack("connector_heading") / 2
    zero = np.zeros_like(half)
    return np.stack([zero, zero, np.sin(half), np.cos(half)], axis=-1)


def spatial_centre_lines(
    trajectory: Trajectory, geometry: Geometry, divisions: int
) -> Array:
    """Return the centre line of every segment in three dimensions.

    The centre line of a spatial segment is a cubic curve between two connectors, which
    is tangent to the connector axes. The centre lines of a planar snake are computed by
    `centre_lines` and have a constant height.

    Args:
        trajectory: run with recorded connector poses.
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
    """Return the points offset to the left, followed by the points offset to the right.

    Args:
        points: points of the line, shape (…, k, 2), m.
        heading: direction of the line at each point, shape (…, k), rad.
        half_width: distance by which the points are offset, m.
    """
    offset = half_width * np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    return np.concatenate([points + offset, points - offset], axis=-2)


def body_overlap(trajectory: Trajectory, geometry: Geometry) -> float:
    """Return the maximum overlap between two parts of a planar body, m.

    Parts of the body can overlap, because only the twin in a world with objects
    simulates contacts between them. Samples in which the connector headings span at
    most π are skipped, because such a body cannot touch itself. Two points are
    compared only if their distance along the body exceeds twice the body width. The
    result is 0 for a spatial snake and for an overlap below a quarter of the body
    width.
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
