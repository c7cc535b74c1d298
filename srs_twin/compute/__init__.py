"""Compiled kernels, array checks, threads, worker processes and claims of objects."""
