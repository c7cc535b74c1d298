"""Twins on an accelerator: MuJoCo Warp steps them, the laws are those of the processor."""
