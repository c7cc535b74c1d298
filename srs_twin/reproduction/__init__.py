"""Comparison of claims in the dissertation with simulations of both plants."""
