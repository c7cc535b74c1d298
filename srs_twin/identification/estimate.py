r"""Estimate: what a fit found, how well it is known, and what these data cannot tell.

**Verdicts.** Let J be the derivatives of the weighted residuals by the coordinates z of `unknowns`, s_k its
singular values with directions v_k, and E the difference between two Jacobians from steps h and 2h, which
shows how far J itself is to be trusted. A direction is *blind* where moving along it does nothing that could
be told from the error of the derivatives,

$$ s_k \le 2\,\lVert E v_k \rVert \quad\text{or}\quad s_k \le 10^{-6} s_1 . $$

The others have the standard error σ/s_k. A parameter with a share of more than a tenth in the blind
directions is not identifiable. So is one whose standard error is 1 or more in z, a factor e either way,
for then the data hardly say more than its bounds do. Up to 0.1 it is identified, between them weakly. A
smaller share in a blind direction adds the spread that the bounds leave to it.

All of this supposes that the model is right. Where the weighted residuals, all or those of one kind of
signal, exceed their noise by more than `EXPLAINED`, nothing is identified: an interval is then the spread
about the best value under a wrong model, and the verdict is "cannot tell".

**Independent samples.** Residuals of neighbouring samples resemble each other: of noise that cameras and
filters smooth, and of what the model lacks. With ρ_k their autocorrelation, n samples tell a mean as well as
n/τ independent ones,

$$ \tau = 1 + 2 \sum_{k \ge 1} \rho_k , $$

the sum taken while pairs ρ_{2m} + ρ_{2m+1} are positive (Geyer 1992, Statistical Science 7: initial positive
sequence). A fit of p unknowns takes the slow part of the noise out of the residuals, about a share c = p
τ/n of their power at all short lags; it is put back, ρ_k → (ρ_k + c)/(1 + c), with τ as it comes out. All
series are pooled, each weighted by its power. Series that are too short to tell, such as pulls or averages
of runs, count as independent.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.unknowns import Unknown
from srs_twin.trajectory import Shown

IDENTIFIED = 0.1
"""Largest standard error in z of what is identified."""

KNOWN = 1.0
"""Standard error in z from which on nothing is known."""

BLIND_SHARE = 0.1
"""Share in blind directions from which on a parameter is not identifiable."""

EXPLAINED = 2.0
"""Largest standard deviation of the weighted residuals of a model that explains the data, kind by kind."""

UNEXPLAINED = "the model does not explain the data; these intervals do not hold"

_TRUSTED = 2.0
_LEAST = 1e-6


@dataclass(frozen=True)
class Identifiability:
    """What a Jacobian says, all in coordinates z.

    Attributes:
        covariance: shape (n, n).
        share: of each parameter in the blind directions, shape (n,).
        blind: these directions, shape (blind, n).
    """

    covariance: np.ndarray
    share: np.ndarray
    blind: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        """Standard errors, shape (n,)."""
        return np.sqrt(np.diag(self.covariance))

    def hidden(self, i: int) -> bool:
        """Say whether parameter i is not identifiable."""
        return bool(self.share[i] > BLIND_SHARE or self.errors[i] >= KNOWN)


def identifiability(
    jacobian: np.ndarray, error: np.ndarray, noise: float, widths: np.ndarray
) -> Identifiability:
    """Return what a Jacobian says.

    Args:
        jacobian: J, shape (samples, n).
        error: E, same shape.
        noise: σ of a weighted residual, grown by the root of the correlation time.
        widths: between the bounds of each parameter, in z, shape (n,).
    """
    _, singular, directions = np.linalg.svd(jacobian, full_matrices=False)
    doubt = np.linalg.norm(error @ directions.T, axis=0)
    is_blind = (singular <= _TRUSTED * doubt) | (singular <= _LEAST * singular.max(initial=0.0))
    seen, blind = directions[~is_blind], directions[is_blind]
    covariance = (seen.T * (noise / singular[~is_blind]) ** 2) @ seen
    # Uniform between the bounds: the variance of what nobody knows.
    reach = (np.abs(blind) @ widths) / np.sqrt(12)
    covariance += (blind.T * reach**2) @ blind
    return Identifiability(covariance, np.linalg.norm(blind, axis=0), blind)


Verdict = Literal["identified", "weakly identified", "cannot tell", "not identifiable"]
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
            most once), "cannot tell": the model does not explain the data, and the interval is the spread
            about the best value under a wrong model; or "not identifiable": from these data; such a one has
            no numbers.
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
            wanted = "no numbers" if none else "all"
            raise InputError(f"{self.name}: {self.verdict}, so it must have {wanted}")


@dataclass(frozen=True)
class Estimate(Shown):
    """What a fit found.

    Attributes:
        parameters: in the order in which they were asked for.
        correlation: of the estimates, shape (parameters, parameters); NaN where one has no number.
        residuals: of all data, the fit's and those kept for validation.
        cancels: directions in which the residuals do not change: name → share, in the coordinates of
            `unknowns`; {mass: 0.71, stiffness: 0.71} says that only their ratio acts.
        samples: number of samples that were fitted.
        independent: how many independent ones they are worth, see `correlation_time`.
        residual_scale: standard deviation of the weighted residuals: 1 where they are as large as expected.
        held: what was taken as known and the values refer to, by name.
        converged: whether the search came to an end.
    """

    page: ClassVar[str] = "fit"

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

    @property
    def misfit(self) -> tuple[str, ...]:
        """What is left where the model does not explain the data, a line each; none where it does."""
        explained = explains(self.residuals, self.residual_scale)
        return () if explained else (UNEXPLAINED, *patterns(self.residuals))

    def with_known(self, known: Sequence[Parameter]) -> Estimate:
        """Return the estimate with parameters that were not fitted, which correlate with nothing."""
        size, count = len(self.parameters), len(known)
        correlation = np.eye(size + count)
        correlation[:size, :size] = self.correlation
        for i, each in enumerate(self.parameters):
            if each.value is None:
                correlation[i], correlation[:, i] = np.nan, np.nan
        return replace(self, parameters=(*self.parameters, *known), correlation=correlation)

    def rms(self, role: Role) -> float | None:
        """Return the root mean square of the weighted residuals of a role; None without any."""
        squares = [(r.values / r.scale) ** 2 for r in self.residuals if r.role == role and len(r.values)]
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
            value = f"{each.value:.5g} ± {each.standard_error:.2g}{unit}"
            interval = f"95 % {each.low:.5g} to {each.high:.5g}"
            lines.append(f"{each.name}: {value}, {interval}: {each.verdict}{why}")
        return "\n".join((*lines, *self.misfit))


_SERIES = 20
"""Values from which on a signal is taken for a series in time."""
_GROWS = 1.5
"""Times the RMS of a series' first half: from here on the residuals of its second half have grown."""


