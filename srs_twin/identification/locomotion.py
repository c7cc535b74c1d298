"""Fits of friction, lengths, masses or stiffness to runs of the crawling robot.

A plant is simulated with the recorded valve states or pressures, and the simulated
motion is compared with the measured motion. The compared signals are the
period-averaged speed and yaw rate ("averages"), the path, heading and bends over time
("shapes"), or all of these ("both").

Some parameters cannot be identified from these data. The motion depends only on ratios
of masses, and on the ratios of stiffness and damping to the masses. In the model
`complete`, the bends are prescribed, so the motion does not depend on the stiffness.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from srs_twin.comparison.metrics import plant_metrics
from srs_twin.control.base import Controller
from srs_twin.control.replay import Replay
from srs_twin.errors import DivergedError, InputError, UnknownNameError
from srs_twin.identification.estimate import (
    FitEstimate,
    Parameter,
    Residual,
    Role,
    half_width,
    verdict_on,
)
from srs_twin.identification.fit_file import DataSet, assign_roles, trajectory_hash
from srs_twin.identification.least_squares import (
    Search,
    SearchOptions,
    Watch,
    least_squares,
)
from srs_twin.identification.parameters import free_parameters, with_values
from srs_twin.plants.base import Plant
from srs_twin.pneumatics import Pneumatics
from srs_twin.recordings.body.trajectories import numbered_columns
from srs_twin.recordings.recorded_pressures import RecordedPressures
from srs_twin.recordings.recording import Recording, interpolated_values
from srs_twin.recordings.takes import NO_MARKERS
from srs_twin.robot.spec import RobotSpec
from srs_twin.rollout import rollout
from srs_twin.trajectory import Trajectory


def gait_run(recording: Recording, name: str, supply_pa: float) -> GaitRun:
    """Create a gait run from a recording with valve states or pressures."""
    trajectory = recording.trajectory
    if recording.only_bends:
        raise InputError(f"{name}: {NO_MARKERS}")
    controller = Replay(
        recording.commands(name), trajectory.metadata.get("gait_frequency_hz")
    )
    logged = recording.pressures()
    chambers = logged and (
        lambda spec: RecordedPressures(spec, *logged, supply_pa=supply_pa)
    )
    return GaitRun(trajectory, controller, supply_pa, name, chambers)


MEASURED_LENGTHS = ("geometry.rigid_gap_m", "geometry.segment_length_m")
"""Lengths whose sum is the segment pitch, which can be measured with markers."""

FROM_MARKERS = "measured from the markers, not from the walk"


def measured_length(
    recordings: Sequence[Recording], spec: RobotSpec, names: Sequence[str]
) -> Parameter | None:
    r"""Measure the rigid gap or the segment length from markers, if possible.

    The pitch is the sum of the rigid gap and the length of a straight segment. The
    requested length is the measured pitch minus the other length, which is taken from
    the robot file. With the gap g of the robot file, the markers determine the arc
    length ℓ of a segment at each bend q. The pitch then follows from the fitted
    coefficients a and b:

    $$ \ell = a + b\,q^2, \qquad \text{pitch} = a + g . $$

    The coefficient b covers the elongation of bent segments and the effect of an error
    in g. The standard error includes the scatter between segments due to marker
    placement, and the noise of the two outermost markers.

    Args:
        recordings: recordings, of which those without markers are ignored.
        spec: robot with which the recordings were read.
        names: requested parameters. If both the gap and the segment length are
            requested, the result is None, because markers determine only the pitch.
    """
    requested = [name for name in names if name in MEASURED_LENGTHS]
    marked = [
        recording for recording in recordings if recording.summary.markers is not None
    ]
    if len(requested) != 1 or not marked:
        return None
    parameter = free_parameters(spec, requested)[0]
    count = spec.segments
    straight_lengths = []
    for recording in marked:
        bends = recording.trajectory.stack("bend")
        lengths = recording.trajectory.stack("length")
        straight_lengths.append(
            [
                np.polyfit(q**2, length, 1)[1]
                for q, length in zip(bends.T, lengths.T, strict=True)
            ]
        )
    means = np.mean(straight_lengths, axis=0)
    value = parameter.start + float(means.mean()) - spec.geometry.segment_length
    noise = max(
        r.summary.markers.noise_m for r in marked if r.summary.markers is not None
    )
    scatter = float(means.std(ddof=1)) if count > 1 else 0.0
    error = math.hypot(scatter / math.sqrt(count), math.sqrt(2) * noise / count)
    half = half_width(error, max(count - 1, 1))
    value, low, high = (
        parameter.value(parameter.coordinate(v))
        for v in (value, value - half, value + half)
    )
    verdict = verdict_on(error, parameter.derivative(value))
    return Parameter(
        parameter.name, parameter.unit, verdict, value, error, low, high, FROM_MARKERS
    )


PLANTS = ("analytical", "twin")
AGAINST = ("averages", "shapes", "both")

NOISE = {
    "speed": (2e-3, "m/s"),
    "yaw_rate": (1e-2, "rad/s"),
    "path": (2e-3, "m"),
    "heading": (2e-2, "rad"),
    "bend": (2e-2, "rad"),
}
"""Expected standard deviation and unit of each signal.

