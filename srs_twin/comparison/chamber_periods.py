"""ChamberPeriods: a run under iterative learning, cut into the periods of each chamber's own clock."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.sampling import label, positive_number
from srs_twin.errors import InputError
from srs_twin.trajectory import Trajectory

_ROUNDING = 1e-6  # of a period


@dataclass(frozen=True)
class ChamberPeriods:
    """What each chamber did in its own periods, of which the run holds K in whole.

    Attributes:
        amplitude: furthest sensed bend to the chamber's side, shape (K, segments, 2), rad; NaN where
            nothing was read.
        target: at the end of the period, same shape, rad; NaN where there is none.
        duty: same shape.
    """

    amplitude: np.ndarray
    target: np.ndarray
    duty: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """Target less amplitude, shape (K, segments, 2), rad."""
        return self.target - self.amplitude

    @classmethod
    def of(cls, trajectory: Trajectory) -> ChamberPeriods:
        """Cut a run into the periods of its chambers.

        Raises:
            InputError: the metadata do not say when chambers begin to fill, or how often.
        """
        sensed = trajectory.stack("sensed")
        period, begins = _clocks(trajectory, sensed.shape[-1])
        time = trajectory.time
        whole = int(math.floor(((time[-1] - begins) / period).min() + _ROUNDING))
        shape = (max(whole, 0), sensed.shape[-1], 2)
        found = cls(np.full(shape, math.nan), np.full(shape, math.nan), np.full(shape, math.nan))
        for side, name in enumerate(("plus", "minus")):
            target, duty = trajectory.stack(f"target_{name}"), trajectory.stack(f"duty_{name}")
            for j in range(shape[1]):
                away = sensed[:, j] if side == 0 else -sensed[:, j]
                edges = begins[j, side] + period * (np.arange(shape[0] + 1) - _ROUNDING)
                cuts = np.searchsorted(time, edges)
                for n, (first, end) in enumerate(zip(cuts[:-1], cuts[1:], strict=True)):
                    good = away[first:end][np.isfinite(away[first:end])]
                    found.amplitude[n, j, side] = good.max() if len(good) else math.nan
                    # A sample shows what its tick was given: the last one of a period is still its own.
                    found.target[n, j, side] = target[end - 1, j]
                    found.duty[n, j, side] = duty[(first + end) // 2, j]
        return found


def _clocks(trajectory: Trajectory, segments: int) -> tuple[float, np.ndarray]:
    """Return the gait period (s) and when each chamber first fills, shape (segments, 2), s."""
    frequency = positive_number(trajectory, "gait_frequency_hz")
    told = (trajectory.metadata.get("control") or {}).get("fill_begins_s")
    begins = np.array(told, dtype=float) if isinstance(told, list) else np.empty(0)
    if frequency is None or begins.shape != (segments, 2) or not np.isfinite(begins).all():
        raise InputError(
            f"{label(trajectory)}: metadata gait_frequency_hz and control.fill_begins_s are needed to tell "
            "the periods of the chambers"
        )
    return 1 / frequency, begins
