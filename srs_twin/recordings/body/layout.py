"""Layouts of the markers on the robot, and order of the markers along the body.

The layouts are:

- ``single``: one marker per connector.
- ``head``: one marker per connector, and one in front of the head.
- ``pair``: two markers per connector, along or across the body, as on the first and the
  third robot of the dissertation (Sections 2.3.1 and 2.3.2).
- ``middles``: one marker per connector, and one at the middle of each segment.
- ``head_middles``: the markers of ``middles``, and one in front of the head.

The distance between markers on adjacent connectors never exceeds the length of a
straight segment, whereas markers on more distant connectors are sometimes farther
apart. The minimum spanning tree of the maximum distances therefore connects the markers
in their order along the body.
"""

from __future__ import annotations

from contextlib import suppress
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from srs_twin.errors import InputError
from srs_twin.recordings.body.tracking import pairwise_distances, sample_frames
from srs_twin.recordings.signals.units import LENGTHS
from srs_twin.robot.spec import RobotSpec


class LayoutSize(NamedTuple):
    """Number of markers in a layout with N connectors: per_connector · N + extra."""

    per_connector: int
    extra: int


Layout = Literal["single", "head", "pair", "middles", "head_middles"]

LAYOUT_SIZES: dict[str, LayoutSize] = {
    "single": LayoutSize(1, 0),
    "head": LayoutSize(1, 1),
    "pair": LayoutSize(2, 0),
    "middles": LayoutSize(2, -1),
    "head_middles": LayoutSize(2, 0),
}

LAYOUTS = ("auto", *LAYOUT_SIZES)
"""Layout names, including "auto" for a layout that is detected from the markers."""

MIN_COVERAGE = 0.2
"""Minimum fraction of frames in which a robot marker is visible."""
_MAX_NEIGHBOUR_PITCH = 2.0
"""Maximum distance from a robot marker to the nearest marker, in segment lengths."""
_MIN_EXTENT = 0.1
"""Minimum extent of all markers, relative to the length of the straight body."""
_MAX_NEAREST_PITCH = 2.5
"""Maximum distance between the two closest markers, in segment lengths."""
_DISTANCE_FRAMES = 2000
_NEIGHBOUR_FRAMES = 300
_SAME_HEIGHT = 0.05
"""Maximum difference between the height of a robot marker and the median height, m."""
_CONSTANT_HEIGHT = 0.02
"""Maximum variation in the height of a robot marker with an unusual height, m."""
_MAX_DISTANCE_RANGE = 0.5
"""Maximum relative variation of the distance between two markers that move together."""
_MIN_MOTION_RATIO = 0.2
"""Minimum ratio of the mean displacements of two markers that move together."""


def foreign_tracks(tracks: np.ndarray) -> dict[int, str]:
    """Return the tracks that do not belong to the robot, with the reason for each.

    A marker with an unusual but constant height, for example on a mast, belongs to the
    robot if it moves together with another robot marker. `tracks` contains floor
    coordinates in m.
    """
    visible = np.isfinite(tracks[..., 0])
    heights = {
        int(k): tracks[visible[:, k], k, 2] for k in np.flatnonzero(visible.any(axis=0))
    }
    if not heights:
        return {}
    usual = np.quantile(tracks[visible][:, 2], 0.5, method="lower")
    different = [
        k
        for k, height in heights.items()
        if abs(np.median(height) - usual) > _SAME_HEIGHT
    ]
    robot = [k for k in heights if k not in different]
    height_range = {k: _range(heights[k]) for k in different}
    candidates = [k for k in different if height_range[k] <= _CONSTANT_HEIGHT]
    # The search is repeated, because a marker may move together with a newly accepted
    # marker.
    while accepted := [
        k
        for k in candidates
        if any(_move_together(tracks[:, [k, other], :2]) for other in robot)
    ]:
        robot += accepted
        candidates = [k for k in candidates if k not in accepted]
    reasons = {}
    for k in (k for k in different if k not in robot):
        reason = "it does not move with the other markers"
        if height_range[k] > _CONSTANT_HEIGHT:
            reason = f"its height varies by {1e3 * height_range[k]:.0f} mm"
        reasons[k] = f"it is {1e3 * np.median(heights[k]):.0f} mm high, and {reason}"
    return reasons


