"""Reproduction of the dissertation's claims with both plants."""
