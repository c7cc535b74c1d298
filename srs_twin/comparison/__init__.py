"""Metrics of one trajectory, and the comparison of two."""
