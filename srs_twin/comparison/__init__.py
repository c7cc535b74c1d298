"""Metrics of single runs and comparisons of two runs."""
