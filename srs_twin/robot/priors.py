r"""Priors: probability distributions of a robot's uncertain parameters.

A robot file states the distribution of a parameter (`Uncertain`). Parameters are computed from standard
normal variables ζ with the correlations of the file (a Gaussian copula), by their distribution functions F:

$$ x_i = F_i^{-1}(\Phi(\zeta_i)), \qquad \zeta = L z, \quad L L^T = R, \quad z_i = \Phi^{-1}(u_i), $$

with u uniform and independent. Normal and lognormal distributions are truncated to the range that robot files
allow.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import ndtr, ndtri

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.robot.file import RobotFile
from srs_twin.robot.sourced import Uncertain

_EDGE = 1e-9
"""Smallest distance of a probability from 0 and 1, at which the normal quantile is infinite."""


@dataclass(frozen=True)
class Prior:
    """Prior of one parameter.

    Attributes:
        path: path of the parameter in a robot file.
        value: value in the robot file.
        unit: unit of the value.
        uncertain: distribution.
        bounds: range that robot files allow.
        source: source of the distribution.
    """

    path: str
    value: float
    unit: str
    uncertain: Uncertain
    bounds: tuple[float, float]
    source: str

    def at(self, shares: np.ndarray) -> np.ndarray:
        """Return the quantiles at these probabilities."""
        distribution = self.uncertain
        if distribution.low is not None and distribution.high is not None:
            return distribution.low + (distribution.high - distribution.low) * np.asarray(shares)
        if distribution.factor is not None:
            z_bounds = np.log(np.maximum(self.bounds, 1e-300) / self.value) / np.log(distribution.factor)
            return np.asarray(self.value * distribution.factor ** _truncated_normal(z_bounds, shares))
        assert distribution.sd is not None, "checked by the file's model"
        z_bounds = (np.array(self.bounds) - self.value) / distribution.sd
        return np.asarray(self.value + distribution.sd * _truncated_normal(z_bounds, shares))

    def shares_of(self, values: np.ndarray) -> np.ndarray:
        """Return the cumulative probabilities of values, 0 or 1 outside the distribution."""
        table = np.linspace(0.0, 1.0, 4001)
        return np.interp(values, self.at(table), table)

    def measured(self, value: float, sd: float) -> Prior:
        """Return the prior after a measurement of `value` with the standard deviation `sd`."""
        return replace(self, value=value, uncertain=Uncertain.model_validate({"kind": "normal", "sd": sd}))


def _truncated_normal(bounds: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return the quantiles of the standard normal distribution truncated to bounds."""
    low, high = ndtr(bounds)
    return np.asarray(ndtri(low + (high - low) * np.clip(shares, _EDGE, 1 - _EDGE)))


@dataclass(frozen=True)
class Priors:
    """Joint prior of a robot's uncertain parameters.

    Attributes:
        members: priors of the parameters.
        correlation: correlation of the underlying normal variables, shape (d, d).
    """

    members: tuple[Prior, ...]
    correlation: np.ndarray

    @classmethod
    def of(cls, robot: RobotFile, *, without: Collection[str] = ()) -> Priors:
        """Return the priors of a robot file.

        Args:
            robot: robot file.
            without: paths of parameters that keep their value.

        Raises:
            UnknownNameError: one of them is not uncertain.
            InputError: no parameter is uncertain, or the correlations are inconsistent.
        """
        records = {path: record for path, record in robot.records().items() if record.uncertain is not None}
        for path in without:
            if path not in records:
                raise UnknownNameError("uncertain number", path, records)
        priors = []
        for path, record in records.items():
            if path not in without:
                section, key = path.split(".")
                bounds = getattr(robot, section).bounds[key]
                distribution = record.uncertain
                source = (distribution.source if distribution else None) or record.source
                prior = Prior(path, record.value, record.unit, distribution, bounds, source)  # type: ignore
                priors.append(prior)
        if not priors:
            raise InputError(
                f"robot {robot.name}: no parameter is uncertain; add `uncertain:` to its records "
                "(docs/uncertainty.md)"
            )
        index = {prior.path: i for i, prior in enumerate(priors)}
        correlation = np.eye(len(priors))
        for pair in robot.correlated or ():
            if all(path in index for path in pair.of):
                i, j = (index[path] for path in pair.of)
                correlation[i, j] = correlation[j, i] = pair.r
        if np.linalg.eigvalsh(correlation)[0] <= 1e-9:
            raise InputError(
                f"robot {robot.name}: its correlations are inconsistent; the matrix must be positive definite"
            )
        return cls(tuple(priors), correlation)

    @property
    def paths(self) -> tuple[str, ...]:
        """Paths of the parameters."""
        return tuple(prior.path for prior in self.members)

    @property
    def independent(self) -> bool:
        """Whether no two parameters are correlated."""
        return bool((self.correlation == np.eye(len(self.members))).all())

    def at(self, shares: np.ndarray) -> np.ndarray:
        """Return the parameters at points u of the unit cube, shape (…, d)."""
        normal = ndtri(np.clip(shares, _EDGE, 1 - _EDGE)) @ np.linalg.cholesky(self.correlation).T
        columns = [prior.at(ndtr(normal[..., i])) for i, prior in enumerate(self.members)]
        return np.stack(columns, axis=-1)

    def document(self) -> list[dict[str, Any]]:
        """Return the priors as JSON values, for hashes and results."""
        rows = [
            {
                "parameter": p.path,
                "value": p.value,
                "unit": p.unit,
                **p.uncertain.model_dump(),
                "source": p.source,
            }
            for p in self.members
        ]
        correlated = [] if self.independent else [{"correlation": self.correlation.tolist()}]
        return [*rows, *correlated]
