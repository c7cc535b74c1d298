r"""Actuator from step responses: what valves or pressures did, and how far the segments bent.

Predictions are those of `pneumatics.LagPneumatics`, Eq. 14 for nominal modules: τ_fill, τ_vent and τ_mode
of all modules, gain and bias of each chamber's own. Segments must bend freely, on a bench or lifted: on the
floor the load of the body is in the bends as well. `actuator.bend_rad` and all gains together cannot be
told apart, so it is held unless asked for.

Of a log of pressures instead of valves, bends follow the pressures by τ_mode, taken as a delay (for pressures
that change in τ₁ that errs by (τ_mode/τ₁)²); what fills the chambers cannot be told from it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.data_set import DataSet, fingerprint, keep_apart, trajectory_hash
from srs_twin.identification.estimate import Estimate, Residual, Role
from srs_twin.identification.least_squares import least_squares
from srs_twin.identification.recording import Recording
from srs_twin.identification.search import Watch
from srs_twin.identification.unknowns import Unknown, per_segment, unknowns, with_values
from srs_twin.identification.valve_log import SIDES, ValveLog
from srs_twin.pneumatics import LagPneumatics, Schedule
from srs_twin.pneumatics.bending import air_bend
from srs_twin.spec import RobotSpec
from srs_twin.trajectory import Trajectory

_BEND_NOISE = 0.01  # rad
_PRESSURE_NOISE = 500.0  # Pa
_CLOCK = 0.05  # s: how far an estimated offset may be wrong


@dataclass(frozen=True)
class Response:
    """What segments did when their valves were switched, or under measured pressures.

    Attributes:
        name: of the data.
        sha256: of them.
        drive: valve states from time 0 on, or a log of pressures on the same clock.
        supply_pa: gauge pressure of the supply, Pa; of no matter to a log of pressures.
        time: of the samples, ascending, shape (samples,), s.
        bend: measured, shape (samples, segments), rad; NaN where it is not known.
        pressure: measured while valves were switched, shape (samples, segments, 2), Pa, or None.
        clock_known: whether drive and bends share a clock; if not, what lies between them is found along.
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
    def of_rollout(
        cls, trajectory: Trajectory, name: str, supply_pa: float, *, pressures: bool = False
    ) -> Response:
        """Return the response of a plant: edges are taken to fall on samples.

        Args:
            trajectory: what `rollout` gave, from rest.
            name: what to call it.
            supply_pa: Pa.
            pressures: whether its pressures count as measured.
        """
        time = trajectory.time - trajectory.time[0]
        states = _sides(trajectory, "valve").astype(np.int8)[1:]  # those that led to a sample
        starts = np.append(0, np.flatnonzero((states[1:] != states[:-1]).any(axis=(1, 2))) + 1)
        schedule = Schedule(float(time[-1]), time[starts], np.ascontiguousarray(states[starts]))
        measured = _sides(trajectory, "pressure") if pressures else None
        return cls(
            name, trajectory_hash(trajectory), schedule, supply_pa, time, trajectory.stack("bend"), measured
        )

    @classmethod
    def of_recording(cls, recording: Recording, name: str, supply_pa: float) -> Response:
        """Return the response in a recording that was joined with its log, without samples that were filled.

        Raises:
            InputError: there is no log.
        """
        trajectory, log = recording.trajectory, recording.valves
        if log is None:
            raise InputError(f"{name}: no log of valves or pressures; join one with the recording")
        about = trajectory.metadata.get("valve_log")
        known = not (isinstance(about, Mapping) and about.get("offset_estimated"))
        bend = trajectory.stack("bend").copy()
        if trajectory.has("filled"):
            filled = trajectory.stack("filled") > 0
            bend[filled[:, :-1] | filled[:, 1:]] = np.nan
        drive = log.schedule() if log.kind == "valve" else log.shifted(-float(log.time[0]))
        hashed = fingerprint(bend, log.time, log.values)
        time = trajectory.time - log.time[0]
        return cls(name, hashed, drive, supply_pa, time, bend, clock_known=known)

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""
        return DataSet(self.name, self.sha256, role, int(np.isfinite(self.bend).sum()))


