"""Comparison of the dissertation's claims with the results of both plants."""
