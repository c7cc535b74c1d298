"""Path planning with footprints, and following of plans (Section 5.2).

`plan(problem)` returns a `Plan`. The planner searches over arcs (`search_kernels`, `search_tree`,
`best_first`) with exact collision checks of the footprint (`arcs`, `collision`). `infeasibility` proves that
no path exists. `follower` and `steering` follow a plan by the offset of a gait.
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