def _range(values: np.ndarray) -> float:
    low, high = np.quantile(values, [0.05, 0.95])
    return float(high - low)


def _move_together(pair: np.ndarray) -> bool:
    pair = pair[np.isfinite(pair).all(axis=(1, 2))]
    if len(pair) < 2:
        return False
    distance = np.linalg.norm(pair[:, 0] - pair[:, 1], axis=-1)
    motion, other_motion = np.linalg.norm(pair - np.median(pair, axis=0), axis=-1).mean(
        axis=0
    )
    rigid = (
        _range(distance)
        <= _MAX_DISTANCE_RANGE * np.median(distance) + _CONSTANT_HEIGHT / 2
    )
    return bool(rigid and motion >= _MIN_MOTION_RATIO * other_motion)


def robot_markers(
    points: np.ndarray, connectors: int, pitch: float, layout: str, named: int
) -> tuple[list[str], np.ndarray]:
    """Return the possible layouts and the indices of the robot markers.

    Args:
        points: positions of all tracks, m, shape (frames, tracks, 2).
        connectors: number N of connectors.
        pitch: length of a straight segment, m.
        layout: marker layout, one of `LAYOUTS`. With "auto", every layout is possible
            that has as many markers as are visible.
        named: number of columns with a known place on the robot.
    """
    visible = ~np.isnan(points[..., 0])
    coverage = visible.mean(axis=0)
    candidates = np.flatnonzero(coverage >= MIN_COVERAGE)
    if len(candidates) > connectors and not named:
        # A robot marker is close to another marker in most frames in which it is
        # visible.
        limit = _MAX_NEIGHBOUR_PITCH * pitch
        has_neighbour = (
            pairwise_distances(points[:, candidates], _NEIGHBOUR_FRAMES) < limit
        ).any(axis=2)
        sampled = visible[sample_frames(len(points), _NEIGHBOUR_FRAMES)][:, candidates]
        candidates = candidates[has_neighbour.sum(axis=0) > 0.5 * sampled.sum(axis=0)]
    counts = {
        name: size.per_connector * connectors + size.extra
        for name, size in LAYOUT_SIZES.items()
    }
    if named:
        layout = "named"
        counts = {"named": named}
    possible = [layout]
    if layout == "auto":
        # Markers are counted per frame, because a marker that was hidden for a long
        # time may have two tracks.
        visible_count = visible[:, candidates].sum(axis=1)
        count = int(np.quantile(visible_count, 0.95, method="lower"))
        possible = [name for name, required in counts.items() if required == count]
    required = counts[possible[0]] if possible else -1
    if required < 0 or len(candidates) < required:
        raise InputError(_wrong_number(len(candidates), connectors, counts, coverage))
    best = np.argsort(-coverage[candidates], kind="stable")[:required]
    return possible, np.sort(candidates[best])


def _wrong_number(
    candidates: int, connectors: int, counts: dict[str, int], coverage: np.ndarray
) -> str:
    listed = ", ".join(f"{count} ({layout})" for layout, count in counts.items())
    fractions = ", ".join(
        f"{100 * fraction:.0f} %" for fraction in sorted(coverage, reverse=True)[:12]
    )
    return (
        f"{candidates} markers may belong to the robot, but {connectors} connectors"
        f" need {listed}; the markers are visible in {fractions} of the frames. Give"
        " --layout, export the recording without other markers, or give the place of"
        " each marker in a map (--map)"
    )


def body_order(points: np.ndarray) -> np.ndarray:
    """Return the marker indices in order along the body, starting at either end."""
    from scipy.sparse.csgraph import depth_first_order, minimum_spanning_tree

    # A high quantile is used instead of the maximum, because a few frames may be wrong.
    # The offset prevents distances of 0, which a sparse graph would omit.
    tree = minimum_spanning_tree(
        np.quantile(pairwise_distances(points, _DISTANCE_FRAMES), 0.98, axis=0) + 1.0
    )
    neighbours = np.bincount(np.concatenate(tree.nonzero()), minlength=points.shape[1])
    ends = np.flatnonzero(neighbours == 1)
    if len(ends) != 2:
        raise InputError(
            "the markers do not form one line along the body; their connections have"
            f" {len(ends)} ends instead of 2"
        )
    return np.asarray(
        depth_first_order(tree, ends[0], directed=False, return_predecessors=False)
    )


