r"""Box edges: how wide a body is, from how far it reached beside its path at several offsets (Table 8).

The width of the body moves nothing but what the body covers, by half of it on either side:

$$ e = e_0 + \tfrac12 (w - w_0) $$

for the reach e to one side, where a body of width w₀ that moves alike reaches e₀. So a plant has to be run
once, with any width.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.identification.estimate import Estimate, Residual, Role
from srs_twin.identification.fit_file import DataSet, fingerprint, with_roles
from srs_twin.identification.least_squares import least_squares
from srs_twin.identification.unknowns import unknowns
from srs_twin.robot.spec import RobotSpec

WIDTH = "geometry.width_m"
ROUNDING = 0.005
"""To which Table 8 gives edges, m."""


@dataclass(frozen=True)
class BoxEdges:
    """Reach beside the path in one run.

    Attributes:
        offset: φ, positive to the left.
        measured: to the left and to the right, both positive, m.
        drawn: the same of a plant whose body is as wide as the robot of the fit, m.
    """

    offset: float
    measured: tuple[float, float]
    drawn: tuple[float, float]

    def of_width(self, change: float) -> tuple[float, float]:
        """Return what the plant reaches with a body wider by so much, m."""
        left, right = self.drawn
        return left + change / 2, right + change / 2

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""
        return DataSet(
            f"offset {self.offset:g}", fingerprint(np.array([self.offset, *self.measured])), role, 2
        )


def fit_width(runs: Sequence[BoxEdges], spec: RobotSpec, *, validation: Sequence[BoxEdges] = ()) -> Estimate:
    """Return the width with which a plant's boxes are those measured.

    Args:
        runs: what was measured, and what the plant gave.
        spec: the robot, with the width that was drawn.
        validation: runs to hold the estimate against.

    Raises:
        InputError: no run, or one to validate with that is also fitted.
    """
    roles = with_roles("box edges", runs, validation)

    def residuals(values: Mapping[str, float]) -> list[Residual]:
        change = values[WIDTH] - spec.geometry.width
        return [
            Residual(
                f"offset {each.offset:g}", "m", np.subtract(each.measured, each.of_width(change)),
                ROUNDING, role,
            )
            for each, role in roles
        ]  # fmt: skip

    return least_squares(residuals, unknowns(spec, [WIDTH]))
