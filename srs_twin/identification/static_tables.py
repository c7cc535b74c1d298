r"""Gains, rest bends and dead zones of free segments, fitted to static measurements.

**Tables.** A table is a CSV file with constant pressures and the bends at which free
segments come to rest. The columns are ``pressure_plus_1,pressure_minus_1,bend_1,…``
and, optionally, the standard errors ``bend_error_1,…``. A column name may include the
unit (``pressure_plus_1_kpa``, ``bend_1_deg``). A pressure without a column is assumed
to be 0. An empty cell marks a bend that was not measured. Static data do not determine
time constants or masses.

**Plateaus.** A table can also be computed from the plateaus of a recording. A plateau
is an interval in which all pressures stay within ±1 kPa, or within ±5 standard
deviations of the noise if this range is larger. The first 5 τ of each plateau, the last
50 ms and frames with pressure outliers are discarded, where τ is the largest time
constant of the robot. The first quarter of the remaining frames is discarded repeatedly
until the bend of a segment has settled. A bend has settled if its drift along a fitted
line is less than twice the standard error of the drift, or less than 0.1 mrad. The mean
bend has the standard error

$$ \sigma = \max\bigl(s / \sqrt{n/\tau_c},\; e/10\bigr), $$

where s is the standard deviation of n frames about the line, τ_c the
`correlation_time`, and e the recorded standard error of one frame (``bend_error_1``). A
tenth of e is assumed to be a systematic error, for example due to marker offsets, and
is not reduced by averaging.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from srs_twin.errors import InputError
from srs_twin.identification.actuator import (
    CLOCK_ERROR_S,
    MIN_DRIFT_RAD,
    MODULE_PARAMETERS,
    bend_residuals,
    fixed_values,
    log_of,
    measured_bends,
)
from srs_twin.identification.estimate import (
    FitEstimate,
    Residual,
    Role,
    correlation_time,
)
from srs_twin.identification.fit_file import DataSet, array_hash, assign_roles
from srs_twin.identification.least_squares import Watch, least_squares
from srs_twin.identification.parameters import free_parameters, per_segment, with_values
from srs_twin.io.files import StrPath, write_text
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.recordings.csv_table import first_line_names, read_table
from srs_twin.recordings.recorded_file import read_file
from srs_twin.recordings.recording import Recording, ValveLog
from srs_twin.recordings.signals.gaps import MIN_FRAMES
from srs_twin.recordings.signals.logs import SIDES, check_values
from srs_twin.recordings.signals.units import ANGLES, PRESSURES, is_clock
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

_PLATEAU_BAND_PA = 1e3
"""Half the maximum pressure range on a plateau, Pa."""

_OUTLIER_MEDIANS = 7.5
"""Minimum deviation of an outlier, as a multiple of the median absolute deviation."""

_OUTLIER_MARGIN_PA = 100.0
"""Constant part of the minimum deviation of an outlier, Pa."""

_BEND_LIMIT = "actuator.bend_limit_rad"
_ONSET_FRACTION = "actuator.onset_fraction"
_ONSET = "actuator.dead_zone_rad"
_ONSET_WIDTH = "actuator.dead_zone_transition_rad"
_DEAD_ZONE = (_ONSET, _ONSET_WIDTH, _ONSET_FRACTION)

_SHARP_WIDTH_RAD = 0.02
"""Assumed width of the dead-zone transition if the data do not determine it, rad."""


@dataclass(frozen=True)
class StaticTable:
    """Bends at constant pressures.

    Attributes:
        pressure: gauge pressures, Pa, shape (points, segments, 2).
        bend: measured bends, rad, shape (points, segments), with NaN for bends that
            were not measured.
        bend_error: standard errors of the bends, rad, shape (points, segments), with
            NaN for unknown errors.
    """

    name: str
    sha256: str
    pressure: np.ndarray
    bend: np.ndarray
    bend_error: np.ndarray | float = math.nan

    @classmethod
    def from_recording(
        cls, recording: Recording, name: str, spec: RobotSpec, supply_pa: float
    ) -> StaticTable:
        """Create a table from the plateaus of a recording that has a log.

        If the log contains valve states, filling chambers are assumed to be at the
        supply pressure after 5 τ, and venting chambers at zero gauge pressure. Times at
        which a chamber holds its air are excluded, because the chamber pressure is then
        unknown.
        """
        trajectory = recording.trajectory
        log = log_of(recording, name)
        time = trajectory.time
        bend = measured_bends(recording)
        pressure = _chamber_pressures(trajectory, log, supply_pa)
        band = np.maximum(_PLATEAU_BAND_PA, 3 * _noise_scale(log.values))
        frame_error = np.zeros_like(bend)
        if trajectory.has("bend_error"):
            frame_error = trajectory.stack("bend_error")
        actuator = spec.actuator
        wait = 5 * max(actuator.tau_fill, actuator.tau_vent, actuator.tau_mode)
        points = []
        longest = 0.0
        for begin, end in _constant_intervals(pressure, band):
            longest = max(longest, float(time[end - 1] - time[begin]))
            frames = _settled_frames(time, pressure, band, begin, end, wait)
            if frames is None:
                continue
            point = np.array(
                [
                    _settled_mean(
                        time[frames],
                        pressure[frames, j],
                        bend[frames, j],
                        frame_error[frames, j],
                    )
                    for j in range(spec.segments)
                ]
            )
            if np.isfinite(point[:, 2]).any():
                points.append(point)
        if not points:
            message = (
                f"{name}: the recording contains no plateau. The pressures are"
                f" constant for at most {longest:.2g} s, but {wait:.2g} s (5 times the"
                f" largest time constant) and {MIN_FRAMES} more frames with settled"
                " bends are needed"
            )
            if log.kind == "valve" and np.isnan(pressure).any():
                message += (
                    "; the pressure of a chamber whose valves hold (state 0) is"
                    " unknown, so also log the pressures"
                )
            raise InputError(message)
        table = np.array(points)
        return cls(
            name, array_hash(table), table[..., :2], table[..., 2], table[..., 3]
        )

    def data_set(self, role: Role) -> DataSet:
        """Return the name, hash and size of the table."""
        return DataSet(self.name, self.sha256, role, int(np.isfinite(self.bend).sum()))


def _chamber_pressures(
    trajectory: Trajectory, log: ValveLog, supply_pa: float
) -> np.ndarray:
    values = np.stack(
        [trajectory.stack(f"{log.kind}_{side}") for side in SIDES], axis=-1
    )
    if log.kind != "valve":
        return values
    return np.select([values == 1, values == -1], [supply_pa, 0.0], np.nan)


def _settled_frames(
    time: np.ndarray,
    pressure: np.ndarray,
    band: np.ndarray,
    begin: int,
    end: int,
    wait: float,
) -> np.ndarray | None:
    span = float(time[end - 1] - time[begin])
    deviation = np.abs(pressure[begin:end] - np.median(pressure[begin:end], axis=0))
    limit = _OUTLIER_MEDIANS * np.median(deviation, axis=0) + _OUTLIER_MARGIN_PA
    is_near = (deviation <= limit).all(axis=(1, 2))
    since = time[begin:end] - time[begin]
    # The end of a plateau is discarded, because the next step may already have begun
    # within the band and because the clocks may differ.
    frames = begin + np.flatnonzero(
        is_near & (since >= wait) & (since <= span - CLOCK_ERROR_S)
    )
    if len(frames) < MIN_FRAMES:
        return None
    # A slow ramp may stay within the band for some time, but is not a plateau.
    slope = np.polyfit(
        since[frames - begin], pressure[frames].reshape(len(frames), -1), 1
    )[0]
    if (np.abs(slope) * span > band.ravel()).any():
        return None
    return frames


def _constant_intervals(
    pressure: np.ndarray, band: np.ndarray
) -> Iterator[tuple[int, int]]:
    begin = 0
    low = pressure[0]
    high = pressure[0]
    for k, row in enumerate(pressure[1:], start=1):
        low = np.minimum(low, row)
        high = np.maximum(high, row)
        if not (high - low <= 2 * band).all():
            yield begin, k
            begin = k
            low = row
            high = row
    yield begin, len(pressure)


def _noise_scale(values: np.ndarray) -> np.ndarray:
    """Return the noise scale of a log, which is 1.65 σ for white noise.

    The scale is the smaller of two medians, computed from the magnitudes of the first
    and second differences. The first differences are multiplied by √3, so that both
    medians are equal for white noise. The first differences are insensitive to steps,
    and the second differences are insensitive to ramps.
    """
    medians = [
        scale * np.median(np.abs(np.diff(values, order, axis=0)), axis=0)
        for order, scale in ((1, math.sqrt(3)), (2, 1.0))
        if len(values) > order
    ]
    return np.asarray(np.min(medians, axis=0))


def _settled_mean(
    time: np.ndarray, pressure: np.ndarray, bend: np.ndarray, frame_error: np.ndarray
) -> list[float]:
    """Return the mean pressures, the mean bend and its standard error.

    The bend and its standard error are NaN if the bend does not settle.
    """
    kept = np.flatnonzero(np.isfinite(bend))
    while len(kept) >= MIN_FRAMES:
        since = time[kept] - time[kept].mean()
        slope, mean = np.polyfit(since, bend[kept], 1)
        residual = bend[kept] - mean - slope * since
        scatter = math.sqrt(
            residual @ residual / (len(kept) - 2) * correlation_time([residual], 2)
        )
        if abs(slope) <= max(
            2 * scatter / math.sqrt(since @ since), MIN_DRIFT_RAD / np.ptp(since)
        ):
            common_error = math.sqrt(np.mean(frame_error[kept] ** 2)) / 10
            return [
                *pressure[kept].mean(axis=0),
                mean,
                max(scatter / math.sqrt(len(kept)), common_error),
            ]
        kept = kept[len(kept) // 4 :]
    return [*pressure.mean(axis=0), math.nan, math.nan]


NamedRecordings = Sequence[tuple[str, Recording]]
"""Recordings that have logs, each paired with its name."""


def plateau_tables(
    recordings: NamedRecordings, spec: RobotSpec, supply_pa: float
) -> list[StaticTable]:
    """Return a table of the plateaus of each recording.

    Raises:
        InputError: a recording has no plateau, or a pressure has only two different
            values.
    """
    tables = [
        StaticTable.from_recording(recording, name, spec, supply_pa)
        for name, recording in recordings
    ]
    if any(log_of(recording, name).kind == "valve" for name, recording in recordings):
        return tables  # valve states correspond to only two pressures
    merged = merge_tables(tables)
    for j, k in np.ndindex(spec.segments, len(SIDES)):
        levels = np.sort(merged.pressure[np.isfinite(merged.bend[:, j]), j, k])
        levels = levels[np.diff(levels, prepend=-np.inf) > _PLATEAU_BAND_PA]
        if len(levels) == 2:
            raise InputError(
                f"the column 'pressure_{SIDES[k]}_{j + 1}' has only 2 different"
                " pressures; 3 or more are needed, to distinguish a line from a curve"
            )
    return tables


def merge_tables(tables: Sequence[StaticTable]) -> StaticTable:
    """Return one table with the points of several recordings."""
    arrays = [
        np.concatenate([getattr(table, name) for table in tables])
        for name in ("pressure", "bend", "bend_error")
    ]
    name = ", ".join(table.name for table in tables)
    return StaticTable(name, array_hash(*arrays), *arrays)


def write_static_table(table: StaticTable, path: StrPath) -> None:
    """Write a table with full precision, in the format of `read_static_table`."""
    points, segments = table.bend.shape
    header = [f"pressure_{side}_{j + 1}_pa" for j in range(segments) for side in SIDES]
    header += [
        f"{name}_{j + 1}_rad"
        for name in ("bend", "bend_error")
        for j in range(segments)
    ]
    error = np.broadcast_to(table.bend_error, table.bend.shape)
    rows = np.hstack([table.pressure.reshape(points, -1), table.bend, error]).tolist()
    lines = (",".join(map(repr, row)).replace("nan", "") for row in rows)
    write_text(path, "\n".join([",".join(header), *lines, ""]))


def is_static_table(path: StrPath) -> bool:
    """Return whether the header of a file has bend columns but no time column."""
    names = first_line_names(path)
    has_time = any(is_clock(name) for name in names)
    return not has_time and any(name.startswith("bend_") for name in names)


def read_static_table(path: StrPath, spec: RobotSpec) -> StaticTable:
    """Read a static table from a CSV file."""
    names = [*(f"pressure_{side}" for side in SIDES), "bend", "bend_error"]
    units = dict.fromkeys(names[:2], PRESSURES) | dict.fromkeys(names[2:], ANGLES)
    table = read_table(read_file(path), units)
    for column in table.columns:
        if not 1 <= column.number <= spec.segments:
            raise table.error(
                column,
                f"{column.text}: this segment does not exist; {spec.name} has"
                f" segments 1 to {spec.segments}",
            )
    if not any(column.name == "bend" for column in table.columns):
        raise table.file.error(
            "the column 'bend_1' is missing; a static table has the columns"
            " pressure_plus_1,pressure_minus_1,bend_1,…",
            1,
        )
    cells, _ = table.read(table.columns)
    check_values(table, table.columns, cells)
    values = np.zeros((len(cells), spec.segments, 4))
    values[..., 2:] = np.nan
    for k, column in enumerate(table.columns):
        values[:, column.number - 1, names.index(column.name)] = cells[:, k]
    pressure = values[..., :2]
    bend = values[..., 2]
    missing = np.isnan(pressure).any(axis=(1, 2))
    if missing.any():
        line = table.file.line_of_row(int(missing.argmax()), table.file.header_lines)
        problem = "a pressure is missing; give all pressures in every row"
        raise table.file.error(problem, line)
    if not np.isfinite(bend).any():
        raise table.file.error("the columns of bends contain no number")
    name = table.file.name
    return StaticTable(name, table.file.sha256, pressure, bend, values[..., 3])


def fit_static(
    tables: Sequence[StaticTable],
    spec: RobotSpec,
    *,
    names: Iterable[str] | None = None,
    validation: Sequence[StaticTable] = (),
    watch: Watch | None = None,
) -> FitEstimate:
    """Estimate gains, rest bends and the bend limit from static tables.

    By default, a dead zone is included if it improves the fit significantly (F-test,
    1 %). A dead zone in which segments do not respond is tried first, and then one with
    a reduced response. The parameter `actuator.bend_rad` is constant, as in
    `fit_actuator`.
    """
    data = assign_roles("static tables", tables, validation)
    largest = max(float(np.nanmax(np.abs(table.bend), initial=0.1)) for table in tables)
    unlimited = math.isinf(spec.actuator.bend_limit)

    def residuals(robot: RobotSpec) -> list[Residual]:
        result = []
        for table, role in data:
            rest = robot.modules.array("bias")
            difference = table.bend - rest - air_bend(robot, table.pressure)
            result += bend_residuals(table.name, difference, role, table.bend_error)
        return result

    def search(
        searched: Sequence[str], fixed: Mapping[str, float], starts: Mapping[str, float]
    ) -> FitEstimate:
        base = with_values(spec, fixed)
        unknowns = free_parameters(base, searched, starts=starts)
        estimate = least_squares(
            lambda values: residuals(with_values(base, values)),
            unknowns,
            held=fixed_values(base, unknowns) | dict(fixed),
            watch=watch,
        )
        is_reached = _BEND_LIMIT not in searched or _BEND_LIMIT in estimate.values
        if names is not None or not unlimited or is_reached:
            return estimate
        # If the data do not reach the bend limit, the fit is repeated without a limit,
        # because even a limit at the upper bound of the search would reduce the bends.
        without = search([name for name in searched if name != _BEND_LIMIT], fixed, {})
        return without.with_fixed([estimate[_BEND_LIMIT]])

    starts = {_BEND_LIMIT: min(1.5 * max(largest, 0.1), 6.0)} if unlimited else {}
    default = [*per_segment(spec, *MODULE_PARAMETERS), _BEND_LIMIT]
    searched = default if names is None else list(names)
    linear = search(searched, {}, starts)
    points = sum(np.isfinite(table.bend).sum() for table in tables)
    if (
        names is not None
        or spec.actuator.onset_fraction
        or points <= len(searched) + len(_DEAD_ZONE)
    ):
        return linear
    return _fit_dead_zone(search, linear, searched, starts, largest)


_StaticSearch = Callable[
    [Sequence[str], Mapping[str, float], Mapping[str, float]], FitEstimate
]
"""Search function, called with the free parameters, constants and initial values."""


def _fit_dead_zone(
    search: _StaticSearch,
    linear: FitEstimate,
    searched: Sequence[str],
    starts: Mapping[str, float],
    largest: float,
) -> FitEstimate:
    def with_dead_zone(
        zone_starts: Mapping[str, float], fixed: Mapping[str, float]
    ) -> FitEstimate:
        names = [*searched, *(name for name in _DEAD_ZONE if name not in fixed)]
        estimate = search(names, fixed, {**starts, **zone_starts})
        if estimate[_ONSET_WIDTH].value is not None:
            return estimate
        # The data do not determine the width of the transition, so the minimum width
        # is used.
        names.remove(_ONSET_WIDTH)
        sharp = {**fixed, _ONSET_WIDTH: _SHARP_WIDTH_RAD}
        return search(names, sharp, {**starts, _ONSET: zone_starts[_ONSET]})

    complete = with_dead_zone(
        {_ONSET: 0.4 * largest, _ONSET_WIDTH: 0.2 * largest}, {_ONSET_FRACTION: 1.0}
    )
    if not _is_significant(complete, linear):
        return linear
    partial = with_dead_zone({_ONSET_FRACTION: 0.8} | complete.values, {})
    best = partial if _is_significant(partial, complete) else complete
    why = (
        f"the residuals are {linear.rms('fit'):.3g} times the noise without a dead zone"
        f" and {best.rms('fit'):.3g} times with a dead zone"
    )
    onset = best[_ONSET]
    explained = replace(onset, why="; ".join(filter(None, (why, onset.why))))
    parameters = (explained if p is onset else p for p in best.parameters)
    return replace(best, parameters=tuple(parameters))


def _is_significant(more: FitEstimate, less: FitEstimate) -> bool:
    if any(more[p.name].value is None for p in more.parameters if p.name in _DEAD_ZONE):
        return False
    added = max(len(more.values) - len(less.values), 1)
    freedom = more.independent - len(more.values)
    ratio = ((less.rms("fit") or 0.0) / max(more.rms("fit") or 0.0, 1e-3)) ** 2 - 1
    return freedom > 0 and ratio * freedom / added > scipy.stats.f.ppf(
        0.99, added, freedom
    )
