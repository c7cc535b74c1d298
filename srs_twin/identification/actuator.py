"""Actuator parameters of free segments, estimated from step responses.

The data are time series of valve states or pressures and of the resulting bends. The
model is `pneumatics.LagPneumatics`, which is Eq. 14 of the dissertation for nominal
modules. All modules share the time constants τ_fill, τ_vent and τ_mode, whereas each
module has its own gain and rest bend.

The segments must bend freely, either on a bench or while the robot is lifted, because
contact with the floor also changes the bends. Scaling `actuator.bend_rad` has the same
effect as scaling the gains of all modules. A fit therefore keeps `actuator.bend_rad`
constant unless this parameter is requested.

If the log contains pressures instead of valve states, a delay of τ_mode approximates
the first-order lag of the bends. For pressures with time constant τ₁, the relative
error of this approximation is of the order of (τ_mode/τ₁)². The parameters τ_fill and
τ_vent cannot be identified from pressures.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.estimate import FitEstimate, Residual, Role
from srs_twin.identification.fit_file import DataSet, array_hash, assign_roles
from srs_twin.identification.least_squares import Watch, least_squares
from srs_twin.identification.parameters import (
    FreeParameter,
    free_parameters,
    per_segment,
    with_values,
)
from srs_twin.pneumatics import LagPneumatics, Schedule
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.recordings.recording import Recording, ValveLog
from srs_twin.recordings.signals.logs import SIDES
from srs_twin.robot.spec import RobotSpec

_BEND_NOISE_RAD = 0.01
"""Assumed standard deviation of a bend for which no error was recorded, rad."""

_PRESSURE_NOISE_PA = 500.0
"""Assumed standard deviation of a measured pressure, Pa."""

MIN_DRIFT_RAD = 1e-4
"""Maximum drift of a settled bend, and minimum standard error of a bend, rad."""

CLOCK_ERROR_S = 0.05
"""Standard error of an estimated clock offset, s."""

_BEND = "actuator.bend_rad"
MODULE_PARAMETERS = ("modules.gain_plus", "modules.gain_minus", "modules.bias_rad")


@dataclass(frozen=True)
class Response:
    """Bends of segments in response to valve states or measured pressures.

    Attributes:
        drive: schedule of valve states that starts at time 0, or pressure log with the
            clock of `time`.
        supply_pa: supply pressure (gauge), Pa, which is not used if pressures were
            logged.
        time: sample times in ascending order, s, shape (samples,).
        bend: measured bends, rad, shape (samples, segments), with NaN for unknown
            bends.
        pressure: pressures that were measured in addition to valve states, Pa, shape
            (samples, segments, 2), or None.
        clock_known: whether `drive` and `bend` use the same clock. Otherwise, the fit
            estimates the offset between their clocks.
    """

    name: str
    sha256: str
    drive: Schedule | ValveLog
    supply_pa: float
    time: np.ndarray
    bend: np.ndarray
    pressure: np.ndarray | None = None
    clock_known: bool = True

    @classmethod
    def from_recording(
        cls, recording: Recording, name: str, supply_pa: float
    ) -> Response:
        """Create a response from a recording and its valve or pressure log."""
        trajectory = recording.trajectory
        log = log_of(recording, name)
        about = trajectory.metadata.get("valve_log", {})
        bend = measured_bends(recording)
        drive: Schedule | ValveLog
        if log.kind == "valve":
            drive = log.schedule()
        else:
            drive = log.shifted(-float(log.time[0]))
        return cls(
            name,
            array_hash(bend, log.time, log.values),
            drive,
            supply_pa,
            trajectory.time - log.time[0],
            bend,
            clock_known=not about.get("offset_estimated"),
        )

    def data_set(self, role: Role) -> DataSet:
        """Return the name, hash and size of the response."""
        return DataSet(self.name, self.sha256, role, int(np.isfinite(self.bend).sum()))


def log_of(recording: Recording, name: str) -> ValveLog:
    """Return the valve or pressure log of a recording.

    Raises:
        InputError: the recording has no log.
    """
    if recording.valves is None:
        raise InputError(
            f"{name}: the recording has no log of valves or pressures; give one with"
            " --valves"
        )
    return recording.valves


def measured_bends(recording: Recording) -> np.ndarray:
    """Return the measured bends, rad, shape (samples, segments).

    The bend of a segment is NaN in frames in which a marker of this segment was
    interpolated.
    """
    trajectory = recording.trajectory
    bend = trajectory.stack("bend").copy()
    if trajectory.has("filled"):
        filled = trajectory.stack("filled") > 0
        bend[filled[:, :-1] | filled[:, 1:]] = np.nan
    return bend


def default_actuator_parameters(spec: RobotSpec) -> tuple[str, ...]:
    """Return the names of the parameters that `fit_actuator` estimates by default."""
    lags = ("actuator.tau_fill_s", "actuator.tau_vent_s", "actuator.tau_mode_s")
    return (*lags, *per_segment(spec, *MODULE_PARAMETERS))


def fit_actuator(
    responses: Sequence[Response],
    spec: RobotSpec,
    *,
    names: Iterable[str] | None = None,
    validation: Sequence[Response] = (),
    starts: int = 1,
    watch: Watch | None = None,
) -> FitEstimate:
    """Estimate time constants, gains and rest bends from measured responses.

    The search starts from the values in `spec`.
    """
    data = assign_roles("responses", responses, validation)
    for response, _ in data:
        if (bends := response.bend.shape[1]) != spec.segments:
            raise InputError(
                f"{response.name}: the recording has bends of {bends} segments, but"
                f" {spec.name} has {spec.segments} segments"
            )

    def residuals(values: Mapping[str, float]) -> list[Residual]:
        robot = with_values(spec, values)
        result: list[Residual] = []
        for k, (response, role) in enumerate(data):
            # Validation responses have no clock parameter, because validation data must
            # not influence the fit.
            clock = values.get(f"clock_{k}", 0.0)
            result += _response_residuals(response, robot, clock, role)
        return result

    if names is None:
        names = default_actuator_parameters(spec)
    unknowns = free_parameters(spec, names)
    bound = 4 * CLOCK_ERROR_S
    clocks = [
        FreeParameter(
            f"clock_{k}", "s", 0.0, -bound, bound, CLOCK_ERROR_S, nuisance=True
        )
        for k, response in enumerate(responses)
        if not response.clock_known
    ]
    held = fixed_values(spec, unknowns)
    return least_squares(
        residuals, [*unknowns, *clocks], starts=starts, held=held, watch=watch
    )


def fixed_values(
    spec: RobotSpec, unknowns: Sequence[FreeParameter]
) -> dict[str, float]:
    """Return the constants that define the scale of the fitted gains.

    These are the nominal supply pressure (kPa) and, unless it is a free parameter, the
    bend at this pressure (rad).
    """
    fixed = {"actuator.at_pressure_kpa": spec.supply.nominal / 1e3}
    if all(unknown.name != _BEND for unknown in unknowns):
        fixed[_BEND] = spec.actuator.gain * spec.supply.nominal
    return fixed


def predict_response(
    response: Response, spec: RobotSpec, clock: float = 0.0
) -> tuple[np.ndarray, np.ndarray | None]:
    """Predict the bends and chamber pressures of free segments.

    The offset `clock` (s) converts the sample times of the bends to the clock of the
    drive.

    Returns:
        Bends, rad, shape (samples, segments), and pressures, Pa, shape (samples,
        segments, 2). The pressures are None if the response contains logged pressures.
    """
    if isinstance(response.drive, ValveLog):
        delayed = response.drive.at(response.time + clock - spec.actuator.tau_mode)
        return spec.modules.array("bias") + air_bend(spec, delayed), None
    chambers = LagPneumatics(spec, supply_pa=response.supply_pa, layout="in_out")
    times = np.clip(response.time + clock, 0.0, response.drive.span)
    trace = chambers.advance(response.drive, times)
    return trace.bend, trace.pressure


def _response_residuals(
    response: Response, spec: RobotSpec, clock: float, role: Role
) -> Iterator[Residual]:
    bend, pressure = predict_response(response, spec, clock)
    yield from bend_residuals(response.name, response.bend - bend, role, math.nan)
    if response.pressure is not None and pressure is not None:
        for j, k in np.ndindex(spec.segments, len(SIDES)):
            signal = f"{response.name} pressure_{SIDES[k]}_{j + 1}"
            difference = (response.pressure - pressure)[:, j, k]
            yield Residual(signal, "Pa", difference, _PRESSURE_NOISE_PA, role)


def bend_residuals(
    name: str, difference: np.ndarray, role: Role, error: np.ndarray | float
) -> list[Residual]:
    """Return one series of bend residuals for each segment.

    The scale of a series is the RMS of the bend errors `error` (rad) of its segment. If
    an error is unknown, the scale is `_BEND_NOISE_RAD`.
    """
    residuals = []
    columns = zip(difference.T, np.broadcast_to(error, difference.shape).T, strict=True)
    for j, (column, errors) in enumerate(columns, start=1):
        measured = np.isfinite(column)
        square = (errors[measured] ** 2).sum() / max(measured.sum(), 1)
        noise = max(float(np.sqrt(square)), MIN_DRIFT_RAD)
        if math.isnan(square):
            noise = _BEND_NOISE_RAD
        signal = f"{name} bend_{j}"
        residuals.append(Residual(signal, "rad", column[measured], noise, role))
    return residuals
