"""Synthetic recordings: a trajectory as a motion capture system exports it.

Used by tests of the reader and by worked examples, where the true motion is known.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import simpson

from srs_twin.errors import check_choice
from srs_twin.io.files import atomic_write
from srs_twin.recordings.body.floor import MAPS
from srs_twin.recordings.body.layout import LAYOUTS
from srs_twin.recordings.signals.units import LENGTHS
from srs_twin.trajectory import Trajectory

MOTIVE_LENGTHS = {
    "Meters": "m",
    "Centimeters": "cm",
    "Millimeters": "mm",
    "Inches": "in",
    "Feet": "ft",
}
"""Words after 'Length Units' in a Motive export."""


@dataclass(frozen=True)
class Take:
    """Settings of a recording and its export.

    Attributes:
        layout: one of `LAYOUTS` except "auto".
        apart: distance between the markers of a pair, and between the two markers of
            the head, m.
        across: whether pairs are placed across the body instead of along it.
        height: height of the markers above the floor, m.
        noise: standard deviation of each coordinate, m.
        rate_hz: frames per second; None: the samples of the trajectory.
        swaps: number of permanent swaps of two columns.
        lost: fraction of positions that are lost in short gaps.
        gap_frames: mean length of these gaps, frames.
        occluded: (marker from 0, start in s, end in s) of a hidden marker.
        spikes: number of outliers.
        fragments: whether a lost marker reappears in a new column, as in Motive.
        labeled: whether columns are named after connectors; otherwise they are
            unlabeled and in any order.
        unit: length unit, one that Motive exports.
        up: vertical axis, one of `floor.MAPS`.
        digits: number of decimals.
        seed: random seed.
    """

    layout: str = "single"
    apart: float = 0.02
    across: bool = False
    height: float = 0.03
    noise: float = 2e-4
    rate_hz: float | None = None
    swaps: int = 0
    lost: float = 0.0
    gap_frames: float = 4.0
    occluded: Sequence[tuple[int, float, float]] = ()
    spikes: int = 0
    fragments: bool = False
    labeled: bool = False
    unit: str = "mm"
    up: str = "y"
    digits: int = 6
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value, allowed in (
            ("layout", self.layout, LAYOUTS[1:]),
            ("unit", self.unit, tuple(MOTIVE_LENGTHS.values())),
            ("up", self.up, tuple(MAPS)),
        ):
            check_choice(name, value, allowed)


def markers(trajectory: Trajectory, take: Take) -> np.ndarray:
    """Return the noise-free marker positions of a layout, shape (samples, markers, 2), m."""
    position = trajectory.position
    theta = trajectory.stack("connector_heading")
    along = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    if "middles" in take.layout:
        middle = middles(trajectory)
        both = np.empty((len(position), 2 * position.shape[1] - 1, 2))
        both[:, ::2] = position
        both[:, 1::2] = middle
        position = both
    if "head" in take.layout:
        return np.concatenate(
            [position[:, :1] + take.apart * along[:, :1], position], axis=1
        )
    if take.layout != "pair":
        return position
    if take.across:
        along = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    pairs = np.stack(
        [position + take.apart / 2 * along, position - take.apart / 2 * along], axis=2
    )
    return pairs.reshape(len(position), -1, 2)


def _arcs(
    theta: np.ndarray, bend: np.ndarray, length: np.ndarray, upto: float
) -> np.ndarray:
    """Return the displacement backward along arcs from their front ends (Simpson's rule), complex, m."""
    s = np.linspace(0.0, upto, 65)
    tangent = np.exp(1j * (theta[..., None] - bend[..., None] * s))
    return np.asarray(length * simpson(tangent, x=s, axis=-1))


def lengths(trajectory: Trajectory) -> np.ndarray:
    """Return the lengths of the arcs, shape (samples, segments), m."""
    if "length_1" in trajectory.columns:
        return trajectory.stack("length")
    return np.full(
        trajectory.stack("bend").shape, float(trajectory.metadata["segment_length_m"])
    )


def middles(trajectory: Trajectory) -> np.ndarray:
    """Return the middles of the segments, shape (samples, segments, 2), m."""
    theta = trajectory.stack("connector_heading")[:, :-1]
    gap = float(trajectory.metadata["rigid_gap_m"]) / 2
    front = trajectory.position[:, :-1] @ [1, 1j] - gap * np.exp(1j * theta)
    place = front - _arcs(theta, trajectory.stack("bend"), lengths(trajectory), 0.5)
    return np.stack([place.real, place.imag], axis=-1)


def stretched(
    trajectory: Trajectory, fraction: float, power: float = 1.0
) -> Trajectory:
    """Return a motion whose segments lengthen with their bend.

    Args:
        trajectory: trajectory of a plant.
        fraction: relative elongation of the most bent segment.
        power: exponent of the bend.
    """
    bend = trajectory.stack("bend")
    theta = trajectory.stack("connector_heading")
    gap = float(trajectory.metadata["rigid_gap_m"]) / 2
    length = lengths(trajectory) * (
        1 + fraction * (np.abs(bend) / np.abs(bend).max()) ** power
    )
    facing = gap * np.exp(1j * theta)
    step = facing[:, :-1] + _arcs(theta[:, :-1], bend, length, 1.0) + facing[:, 1:]
    place = (trajectory.position[:, 0] @ [1, 1j])[:, None] - np.cumsum(step, axis=1)
    columns = dict(trajectory.columns)
    for j in range(bend.shape[1]):
        columns |= {f"x_{j + 2}": place[:, j].real, f"y_{j + 2}": place[:, j].imag}
        columns[f"length_{j + 1}"] = length[:, j]
    return replace(trajectory, columns=columns)


def motive_csv(trajectory: Trajectory, take: Take) -> str:
    """Return a Motive CSV export, format 1.21, of a motion.

    Raises:
        InputError: a setting of the recording is unknown.
    """
    random = np.random.default_rng(take.seed)
    time, plane = _captured(trajectory, take)
    seen = plane + take.noise * random.standard_normal(plane.shape)
    for _ in range(take.spikes):
        seen[random.integers(len(seen)), random.integers(seen.shape[1])] += (
            random.uniform(-0.2, 0.2, 2)
        )
    hidden = _hidden(time, seen.shape[1], take, random)
    seen[hidden] = np.nan
    height = take.height + take.noise * random.standard_normal(seen.shape[:2])
    columns, names = _columns(
        np.concatenate([seen, height[..., None]], axis=-1), hidden, take, random
    )
    return _text(time, columns, names, take)


def write_motive(
    trajectory: Trajectory, take: Take, path: str | os.PathLike[str]
) -> None:
    """Write `motive_csv` to a file atomically.

    Raises:
        InputError: as `motive_csv`, or the file cannot be written.
    """
    text = motive_csv(trajectory, take)
    with atomic_write(path) as part:
        part.write_text(text, encoding="utf-8", newline="")


def _captured(trajectory: Trajectory, take: Take) -> tuple[np.ndarray, np.ndarray]:
    """Return frame times from 0 and the markers at them."""
    time = trajectory.time - trajectory.time[0]
    plane = markers(trajectory, take)
    if take.rate_hz is None:
        return time, plane
    from scipy.interpolate import CubicSpline

    frames = np.arange(int(time[-1] * take.rate_hz + 1e-9) + 1) / take.rate_hz
    return frames, CubicSpline(time, plane)(frames)


def _hidden(
    time: np.ndarray, count: int, take: Take, random: np.random.Generator
) -> np.ndarray:
    """Return when each marker is hidden, shape (frames, markers)."""
    hidden = np.zeros((len(time), count), dtype=bool)
    wanted = take.lost * hidden.size
    while hidden.sum() < wanted:
        start = random.integers(1, len(time))
        marker = random.integers(count)
        hidden[start : start + random.geometric(1 / take.gap_frames), marker] = True
    for which, begin, end in take.occluded:
        hidden[(time >= begin) & (time < end), which] = True
    return hidden


def _columns(
    points: np.ndarray, hidden: np.ndarray, take: Take, random: np.random.Generator
) -> tuple[np.ndarray, list[str]]:
    """Return the markers in the columns of the file, and their names."""
    frames, count = points.shape[:2]
    if take.labeled:
        return points, _labels(take.layout, count)
    if take.fragments:
        points = _fragmented(points, hidden)
        count = points.shape[1]
        return points, [f"Unlabeled {1000 + k}" for k in range(count)]
    order = random.permutation(count)
    place = np.broadcast_to(order, (frames, count)).copy()
    swaps: list[int] = sorted(random.integers(1, frames, take.swaps).tolist())
    for swap in swaps:
        a, b = random.choice(count, 2, replace=False)
        place[swap:, [a, b]] = place[swap:, [b, a]]
    return np.take_along_axis(points, place[..., None], axis=1), [
        f"Unlabeled {1000 + k}" for k in range(count)
    ]


def _labels(layout: str, count: int) -> list[str]:
    if layout == "pair":
        return [f"snake:{k // 2 + 1}{'ab'[k % 2]}" for k in range(count)]
    ahead = ["snake:ahead"] if "head" in layout else []
    return ahead + [f"snake:{k}" for k in range(1, count + 1 - len(ahead))]


def _fragmented(points: np.ndarray, hidden: np.ndarray) -> np.ndarray:
    """Return a column for each appearance of a marker, in the order in which they appear."""
    pieces = []
    for marker in range(points.shape[1]):
        edges = np.flatnonzero(
            np.diff(np.concatenate([[True], hidden[:, marker], [True]]).astype(np.int8))
        )
        pieces += [
            (int(begin), int(end), marker) for begin, end in edges.reshape(-1, 2)
        ]
    columns = np.full((len(points), len(pieces), 3), np.nan)
    for k, (begin, end, marker) in enumerate(sorted(pieces)):
        columns[begin:end, k] = points[begin:end, marker]
    return columns


def _text(time: np.ndarray, columns: np.ndarray, names: list[str], take: Take) -> str:
    count = columns.shape[1]
    filed = np.empty_like(columns)
    for k, (axis, sign) in enumerate(MAPS[take.up]):
        filed[..., axis] = sign * columns[..., k] / LENGTHS[take.unit]
    unseen = np.isnan(filed).any(axis=-1)
    cells = np.char.mod(f"%.{take.digits}f", filed)
    cells[unseen] = ""
    word = next(
        word for word, unit in MOTIVE_LENGTHS.items() if unit == take.unit
    ).capitalize()
    rate = 1 / float(np.median(np.diff(time)))
    header = [
        (
            f"Format Version,1.21,Take Name,synthetic {take.seed},Capture Frame"
            f" Rate,{rate:.6f},Export Frame Rate,{rate:.6f},Capture Start Time,,Total"
            f" Frames in Take,{len(time)},Total Exported Frames,{len(time)},Rotation"
            f" Type,Quaternion,Length Units,{word},Coordinate Space,Global"
        ),
        "",
        ",Type" + ",Marker" * (3 * count),
        ",Name," + ",".join(name for name in names for _ in range(3)),
        ",ID," + ",".join(f"{4096 + k:X}" for k in range(count) for _ in range(3)),
        "," + ",Position" * (3 * count),
        "Frame,Time (Seconds)" + ",X,Y,Z" * count,
    ]
    rows = [
        f"{k},{t:.6f}," + ",".join(row)
        for k, (t, row) in enumerate(
            zip(time, cells.reshape(len(time), -1).tolist(), strict=True)
        )
    ]
    return "\r\n".join([*header, *rows, ""])
