r"""Prior distributions of uncertain robot parameters, with correlations.

In a robot file, the entry `uncertain` defines the distribution F of a value.
Correlations between values are modelled by a Gaussian copula with standard normal
variables ζ and the correlation matrix R:

$$ x_i = F_i^{-1}(\Phi(\zeta_i)), \qquad \zeta = L z, \quad L L^T = R, \quad z_i = \Phi^{-1}(u_i), $$

where the variables u_i are independent and uniformly distributed. Normal and lognormal
distributions are truncated at the bounds that apply in robot files.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, ndtri

from srs_twin.compute.arrays import Array
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.robot.file import RobotFile
from srs_twin.robot.sourced import MIN_PROBABILITY, Uncertain


@dataclass(frozen=True)
class Prior:
    """Prior distribution of one parameter.

    Attributes:
        path: path of the parameter in a robot file.
        bounds: minimum and maximum value allowed in a robot file.
    """

    path: str
    value: float
    unit: str
    uncertain: Uncertain
    bounds: tuple[float, float]
    source: str

    def quantile(self, probabilities: Array) -> Array:
        """Return the values of the parameter at cumulative probabilities."""
        return self.uncertain.quantile(self.value, self.bounds, probabilities)

    def cdf(self, values: Array) -> Array:
        """Return the cumulative probabilities of values, computed by interpolation."""
        table = np.linspace(0.0, 1.0, 4001)
        return np.interp(values, self.quantile(table), table)

    def with_measurement(self, value: float, sd: float) -> Prior:
        """Return a prior with the normal distribution of a measured value."""
        return replace(
            self,
            value=value,
            uncertain=Uncertain.model_validate({"kind": "normal", "sd": sd}),
        )


@dataclass(frozen=True)
class Priors:
    """Joint prior distribution of the uncertain parameters of a robot.

    Attributes:
        correlation: correlation matrix R of the normal variables, shape (d, d).
    """

    parameters: tuple[Prior, ...]
    correlation: Array

    @classmethod
    def from_robot(cls, robot: RobotFile, *, exclude: Collection[str] = ()) -> Priors:
        """Return the prior distribution that a robot file defines.

        Parameters with paths in `exclude` are treated as exactly known.
        """
        records = {
            path: record
            for path, record in robot.records().items()
            if record.uncertain is not None
        }
        for path in exclude:
            if path not in records:
                raise UnknownNameError("uncertain number", path, records)
        parameters = []
        for path, record in records.items():
            if path not in exclude:
                section, key = path.split(".")
                bounds = getattr(robot, section).bounds[key]
                prior = record.uncertain
                source = (prior.source if prior else None) or record.source
                parameters.append(
                    Prior(path, record.value, record.unit, prior, bounds, source)  # type: ignore[arg-type]
                )
        if not parameters:
            raise InputError(
                f"robot {robot.name}: the robot file has no uncertain values; add"
                " `uncertain` to one or more values (docs/uncertainty.md)"
            )
        index = {prior.path: i for i, prior in enumerate(parameters)}
        correlation = np.eye(len(parameters))
        for pair in robot.correlated or ():
            if all(path in index for path in pair.of):
                i, j = (index[path] for path in pair.of)
                correlation[i, j] = correlation[j, i] = pair.r
        if np.linalg.eigvalsh(correlation)[0] <= 1e-9:
            raise InputError(
                f"robot {robot.name}: the correlations contradict each other, because"
                " their matrix is not positive definite; reduce some correlations"
            )
        return cls(tuple(parameters), correlation)

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths of the parameters in the robot file."""
        return tuple(prior.path for prior in self.parameters)

    @property
    def independent(self) -> bool:
        """Whether all parameters are uncorrelated."""
        return bool((self.correlation == np.eye(len(self.parameters))).all())

    def quantile(self, probabilities: Array) -> Array:
        """Return the parameter values for independent uniform probabilities u."""
        inside = np.clip(probabilities, MIN_PROBABILITY, 1 - MIN_PROBABILITY)
        normal = ndtri(inside) @ np.linalg.cholesky(self.correlation).T
        columns = [
            prior.quantile(ndtr(normal[..., i]))
            for i, prior in enumerate(self.parameters)
        ]
        return np.stack(columns, axis=-1)

    def document(self) -> list[dict[str, object]]:
        """Return the prior distribution as JSON values."""
        rows = [
            {
                "parameter": p.path,
                "value": p.value,
                "unit": p.unit,
                **p.uncertain.model_dump(),
                "source": p.source,
            }
            for p in self.parameters
        ]
        if self.independent:
            correlated = []
        else:
            correlated = [{"correlation": self.correlation.tolist()}]
        return [*rows, *correlated]
