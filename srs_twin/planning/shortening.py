"""Shorter paths: Dubins paths between two poses of a found path, where they are free and shorter."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
from srs_twin.planning.best_first import Moves, at_rest, one_arc, passes
from srs_twin.planning.collision import Surroundings
from srs_twin.planning.dubins import Pieces, word
from srs_twin.robot.world import Pose

_ROUNDS = 4
_WORTH = 1e-4
"""A round that saves less than this share of the path is the last."""
_NEARER = 0.97
"""The end of the next cut to be tried is so many times as far on: tries grow with the logarithm."""


def shortened(start: Pose, path: Pieces, moves: Moves, around: Surroundings, radius: float) -> Pieces:
    """Return a path with the same ends, free and not longer.

    Args:
        start: where it begins.
        path: a free path, its curvatures among those of the moves.
        moves: what the snake can do.
        around: the world.
        radius: of Dubins paths, m.
    """
    pieces = [(c, length) for c, length in path if length > 0]
    which = np.array([np.argmin(abs(moves.curvatures - c)) for c, _ in pieces], dtype=np.int64)
    lengths = np.array([length for _, length in pieces])
    for turn in range(_ROUNDS):
        before = math.fsum(lengths)
        # Cuts begin and end in other places each round.
        counts = np.ceil(lengths * (2 + turn) / radius).astype(np.int64)
        split = np.repeat(which, counts), np.repeat(lengths / counts, counts)
        which, lengths = _cut(*start, *split, moves, around, radius)
        if math.fsum(lengths) > before * (1 - _WORTH):
            break
    return list(zip(moves.curvatures[which].tolist(), lengths.tolist(), strict=True))


@allocating
def _cut(x, y, heading, which, lengths, moves, around, radius):  # type: ignore[no-untyped-def]  # noqa: D417
    """Go along a path once, from each pose as far as a short cut leads; return moves and lengths (m).

    Args:
        x, y, heading: where it begins, m and rad.
        which: move of each piece, shape (n,).
        lengths: of the pieces, m, shape (n,).
        moves, around, radius: as for `shortened`.
    """
    count = len(which)
    way, places = at_rest(x, y, heading, moves), np.zeros(count + 1)
    ways = [way]
    for k in range(count):
        _, way = one_arc(way, which[k], lengths[k], moves, around)
        ways.append(way)
        places[k + 1] = places[k] + lengths[k]
    taken, long, made = np.empty(3 * count, dtype=np.int64), np.empty(3 * count), 0
    way, k = at_rest(x, y, heading, moves), 0
    while k < count:
        last = count
        while last > k:
            pose = ways[last]
            path = word(way[0], way[1], way[2], pose[0], pose[1], pose[2], False, radius)
            if path[3] + path[4] + path[5] < places[last] - places[k] - 1e-9:
                free, end = passes(way, path, moves, around)
                # A change of offset is felt on what follows it.
                if free and _goes_on(end, last, which, lengths, ways, moves, around):
                    break
            last = k + min(last - k - 1, int(_NEARER * (last - k)))
        if last > k:
            for piece in range(3):
                if path[3 + piece] > 0:
                    made = _lay(taken, long, made, moves.turns[0, 1 + int(path[piece])], path[3 + piece])
            way, k = end, last
        else:
            made = _lay(taken, long, made, which[k], lengths[k])
            _, way = one_arc(way, which[k], lengths[k], moves, around)
            k += 1
    return taken[:made], long[:made]


@compiled
def _lay(taken, long, made, move, length):  # type: ignore[no-untyped-def]
    """Add a piece to a path, to its last one if their moves are the same; return how many there are."""
    if made > 0 and taken[made - 1] == move:
        long[made - 1] += length
        return made
    taken[made], long[made] = move, length
    return made + 1


@allocating
def _goes_on(way, k, which, lengths, ways, moves, around):  # type: ignore[no-untyped-def]
    """Say whether a free path from piece k on stays free for one that comes there another way."""
    while k < len(which):
        before, left, right, lasting = way[3], way[4], way[5], way[6]
        there = ways[k]
        ended = lasting <= 0 or (left <= there[4] and right <= there[5] and lasting <= there[6])
        if before == there[3] and ended:
            return True
        free, way = one_arc(way, which[k], lengths[k], moves, around)
        if not free:
            return False
        k += 1
    return True
