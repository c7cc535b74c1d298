"""The default planner: best-first search from both ends, coarse first, with a budget and a named outcome."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

from srs_twin.planning.collision import Checker
from srs_twin.planning.plan import Outcome, Plan, Problem, Segment, path_of
from srs_twin.planning.primitives import Primitives
from srs_twin.planning.settings import Settings
from srs_twin.planning.smoothing import shortened
from srs_twin.planning.tree import (
    Pieces, Resolution, Tree, arrivals, moves_of, reversed_moves, target_of, turned,
)  # fmt: skip
from srs_twin.planning.unreachable import disconnected
from srs_twin.world import Goal, Pose

_COARSEST_TURN = 0.5
_COUNT = 5
_CELL = 0.35
_SECTORS = 48
_SHARE = 1000


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


def best_first(problem: Problem, settings: Settings) -> Plan:
    """Plan; see `planning.plan`."""
    checker, budget = Checker(problem.world, problem.footprint), _Budget(settings.nodes, settings.seconds)
    narrowest = problem.footprint.narrowest
    if disconnected(problem.start, problem.goal, problem.world, narrowest):
        reason = (
            f"no path of any shape: start and goal are apart by gaps narrower than {2 * narrowest:g} m, "
            "the footprint's least; move obstacles, or plan with a narrower footprint"
        )
        return Plan(Outcome.UNREACHABLE, reason)
    best: tuple[Segment, ...] = ()
    reached, resolution = "", None
    for resolution in _resolutions(problem, settings.levels):
        found = _at(resolution, problem, settings, checker, budget, _length(best))
        if isinstance(found, str):
            reached = found
        else:
            best = _smoothed(found, problem, checker) if settings.smooth else found
            reached = "found"
        if budget.spent or (best and not settings.improve):
            break
    assert resolution is not None, "there is a level"
    expanded, cell = settings.nodes - budget.nodes, (resolution.cell, resolution.sector)
    if best:
        return Plan(Outcome.FOUND, "a free path", best, expanded, cell)
    words = f"cells of {1000 * cell[0]:.3g} mm and {math.degrees(cell[1]):.3g} degrees"
    if reached:
        reason = f"{reached}, at {words}; finer ones (levels) may still find a way"
        return Plan(Outcome.UNREACHABLE, reason, (), expanded, cell)
    reason = f"neither a path nor a proof after {expanded} nodes, at {words}; give more nodes or seconds"
    return Plan(Outcome.BUDGET_SPENT, reason, (), expanded, cell)


def _resolutions(problem: Problem, levels: int) -> Iterator[Resolution]:
    """Yield finer and finer ones: arcs and cells halve, curvatures double; given primitives come first."""
    right, left = problem.footprint.tightest
    first = problem.primitives or Primitives(_COUNT, _COARSEST_TURN, _COARSEST_TURN / min(right, left))
    for level in range(levels):
        part = 2**level
        count = first.count if level < 2 else 2 * first.count - 1
        arcs = Primitives(count, first.turn / part, first.length / part)
        yield Resolution(arcs, _CELL * arcs.length, 2 * math.pi / (_SECTORS * part))


def _at(
    resolution: Resolution, problem: Problem, settings: Settings, checker: Checker, budget: _Budget, best: float
) -> tuple[Segment, ...] | str:  # fmt: skip
    """Search at one resolution; return a path, why there is none, or "" where the budget ended it.

    The trees take turns with growing shares. The one from the goal rarely is the first to find a path; it is
    there for goals that nothing leads to, which it knows at once, and the other tree after all cells.
    """
    trees = _trees(resolution, problem, settings, checker)
    share = _SHARE
    while not budget.spent:
        for backward, tree in enumerate(trees):
            before = tree.expanded
            found = tree.grow(max(1, min(share, budget.nodes)), best)
            budget.nodes -= tree.expanded - before
            if found:
                return _path(found, problem, backward=bool(backward))
            if tree.exhausted:
                return f"no free arc leads on {'back from the goal' if backward else 'from the start'} to an untried pose"
            if budget.spent:
                break
        share *= 2
    return ""


def _trees(resolution: Resolution, problem: Problem, settings: Settings, checker: Checker) -> list[Tree]:
    """Return the tree from the start, and that from the goal unless transients make paths one-way."""
    body, around, start = problem.footprint, checker.surroundings, problem.start
    moves = moves_of(resolution.primitives, body)
    trees = [Tree([start], moves, target_of(problem.goal, body), around, resolution, settings.weight)]
    if not body.transients:
        back = turned(start)
        home = target_of(Goal(back.x, back.y, back.heading, radius=0.0, heading_tolerance=0.0), body)
        roots = [turned(pose) for pose in arrivals(problem.goal, resolution.sector)]
        trees.append(Tree(roots, reversed_moves(moves), home, around, resolution, settings.weight))
    return trees


def _path(found: tuple[Pose, Pieces], problem: Problem, *, backward: bool) -> tuple[Segment, ...]:
    pieces = found[1]
    if backward:
        pieces = [(-curvature, length) for curvature, length in reversed(pieces)]
    return path_of(problem.start, pieces, problem.footprint)


def _smoothed(path: tuple[Segment, ...], problem: Problem, checker: Checker) -> tuple[Segment, ...]:
    shorter = shortened(path, problem.footprint, checker)
    # Transients hang on what came before; a path that is no longer free with them is not taken.
    return shorter if checker.free_path(shorter) else path


def _length(path: tuple[Segment, ...]) -> float:
    return math.fsum(s.length for s in path) if path else math.inf
