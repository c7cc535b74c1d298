"""Sweeps: one scenario over many values of its fields, rows that survive whatever happens to the process."""

from srs_twin.extensions import lazy

__getattr__ = lazy(
    {
        "load_sweep": "srs_twin.studies.sweep.loading:load_sweep",
        "open_sweep": "srs_twin.studies.sweep.execution:open_sweep",
    }
)
