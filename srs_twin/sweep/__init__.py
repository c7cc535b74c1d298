"""Sweeps: one scenario over many values of its fields, rows that survive whatever happens to the process."""

from srs_twin.sweep.execution import OpenSweep, open_sweep
from srs_twin.sweep.loading import load_sweep
from srs_twin.sweep.points import Experiment, Point, Sweep
from srs_twin.sweep.report import Summary

__all__ = ["Experiment", "OpenSweep", "Point", "Summary", "Sweep", "load_sweep", "open_sweep"]
