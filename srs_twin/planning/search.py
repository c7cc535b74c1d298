"""The default planner: best-first search from both ends, coarse first, with a budget and a named outcome."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial

from srs_twin.planning.collision import Checker, Surroundings
from srs_twin.planning.guide import guide_to
from srs_twin.planning.primitives import Primitives
from srs_twin.planning.problem import Outcome, Plan, Problem, Segment, path_of
from srs_twin.planning.settings import Settings
from srs_twin.planning.smoothing import shortened
from srs_twin.planning.tree import (
    Pieces,
    Resolution,
    Tree,
    arrivals,
    moves_of,
    reversed_moves,
    target_of,
    turned,
)  # fmt: skip
from srs_twin.planning.unreachable import disconnected
from srs_twin.world import Goal

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
    for level, resolution in enumerate(_resolutions(problem, settings.levels)):
        trees = _trees(resolution, problem, settings, checker.surroundings)
        guided = partial(_guided, resolution, problem, settings, checker.surroundings)
        ended = _at(trees, guided, problem, budget, _length(best), prove=level == 0)
        if ended.path is not None:
            best = _finished(ended.path, trees[0], problem, settings, checker)
        if ended.final or budget.spent or (best is not None and not settings.improve):
            break
    expanded, cell = settings.nodes - budget.nodes, (resolution.cell, resolution.sector)
    if best is not None:
        return Plan(Outcome.FOUND, "a free path", best, expanded, cell)
    if ended.final:
        return Plan(Outcome.UNREACHABLE, ended.why, (), expanded)
    words = f"cells of {1000 * cell[0]:.3g} mm and {math.degrees(cell[1]):.3g} degrees"
    if ended.why:
        reason = f"{ended.why}, at {words}; finer ones (more levels) may still find a way"
        return Plan(Outcome.UNREACHABLE, reason, (), expanded, cell)
    reason = f"neither a path nor a proof after {expanded} nodes, at {words}; give more nodes or seconds"
    return Plan(Outcome.BUDGET_SPENT, reason, (), expanded, cell)


def _resolutions(problem: Problem, levels: int) -> Iterator[Resolution]:
    """Yield finer and finer ones: arcs and cells halve, at last curvatures double; given arcs come first."""
    both = min(problem.footprint.tightest)
    first = problem.primitives or Primitives(_COUNT, _COARSEST_TURN, _COARSEST_TURN / both)
    for level in range(levels):
        part = 2**level
        count = first.count if level < 2 else 2 * first.count - 1
        arcs = Primitives(count, first.turn / part, first.length / part)
        yield Resolution(arcs, _CELL * arcs.length, 2 * math.pi / (_SECTORS * part))


def _at(
    trees: list[Tree], guided: Callable[[], Tree], problem: Problem, budget: _Budget, best: float, *,
    prove: bool,
) -> _Ended:  # fmt: skip
    """Search at one resolution.

    The trees take turns with growing shares. The one from the goal rarely is the first to find a path; it is
    there for goals that nothing leads to, which it knows at once, and the other tree after all cells. What
    they do not find at once is sought with a guide as well: its path may be longer than need be.
    """
    share = _SHARE
    while not budget.spent:
        for tree in trees:
            before = tree.expanded
            found = tree.grow(max(1, min(share, budget.nodes)), best)
            budget.nodes -= tree.expanded - before
            if found is not None:
                # What leads back from the goal leads there with its turns exchanged.
                return _Ended([(-c, length) for c, length in reversed(found)] if tree.backward else found)
            if tree.exhausted and not prove:
                end = "back from the goal" if tree.backward else "on from the start"
                return _Ended(why=f"no free arc leads {end} to a pose not yet tried")
            if tree.exhausted or budget.spent:
                break
        # Easy problems are over before the proof would be.
        narrowest = problem.footprint.narrowest
        if prove and disconnected(problem.start, problem.goal, problem.world, narrowest):
            why = (
                f"no path of any shape: start and goal are apart by gaps narrower than {2 * narrowest:g} m, "
                "the footprint's least width; move obstacles, or plan with a narrower footprint"
            )
            return _Ended(why=why, final=True)
        if share == _SHARE:
            trees.append(guided())
        prove, share = False, min(2 * share, _LARGEST_SHARE)
    return _Ended()


def _trees(resolution: Resolution, problem: Problem, settings: Settings, around: Surroundings) -> list[Tree]:
    """Return the tree from the start, and that from the goal unless transients make paths one-way."""
    body, start = problem.footprint, problem.start
    moves = moves_of(resolution.primitives, body)
    trees = [Tree([start], moves, target_of(problem.goal, body), around, resolution, settings.weight)]
    if not body.transients:
        back = turned(start)
        home = target_of(Goal(back.x, back.y, back.heading, radius=0.0, heading_tolerance=0.0), body)
        roots = [turned(pose) for pose in arrivals(problem.goal, resolution.sector)]
        trees.append(
            Tree(roots, reversed_moves(moves), home, around, resolution, settings.weight, backward=True)
        )
    return trees


def _guided(resolution: Resolution, problem: Problem, settings: Settings, around: Surroundings) -> Tree:
    """Return a tree from the start that follows the guide."""
    body, goal, start = problem.footprint, problem.goal, problem.start
    guide = guide_to(goal, start, problem.world, body.narrowest, 4 / min(body.tightest))
    moves, weight = moves_of(resolution.primitives, body), max(settings.weight, _GUIDED_WEIGHT)
    return Tree([start], moves, target_of(goal, body), around, resolution, weight, guide=guide)


def _finished(
    found: Pieces, tree: Tree, problem: Problem, settings: Settings, checker: Checker
) -> tuple[Segment, ...]:
    """Return the path as segments, shortened where it is to be."""
    start, body = problem.start, problem.footprint
    path = path_of(start, found, body)
    if settings.smooth:
        radius = 1 / min(body.tightest)
        shorter = path_of(start, shortened(start, found, tree.moves, checker.surroundings, radius), body)
        # Transients hang on what came before; a path that is no longer free with them is not taken.
        path = shorter if _length(shorter) < _length(path) and checker.free_path(shorter) else path
    return path


def _length(path: tuple[Segment, ...] | None) -> float:
    return math.inf if path is None else math.fsum(s.length for s in path)
