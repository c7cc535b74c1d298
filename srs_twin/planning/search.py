"""The default planner: best-first search from both ends, coarse first, with a budget and a named outcome.

Where obstacles stand so close together that start and goal lie in different rooms, that is proven, and no
path is sought.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count
from typing import Any

from srs_twin.planning.arcs import Primitives
from srs_twin.planning.best_first import Moves, Search
from srs_twin.planning.collision import Checker, Surroundings
from srs_twin.planning.dubins import Pieces
from srs_twin.planning.free_space import disconnected
from srs_twin.planning.gates import NO_GATES, gates_of
from srs_twin.planning.guide import NO_GUIDE, guide_to
from srs_twin.planning.plan import Plan
from srs_twin.planning.pockets import COARSE, FINE, Finely, shut_in
from srs_twin.planning.problem import Outcome, Problem, Segment, Settings, path_of
from srs_twin.planning.shortening import shortened
from srs_twin.planning.tree import Tree, arrivals, moves_of, reversed_moves, target_of, turned
from srs_twin.robot.world import Goal

Cells = tuple[float, float]
"""Side of a cell of poses, m, and its width in heading, rad."""

# The coarsest arcs: five curvatures, turns of 0.5 rad at most; a cell is about a third of an arc and half of
# the smallest change of heading wide, so that a node's children do not fall into one cell.
_COUNT, _COARSEST_TURN = 5, 0.5
_CELL, _SECTORS = 0.35, 48
_GUIDED_WEIGHT = 1.5
_SHARE, _LARGEST_SHARE = 1000, 16_000
"""Nodes of the first turn of each tree, and of the largest; every turn is twice the last."""


@dataclass
class _Budget:
    """What is left of it."""

    nodes: int
    seconds: float | None
    begun: float = field(default_factory=time.perf_counter)

    @property
    def spent(self) -> bool:
        late = self.seconds is not None and time.perf_counter() - self.begun > self.seconds
        return late or self.nodes <= 0


@dataclass(frozen=True)
class _Ended:
    """How the search at one resolution ended.

    Attributes:
        path: a free one, if found.
        why: there is none, in words; empty where the budget ended it.
        final: no finer resolution can find one.
    """

    path: Pieces | None = None
    why: str = ""
    final: bool = False


def best_first(problem: Problem, settings: Settings) -> Plan:
    """Plan; see `planning.plan`."""
    checker, budget = Checker(problem.world, problem.footprint), _Budget(settings.nodes, settings.seconds)
    best: tuple[Segment, ...] | None = None
    for level, (arcs, cells) in enumerate(_resolutions(problem, settings.levels)):
        trees = _trees(arcs, cells, problem, settings, checker.surroundings)
        ended = _search_level(trees, problem, budget, _search_length(best), level == 0)
        if ended.path is not None:
            best = _finished(ended.path, trees[0].search.moves, problem, settings, checker)
        if ended.final or budget.spent or (best is not None and not settings.improve):
            break
    made: dict[str, Any] = {
        "expanded": settings.nodes - budget.nodes,
        "trees": tuple(trees) if settings.keep else (),
    }
    if best is not None:
        return Plan(Outcome.FOUND, "a free path", best, cell=cells, **made)
    if ended.final:
        return Plan(Outcome.UNREACHABLE, ended.why, **made)
    at = f"at cells of {1000 * cells[0]:.3g} mm and {math.degrees(cells[1]):.3g} degrees"
    if ended.why:
        reason = f"{ended.why}, {at}; finer ones (more levels) may still find a way"
        return Plan(Outcome.UNREACHABLE, reason, cell=cells, **made)
    reason = f"neither a path nor a proof after {made['expanded']} nodes, {at}; give more nodes or seconds"
    return Plan(Outcome.BUDGET_SPENT, reason, cell=cells, **made)


def _resolutions(problem: Problem, levels: int) -> Iterator[tuple[Primitives, Cells]]:
    """Yield finer and finer arcs and cells: both halve, at last curvatures double; given arcs come first."""
    both = min(problem.footprint.tightest)
    first = problem.primitives or Primitives(_COUNT, _COARSEST_TURN, _COARSEST_TURN / both)
    for level in range(levels):
        part = 2**level
        count = first.count if level < 2 else 2 * first.count - 1
        arcs = Primitives(count, first.turn / part, first.length / part)
        yield arcs, (_CELL * arcs.length, 2 * math.pi / (_SECTORS * part))


def _search_level(trees: list[Tree], problem: Problem, budget: _Budget, best: float, prove: bool) -> _Ended:
    """Search at one resolution.

    The trees take turns with growing shares. The one from the goal rarely is the first to find a path; it is
    there for goals that nothing leads to, which it knows at once, and the other tree after all cells. What
    they do not find at once is sought with a guide as well: its path may be longer than need be.
    """
    proofs = (COARSE, FINE) if prove else ()
    for turn in count():
        if budget.spent:
            break
        # Easy problems are over before a proof would be: it comes behind the first and the second turn.
        share = min(_SHARE * 2 ** max(turn - 1, 0), _LARGEST_SHARE)
        for tree in trees:
            before = tree.expanded
            found = tree.grow(max(1, min(share, budget.nodes)), best)
            budget.nodes -= tree.expanded - before
            if found is not None:
                # What leads back from the goal leads there with its turns exchanged.
                return _Ended([(-c, length) for c, length in reversed(found)] if tree.backward else found)
            if tree.exhausted and turn >= len(proofs):
                end = "back from the goal" if tree.backward else "on from the start"
                return _Ended(why=f"no free arc leads {end} to a pose not yet tried")
            if tree.exhausted or budget.spent:
                break
        if turn < len(proofs) and (why := _proof(problem, trees[0].search.around, proofs[turn])):
            return _Ended(why=why, final=True)
        if turn == 0:
            trees.append(_guided(trees[0].search, problem))
    return _Ended()


def _proof(problem: Problem, around: Surroundings, how: Finely) -> str:
    """Return why there is no path at all, or nothing where so fine a proof does not say so."""
    start, goal, body = problem.start, problem.goal, problem.footprint
    if how is COARSE and disconnected(start, goal, problem.world, body.narrowest):
        return (
            f"no path of any shape: start and goal are apart by gaps narrower than {2 * body.narrowest:g} m, "
            "the footprint's least width; move obstacles, or plan with a narrower footprint"
        )
    end = shut_in(start, goal, body, around, how)
    if not end:
        return ""
    return (
        f"no path with such turns: where the {end} lies there is no room for one of radius "
        f"{1 / max(body.tightest):.3g} m; turn the {end} round, or plan with tighter turns"
    )


def _trees(
    arcs: Primitives, cells: Cells, problem: Problem, settings: Settings, around: Surroundings
) -> list[Tree]:
    """Return the tree from the start, and that from the goal unless transients make paths one-way."""
    body, start = problem.footprint, problem.start
    moves = moves_of(arcs, body)
    target = target_of(problem.goal, body)
    search = Search(moves, target, around, *cells, settings.weight, NO_GUIDE, NO_GATES)
    trees = [Tree([start], search)]
    if not body.transients:
        end = turned(start)
        home = target_of(Goal(end.x, end.y, end.heading, radius=0.0, heading_tolerance=0.0), body)
        roots = [turned(pose) for pose in arrivals(problem.goal, cells[1])]
        back = search._replace(moves=reversed_moves(moves), target=home)
        trees.append(Tree(roots, back, backward=True))
    return trees


def _guided(search: Search, problem: Problem) -> Tree:
    """Return a tree from the start that follows the guide."""
    body, start = problem.footprint, problem.start
    guide = guide_to(problem.goal, start, problem.world, body.narrowest, 4 / min(body.tightest))
    weight, gates = max(search.weight, _GUIDED_WEIGHT), gates_of(problem.world, body)
    return Tree([start], search._replace(guide=guide, weight=weight, gates=gates))


def _finished(
    found: Pieces, moves: Moves, problem: Problem, settings: Settings, checker: Checker
) -> tuple[Segment, ...]:
    """Return the path as segments, shortened where it is to be."""
    start, body = problem.start, problem.footprint
    path = path_of(start, found, body)
    if settings.smooth:
        radius = 1 / min(body.tightest)
        shorter = path_of(start, shortened(start, found, moves, checker.surroundings, radius), body)
        # Transients hang on what came before; a path that is no longer free with them is not taken.
        if _search_length(shorter) < _search_length(path) and checker.free_path(shorter):
            path = shorter
    return path


def _search_length(path: tuple[Segment, ...] | None) -> float:
    return math.inf if path is None else math.fsum(s.length for s in path)
