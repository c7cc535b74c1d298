"""Shortening of a found path: Dubins paths between two of its poses where they are free and shorter."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compiled import compiled
from srs_twin.planning.best_first import Moves, passes
from srs_twin.planning.collision import Surroundings
from srs_twin.planning.dubins import shortest, word
from srs_twin.planning.swept import along
from srs_twin.planning.tree import Pieces
from srs_twin.world import Pose

_ROUNDS = 4
_WORTH = 1e-4
"""A round that saves less than this share of the path is the last."""


def shortened(start: Pose, path: Pieces, moves: Moves, around: Surroundings, radius: float) -> Pieces:
    """Return a path with the same ends, free (transients aside) and not longer.

    Args:
        start: where it begins.
        path: a free path.
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
        last = _farthest(poses, places, k, moves, around, radius)
        if last > k:
            x, y, heading = map(float, poses[last])
            cut = shortest(Pose(*map(float, poses[k])), x, y, heading, radius)
            done += zip(cut.curvatures, cut.lengths, strict=True)
        else:
            done.append(path[k])
        k = max(last, k + 1)
    return done


@compiled
def _farthest(poses, places, k, moves, around, radius):  # type: ignore[no-untyped-def]
    """Return the last pose to which a free short cut leads from pose k, or k."""
    x, y, heading = poses[k, 0], poses[k, 1], poses[k, 2]
    for last in range(len(places) - 1, k, -1):
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
