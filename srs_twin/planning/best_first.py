"""Best-first search from the start and from the goal at increasing resolution.

The search grows a tree from the start. If the footprint has no transients, the search
also grows a tree from the goal. If no tree succeeds in the first round, the planner
tries to prove that no path exists. It then grows another tree with the heuristic from
`guidance`. Finally, parts of the path are replaced by shorter Dubins paths.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from functools import cached_property
from itertools import count
from typing import NamedTuple

import numpy as np

from srs_twin.planning.arcs import ArcSequence, Primitives
from srs_twin.planning.collision import Checker
from srs_twin.planning.free_space import is_disconnected
from srs_twin.planning.guidance import (
    NO_HEURISTIC,
    NO_PASSAGES,
    GridHeuristic,
    find_passages,
    grid_heuristic,
)
from srs_twin.planning.path import Segment, path_from_arcs
from srs_twin.planning.primitives import (
    MotionPrimitives,
    make_motion_primitives,
    shorten_path,
)
from srs_twin.planning.problem import Plan, PlanOutcome, Problem, Settings
from srs_twin.planning.search_kernels import SearchSpec
from srs_twin.planning.search_tree import (
    SearchTree,
    goal_poses,
    make_target,
    turned_around,
)
from srs_twin.robot.world import Goal

_CURVATURES = 5
"""Number of curvatures at the coarsest level."""
_COARSEST_TURN = 0.5
"""Maximum turn of an arc at the coarsest level, rad."""
_CELL_FRACTION = 0.35
"""Side of a cell divided by the length of an arc.

With this ratio the children of a node lie in different cells.
"""
_SECTORS = 48
"""Number of heading sectors at the coarsest level.

The width of a sector is half the minimum heading change of an arc.
"""
_GUIDED_WEIGHT = 1.5
"""Weight of the cost-to-go in a search with guidance.

