"""Metrics of single runs, and comparisons between two runs."""
