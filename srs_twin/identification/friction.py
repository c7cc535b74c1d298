r"""Estimation of friction coefficients from pulls (Eq. 17, Table 2) and coasting tests.

**Pulls.** A car pulls the robot with a spring, either along the body with rolling
wheels or across the body with blocked wheels. Each pull yields one static friction
coefficient μ. The coefficient is computed from the maximum deformation ΔL_max of the
spring with stiffness k, and from the mass m of the robot:

$$ \mu = \frac{k\,\Delta L_{max}}{m g}. $$

The kinetic friction coefficient may be smaller. The estimate is the mean of μ over all
pulls. The standard error includes the errors in k and m, which are common to all pulls.
Rounding may change all readings in the same way. The standard error of a mean is
therefore at least Δ/√12, where Δ is the smallest decimal step of the readings.

A table of pulls is a CSV file with the maximum spring deformations in pulls along the
body (``along_mm``) and across the body (``across_mm``). Each row contains one pull
along the body, one pull across the body, or both. The columns ``spring_n_per_m`` and
``mass_kg`` must contain constant values. The same applies to the optional columns of
standard errors, ``spring_error_n_per_m`` and ``mass_error_kg``.

**Coasting tests.** The robot with vented chambers is pushed and released on the floor.
A straight robot decelerates by μ_t g/(1 + s) in the rolling direction of its wheels,
and by μ_n g in the lateral direction, where s is the relative inertia of the wheels. In
other directions, the deceleration depends on the friction law (see `floor.slide`). The
initial position and velocity of each run are fitted together with μ_t and μ_n. A
component of the initial velocity is set to 0 if the displacement in its direction does
not exceed the noise.

**Bent bodies.** The wheels of a bent body cannot all roll without slip. The body moves
along the circular arc with the minimum dissipation. On this arc, the mean misalignment
of the wheels is

$$ ε = \min_{a, b} \sum_i \frac{m_i}{M}\,\lvert δ_i - a - b\,i \rvert , $$

where δ_i is the heading of connector i, m_i the mass of connector i, and M the total
mass. Under the friction law `wheel`, the lateral slip of the wheels increases the drag
coefficient to μ_t + ε √(μ_n² − μ_t²). The motion is expressed in a frame that turns
with the body. If the robot rolls, the angle between the mean heading and the rolling
direction is also fitted.

The misalignment ε is computed from the recorded bends, or from the rest bends in the
robot file if no bends were recorded. Because ε(bends) is a seminorm, bend errors
(`_BEND_ERROR_RAD`, `_UNSEEN_BEND_RAD`) change ε by at most ε(errors). The fit is
repeated with ε increased and decreased by the 95 % quantile of ε(errors). The
confidence interval of a coefficient also covers the intervals of these two fits.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.estimate import (
    LEVEL,
    UNIDENTIFIABLE_ERROR,
    FitEstimate,
    Parameter,
    Residual,
    Role,
    correlation_matrix,
    half_width,
    verdict_on,
)
from srs_twin.identification.fit_file import (
    DataSet,
    array_hash,
    assign_roles,
    trajectory_hash,
)
from srs_twin.identification.least_squares import Watch, least_squares
from srs_twin.identification.parameters import FreeParameter, free_parameters
from srs_twin.io.files import StrPath
from srs_twin.plants.analytical.floor import slide, spin_fraction
from srs_twin.recordings.body.trajectories import moving_derivative
from srs_twin.recordings.csv_table import (
    CsvColumn,
    CsvTable,
    first_line_names,
    read_table,
)
from srs_twin.recordings.recorded_file import read_file
from srs_twin.recordings.signals.units import LENGTHS
from srs_twin.robot import friction
from srs_twin.robot.friction import FRICTION_LAWS
from srs_twin.robot.spec import GRAVITY, RobotSpec
from srs_twin.trajectory import Trajectory

_NAMES = ("friction.mu_t", "friction.mu_n")


_DIRECTIONS = ("along", "across")
"""Directions relative to the body, in the order of `_NAMES`."""


@dataclass(frozen=True)
class Pulls:
    """Spring deformations measured while a car pulls the robot with a spring.

    Attributes:
        along: maximum deformation of the spring in each pull along the body, m.
        across: maximum deformation of the spring in each pull with blocked wheels or
            across the body, m.
        stiffness: spring stiffness k, N/m.
        mass: mass m of the pulled robot, kg.
        stiffness_error: standard error of k, N/m.
        mass_error: standard error of m, kg.
        resolution: decimal step of the readings along and across the body, m, or 0 if
            it is unknown.
        sha256: SHA-256 of the file, or an empty string if the data are not from a file.
    """

    along: Sequence[float]
    across: Sequence[float]
    stiffness: float
    mass: float
    stiffness_error: float = 0.0
    mass_error: float = 0.0
    name: str = "pulls"
    sha256: str = ""
    resolution: Sequence[float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("stiffness", "mass"):
            value = getattr(self, name)
            error = getattr(self, f"{name}_error")
            if not 0 <= error < value < math.inf:
                raise InputError(
                    f"{self.name}: {name} {value!r} with error {error!r} is not"
                    " allowed; the value must be above 0 and larger than its error"
                )
        for direction in _DIRECTIONS:
            pulls = np.asarray(getattr(self, direction), dtype=float)
            if pulls.ndim != 1 or not (np.isfinite(pulls) & (pulls >= 0)).all():
                raise InputError(
                    f"{self.name}: the pulls {direction} the body are not allowed; they"
                    " must be a list of spring deformations of at least 0 m"
                )
            if len(pulls) == 1:
                raise InputError(
                    f"{self.name}: a single pull {direction} the body does not show"
                    " the scatter; give 2 or more pulls, or none"
                )

    @property
    def factor(self) -> float:
        """Ratio of the friction coefficient to the spring deformation, 1/m."""
        return self.stiffness / (self.mass * GRAVITY)

    def coefficients(self, direction: str) -> np.ndarray:
        """Return the coefficient μ of each pull "along" or "across" the body."""
        return self.factor * np.asarray(getattr(self, direction), dtype=float)

    def data_set(self, role: Role) -> DataSet:
        """Return the name, hash and size of the data."""
        constants = [self.stiffness, self.mass]
        used = array_hash(*map(np.asarray, (self.along, self.across, constants)))
        samples = len(self.along) + len(self.across)
        return DataSet(self.name, self.sha256 or used, role, samples)


def fit_pulls(pulls: Pulls, *, validation: Sequence[Pulls] = ()) -> FitEstimate:
    """Estimate μ_t and μ_n from pulls.

    A coefficient is not identifiable if there are no pulls in its direction.
    """
    data_with_roles = assign_roles("pulls", [pulls], validation)
    shared = (pulls.stiffness_error / pulls.stiffness) ** 2
    shared += (pulls.mass_error / pulls.mass) ** 2
    values = [pulls.coefficients(direction) for direction in _DIRECTIONS]
    means = np.full(len(values), np.nan)
    variances = means.copy()
    rounding = pulls.factor * np.array(pulls.resolution) / math.sqrt(12)
    for k, value in enumerate(values):
        if len(value):
            means[k] = value.mean()
            variances[k] = value.var(ddof=1) / len(value)
    # Errors in k and m scale both coefficients by the same factor, so the coefficients
    # are correlated.
    floored = np.maximum(variances, rounding**2)
    covariance = np.diag(floored) + shared * np.outer(means, means)
    errors = np.sqrt(np.diag(covariance))
    parameters = [
        _parameter(k, values[k], means[k], variances[k], errors[k]) for k in range(2)
    ]
    residuals = tuple(
        Residual(
            f"{data.name} {direction}",
            "1",
            data.coefficients(direction) - means[k],
            max(float(values[k].std(ddof=1)), float(rounding[k]), 1e-12),
            role,
        )
        for data, role in data_with_roles
        for k, direction in enumerate(_DIRECTIONS)
        if len(values[k]) and len(data.coefficients(direction))
    )
    samples = sum(map(len, values))
    return FitEstimate(
        tuple(parameters),
        correlation_matrix(covariance, parameters),
        residuals,
        samples=samples,
        independent=float(samples),
        residual_scale=1.0,
        held={"mass_kg": pulls.mass, "spring_n_per_m": pulls.stiffness},
    )


def _parameter(
    k: int, values: np.ndarray, mean: float, variance: float, error: float
) -> Parameter:
    why = ""
    if not len(values):  # `Pulls` does not accept a single value
        why = f"there are no pulls {_DIRECTIONS[k]} the body"
    elif error >= UNIDENTIFIABLE_ERROR * mean:
        why = (
            f"the standard error of the pulls {_DIRECTIONS[k]} the body is as large as"
            " their mean"
        )
    if why:
        return Parameter(_NAMES[k], "1", "not identifiable", why=why)
    # The Welch-Satterthwaite formula gives the degrees of freedom. The standard errors
    # of k and m are treated as exact, so they have infinitely many degrees of freedom.
    freedom = np.inf
    if variance > 0:
        freedom = (len(values) - 1) * (error**2 / variance) ** 2
    half = half_width(error, freedom)
    return Parameter(
        _NAMES[k],
        "1",
        verdict_on(error, mean),
        float(mean),
        float(error),
        low=max(mean - half, 0.0),
        high=mean + half,
    )


_CONSTANTS = {
    "spring_n_per_m": (1e-2, 1e6),
    "mass_kg": (1e-3, 1e3),
    "spring_error_n_per_m": (0.0, 1e6),
    "mass_error_kg": (0.0, 1e3),
}
"""Columns with constant values, and their plausible ranges.

