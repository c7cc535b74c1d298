"""MuJoCo twin of the snake: model, physics, contacts and batches of twins."""

import os

# Without this variable MuJoCo searches for a display, which simulations do not need.
# Modules that render images set the variable before this import.
os.environ.setdefault("MUJOCO_GL", "disabled")
