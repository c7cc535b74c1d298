"""Sweeps: runs of a scenario over many values of its fields, stored row by row so that they can resume."""

from srs_twin.studies.sweep.execution import OpenSweep, open_sweep
from srs_twin.studies.sweep.loading import load_sweep
from srs_twin.studies.sweep.points import Experiment, Point, Sweep
from srs_twin.studies.sweep.report import Summary

__all__ = ["Experiment", "OpenSweep", "Point", "Summary", "Sweep", "load_sweep", "open_sweep"]