If the bend error computed from the markers is larger, it is used instead.
"""

_STEP = 3e-2
"""Step of finite differences in z for analytical plants, whose residuals have kinks."""

_COARSE_STEP = 0.1

MAX_TWIN_RUNS = 150
"""Maximum number of model runs in a search with the twin."""

_CLOSE_STEPS = {"tolerance": 2e-5}  # m/s, multiplied by the time scale of the robot
"""Settings of an analytical plant with prescribed bends in a fit.

The tolerance is a tenth of the default value. With the default value, step-size control
would affect finite differences more than the parameters do.
"""

_COMPLIANT_STEPS = _CLOSE_STEPS | {
    "timestep": 0.0005,
    "slip_speed": 0.001,
}  # s and m/s, multiplied by the time scale of the robot
"""Settings of the model `compliant` in a fit.

With the default time step of 2 ms and slip speed of 0.25 mm/s, the sum of squares has
many local minima that are a few standard errors apart. The twin also uses a slip speed
of 1 mm/s.
"""

_DIVERGED_RESIDUAL = 1e3
"""Residual assigned to each sample of a diverged simulation."""

_MAX_RATE_HZ = 50.0
"""Maximum sampling rate at which shapes are compared, Hz."""


@dataclass(frozen=True)
class GaitRun:
    """Measured run of the crawling robot.

    Attributes:
        trajectory: measured motion from rest, with the gait frequency in the metadata.
        controller: controller that replays the recorded valve states.
        supply_pa: supply pressure, Pa.
        chambers: function that creates a pneumatic model with the recorded pressures,
            or None if valve states were recorded.
    """

    trajectory: Trajectory
    controller: Controller
    supply_pa: float
    name: str
    chambers: Callable[[RobotSpec], Pneumatics] | None = None

    def data_set(self, role: Role) -> DataSet:
        """Return the name, hash and size of the run."""
        return DataSet(
            self.name, trajectory_hash(self.trajectory), role, len(self.trajectory)
        )


@dataclass(frozen=True)
class PlantModel:
    """Plant that simulates the robot in a fit.

    Attributes:
        plant: name of the plant, "analytical" or "twin".
        settings: settings of the plant, such as model="compliant", which override the
            default settings of fits.
    """

    plant: str = "analytical"
    settings: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.plant not in PLANTS:
            raise UnknownNameError("plant", self.plant, PLANTS)

    def search_options(self, compare_signals: str) -> SearchOptions:
        """Return the search settings for this plant.

        The motion of the twin is a smooth function of z down to steps of 1e-3. Path and
        heading vary monotonically with z only within 1e-2 of the solution, whereas
        bends do so within 1. The first stage of a search with the twin therefore uses
        only the bends. The model `compliant` has finer kinks than the twin, and all of
        its signals vary monotonically.
        """
        if self.plant == "twin":
            staged = compare_signals != "averages"
            return SearchOptions(
                step=3e-3,
                coarse_step=3e-2,
                tolerance=3e-4,
                first_stage=_is_bend if staged else None,
                identifiability_step=3e-2,
                target_rms=1e-2,
                max_runs=MAX_TWIN_RUNS,
            )
        if self.settings.get("model") == "compliant":
            return SearchOptions(
                step=1e-2,
                coarse_step=3e-2,
                tolerance=1e-4,
                first_stage=lambda residual: True,
                identifiability_step=1e-2,
            )
        return SearchOptions(_STEP, _COARSE_STEP)

    def build(
        self, spec: RobotSpec, supply_pa: float, chambers: Pneumatics | None = None
    ) -> Plant:
        """Create the plant for a robot.

        The argument `chambers` is a pneumatic model, or None for the default model.
        """
        settings = dict(self.settings)
        if chambers is not None:
            settings["pneumatics"] = chambers
        if self.plant == "twin":
            from srs_twin.plants.twin.snake import TwinSnake

            return TwinSnake(spec, supply_pa=supply_pa, **settings)
        from srs_twin.plants.analytical import AnalyticalSnake

        is_compliant = settings.get("model") == "compliant"
        steps = _COMPLIANT_STEPS if is_compliant else _CLOSE_STEPS
        for name, value in steps.items():
            settings.setdefault(name, value * spec.scale.time)
        return AnalyticalSnake(spec, supply_pa=supply_pa, **settings)

    def simulate(self, run: GaitRun, spec: RobotSpec) -> Trajectory:
        """Simulate the plant with the recorded valve states or pressures of a run.

        Raises:
            DivergedError: the simulation diverged.
        """
        chambers = run.chambers and run.chambers(spec)
        plant = self.build(spec, run.supply_pa, chambers)
        span = float(run.trajectory.time[-1] - run.trajectory.time[0])
        duration = math.ceil(span / plant.tick - 1e-9) * plant.tick
        return rollout(plant, run.controller, duration, record_hz=1 / plant.tick)


def _is_bend(residual: Residual) -> bool:
    return " bend_" in residual.name


class _Data(NamedTuple):
    run: GaitRun
    measured: dict[str, np.ndarray]
    role: Role


@dataclass(frozen=True)
class _Comparison:
    model: PlantModel
    spec: RobotSpec
    compare_signals: str

    def data(self, run: GaitRun, role: Role) -> _Data:
        measured = signals(run.trajectory, None, self.compare_signals, run.name)
        return _Data(run, measured, role)

    def simulated(
        self, data: Sequence[_Data], plant: PlantModel, values: Mapping[str, float]
    ) -> list[_Data]:
        robot = with_values(self.spec, values)
        return [
            self.data(replace(run, trajectory=plant.simulate(run, robot)), role)
            for run, _, role in data
        ]

    def residuals(
        self, data: Sequence[_Data], values: Mapping[str, float]
    ) -> list[Residual]:
        robot = with_values(self.spec, values)
        result: list[Residual] = []
        for run, measured, role in data:
            predicted: dict[str, np.ndarray] = {}
            with suppress(DivergedError):
                simulation = self.model.simulate(run, robot)
                predicted = signals(
                    simulation, run.trajectory, self.compare_signals, run.name
                )
            for name, signal in measured.items():
                difference = np.full_like(signal, _DIVERGED_RESIDUAL)
                if predicted:
                    difference = signal - predicted[name]
                kind = name if name in NOISE else name.rpartition("_")[0]
                scale, unit = NOISE[kind]
                error_name = name.replace("bend", "bend_error")
                error = run.trajectory.columns.get(error_name)
                if kind == "bend" and error is not None:
                    scale = max(scale, float(np.sqrt(np.mean(error**2))))
                result.append(
                    Residual(f"{run.name} {name}", unit, difference, scale, role)
                )
        return result


def fit_locomotion(
    runs: Sequence[GaitRun],
    spec: RobotSpec,
    names: Iterable[str],
    *,
    model: PlantModel | None = None,
    compare_signals: str = "averages",
    validation: Sequence[GaitRun] = (),
    starts: int = 3,
    watch: Watch | None = None,
    reference: PlantModel | None = None,
    known: Sequence[Parameter] = (),
) -> FitEstimate:
    """Fit parameters of a robot to gait runs.

    Args:
        runs: measured runs.
        spec: robot with the initial values and the constant values.
        names: names of the free parameters, as defined in the module `parameters`.
        model: plant that simulates the robot, by default the analytical plant.
        compare_signals: signals to compare, "averages", "shapes" or "both".
        validation: runs that are used only for validation.
        starts: number of searches, each from a different starting point. A single
            search is sufficient only if shapes are compared with the twin.
        watch: progress callback.
        reference: better model of the robot, from which the bias due to model errors is
            estimated (see `least_squares`). Without a reference, the intervals assume
            that the model is correct.
        known: measured parameters, which are constant in the fit.
    """
    if compare_signals not in AGAINST:
        raise UnknownNameError("residual", compare_signals, AGAINST)
    fixed = {parameter.name: parameter.value or 0.0 for parameter in known}
    spec = with_values(spec, fixed)
    unknowns = free_parameters(spec, [name for name in names if name not in fixed])
    comparison = _Comparison(model or PlantModel(), spec, compare_signals)
    data = [
        comparison.data(run, role)
        for run, role in assign_roles("gait runs", runs, validation)
    ]
    fitted = data[: len(runs)]
    if not unknowns and known:
        return FitEstimate(
            (), np.zeros((0, 0)), tuple(comparison.residuals(data, {}))
        ).with_fixed(known)
    options = comparison.model.search_options(compare_signals)

    def refit(values: Mapping[str, float]) -> dict[str, float]:
        assert reference is not None
        simulated = comparison.simulated(fitted, reference, values)
        search = Search(
            partial(comparison.residuals, simulated), unknowns, options, None
        )
        # The search starts where the fit started, so that it finds the same local
        # minimum.
        return search.values(search.run(search.start).z)

    estimate = least_squares(
        partial(comparison.residuals, fitted),
        unknowns,
        options=options,
        starts=starts,
        watch=watch,
        validation=partial(comparison.residuals, data[len(runs) :]),
        refit=refit if reference else None,
    )
    return estimate.with_fixed(known)


def signals(
    trajectory: Trajectory, measured: Trajectory | None, compare_signals: str, name: str
) -> dict[str, np.ndarray]:
    """Return the signals that are compared, each of shape (samples,).

    If `measured` is given, the times and the pose of the simulated `trajectory` are
    aligned with the measured run.
    """
    result: dict[str, np.ndarray] = {}
    if compare_signals != "shapes":
        metrics = plant_metrics(trajectory)
        if metrics["com_speed_m_s"] is None:
            raise InputError(
                f"{name}: the speed cannot be averaged over gait periods; record three"
                " or more complete periods, and give `gait_frequency_hz` in the metadata"
            )
        result["speed"] = np.array([metrics["com_speed_m_s"]])
        result["yaw_rate"] = np.array([metrics["yaw_rate_rad_s"]])
    if compare_signals != "averages":
        result |= _shapes(
            trajectory, measured or trajectory, is_aligned=measured is not None
        )
    return result


def _shapes(
    trajectory: Trajectory, measured: Trajectory, *, is_aligned: bool
) -> dict[str, np.ndarray]:
    span = measured.time[-1] - measured.time[0]
    count = min(len(measured), int(span * _MAX_RATE_HZ) + 1)
    clock = np.linspace(0.0, span, count)

    def resample(run: Trajectory, values: np.ndarray) -> np.ndarray:
        return interpolated_values(clock, run.time - run.time[0], values)

    path = resample(trajectory, trajectory.com)
    heading = resample(trajectory, trajectory["heading"])
    if is_aligned:
        # A simulated run starts at the origin, so the paths are aligned before their
        # shapes are compared.
        target = resample(measured, measured.com)
        target_heading = resample(measured, measured["heading"])
        turn = float((target_heading - heading).mean())
        c = math.cos(turn)
        s = math.sin(turn)
        turned = (path - path.mean(axis=0)) @ [[c, s], [-s, c]]
        path = turned + target.mean(axis=0)
        heading = heading + turn
    shapes = {"path_x": path[:, 0], "path_y": path[:, 1], "heading": heading}
    return shapes | numbered_columns(
        "bend", resample(trajectory, trajectory.stack("bend"))
    )
