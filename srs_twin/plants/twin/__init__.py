"""The MuJoCo twin: model, physics, contacts and batches of twins."""

import os

# Simulation needs no display, but MuJoCo would search for one. Code that renders sets
# the variable before this import.
os.environ.setdefault("MUJOCO_GL", "disabled")