def rigid_pairs(points: np.ndarray, connectors: int) -> np.ndarray:
    """Return marker pairs with a constant mutual distance, shape (connectors, 2)."""
    median, spread = distance_statistics(points)
    score = spread + 0.02 * median
    pairs: list[tuple[int, int]] = []
    free = set(range(points.shape[1]))
    rows, columns = np.triu_indices(len(score), k=1)
    for k in np.argsort(score[rows, columns], kind="stable"):
        a = int(rows[k])
        b = int(columns[k])
        if {a, b} <= free:
            pairs.append((a, b))
            free -= {a, b}
    # The distance between markers of different pairs may be as small and as constant as
    # within a pair. Pairs of successive markers along the body are therefore an
    # alternative.
    with suppress(InputError):
        in_order = [(int(a), int(b)) for a, b in body_order(points).reshape(-1, 2)]
        pairs = min(
            pairs, in_order, key=lambda option: sum(score[a, b] for a, b in option)
        )
    worst = max(spread[a, b] / max(median[a, b], 1e-9) for a, b in pairs)
    if len(pairs) != connectors or worst > 0.2:
        raise InputError(
            f"{connectors} pairs of markers with constant distances are needed, but"
            f" the distance of one pair changes by {100 * worst:.0f} %; check that"
            " each connector has two markers, or give --layout"
        )
    return np.array(pairs)


def distance_statistics(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the medians and standard deviations of the marker distances, m.

    Both results have shape (markers, markers), and are robust to a few wrong frames.
    """
    distance = pairwise_distances(points, _DISTANCE_FRAMES)
    distance[:, np.isnan(distance).all(axis=0)] = np.inf
    with np.errstate(invalid="ignore"):
        low, median, high = np.nanquantile(distance, [0.25, 0.5, 0.75], axis=0)
        # The factor 0.74 converts the interquartile range of normally distributed
        # values to their standard deviation.
        return median, np.nan_to_num(0.74 * (high - low), nan=np.inf)


def check_scale(points: np.ndarray, spec: RobotSpec) -> None:
    """Raise an error if the marker distances do not match the size of the robot."""
    pitch = spec.geometry.pitch
    straight = spec.segments * pitch
    distance = pairwise_distances(points, _DISTANCE_FRAMES)
    distance = distance[np.isfinite(distance).any(axis=(1, 2))]
    if not len(distance):
        raise InputError(
            "no frame has two visible markers, but the robot needs at least"
            f" {spec.segments + 1}"
        )
    nearest, farthest = (
        np.median(extreme(distance, axis=(1, 2))) for extreme in (np.nanmin, np.nanmax)
    )
    if nearest > _MAX_NEAREST_PITCH * pitch or farthest < _MIN_EXTENT * straight:
        raise InputError(
            f"the markers are {1e3 * nearest:.4g} to {1e3 * farthest:.4g} mm apart, but"
            f" the connectors of {spec.name} are {1e3 * pitch:.4g} mm"
            f" apart{unit_hint(float(farthest / straight))}"
        )


def unit_hint(ratio: float) -> str:
    """Return a hint on the unit, based on the ratio of measured to expected lengths."""
    for unit, factor in LENGTHS.items():
        for correction, preposition in ((factor, "in"), (1 / factor, "not in")):
            if factor != 1 and 0.7 < ratio * correction < 1.1:
                return (
                    "; check the unit, because the lengths seem to be"
                    f" {preposition} {unit}"
                )
    return "; check that the recording belongs to this robot"


def forward_distance(period: float, points: np.ndarray) -> float:
    """Return the distance that the body travelled towards the first marker, m.

    The result is negative if the body moves towards the last marker. `period` is the
    frame period (s), and `points` contains the marker positions along the body (m).
    """
    stride = max(1, round(0.25 / period))
    sampled = points[::stride] if len(points) > stride else points[[0, -1]]
    centre = sampled.mean(axis=1)
    axis = sampled[:, 0] - sampled[:, -1]
    axis = axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-9)
    return float(
        sum(
            ((b - a) * (u + v) / 2).sum()
            for (a, u), (b, v) in pairwise(zip(centre, axis, strict=True))
        )
    )
