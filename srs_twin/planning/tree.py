"""One tree of a search: from the start, or, on the reversed problem, from the goal."""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from srs_twin.planning.arcs import Primitives
from srs_twin.planning.best_first import (
    ARRIVED,
    CONNECTED,
    EXHAUSTED,
    EXPANDED,
    FULL,
    Frontier,
    Moves,
    Search,
    Target,
    add_root,
    empty_frontier,
    expand,
    grown,
)  # fmt: skip
from srs_twin.planning.dubins import Pieces, shortest
from srs_twin.planning.footprint import Footprint
from srs_twin.robot.world import Goal, Pose

_ROOM = 4096
# At the end of a tightest turn the Dubins length jumps by a full turn if rounding puts the goal inside of it;
# the bound must not, so it is that of turns tighter by this share.
_SLACK = 1e-6
_SPREAD = (0.0, -0.7, 0.7)
_EASES = (1.0, 2.0, 5.0)
"""Times the least radius: small corrections with tight turns have all of their transients."""


def moves_of(primitives: Primitives, footprint: Footprint) -> Moves:
    """Return what a snake can do: the primitives it can follow, its tightest turns, and straight ahead.

    Raises:
        InputError: the footprint cannot follow one of the primitives.
    """
    right, left = footprint.tightest
    both = min(right, left)
    own = [*primitives.curvatures, -right, -both, 0.0, both, left]
    gentle = [side * both / ease for ease in _EASES for side in (-1, 1)]
    curvatures = np.unique(np.round([*own, *gentle], 12))
    # Rounding, which merges equal ones, must not leave the footprint's range.
    curvatures = np.clip(curvatures, -right, left)
    motions = [footprint.at(float(k)) for k in curvatures]
    offsets = [m.offset for m in motions]
    changes = [[footprint.transient(a, b) for b in offsets] for a in offsets]
    changes.append([(0.0, 0.0, 0.0)] * len(offsets))
    arcs = np.unique([np.argmin(abs(curvatures - k)) for k in own])
    turns = [[np.argmin(abs(curvatures - side * both / ease)) for side in (-1, 0, 1)] for ease in _EASES]
    edges = np.array([m.left for m in motions]), np.array([m.right for m in motions])
    reach = primitives.length, footprint.ahead, footprint.behind
    return Moves(curvatures, *edges, np.array(changes), arcs, np.array(_EASES), np.array(turns), *reach)


def target_of(goal: Goal, footprint: Footprint) -> Target:
    """Return a goal as the kernel takes it."""
    right, left = footprint.tightest
    pose = goal.x, goal.y, goal.heading or 0.0
    radii = (1 - _SLACK) / max(right, left), 1 / min(right, left)
    return Target(*pose, goal.heading is None, goal.radius, goal.heading_tolerance, *radii)


def reversed_moves(moves: Moves) -> Moves:
    """Return what the moves are for one that goes the same paths from their end: sides exchanged."""
    last = len(moves.curvatures) - 1
    turned, left, right = (each[::-1].copy() for each in (-moves.curvatures, moves.right, moves.left))
    changes, turns, arcs = np.zeros_like(moves.changes), last - moves.turns[:, ::-1], last - moves.arcs[::-1]
    reach = moves.length, moves.behind, moves.ahead
    return Moves(turned, left, right, changes, arcs, moves.eases, turns, *reach)


class Tree:
    """A best-first search that can be continued.

    Args:
        roots: poses to begin at.
        search: what it goes by.
        backward: it solves the reversed problem, from the goal.
    """

    def __init__(self, roots: list[Pose], search: Search, *, backward: bool = False) -> None:
        self.search, self.backward, self.exhausted = search, backward, False
        self.frontier: Frontier = empty_frontier(max(_ROOM, 2 * len(roots)))
        for root in roots:
            add_root(self.frontier, *root, search)

    @property
    def expanded(self) -> int:
        """Nodes expanded so far."""
        return int(self.frontier.counts[EXPANDED])

    def grow(self, share: int, best: float) -> Pieces | None:
        """Expand so many nodes at most; return the pieces of a plan shorter than `best` (m), if found."""
        until = self.expanded + share
        while True:
            ended, node = expand(self.frontier, self.search, best, until - self.expanded)
            if ended != FULL:
                break
            self.frontier = grown(self.frontier)
        self.exhausted = ended == EXHAUSTED
        return self._path(int(node), connected=ended == CONNECTED) if ended in (CONNECTED, ARRIVED) else None

    def _path(self, node: int, *, connected: bool) -> Pieces:
        moves, target = self.search.moves, self.search.target
        pieces: Pieces = []
        end = Pose(*map(float, self.frontier.nodes[node, :3]))
        if connected:
            heading = None if target.free else target.heading
            pieces = shortest(end, target.x, target.y, heading, target.turning)[::-1]
        while (parent := int(self.frontier.links[node, 0])) >= 0:
            move = int(self.frontier.links[node, 1])
            if move >= 0:
                pieces.append((float(moves.curvatures[move]), moves.length))
            else:
                gate, ease = divmod(-1 - move, len(moves.eases))
                x, y, heading, through = map(float, self.search.gates[gate])
                begin = Pose(*map(float, self.frontier.nodes[parent, :3]))
                way = shortest(begin, x, y, heading, target.turning * moves.eases[ease])
                pieces += [(0.0, through), *way[::-1]]
            node = parent
        return pieces[::-1]


def arrivals(goal: Goal, sector: float) -> list[Pose]:
    """Return poses spread over a goal's tolerance, the goal's own first."""
    if goal.heading is None:
        headings = list(np.arange(0.0, 2 * math.pi, sector))
    else:
        headings = [goal.heading + share * goal.heading_tolerance for share in (0.0, -1.0, 1.0)]
    x, y = ([place + share * goal.radius for share in _SPREAD] for place in (goal.x, goal.y))
    return [Pose(*place, float(heading)) for heading in headings for place in product(x, y)]


def turned(pose: Pose) -> Pose:
    """Return a pose looking back."""
    return Pose(pose.x, pose.y, pose.heading + math.pi)
