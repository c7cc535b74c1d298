"""Recordings of runs in Rerun's format, and the Rerun viewer."""
