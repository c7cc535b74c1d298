"""What a planner is asked, how hard it tries, and what it answers."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from srs_twin.errors import InputError
from srs_twin.planning.arcs import Primitives, along
from srs_twin.planning.footprint import Footprint
from srs_twin.robot.world import Goal, Pose, World

if TYPE_CHECKING:
    pass

_MOST_LEVELS = 5


@dataclass(frozen=True)
class Settings:
    """How hard to try.

    Attributes:
        nodes: how many may be expanded in all.
        seconds: wall time, looked at after 16,000 nodes at the latest; None: no limit. Only without it the
            same problem has the same answer on every machine.
        weight: of the bound; 1: shortest path first; above 1: fewer nodes, paths up to so many times longer.
        levels: how many resolutions to try, each with half the last one's arcs and cells; 1 to 5.
        smooth: shorten the path afterwards.
        clearance_weight: extra cost of a metre of way that touches something, m; it falls by e for each
            width of the straight body that is between. Above 0 wider bodies are planned for as well.
        keep: the trees of the search, to be shown.
        improve: do not stop at the first plan: look at finer levels for shorter ones while the budget lasts.
    """

    nodes: int = 200_000
    seconds: float | None = None
    weight: float = 1.0
    levels: int = 4
    smooth: bool = True
    improve: bool = False
    clearance_weight: float = 0.0
    keep: bool = False

    def __post_init__(self) -> None:
        if self.nodes < 1 or self.levels < 1 or not (1 <= self.weight < math.inf):
            given = f"nodes {self.nodes}, levels {self.levels}, weight {self.weight:g}"
            raise InputError(f"planner: {given}: all must be 1 at least")
        if not 0 <= self.clearance_weight < math.inf:
            raise InputError(f"planner: clearance_weight {self.clearance_weight:g} must not be below 0")
        if self.levels > _MOST_LEVELS:
            raise InputError(f"planner: levels {self.levels}, {_MOST_LEVELS} at most")
        if self.seconds is not None and not self.seconds > 0:
            raise InputError(f"planner: seconds {self.seconds:g} must be above 0")


# What stays below is rounding, m and rad.


@dataclass(frozen=True)
class Problem:
    """From where to where, among what, with which body.

    Attributes:
        start: the snake lies there straight.
        goal: where it is to arrive.
        world: obstacles and bounds.
        footprint: what the body sweeps, and how tightly it turns.
        primitives: arcs to plan with; None: `best_first` chooses its own. `greedy` needs them.
    """

    start: Pose
    goal: Goal
    world: World
    footprint: Footprint
    primitives: Primitives | None = None


class Outcome(StrEnum):
    """How planning ended; `Plan.reason` says why.

    FOUND: a free path. UNREACHABLE: there is none; the reason says whether that is proven of every path or of
    the poses that were tried. BUDGET_SPENT: neither is known. STUCK: `greedy` stood where every arc is
    blocked.
    """

    FOUND = "found"
    UNREACHABLE = "unreachable"
    BUDGET_SPENT = "budget_spent"
    STUCK = "stuck"


@dataclass(frozen=True)
class Segment:
    """An arc of a plan.

    Attributes:
        start: of the centre of mass.
        curvature: left positive, 1/m.
        length: m.
        offset: of the gait that drives it.
        speed: m/s.
    """

    start: Pose
    curvature: float
    length: float
    offset: float
    speed: float

    def pose(self, length: float) -> Pose:
        """Return the pose after a length (m)."""
        return Pose(*map(float, along(*self.start, self.curvature, length)))

    @property
    def end(self) -> Pose:
        """Where the next one begins."""
        return self.pose(self.length)


def segment(start: Pose, curvature: float, length: float, footprint: Footprint) -> Segment:
    """Return an arc with the offset and the speed that the footprint has for its curvature."""
    row = footprint.at(curvature)
    return Segment(start, curvature, length, row.offset, row.speed)


def path_of(start: Pose, pieces: list[tuple[float, float]], footprint: Footprint) -> tuple[Segment, ...]:
    """Return (curvature, length) pieces laid end to end; neighbours of one curvature become one segment."""
    merged: list[list[float]] = []
    for curvature, length in pieces:
        if length <= 0:
            continue
        if merged and math.isclose(merged[-1][0], curvature, abs_tol=1e-12):
            merged[-1][1] += length
        else:
            merged.append([curvature, length])
    segments: list[Segment] = []
    for curvature, length in merged:
        segments.append(segment(start, curvature, length, footprint))
        start = segments[-1].end
    return tuple(segments)
