"""Free bends of a gait, from the chambers alone."""

from __future__ import annotations

import copy

import numpy as np

from srs_twin import AnalyticalSnake, Gait, TwinSnake
from srs_twin.pneumatics import Trace


def free_bends(
    plant: AnalyticalSnake | TwinSnake, gait: Gait, times: np.ndarray
) -> Trace:
    """Return the trace of a plant's chambers in a gait from rest, at some times (s)."""
    gait = copy.copy(gait)
    chambers = copy.deepcopy(plant.pneumatics)
    gait.reset(plant.spec, plant.tick)
    chambers.reset()
    return chambers.advance(gait.script(float(times[-1])), np.asarray(times))
