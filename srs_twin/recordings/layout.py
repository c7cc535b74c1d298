"""Which markers are the robot's, and which of them is where on it.

Layouts: ``single``, one marker at each connector; ``head``, one more ahead of the head's, so that its heading
is measured; ``pair``, two at each connector, along or across the body, as the dissertation's first and third
robots had them (Sections 2.3.1 and 2.3.2); ``middles``, one at each connector and one at the middle of each
segment; ``head_middles``, these and one more ahead of the head's.

Neighbours along the body are never farther apart than a straight segment is long, others sometimes are: the
tree that joins all markers over the least of their largest distances is the body. Markers of one rigid part
keep their distance.

Errors raised here do not name the file; `read_motion` puts its name before them.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from srs_twin.errors import InputError
from srs_twin.recordings.csv_table import LENGTHS
from srs_twin.recordings.tracking import distances, some_frames

LAYOUTS = ("auto", "single", "head", "pair", "middles", "head_middles")

Places = dict[int, tuple[int, str]]
"""Marker → its station (0, 2, … the connectors, head first; 1, 3, … the segments' middles) and side."""

_SOLID = 0.2  # of the frames a marker of the robot is seen on, or more
_APART = 2.0  # times the length of a segment: farther from all others nothing is on the robot
_TINY = 0.1  # of the body's length: no body curls up so far
_FAR = 2.5  # times a segment's length: farther apart no two neighbours are
_SAMPLED = 2000  # frames that distances are taken from
_NEAR_SAMPLED = 300


def robot_markers(
    points: np.ndarray, connectors: int, pitch: float, layout: str, named: int
) -> tuple[list[str], np.ndarray]:
    """Choose the robot's markers.

    Args:
        points: of all tracks, shape (frames, tracks, 2), m.
        connectors: N.
        pitch: length of a straight segment, m.
        layout: one of `LAYOUTS`; "auto" takes the one that has as many markers as are there.
        named: how many columns have a place on the robot by their names; 0: none.

    Returns:
        The layouts that it may be ("named" for those), and which tracks the robot's markers are.

    Raises:
        InputError: too few or too many markers.
    """
    seen = ~np.isnan(points[..., 0])
    share = seen.mean(axis=0)
    solid = np.flatnonzero(share >= _SOLID)
    if len(solid) > connectors and not named:
        # Only those that have another one near on most frames they are seen on.
        near = (distances(points[:, solid], _NEAR_SAMPLED) < _APART * pitch).any(axis=2)
        there = seen[some_frames(len(points), _NEAR_SAMPLED)][:, solid]
        solid = solid[near.sum(axis=0) > 0.5 * there.sum(axis=0)]
    layouts = {
        "single": connectors, "head": connectors + 1, "pair": 2 * connectors,
        "middles": 2 * connectors - 1, "head_middles": 2 * connectors,
    }  # fmt: skip
    if named:
        layout, layouts = "named", {"named": named}
    fitting = [layout]
    if layout == "auto":
        # At once: a marker that was lost for long may have become two tracks.
        together = int(np.quantile(seen[:, solid].sum(axis=1), 0.95, method="lower")) if solid.size else 0
        fitting = [each for each, count in layouts.items() if count == together]
    wanted = layouts[fitting[0]] if fitting else -1
    if wanted < 0 or len(solid) < wanted:
        listed = ", ".join(f"{count} ({each})" for each, count in layouts.items())
        shares = ", ".join(f"{100 * each:.0f} %" for each in sorted(share, reverse=True)[:12])
        raise InputError(
            f"{len(solid)} markers that could be the robot's; {connectors} connectors carry {listed}. "
            f"Seen on these shares of the frames: {shares}. Give layout, export without others, or say in "
            "a map where each is (--map)"
        )
    return fitting, np.sort(solid[np.argsort(-share[solid], kind="stable")[:wanted]])


def body_order(points: np.ndarray) -> np.ndarray:
    """Return markers in their order along the body, from one of its ends.

    Args:
        points: shape (frames, markers, 2), m.

    Raises:
        InputError: they do not lie along one line.
    """
    from scipy.sparse.csgraph import depth_first_order, minimum_spanning_tree

    # The largest but on a few frames. To a sparse graph 0 would be no edge.
    tree = minimum_spanning_tree(np.quantile(distances(points, _SAMPLED), 0.98, axis=0) + 1.0)
    neighbours = np.bincount(np.concatenate(tree.nonzero()), minlength=points.shape[1])
    ends = np.flatnonzero(neighbours == 1)
    if len(ends) != 2:
        raise InputError(f"the markers do not lie along one body: {len(ends)} of them are at an end")
    return np.asarray(depth_first_order(tree, ends[0], directed=False, return_predecessors=False))


def rigid_pairs(points: np.ndarray, connectors: int) -> np.ndarray:
    """Return which markers form pairs of constant distance, shape (connectors, 2).

    Raises:
        InputError: no such pairs.
    """
    mean, spread = _median_and_spread(points)
    score = spread + 0.02 * mean
    pairs: list[tuple[int, int]] = []
    free = set(range(points.shape[1]))
    rows, columns = np.triu_indices(len(score), k=1)
    for k in np.argsort(score[rows, columns], kind="stable"):
        a, b = int(rows[k]), int(columns[k])
        if {a, b} <= free:
            pairs.append((a, b))
            free -= {a, b}
    worst = max(spread[a, b] / max(mean[a, b], 1e-9) for a, b in pairs)
    if len(pairs) != connectors or worst > 0.2:
        raise InputError(
            f"no {connectors} pairs of markers keep their distance (one changes by {100 * worst:.0f} %); "
            "are there two at each connector? Give layout"
        )
    return np.array(pairs)


def _median_and_spread(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return medians and spreads of the distances; a few frames that are wrong do not count."""
    apart = distances(points, _SAMPLED)
    # Of a marker from itself, or of two that were never seen at once.
    apart[:, np.isnan(apart).all(axis=0)] = np.inf
    with np.errstate(invalid="ignore"):
        low, middle, high = np.nanquantile(apart, [0.25, 0.5, 0.75], axis=0)
        return middle, np.nan_to_num(0.74 * (high - low), nan=np.inf)


def check_scale(points: np.ndarray, pitch: float, segments: int, robot: str) -> None:
    """Refuse markers that are as far from each other as those of no such robot, before any is followed.

    Args:
        points: in slots, shape (frames, slots, 2), m.
        pitch: length of a straight segment, m.
        segments: how many there are.
        robot: its name.

    Raises:
        InputError: the nearest two are farther apart than neighbours can be, or all of them hardly apart.
    """
    apart = distances(points, _SAMPLED).reshape(min(len(points), _SAMPLED), -1)
    apart = apart[np.isfinite(apart).sum(axis=1) >= 2]
    if not len(apart):
        raise InputError(f"never two markers at once; {segments + 1} or more are wanted")
    nearest, farthest = np.median(np.nanmin(apart, axis=1)), np.median(np.nanmax(apart, axis=1))
    if nearest > _FAR * pitch or farthest < _TINY * segments * pitch:
        raise InputError(
            f"markers lie {1e3 * nearest:.4g} to {1e3 * farthest:.4g} mm apart, the connectors of {robot} "
            f"{1e3 * pitch:.4g} mm{unit_hint(float(farthest / (segments * pitch)))}"
        )


def unit_hint(ratio: float) -> str:
    """Return which unit may have been meant where lengths are `ratio` times what they should be."""
    for unit, factor in LENGTHS.items():
        for given, direction in ((factor, "in"), (1 / factor, "not in")):
            if factor != 1 and 0.7 < ratio * given < 1.1:
                return f"; were lengths {direction} {unit}?"
    return "; is it this robot?"


def forward_distance(period: float, points: np.ndarray) -> float:
    """Return how far markers moved towards the first of them, m; below 0 away from it.

    Args:
        period: of the frames, s.
        points: in order along the body, shape (frames, N, 2), m.
    """
    stride = max(1, round(0.25 / period))
    some = points[::stride] if len(points) > stride else points[[0, -1]]
    centre, along = some.mean(axis=1), some[:, 0] - some[:, -1]
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    return float(
        sum(((b - a) * (u + v) / 2).sum() for (a, u), (b, v) in pairwise(zip(centre, along, strict=True)))
    )
