r"""Tracking of markers across column swaps and gaps.

1. *Slots*: Some formats store a reappearing marker in a new column. Columns whose time
   spans do not overlap are therefore combined into one slot.
2. *Tracklets*: A tracklet is a part of a slot in which all samples certainly belong to
   one marker. The expected position of a marker in frame k is

   $$ \hat p_k = p_a + (k - a)(p_a - p_{a-1}), $$

   where a is the last frame in which the marker was seen. A sample in the next frame
   certainly belongs to the tracklet if its distance from the expected position is below
   a threshold called the gate. In addition, all other samples must be at least twice as
   far away from this position.
3. *Tracks*: Tracklets that begin in a frame are assigned to the markers that were lost
   before this frame. The Hungarian method minimises the sum of the distances from the
   expected positions. After a gap of a few frames, the expected position is
   extrapolated with the velocity of the marker. After a longer gap, two positions are
   considered: the last position of the marker, and this position moved together with
   the surrounding markers. The position closer to the new tracklet is used.

Of 65 synthetic recordings with swaps, gaps and reappearing markers, 16 can be read
without tracking and all 65 with tracking.
"""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError

MAX_MARKERS = 64
"""Maximum number of markers and reflections in one frame."""

GATE_RATIO = 0.4
"""Gate of a tracklet, relative to the distance between the closest markers."""

_DISTANCE_FRAMES = 500
_MIN_SAMPLES = 3
"""Minimum number of samples in a track that is not treated as a reflection."""
_MAX_SHORT = 0.03
"""Maximum fraction of samples in short tracklets if these are reflections.

A larger fraction is probably due to fast markers.
"""
_VELOCITY_FRAMES = 4
"""Maximum number of frames over which a marker is assumed to keep its velocity."""
_MAX_REACH_RATIO = 6.0
"""Maximum ratio of the reach after a long gap to the reach after a short gap."""
_PAST_SAMPLES = 100
_RANGE_COST = 3.0
"""Weight of deviations from past distance ranges in the assignment cost."""
_FORBIDDEN_COST = 1e6
"""Cost of an assignment that exceeds the maximum distance, m."""


class Tracks(NamedTuple):
    """Marker positions sorted by track, or by slot before tracking.

    Attributes:
        points: marker positions, m, shape (frames, tracks, 2 or 3). The position of a
            hidden marker is NaN.
        columns: file column of each sample, or −1 for a hidden marker, shape (frames,
            tracks).
        unassigned: number of samples that do not belong to any track.
    """

    points: np.ndarray
    columns: np.ndarray
    unassigned: int


def pack_slots(points: np.ndarray) -> Tracks:
    """Combine columns into the smallest possible number of slots."""
    visible = ~np.isnan(points[..., 0])
    used = np.flatnonzero(visible.any(axis=0))
    if not used.size:
        raise InputError("no marker is visible in any frame")
    first = visible[:, used].argmax(axis=0)
    last = len(visible) - 1 - visible[::-1, used].argmax(axis=0)
    # Each heap entry contains the last frame of a slot and the slot index. The slot
    # that has been free for the longest time is reused first.
    ends: list[tuple[int, int]] = []
    slot_of = np.empty(len(used), dtype=int)
    for k in np.lexsort((used, first)):
        if ends and ends[0][0] < first[k]:
            _, slot = heapq.heappop(ends)
        else:
            slot = len(ends)
        slot_of[k] = slot
        heapq.heappush(ends, (int(last[k]), slot))
    slots = np.full((len(points), len(ends), points.shape[-1]), np.nan)
    columns = np.full((len(points), len(ends)), -1)
    for k, slot in enumerate(slot_of):
        frames = slice(first[k], last[k] + 1)
        slots[frames, slot] = points[frames, used[k]]
        columns[frames, slot] = used[k]
    return Tracks(slots, columns, 0)


def sample_frames(count: int, limit: int) -> np.ndarray:
    """Return the indices of all frames, or of a sample of at most `limit` frames.

    The sample is stratified and random, because equally spaced frames could alias with
    a periodic gait.
    """
    if count <= limit:
        return np.arange(count)
    edges = np.linspace(0, count, limit + 1)
    return np.unique(
        (edges[:-1] + np.random.default_rng(0).random(limit) * np.diff(edges)).astype(
            int
        )
    )


def pairwise_distances(points: np.ndarray, frames: int) -> np.ndarray:
    """Return all pairwise distances in a sample of at most `frames` frames, m.

    The result has shape (frames, points, points). Distances to hidden points and from a
    point to itself are NaN.
    """
    sampled = points[sample_frames(len(points), frames)]
    distance = np.asarray(
        np.linalg.norm(sampled[:, :, None] - sampled[:, None], axis=-1)
    )
    distance[:, np.arange(distance.shape[1]), np.arange(distance.shape[1])] = np.nan
    return distance


