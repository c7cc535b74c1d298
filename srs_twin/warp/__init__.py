"""Twins on a GPU, simulated by MuJoCo Warp with the laws that the CPU twins use."""

import warp

warp.config.log_level = (
    warp.LOG_ERROR
)  # Warp would print a greeting and the name of each kernel to stdout
