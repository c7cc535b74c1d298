"""Actuators of free segments: time constants, gains and biases from responses and from held pressures.

**Responses.** What valves or pressures did, and how far the segments bent. Predictions are those of
`pneumatics.LagPneumatics`, Eq. 14 for nominal modules: τ_fill, τ_vent and τ_mode of all modules, gain and
bias of each chamber's own. Segments must bend freely, on a bench or lifted: on the floor the load of the
body is in the bends as well. `actuator.bend_rad` and all gains together cannot be told apart, so it is held
unless asked for. Of a log of pressures instead of valves, bends follow the pressures by τ_mode, taken as a
delay (for pressures that change in τ₁ that errs by (τ_mode/τ₁)²); what fills the chambers cannot be told
from it.

**Static tables.** Pressures that were held, and the bends at which free segments came to rest, in a plain CSV
file with ``pressure_plus_1,pressure_minus_1,bend_1,…`` (``pressure_plus_1_kpa``, ``bend_1_deg``; Pa and rad
without a unit). A pressure that is not there is 0, an empty bend was not measured. Gain, bias and bend limit
can be told from it; nothing that takes time, and no mass.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.estimate import Estimate, Residual, Role
from srs_twin.identification.fit_file import DataSet, fingerprint, with_roles
from srs_twin.identification.least_squares import Watch, least_squares
from srs_twin.identification.unknowns import Unknown, per_segment, unknowns, with_values
from srs_twin.pneumatics import LagPneumatics, Schedule
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.recordings.csv_table import ANGLES, PRESSURES, first_line_names, read_file, read_table
from srs_twin.recordings.logs import SIDES, ValveLog
from srs_twin.recordings.recording import Recording
from srs_twin.robot.spec import RobotSpec

_BEND_NOISE = 0.01  # rad
_PRESSURE_NOISE = 500.0  # Pa
_CLOCK = 0.05  # s: how far an estimated offset may be wrong
_MOST_PRESSURE = 2e6  # Pa
_MOST_BEND = 2 * math.pi
_BEND, _LIMIT = "actuator.bend_rad", "actuator.bend_limit_rad"
_OWN = ("modules.gain_plus", "modules.gain_minus", "modules.bias_rad")


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
    lags = ("actuator.tau_fill_s", "actuator.tau_vent_s", "actuator.tau_mode_s")
    return (*lags, *per_segment(spec, *_OWN))


def fit_actuator(
    responses: Sequence[Response],
    spec: RobotSpec,
    *,
    names: Iterable[str] | None = None,
    validation: Sequence[Response] = (),
    starts: int = 1,
    watch: Watch | None = None,
) -> Estimate:
    """Return time constants, gains and biases from responses.

    Args:
        responses: what was measured.
        spec: the robot that the search starts from.
        names: what is unknown, see `unknowns`; default `actuator_unknowns`.
        validation: responses to hold the estimate against.
        starts: how many searches.
        watch: is told how far the search is, see `least_squares`.

    Raises:
        InputError: no response, responses of another robot, or one to validate with that is also fitted.
    """
    everything = with_roles("responses", responses, validation)
    for each, _ in everything:
        if (bends := each.bend.shape[1]) != spec.segments:
            raise InputError(f"{each.name}: {bends} bends; {spec.name} has {spec.segments} segments")

    def residuals(values: Mapping[str, float]) -> list[Residual]:
        robot = with_values(spec, values)
        found: list[Residual] = []
        for k, (response, role) in enumerate(everything):
            # What validates has no say in anything, its clock neither.
            found += _compared(response, robot, values.get(f"clock_{k}", 0.0), role)
        return found

    clocks = [
        Unknown(f"clock_{k}", "s", 0.0, -_CLOCK * 4, _CLOCK * 4, _CLOCK, nuisance=True)
        for k, response in enumerate(responses)
        if not response.clock_known
    ]
    wanted = unknowns(spec, actuator_unknowns(spec) if names is None else names)
    held = _held(spec, wanted)
    return least_squares(residuals, [*wanted, *clocks], starts=starts, held=held, watch=watch)


def _held(spec: RobotSpec, wanted: Sequence[Unknown]) -> dict[str, float]:
    """Return what gains refer to: nominal pressure, and the bend there unless it is looked for."""
    held = {"actuator.at_pressure_kpa": spec.supply.nominal / 1e3}
    if all(each.name != _BEND for each in wanted):
        held[_BEND] = spec.actuator.gain * spec.supply.nominal
    return held


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


def _compared(response: Response, spec: RobotSpec, clock: float, role: Role) -> list[Residual]:
    bend, pressure = predicted(response, spec, clock)
    found = _bend_residuals(response.name, response.bend - bend, role)
    if response.pressure is not None and pressure is not None:
        off = response.pressure - pressure
        for j, (plus, minus) in enumerate(off.transpose(1, 2, 0), start=1):
            for side, values in (("plus", plus), ("minus", minus)):
                name = f"{response.name} pressure_{side}_{j}"
                found.append(Residual(name, "Pa", values, _PRESSURE_NOISE, role))
    return found


def _bend_residuals(name: str, off: np.ndarray, role: Role) -> list[Residual]:
    """Return residuals of bends by segment, without those that were not measured."""
    return [
        Residual(f"{name} bend_{j + 1}", "rad", column[np.isfinite(column)], _BEND_NOISE, role)
        for j, column in enumerate(off.T)
    ]


@dataclass(frozen=True)
class StaticTable:
    """Bends under held pressures.

    Attributes:
        name: of the file.
        sha256: of it.
        pressure: gauge, shape (points, segments, 2), Pa.
        bend: shape (points, segments), rad; NaN where it was not measured.
    """

    name: str
    sha256: str
    pressure: np.ndarray
    bend: np.ndarray

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""
        return DataSet(self.name, self.sha256, role, int(np.isfinite(self.bend).sum()))


def is_static(path: str | os.PathLike[str]) -> bool:
    """Say whether a file's first line names bends as its columns: a table, no recording.

    Raises:
        InputError: the file cannot be read.
    """
    return any(name.startswith("bend_") for name in first_line_names(path))


def read_static(path: str | os.PathLike[str], spec: RobotSpec) -> StaticTable:
    """Read a static table.

    Raises:
        InputError: no such file, no bends, columns of other segments, or values that no robot has.
    """
    names = [*(f"pressure_{side}" for side in SIDES), "bend"]
    table = read_table(read_file(path), dict.fromkeys(names[:2], PRESSURES) | {"bend": ANGLES})
    for each in table.columns:
        if not 1 <= each.number <= spec.segments or each.letter:
            raise table.error(each, f"{each.text}: {spec.name} has segments 1 to {spec.segments}")
    if not any(each.name == "bend" for each in table.columns):
        example = "pressure_plus_1,pressure_minus_1,bend_1,…"
        raise table.file.error(f"no column 'bend_1'; a static table has {example}", 1)
    given, _ = table.read(table.columns)
    values = np.zeros((len(given), spec.segments, 3))
    values[..., 2] = np.nan
    for each, column in zip(table.columns, given.T, strict=True):
        values[:, each.number - 1, names.index(each.name)] = column
    pressure, bend = values[..., :2], values[..., 2]
    if not (np.abs(pressure) <= _MOST_PRESSURE).all():
        allowed = f"from {-_MOST_PRESSURE:g} to {_MOST_PRESSURE:g} Pa"
        raise table.file.error(f"pressures {allowed} are wanted, in every row")
    if not np.isfinite(bend).any() or (np.abs(bend) > _MOST_BEND).any():
        wanted = f"bends up to {_MOST_BEND:.3g} rad are wanted"
        raise table.file.error(f"{wanted}; is the unit right (bend_1_deg)?")
    return StaticTable(table.file.name, table.file.sha256, pressure, bend)


def fit_static(
    tables: Sequence[StaticTable],
    spec: RobotSpec,
    *,
    names: Iterable[str] | None = None,
    validation: Sequence[StaticTable] = (),
    watch: Watch | None = None,
) -> Estimate:
    """Return gains, biases and the bend limit from static tables.

    Args:
        tables: what was measured; the residual of each point is in the estimate.
        spec: the robot that the search starts from; `actuator.bend_rad` is held, as in `fit_actuator`.
        names: what is unknown, see `unknowns`; default gains, biases and the bend limit.
        validation: tables to hold the estimate against.
        watch: is told how far the search is, see `least_squares`.

    Raises:
        InputError: no table, or one to validate with that is also fitted.
    """
    everything = with_roles("static tables", tables, validation)

    def residuals(values: Mapping[str, float]) -> list[Residual]:
        robot, found = with_values(spec, values), []
        for table, role in everything:
            off = table.bend - robot.modules.array("bias") - air_bend(robot, table.pressure)
            found += _bend_residuals(table.name, off, role)
        return found

    wanted = [*per_segment(spec, *_OWN), _LIMIT] if names is None else list(names)
    largest = max(float(np.nanmax(np.abs(table.bend), initial=0.1)) for table in tables)
    starts = {_LIMIT: min(1.5 * max(largest, 0.1), 6.0)} if math.isinf(spec.actuator.bend_limit) else {}
    looked_for = unknowns(spec, wanted, starts=starts)
    return least_squares(residuals, looked_for, held=_held(spec, looked_for), watch=watch)
