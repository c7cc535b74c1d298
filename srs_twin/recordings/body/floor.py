"""Detection of the floor plane, and transformation of markers to floor coordinates.

**Vertical axis.** Each marker of a crawling snake has a nearly constant height, so its
displacements d over time are nearly parallel to the floor. The cross product d₁ × d₂ of
any two displacements is a candidate for the floor normal n. The candidate with the
smallest median |n·d| is refined by a principal component analysis of the displacements,
without outliers. If the snake does not move, the plane is fitted to the marker
positions, and unequal marker heights tilt the plane. The vertical axis is the file axis
closest to the normal.

**Levelling.** A tilt of the floor is removed only if it is certain. The gradients of
the floor are computed by a robust fit of the marker heights over the horizontal marker
positions. A lift of the body in phase with the motion causes an apparent gradient L/S,
where L is the RMS lift and S the RMS displacement. A gradient is therefore interpreted
as a tilt only if it exceeds twice the gradient for a lift of 1 % of the body length.
Each principal direction of the motion is tested separately.

The floor coordinates x and y follow from the file axes X, Y and Z by a rotation, which
preserves left and right:

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
from typing import Literal

import numpy as np

from srs_twin.errors import InputError
from srs_twin.recordings.body.tracking import pairwise_distances

Up = Literal["x", "y", "z", "-x", "-y", "-z"]
"""File axis that points up."""

MAPS = {
    "z": ((0, 1), (1, 1), (2, 1)),
    "y": ((0, 1), (2, -1), (1, 1)),
    "x": ((1, 1), (2, 1), (0, 1)),
    "-z": ((0, 1), (1, -1), (2, -1)),
    "-y": ((0, 1), (2, 1), (1, -1)),
    "-x": ((1, 1), (2, -1), (0, -1)),
}
"""File axis and sign of the floor coordinates x, y and height, by vertical axis."""

UPS = ("auto", *MAPS)

_SAMPLES = 20_000
_LAG_FRACTIONS = (60, 30, 10)
"""Ratios of the recording duration to the time spans of displacements."""
_NORMALS = 400
_LIFT_FRACTION = 0.01
"""Assumed RMS lift in phase with the motion, relative to the body length."""
_CERTAIN_RATIO = 2.0
"""Minimum ratio of a certain tilt to the apparent gradient due to the assumed lift."""
_EXTENT_FRAMES = 200
_FIT_ITERATIONS = 8
_MAX_SHIFT = 1e-3
"""Maximum horizontal shift between high and low markers due to an ignored tilt, m."""
_PLANE_RATIO = 3.0
"""Minimum ratio of the spread in a plane to the spread normal to it."""
_MAX_TILT = np.radians(3.0)
"""Maximum tilt that is ignored, rad."""
_MAX_AXIS_TILT = np.radians(30.0)
"""Maximum angle between the floor normal and the vertical axis of the file, rad."""


@dataclass(frozen=True)
class FloorPlane:
    """Marker positions in floor coordinates, and the detected vertical axis.

    Attributes:
        points: coordinates x, y and height above the file origin, shape (frames,
            columns, 3), m. All heights are 0 if the file contains none.
    """

    up: str
    points: np.ndarray
    corrections: tuple[str, ...]


def map_to_floor(
    points: np.ndarray, up: str, usual: str, level: bool | None = None
) -> FloorPlane:
    """Transform markers to floor coordinates.

    Args:
        points: marker positions, shape (frames, columns, 3) or (…, 2), m.
        up: vertical axis, one of `UPS`.
        usual: common vertical axis of the file format, used if the markers do not
            determine the axis.
        level: whether to remove the tilt of the floor, or None to remove only a certain
            tilt.
    """
    notes: list[str] = []
    planar = points.shape[-1] == 2
    if planar:
        if up not in ("auto", "z", "-z"):
            raise InputError(
                f"up {up} is not allowed for a file that has only x and y; use z, or"
                " -z if y points down"
            )
        up = up.replace("auto", "z")
        points = np.concatenate([points, np.zeros_like(points[..., :1])], axis=-1)
    elif up == "auto":
        up, points, notes = _find_floor(points, usual, level)
    elif level:
        points, notes = _levelled(points, "xyz".index(up[-1]), level)
    mapped = np.stack([sign * points[..., axis] for axis, sign in MAPS[up]], axis=-1)
    if planar and up == "-z":
        notes.append("y is reversed, because up is -z")
    elif up != "z":
        x, y, _ = (("−" if sign < 0 else "") + "XYZ"[axis] for axis, sign in MAPS[up])
        notes.append(
            f"the axes are rotated: floor x is {x} of the file, and floor y is {y} of"
            " the file"
        )
    return FloorPlane(up, mapped, tuple(notes))


def _find_floor(
    points: np.ndarray, usual: str, level: bool | None
) -> tuple[str, np.ndarray, list[str]]:
    visible = points[np.isfinite(points).all(axis=-1)]
    visible = visible[:: len(visible) // _SAMPLES + 1]
    if len(visible) < 3:
        raise InputError(
            "the file has too few marker positions to determine the floor; record"
            " more frames"
        )
    spread, axes = _principal_axes(_displacements(points))
    if not _is_plane(spread):
        spread, axes = _principal_axes(visible - np.median(visible, axis=0))
    axis = int(np.argmax(np.abs(axes[:, 0])))
    if not _is_plane(spread):
        common = "xyz".index(usual)
        vertical = np.median(np.abs(visible[:, common] - np.median(visible[:, common])))
        if vertical > 2 * spread[0] + 1e-3:
            raise InputError(
                "the vertical axis cannot be determined, because the markers spread"
                f" {1e3 * spread[0]:.0f} mm and {1e3 * spread[1]:.0f} mm in two"
                " directions; set it with --up x, y or z, or with `up` in a map"
            )
        note = (
            f"up is assumed to be {usual}, as usual in such files, because the markers"
            " do not determine it"
        )
        return usual, points, [note]
    normal = axes[:, 0] * np.sign(axes[axis, 0])
    tilt = float(np.arccos(min(1.0, normal[axis])))
    if tilt > _MAX_AXIS_TILT:
        raise InputError(
            f"the plane of the markers is tilted by {np.degrees(tilt):.0f}° from all"
            " axes; rotate the recording, or give the vertical axis with --up x, y or"
            " z, or with `up` in a map"
        )
    # A calibration square on the floor defines the origin, so the markers are above the
    # origin.
    height = float(np.median(visible[:, axis]))
    up = ("-" if height < -1e-3 else "") + "xyz"[axis]
    notes = [f"up is {up}: markers stay within {1e3 * spread[0]:.1f} mm of a plane"]
    if abs(height) <= 1e-3:
        notes.append(
            f"the markers are at a height of 0, so {up} is assumed to point up, not"
            " down"
        )
    levelled, tilt_notes = _levelled(points, axis, level)
    return up, levelled, notes + tilt_notes


def _levelled(
    points: np.ndarray, axis: int, level: bool | None
) -> tuple[np.ndarray, list[str]]:
    horizontal = [k for k in range(3) if k != axis]
    seen = np.isfinite(points).all(axis=-1).any(axis=0)
    place = points[:, seen][..., horizontal]
    height = points[:, seen, axis]
    slopes, residual = _fit_slopes(place, height)
    spread, axes = _horizontal_axes(place)
    lift = np.hypot(_LIFT_FRACTION * _body_extent(place), residual)
    along = axes.T @ slopes
    certain = np.abs(along) > _CERTAIN_RATIO * lift / spread
    if level is not None:
        certain[:] = level
    removed = axes @ np.where(certain, along, 0.0)
    suspected = float(np.degrees(np.arctan(np.linalg.norm(slopes - removed))))
    notes = []
    tilt = float(np.arctan(np.linalg.norm(removed)))
    heights = np.nanmedian(height - place @ removed, axis=0)
    shift = tilt * float(np.nanmax(heights) - np.nanmin(heights))
    if level or tilt > _MAX_TILT or shift > _MAX_SHIFT:
        normal = np.zeros(3)
        normal[horizontal] = -removed
        normal[axis] = 1.0
        points = _rotated(points, normal, axis)
        notes.append(f"the floor was levelled by {np.degrees(tilt):.1f}°")
    if level is None and suspected > np.degrees(_MAX_TILT):
        notes.append(
            f"a tilt of {suspected:.1f}° was not removed, because a lift in phase with"
            " the motion looks the same; set `level: true` in a map to remove the tilt"
        )
    return points, notes


def _rotated(points: np.ndarray, normal: np.ndarray, axis: int) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    centre = np.nanmedian(points.reshape(-1, 3), axis=0)
    level, _ = Rotation.align_vectors(np.eye(3)[axis], normal)
    return np.asarray((points - centre) @ level.as_matrix().T + centre)


def _fit_slopes(place: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, float]:
    x, y = (place - np.nanmean(place, axis=0)).reshape(-1, 2).T
    z = (height - np.nanmean(height, axis=0)).ravel()
    known = np.flatnonzero(np.isfinite(x + y + z))
    known = known[:: len(known) // _SAMPLES + 1]
    position = np.column_stack([x[known], y[known]])
    slopes = np.zeros(2)
    weight = np.ones(len(known))
    residual = 0.0
    for _ in range(_FIT_ITERATIONS):
        weighted = position * weight[:, None]
        slopes = np.linalg.lstsq(
            weighted.T @ position, weighted.T @ z[known], rcond=None
        )[0]
        deviation = np.abs(z[known] - position @ slopes)
        residual = float(np.median(deviation))
        # Cauchy weights reduce the influence of markers that move up and down, such as
        # a marker on the head.
        weight = 1 / (1 + (deviation / (3 * residual + 1e-4)) ** 2)
    return slopes, residual


def _horizontal_axes(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ascending RMS displacements along the principal axes, and the axes."""
    moved = place - np.nanmean(place, axis=0)
    products = moved[..., :, None] * moved[..., None, :]
    covariance = np.nanmedian(np.nanmean(products, axis=0), axis=0)
    values, axes = np.linalg.eigh(covariance)
    return np.sqrt(np.maximum(values, 1e-12)), axes


