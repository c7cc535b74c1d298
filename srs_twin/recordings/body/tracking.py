r"""Markers over time, and how each keeps its identity through swaps and gaps.

1. *Slots*: a take in which markers came and went has a column for each appearance; columns that were never
   seen at the same time are laid side by side into one.
2. *Untangling*, where a file lists its markers in another order on every frame: a marker goes on in the slot
   whose sample is nearest to where it was, if each is the other's nearest and within the gate.
3. *Tracklets*: stretches of one slot in which nothing but one marker can have been seen. From one sample to
   the next a marker is expected at

   $$ \hat p_k = p_a + (k - a)(p_a - p_{a-1}), $$

   and the link is sure where the sample lies nearer to it than the gate, and twice as near as any other.
4. *Tracks*: in the order of time, each moment's new tracklets are assigned to the markers lost before it so
   that the sum of distances to where these are expected is least (Hungarian method). Over a few frames a
   marker is expected to go on as it did; over more either to be where it was or to have moved with the
   markers around it, whichever is nearer, and to keep within the distances from the others that it has had
   before.

Errors raised here do not name the file; `read_motion` puts its name before them.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from srs_twin.errors import InputError

MOST = 64
"""Slots: markers and reflections at the same time."""

GATE = 0.4
"""Of the distance of the two closest markers: how far from its expected place a marker surely is itself."""

MOST_PIECES = 10_000
_AT_ONCE = 2000  # frames that are untangled at once
_SAMPLED = 500  # frames that tell how close markers come
_TANGLED, _OFTEN = 2000, 0.02  # pieces, and a frame: so many come of a file whose columns mean nothing
_JUMPING = "markers jump from frame to frame, none can be followed"
_SHORT = 3  # frames: fewer samples than these are joined last, where they fit between others
_RARE = 0.03  # of all samples: as many in short tracklets are no outliers
_ALONE = 4  # frames over which a marker is expected to go on as it did
_FARTHEST = 6.0  # times as far as usual a marker may come back after a long time
_REMEMBERED = 100  # samples of the past that tell how far from each other two markers may be
_BODY = 3.0  # what a distance that two markers never had counts against one from where a marker is expected
_NEVER = 1e6


def pack_slots(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return markers in as few slots as there were columns in use at the same time.

    Args:
        points: shape (frames, columns, 2), m.

    Returns:
        Shape (frames, slots, 2), m; from which column each comes, −1 where nothing is, shape (frames, slots).

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
    slots = np.full((len(points), len(ends), 2), np.nan)
    columns = np.full((len(points), len(ends)), -1)
    for k, slot in enumerate(slot_of):
        stretch = slice(first[k], last[k] + 1)
        slots[stretch, slot] = points[stretch, used[k]]
        columns[stretch, slot] = used[k]
    return slots, columns


def untangle(points: np.ndarray, columns: np.ndarray, gate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return slots in which markers stay as far as that is plain, and where each sample came from.

    Args:
        points: shape (frames, slots, 2), m.
        columns: from which column each sample came, shape (frames, slots).
        gate: m.
    """
    frames, slots = points.shape[:2]
    following = np.concatenate(
        [_following(points[k : k + _AT_ONCE + 1], gate) for k in range(0, frames - 1, _AT_ONCE)]
    )
    order = np.empty((frames, slots), dtype=int)
    row = list(range(slots))
    order[0] = row
    for k, links in enumerate(following.tolist(), start=1):
        new = [links[slot] for slot in row]
        taken = set(new)
        # A marker that is not seen now keeps its slot, where no other has come to it.
        for place, slot in enumerate(row):
            if new[place] < 0 and slot not in taken:
                new[place] = slot
                taken.add(slot)
        free = iter(slot for slot in range(slots) if slot not in taken)
        row = [slot if slot >= 0 else next(free) for slot in new]
        order[k] = row
    return (
        np.take_along_axis(points, order[..., None], axis=1),
        np.take_along_axis(np.ascontiguousarray(columns), order, axis=1),
    )


def _following(points: np.ndarray, gate: float) -> np.ndarray:
    """Return in which slot each marker surely is on the next frame, −1 where that is not sure."""
    apart = np.hypot(*np.moveaxis(points[:-1, :, None] - points[1:, None], -1, 0))
    apart = np.where(np.isnan(apart), np.inf, apart)
    ahead, back = apart.argmin(axis=2), apart.argmin(axis=1)
    mutual = np.take_along_axis(back, ahead, axis=1) == np.arange(points.shape[1])
    return np.asarray(np.where(mutual & (apart.min(axis=2) < gate), ahead, -1))


@dataclass(frozen=True)
class Tracklet:
    """One stretch of one slot.

    Attributes:
        slot: which.
        frames: where it was seen, ascending, shape (samples,).
    """

    slot: int
    frames: np.ndarray


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


