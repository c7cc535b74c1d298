"""Tracking: tracklets joined to markers that keep their identity through swaps and gaps.

In the order of time, each moment's new tracklets are assigned to the markers lost before it so that the sum
of distances to where these are expected is least (Hungarian method). Over a few frames a marker is expected
to go on as it did; over more either to be where it was or to have moved with the markers around it, whichever
is nearer, and to keep within the distances from the others that it has had before.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.slots import MOST
from srs_twin.identification.tracklets import GATE, Tracklet, closest, tracklets
from srs_twin.identification.untangling import untangled

MOST_PIECES = 10_000
_TANGLED = 2000  # pieces: so many come of a file whose columns mean nothing
_WILD = "markers jump from frame to frame, none can be followed"
_SHORT = 3  # frames: fewer samples than these are joined last, where they fit between others
_RARE = 0.03  # of all samples: as many in short tracklets are no outliers
_ALONE = 4  # frames over which a marker is expected to go on as it did
_FARTHEST = 6.0  # times as far as usual a marker may come back after a long time
_REMEMBERED = 100  # samples of the past that tell how far from each other two markers may be
_BODY = 3.0  # what a distance that two markers never had counts against one from where a marker is expected
_NEVER = 1e6


@dataclass(frozen=True)
class Tracks:
    """Markers over time.

    Attributes:
        points: NaN where not seen, shape (frames, tracks, 2), m.
        columns: from which column of the file each sample came, −1 where not seen, shape (frames, tracks).
        dropped: samples that belong to no track.
    """

    points: np.ndarray
    columns: np.ndarray
    dropped: int


def follow(name: str, points: np.ndarray, columns: np.ndarray, longest: int, reach: float) -> Tracks:
    """Follow markers through frames.

    Args:
        name: of the file.
        points: in slots, shape (frames, slots, 2), m.
        columns: from which column of the file each comes, shape (frames, slots).
        longest: frames over which a link inside a slot may go.
        reach: how far from where it is expected a marker may appear, m.

    Returns:
        As many tracks as were needed.

    Raises:
        InputError: markers jump too often to be followed.
    """
    least = closest(points)
    gate = min(GATE * least, reach)
    pieces = tracklets(points, gate, longest)
    if len(pieces) > _TANGLED:
        points, columns = untangled(points, columns, gate)
        pieces = tracklets(points, gate, longest)
    if len(pieces) > MOST_PIECES:
        raise InputError(
            f"{name}: {_WILD} ({len(pieces)} pieces of their ways; at most {MOST_PIECES} are joined)"
        )
    book = _Book(points, longest, reach)
    short = [each for each in pieces if len(each.frames) < _SHORT]
    if sum(len(each.frames) for each in short) > _RARE * np.count_nonzero(columns >= 0):
        # Few frames a second: markers go far from frame to frame, and pieces are short without being wrong.
        short = []
    apart = {id(each) for each in short}
    for _, group in groupby((each for each in pieces if id(each) not in apart), key=lambda each: each.start):
        book.join(list(group))
        if len(book.tracks) > MOST:
            raise InputError(
                f"{name}: {_WILD} (over {MOST} tracks); is the unit of length or of time another?"
            )
    dropped = sum(len(each.frames) for each in short if not book.fits(each, gate))
    if not book.tracks:
        return Tracks(np.full((len(points), 1, 2), np.nan), np.full((len(points), 1), -1), dropped)
    tracks, slots = np.stack(book.tracks, axis=1), np.stack(book.slots, axis=1)
    origin = np.take_along_axis(columns, np.maximum(slots, 0), axis=1)
    return Tracks(tracks, np.where(slots < 0, -1, origin), dropped)


class _Book:
    """Tracks as far as they are known."""

    def __init__(self, points: np.ndarray, longest: int, reach: float) -> None:
        self._points, self._longest, self._reach = points, longest, reach
        self.tracks: list[np.ndarray] = []
        self.slots: list[np.ndarray] = []
        self._ends: list[int] = []

    def join(self, pieces: list[Tracklet]) -> None:
        """Give tracklets that begin on the same frame to tracks that ended before it, or to new ones."""
        start = pieces[0].start
        free = [k for k, end in enumerate(self._ends) if end < start]
        targets: list[int | None] = [None] * len(pieces)
        if free:
            begins = np.stack([self._points[start, each.slot] for each in pieces])
            distance = np.stack([self._distance(k, start, begins) for k in free], axis=1)
            for row, column in _assigned(distance):
                if distance[row, column] < _NEVER:
                    targets[row] = free[column]
        for piece, target in zip(pieces, targets, strict=True):
            self._write(piece, self._new() if target is None else target)

    def fits(self, piece: Tracklet, gate: float) -> bool:
        """Put a short tracklet into the hole of a track that runs through it; say whether there is one."""
        for k, track in enumerate(self.tracks):
            hole = self._hole(track, piece)
            if hole is None:
                continue
            before, after = hole
            share = ((piece.frames - before) / (after - before))[:, None]
            between = (1 - share) * track[before] + share * track[after]
            if np.hypot(*(self._points[piece.frames, piece.slot] - between).T).max() < gate:
                self._write(piece, k)
                return True
        return False

    def _hole(self, track: np.ndarray, piece: Tracklet) -> tuple[int, int] | None:
        first, last = max(0, piece.start - self._longest), piece.end + self._longest + 1
        seen = np.flatnonzero(~np.isnan(track[first:last, 0])) + first
        before, after = seen[seen < piece.start], seen[seen > piece.end]
        inside = len(before) + len(after) < len(seen)
        return None if inside or not before.size or not after.size else (int(before[-1]), int(after[0]))

    def _write(self, piece: Tracklet, track: int) -> None:
        self.tracks[track][piece.frames] = self._points[piece.frames, piece.slot]
        self.slots[track][piece.frames] = piece.slot
        self._ends[track] = max(self._ends[track], piece.end)

    def _new(self) -> int:
        frames = len(self._points)
        self.tracks.append(np.full((frames, 2), np.nan))
        self.slots.append(np.full(frames, -1))
        self._ends.append(-1)
        return len(self._ends) - 1

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


def _assigned(distance: np.ndarray) -> list[tuple[int, int]]:
    """Return pairs (row, column) with the least sum of distances."""
    if distance.shape == (1, 1):
        return [(0, 0)]
    if distance.shape[0] == 1:
        return [(0, int(distance[0].argmin()))]
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(distance)
    return [(int(row), int(column)) for row, column in zip(rows, columns, strict=True)]