def _certain_links(points: np.ndarray, gate: float) -> np.ndarray:
    step = np.diff(points, axis=0, prepend=np.nan)
    # After a jump the velocity is unknown, so the position is not extrapolated.
    step[np.isnan(step).any(axis=-1) | (np.linalg.norm(step, axis=-1) > 2 * gate)] = 0.0
    expected = np.full_like(points, np.nan)
    expected[1:] = points[:-1] + step[:-1]
    error = np.linalg.norm(points - expected, axis=-1)
    nearest = np.full_like(error, np.inf)
    for shift in range(1, points.shape[1]):
        other = np.linalg.norm(np.roll(points, shift, axis=1) - expected, axis=-1)
        np.fmin(nearest, other, out=nearest)
    return np.asarray((error < gate) & (2 * error < nearest))


def track_markers(
    points: np.ndarray, columns: np.ndarray, longest: int, reach: float
) -> Tracks:
    """Track markers over all frames.

    `longest` is the maximum length of a gap that is interpolated, in frames. `reach` is
    the maximum distance of a marker from its expected position, m.
    """
    distance = pairwise_distances(points, _DISTANCE_FRAMES)
    nearest = np.where(np.isnan(distance), np.inf, distance).min(axis=(1, 2))
    nearest = nearest[np.isfinite(nearest)]
    # A low quantile is used instead of the minimum, because a few frames may contain
    # reflections close to markers.
    if nearest.size:
        gate = min(GATE_RATIO * float(np.quantile(nearest, 0.05)), reach)
    else:
        gate = reach
    visible = np.isfinite(points[..., 0])
    certain = _certain_links(points, gate)
    ends = visible & ~np.append(certain[1:], np.zeros_like(certain[:1]), axis=0)
    slot, first = np.nonzero((visible & ~certain).T)
    last = np.nonzero(ends.T)[1]
    tracker = _Tracker(points, gate, longest, reach)
    order = np.argsort(first, kind="stable")
    length = last - first + 1
    if length[length < _MIN_SAMPLES].sum() < _MAX_SHORT * visible.sum():
        tracker.shortest = _MIN_SAMPLES
    for group in np.split(order, np.flatnonzero(np.diff(first[order])) + 1):
        tracker.assign(int(first[group[0]]), slot[group], last[group])
    slots = tracker.slots[:, tracker.samples >= _MIN_SAMPLES].astype(int)
    if not slots.shape[1]:
        slots = np.full((len(points), 1), -1)
    hidden = slots < 0
    index = np.maximum(slots, 0)
    tracks = np.where(
        hidden[..., None], np.nan, np.take_along_axis(points, index[..., None], axis=1)
    )
    origin = np.where(hidden, -1, np.take_along_axis(columns, index, axis=1))
    return Tracks(tracks, origin, int(visible.sum() - (~hidden).sum()))


