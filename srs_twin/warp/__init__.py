"""GPU simulation of twins in MuJoCo Warp, with the physical laws of the CPU twins."""

import warp

# Otherwise, Warp prints a greeting and the name of each kernel.
warp.config.log_level = warp.LOG_ERROR
