r"""What is not known of a robot, as distributions that can be drawn from.

A robot file says of a number how well it is known (`Uncertain`). Numbers are made from standard normal
variables ζ with the file's correlations (a Gaussian copula), each by its own distribution function F:

$$ x_i = F_i^{-1}(\Phi(\zeta_i)), \qquad \zeta = L z, \quad L L^T = R, \quad z_i = \Phi^{-1}(u_i), $$

with u uniform and independent. Normal and lognormal distributions end where robot files do not allow more.
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

_EDGE = 1e-9  # of shares, which must stay inside of 0 to 1


@dataclass(frozen=True)
class Prior:
    """What is known of one number.

    Attributes:
        path: of the number in a robot file.
        value: what the file says it is.
        unit: of that.
        uncertain: its distribution.
        bounds: what a robot file allows.
        source: where the distribution comes from.
    """

    path: str
    value: float
    unit: str
    uncertain: Uncertain
    bounds: tuple[float, float]
    source: str

    def at(self, shares: np.ndarray) -> np.ndarray:
        """Return the numbers below which these shares of the distribution lie."""
        given = self.uncertain
        if given.low is not None and given.high is not None:
            return given.low + (given.high - given.low) * np.asarray(shares)
        if given.factor is not None:
            to_z = np.log(np.maximum(self.bounds, 1e-300) / self.value) / np.log(given.factor)
            return np.asarray(self.value * given.factor ** _between(to_z, shares))
        assert given.sd is not None, "checked by the file's model"
        to_z = (np.array(self.bounds) - self.value) / given.sd
        return np.asarray(self.value + given.sd * _between(to_z, shares))

    def shares_of(self, values: np.ndarray) -> np.ndarray:
        """Return the shares at which these numbers lie, what is beyond the distribution at its ends."""
        table = np.linspace(0.0, 1.0, 4001)
        return np.interp(values, self.at(table), table)

    def measured(self, value: float, sd: float) -> Prior:
        """Return what is known after a measurement that says `value`, with this standard deviation."""
        return replace(self, value=value, uncertain=Uncertain.model_validate({"kind": "normal", "sd": sd}))


def _between(ends: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return standard normal numbers by shares of what lies between two ends."""
    low, high = ndtr(ends)
    return np.asarray(ndtri(low + (high - low) * np.clip(shares, _EDGE, 1 - _EDGE)))


@dataclass(frozen=True)
class Priors:
    """What is known of a robot's uncertain numbers, together.

    Attributes:
        each: one for each number.
        correlation: of the normal variables behind them, shape (d, d).
    """

    each: tuple[Prior, ...]
    correlation: np.ndarray

    @classmethod
    def of(cls, robot: RobotFile, *, without: Collection[str] = ()) -> Priors:
        """Return what a robot file says.

        Args:
            robot: the file.
            without: paths of numbers that are taken as they are.

        Raises:
            UnknownNameError: one of them is not uncertain.
            InputError: nothing is uncertain, or the correlations contradict each other.
        """
        found = {path: record for path, record in robot.records().items() if record.uncertain is not None}
        for path in without:
            if path not in found:
                raise UnknownNameError("uncertain number", path, found)
        each = []
        for path, record in found.items():
            if path not in without:
                section, key = path.split(".")
                bounds = getattr(robot, section).bounds[key]
                given = record.uncertain
                source = (given.source if given else None) or record.source
                each.append(Prior(path, record.value, record.unit, given, bounds, source))  # type: ignore[arg-type]
        if not each:
            raise InputError(
                f"robot {robot.name}: nothing is said to be uncertain; add `uncertain:` to its numbers "
                "(docs/uncertainty.md)"
            )
        place = {prior.path: i for i, prior in enumerate(each)}
        correlation = np.eye(len(each))
        for pair in robot.correlated or ():
            if all(path in place for path in pair.of):
                i, j = (place[path] for path in pair.of)
                correlation[i, j] = correlation[j, i] = pair.r
        if np.linalg.eigvalsh(correlation)[0] <= 1e-9:
            raise InputError(f"robot {robot.name}: its correlations contradict each other")
        return cls(tuple(each), correlation)

    @property
    def paths(self) -> tuple[str, ...]:
        """Of the numbers."""
        return tuple(prior.path for prior in self.each)

    @property
    def independent(self) -> bool:
        """Whether no two go together."""
        return bool((self.correlation == np.eye(len(self.each))).all())

    def at(self, shares: np.ndarray) -> np.ndarray:
        """Return the numbers that independent shares u stand for, shape (…, d)."""
        normal = ndtri(np.clip(shares, _EDGE, 1 - _EDGE)) @ np.linalg.cholesky(self.correlation).T
        columns = [prior.at(ndtr(normal[..., i])) for i, prior in enumerate(self.each)]
        return np.stack(columns, axis=-1)

    def document(self) -> list[dict[str, Any]]:
        """Return plain data of it, for digests and results."""
        rows = [
            {
                "parameter": p.path,
                "value": p.value,
                "unit": p.unit,
                **p.uncertain.model_dump(),
                "source": p.source,
            }
            for p in self.each
        ]
        correlated = [] if self.independent else [{"correlation": self.correlation.tolist()}]
        return [*rows, *correlated]