The weakest spring stretches by 1 m under a mass of 1 g. The stiffest spring stretches
by 10 mm under a mass of 1 t. The columns of standard errors are optional.
"""

_DEFORMATION_LIMITS = (0.0, 10.0)
"""Range of plausible spring deformations, m."""

PULL_COLUMNS = "along_mm,across_mm,spring_n_per_m,mass_kg"
"""Header line of a table of pulls."""


def is_pull_table(path: StrPath) -> bool:
    """Return whether the header of a file contains a column of spring deformations."""
    return any(
        name == direction or name.startswith((f"{direction}_", f"{direction} "))
        for name in first_line_names(path)
        for direction in _DIRECTIONS
    )


def read_pull_table(path: StrPath) -> Pulls:
    """Read a table of pulls from a CSV file."""
    known: dict[str, dict[str, float]] = dict.fromkeys(_DIRECTIONS, LENGTHS)
    table = read_table(read_file(path), known | {name: {} for name in _CONSTANTS})
    file = table.file
    needed = f"a table of pulls has the columns {PULL_COLUMNS}"
    columns = {column.name: column for column in table.columns}
    names = {f"{name}_mm": name for name in _DIRECTIONS}
    names |= {name: name for name in _CONSTANTS}
    table.check_misspelt([text for text in names if names[text] not in columns])
    for column in table.columns:
        if column.number:
            problem = f"the column '{column.text}' must not be numbered; {needed}"
            raise table.error(column, problem)
    if not columns.keys() & set(_DIRECTIONS):
        raise file.error(
            f"the columns 'along' and 'across' are both missing; {needed}", 1
        )
    for name in ("spring_n_per_m", "mass_kg"):
        if name not in columns:
            raise file.error(f"the column '{name}' is missing; {needed}", 1)
    rows, _ = table.read(table.columns)
    values = {
        column.name: cells for column, cells in zip(table.columns, rows.T, strict=True)
    }
    deformations: list[list[float]] = [[], []]
    resolution = [0.0, 0.0]
    for k, name in enumerate(_DIRECTIONS):
        if name in columns:
            readings = values[name]
            rule = "a deformation must be {}"
            table.check_range(columns[name], readings, _DEFORMATION_LIMITS, rule)
            resolution[k] = table.decimal_step(columns[name], readings)
            deformations[k] = readings[~np.isnan(readings)].tolist()
    stiffness, mass, stiffness_error, mass_error = (
        _constant(table, columns[name], values[name]) if name in columns else 0.0
        for name in _CONSTANTS
    )
    return Pulls(
        deformations[0],
        deformations[1],
        stiffness,
        mass,
        stiffness_error,
        mass_error,
        file.name,
        file.sha256,
        resolution,
    )


def _constant(table: CsvTable, column: CsvColumn, values: np.ndarray) -> float:
    table.check_range(column, values, _CONSTANTS[column.name], "it must be {}")
    rows = np.flatnonzero(np.isfinite(values))
    if not rows.size:
        raise table.error(column, f"{column.text}: the column contains no number", 0)
    first = float(values[rows[0]])
    different = rows[values[rows] != first]
    if different.size:
        row = int(different[0])
        raise table.error(
            column,
            f"{column.text}: the value is {values[row]:g} here but {first:g} above;"
            " use one file for each spring and each mass",
            row,
        )
    return first


_MAX_TURN_RAD = 0.2
"""Maximum change of heading during coasting, rad.

