"""Path planning with footprints, and following of plans (Section 5.2).

`plan(problem)` returns a `Plan`. The planner searches over arcs and Dubins paths (`moves`, `dubins`) with
exact collision checks of the footprint (`arcs`, `collision`). Trees (`search_kernels`, `search_tree`) grow
from start and goal (`best_first`). If that does not succeed at once, `infeasibility` tries to prove that no
path exists, and `guidance` leads a tree around obstacles and through narrow passages. `follower` and
`steering` follow a plan by the offset of a gait.
"""

from srs_twin.extensions import lazy

__getattr__ = lazy(
    {
        "Footprint": "srs_twin.planning.footprint:Footprint",
        "Outcome": "srs_twin.planning.problem:Outcome",
        "Primitives": "srs_twin.planning.arcs:Primitives",
        "Problem": "srs_twin.planning.problem:Problem",
        "Segment": "srs_twin.planning.path:Segment",
        "Settings": "srs_twin.planning.problem:Settings",
        "load_footprint": "srs_twin.planning.footprint_file:load_footprint",
    }
)
