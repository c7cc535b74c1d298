"""Floor: which way is up in a recording, and the map from its axes to the floor plane.

Each marker of a crawling snake keeps its height, so its displacements d over some time lie in the floor plane
at any height. The normal n is the one of many normals d₁ × d₂ with the least median |n·d|, refined by
principal components of the displacements near that plane. A take without motion has only the positions of the
markers to fit a plane to, which markers of unequal height tilt.

The axis of the file closest to the normal points up. Each map is a rotation, so left stays left:

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
"""Up → (axis of the file, sign) of the floor's x, its y and of the height."""

UPS = ("auto", *MAPS)

_SAMPLED = 20_000
_PARTS = (60, 30, 10)  # of a take: the spans of time over which markers move
_NORMALS = 400  # candidates for the normal
_SHIFT = 1e-3  # m: a tilt that displaces high markers farther against low ones is levelled
_PLAIN = 3.0  # how many times further markers spread in the plane than out of it, where that tells the plane
_SAME_LEVEL = 0.05  # m: so far from most markers' height any marker may be the robot's
_STEADY = 0.02  # m: a marker at another height that varies more is not on the robot
_VARIES = 0.5  # of the distance from the robot's nearest marker: it varies less
_MOVES = 0.2  # of the motion of that marker
_LEVEL = np.radians(3.0)  # beyond this the recording is levelled
_STEEPEST = np.radians(30.0)


@dataclass(frozen=True)
class FloorPlane:
    """Markers over the floor.

    Attributes:
        up: the axis of the file that points up.
        points: x and y on the floor, and height above the file's origin (0 where the file has none), shape
            (frames, columns, 3), m.
        corrections: what was found and done, in words.
    """

    up: str
    points: np.ndarray
    corrections: tuple[str, ...]


def on_floor(points: np.ndarray, up: str, usual: str) -> FloorPlane:
    """Map markers to the floor.

    Args:
        points: shape (frames, columns, 3) or (…, 2), m.
        up: one of `UPS`.
        usual: the axis that such files have upwards, taken where the markers do not tell.

    Raises:
        InputError: an axis that a plane does not have, or no way to tell.
    """
    notes: list[str] = []
    flat = points.shape[-1] == 2
    if flat:
        if up not in ("auto", "z", "-z"):
            raise InputError(f"a file with x and y alone has up z or -z (y runs down), not {up}")
        up = up.replace("auto", "z")
        points = np.concatenate([points, np.zeros_like(points[..., :1])], axis=-1)
    elif up == "auto":
        up, points, notes = _found(points, usual)
    turned = np.stack([sign * points[..., axis] for axis, sign in MAPS[up]], axis=-1)
    if up != "z":
        x, y, _ = (("−" if sign < 0 else "") + "XYZ"[axis] for axis, sign in MAPS[up])
        seen = f"axes turned: floor x is {x}, floor y is {y} of the file"
        notes.append("y reversed, as up -z asks" if flat else seen)
    return FloorPlane(up, turned, tuple(notes))


def strangers(tracks: np.ndarray) -> dict[int, str]:
    """Return the tracks that are not of the robot, and why.

    A marker at another height than most, as on a mast, is the robot's if it keeps this height and its
    distance from another marker of the robot, and does not stand still while that one moves.

    Args:
        tracks: over the floor, shape (frames, tracks, 3), m.
    """
    seen = np.isfinite(tracks[..., 0])
    level = np.quantile(tracks[seen][:, 2], 0.5, method="lower") if seen.any() else 0.0
    heights = [tracks[seen[:, k], k, 2] for k in range(tracks.shape[1])]
    far = [k for k, each in enumerate(heights) if each.size and abs(np.median(each) - level) > _SAME_LEVEL]
    robot = [k for k, each in enumerate(heights) if each.size and k not in far]
    change = {k: _range(heights[k]) for k in far}
    unsure = [k for k in far if change[k] <= _STEADY]
    while joined := [k for k in unsure if any(_together(tracks[:, [k, other], :2]) for other in robot)]:
        robot += joined
        unsure = [k for k in unsure if k not in joined]
    found = {}
    for k in (k for k in far if k not in robot):
        varies = f"its height varies by {1e3 * change[k]:.0f} mm"
        why = varies if change[k] > _STEADY else "does not move with the others"
        found[k] = f"{1e3 * np.median(heights[k]):.0f} mm high, {why}"
    return found


def _range(values: np.ndarray) -> float:
    low, high = np.quantile(values, [0.05, 0.95])
    return float(high - low)


