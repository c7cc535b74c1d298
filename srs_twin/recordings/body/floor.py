"""Floor: which way is up in a recording, and the map from its axes to the floor plane.

Markers on a crawling snake stay in a plane; its normal is the axis closest to the direction in which they
spread least, found without what lies apart. Each map is a rotation, so left stays left:

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
_PLAIN = 3.0  # how many times further markers spread in the plane than out of it, where that tells the plane
_LEVEL = np.radians(3.0)  # beyond this the recording is levelled
_STEEPEST = np.radians(30.0)


@dataclass(frozen=True)
class FloorPlane:
    """Markers over the floor.

    Attributes:
        up: the axis of the file that points up.
        plane: shape (frames, columns, 2), m.
        height: above the file's origin, shape (frames, columns), m; zeros where the file has none.
        corrections: what was found and done, in words.
    """

    up: str
    plane: np.ndarray
    height: np.ndarray
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
        up, points = (
            up.replace("auto", "z"),
            np.concatenate([points, np.zeros_like(points[..., :1])], axis=-1),
        )
    elif up == "auto":
        up, points, notes = _found(points, usual)
    turned = np.stack([sign * points[..., axis] for axis, sign in MAPS[up]], axis=-1)
    if up != "z":
        x, y, _ = (("−" if sign < 0 else "") + "XYZ"[axis] for axis, sign in MAPS[up])
        seen = f"axes turned: floor x is {x}, floor y is {y} of the file"
        notes.append("y reversed, as up -z asks" if flat else seen)
    return FloorPlane(up, turned[..., :2], turned[..., 2], tuple(notes))


def _found(points: np.ndarray, usual: str) -> tuple[str, np.ndarray, list[str]]:
    seen = points[np.isfinite(points).all(axis=-1)]
    seen = seen[:: len(seen) // _SAMPLED + 1]
    if len(seen) < 3:
        raise InputError("too few markers to find the floor")
    centre, spread, axes = _plane(seen)
    axis = int(np.argmax(np.abs(axes[:, 0])))
    if spread[1] < _PLAIN * spread[0] + 1e-3:
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
    if tilt > _LEVEL:
        points = (points - centre) @ _turn(normal, axis).T + centre
        notes.append(f"levelled by {np.degrees(tilt):.1f}°")
    return up, points, notes


def _plane(seen: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centre, spreads (ascending) and their directions (columns), without points that lie apart."""
    kept = seen
    for _ in range(4):
        centre = np.median(kept, axis=0)
        values, axes = np.linalg.eigh(np.cov((kept - centre).T) + 1e-18 * np.eye(3))
        far = np.abs((seen - centre) @ axes)
        middle = np.median(far, axis=0)
        inside = (far <= 8 * middle + 1e-3).all(axis=1)
        if inside.sum() < 3:
            break
        kept = seen[inside]
    return centre, np.sqrt(np.maximum(values, 0.0)), axes


def _turn(normal: np.ndarray, axis: int) -> np.ndarray:
    """Return the smallest rotation that turns a normal onto an axis, shape (3, 3)."""
    target = np.eye(3)[axis]
    v, c = np.cross(normal, target), float(normal @ target)
    k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + k + k @ k / (1 + c)
