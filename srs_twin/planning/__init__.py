"""Planning: from start to goal among obstacles with the floor that the body sweeps (Section 5.2).

`plan(problem)` → `Plan`. footprint → primitives → search; geometry in `arcs`, `dubins`, `collision`.
"""

from srs_twin.extensions import lazy

__getattr__ = lazy(
    {
        "Footprint": "srs_twin.planning.footprint:Footprint",
        "Outcome": "srs_twin.planning.problem:Outcome",
        "Primitives": "srs_twin.planning.arcs:Primitives",
        "Problem": "srs_twin.planning.problem:Problem",
        "Segment": "srs_twin.planning.problem:Segment",
        "Settings": "srs_twin.planning.problem:Settings",
        "load_footprint": "srs_twin.planning.footprint:load_footprint",
    }
)
