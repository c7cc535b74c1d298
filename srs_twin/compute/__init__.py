"""Compiled kernels, checks of arrays, threads and worker processes."""
