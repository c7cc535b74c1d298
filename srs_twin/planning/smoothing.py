"""Shortening of a found path: Dubins paths between two of its poses where they are free and shorter."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compiled import compiled
from srs_twin.planning.best_first import Moves, one_arc, passes
from srs_twin.planning.collision import Surroundings
from srs_twin.planning.dubins import shortest, word
from srs_twin.planning.swept import along
from srs_twin.planning.tree import Pieces
from srs_twin.world import Pose

_ROUNDS = 4
_WORTH = 1e-4
"""A round that saves less than this share of the path is the last."""


def shortened(start: Pose, path: Pieces, moves: Moves, around: Surroundings, radius: float) -> Pieces:
    """Return a path with the same ends, free and not longer.

    Args:
        start: where it begins.
        path: a free path, its curvatures among those of the moves.
        moves: what the snake can do.
        around: the world.
        radius: of Dubins paths, m.
    """
    for turn in range(_ROUNDS):
        before = _length(path)
        # Cuts begin and end in other places each round.
        path = _cut(start, _split(path, radius / (2 + turn)), moves, around, radius)
        if _length(path) > before * (1 - _WORTH):
            break
    return path


def _cut(start: Pose, path: Pieces, moves: Moves, around: Surroundings, radius: float) -> Pieces:
    """Go along the path once, from each pose as far as a short cut leads."""
    poses, places = np.empty((len(path) + 1, 3)), np.zeros(len(path) + 1)
    poses[0] = start.x, start.y, start.heading
    for k, (curvature, length) in enumerate(path):
        poses[k + 1] = along(*poses[k], curvature, length)
        places[k + 1] = places[k] + length
    done: Pieces = []
    k = 0
    while k < len(path):
        last = len(path)
        while (last := int(_farthest(poses, places, k, last, moves, around, radius))) > k:
            x, y, heading = map(float, poses[last])
            cut = shortest(Pose(*map(float, poses[k])), x, y, heading, radius)
            cuts = list(zip(cut.curvatures, cut.lengths, strict=True))
            # A change of offset is felt on what follows it, so a cut is judged with the rest of the path.
            if not moves.changes.any() or _passes(start, [*done, *cuts, *path[last:]], moves, around):
                done += cuts
                break
            last -= 1
        else:
            done.append(path[k])
        k = max(last, k + 1)
    return done


def _passes(start: Pose, path: Pieces, moves: Moves, around: Surroundings) -> bool:
    """Say whether a path is free, transients included."""
    pieces = [(c, length) for c, length in path if length > 0]
    which = np.array([int(np.argmin(abs(moves.curvatures - c))) for c, _ in pieces])
    lengths = np.array([length for _, length in pieces])
    return bool(_all_free(start.x, start.y, start.heading, which, lengths, moves, around))


@compiled
def _all_free(x, y, heading, which, lengths, moves, around):  # type: ignore[no-untyped-def]
    """Say whether arcs laid end to end are free."""
    before, left, right, lasting = len(moves.curvatures), 0.0, 0.0, 0.0
    for k in range(len(which)):
        free, x, y, heading, left, right, lasting = one_arc(
            x, y, heading, before, which[k], lengths[k], left, right, lasting, moves, around
        )
        if not free:
            return False
        before = which[k]
    return True


@compiled
def _farthest(poses, places, k, until, moves, around, radius):  # type: ignore[no-untyped-def]
    """Return the last pose, `until` at most, to which a free short cut leads from pose k, or k."""
    x, y, heading = poses[k, 0], poses[k, 1], poses[k, 2]
    for last in range(until, k, -1):
        path = word(x, y, heading, poses[last, 0], poses[last, 1], poses[last, 2], False, radius)
        if path[3] + path[4] + path[5] < places[last] - places[k] - 1e-9:
            if passes(x, y, heading, path, len(moves.curvatures), 0.0, 0.0, 0.0, moves, around):
                return last
    return k


def _split(path: Pieces, longest: float) -> Pieces:
    """Return the path in pieces of this length at most."""
    counts = [math.ceil(length / longest) for _, length in path]
    return [(c, length / n) for (c, length), n in zip(path, counts, strict=True) for _ in range(n)]


def _length(path: Pieces) -> float:
    return math.fsum(length for _, length in path)
