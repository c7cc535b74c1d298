r"""Friction of the wheels from pulls with a spring car (Eq. 17, Table 2) and from coasting.

**Pulls.** The spring's largest deformation as motion begins,

$$ \mu = \frac{k\,\Delta L_{max}}{m g}, $$

once for each pull, along with wheels that roll and across with wheels held. The estimate is the mean over the
pulls with its standard error, grown by what is not known of k and m, which all pulls share. It is the
friction at which motion begins; while the robot slides it may be less. A table of pulls is a plain CSV file
with one pull a row: ``along_mm`` or ``across_mm``, the spring's largest deformation (m without a unit; a
blank cell: not pulled that way). ``spring_n_per_m`` and ``mass_kg`` are the same in every row that has them,
as are their standard errors ``spring_error_n_per_m`` and ``mass_error_kg``, which may be left out.

**Coasting.** The robot is thrown across the floor, straight, with vented chambers. Along its wheels it loses
μ_t g/(1 + s), across them μ_n g; thrown at an angle, what the friction law says (`floor.slide`, which also
tells what s is). Where each run began and how fast it was thrown is found along with μ_t and μ_n; a
direction in which it went no further than noise is taken as not thrown at all.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.estimate import IDENTIFIED, KNOWN, Estimate, Parameter, Residual, Role, Verdict
from srs_twin.identification.fit_file import DataSet, fingerprint, trajectory_hash, with_roles
from srs_twin.identification.least_squares import LEVEL, Watch, least_squares
from srs_twin.identification.unknowns import Unknown, unknowns
from srs_twin.plants.analytical.floor import slide, spin_share
from srs_twin.recordings.body.trajectories import moving_slope
from srs_twin.recordings.csv_table import CsvColumn, CsvTable, first_line_names, read_file, read_table
from srs_twin.recordings.signals.units import LENGTHS
from srs_twin.robot.friction import LAWS
from srs_twin.robot.spec import GRAVITY, RobotSpec
from srs_twin.trajectory import Trajectory

_NAMES = ("friction.mu_t", "friction.mu_n")
_WAYS = ("along", "across")
_LEAST_PULLS = 2


@dataclass(frozen=True)
class Pulls:
    """What a spring car measured.

    Attributes:
        along: largest deformation of the spring in each pull with rolling wheels, m.
        across: the same, across the body or with wheels held, m.
        stiffness: k of the spring, N/m.
        mass: m of what was pulled, kg.
        stiffness_error: standard error of k, N/m.
        mass_error: standard error of m, kg.
        name: what the data are called.
        sha256: of their file; empty where there is none.
    """

    along: Sequence[float]
    across: Sequence[float]
    stiffness: float
    mass: float
    stiffness_error: float = 0.0
    mass_error: float = 0.0
    name: str = "pulls"
    sha256: str = ""

    def __post_init__(self) -> None:
        for what in ("stiffness", "mass"):
            value, error = getattr(self, what), getattr(self, f"{what}_error")
            if not (math.isfinite(value) and value > 0 and math.isfinite(error) and 0 <= error < value):
                raise InputError(
                    f"{self.name}: {what} {value!r} with error {error!r} is not allowed; it must be above 0 "
                    "and its error smaller"
                )
        for way in _WAYS:
            pulls = np.asarray(getattr(self, way), dtype=float)
            if pulls.ndim != 1 or not (np.isfinite(pulls) & (pulls >= 0)).all():
                raise InputError(f"{self.name}: pulls {way} must be a list of lengths in m, 0 or more")
            if len(pulls) == 1:
                what = f"one pull {way} does not show its scatter"
                raise InputError(f"{self.name}: {what}; give 2 or more, or none")

    @property
    def factor(self) -> float:
        """Friction coefficient over deformation, 1/m."""
        return self.stiffness / (self.mass * GRAVITY)

    def coefficients(self, way: str) -> np.ndarray:
        """Return μ of each pull "along" or "across"."""
        return self.factor * np.asarray(getattr(self, way), dtype=float)

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""
        along, across = (np.asarray(getattr(self, way), dtype=float) for way in _WAYS)
        used = fingerprint(along, across, np.array([self.stiffness, self.mass]))
        return DataSet(self.name, self.sha256 or used, role, len(along) + len(across))


def fit_pulls(pulls: Pulls, *, validation: Sequence[Pulls] = ()) -> Estimate:
    """Return μ_t and μ_n; a direction that was not pulled is not identifiable.

    Args:
        pulls: what was measured.
        validation: pulls to hold the estimate against.

    Raises:
        InputError: pulls to validate with that are also fitted.
    """
    everything = with_roles("pulls", [pulls], validation)
    shared = (pulls.stiffness_error / pulls.stiffness) ** 2 + (pulls.mass_error / pulls.mass) ** 2
    values = [pulls.coefficients(way) for way in _WAYS]
    means = np.array([each.mean() if len(each) else np.nan for each in values])
    own = np.array([each.var(ddof=1) / len(each) if len(each) else np.nan for each in values])
    covariance = np.diag(own) + shared * np.outer(means, means)
    errors = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / np.outer(errors, errors)
    found = [_parameter(k, values[k], means[k], own[k], errors[k]) for k in range(2)]
    for k, each in enumerate(found):
        if each.value is None:
            correlation[k], correlation[:, k] = np.nan, np.nan
        else:
            correlation[k, k] = 1.0
    scatter = [max(float(each.std(ddof=1)), 1e-12) if len(each) else math.nan for each in values]
    residuals = tuple(
        Residual(f"{data.name} {way}", "1", data.coefficients(way) - means[k], scatter[k], role)
        for data, role in everything
        for k, way in enumerate(_WAYS)
        if len(values[k]) and len(data.coefficients(way))
    )
    samples = sum(len(each) for each in values)
    held = {"mass_kg": pulls.mass, "spring_n_per_m": pulls.stiffness}
    return Estimate(tuple(found), correlation, residuals, (), samples, float(samples), 1.0, held)


def _parameter(k: int, values: np.ndarray, mean: float, own: float, error: float) -> Parameter:
    from scipy import stats

    if len(values) < _LEAST_PULLS:
        return Parameter(_NAMES[k], "1", "not identifiable", why=f"nothing was pulled {_WAYS[k]}")
    if error >= KNOWN * mean:
        why = f"the pulls {_WAYS[k]} scatter as much as they measure"
        return Parameter(_NAMES[k], "1", "not identifiable", why=why)
    # Welch-Satterthwaite: what all pulls share is taken as known from many measurements.
    freedom = (len(values) - 1) * (error**2 / own) ** 2 if own > 0 else np.inf
    reach = float(stats.t.ppf(0.5 + LEVEL / 2, freedom)) * error
    verdict: Verdict = "identified" if error <= IDENTIFIED * mean else "weakly identified"
    return Parameter(_NAMES[k], "1", verdict, float(mean), float(error), max(mean - reach, 0.0), mean + reach)


_CONSTANTS = ("spring_n_per_m", "mass_kg", "spring_error_n_per_m", "mass_error_kg")
"""Columns of what all pulls of a table share; the errors may be left out."""

_LONGEST = 10.0  # m: no spring of a scale deforms that much
_EXAMPLE = "along_mm,across_mm,spring_n_per_m,mass_kg"


def is_pulls(path: str | os.PathLike[str]) -> bool:
    """Say whether a file's first line names a column of pulls.

    Raises:
        InputError: the file cannot be read.
    """
    names = first_line_names(path)
    return any(name == way or name.startswith((f"{way}_", f"{way} ")) for name in names for way in _WAYS)


def read_pulls(path: str | os.PathLike[str]) -> Pulls:
    """Read a table of pulls.

    Raises:
        InputError: no such file, columns missing or of other units, cells that are no such number.
    """
    known: dict[str, dict[str, float]] = dict.fromkeys(_WAYS, LENGTHS)
    table = read_table(read_file(path), known | {name: {} for name in _CONSTANTS})
    found = {each.name: each for each in table.columns}
    for each in table.columns:
        if each.number or each.letter:
            raise table.error(each, f"{each.text}: these columns have no numbers; {_EXAMPLE}")
    if not found.keys() & set(_WAYS):
        raise table.file.error(f"neither 'along' nor 'across'; a table of pulls has {_EXAMPLE}", 1)
    for name in _CONSTANTS[:2]:
        if name not in found:
            raise table.file.error(f"no column '{name}'; a table of pulls has {_EXAMPLE}", 1)
    rows, _ = table.read(table.columns)
    values = {each.name: column for each, column in zip(table.columns, rows.T, strict=True)}
    along, across = (_deformations(table, found[way], values[way]) if way in found else [] for way in _WAYS)
    stiffness, mass, stiffness_error, mass_error = (
        _constant(table, found[name], values[name]) if name in found else 0.0 for name in _CONSTANTS
    )
    file = table.file
    return Pulls(along, across, stiffness, mass, stiffness_error, mass_error, file.name, file.sha256)


def _deformations(table: CsvTable, column: CsvColumn, values: np.ndarray) -> list[float]:
    """Return the deformations in a column, m, without its blank cells."""
    wrong = np.flatnonzero((values < 0) | (values > _LONGEST))
    if wrong.size:
        row = int(wrong[0])
        given = f"{column.text}: {values[row] / column.factor:g} is not allowed"
        allowed = f"a deformation of 0 to {_LONGEST / column.factor:g} {column.unit or 'm'}"
        raise table.error(column, f"{given}; {allowed}", row)
    return [float(each) for each in values if np.isfinite(each)]


def _constant(table: CsvTable, column: CsvColumn, values: np.ndarray) -> float:
    """Return the one number that a column holds."""
    given = np.flatnonzero(np.isfinite(values))
    if not given.size:
        raise table.error(column, f"{column.text}: no number in it", 0)
    first = float(values[given[0]])
    other = given[values[given] != first]
    if other.size:
        row = int(other[0])
        what = f"{values[row]:g} here and {first:g} before; one file, one spring and one mass"
        raise table.error(column, f"{column.text}: {what}", row)
    return first


_MOST_TURN = 0.2  # rad: beyond it the body is no longer a point
_LEAST_SAMPLES = 8
_LEAST_SPEED = 0.02  # m/s
_NOISE = 1e-3  # m
_SEEN = 3.0  # times the noise: what it must go in a direction to have been thrown that way


@dataclass(frozen=True)
class Coasting:
    """One throw.

    Attributes:
        name: of the data.
        sha256: of them.
        time: from the first sample used, shape (samples,), s.
        place: centre of mass along and across the mean heading, from the first sample, (samples, 2), m.
        velocity: a first guess of how it was thrown, along and across, m/s.
        span: begin and end of what was used, s on the recording's clock.
    """

    name: str
    sha256: str
    time: np.ndarray
    place: np.ndarray
    velocity: tuple[float, float]
    span: tuple[float, float]

    @classmethod
    def of(cls, trajectory: Trajectory, name: str, *, start: float | None = None) -> Coasting:
        """Return the throw that a trajectory shows.

        Args:
            trajectory: a recording, or a plant's.
            name: what to call it.
            start: from when on nobody touches the robot, s; None: from where it is fastest.

        Raises:
            InputError: too short, too slow, or the robot turns.
        """
        time, com = trajectory.time, trajectory.com
        if len(time) < _LEAST_SAMPLES:
            raise InputError(f"{name}: {len(time)} samples; {_LEAST_SAMPLES} or more are wanted")
        speed = np.hypot(*moving_slope(time, com).T)
        first = int(np.argmax(speed)) if start is None else int(np.searchsorted(time, start))
        time, com = time[first:], com[first:]
        if len(time) < _LEAST_SAMPLES:
            wanted = f"{_LEAST_SAMPLES} or more are wanted"
            raise InputError(f"{name}: {len(time)} samples after the throw; {wanted}")
        if speed[first] < _LEAST_SPEED:
            raise InputError(
                f"{name}: it moves at {speed[first]:.2g} m/s at most; a throw of "
                f"{_LEAST_SPEED:g} m/s or more is wanted"
            )
        heading = trajectory["heading"][first:]
        if np.ptp(heading) > _MOST_TURN:
            raise InputError(
                f"{name}: it turns by {np.ptp(heading):.2g} rad while it coasts; {_MOST_TURN:g} rad at most: "
                "throw it straight along or across"
            )
        c, s = np.cos(heading.mean()), np.sin(heading.mean())
        place = (com - com[0]) @ np.array([[c, -s], [s, c]])
        guess = moving_slope(time, place)[0]
        velocity, span = (float(guess[0]), float(guess[1])), (float(time[0]), float(time[-1]))
        return cls(name, trajectory_hash(trajectory), time - time[0], place, velocity, span)

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""
        return DataSet(self.name, self.sha256, role, 2 * len(self.time), *self.span)


def fit_coasting(
    runs: Sequence[Coasting],
    spec: RobotSpec,
    *,
    validation: Sequence[Coasting] = (),
    law: str = "wheel",
    wheel_inertia: bool = True,
    watch: Watch | None = None,
) -> Estimate:
    """Return μ_t and μ_n from throws.

    Args:
        runs: throws; along them and across them, to know both.
        spec: the robot, whose wheels and masses say how much the wheels' spinning adds.
        validation: throws to hold the estimate against; of these only the throw itself is fitted.
        law: "axis", "wheel" or "ellipse".
        wheel_inertia: whether wheels have to stop spinning, as the robot's and the twin's; the analytical
            plant's and skids have none.
        watch: is told how far the search is, see `least_squares`.

    Raises:
        InputError: no run, an unknown law, or a run to validate with that is also fitted.
    """
    if law not in LAWS or law == "viscous":
        raise InputError(f"friction law '{law}' is unknown here; allowed: axis, wheel, ellipse")
    with_roles("coasting runs", runs, validation)
    share = spin_share(spec) if wheel_inertia else 0.0

    def residuals(values: Mapping[str, float]) -> list[Residual]:
        return [each for k, run in enumerate(runs) for each in _missed(run, k, values, law, share)]

    thrown = [unknown for k, run in enumerate(runs) for unknown in _throw(run, k)]
    held = {"spin_share": share}
    found = least_squares(residuals, [*unknowns(spec, _NAMES), *thrown], held=held, watch=watch)
    if not validation or len(found.values) < len(_NAMES):
        return found
    return _validated(found, validation, law, share)


def _throw(run: Coasting, k: int) -> list[Unknown]:
    """Return the velocities that can be seen of a throw, as unknowns."""
    few = len(run.time) // 4
    went = np.abs(run.place[-few:].mean(axis=0) - run.place[: max(1, few // 4)].mean(axis=0))
    return [
        Unknown(f"{way}_{k}", "m/s", guess, guess - 2.0, guess + 2.0, 1.0, nuisance=True)
        for way, guess, far in zip(_WAYS, run.velocity, went, strict=True)
        if far > _SEEN * _NOISE
    ]


def _missed(run: Coasting, k: int, values: Mapping[str, float], law: str, share: float) -> list[Residual]:
    """Return residuals of throw k by direction; where it began is their mean, and taken out."""
    thrown = values.get(f"along_{k}", 0.0), values.get(f"across_{k}", 0.0)
    mu_t, mu_n = (values[name] for name in _NAMES)
    off = run.place - slide(thrown, run.time, law=law, mu_t=mu_t, mu_n=mu_n, share=share)
    return [
        Residual(f"{run.name} {way}", "m", column - column.mean(), _NOISE)
        for way, column in zip(_WAYS, off.T, strict=True)
    ]


def _validated(found: Estimate, validation: Sequence[Coasting], law: str, share: float) -> Estimate:
    """Return the estimate with residuals of throws that it has not seen, each thrown as suits it best."""
    added: list[Residual] = []
    for run in validation:

        def residuals(values: Mapping[str, float], run: Coasting = run) -> list[Residual]:
            return _missed(run, 0, {**found.values, **values}, law, share)

        thrown = _throw(run, 0)
        seen = least_squares(residuals, thrown).residuals if thrown else residuals({})
        added += [replace(each, role="validation") for each in seen]
    return replace(found, residuals=(*found.residuals, *added))
