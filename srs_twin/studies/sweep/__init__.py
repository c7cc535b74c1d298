"""Sweeps: runs of a scenario over many values of its fields, stored row by row so that they can resume."""

from srs_twin.extensions import lazy

__getattr__ = lazy(
    {
        "load_sweep": "srs_twin.studies.sweep.loading:load_sweep",
        "open_sweep": "srs_twin.studies.sweep.execution:open_sweep",
    }
)