A robot that turns further cannot be modelled as a point mass.
"""

_MIN_SAMPLES = 8

_MIN_SPEED_M_S = 0.02

_NOISE_M = 1e-3
"""Standard deviation of a measured position, m."""

_MIN_TRAVEL = 3.0
"""Minimum ratio of displacement to `_NOISE_M` for fitting an initial velocity."""

_MAX_ROLL_ANGLE_RAD = 0.1
"""Maximum angle between the mean heading and the rolling direction, rad."""

_HEADING_DEGREE = 3
"""Degree of the polynomial in time that smooths the heading."""

_BEND_ERROR_RAD = 0.01
"""Standard deviation of a mean recorded bend due to marker placement, rad."""

_UNSEEN_BEND_RAD = 0.03
"""Standard deviation of a rest bend that is taken from the robot file, rad."""

_BEND_DRAWS = 1000

_MAX_HALF_WIDTH = 0.1
"""Maximum relative half width of the 95 % interval of an identified coefficient."""


@dataclass(frozen=True)
class CoastingTest:
    """Recorded motion of the vented robot after a push.

    Attributes:
        time: time since the first used sample, s, shape (samples,).
        position: displacement of the centre of mass along and across the heading, m,
            shape (samples, 2).
        velocity: estimate of the initial velocity along and across the heading, m/s,
            from which the fit starts.
        span: times of the first and last used sample on the clock of the recording, s.
        bends: mean recorded bends, rad, shape (segments,), or None if the bends were
            not recorded.
    """

    name: str
    sha256: str
    time: np.ndarray
    position: np.ndarray
    velocity: tuple[float, float]
    span: tuple[float, float]
    bends: np.ndarray | None = None

    @classmethod
    def from_trajectory(
        cls, trajectory: Trajectory, name: str, *, start: float | None = None
    ) -> CoastingTest:
        """Extract the coasting motion from a trajectory.

        The robot coasts from the time `start` (s), by default the time of the maximum
        speed.
        """
        needed = f"{_MIN_SAMPLES} or more are needed"
        time = trajectory.time
        if len(time) < _MIN_SAMPLES:
            raise InputError(f"{name}: the recording has {len(time)} samples; {needed}")
        speed = np.hypot(*moving_derivative(time, trajectory.com).T)
        first = int(np.argmax(speed) if start is None else np.searchsorted(time, start))
        time = time[first:]
        if len(time) < _MIN_SAMPLES:
            raise InputError(
                f"{name}: the recording has {len(time)} samples after the push;"
                f" {needed}"
            )
        if speed[first] < _MIN_SPEED_M_S:
            raise InputError(
                f"{name}: the maximum speed is only {speed[first]:.2g} m/s, but at"
                f" least {_MIN_SPEED_M_S:g} m/s is needed; push the robot faster"
            )
        heading = trajectory["heading"][first:]
        if np.ptp(heading) > _MAX_TURN_RAD:
            raise InputError(
                f"{name}: the robot turns by {np.ptp(heading):.2g} rad while it"
                f" coasts, but at most {_MAX_TURN_RAD:g} rad is allowed; push it"
                " straight along or across"
            )
        trend = np.polynomial.Polynomial.fit(time, heading, _HEADING_DEGREE)(time)
        middle = (trend[1:] + trend[:-1]) / 2
        moves = np.diff(trajectory.com[first:], axis=0)
        steps = moves @ [1.0, 1.0j] * np.exp(-1j * middle)
        path = np.concatenate([[0.0], np.cumsum(steps)])
        position = np.stack([path.real, path.imag], axis=1)
        along, across = moving_derivative(time, position)[0].tolist()
        bends = None
        if trajectory.has("bend_1"):
            bends = trajectory.stack("bend")[first:].mean(axis=0)
        return cls(
            name,
            trajectory_hash(trajectory),
            time - time[0],
            position,
            (along, across),
            (float(time[0]), float(time[-1])),
            bends,
        )

    def data_set(self, role: Role) -> DataSet:
        """Return the name, hash and size of the data."""
        return DataSet(self.name, self.sha256, role, 2 * len(self.time), *self.span)


def fit_coasting(
    runs: Sequence[CoastingTest],
    spec: RobotSpec,
    *,
    validation: Sequence[CoastingTest] = (),
    friction_law: str = "wheel",
    wheel_inertia: bool = True,
    watch: Watch | None = None,
) -> FitEstimate:
    """Estimate μ_t and μ_n from coasting tests.

    A coefficient is identifiable only if the robot coasts in its direction. Validation
    tests do not influence the coefficients, but their initial velocities are fitted. If
    `wheel_inertia` is false, the wheels have no rotational inertia, as in the
    analytical plant. The value of `friction_law` is one of
    `robot.friction.FRICTION_LAWS` except "viscous".
    """
    allowed = [name for name in FRICTION_LAWS if name != "viscous"]
    if friction_law not in allowed:
        raise InputError(
            f"friction law '{friction_law}' is not allowed here; use one of"
            f" {', '.join(allowed)}"
        )
    assign_roles("coasting tests", runs, validation)
    fraction = spin_fraction(spec) if wheel_inertia else 0.0
    model = _CoastingModel(spec, friction_law, fraction)
    estimate = model.fit(runs, 0.0, watch)
    if "friction.mu_n" not in estimate.values:
        # The drag of a bent body depends on μ_n, which these tests do not determine.
        model = replace(model, mu_n=spec.friction.mu_n)
        estimate = model.fit(runs, 0.0, watch)
    ends = [model.fit(runs, side, None) for side in (-1.0, 1.0)]
    parameters = tuple(_widened(parameter, ends) for parameter in estimate.parameters)
    estimate = replace(estimate, parameters=parameters)
    if not validation or len(estimate.values) < len(_NAMES):
        return estimate
    added = [
        replace(residual, role="validation")
        for run in validation
        for residual in model.validation_residuals(run, estimate.values)
    ]
    return replace(estimate, residuals=(*estimate.residuals, *added))


_STDS_IN_HALF_WIDTH = 1.96
"""Ratio of the half width of a 95 % interval to the standard deviation."""


def misalignment(bends: np.ndarray, spec: RobotSpec) -> np.ndarray:
    """Return the mean misalignment ε of the wheels of bent bodies, rad.

    The array `bends` (rad) has the shape (..., segments).
    """
    weights = spec.mass.array() / spec.mass.total
    number = np.arange(len(weights))
    headings = np.concatenate(
        [np.zeros_like(bends[..., :1]), np.cumsum(bends, axis=-1)], axis=-1
    )
    smallest = np.full(bends.shape[:-1], np.inf)
    # The line with the minimum sum of absolute deviations passes through two of the
    # headings.
    for i, j in itertools.combinations(number, 2):
        slope = (headings[..., j] - headings[..., i]) / (j - i)
        line = headings[..., i, None] + slope[..., None] * (number - i)
        smallest = np.minimum(smallest, np.abs(headings - line) @ weights)
    return smallest


def _widened(parameter: Parameter, ends: Sequence[FitEstimate]) -> Parameter:
    fits = [parameter, *(end[parameter.name] for end in ends)]
    for fit in fits:
        if fit.value is None:
            return fit
    low = min(fit.low for fit in fits if fit.low is not None)
    high = max(fit.high for fit in fits if fit.high is not None)
    error = (high - low) / 2 / _STDS_IN_HALF_WIDTH
    widened = replace(parameter, standard_error=error, low=low, high=high)
    value = parameter.value or 0.0
    is_wide = max(value - low, high - value) > _MAX_HALF_WIDTH * value
    if is_wide and parameter.verdict == "identified":
        why = f"its 95 % interval exceeds ±{100 * _MAX_HALF_WIDTH:.0f} %"
        return replace(widened, verdict="weakly identified", why=why)
    return widened


@dataclass(frozen=True)
class _CoastingModel:
    """Model that predicts coasting tests.

    The attribute `fraction` is the relative inertia s of the wheels. The attribute
    `mu_n` is the coefficient for the lateral slip of a bent body, by default the fitted
    μ_n.
    """

    spec: RobotSpec
    friction_law: str
    fraction: float
    mu_n: float | None = None

    def fit(
        self, runs: Sequence[CoastingTest], side: float, watch: Watch | None
    ) -> FitEstimate:
        """Fit the friction coefficients for one value of the misalignment ε.

        The argument `side` is −1 for the lower bound of ε, 0 for the estimate, and 1
        for the upper bound.
        """
        angles = [self._misalignment(run, side) for run in runs]

        def residuals(values: Mapping[str, float]) -> list[Residual]:
            return [
                residual
                for k, run in enumerate(runs)
                for residual in self._residuals(run, k, values, angles[k])
            ]

        unknowns = [*free_parameters(self.spec, _NAMES)]
        for k, run in enumerate(runs):
            unknowns += _motion(run, k)
        return least_squares(
            residuals, unknowns, held={"spin_fraction": self.fraction}, watch=watch
        )

    def _misalignment(self, run: CoastingTest, side: float) -> float:
        known = run.bends
        error = _BEND_ERROR_RAD
        if known is None:
            known = self.spec.modules.array("bias")
            error = _UNSEEN_BEND_RAD
        errors = error * np.random.default_rng(0).normal(size=(_BEND_DRAWS, len(known)))
        change = float(np.quantile(misalignment(errors, self.spec), LEVEL))
        return max(float(misalignment(known, self.spec)) + side * change, 0.0)

    def _residuals(
        self, run: CoastingTest, k: int, values: Mapping[str, float], angle: float
    ) -> list[Residual]:
        """Return the position residuals of run k, each series with a mean of 0.

        Subtracting the mean of a series is equivalent to fitting the initial position.
        """
        velocity = values.get(f"along_{k}", 0.0), values.get(f"across_{k}", 0.0)
        mu_t, mu_n = (values[name] for name in _NAMES)
        friction_law = getattr(friction, self.friction_law)
        along, across, *_ = friction_law(
            1.0, angle, 1.0, mu_t, self.mu_n or mu_n, _SHARP_SLIP
        )
        drag = -along - angle * across
        path = slide(
            velocity,
            run.time,
            friction_law=self.friction_law,
            mu_t=drag,
            mu_n=mu_n,
            fraction=self.fraction,
        )
        turned = path @ [1.0, 1.0j] * np.exp(1j * values.get(f"roll_{k}", 0.0))
        difference = run.position - np.stack([turned.real, turned.imag], axis=1)
        return [
            Residual(f"{run.name} {direction}", "m", column - column.mean(), _NOISE_M)
            for direction, column in zip(_DIRECTIONS, difference.T, strict=True)
        ]

    def validation_residuals(
        self, run: CoastingTest, fitted: Mapping[str, float]
    ) -> Sequence[Residual]:
        angle = self._misalignment(run, 0.0)
        motion = _motion(run, 0)

        def residuals(values: Mapping[str, float]) -> list[Residual]:
            return self._residuals(run, 0, {**fitted, **values}, angle)

        if motion:
            return least_squares(residuals, motion).residuals
        return residuals({})


_SHARP_SLIP = 1e-12
"""Slip speed that regularises the friction law, m/s, too small to affect a fit."""


def _motion(run: CoastingTest, k: int) -> list[FreeParameter]:
    """Return the initial velocities and the rolling direction as free parameters."""
    few = len(run.time) // 4
    late = run.position[-few:].mean(axis=0)
    moved = late - run.position[2 * few : 3 * few].mean(axis=0)
    rolls = abs(moved[0]) > _MIN_TRAVEL * _NOISE_M
    limit = _MAX_ROLL_ANGLE_RAD
    angle = 0.0
    if rolls:
        angle = float(np.clip(moved[1] / moved[0], -limit / 2, limit / 2))
    shift = late - run.position[: max(1, few // 4)].mean(axis=0)
    turned = shift @ [1.0, 1.0j] * np.exp(-1j * angle)

    def free(name: str, unit: str, start: float, low: float, high: float) -> None:
        unknowns.append(
            FreeParameter(f"{name}_{k}", unit, start, low, high, 1.0, nuisance=True)
        )

    unknowns: list[FreeParameter] = []
    travel = (abs(turned.real), abs(turned.imag))
    for name, guess, distance in zip(_DIRECTIONS, run.velocity, travel, strict=True):
        if distance > _MIN_TRAVEL * _NOISE_M:
            free(name, "m/s", guess, guess - 2.0, guess + 2.0)
    if rolls:
        free("roll", "rad", angle, -limit, limit)
    return unknowns