def of_kinds(residuals: Sequence[Residual]) -> dict[str, list[Residual]]:
    """Return the residuals of the fit by kind of signal, such as bend, the worst first."""
    kinds: dict[str, list[Residual]] = {}
    for each in residuals:
        if each.role == "fit" and len(each.values):
            kinds.setdefault(re.sub(r"_(\d+|x|y)$", "", each.name.rpartition(" ")[2]), []).append(each)
    return dict(sorted(kinds.items(), key=lambda kind: -_weighted_rms(kind[1])))


def _weighted_rms(residuals: Sequence[Residual]) -> float:
    return float(np.sqrt(np.mean([(each.rms / each.scale) ** 2 for each in residuals])))


def explains(residuals: Sequence[Residual], scale: float) -> bool:
    """Say whether a model explains the data: all of them, and each kind of signal.

    Args:
        residuals: of all data.
        scale: standard deviation of the weighted ones.
    """
    return max(scale, *map(_weighted_rms, of_kinds(residuals).values()), 0.0) <= EXPLAINED


def patterns(residuals: Sequence[Residual]) -> Iterator[str]:
    """Yield which signals exceed their noise, the worst first, where most, and whether with time."""
    for kind, some in of_kinds(residuals).items():
        if (left := _weighted_rms(some)) <= 1:
            break
        worst = max(some, key=lambda each: each.rms / each.scale)
        halves = [[np.sum(part**2) for part in np.array_split(each.values, 2)] for each in some]
        before, after = np.sum(halves, axis=0)
        grew = ", growing with time" if len(worst.values) >= _SERIES and after > _GROWS**2 * before else ""
        where = f", most in {name}" if (name := worst.name.rpartition(" ")[0]) else ""
        yield f"left of {kind}: {left:.3g} times the noise{where}{grew}"


