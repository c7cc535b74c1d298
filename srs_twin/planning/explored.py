"""What a search has explored: the arcs of its trees, the gates, the arcs it rejected and by what.

Nothing of this is kept while a search runs: nodes say where they come from, and arcs that lead from the
expanded ones are looked at once more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.planning.arcs import along
from srs_twin.planning.best_first import NODES, OPEN, one_arc
from srs_twin.planning.collision import nearest
from srs_twin.planning.problem import Problem
from srs_twin.planning.tree import Tree

_POINTS = 5
MOST_NODES = 3000
"""Of which rejected arcs are looked for."""


@dataclass(frozen=True)
class Explored:
    """A search from above, all in m.

    Attributes:
        arcs: that lead to a node, shape (n, points, 2); the way into a gate is drawn as a line.
        gates: begin and end of the straight way through each, shape (g, 2, 2).
        rejected: arcs that touch something, shape (m, points, 2).
        reasons: what each of them touches.
        nodes: made in all.
    """

    arcs: np.ndarray
    gates: np.ndarray
    rejected: np.ndarray
    reasons: tuple[str, ...]
    nodes: int


def explored(trees: Sequence[Tree], problem: Problem) -> Explored:
    """Return what the trees of a search have seen.

    Args:
        trees: as the search left them.
        problem: that they were to solve.
    """
    arcs, rejected, reasons, gates = [], [], [], np.empty((0, 4))
    for tree in trees:
        frontier, moves = tree.frontier, tree.search.moves
        made = int(frontier.counts[NODES])
        open_ = set(frontier.heap[: int(frontier.counts[OPEN])].tolist())
        for node in range(made):
            parent, move = (int(each) for each in frontier.links[node])
            if parent >= 0:
                begin = frontier.nodes[parent]
                straight = np.linspace(begin[:2], frontier.nodes[node, :2], _POINTS)
                arcs.append(straight if move < 0 else _arc(begin, moves.curvatures[move], moves.length))
        for node in [each for each in range(made) if each not in open_][: MOST_NODES // len(trees)]:
            at = frontier.nodes[node]
            # Behind a gate the snake is straight.
            before = max(int(frontier.links[node, 1]), -1)
            way = (*at[:3], before if before >= 0 else int(moves.turns[0, 1]), *at[5:8])
            for move in moves.arcs:
                if not one_arc(way, move, moves.length, moves, tree.search.around)[0]:
                    arc = _arc(at, moves.curvatures[move], moves.length)
                    rejected.append(arc)
                    reasons.append(nearest(problem.world, *map(float, arc[-1])))
        gates = np.vstack([gates, tree.search.gates])
    ends = [along(x, y, heading, 0.0, length)[:2] for x, y, heading, length in gates]
    return Explored(
        np.array(arcs).reshape(-1, _POINTS, 2),
        np.stack([gates[:, :2], np.array(ends).reshape(-1, 2)], axis=1),
        np.array(rejected).reshape(-1, _POINTS, 2),
        tuple(reasons),
        sum(int(tree.frontier.counts[NODES]) for tree in trees),
    )


def _arc(pose: np.ndarray, curvature: float, length: float) -> np.ndarray:
    return np.array([along(*pose[:3], curvature, s)[:2] for s in np.linspace(0.0, length, _POINTS)])
