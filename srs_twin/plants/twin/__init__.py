"""The MuJoCo twin: model, physics, contacts and batches of twins."""

import os

# Simulation needs no display, but MuJoCo would search for one. Rendering sets the
# variable earlier.
os.environ.setdefault("MUJOCO_GL", "disabled")
