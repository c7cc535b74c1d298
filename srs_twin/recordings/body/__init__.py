"""Reconstruction of the body shape from motion capture markers."""
