"""Compiled kernels, array checks, threads and worker processes."""
