"""Planning: from start to goal among obstacles with the floor that the body sweeps (Section 5.2).

`plan(problem)` → `Plan`. footprint → primitives → search; geometry in `arcs`, `dubins`, `collision`.
"""
