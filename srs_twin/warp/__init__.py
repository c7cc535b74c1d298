"""Twins on a GPU, stepped by MuJoCo Warp with the same laws as on the CPU."""

import warp

warp.config.log_level = (
    warp.LOG_ERROR
)  # Warp would print a greeting and the name of each kernel to stdout
