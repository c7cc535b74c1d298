"""Path planning with footprints, and controllers that follow plans (Section 5.2).

`plan(problem)` returns a `Plan`. The module `best_first` grows search trees of arcs and
Dubins paths from the start and from the goal, with exact collision checks. If the first
search does not succeed, `free_space` tries to prove that no path exists. The module
`guidance` computes a heuristic that takes obstacles into account, and entry poses of
narrow passages. The modules `follower` and `steering` make a snake follow a plan by
changing the offset of its gait.
"""

from typing import TYPE_CHECKING

from srs_twin.extensions import lazy

if TYPE_CHECKING:
    from srs_twin.planning.arcs import Primitives as Primitives
    from srs_twin.planning.footprint import Footprint as Footprint
    from srs_twin.planning.footprint_file import load_footprint as load_footprint
    from srs_twin.planning.path import Segment as Segment
    from srs_twin.planning.problem import (
        PlanOutcome as PlanOutcome,
        Problem as Problem,
        Settings as Settings,
    )

lazy(__name__)
