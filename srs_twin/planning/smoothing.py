"""Shortening of a found path: Dubins paths between two of its poses where they are free and shorter."""

from __future__ import annotations

import math
from collections.abc import Sequence

from srs_twin.planning.collision import Checker
from srs_twin.planning.dubins import shortest
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.plan import Segment, path_of

_ROUNDS = 4
_WORTH = 1e-4
"""A short cut that saves less than this share of the path is not looked for again."""


def shortened(path: tuple[Segment, ...], footprint: Footprint, checker: Checker) -> tuple[Segment, ...]:
    """Return a path with the same ends, free (transients aside) and not longer.

    Args:
        path: a free path.
        footprint: how tightly the snake turns.
        checker: of the same footprint.
    """
    radius = 1 / min(footprint.tightest)
    for turn in range(_ROUNDS):
        before = _length(path)
        # Cuts begin and end in other places each round.
        path = _cut(_split(path, radius / (2 + turn)), footprint, checker, radius)
        if _length(path) > before * (1 - _WORTH):
            break
    return path


def _cut(path: Sequence[Segment], footprint: Footprint, checker: Checker, radius: float) -> tuple[Segment, ...]:
    """Go along the path once, from each pose as far as a short cut leads."""
    done: list[tuple[float, float]] = []
    start, k = path[0].start, 0
    here = start
    while k < len(path):
        for last in range(len(path) - 1, k, -1):
            end, along = path[last].end, _length(path[k : last + 1])
            cut = shortest(here, end.x, end.y, end.heading, radius)
            if cut.length < along - 1e-9:
                pieces = list(zip(cut.curvatures, cut.lengths, strict=True))
                way = path_of(here, pieces, footprint)
                if all(checker.free(s.start, s.curvature, s.length) for s in way):
                    done += pieces
                    here, k = end, last + 1
                    break
        else:
            done.append((path[k].curvature, path[k].length))
            here, k = path[k].end, k + 1
    return path_of(start, done, footprint)


def _split(path: Sequence[Segment], longest: float) -> list[Segment]:
    """Return the path in segments of this length at most."""
    parts = []
    for segment in path:
        count = math.ceil(segment.length / longest)
        for i in range(count):
            start = segment.pose(segment.length * i / count)
            parts.append(Segment(start, segment.curvature, segment.length / count, segment.offset, segment.speed))
    return parts


def _length(path: Sequence[Segment]) -> float:
    return math.fsum(s.length for s in path)
