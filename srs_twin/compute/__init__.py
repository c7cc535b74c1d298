"""Compiled kernels, array checks, threads, worker processes, and claims by one thread."""
