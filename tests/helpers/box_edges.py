r"""Width of the body from the edges of the bounding box at several offsets (Table 8).

The width of the body does not affect its motion. It changes the lateral reach by half
of the change on either side:

$$ e = e_0 + \tfrac12 (w - w_0) $$

Here e is the reach to one side, and e₀ is the reach of a body of width w₀ with the same
motion. One run of the plant with any width is therefore sufficient.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.identification.estimate import FitEstimate, Residual, Role
from srs_twin.identification.fit_file import DataSet, array_hash, assign_roles
from srs_twin.identification.least_squares import least_squares
from srs_twin.identification.parameters import free_parameters
from srs_twin.robot.spec import RobotSpec

WIDTH = "geometry.width_m"
ROUNDING = 0.005
"""Resolution of the edges in Table 8, m."""


@dataclass(frozen=True)
class BoxEdges:
    """Lateral reach in one run.

    Attributes:
        offset: φ, positive to the left.
        measured: reach to the left and to the right, both positive, m.
        drawn: reach of a plant whose body has the width of the robot in the fit, m.
    """

    offset: float
    measured: tuple[float, float]
    drawn: tuple[float, float]

    def of_width(self, change: float) -> tuple[float, float]:
        """Return the reach of a body whose width differs by the given change, m."""
        left, right = self.drawn
        return left + change / 2, right + change / 2

    def data_set(self, role: Role) -> DataSet:
        """Return the record of these data in a fit."""
        return DataSet(
            f"offset {self.offset:g}",
            array_hash(np.array([self.offset, *self.measured])),
            role,
            2,
        )


def fit_width(
    runs: Sequence[BoxEdges], spec: RobotSpec, *, validation: Sequence[BoxEdges] = ()
) -> FitEstimate:
    """Return the width for which the reach of a plant agrees with the measured one.

    Args:
        runs: measured reach and reach of the plant.
        spec: robot with the width used by the plant.
        validation: runs to validate the estimate.

    Raises:
        InputError: there is no run, or a validation run is also fitted.
    """
    roles = assign_roles("box edges", runs, validation)

    def residuals(values: Mapping[str, float]) -> list[Residual]:
        change = values[WIDTH] - spec.geometry.width
        return [
            Residual(
                f"offset {item.offset:g}",
                "m",
                np.subtract(item.measured, item.of_width(change)),
                ROUNDING,
                role,
            )
            for item, role in roles
        ]

    return least_squares(residuals, free_parameters(spec, [WIDTH]))
