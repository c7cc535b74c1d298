"""Twins on an accelerator: MuJoCo Warp steps them, the laws are those of the processor."""

import warp

warp.config.log_level = warp.LOG_ERROR  # it would greet, and name each kernel, on the standard output
