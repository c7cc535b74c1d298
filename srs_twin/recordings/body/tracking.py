r"""Markers over time, and how each keeps its identity through swaps and gaps.

1. *Slots*: a take in which markers came and went has a column for each appearance; columns that were never
   seen at the same time are laid side by side into one.
2. *Tracklets*: stretches of one slot in which nothing but one marker can have been seen. From one sample to
   the next a marker is expected at

   $$ \hat p_k = p_a + (k - a)(p_a - p_{a-1}), $$

   and the link is sure where the sample lies nearer to it than the gate, and twice as near as any other.
3. *Tracks*: in the order of time, each frame's new tracklets are assigned to the markers lost before it so
   that the sum of distances to their expected positions is least (Hungarian method). Over a few frames a
   marker is expected to move on at its velocity; over more, either to be where it was or to have moved with
   the markers around it, whichever is nearer.

Relabelling is needed: of 65 synthetic takes with swaps, gaps and markers that come back in new columns, 16
are read if columns are taken for markers, and all 65 if markers are followed.

Errors raised here do not name the file; `read_motion` puts its name before them.
"""

from __future__ import annotations

import heapq

import numpy as np

from srs_twin.errors import InputError

MOST = 64
"""Slots: markers and reflections at the same time."""

GATE = 0.4
"""Of the distance of the two closest markers: how far from its expected place a marker surely is itself."""

_SAMPLED = 500  # frames that tell how close markers come
_SHORT = 3  # samples: a track with fewer is a reflection
_RARE = 0.03  # of all samples: where as many are in short tracklets, markers move far from frame to frame
_ALONE = 4  # frames over which a marker is expected to move on at its velocity
_FARTHEST = 6.0  # times as far as usual a marker may come back after a long time
_REMEMBERED = 100  # samples of the past that tell how far from each other two markers may be
_BODY = 3.0  # cost of a distance that two markers never had, relative to one from the expected position
_NEVER = 1e6


