"""Elastica of a uniform heavy rod that is clamped at one end: EI θ'' = −w (L − s) cos θ."""

from __future__ import annotations

import numpy as np
from scipy.integrate import solve_bvp

from srs_twin import RobotSpec
from srs_twin.robot.spec import GRAVITY


def sag(spec: RobotSpec) -> float:
    """Return the sag of the tip of a horizontal robot over its length."""
    rigidity = spec.bending.pitch_stiffness * spec.geometry.segment_length
    number = GRAVITY * spec.mass.total * spec.geometry.body_length**2 / rigidity
    rod = solve_bvp(
        lambda s, y: np.stack([y[1], -number * (1 - s) * np.cos(y[0])]),
        lambda a, b: np.array([a[0], b[1]]),
        np.linspace(0.0, 1.0, 50),
        np.zeros((2, 50)),
    )
    s = np.linspace(0, 1, 400)
    return float(np.trapezoid(np.sin(rod.sol(s)[0]), s))
