"""Rerun recordings of runs, and the Rerun viewer."""
