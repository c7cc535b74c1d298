"""Floor plane of a recording: vertical axis, and the map from file axes to floor coordinates.

Each marker of a crawling snake keeps its height, so its displacements d over time are parallel to the floor.
Candidate normals n are cross products d₁ × d₂. The one with the smallest median |n·d| is refined by principal
components of the displacements close to its plane. A recording without motion has only the positions of the
markers, and markers of unequal height tilt a plane through them.

The axis of the file closest to the normal points up. Each map is a rotation, so left and right are preserved:

| up | x    | y    |
|----|------|------|
| z  | X    | Y    |
| y  | X    | −Z   |
| x  | Y    | Z    |
| −z | X    | −Y   |
| −y | X    | Z    |
| −x | Y    | −Z   |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError

MAPS = {
    "z": ((0, 1), (1, 1), (2, 1)), "y": ((0, 1), (2, -1), (1, 1)), "x": ((1, 1), (2, 1), (0, 1)),
    "-z": ((0, 1), (1, -1), (2, -1)), "-y": ((0, 1), (2, 1), (1, -1)), "-x": ((1, 1), (2, -1), (0, -1)),
}  # fmt: skip
"""Vertical axis → (axis of the file, sign) of the floor's x, of its y and of the height."""

UPS = ("auto", *MAPS)

_SAMPLES = 20_000
"""Largest number of positions or displacements that are used."""
_LAG_FRACTIONS = (60, 30, 10)
"""Durations of displacements, as the duration of the recording divided by these numbers."""
_NORMALS = 400
"""Number of candidate normals."""
_MAX_SHIFT = 1e-3
"""Displacement of high markers relative to low ones, by a tilt, above which the recording is levelled, m."""
_PLANE_RATIO = 3.0
"""Ratio of the spread in a plane to that normal to it, 1, above which the plane is determined."""
_SAME_HEIGHT = 0.05
"""Height difference from most markers up to which a marker is assumed to be on the robot, m."""
_CONSTANT_HEIGHT = 0.02
"""Range of the height up to which a marker at another height may be on the robot, m."""
_MAX_DISTANCE_RANGE = 0.5
"""Largest range of the distance of such a marker from a marker of the robot, relative to the distance, 1."""
_MIN_MOTION_RATIO = 0.2
"""Smallest motion of such a marker relative to that marker of the robot, 1."""
_MAX_TILT = np.radians(3.0)
"""Tilt above which the recording is levelled."""
_MAX_AXIS_TILT = np.radians(30.0)
"""Largest tilt at which an axis of the file counts as vertical."""


@dataclass(frozen=True)
class FloorPlane:
    """Markers in floor coordinates, with the detected vertical axis.

    Attributes:
        up: vertical axis of the file.
        points: x and y on the floor, and height above the origin of the file (0 if the file has no heights),
            shape (frames, columns, 3), m.
        corrections: notes on results and changes, for the summary.
    """

    up: str
    points: np.ndarray
    corrections: tuple[str, ...]


def map_to_floor(points: np.ndarray, up: str, usual: str) -> FloorPlane:
    """Transform markers to floor coordinates.

    Args:
        points: shape (frames, columns, 3) or (…, 2), m.
        up: one of `UPS`.
        usual: vertical axis that is usual for the file format; the fallback if the markers do not determine
            it.

    Raises:
        InputError: a plane file does not have the axis, or the vertical axis cannot be determined.
    """
    notes: list[str] = []
    planar = points.shape[-1] == 2
    if planar:
        if up not in ("auto", "z", "-z"):
            raise InputError(
                f"up {up} is not allowed for a file with x and y only; use z, or -z if y points down"
            )
        up = up.replace("auto", "z")
        points = np.concatenate([points, np.zeros_like(points[..., :1])], axis=-1)
    elif up == "auto":
        up, points, notes = _find_floor(points, usual)
    mapped = np.stack([sign * points[..., axis] for axis, sign in MAPS[up]], axis=-1)
    if up != "z":
        x, y, _ = (("−" if sign < 0 else "") + "XYZ"[axis] for axis, sign in MAPS[up])
        rotated = f"axes rotated: floor x is {x}, floor y is {y} of the file"
        notes.append("y reversed, because up is -z" if planar else rotated)
    return FloorPlane(up, mapped, tuple(notes))


def foreign_tracks(tracks: np.ndarray) -> dict[int, str]:
    """Return the tracks that do not belong to the robot, with reasons.

    A marker at another height than most, for example on a mast, belongs to the robot if it keeps this height
    and its distance from another marker of the robot, and moves together with that one.

    Args:
        tracks: in floor coordinates, shape (frames, tracks, 3), m.
    """
    visible = np.isfinite(tracks[..., 0])
    usual = np.quantile(tracks[visible][:, 2], 0.5, method="lower") if visible.any() else 0.0
    heights = [tracks[visible[:, k], k, 2] for k in range(tracks.shape[1])]
    different = [
        k for k, height in enumerate(heights) if height.size and abs(np.median(height) - usual) > _SAME_HEIGHT
    ]
    robot = [k for k, height in enumerate(heights) if height.size and k not in different]
    height_range = {k: _range(heights[k]) for k in different}
    candidates = [k for k in different if height_range[k] <= _CONSTANT_HEIGHT]
    # A marker may be attached to a marker that has itself just been accepted.
    while accepted := [
        k for k in candidates if any(_move_together(tracks[:, [k, other], :2]) for other in robot)
    ]:
        robot += accepted
        candidates = [k for k in candidates if k not in accepted]
    reasons = {}
    for k in (k for k in different if k not in robot):
        varies = f"its height varies by {1e3 * height_range[k]:.0f} mm"
        reason = varies if height_range[k] > _CONSTANT_HEIGHT else "does not move with the other markers"
        reasons[k] = f"{1e3 * np.median(heights[k]):.0f} mm high, {reason}"
    return reasons


