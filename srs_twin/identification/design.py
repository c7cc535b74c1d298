r"""Optimal experimental design, which chooses experiments for a requested accuracy.

For each candidate experiment, a model predicts observations with known noise. Let z be
the logarithms of all uncertain parameters, J the Jacobian of the predictions with
respect to z, and R the covariance of the noise. The experiment increases the
information matrix Λ to Λ', from which the standard deviations of z follow:

$$ \Lambda' = \Lambda + J^T R^{-1} J, \qquad \mathrm{sd}(z_i) = \sqrt{(\Lambda'^{-1})_{ii}}. $$

The initial information matrix is computed from the `uncertain` entries of the robot
file. For a parameter with value 0, such as drag, z is instead the parameter divided by
a tenth of the axial friction of the robot.

The experiments are chosen one after another. For each confidence interval, let w be the
ratio of its width to the requested width, or 1 if the interval is narrow enough. Each
choice minimises the mean of ln w over all intervals that are still too wide. The design
ends early if the best experiment would not narrow any of these intervals by more than
2 %.

Model errors are included only for gait runs. For runs of any duration, the model error
is 2 % of the speed, of the turning rate and of the bend amplitudes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.metrics import plant_metrics
from srs_twin.compute.arrays import Array
from srs_twin.control.gait import Gait
from srs_twin.errors import InputError
from srs_twin.identification.parameters import free_parameters, with_values
from srs_twin.identification.priors import Priors
from srs_twin.io.arguments import checked
from srs_twin.io.files import StrPath
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.pneumatics import LagPneumatics
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.robot.file import load_robot_file
from srs_twin.robot.spec import GRAVITY, RobotSpec
from srs_twin.rollout import rollout

PULL_FRACTION = 0.015
"""Relative standard error of the mean of ten pulls (0.0015/0.0966, Section 3.4.1)."""

LENGTH_STD_M = 4e-4
"""Standard deviation of a length that is measured with markers during a run, m."""

BEND_STD_RAD = 0.01
"""Standard deviation of a measured bend, rad."""

MASS_STD_KG = 1e-3
"""Standard deviation of a weighed mass, kg."""

RUN_DISCREPANCY = 0.02
"""Relative error of `compliant` in speed and turning rate, compared with the twin."""

_MAX_REPETITIONS = 3
"""Maximum number of times that each experiment may be chosen."""

_MIN_NARROWING = 0.98
"""Ratio of new to old interval width below which an experiment is worthwhile."""

_STEP = 0.05
"""Step of finite differences in z.