def tracklets(points: np.ndarray, gate: float, longest: int) -> list[Tracklet]:
    """Cut slots where a marker may have become another.

    Args:
        points: shape (frames, slots, 2), m.
        gate: m.
        longest: frames over which a link may go.

    Returns:
        In the order of their first frames.
    """
    found: list[Tracklet] = []
    for slot in range(points.shape[1]):
        seen = np.flatnonzero(~np.isnan(points[:, slot, 0]))
        breaks = np.flatnonzero(~_sure(points, slot, seen, gate, longest)) + 1
        found += [Tracklet(slot, part) for part in np.split(seen, breaks) if part.size]
    return sorted(found, key=lambda each: (each.frames[0], each.slot))


def _sure(points: np.ndarray, slot: int, seen: np.ndarray, gate: float, longest: int) -> np.ndarray:
    """Say of each step from one sample to the next whether it is sure, shape (samples − 1,)."""
    own = points[:, slot]
    before, after = seen[:-1], seen[1:]
    step = after - before
    velocity = np.zeros((len(before), 2))
    running = np.flatnonzero(step[:-1] == 1) + 1
    velocity[running] = own[before[running]] - own[before[running] - 1]
    # A jump is no velocity: what follows it would be expected far away.
    velocity[np.hypot(*velocity.T) > 2 * gate] = 0.0
    # Farther than a few frames nothing goes on as it did.
    expected = own[before] + velocity * np.minimum(step, 3)[:, None]
    away = np.hypot(*(own[after] - expected).T)
    nearest = np.full(len(before), np.inf)
    for other in range(points.shape[1]):
        if other != slot:
            distance = np.hypot(*(points[after, other] - expected).T)
            np.fmin(nearest, distance, out=nearest)
    return np.asarray((away < gate) & (2 * away < nearest) & (step <= longest))


