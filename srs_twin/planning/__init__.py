"""Planning: from start to goal among obstacles with the floor that the body sweeps (Section 5.2).

`plan(problem)` → `Plan`. footprint → primitives → search; geometry in `arcs`, `dubins`, `collision`.
"""

from srs_twin.planning.arcs import Primitives as Primitives
from srs_twin.planning.footprint import Footprint as Footprint
from srs_twin.planning.footprint import load_footprint as load_footprint
from srs_twin.planning.plan import Plan as Plan
from srs_twin.planning.planner import plan as plan
from srs_twin.planning.problem import Outcome as Outcome
from srs_twin.planning.problem import Problem as Problem
from srs_twin.planning.problem import Segment as Segment
from srs_twin.planning.problem import Settings as Settings
