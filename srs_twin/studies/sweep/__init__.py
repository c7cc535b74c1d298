"""Sweeps that run a scenario with many values of its fields."""

from typing import TYPE_CHECKING

from srs_twin.extensions import lazy

if TYPE_CHECKING:
    from srs_twin.studies.sweep.execution import open_sweep as open_sweep
    from srs_twin.studies.sweep.loading import load_sweep as load_sweep

lazy(__name__)
