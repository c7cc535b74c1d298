"""Distribution of robots over episodes (domain randomisation).

The robot of an episode depends on random module properties from the robot file, on
parameter estimates from a fit file, and on uniform parameter ranges. Fitted parameters
are drawn from a joint normal distribution with the standard errors and correlations of
the fit, and clipped to their confidence intervals. Because of the correlations,
well-determined combinations of parameters, such as the sum of two parameters, vary
little.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.fit_file import FitFile, load_fit
from srs_twin.identification.parameters import free_parameters, with_values
from srs_twin.io.documents import Document
from srs_twin.io.files import StrPath
from srs_twin.robot.file import RobotFile, load_robot_file, robot_in
from srs_twin.robot.spec import RobotSpec

Robot = StrPath | Mapping[str, object]
Ranges = Mapping[str, tuple[float, float]]

_SEED_COUNT = 2**32


@dataclass(frozen=True)
class Variation:
    """Distribution of robots over episodes.

    Attributes:
        file: nominal robot, and random distributions of the module properties.
        fit: fit from which parameters are drawn, or None.
        ranges: limits (low, high) of a uniform distribution, keyed by parameter name.
    """

    file: RobotFile
    fit: FitFile | None = None
    ranges: Ranges = field(default_factory=dict)

    @classmethod
    def load(
        cls, robot: Robot, fit: StrPath | None = None, ranges: Ranges | None = None
    ) -> Variation:
        """Load a robot and a fit, and check the ranges.

        Args:
            robot: name or path of a robot file, or a mapping as in the section `robot`
                of a scenario.
            fit: path of a fit file for this robot, or None.
            ranges: limits (low, high) of a uniform distribution, keyed by parameter
                name.

        Raises:
            InputError: a file does not exist, the fit is for another robot, or a range
                is not allowed.
        """
        fit_file = None if fit is None else load_fit(fit)
        if isinstance(robot, Mapping):
            file = robot_in(Document("robot", robot))
            name = file.name
        else:
            file = load_robot_file(robot)
            name = os.fspath(robot)
        if fit_file is not None and fit_file.robot != name:
            raise InputError(
                f"fit {fit_file.name} is for robot '{fit_file.robot}', not for"
                f" '{name}'; use a fit of this robot"
            )
        variation = cls(file, fit_file, dict(ranges or {}))
        spec = file.spec()
        for name, (low, high) in variation.ranges.items():
            if not low <= high:
                raise InputError(
                    f"{name}: the range {low:g} to {high:g} is not allowed; give the"
                    " lower limit first"
                )
            for limit in (low, high):
                free_parameters(spec, [name], starts={name: limit})
        return variation

    def draw(self, rng: np.random.Generator) -> RobotSpec:
        """Draw the robot for one episode."""
        spec = self.file.spec(int(rng.integers(_SEED_COUNT)))
        if self.fit is not None:
            spec = with_values(spec, _draw_fitted_values(self.fit, spec, rng))
        return with_values(
            spec,
            {name: float(rng.uniform(*limits)) for name, limits in self.ranges.items()},
        )


def _draw_fitted_values(
    fit: FitFile, spec: RobotSpec, rng: np.random.Generator
) -> dict[str, float]:
    fitted = [parameter for parameter in fit.parameters if parameter.value is not None]
    values = np.array([parameter.value for parameter in fitted], dtype=float)
    errors = np.array([parameter.standard_error for parameter in fitted], dtype=float)
    covariance = np.array(fit.correlation, dtype=float) * np.outer(errors, errors)
    # Correlations of 1 make the covariance singular, which the method `eigh` allows.
    drawn = values
    if fitted:
        drawn = rng.multivariate_normal(values, covariance, method="eigh")
    unknowns = free_parameters(spec, (parameter.name for parameter in fitted))
    bounds = {unknown.name: unknown for unknown in unknowns}
    result = {
        name: value for name, value in fit.held.items() if name == "actuator.bend_rad"
    }
    for parameter, value in zip(fitted, drawn, strict=True):
        bound = bounds[parameter.name]
        low = max(parameter.low, bound.low)  # type: ignore[type-var]
        high = min(parameter.high, bound.high)  # type: ignore[type-var]
        result[parameter.name] = float(np.clip(value, low, high))
    return result
