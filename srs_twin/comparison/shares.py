"""Attribution: which assumption has which share in what lies between two runs."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from srs_twin.comparison.compare import compare
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.trajectory import Trajectory

MEASURES = {
    "com_speed_m_s": ("CoM speed", "m/s"),
    "yaw_rate_rad_s": ("yaw rate", "rad/s"),
    "mean_bend_amplitude_rad": ("bend amplitude", "rad"),
    "shape_rms_m": ("body shape, RMS", "m"),
}
"""What is attributed: differences twin − analytical of three metrics, and the distance of the body shapes."""


@dataclass(frozen=True)
class Share:
    """What one assumption contributes to the gap.

    Attributes:
        name: short name.
        title: one line for people.
        value: contribution to each of `MEASURES`, in that order.
        low: least of it over the orders in which the assumptions may be switched.
        high: most of it.
        how: "averaged" over orders on the analytical side, "first" of all there, or "refined" on the plant
            that alone has it.
    """

    name: str
    title: str
    value: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    how: str


@dataclass(frozen=True)
class Attribution:
    """A gap between twin and analytical model, split.

    Attributes:
        reference: the analytical values of `MEASURES`; 0 for the distance.
        gap: twin − analytical.
        shares: what is explained; their values and the remainder add up to the gap.
        remainder: what is not explained by any of them.
        matched: gap that is left when both plants have stiff bends and the same friction at the same points.
        same: assumptions on which the two plants agree in this scenario, so that they explain nothing.
    """

    reference: tuple[float, ...]
    gap: tuple[float, ...]
    shares: tuple[Share, ...]
    remainder: tuple[float, ...]
    matched: tuple[float, ...]
    same: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Return plain data for metrics.json, measures by name."""
        parts = asdict(self)
        return {
            "measures": list(MEASURES),
            **{name: list(parts[name]) for name in ("reference", "gap", "remainder", "matched", "same")},
            "shares": [
                {k: list(v) if isinstance(v, tuple) else v for k, v in s.items()} for s in parts["shares"]
            ],
        }


def gap_between(reference: Trajectory, candidate: Trajectory) -> np.ndarray:
    """Return candidate − reference in `MEASURES`, shape (4,).

    Raises:
        InputError: as in `compare`.
        ValueError: one of the runs has no gait metrics.
    """
    ours, theirs = plant_metrics(reference), plant_metrics(candidate)
    names = list(MEASURES)[:-1]
    if any(run[name] is None for run in (ours, theirs) for name in names):
        raise ValueError("a run without whole gait periods has no gait to explain")
    differences = [theirs[name] - ours[name] for name in names]
    return np.array([*differences, compare(reference, candidate).metrics["shape_rms_m"]])