class _Tracker:
    """State of all tracks up to the current frame.

    Attributes:
        slots: slot of each track, or −1 for a hidden marker, shape (frames,
            `MAX_MARKERS`).
        samples: number of samples in each track, 0 for an unused track, shape
            (`MAX_MARKERS`,).
        shortest: minimum number of samples in a tracklet that begins a new track.
    """

    def __init__(
        self, points: np.ndarray, gate: float, longest: int, reach: float
    ) -> None:
        self._points = points
        self._gate = gate
        self._longest = longest
        self._reach = reach
        self.slots = np.full((len(points), MAX_MARKERS), -1, dtype=np.int8)
        self.samples = np.zeros(MAX_MARKERS, dtype=int)
        self.shortest = 1
        self._end = np.full(MAX_MARKERS, -1)
        self._last, self._velocity = np.zeros((2, MAX_MARKERS, points.shape[-1]))

    def assign(self, first: int, slots: np.ndarray, last: np.ndarray) -> None:
        from scipy.optimize import linear_sum_assignment

        reflections = (self._end < first - _VELOCITY_FRAMES) & (
            self.samples < _MIN_SAMPLES
        )
        self.slots[:, reflections & (self.samples > 0)] = -1
        self.samples[reflections] = 0
        # Tracklets close to an expected position are assigned first, because their
        # distances help to identify the remaining tracklets.
        for reach, longest in ((self._gate, _VELOCITY_FRAMES), (self._reach, first)):
            free = np.flatnonzero(
                (self._end < first)
                & (self._end >= first - longest)
                & (self.samples > 0)
            )
            cost = self._costs(free, first, self._points[first, slots], reach)
            rows, indices = linear_sum_assignment(cost)
            allowed = cost[rows, indices] < _FORBIDDEN_COST
            for row, track in zip(rows[allowed], free[indices[allowed]], strict=True):
                self._extend(int(track), int(slots[row]), first, int(last[row]))
            remaining = np.setdiff1d(
                np.flatnonzero(last - first >= self.shortest - 1), rows[allowed]
            )
            slots = slots[remaining]
            last = last[remaining]
        unused = np.flatnonzero(self.samples == 0)
        if len(slots) > len(unused):
            raise InputError(
                f"the markers jump between frames and need more than {MAX_MARKERS}"
                " tracks; check the units of lengths and times"
            )
        for track, slot, end in zip(
            unused.tolist(), slots.tolist(), last.tolist(), strict=False
        ):
            self._extend(track, slot, first, end)

    def _extend(self, track: int, slot: int, first: int, last: int) -> None:
        if last > first:
            before = self._points[last - 1, slot]
        else:
            before = self._last[track]
        continuous = last > first or (
            self.samples[track] > 0 and self._end[track] == first - 1
        )
        step = self._points[last, slot] - before
        if continuous and np.linalg.norm(step) < 2 * self._gate:
            self._velocity[track] = step
        else:
            self._velocity[track] = 0.0
        self._last[track] = self._points[last, slot]
        self._end[track] = last
        self.slots[first : last + 1, track] = slot
        self.samples[track] += last + 1 - first

    def _costs(
        self, tracks: np.ndarray, frame: int, starts: np.ndarray, near: float
    ) -> np.ndarray:
        """Return the cost of each assignment, m, shape (tracklets, tracks).

        The maximum distance of an assignment grows with the gap, up to a factor of
        `_MAX_REACH_RATIO`.
        """
        gap = frame - self._end[tracks]
        moved = (
            np.where(gap <= _VELOCITY_FRAMES, gap, 0)[:, None] * self._velocity[tracks]
        )
        distance = np.linalg.norm(
            starts[:, None] - (self._last[tracks] + moved), axis=-1
        )
        violation = np.zeros_like(distance)
        for k in np.flatnonzero((gap > 1) | (near > self._gate)):
            end = self._end[tracks[k]]
            others = np.flatnonzero((self.slots[[end, frame]] >= 0).all(axis=0))
            if gap[k] > _VELOCITY_FRAMES and len(others) >= 2:
                positions = (
                    self._points[at, self.slots[at, others]] for at in (end, frame)
                )
                moved_with_others = _move_rigidly(self._last[tracks[k]], *positions)
                distance[:, k] = np.fmin(
                    distance[:, k], np.linalg.norm(starts - moved_with_others, axis=-1)
                )
            violation[:, k] = self._range_violation(tracks[k], frame, starts)
        reach = near * np.minimum(_MAX_REACH_RATIO, 1.0 + (gap - 1) / self._longest)
        return np.asarray(
            np.where(
                distance > reach, _FORBIDDEN_COST, distance + _RANGE_COST * violation
            )
        )

    def _range_violation(
        self, track: int, frame: int, starts: np.ndarray
    ) -> np.ndarray:
        others = np.flatnonzero(self.slots[frame] >= 0)
        past = np.flatnonzero(self.slots[: self._end[track] + 1, track] >= 0)
        past = past[:: len(past) // _PAST_SAMPLES + 1][:, None]
        slots = self.slots[past, others]
        positions = np.where((slots >= 0)[..., None], self._points[past, slots], np.nan)
        distance = np.linalg.norm(
            positions - self._points[past, self.slots[past, track]], axis=-1
        )
        smallest = np.fmin.reduce(distance)
        largest = np.fmax.reduce(distance)
        current = self._points[frame, self.slots[frame, others]]
        now = np.linalg.norm(starts[:, None] - current, axis=-1)
        excess = np.maximum(now - largest, 0.0) + np.maximum(smallest - now, 0.0)
        return np.asarray(np.nansum(excess, axis=1))


def _move_rigidly(
    point: np.ndarray, before: np.ndarray, after: np.ndarray
) -> np.ndarray:
    weight = 1.0 / (((before - point)[:, :2] ** 2).sum(axis=1) + 1e-6) ** 2
    weight /= weight.sum()
    centre = weight @ before
    target = weight @ after
    a = (before - centre)[:, :2] @ [1, 1j]
    b = (after - target)[:, :2] @ [1, 1j]
    turn = (weight * np.conj(a) * b).sum()
    turn = turn / abs(turn) if abs(turn) > 0 else 1.0
    x, y = point[:2] - centre[:2]
    moved = turn * complex(x, y)
    return np.array([target[0] + moved.real, target[1] + moved.imag, *point[2:]])
