"""Utilities for compiled kernels, arrays, threads and worker processes."""
