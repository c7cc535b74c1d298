"""What a scenario file says of how the way to the goal is found."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from srs_twin.io.validation import Strict
from srs_twin.scenario.fields import quantity, section

_KIND = "How the way is found."

Turn = Annotated[float, Field(ge=-math.pi, le=math.pi)]


class PrimitivesFile(Strict):
    """Arcs of one length to plan with (Section 5.2.1)."""

    count: int = quantity("N, how many; odd", "", 3, 201)
    turn_rad: float = quantity("Largest turn of one", "rad", 0.001, 3.14)
    length_m: float = quantity("Length of each", "m", 0.001, 100.0)


class _PlannerFile(Strict):
    footprint: str = Field(
        title="Footprint", min_length=1, max_length=4096,
        description="What the body sweeps at each offset: a shipped name or the path of a footprint file.",
    )  # fmt: skip
    turn_share: float = quantity(
        "Share of the tightest turns to plan with; the rest is left to the follower", "", 0.05, 1.0, 1.0
    )
    margin_m: float = quantity("Added to both edges of the footprint", "m", 0.0, 10.0, 0.0)


class _FreeFile(_PlannerFile):
    run_up_m: float = quantity(
        "Straight beginning of the path, over which the gait gets going", "m", 0.0, 100.0, 0.0
    )


class _SearchFile(_FreeFile):
    primitives: PrimitivesFile | None = section("Arcs to plan with (default: the planner's own).", None)


class BestFirstFile(_SearchFile):
    """Best-first search, from both sides where that helps."""

    kind: Literal["best_first"] = section(_KIND)
    nodes: int = quantity("How many may be expanded", "", 1, 100_000_000, 200_000)
    seconds: float | None = quantity(
        "Wall time; only without it is a run the same on every machine (default: no limit)",
        "s", 0.001, 3600.0, None,
    )  # fmt: skip
    weight: float = quantity("Of the bound; above 1 faster and longer", "", 1.0, 100.0, 1.0)
    levels: int = quantity("Resolutions to try", "", 1, 5, 4)
    smooth: bool = section("Shorten the path afterwards.", True)
    shape_changes: bool = section(
        "Plan the way that changes of offset take, as the footprint has it measured, not jumps of curvature.",
        False,
    )
    improve: bool = section("Go on to finer levels for shorter paths while the budget lasts.", False)


class GreedyFile(_FreeFile):
    """The text's search: the best child of either side in turn, for good."""

    kind: Literal["greedy"] = section(_KIND)
    primitives: PrimitivesFile = section(
        "Arcs to plan with (default: Section 5.2's: 21, turns of 60 degrees at most, 0.2 m).",
        PrimitivesFile(count=21, turn_rad=math.pi / 3, length_m=0.2),
    )


class OmplFile(_FreeFile):
    """RRT-Connect of the Open Motion Planning Library (extra ompl)."""

    kind: Literal["ompl"] = section(_KIND)
    seconds: float = quantity("Wall time", "s", 0.001, 3600.0, 1.0)


class GivenFile(_PlannerFile):
    """A path that is given, as in Fig. 56; obstacles are not looked at."""

    kind: Literal["given"] = section(_KIND)
    turns_rad: Annotated[list[Turn], Field(min_length=1, max_length=1000)] = section(
        "Turn of each step, positive to the left, rad, -3.14159 to 3.14159."
    )
    step_m: float = quantity("Length of each step", "m", 0.001, 100.0)


PLANNER_FILES: dict[str, type[_PlannerFile]] = {
    "best_first": BestFirstFile, "greedy": GreedyFile, "ompl": OmplFile, "given": GivenFile,
}  # fmt: skip
"""Kind → keys that a planner of this kind has."""

PlannerFile = Annotated[BestFirstFile | GreedyFile | OmplFile | GivenFile, Field(discriminator="kind")]
