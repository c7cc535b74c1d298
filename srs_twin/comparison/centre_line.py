"""Where the body is between its connectors: its centre line, its two sides, the hull that touches obstacles.

Recorded are the connectors only (`x_i`, `y_i`, `theta_i`); between two of them a segment is half its rigid
gap straight along the front connector's heading, an arc of constant curvature, and half the gap along the
rear connector's heading (Fig. 35).
"""

from __future__ import annotations

import numpy as np

from srs_twin.comparison.sampling import segment_lengths
from srs_twin.plants.twin.mjcf.numerics import ModelSettings, hinge_stations
from srs_twin.robot.geometry import chord
from srs_twin.robot.spec import Geometry
from srs_twin.trajectory import Trajectory


def centre_lines(trajectory: Trajectory, geometry: Geometry, pieces: int = 8) -> np.ndarray:
    """Return the centre line of every segment, shape (samples, segments, pieces + 3, 2), m, front first.

    The points are: front connector, both ends of the arc with `pieces` equal parts between them, rear
    connector. The twin bends in a few hinges, not in an exact arc; what is left between the end of the
    arc and the recorded rear connector is spread evenly along the segment, so that both ends are where
    they were recorded.

    Args:
        trajectory: with `x_1…`, `y_1…`, `theta_1…`.
        geometry: of the robot that was recorded.
        pieces: straight parts that stand in for an arc, 1 or more.
    """
    theta = trajectory.stack("theta")
    front, rear = trajectory.position[:, :-1], trajectory.position[:, 1:]
    bend = (theta[:, :-1] - theta[:, 1:])[..., None]
    part = np.linspace(0.0, 1.0, pieces + 1)
    ahead = theta[:, :-1, None]
    reach = part * chord(bend * part, geometry.segment_length, 0.0)
    arc = reach[..., None] * _unit(ahead - bend * part / 2)
    stub = geometry.rigid_gap / 2
    start = front[:, :, None] - stub * _unit(ahead)
    bent = start - arc
    end = bent[:, :, -1:] - stub * _unit(theta[:, 1:, None])
    line = np.concatenate([front[:, :, None], bent, end], axis=2)
    share = np.linspace(0.0, 1.0, pieces + 3)[:, None]
    return line + share * (rear[:, :, None] - end)


def body_sides(trajectory: Trajectory, geometry: Geometry, pieces: int = 8) -> np.ndarray:
    """Return points on both sides of the body, shape (samples, points, 2), m: half its width off the line.

    Args:
        trajectory: with `x_1…`, `y_1…`, `theta_1…`.
        geometry: of the robot that was recorded.
        pieces: of each segment's arc, 1 or more.
    """
    theta = trajectory.stack("theta")
    front, rear = theta[:, :-1, None], theta[:, 1:, None]
    arc = front - (front - rear) * np.linspace(0.0, 1.0, pieces + 1)
    headings = np.concatenate([front, arc, rear], axis=2)
    lines = centre_lines(trajectory, geometry, pieces)
    return on_both_sides(lines, headings, geometry.width / 2).reshape(len(lines), -1, 2)


def on_both_sides(points: np.ndarray, heading: np.ndarray, half_width: float) -> np.ndarray:
    """Return the points to the left, then those to the right of a line: (…, k, 2) give (…, 2 k, 2), m."""
    across = half_width * np.stack([-np.sin(heading), np.cos(heading)], axis=-1)
    return np.concatenate([points + across, points - across], axis=-2)


def hull_lines(trajectory: Trajectory) -> np.ndarray:
    r"""Return the line whose points are half the body's width inside the hull, shape (samples, points, 2), m.

    The twin collides a capsule between each two neighbouring hinges (`mjcf.surroundings`); this is the line
    of their axes in the plane, through connectors and hinges, head first. A connector's pose places the
    hinges next to it, so that the line is the twin's own for one or two hinges a segment. With more, the
    inner ones are taken to share the bend equally. A model without hinges has those that the twin would have
    in its place: the middle of a segment bent by q is then $$ l\,|q|/24 $$ inside of its arc's, and 5 % more
    at 1.5 rad (1.5 mm at 1 rad in generation 2).

    Args:
        trajectory: with `x_1…`, `y_1…`, `theta_1…` and the lengths in its metadata.

    Raises:
        InputError: the lengths are not there.
    """
    theta, position = trajectory.stack("theta"), trajectory.position
    hinges = trajectory.metadata.get("hinges_per_segment", ModelSettings.hinges_per_segment)
    length, gap = segment_lengths(trajectory)
    pieces = np.diff(hinge_stations(hinges, length, gap), prepend=0.0, append=length + gap)
    part = np.linspace(0.0, 1.0, hinges + 1)
    headings = theta[:, :-1, None] + np.diff(theta, axis=1)[..., None] * part
    line = position[:, :-1, None] - np.cumsum(pieces[:, None] * _unit(headings), axis=2)
    # From the last hinge on the rear connector decides; what is left is spread over the hinges before it.
    share = np.append(np.linspace(0.0, 1.0, hinges), 1.0)[:, None]
    line += share * (position[:, 1:, None] - line[:, :, -1:])
    return np.concatenate([position[:, :1], line.reshape(len(line), -1, 2)], axis=1)


def _unit(angle: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