A large step is needed because the metrics of simulated runs are not smooth functions of
z.
"""

_PRIOR_STD = 3.0
"""Standard deviation of z without prior knowledge, and maximum for all parameters."""


@dataclass(frozen=True)
class CandidateExperiment:
    """Experiment that a design may choose.

    Attributes:
        description: instruction for the operator.
        predict: function that returns the predicted observations for a robot.
        noise: function that returns the noise standard deviation of each predicted
            observation.
    """

    description: str
    minutes: float
    predict: Callable[[RobotSpec], Array]
    noise: Callable[[Array], Array]


def candidates(spec: RobotSpec) -> Iterator[CandidateExperiment]:
    """Yield the candidate experiments for a robot."""
    yield from _measurements(spec)
    yield from _pulls(spec)
    yield from _actuator_tests(spec)
    yield from _gait_runs(spec)


def _constant_noise(std: float) -> Callable[[Array], Array]:
    return lambda predicted: np.full(len(predicted), std)


def _relative_noise(fraction: float) -> Callable[[Array], Array]:
    return lambda predicted: fraction * np.maximum(np.abs(predicted), 1e-6)


def _measurements(spec: RobotSpec) -> Iterator[CandidateExperiment]:
    def lengths(robot: RobotSpec) -> Array:
        g = robot.geometry
        return np.array([g.segment_length, g.rigid_gap, g.half_track])

    yield CandidateExperiment(
        "record markers on the connectors (calibrate locomotion)",
        10,
        lengths,
        _constant_noise(LENGTH_STD_M),
    )
    yield CandidateExperiment(
        "weigh connectors", 5, lambda r: r.mass.array(), _constant_noise(MASS_STD_KG)
    )


def _pulls(spec: RobotSpec) -> Iterator[CandidateExperiment]:
    for load in (0.0, 2.0 * spec.mass.total):
        words = f" with {1000 * load:.0f} g on it" if load else ""

        def along(robot: RobotSpec, load: float = load) -> Array:
            friction = robot.friction.mu_t * (robot.mass.total + load) * GRAVITY
            return np.array([friction + robot.friction.drag])

        def across(robot: RobotSpec, load: float = load) -> Array:
            return np.array([robot.friction.mu_n * (robot.mass.total + load) * GRAVITY])

        noise = _relative_noise(PULL_FRACTION)
        yield CandidateExperiment(
            f"10 pulls along the body{words}, in motion, hoses attached",
            10,
            along,
            noise,
        )
        yield CandidateExperiment(
            f"10 pulls across the body{words}, in motion, wheels fixed",
            10,
            across,
            noise,
        )


def _actuator_tests(spec: RobotSpec) -> Iterator[CandidateExperiment]:
    supply = spec.supply.nominal
    levels = np.linspace(0.2, 1.0, 5) * supply

    def static(robot: RobotSpec) -> Array:
        pressure = np.zeros((len(levels), robot.segments, 2))
        pressure[:, 0, 0] = levels
        return air_bend(robot, pressure)[:, 0]

    yield CandidateExperiment(
        f"constant pressures up to {supply / 1e3:.0f} kPa, segments lifted (calibrate"
        " actuator --static)",
        20,
        static,
        _constant_noise(BEND_STD_RAD),
    )

    def steps(robot: RobotSpec) -> Array:
        chambers = LagPneumatics(robot, supply_pa=supply)
        bends = []
        for state in (1, -1):
            valves = np.full((robot.segments, 2), -1)
            valves[0, 0] = state
            duration = 4 * max(spec.actuator.tau_fill, spec.actuator.tau_vent)
            times = np.linspace(0, duration, 41)[1:]
            bends.append(
                chambers.advance(chambers.schedule(valves, duration), times).bend[:, 0]
            )
        return np.concatenate(bends)

    yield CandidateExperiment(
        f"pressure steps of {supply / 1e3:.0f} kPa, segments lifted (calibrate"
        " actuator)",
        10,
        steps,
        _constant_noise(BEND_STD_RAD),
    )


def _gait_runs(spec: RobotSpec) -> Iterator[CandidateExperiment]:
    supply = spec.supply.nominal

    def noise(predicted: Array) -> Array:
        std = np.maximum(RUN_DISCREPANCY * np.abs(predicted), 1e-4)
        bends = slice(1, 1 + spec.segments)
        std[bends] = np.hypot(BEND_STD_RAD, RUN_DISCREPANCY * predicted[bends])
        return std

    for frequency, offset in (
        (1.0, 0.0),
        (1.5, 0.0),
        (2.0, 0.0),
        (1.0, 0.3),
        (2.0, 0.3),
    ):

        def run(
            robot: RobotSpec, frequency: float = frequency, offset: float = offset
        ) -> Array:
            snake = AnalyticalSnake(
                robot, model="compliant", friction="wheel", supply_pa=supply
            )
            metrics = plant_metrics(rollout(snake, Gait(frequency, offset=offset), 6.0))
            observed = [metrics["com_speed_m_s"], *metrics["bend_amplitude_rad"]]
            if offset:
                observed.append(metrics["yaw_rate_rad_s"])
            return np.array(observed)

        description = (
            f"gait run at {frequency:g} Hz, offset {offset:g}, {supply / 1e3:.0f} kPa,"
            " 20 s (calibrate locomotion)"
        )
        yield CandidateExperiment(description, 5, run, noise)


@dataclass(frozen=True)
class ExperimentDesign:
    """Chosen experiments and the accuracy after each experiment.

    The accuracy of a parameter is the half width of its 95 % interval, divided by the
    parameter value unless this value is 0.

    Attributes:
        chosen: experiments in the order in which they were chosen.
        after: accuracy of each requested parameter after each experiment.
        before: accuracy of each requested parameter before the first experiment.
    """

    chosen: tuple[CandidateExperiment, ...]
    after: Mapping[str, tuple[float, ...]]
    before: Mapping[str, float]
    targets: Mapping[str, float]

    @property
    def unmet(self) -> tuple[str, ...]:
        """Names of the parameters whose intervals remain wider than requested."""
        return tuple(
            name
            for name, widths in self.after.items()
            if (self.before[name], *widths)[-1] > self.targets[name]
        )

    def document(self) -> dict[str, object]:
        """Return the design as JSON values."""
        rows = [
            {
                "do": experiment.description,
                "minutes": experiment.minutes,
                "after": {name: after[k] for name, after in self.after.items()},
            }
            for k, experiment in enumerate(self.chosen)
        ]
        return {
            "before": dict(self.before),
            "wanted": dict(self.targets),
            "experiments": rows,
            "unmet": list(self.unmet),
        }


@checked
def calibrate_design(
    robot: StrPath, target_accuracy: Mapping[str, float]
) -> ExperimentDesign:
    """Choose experiments for a requested accuracy, as `srs-twin calibrate design` does.

    Args:
        robot: name or path of the robot, whose file states the current uncertainties.
        target_accuracy: required half width of the 95 % interval of each parameter,
            relative to the parameter value, for example 0.05.

    Raises:
        InputError: the robot is not valid, or no parameter is requested.
    """
    file = load_robot_file(robot)
    fractions = (np.arange(64) + 0.5) / 64
    known: dict[str, tuple[float, float]] = {}
    if any(record.uncertain for record in file.records().values()):
        known = {
            prior.path: (prior.value, float(prior.quantile(fractions).std()))
            for prior in Priors.from_robot(file).parameters
        }
    return choose_experiments(file.spec(), known, target_accuracy)


def choose_experiments(
    spec: RobotSpec,
    known: Mapping[str, tuple[float, float]],
    targets: Mapping[str, float],
) -> ExperimentDesign:
    """Choose experiments until the requested accuracy is reached.

    The mapping `known` contains the value and the standard deviation of each uncertain
    parameter. The mapping `targets` contains the required half widths of 95 %
    intervals, relative to the parameter values.
    """
    if not targets:
        raise InputError(
            "--target-accuracy contains no parameters; give one or more, for example"
            " friction.mu_t=5%"
        )
    zero_scale = 0.1 * spec.friction.mu_t * spec.mass.total * GRAVITY
    names = list(dict.fromkeys([*targets, *known]))
    unknown = [name for name in names if name not in known]
    believed = {
        parameter.name: (parameter.start, np.inf)
        for parameter in free_parameters(spec, unknown)
    }
    believed |= known
    values = {name: believed[name][0] for name in names}
    scale = np.array([abs(value) or zero_scale for value in values.values()])
    std = np.array([believed[name][1] for name in names]) / scale
    information = np.diag(1 / np.minimum(std, _PRIOR_STD) ** 2)
    offered = list(candidates(spec))
    gains = [_information(each, spec, values, scale) for each in offered]
    goals = np.array(list(targets.values()))
    units = np.where([values[name] for name in targets], 1.0, zero_scale)

    def widths(matrix: Array) -> Array:
        variances = np.diag(np.linalg.inv(matrix))[: len(targets)]
        return np.asarray(1.96 * np.sqrt(variances) * units)

    chosen: list[int] = []
    reached = [widths(information)]
    while (too_wide := reached[-1] > goals).any():
        scores = np.full(len(gains), np.inf)
        for k, gain in enumerate(gains):
            if chosen.count(k) < _MAX_REPETITIONS:
                excess = np.maximum(widths(information + gain) / goals, 1.0)
                scores[k] = np.log(excess[too_wide]).mean()
        best = int(np.argmin(scores))
        information = information + gains[best]
        narrowed = widths(information)
        is_useful = narrowed[too_wide] < _MIN_NARROWING * reached[-1][too_wide]
        if not np.isfinite(scores[best]) or not is_useful.any():
            break
        chosen.append(best)
        reached.append(narrowed)
    before, *after = np.array(reached).tolist()
    return ExperimentDesign(
        tuple(offered[k] for k in chosen),
        {name: tuple(row[i] for row in after) for i, name in enumerate(targets)},
        dict(zip(targets, before, strict=True)),
        dict(targets),
    )


def _information(
    experiment: CandidateExperiment,
    spec: RobotSpec,
    values: Mapping[str, float],
    scale: Array,
) -> Array:
    """Return the information matrix JᵀR⁻¹J of an experiment.

    J is computed by central differences, or by one-sided differences for a parameter
    with value 0.
    """
    predicted = experiment.predict(spec)
    columns = []
    for (name, value), size in zip(values.items(), scale, strict=True):
        up = value + _STEP * size
        down = value - _STEP * size if value else 0.0
        ends = [
            experiment.predict(with_values(spec, {name: end})) for end in (up, down)
        ]
        columns.append((ends[0] - ends[1]) / ((up - down) / size))
    derivatives = np.stack(columns, axis=1) / experiment.noise(predicted)[:, None]
    return np.asarray(derivatives.T @ derivatives)