def _range(values: np.ndarray) -> float:
    """Return the range between the 5 % and the 95 % quantile."""
    low, high = np.quantile(values, [0.05, 0.95])
    return float(high - low)


def _move_together(pair: np.ndarray) -> bool:
    """Return whether two tracks move together, given their positions, shape (frames, 2, 2), m."""
    pair = pair[np.isfinite(pair).all(axis=(1, 2))]
    if len(pair) < 2:
        return False
    distance = np.linalg.norm(pair[:, 0] - pair[:, 1], axis=-1)
    motion, other_motion = np.linalg.norm(pair - np.median(pair, axis=0), axis=-1).mean(axis=0)
    rigid = _range(distance) <= _MAX_DISTANCE_RANGE * np.median(distance) + _CONSTANT_HEIGHT / 2
    return bool(rigid and motion >= _MIN_MOTION_RATIO * other_motion)


def _find_floor(points: np.ndarray, usual: str) -> tuple[str, np.ndarray, list[str]]:
    """Return the vertical axis, the points after levelling, and notes."""
    visible = points[np.isfinite(points).all(axis=-1)]
    visible = visible[:: len(visible) // _SAMPLES + 1]
    if len(visible) < 3:
        raise InputError("the file has too few marker positions to determine the floor")
    centre, (spread, axes) = np.median(visible, axis=0), _principal_axes(_displacements(points))
    if not _is_plane(spread):
        spread, axes = _principal_axes(visible - centre)
    axis = int(np.argmax(np.abs(axes[:, 0])))
    if not _is_plane(spread):
        common = "xyz".index(usual)
        vertical = np.median(np.abs(visible[:, common] - np.median(visible[:, common])))
        if vertical > 2 * spread[0] + 1e-3:
            raise InputError(
                f"the vertical axis cannot be determined, because the markers spread {1e3 * spread[0]:.0f} "
                f"mm and {1e3 * spread[1]:.0f} mm in two directions; give --up x, y or z, or `up` in a map"
            )
        return (
            usual,
            points,
            [f"up assumed to be {usual}, as usual in such files: markers do not determine it"],
        )
    normal = axes[:, 0] * np.sign(axes[axis, 0])
    tilt = float(np.arccos(min(1.0, normal[axis])))
    if tilt > _MAX_AXIS_TILT:
        raise InputError(
            f"the plane of the markers is tilted by {np.degrees(tilt):.0f}° from all axes; rotate the "
            "recording, or give --up x, y or z, or `up` in a map"
        )
    # The origin is on the floor, where the calibration square was, so the markers are above it.
    height = float(np.median(visible[:, axis]))
    up = ("-" if height < -1e-3 else "") + "xyz"[axis]
    plane = f"{1e3 * spread[0]:.1f} mm of a plane that is tilted by {np.degrees(tilt):.1f}°"
    notes = [f"up is {up}: markers stay within {plane}"]
    if abs(height) <= 1e-3:
        notes.append(f"the markers have the height 0: {up} is assumed to point up, not down")
    # All heights are used: there are too few columns for quantiles.
    ever = np.isfinite(points).any(axis=(0, -1))
    heights = np.nanmedian(points[:, ever] @ normal, axis=0) if points.ndim > 2 else np.zeros(1)
    if tilt > _MAX_TILT or tilt * np.ptp(heights) > _MAX_SHIFT:
        from scipy.spatial.transform import Rotation

        level, _ = Rotation.align_vectors(np.eye(3)[axis], normal)
        points = (points - centre) @ level.as_matrix().T + centre
        notes.append(f"levelled by {np.degrees(tilt):.1f}°")
    return up, points, notes


def _displacements(points: np.ndarray) -> np.ndarray:
    """Return the larger half of the displacements of markers over some durations, shape (samples, 3), m."""
    lags = {max(1, len(points) // parts) for parts in _LAG_FRACTIONS}
    moved = np.concatenate([(points[lag:] - points[:-lag]).reshape(-1, 3) for lag in sorted(lags)])
    moved = moved[np.isfinite(moved).all(axis=1)]
    moved = moved[:: len(moved) // _SAMPLES + 1]
    distance = np.linalg.norm(moved, axis=1)
    # Noise at both ends makes the spread of displacements √2 times that of positions.
    return np.asarray(moved[distance >= np.median(distance)] / np.sqrt(2))


def _is_plane(spread: np.ndarray) -> bool:
    return bool(spread[1] >= _PLANE_RATIO * spread[0] + 1e-3)


def _principal_axes(moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the spreads about the origin (ascending) and their directions (columns), without outliers."""
    pairs = np.random.default_rng(0).integers(len(moved), size=(2, _NORMALS))
    normals = np.cross(*moved[pairs])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)
    distance = np.abs(moved[:: len(moved) // 2000 + 1] @ normals.T)
    normal, inliers = normals[np.argmin(np.median(distance, axis=0))], moved
    for _ in range(4):
        distance = np.abs(moved @ normal)
        inliers = moved[distance <= 5 * np.median(distance) + 1e-3]
        values, axes = np.linalg.eigh(inliers.T @ inliers / len(inliers) + 1e-18 * np.eye(3))
        normal = axes[:, 0]
    return np.sqrt(np.maximum(values, 0.0)), axes
