"""Reproduction of the dissertation: claims, the runs that they need, and a verdict for each plant."""
