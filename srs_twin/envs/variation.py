"""Variation: how the robots of episodes differ, as far as measurements leave it open.

Three sources, each of which may be absent: what a robot file leaves to chance (the spreads of `modules`), the
confidence intervals of a fit file, and ranges of one's own. From a fit the parameters are drawn together, as
normal numbers with its standard errors and correlations, and held within their intervals: what the data
could only tell of a sum stays a matter of the sum.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.fit_file import FitFile, load_fit
from srs_twin.identification.unknowns import unknowns, with_values
from srs_twin.robot_file import RobotFile
from srs_twin.robots import load_robot_file
from srs_twin.spec import RobotSpec

_MOST_SEEDS = 2**32

Path = str | os.PathLike[str]


@dataclass(frozen=True)
class Variation:
    """How robots differ.

    Attributes:
        file: the robot, with the spreads of its modules.
        fit: its intervals; None: no fit.
        ranges: lowest and highest of other numbers, by their names in a robot file, uniform.
    """

    file: RobotFile
    fit: FitFile | None = None
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        robot: Path,
        *,
        fit: Path | None = None,
        ranges: Mapping[str, tuple[float, float]] | None = None,
    ) -> Variation:
        """Return the variation of a robot.

        Args:
            robot: name or path.
            fit: path of a fit file that started from this robot.
            ranges: as the attribute.

        Raises:
            InputError: no such file, a fit of another robot, or a range that no robot can have.
        """
        found = None if fit is None else load_fit(fit)
        if found is not None and found.robot != os.fspath(robot):
            raise InputError(f"fit {found.name} is of robot '{found.robot}', not of '{os.fspath(robot)}'")
        made = cls(load_robot_file(robot), found, dict(ranges or {}))
        spec = made.file.spec()
        for name, (low, high) in made.ranges.items():
            if not low <= high:
                raise InputError(f"{name}: the range {low:g} to {high:g} is not allowed; lowest first")
            for end in (low, high):
                unknowns(spec, [name], starts={name: end})
        return made

    def draw(self, rng: np.random.Generator) -> RobotSpec:
        """Return the robot of an episode."""
        spec = self.file.spec(int(rng.integers(_MOST_SEEDS)))
        if self.fit is not None:
            spec = with_values(spec, _of_fit(self.fit, spec, rng))
        return with_values(
            spec, {name: float(rng.uniform(low, high)) for name, (low, high) in self.ranges.items()}
        )


def _of_fit(fit: FitFile, spec: RobotSpec, rng: np.random.Generator) -> dict[str, float]:
    """Return the values of a fit as they may be, and those that it held."""
    told = [each for each in fit.parameters if each.value is not None]
    values = np.array([each.value for each in told], dtype=float)
    errors = np.array([each.standard_error for each in told], dtype=float)
    covariance = np.array(fit.correlation, dtype=float) * np.outer(errors, errors)
    drawn = rng.multivariate_normal(values, covariance, method="eigh") if told else values
    bounds = {each.name: each for each in unknowns(spec, (each.name for each in told))}
    held = {name: value for name, value in fit.held.items() if name == "actuator.bend_rad"}
    return held | {
        each.name: float(
            np.clip(value, max(each.low, bounds[each.name].low), min(each.high, bounds[each.name].high))  # type: ignore[type-var]
        )
        for each, value in zip(told, drawn, strict=True)
    }
