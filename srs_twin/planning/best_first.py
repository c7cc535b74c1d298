"""Best-first search for a path, with increasing resolution.

The search grows a tree from the start and, if the footprint has no transients, another
tree from the goal. If the first round finds no path, the search tries to prove that
none exists. If that proof fails, the search adds a tree that the module `guidance`
guides. Finally, shorter Dubins paths replace parts of the path.
"""

from __future__ import annotations

import math
import time
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
"""Number of arc curvatures at the two coarsest levels."""
_COARSEST_TURN = 0.5
"""Maximum turning angle of an arc at the coarsest level, rad."""
_CELL_FRACTION = 0.35
"""Ratio of cell size to arc length, small enough to separate a node's children."""
_SECTORS = 48
"""Number of heading sectors at the coarsest level.

At this level, a sector is about half as wide as the smallest turning angle of an arc.
"""
_GUIDED_WEIGHT = 1.5
"""Minimum weight of the estimated remaining length in a guided search."""
_FIRST_TURN_NODES = 1000
"""Nodes that each tree expands in rounds 1 and 2, doubled in each later round."""
_MAX_TURN_NODES = 16_000
"""Maximum number of nodes that a tree expands between checks of the time limit."""


class _LevelResult(NamedTuple):
    """Result of the search at one resolution.

    Attributes:
        proven: whether the search proved that no path exists at any resolution.
    """

    path: ArcSequence | None = None
    reason: str = ""
    proven: bool = False


def best_first(problem: Problem, settings: Settings) -> Plan:
    """Plan a path by best-first search, within the budget of the settings."""
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


class _Search:
    def __init__(self, problem: Problem, settings: Settings) -> None:
        self.problem = problem
        self.settings = settings
        self.nodes = settings.nodes
        self.begun = time.perf_counter()
        self.checker = Checker(problem.world, problem.footprint)

    @property
    def is_spent(self) -> bool:
        seconds = self.settings.seconds
        return self.nodes <= 0 or (
            seconds is not None and time.perf_counter() - self.begun > seconds
        )

    def start_trees(self, level: int) -> list[SearchTree]:
        """Return a tree from the start and, without transients, one from the goal."""
        problem = self.problem
        body = problem.footprint
        factor = 2**level
        first = problem.primitives or Primitives(
            _CURVATURES, _COARSEST_TURN, _COARSEST_TURN / min(body.tightest)
        )
        number = first.count if level < 2 else 2 * first.count - 1
        arcs = Primitives(number, first.turn / factor, first.length / factor)
        cell = _CELL_FRACTION * arcs.length
        sector = 2 * math.pi / (_SECTORS * factor)
        target = make_target(problem.goal, body)
        spec = SearchSpec(
            make_motion_primitives(arcs, body),
            target,
            self.checker.grid,
            cell,
            sector,
            self.settings.weight,
            NO_HEURISTIC,
            NO_PASSAGES,
        )
        trees = [SearchTree([problem.start], spec)]
        # Transients depend on the direction of travel, so a search with transients
        # cannot start at the goal.
        if not body.transients:
            end = turned_around(problem.start)
            home = make_target(
                Goal(end.x, end.y, end.heading, radius=0.0, heading_tolerance=0.0), body
            )
            roots = [turned_around(pose) for pose in goal_poses(problem.goal, sector)]
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
        body = problem.footprint
        margin = 4 / min(body.tightest)
        heuristic = grid_heuristic(
            problem.goal, problem.start, problem.world, body.narrowest, margin
        )
        return heuristic, find_passages(problem.world, body)

    def search_level(
        self, trees: list[SearchTree], best: float, *, prove: bool
    ) -> _LevelResult:
        """Search at one resolution, and optionally try to prove that no path exists.

        If no arc leads to the goal, the tree from the goal detects this immediately. A
        guided tree is added only after the first round, because its path may be longer
        than necessary.
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
            # The proof comes second, because an easy search takes less time.
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
        is_shorter = _path_length(shorter) < _path_length(path)
        if is_shorter and self.checker.is_path_free(shorter):
            return shorter
        return path


def _path_length(path: tuple[Segment, ...] | None) -> float:
    if path is None:
        return math.inf
    return math.fsum(s.length for s in path)