def follow(
    points: np.ndarray, columns: np.ndarray, longest: int, reach: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """Follow markers through frames.

    Args:
        points: in slots, shape (frames, slots, 2), m.
        columns: from which column of the file each comes, shape (frames, slots).
        longest: frames over which a link inside a slot may go.
        reach: how far from where it is expected a marker may appear, m.

    Returns:
        As many tracks as were needed, NaN where a marker was not seen, shape (frames, tracks, 2), m; from
        which column of the file each sample came, −1 where it was not seen, shape (frames, tracks); how many
        samples belong to no track.

    Raises:
        InputError: markers jump too often to be followed.
    """
    apart = distances(points, _SAMPLED)
    nearest = np.where(np.isnan(apart), np.inf, apart).min(axis=(1, 2))
    nearest = nearest[np.isfinite(nearest)]
    # How near two markers come, but for a few frames.
    gate = min(GATE * float(np.quantile(nearest, 0.05)), reach) if nearest.size else reach
    pieces = tracklets(points, gate, longest)
    if len(pieces) > max(_TANGLED, _OFTEN * len(points)):
        points, columns = untangle(points, columns, gate)
        pieces = tracklets(points, gate, longest)
    if len(pieces) > MOST_PIECES:
        raise InputError(f"{_JUMPING} ({len(pieces)} pieces of their ways; at most {MOST_PIECES} are joined)")
    known = _Tracker(points, longest, reach)
    short = [each for each in pieces if len(each.frames) < _SHORT]
    if sum(len(each.frames) for each in short) > _RARE * np.count_nonzero(columns >= 0):
        # Few frames a second: markers go far from frame to frame, and pieces are short without being wrong.
        short = []
    joined = [each for each in pieces if not short or len(each.frames) >= _SHORT]
    for _, group in groupby(joined, key=lambda each: each.frames[0]):
        known.join(list(group))
        if len(known.tracks) > MOST:
            raise InputError(f"{_JUMPING} (over {MOST} tracks); is the unit of length or of time another?")
    dropped = sum(len(each.frames) for each in short if not known.fits(each, gate))
    if not known.tracks:
        return np.full((len(points), 1, 2), np.nan), np.full((len(points), 1), -1), dropped
    tracks, slots = np.stack(known.tracks, axis=1), np.stack(known.slots, axis=1)
    origin = np.take_along_axis(columns, np.maximum(slots, 0), axis=1)
    return tracks, np.where(slots < 0, -1, origin), dropped


class _Tracker:
    """Tracks up to the frame that has been reached."""

    def __init__(self, points: np.ndarray, longest: int, reach: float) -> None:
        self._points, self._longest, self._reach = points, longest, reach
        self.tracks: list[np.ndarray] = []
        self.slots: list[np.ndarray] = []
        self._ends: list[int] = []

    def join(self, pieces: list[Tracklet]) -> None:
        """Give tracklets that begin on the same frame to tracks that ended before it, or to new ones."""
        from scipy.optimize import linear_sum_assignment

        start = int(pieces[0].frames[0])
        free = [k for k, end in enumerate(self._ends) if end < start]
        targets: dict[int, int] = {}
        if free:
            begins = np.stack([self._points[start, each.slot] for each in pieces])
            distance = np.stack([self._distance(k, start, begins) for k in free], axis=1)
            pairs = zip(*linear_sum_assignment(distance), strict=True)
            targets = {row: free[column] for row, column in pairs if distance[row, column] < _NEVER}
        for row, piece in enumerate(pieces):
            if row not in targets:
                targets[row] = len(self._ends)
                self.tracks.append(np.full((len(self._points), 2), np.nan))
                self.slots.append(np.full(len(self._points), -1))
                self._ends.append(-1)
            self._write(piece, targets[row])

    def fits(self, piece: Tracklet, gate: float) -> bool:
        """Put a short tracklet into the hole of a track that runs through it; say whether there is one."""
        start, end = int(piece.frames[0]), int(piece.frames[-1])
        first = max(0, start - self._longest)
        for k, track in enumerate(self.tracks):
            seen = np.flatnonzero(~np.isnan(track[first : end + self._longest + 1, 0])) + first
            place = int(np.searchsorted(seen, start))
            if place in (0, len(seen)) or seen[place] <= end:
                continue
            before, after = seen[place - 1], seen[place]
            share = ((piece.frames - before) / (after - before))[:, None]
            between = (1 - share) * track[before] + share * track[after]
            if np.hypot(*(self._points[piece.frames, piece.slot] - between).T).max() < gate:
                self._write(piece, k)
                return True
        return False

    def _write(self, piece: Tracklet, track: int) -> None:
        self.tracks[track][piece.frames] = self._points[piece.frames, piece.slot]
        self.slots[track][piece.frames] = piece.slot
        self._ends[track] = max(self._ends[track], int(piece.frames[-1]))

    def _distance(self, track: int, frame: int, begins: np.ndarray) -> np.ndarray:
        """Return how far from where a track's marker should be new tracklets begin, shape (tracklets,), m.

        The longer it was hidden, the farther it may have gone. Beyond the frames over which gaps are filled
        nothing rests on its identity, as the trajectory is cut there.
        """
        own, end = self.tracks[track], self._ends[track]
        gap = frame - end
        expected = [own[end]]
        if gap <= _ALONE:
            velocity = own[end] - own[end - 1] if end and not np.isnan(own[end - 1, 0]) else np.zeros(2)
            expected = [own[end] + gap * velocity]
        else:
            others = np.array([t[[end, frame]] for k, t in enumerate(self.tracks) if k != track])
            others = others[~np.isnan(others).any(axis=(1, 2))] if len(others) else others
            if len(others) >= 2:
                expected.append(_carried(own[end], others[:, 0], others[:, 1]))
        distance = np.linalg.norm(begins[:, None] - np.array(expected), axis=-1).min(axis=1)
        reach = self._reach * min(_FARTHEST, 1.0 + (gap - 1) / self._longest)
        cost = distance + self._strange(track, frame, begins)
        return np.where(distance > reach, _NEVER, cost)

    def _strange(self, track: int, frame: int, begins: np.ndarray) -> np.ndarray:
        """Return by how much places leave the range of distances that a marker has had from the others, m."""
        there = [k for k, each in enumerate(self.tracks) if k != track and not np.isnan(each[frame, 0])]
        if not there:
            return np.zeros(len(begins))
        end = self._ends[track]
        past = slice(0, end + 1, end // _REMEMBERED + 1)
        others = np.stack([self.tracks[k][past] for k in there], axis=1)
        apart = np.hypot(*np.moveaxis(others - self.tracks[track][past, None], -1, 0))
        known = ~np.isnan(apart)
        most = np.where(known, apart, -np.inf).max(axis=0)
        least = np.where(known, apart, np.inf).min(axis=0)
        now = np.linalg.norm(begins[:, None] - np.stack([self.tracks[k][frame] for k in there]), axis=-1)
        over = np.where(np.isfinite(most), np.maximum(now - most, 0.0) + np.maximum(least - now, 0.0), 0.0)
        return np.asarray(_BODY * over.sum(axis=1))


def _carried(point: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return where a point goes that moves rigidly with others, the nearest of which count most."""
    weight = 1.0 / (((before - point) ** 2).sum(axis=1) + 1e-6) ** 2
    weight /= weight.sum()
    centre, target = weight @ before, weight @ after
    a = (before - centre) @ [1, 1j]
    b = (after - target) @ [1, 1j]
    turn = (weight * np.conj(a) * b).sum()
    turn = turn / abs(turn) if abs(turn) > 0 else 1.0
    place = turn * complex(*(point - centre))
    return np.asarray(target + [place.real, place.imag])
