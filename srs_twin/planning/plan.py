"""Result of a planner: a path, or why there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np

from srs_twin.planning.free_space import least_length
from srs_twin.planning.problem import Outcome, Problem, Segment
from srs_twin.planning.tree import Tree
from srs_twin.robot.world import Pose
from srs_twin.trajectory import Shown

_ROUNDING = 1e-6


@dataclass(frozen=True)
class Plan(Shown):
    """A planner's answer; equal for equal problems, whatever the machine.

    Attributes:
        outcome: how it ended.
        reason: the same in words, with the remedy.
        segments: the path; empty unless found.
        expanded: nodes whose children were looked at.
        cell: size of the finest cells of poses looked at, one node in each, (m, rad); None where none were:
            `greedy`, `ompl`, and a proof of every path.
        seconds: wall time; not compared.
        problem: what was asked.
        trees: of the last search, for `explored`; empty where none was kept (`Settings.keep`).
    """

    page: ClassVar[str] = "plan"

    outcome: Outcome
    reason: str
    segments: tuple[Segment, ...] = ()
    expanded: int = 0
    cell: tuple[float, float] | None = None
    seconds: float = field(default=0.0, compare=False)
    problem: Problem | None = field(default=None, compare=False, repr=False)
    trees: tuple[Tree, ...] = field(default=(), compare=False, repr=False)

    @cached_property
    def least_length(self) -> float:
        """Length that no path of this body is shorter than, by obstacles and bounds but not by turns, m."""
        assert self.problem is not None, "a planner's answer"
        asked = self.problem
        return least_length(asked.start, asked.goal, asked.world, asked.footprint.narrowest)

    @property
    def found(self) -> bool:
        """Whether there is a path."""
        return self.outcome is Outcome.FOUND

    @property
    def proven(self) -> bool:
        """Whether it is certain that there is no path, however finely one looks."""
        return self.outcome is Outcome.UNREACHABLE and self.cell is None

    @property
    def length(self) -> float:
        """Of the path, m."""
        return math.fsum(s.length for s in self.segments)

    @property
    def duration(self) -> float:
        """Of the path at the footprint's speeds, s."""
        return math.fsum(s.length / s.speed for s in self.segments)

    @property
    def end(self) -> Pose | None:
        """Where the path ends."""
        return self.segments[-1].end if self.segments else None

    @property
    def kink(self) -> float:
        """Largest jump of the heading between segments, rad; 0 but for `greedy`'s joint."""
        pairs = zip(self.segments, self.segments[1:], strict=False)
        jumps = (abs(math.remainder(b.start.heading - a.end.heading, 2 * math.pi)) for a, b in pairs)
        largest = max(jumps, default=0.0)
        return largest if largest > _ROUNDING else 0.0

    def samples(self, spacing: float = 0.01) -> np.ndarray:
        """Return poses (x, y, heading) along the path, so far apart at most, m; shape (n, 3)."""
        rows = []
        for each in self.segments:
            pieces = max(1, math.ceil(each.length / spacing))
            rows += [(*each.pose(each.length * k / pieces),) for k in range(pieces)]
        if self.end:
            rows.append((*self.end,))
        return np.array(rows, dtype=float).reshape(-1, 3)