def _body_extent(place: np.ndarray) -> float:
    distance = pairwise_distances(place, _EXTENT_FRAMES)
    seen = np.isfinite(distance).any(axis=2)
    if seen.any():
        return float(np.median(np.nanmax(distance[seen], axis=-1)))
    return 0.0


def _displacements(points: np.ndarray) -> np.ndarray:
    lags = {max(1, len(points) // parts) for parts in _LAG_FRACTIONS}
    moved = np.concatenate(
        [(points[lag:] - points[:-lag]).reshape(-1, 3) for lag in sorted(lags)]
    )
    moved = moved[np.isfinite(moved).all(axis=1)]
    moved = moved[:: len(moved) // _SAMPLES + 1]
    distance = np.linalg.norm(moved, axis=1)
    # A displacement contains the noise of two positions, so the standard deviation is
    # √2 times as large as for one position.
    return np.asarray(moved[distance >= np.median(distance)] / np.sqrt(2))


def _is_plane(spread: np.ndarray) -> bool:
    return bool(spread[1] >= _PLANE_RATIO * spread[0] + 1e-3)


def _principal_axes(moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ascending RMS values along the principal axes, and the axes."""
    pairs = np.random.default_rng(0).integers(len(moved), size=(2, _NORMALS))
    normals = np.cross(*moved[pairs])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)
    distance = np.abs(moved[:: len(moved) // 2000 + 1] @ normals.T)
    normal = normals[np.argmin(np.median(distance, axis=0))]
    inliers = moved
    for _ in range(4):
        distance = np.abs(moved @ normal)
        inliers = moved[distance <= 5 * np.median(distance) + 1e-3]
        values, axes = np.linalg.eigh(
            inliers.T @ inliers / len(inliers) + 1e-18 * np.eye(3)
        )
        normal = axes[:, 0]
    return np.sqrt(np.maximum(values, 0.0)), axes