def pack_slots(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return markers in as few slots as there were columns in use at the same time.

    Args:
        points: shape (frames, columns, 2 or 3), m.

    Returns:
        Shape (frames, slots, 2 or 3), m; from which column each comes, −1 where nothing is, shape (frames,
        slots).

    Raises:
        InputError: no marker at all, or more than `MOST` slots.
    """
    seen = ~np.isnan(points[..., 0])
    used = np.flatnonzero(seen.any(axis=0))
    if not used.size:
        raise InputError("no marker was seen on any frame")
    first = seen[:, used].argmax(axis=0)
    last = len(seen) - 1 - seen[::-1, used].argmax(axis=0)
    # (last frame, slot) of those in use; the slot that is free the longest comes first.
    ends: list[tuple[int, int]] = []
    slot_of = np.empty(len(used), dtype=int)
    for k in np.lexsort((used, first)):
        if ends and ends[0][0] < first[k]:
            _, slot = heapq.heappop(ends)
        else:
            slot = len(ends)
        slot_of[k] = slot
        heapq.heappush(ends, (int(last[k]), slot))
    if len(ends) > MOST:
        raise InputError(f"{len(ends)} markers at the same time; at most {MOST} are followed")
    slots = np.full((len(points), len(ends), points.shape[-1]), np.nan)
    columns = np.full((len(points), len(ends)), -1)
    for k, slot in enumerate(slot_of):
        stretch = slice(first[k], last[k] + 1)
        slots[stretch, slot] = points[stretch, used[k]]
        columns[stretch, slot] = used[k]
    return slots, columns


def some_frames(count: int, most: int) -> np.ndarray:
    """Return at most so many frames, evenly spread but not evenly spaced: a gait has a period too."""
    if count <= most:
        return np.arange(count)
    edges = np.linspace(0, count, most + 1)
    return np.unique((edges[:-1] + np.random.default_rng(0).random(most) * np.diff(edges)).astype(int))


def distances(points: np.ndarray, frames: int) -> np.ndarray:
    """Return the distances of each two points on `some_frames`, (frames, points, points), m.

    NaN between a point and itself, and where one was not seen.
    """
    some = points[some_frames(len(points), frames)]
    apart = np.asarray(np.linalg.norm(some[:, :, None] - some[:, None], axis=-1))
    apart[:, np.arange(apart.shape[1]), np.arange(apart.shape[1])] = np.nan
    return apart


def _sure(points: np.ndarray, gate: float) -> np.ndarray:
    """Say which samples surely are of the same marker as the one before in their slot, (frames, slots).

    Args:
        points: shape (frames, slots, 2 or 3), m.
        gate: m.
    """
    step = np.diff(points, axis=0, prepend=np.nan)
    # A jump is no velocity: what follows it would be expected far away.
    step[np.isnan(step).any(axis=-1) | (np.linalg.norm(step, axis=-1) > 2 * gate)] = 0.0
    expected = np.full_like(points, np.nan)
    expected[1:] = points[:-1] + step[:-1]
    away = np.linalg.norm(points - expected, axis=-1)
    nearest = np.full_like(away, np.inf)
    for shift in range(1, points.shape[1]):
        np.fmin(nearest, np.linalg.norm(np.roll(points, shift, axis=1) - expected, axis=-1), out=nearest)
    return np.asarray((away < gate) & (2 * away < nearest))


def follow(
    points: np.ndarray, columns: np.ndarray, longest: int, reach: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """Follow markers through frames.

    Args:
        points: in slots, shape (frames, slots, 2 or 3), m.
        columns: from which column of the file each comes, shape (frames, slots).
        longest: frames over which a link inside a slot may go.
        reach: how far from where it is expected a marker may appear, m.

    Returns:
        As many tracks as were needed, NaN where a marker was not seen, shape (frames, tracks, 2 or 3), m;
        from which column of the file each sample came, −1 where it was not seen, shape (frames, tracks); how
        many samples belong to no track.

    Raises:
        InputError: markers jump too often to be followed.
    """
    apart = distances(points, _SAMPLED)
    nearest = np.where(np.isnan(apart), np.inf, apart).min(axis=(1, 2))
    nearest = nearest[np.isfinite(nearest)]
    # How near two markers come, but for a few frames.
    gate = min(GATE * float(np.quantile(nearest, 0.05)), reach) if nearest.size else reach
    seen, sure = np.isfinite(points[..., 0]), _sure(points, gate)
    ends = seen & ~np.append(sure[1:], np.zeros_like(sure[:1]), axis=0)
    slot, first = np.nonzero((seen & ~sure).T)
    last = np.nonzero(ends.T)[1]
    known, order = _Tracker(points, gate, longest, reach), np.argsort(first, kind="stable")
    length = last - first + 1
    if length[length < _SHORT].sum() < _RARE * seen.sum():
        known.shortest = _SHORT
    for group in np.split(order, np.flatnonzero(np.diff(first[order])) + 1):
        known.join(int(first[group[0]]), slot[group], last[group])
    slots = known.slots[:, known.samples >= _SHORT].astype(int)
    if not slots.shape[1]:
        slots = np.full((len(points), 1), -1)
    lost, at = slots < 0, np.maximum(slots, 0)
    tracks = np.where(lost[..., None], np.nan, np.take_along_axis(points, at[..., None], axis=1))
    origin = np.where(lost, -1, np.take_along_axis(columns, at, axis=1))
    return tracks, origin, int(seen.sum() - (~lost).sum())


class _Tracker:
    """Tracks up to the frame that has been reached.

    Attributes:
        slots: in which slot each track is, −1 where it was not seen, shape (frames, `MOST`).
        samples: of each track, 0 where it is not in use, shape (`MOST`,).
        shortest: samples that a tracklet has, unless it goes on as expected.
    """

    def __init__(self, points: np.ndarray, gate: float, longest: int, reach: float) -> None:
        self._points, self._gate, self._longest, self._reach = points, gate, longest, reach
        self.slots = np.full((len(points), MOST), -1, dtype=np.int8)
        self.samples, self.shortest = np.zeros(MOST, dtype=int), 1
        self._end = np.full(MOST, -1)
        self._last, self._velocity = np.zeros((2, MOST, points.shape[-1]))

    def join(self, first: int, slots: np.ndarray, last: np.ndarray) -> None:
        """Give tracklets that begin on one frame to tracks that ended before it, or to new ones.

        Args:
            first: that frame.
            slots: of the tracklets.
            last: their last frames.
        """
        from scipy.optimize import linear_sum_assignment

        gone = (self._end < first - _ALONE) & (self.samples < _SHORT)
        self.slots[:, gone & (self.samples > 0)] = -1
        self.samples[gone] = 0
        # Those that go on as expected first: the others are then known by their distances from these.
        for reach, longest in ((self._gate, _ALONE), (self._reach, first)):
            free = np.flatnonzero((self._end < first) & (self._end >= first - longest) & (self.samples > 0))
            distance = self._distances(free, first, self._points[first, slots], reach)
            rows, places = linear_sum_assignment(distance)
            good = distance[rows, places] < _NEVER
            for row, track in zip(rows[good], free[places[good]], strict=True):
                self._write(int(track), int(slots[row]), first, int(last[row]))
            left = np.setdiff1d(np.flatnonzero(last - first >= self.shortest - 1), rows[good])
            slots, last = slots[left], last[left]
        unused = np.flatnonzero(self.samples == 0)
        if len(slots) > len(unused):
            raise InputError(
                f"markers jump from frame to frame, none can be followed (over {MOST} tracks); is the unit "
                "of length or of time another?"
            )
        for track, slot, end in zip(unused.tolist(), slots.tolist(), last.tolist(), strict=False):
            self._write(track, slot, first, end)

    def _write(self, track: int, slot: int, first: int, last: int) -> None:
        """Let a track go on in a slot; its velocity is that of the last step, unless this is a jump."""
        before = self._points[last - 1, slot] if last > first else self._last[track]
        follows = last > first or (self.samples[track] > 0 and self._end[track] == first - 1)
        step = self._points[last, slot] - before
        self._velocity[track] = step if follows and np.linalg.norm(step) < 2 * self._gate else 0.0
        self._end[track], self._last[track] = last, self._points[last, slot]
        self.slots[first : last + 1, track] = slot
        self.samples[track] += last + 1 - first

    def _distances(self, tracks: np.ndarray, frame: int, begins: np.ndarray, near: float) -> np.ndarray:
        """Return how far from their tracks' expected positions tracklets begin, (tracklets, tracks), m.

        The longer a marker was hidden, the farther it may have gone. Beyond the frames over which gaps are
        filled nothing rests on its identity, as the trajectory is cut there.
        """
        gap = frame - self._end[tracks]
        moved = np.where(gap <= _ALONE, gap, 0)[:, None] * self._velocity[tracks]
        distance = np.linalg.norm(begins[:, None] - (self._last[tracks] + moved), axis=-1)
        strange = np.zeros_like(distance)
        for k in np.flatnonzero((gap > 1) | (near > self._gate)):
            end = self._end[tracks[k]]
            there = np.flatnonzero((self.slots[[end, frame]] >= 0).all(axis=0))
            if gap[k] > _ALONE and len(there) >= 2:
                others = (self._points[at, self.slots[at, there]] for at in (end, frame))
                carried = _carried(self._last[tracks[k]], *others)
                distance[:, k] = np.fmin(distance[:, k], np.linalg.norm(begins - carried, axis=-1))
            strange[:, k] = self._strange(tracks[k], frame, begins)
        reach = near * np.minimum(_FARTHEST, 1.0 + (gap - 1) / self._longest)
        return np.asarray(np.where(distance > reach, _NEVER, distance + _BODY * strange))

    def _strange(self, track: int, frame: int, begins: np.ndarray) -> np.ndarray:
        """Return by how much places leave the range of distances that a marker has had from the others, m."""
        there = np.flatnonzero(self.slots[frame] >= 0)
        past = np.flatnonzero(self.slots[: self._end[track] + 1, track] >= 0)
        past = past[:: len(past) // _REMEMBERED + 1][:, None]
        slots = self.slots[past, there]
        others = np.where((slots >= 0)[..., None], self._points[past, slots], np.nan)
        apart = np.linalg.norm(others - self._points[past, self.slots[past, track]], axis=-1)
        least, most = np.fmin.reduce(apart), np.fmax.reduce(apart)
        now = np.linalg.norm(begins[:, None] - self._points[frame, self.slots[frame, there]], axis=-1)
        return np.asarray(np.nansum(np.maximum(now - most, 0.0) + np.maximum(least - now, 0.0), axis=1))


def _carried(point: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return where a point goes that moves rigidly over the floor with others; the nearest count most."""
    weight = 1.0 / (((before - point)[:, :2] ** 2).sum(axis=1) + 1e-6) ** 2
    weight /= weight.sum()
    centre, target = weight @ before, weight @ after
    a = (before - centre)[:, :2] @ [1, 1j]
    b = (after - target)[:, :2] @ [1, 1j]
    turn = (weight * np.conj(a) * b).sum()
    turn = turn / abs(turn) if abs(turn) > 0 else 1.0
    x, y = point[:2] - centre[:2]
    place = turn * complex(x, y)
    return np.array([target[0] + place.real, target[1] + place.imag, *point[2:]])
