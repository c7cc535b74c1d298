"""GPU twins, which add the CPU twins' friction and chamber laws to MuJoCo Warp."""

import warp

warp.config.log_level = (
    warp.LOG_ERROR
)  # Warp would print a greeting and the name of each kernel to stdout
