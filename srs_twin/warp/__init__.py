"""GPU twins: MuJoCo Warp with the friction and chamber laws of the CPU twins."""

import warp

warp.config.log_level = (
    warp.LOG_ERROR
)  # Warp would print a greeting and the name of each kernel to stdout
