"""Compiled kernels, array checks, threads, worker processes and object claims."""
