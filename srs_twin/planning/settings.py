"""How hard a planner tries."""

from __future__ import annotations

import math
from dataclasses import dataclass

from srs_twin.errors import InputError

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
        improve: do not stop at the first plan: look at finer levels for shorter ones while the budget lasts.
    """

    nodes: int = 200_000
    seconds: float | None = None
    weight: float = 1.0
    levels: int = 4
    smooth: bool = True
    improve: bool = False

    def __post_init__(self) -> None:
        if self.nodes < 1 or self.levels < 1 or not (1 <= self.weight < math.inf):
            raise InputError(
                f"planner: nodes {self.nodes}, levels {self.levels}, weight {self.weight:g}: "
                "all must be 1 at least"
            )
        if self.levels > _MOST_LEVELS:
            raise InputError(f"planner: levels {self.levels}, {_MOST_LEVELS} at most")
        if self.seconds is not None and not self.seconds > 0:
            raise InputError(f"planner: seconds {self.seconds:g} must be above 0")
