"""How far a plant is from what was measured of the robot: by signal, over time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin.comparison.compare import Comparison, compare
from srs_twin.comparison.metrics import MEASURED_UNITS
from srs_twin.comparison.sampling import rms
from srs_twin.trajectory import Trajectory

_PREFIX = "measured_"
_OF_BENDS = "measured_bend_rms_rad"
_OF_A_WAY = ("measured_com_speed_rel", "measured_yaw_rate_abs")
_MOST_ROWS = 50


@dataclass(frozen=True)
class MeasuredDifference:
    """A plant's difference from a measured motion.

    Attributes:
        comparison: plant less measured, see `compare`.
        only_bends: whether nothing but bends was measured; where the body is follows from them then.
        held: whether both were held at the head, so that nothing went anywhere.
    """

    comparison: Comparison
    only_bends: bool = False
    held: bool = False

    @classmethod
    def of(cls, measured: Trajectory, run: Trajectory) -> MeasuredDifference:
        """Compare a plant with what was measured, at the times of the latter.

        Raises:
            InputError: as `compare`.
        """
        only_bends = bool(measured.metadata.get("bends_only"))
        return cls(compare(measured, run), only_bends, run.metadata.get("base") == "clamped")

    @property
    def metrics(self) -> dict[str, float | None]:
        """Metrics of the plant, by the names in `MEASURED_UNITS`; None what was not measured."""
        told = {_OF_BENDS} if self.only_bends else MEASURED_UNITS.keys() - (_OF_A_WAY if self.held else ())
        metrics = self.comparison.metrics
        return {
            name: metrics[name.removeprefix(_PREFIX)] if name in told else None for name in MEASURED_UNITS
        }

    def signals(self) -> dict[str, np.ndarray]:
        """Return the differences over time: shape and path as distances (m), heading, bends (rad)."""
        bends = {f"bend_{j}_rad": each for j, each in enumerate(self.comparison.bend_error.T, start=1)}
        if self.only_bends:
            return bends
        distances = {"shape_m": self.comparison.shape_error, "path_m": self.comparison.path_error}
        return distances | {"heading_rad": self.comparison.heading_error} | bends

    @property
    def bend_rms(self) -> np.ndarray:
        """Root mean square over the segments of the bends' difference at each instant, (T,), rad."""
        return np.asarray(np.sqrt((self.comparison.bend_error**2).mean(axis=1)))

    def document(self) -> dict[str, Any]:
        """Return what metrics.json says: of each signal the RMS as a whole and in equal parts of the time."""
        time = self.comparison.time
        edges = np.linspace(0, len(time), min(_MOST_ROWS, len(time)) + 1).round().astype(int)
        parts = list(zip(edges[:-1], edges[1:], strict=True))
        signals = self.signals()
        return {
            "rms": {name: rms(values) for name, values in signals.items()},
            "over_time": {
                "time_s": [round(float(time[a:b].mean()), 6) for a, b in parts],
                **{name: [rms(values[a:b]) for a, b in parts] for name, values in signals.items()},
            },
        }