A large weight makes the search find a path quickly, but the path may be longer than
necessary.
"""
_FIRST_TURN_NODES = 1000
"""Number of nodes that each tree expands in the first rounds before the next tree
continues. The number doubles in later rounds.
"""
_MAX_TURN_NODES = 16_000
"""Maximum number of nodes that a tree expands without a check of the time limit."""


class _LevelResult(NamedTuple):
    """Result of the search at one resolution.

    `reason` explains why no path was found. `proven` is true if it was proven that no
    path exists at any resolution.
    """

    path: ArcSequence | None = None
    reason: str = ""
    proven: bool = False


def best_first(problem: Problem, settings: Settings) -> Plan:
    """Plan a path by best-first search, as described in `planner.plan`."""
    search = _Search(problem, settings)
    best: tuple[Segment, ...] | None = None
    for level in range(settings.levels):
        trees = search.start_trees(level)
        spec = trees[0].spec
        result = search.search_level(trees, _path_length(best), prove=level == 0)
        if result.path is not None:
            best = search.finish(result.path, spec.primitives)
        if result.proven or search.is_spent:
            break
        if best is not None and not settings.improve:
            break
    expanded = settings.nodes - search.nodes
    if best is not None:
        return Plan(PlanOutcome.FOUND, "a free path", best, expanded)
    if result.proven:
        return Plan(PlanOutcome.PROVEN_IMPOSSIBLE, result.reason, (), expanded)
    resolution = (
        f"at cells of {1000 * spec.cell:.3g} mm and {math.degrees(spec.sector):.3g}"
        " degrees"
    )
    if result.reason:
        reason = (
            f"{result.reason}, {resolution}; finer cells (a larger value of `levels`)"
            " may find a path"
        )
    else:
        reason = (
            f"neither a path nor a proof was found after {expanded} nodes,"
            f" {resolution}; increase `nodes` or `seconds`"
        )
    return Plan(PlanOutcome.NOT_FOUND, reason, (), expanded)


@dataclass
class _Search:
    problem: Problem
    settings: Settings
    nodes: int = field(init=False)
    begun: float = field(default_factory=time.perf_counter)

    def __post_init__(self) -> None:
        self.nodes = self.settings.nodes
        self.checker = Checker(self.problem.world, self.problem.footprint)

    @property
    def is_spent(self) -> bool:
        seconds = self.settings.seconds
        return self.nodes <= 0 or (
            seconds is not None and time.perf_counter() - self.begun > seconds
        )

    def start_trees(self, level: int) -> list[SearchTree]:
        """Return the tree from the start and, without transients, one from the goal.

        Each level halves the lengths of the arcs and cells of the previous level. From
        the third level on, the arcs have more curvatures.
        """
        problem = self.problem
        body = self.problem.footprint
        factor = 2**level
        first = problem.primitives or Primitives(
            _CURVATURES, _COARSEST_TURN, _COARSEST_TURN / min(body.tightest)
        )
        number = first.count if level < 2 else 2 * first.count - 1
        arcs = Primitives(number, first.turn / factor, first.length / factor)
        cell = _CELL_FRACTION * arcs.length
        sector = 2 * math.pi / (_SECTORS * factor)
        target = make_target(problem.goal, body)
        weight = self.settings.weight
        spec = SearchSpec(
            make_motion_primitives(arcs, body),
            target,
            self.checker.grid,
            cell,
            sector,
            weight,
            NO_HEURISTIC,
            NO_PASSAGES,
        )
        trees = [SearchTree([problem.start], spec)]
        # A path with transients is valid only in its direction of travel, so the search
        # cannot start at the goal.
        if not body.transients:
            end = turned_around(problem.start)
            home = make_target(
                Goal(end.x, end.y, end.heading, radius=0.0, heading_tolerance=0.0), body
            )
            roots = [turned_around(pose) for pose in goal_poses(problem.goal, sector)]
            # The tree from the goal has the start as its target and uses the reversed
            # body.
            backward = spec._replace(
                primitives=make_motion_primitives(arcs, body.backward), target=home
            )
            trees.append(SearchTree(roots, backward, backward=True))
        return trees

    def guided_tree(self, spec: SearchSpec) -> SearchTree:
        heuristic, passages = self.guidance
        weight = max(spec.weight, _GUIDED_WEIGHT)
        spec = spec._replace(heuristic=heuristic, weight=weight, passages=passages)
        return SearchTree([self.problem.start], spec)

    @cached_property
    def guidance(self) -> tuple[GridHeuristic, np.ndarray]:
        problem = self.problem
        body = self.problem.footprint
        margin = 4 / min(body.tightest)
        heuristic = grid_heuristic(
            problem.goal, problem.start, problem.world, body.narrowest, margin
        )
        return heuristic, find_passages(problem.world, body)

    def search_level(
        self, trees: list[SearchTree], best: float, *, prove: bool
    ) -> _LevelResult:
        """Search at one resolution, and optionally try to prove that no path exists.

        The trees take turns, and each tree expands more nodes in each round. If no arc
        leads to the goal, the tree from the goal detects this immediately. A guided
        tree is added after the first round, because its path may be longer than
        necessary.
        """
        for turn in count():
            if self.is_spent:
                break
            nodes = min(_FIRST_TURN_NODES * 2 ** max(turn - 1, 0), _MAX_TURN_NODES)
            reason = ""
            for tree in trees:
                before = tree.expanded
                arcs = tree.grow(max(1, min(nodes, self.nodes)), best)
                self.nodes -= tree.expanded - before
                if arcs is not None:
                    return _LevelResult(arcs)
                if tree.exhausted:
                    reason = f"no free arc leads {tree.way} to an untested pose"
                if tree.exhausted or self.is_spent:
                    break
            # The proof takes longer than an easy search, so the search comes first.
            if turn == 0 and prove and (why := self.proof()):
                return _LevelResult(reason=why, proven=True)
            if reason:
                return _LevelResult(reason=reason)
            if turn == 0:
                trees.append(self.guided_tree(trees[0].spec))
        return _LevelResult()

    def proof(self) -> str:
        problem = self.problem
        clearance = problem.footprint.narrowest
        if is_disconnected(problem.start, problem.goal, problem.world, clearance):
            return (
                "no path of any shape exists, because all passages between start and"
                f" goal are narrower than {2 * clearance:g} m, the smallest width of"
                " the footprint; move obstacles, or plan with a narrower footprint"
            )
        return ""

    def finish(
        self, arcs: ArcSequence, primitives: MotionPrimitives
    ) -> tuple[Segment, ...]:
        start = self.problem.start
        body = self.problem.footprint
        path = path_from_arcs(start, arcs, body)
        if not self.settings.smooth:
            return path
        radius = 1 / min(body.tightest)
        shorter = path_from_arcs(
            start,
            shorten_path(start, arcs, primitives, self.checker.grid, radius),
            body,
        )
        # Merging segments changes the transients, so the shortened path is checked
        # again.
        is_better = _path_length(shorter) < _path_length(
            path
        ) and self.checker.is_path_free(shorter)
        if is_better:
            return shorter
        return path


def _path_length(path: tuple[Segment, ...] | None) -> float:
    if path is None:
        return math.inf
    return math.fsum(s.length for s in path)