def actuator_unknowns(spec: RobotSpec) -> tuple[str, ...]:
    """Return what `fit_actuator` looks for by itself."""
    return (
        "actuator.tau_fill_s", "actuator.tau_vent_s", "actuator.tau_mode_s",
        *per_segment(spec, "modules.gain_plus", "modules.gain_minus", "modules.bias_rad"),
    )  # fmt: skip


def fit_actuator(
    responses: Sequence[Response],
    spec: RobotSpec,
    *,
    names: Iterable[str] | None = None,
    validation: Sequence[Response] = (),
    starts: int = 1,
    noise: float = _BEND_NOISE,
    watch: Watch | None = None,
) -> Estimate:
    """Return time constants, gains and biases from responses.

    Args:
        responses: what was measured.
        spec: the robot that the search starts from.
        names: what is unknown, see `unknowns`; default `actuator_unknowns`.
        validation: responses to hold the estimate against.
        starts: how many searches.
        noise: of a measured bend, rad.
        watch: is told how far the search is, see `least_squares`.

    Raises:
        InputError: no response, responses of another robot, or one to validate with that is also fitted.
    """
    if not responses:
        raise InputError("responses are wanted; none was given")
    everything: list[tuple[Response, Role]] = [
        *((each, "fit") for each in responses), *((each, "validation") for each in validation)
    ]  # fmt: skip
    keep_apart(each.data_set(role) for each, role in everything)
    for each, _ in everything:
        if each.bend.shape[1] != spec.segments:
            raise InputError(
                f"{each.name}: {each.bend.shape[1]} bends; {spec.name} has {spec.segments} segments"
            )

    def residuals(values: Mapping[str, float]) -> list[Residual]:
        robot = with_values(spec, values)
        found: list[Residual] = []
        for k, (response, role) in enumerate(everything):
            # What validates has no say in anything, its clock neither.
            clock = values.get(f"clock_{k}", 0.0)
            found += _compared(response, robot, clock, noise, role)
        return found

    clocks = [
        Unknown(f"clock_{k}", "s", 0.0, -_CLOCK * 4, _CLOCK * 4, _CLOCK, nuisance=True)
        for k, response in enumerate(responses) if not response.clock_known
    ]  # fmt: skip
    wanted = unknowns(spec, actuator_unknowns(spec) if names is None else names)
    held = {"actuator.at_pressure_kpa": spec.supply.nominal / 1e3}
    if all(each.name != "actuator.bend_rad" for each in wanted):
        held["actuator.bend_rad"] = spec.actuator.gain * spec.supply.nominal
    return least_squares(residuals, [*wanted, *clocks], starts=starts, held=held, watch=watch)


def predicted(
    response: Response, spec: RobotSpec, clock: float = 0.0
) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the bends (samples, segments), rad, and pressures (samples, segments, 2), Pa, of free segments.

    Args:
        response: what was done, and when it is looked at.
        spec: the robot.
        clock: what the drive's clock shows more, s.
    """
    if isinstance(response.drive, ValveLog):
        delayed = response.drive.at(response.time + clock - spec.actuator.tau_mode)
        return spec.modules.array("bias") + air_bend(spec, delayed), None
    chambers = LagPneumatics(spec, supply_pa=response.supply_pa, layout="in_out")
    times = np.clip(response.time + clock, 0.0, response.drive.span)
    trace = chambers.advance(response.drive, times)
    return trace.bend, trace.pressure


def _compared(response: Response, spec: RobotSpec, clock: float, noise: float, role: Role) -> list[Residual]:
    bend, pressure = predicted(response, spec, clock)
    found = []
    for j in range(spec.segments):
        known = np.isfinite(response.bend[:, j])
        off = (response.bend[:, j] - bend[:, j])[known]
        found.append(Residual(f"{response.name} bend_{j + 1}", "rad", off, noise, role))
    if response.pressure is not None and pressure is not None:
        for j in range(spec.segments):
            for s, side in enumerate(SIDES):
                off = response.pressure[:, j, s] - pressure[:, j, s]
                name = f"{response.name} pressure_{side}_{j + 1}"
                found.append(Residual(name, "Pa", off, _PRESSURE_NOISE, role))
    return found


def _sides(trajectory: Trajectory, name: str) -> np.ndarray:
    return np.stack([trajectory.stack(f"{name}_{side}") for side in SIDES], axis=-1)
