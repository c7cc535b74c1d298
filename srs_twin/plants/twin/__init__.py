"""Twin of the snake in MuJoCo."""

import os

# Without this environment variable, MuJoCo searches for a display, which simulations do
# not need. Modules that render images set the variable before they import this package.
os.environ.setdefault("MUJOCO_GL", "disabled")
