"""Reconstruction of the body shape from markers."""