_PART = 0.05
"""Of a direction of length 1: parameters with a smaller share have no part in it."""


def bound_reason(unknown: Unknown, z: float) -> str:
    """Return why an unknown has no number whose coordinate z ends at a bound."""
    lower = z - unknown.coordinate(unknown.low) < unknown.coordinate(unknown.high) - z
    bound, side = (unknown.low, "least") if lower else (unknown.high, "most")
    return f"the data want it at the {side} that is allowed, {bound:g} {unknown.unit}, or beyond"


def hidden_reason(
    unknowns: tuple[Unknown, ...], inside: np.ndarray, known: Identifiability, place: int
) -> str:
    """Return why a parameter inside its bounds has no number.

    Args:
        unknowns: of the search.
        inside: which of them do not end at a bound.
        known: what the data tell of those.
        place: of the parameter among them.
    """
    rows = [row for row in known.blind if abs(row[place]) > _PART]
    shares = [(inside[k], abs(row[k])) for row in rows for k in range(len(row)) if k != place]
    others = sorted({unknowns[i].name for i, share in shares if share > _PART})
    if not rows:
        return f"its standard error is {known.errors[place]:.2g} in units that matter, 1 or more"
    if not others:
        return "the residuals do not depend on it"
    return f"together with {', '.join(others)} it cancels: only their combinations act"


def cancels(
    unknowns: tuple[Unknown, ...], inside: np.ndarray, known: Identifiability
) -> tuple[dict[str, float], ...]:
    """Return the directions in which the residuals do not change: name → share, the largest above 0.

    Args:
        unknowns: as in `hidden_reason`.
        inside: likewise.
        known: likewise.
    """
    names = [unknowns[i].name for i in inside]
    rows = []
    for row in known.blind:
        signed = row * np.sign(row[np.argmax(np.abs(row))])
        shares = zip(names, signed, strict=True)
        rows.append({name: round(float(share), 3) for name, share in shares if abs(share) > _PART})
    return tuple(rows)


LEAST_SAMPLES = 20
"""Shorter series say nothing about their autocorrelation."""


_ROUNDS = 5
_MOST_TAKEN = 0.5  # c beyond which a fit has taken so much that the rest says nothing of it


def correlation_time(series: Sequence[np.ndarray], unknowns: int = 0) -> float:
    """Return τ, 1 or more.

    Args:
        series: residuals over time, each of shape (samples,), in comparable units.
        unknowns: p, how many numbers were fitted.
    """
    long = [each for each in series if len(each) >= LEAST_SAMPLES]
    if not long or not any(each.any() for each in long):
        return 1.0
    most = max(len(each) for each in long)
    total = np.zeros(most)
    for each in long:
        total[: len(each)] += _autocovariance(each / max(abs(r).max() for r in long))
    rho = total / total[0]
    pairs = rho[: most // 2 * 2].reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    kept = pairs[: ends[0]] if ends.size else pairs
    lags = 2 * len(kept) - 1  # besides lag 0
    plain = max(1.0, float(2 * kept.sum() - 1))
    samples, time = sum(len(each) for each in long), plain
    for _ in range(_ROUNDS):
        taken = min(unknowns * time / samples, _MOST_TAKEN)
        time = max(1.0, 1.0 + 2 * (float(kept.sum()) - 1 + lags * taken) / (1 + taken))
    return time


def _autocovariance(values: np.ndarray) -> np.ndarray:
    """Return Σ_t r_t r_{t+k} for k = 0…n−1."""
    size = 1 << (2 * len(values) - 1).bit_length()
    spectrum = np.fft.rfft(values, size)
    return np.asarray(np.fft.irfft(np.abs(spectrum) ** 2, size)[: len(values)])