def _together(pair: np.ndarray) -> bool:
    """Say whether the first of two tracks moves as the second does; shape (frames, 2, 2), m."""
    pair = pair[np.isfinite(pair).all(axis=(1, 2))]
    if len(pair) < 2:
        return False
    apart = np.linalg.norm(pair[:, 0] - pair[:, 1], axis=-1)
    own, other = np.linalg.norm(pair - np.median(pair, axis=0), axis=-1).mean(axis=0)
    return bool(_range(apart) <= _VARIES * np.median(apart) + _STEADY / 2 and own >= _MOVES * other)


def _found(points: np.ndarray, usual: str) -> tuple[str, np.ndarray, list[str]]:
    seen = points[np.isfinite(points).all(axis=-1)]
    seen = seen[:: len(seen) // _SAMPLED + 1]
    if len(seen) < 3:
        raise InputError("too few markers to find the floor")
    centre, (spread, axes) = np.median(seen, axis=0), _plane(_displacements(points))
    if not _is_plane(spread):
        spread, axes = _plane(seen - centre)
    axis = int(np.argmax(np.abs(axes[:, 0])))
    if not _is_plane(spread):
        common = "xyz".index(usual)
        across = np.median(np.abs(seen[:, common] - np.median(seen[:, common])))
        if across > 2 * spread[0] + 1e-3:
            raise InputError(
                f"which way is up cannot be told, the markers spread {1e3 * spread[0]:.0f} mm and "
                f"{1e3 * spread[1]:.0f} mm in two directions; give --up x, y or z, or `up` in a map"
            )
        return usual, points, [f"up taken as {usual}, usual for such files: markers do not tell the plane"]
    normal = axes[:, 0] * np.sign(axes[axis, 0])
    tilt = float(np.arccos(min(1.0, normal[axis])))
    if tilt > _STEEPEST:
        raise InputError(
            f"the plane of the markers lies {np.degrees(tilt):.0f}° from all axes; turn the recording, or "
            "give --up x, y or z, or `up` in a map"
        )
    # On the floor's side of the markers lies the origin, where a calibration square lay.
    mean = float(np.median(seen[:, axis]))
    up = ("-" if mean < -1e-3 else "") + "xyz"[axis]
    plane = f"{1e3 * spread[0]:.1f} mm of a plane, {np.degrees(tilt):.1f}° from it"
    notes = [f"up is {up}: markers stay within {plane}"]
    if abs(mean) <= 1e-3:
        notes.append(f"markers lie at height 0: that {up} points up, not down, is assumed")
    # Too few columns to have quantiles: the highest and the lowest.
    ever = np.isfinite(points).any(axis=(0, -1))
    heights = np.nanmedian(points[:, ever] @ normal, axis=0) if points.ndim > 2 else np.zeros(1)
    if tilt > _LEVEL or tilt * np.ptp(heights) > _SHIFT:
        from scipy.spatial.transform import Rotation

        level, _ = Rotation.align_vectors(np.eye(3)[axis], normal)
        points = (points - centre) @ level.as_matrix().T + centre
        notes.append(f"levelled by {np.degrees(tilt):.1f}°")
    return up, points, notes


def _displacements(points: np.ndarray) -> np.ndarray:
    """Return displacements of markers over some spans of time, the larger half, shape (samples, 3), m."""
    lags = {max(1, len(points) // parts) for parts in _PARTS}
    moved = np.concatenate([(points[lag:] - points[:-lag]).reshape(-1, 3) for lag in sorted(lags)])
    moved = moved[np.isfinite(moved).all(axis=1)]
    moved = moved[:: len(moved) // _SAMPLED + 1]
    distance = np.linalg.norm(moved, axis=1)
    # Both ends of a displacement have noise.
    return np.asarray(moved[distance >= np.median(distance)] / np.sqrt(2))


def _is_plane(spread: np.ndarray) -> bool:
    return bool(spread[1] >= _PLAIN * spread[0] + 1e-3)


def _plane(moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return spreads about the origin (ascending) and their directions (columns), without what lies apart."""
    pairs = np.random.default_rng(0).integers(len(moved), size=(2, _NORMALS))
    normals = np.cross(*moved[pairs])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-18)
    away = np.abs(moved[:: len(moved) // 2000 + 1] @ normals.T)
    normal, kept = normals[np.argmin(np.median(away, axis=0))], moved
    for _ in range(4):
        away = np.abs(moved @ normal)
        kept = moved[away <= 5 * np.median(away) + 1e-3]
        values, axes = np.linalg.eigh(kept.T @ kept / len(kept) + 1e-18 * np.eye(3))
        normal = axes[:, 0]
    return np.sqrt(np.maximum(values, 0.0)), axes
