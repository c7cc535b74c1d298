"""Path planning with footprints, and path-following control (Section 5.2).

The function `planner.plan` computes a `Plan` for a `Problem`. The module `best_first`
searches for a path with exact collision checks. If the first round of the search fails,
the module `free_space` tries to prove that no path exists. The module `guidance` finds
narrow passages and computes a search heuristic that takes obstacles into account. The
modules `follower` and `steering` adjust the gait offset so that a snake follows a plan.
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
