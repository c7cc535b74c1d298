"""Estimate: what a fit found, how well it is known, and what these data cannot tell."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from srs_twin.errors import InputError

Verdict = Literal["identified", "weakly identified", "not identifiable"]
Role = Literal["fit", "validation"]


@dataclass(frozen=True)
class Residual:
    """Measured less predicted of one signal.

    Attributes:
        name: of data set and signal, ``"step_1 bend_2"``.
        unit: of the values.
        values: shape (samples,), over time where there is one.
        scale: the noise that is expected of it, in the unit; signals are weighted by it.
        role: "fit", or "validation" where the fit has not seen it.
    """

    name: str
    unit: str
    values: np.ndarray
    scale: float
    role: Role = "fit"

    @property
    def rms(self) -> float:
        """Root mean square, in the unit."""
        return float(np.sqrt(np.mean(self.values**2))) if len(self.values) else 0.0


@dataclass(frozen=True)
class Parameter:
    """One number that was looked for.

    Attributes:
        name: see `unknowns`.
        unit: of all numbers here.
        verdict: "identified" (standard error at most a tenth of the value or scale), "weakly identified" (at
            most once), or "not identifiable": from these data; such a one has no numbers.
        value: the estimate.
        standard_error: of it.
        low: lower end of the 95 % confidence interval.
        high: upper end.
        why: what the verdict rests on, in words.
    """

    name: str
    unit: str
    verdict: Verdict
    value: float | None = None
    standard_error: float | None = None
    low: float | None = None
    high: float | None = None
    why: str = ""

    def __post_init__(self) -> None:
        numbers = (self.value, self.standard_error, self.low, self.high)
        none = self.verdict == "not identifiable"
        if any((number is None) != none for number in numbers):
            raise InputError(
                f"{self.name}: {self.verdict}, so it must have {'no numbers' if none else 'all'}"
            )


@dataclass(frozen=True)
class Estimate:
    """What a fit found.

    Attributes:
        parameters: in the order in which they were asked for.
        correlation: of the estimates, shape (parameters, parameters); NaN where one has no number.
        residuals: of all data, the fit's and those kept for validation.
        cancels: directions in which the residuals do not change: name → share, in the coordinates of
            `unknowns`; {mass: 0.71, stiffness: 0.71} says that only their ratio acts.
        samples: number of samples that were fitted.
        independent: how many independent ones they are worth, see `independence`.
        residual_scale: standard deviation of the weighted residuals: 1 where they are as large as expected.
        held: what was taken as known and the values refer to, by name.
        converged: whether the search came to an end.
    """

    parameters: tuple[Parameter, ...]
    correlation: np.ndarray
    residuals: tuple[Residual, ...] = ()
    cancels: tuple[Mapping[str, float], ...] = ()
    samples: int = 0
    independent: float = 0.0
    residual_scale: float = 0.0
    held: Mapping[str, float] = field(default_factory=dict)
    converged: bool = True

    def __getitem__(self, name: str) -> Parameter:
        """Return a parameter by its name."""
        return next(each for each in self.parameters if each.name == name)

    @property
    def values(self) -> dict[str, float]:
        """What has a number, by name."""
        return {each.name: each.value for each in self.parameters if each.value is not None}

    def rms(self, role: Role) -> float | None:
        """Return the root mean square of the weighted residuals of a role; None without any."""
        squares = [(each.values / each.scale) ** 2 for each in self.residuals if each.role == role]
        squares = [each for each in squares if len(each)]
        return float(np.sqrt(np.concatenate(squares).mean())) if squares else None

    def text(self) -> str:
        """Return the estimate as a table for people."""
        lines = []
        for each in self.parameters:
            if each.value is None:
                lines.append(f"{each.name}: {each.verdict}; {each.why}")
                continue
            unit = "" if each.unit == "1" else f" {each.unit}"
            why = f"; {each.why}" if each.why else ""
            lines.append(
                f"{each.name}: {each.value:.5g} ± {each.standard_error:.2g}{unit}, 95 % {each.low:.5g} to "
                f"{each.high:.5g}: {each.verdict}{why}"
            )
        return "\n".join(lines)
