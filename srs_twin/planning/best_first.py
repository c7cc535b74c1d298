"""Default planner: best-first search from both ends at increasing resolution, then shortening of the path.

Cheap searches come first: a tree from the start and, without transients, one from the goal. Proofs of
infeasibility and a tree with guidance (`guidance`) follow only if these do not succeed at once. The path
found is shortened by Dubins paths between its poses.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count
from typing import NamedTuple

from srs_twin.planning.arcs import Primitives
from srs_twin.planning.collision import Checker, ObstacleGrid
from srs_twin.planning.dubins import ArcSequence
from srs_twin.planning.guidance import NO_HEURISTIC, NO_PASSAGES, find_passages, grid_heuristic
from srs_twin.planning.infeasibility import COARSE, FINE, Resolution, is_disconnected, prove_unreachable
from srs_twin.planning.moves import MoveSet, make_move_set, shorten_path
from srs_twin.planning.path import Segment, path_from_arcs
from srs_twin.planning.problem import Outcome, Plan, Problem, Settings
from srs_twin.planning.search_kernels import SearchSpec
from srs_twin.planning.search_tree import SearchTree, goal_poses, make_target, turned_around
from srs_twin.robot.world import Goal


class Cells(NamedTuple):
    """Size of the cells of poses: side, m, and heading width, rad."""

    side: float
    sector: float


_CURVATURES = 5
"""Curvatures at the coarsest level."""
_COARSEST_TURN = 0.5
"""Largest turn of an arc at the coarsest level, rad."""
_CELL_SHARE = 0.35
"""Side of a cell divided by the length of an arc; small enough that the children of a node lie in different
cells."""
_SECTORS = 48
"""Number of heading sectors at the coarsest level; a sector is half of the smallest heading change of an
arc."""
_GUIDED_WEIGHT = 1.5
"""Weight of the cost-to-go with guidance; large, to find some path quickly even if it is longer."""
_FIRST_TURN_NODES = 1000
"""Number of nodes that each tree expands in its first turn; it doubles with every turn."""
_MAX_TURN_NODES = 16_000
"""Largest number of nodes in a turn, so that time limits are checked often enough."""


@dataclass
class _Budget:
    """Remaining nodes and time limit of a search."""

    nodes: int
    seconds: float | None
    begun: float = field(default_factory=time.perf_counter)

    @property
    def spent(self) -> bool:
        expired = self.seconds is not None and time.perf_counter() - self.begun > self.seconds
        return expired or self.nodes <= 0


@dataclass(frozen=True)
class _LevelResult:
    """Result of the search at one resolution.

    Attributes:
        path: collision-free path, if found.
        reason: reason why there is no path; empty if the budget is spent.
        final: whether no finer resolution can find a path.
    """

    path: ArcSequence | None = None
    reason: str = ""
    final: bool = False


def best_first(problem: Problem, settings: Settings) -> Plan:
    """Plan by best-first search; see `planner.plan`."""
    checker, budget = Checker(problem.world, problem.footprint), _Budget(settings.nodes, settings.seconds)
    best: tuple[Segment, ...] | None = None
    for level, (arcs, cells) in enumerate(_resolutions(problem, settings.levels)):
        trees = _start_trees(arcs, cells, problem, settings, checker.grid)
        result = _search_level(trees, problem, budget, _path_length(best), level == 0)
        if result.path is not None:
            best = _finish(result.path, trees[0].spec.moves, problem, settings, checker)
        if result.final or budget.spent or (best is not None and not settings.improve):
            break
    expanded, kept_trees = settings.nodes - budget.nodes, tuple(trees) if settings.keep else ()
    resolution = f"at cells of {1000 * cells.side:.3g} mm and {math.degrees(cells.sector):.3g} degrees"
    outcome, cell = Outcome.UNREACHABLE, (cells.side, cells.sector)
    if best is not None:
        return Plan(Outcome.FOUND, "a free path", best, expanded, cell, trees=kept_trees)
    if result.final:
        # The result has no cell, because the proof does not depend on the resolution.
        return Plan(outcome, result.reason, expanded=expanded, trees=kept_trees)
    if result.reason:
        reason = f"{result.reason}, {resolution}; finer cells (more levels) may find a path"
    else:
        outcome = Outcome.BUDGET_SPENT
        reason = (
            f"neither a path nor a proof after {expanded} nodes, {resolution}; give more nodes or seconds"
        )
    return Plan(outcome, reason, expanded=expanded, cell=cell, trees=kept_trees)


def _resolutions(problem: Problem, levels: int) -> Iterator[tuple[Primitives, Cells]]:
    """Yield primitives and cells of each level, halved each time; later levels have more curvatures.

    The primitives of the problem, if given, are those of the first level.
    """
    both = min(problem.footprint.tightest)
    first = problem.primitives or Primitives(_CURVATURES, _COARSEST_TURN, _COARSEST_TURN / both)
    for level in range(levels):
        factor = 2**level
        number = first.count if level < 2 else 2 * first.count - 1
        arcs = Primitives(number, first.turn / factor, first.length / factor)
        yield arcs, Cells(_CELL_SHARE * arcs.length, 2 * math.pi / (_SECTORS * factor))


def _search_level(
    trees: list[SearchTree], problem: Problem, budget: _Budget, best: float, prove: bool
) -> _LevelResult:
    """Search at one resolution.

    The trees take turns with growing numbers of nodes. The tree from the goal rarely finds a path first. But
    if no arc leads to the goal, it is exhausted at once, while the other tree must first fill all its cells.
    After the first turn, a guided tree joins; its path may be longer than necessary.

    Args:
        trees: trees of the level; the guided tree is appended.
        problem: the problem.
        budget: remaining budget, reduced by the expanded nodes.
        best: length of the best path so far, m.
        prove: whether to try proofs of infeasibility.
    """
    proofs = (COARSE, FINE) if prove else ()
    for turn in count():
        if budget.spent:
            break
        # Proofs take longer than an easy search, so they are tried only after the first and the second turn.
        nodes = min(_FIRST_TURN_NODES * 2 ** max(turn - 1, 0), _MAX_TURN_NODES)
        for tree in trees:
            before = tree.expanded
            arcs = tree.grow(max(1, min(nodes, budget.nodes)), best)
            budget.nodes -= tree.expanded - before
            if arcs is not None:
                # A backward path is reversed; its left turns become right turns.
                return _LevelResult([(-c, length) for c, length in reversed(arcs)] if tree.backward else arcs)
            if tree.exhausted and turn >= len(proofs):
                end = "back from the goal" if tree.backward else "on from the start"
                return _LevelResult(reason=f"no free arc leads {end} to an untested pose")
            if tree.exhausted or budget.spent:
                break
        if turn < len(proofs) and (reason := _infeasible(problem, trees[0].spec.grid, proofs[turn])):
            return _LevelResult(reason=reason, final=True)
        if turn == 0:
            trees.append(_guided_tree(trees[0].spec, problem))
    return _LevelResult()


def _infeasible(problem: Problem, grid: ObstacleGrid, resolution: Resolution) -> str:
    """Return the reason why no path exists; empty without a proof at this resolution."""
    start, goal, body = problem.start, problem.goal, problem.footprint
    if resolution is COARSE and is_disconnected(start, goal, problem.world, body.narrowest):
        return (
            "no path of any shape: all passages between start and goal are narrower than "
            f"{2 * body.narrowest:g} m, the smallest width of the footprint; move obstacles, or plan with a "
            "narrower footprint"
        )
    end = prove_unreachable(start, goal, body, grid, resolution)
    if not end:
        return ""
    return (
        f"no path with turns of radius {1 / max(body.tightest):.3g} m or more: the {end} has too little room "
        f"to turn; reverse the heading of the {end}, or plan with tighter turns"
    )


def _start_trees(
    arcs: Primitives, cells: Cells, problem: Problem, settings: Settings, grid: ObstacleGrid
) -> list[SearchTree]:
    """Return the tree from the start and, for a footprint without transients, the tree from the goal."""
    body, start = problem.footprint, problem.start
    moves = make_move_set(arcs, body)
    # Both trees share moves and obstacles; only the target and the direction differ.
    target = make_target(problem.goal, body)
    spec = SearchSpec(moves, target, grid, *cells, settings.weight, NO_HEURISTIC, NO_PASSAGES)
    trees = [SearchTree([start], spec)]
    # Transients depend on the direction of a path.
    if not body.transients:
        end = turned_around(start)
        home = make_target(Goal(end.x, end.y, end.heading, radius=0.0, heading_tolerance=0.0), body)
        roots = [turned_around(pose) for pose in goal_poses(problem.goal, cells.sector)]
        backward = spec._replace(moves=make_move_set(arcs, body.backward), target=home)
        trees.append(SearchTree(roots, backward, backward=True))
    return trees


def _guided_tree(spec: SearchSpec, problem: Problem) -> SearchTree:
    """Return a tree from the start that uses grid distances and narrow passages."""
    body, start = problem.footprint, problem.start
    heuristic = grid_heuristic(problem.goal, start, problem.world, body.narrowest, 4 / min(body.tightest))
    weight, passages = max(spec.weight, _GUIDED_WEIGHT), find_passages(problem.world, body)
    return SearchTree([start], spec._replace(heuristic=heuristic, weight=weight, passages=passages))


def _finish(
    arcs: ArcSequence, moves: MoveSet, problem: Problem, settings: Settings, checker: Checker
) -> tuple[Segment, ...]:
    """Return the path as segments, shortened if the settings ask for it."""
    start, body = problem.start, problem.footprint
    path = path_from_arcs(start, arcs, body)
    if settings.smooth:
        radius = 1 / min(body.tightest)
        shorter = path_from_arcs(start, shorten_path(start, arcs, moves, checker.grid, radius), body)
        # Merged segments change the transients, so the shortened path is checked again.
        if _path_length(shorter) < _path_length(path) and checker.is_path_free(shorter):
            path = shorter
    return path


def _path_length(path: tuple[Segment, ...] | None) -> float:
    return math.inf if path is None else math.fsum(s.length for s in path)
