r"""Actuators of free segments: time constants, gains and biases from responses and from held pressures.

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
can be told from it; nothing that takes time, and no mass. ``bend_error_1`` is a bend's standard error; it may
be left out.

**Plateaus** of a recording make such a table. A plateau begins where all pressures stay within ±1 kPa (or ±5
standard deviations of their noise); its first 5 τ, τ the robot's slowest time constant, its last 50 ms and
outliers of pressure are left out. Of what follows the first quarter is left out again and again, for each
segment, until a line through the bends drifts by less than twice its standard error, or by less than 0.1 mrad
over the frames. Bends and pressures are averaged over the rest. The standard error of a mean bend is

$$ \sigma = \max\bigl(s / \sqrt{n/\tau_c},\; e/10\bigr), $$

s the scatter of n frames about the line, τ_c its `correlation_time`, and e the standard error of one frame
where the recording has it (``bend_error_1``). That is nearly white from frame to frame, but a tenth of it is
taken to come from what is the same in all frames, such as offsets of markers, and does not average out.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.stats

from srs_twin.errors import InputError
from srs_twin.identification.estimate import Estimate, Residual, Role, correlation_time
from srs_twin.identification.fit_file import DataSet, fingerprint, with_roles
from srs_twin.identification.least_squares import Watch, least_squares
from srs_twin.identification.unknowns import Unknown, per_segment, unknowns, with_values
from srs_twin.io.files import write_text
from srs_twin.pneumatics import LagPneumatics, Schedule
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.recordings.csv_table import first_line_names, read_file, read_table
from srs_twin.recordings.recording import Recording
from srs_twin.recordings.signals.gaps import MIN_FRAMES
from srs_twin.recordings.signals.logs import SIDES
from srs_twin.recordings.signals.units import ANGLES, PRESSURES, is_clock
from srs_twin.recordings.signals.valve_log import ValveLog
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

_BEND_NOISE = 0.01  # rad
_PRESSURE_NOISE = 500.0  # Pa
_HELD = 1e3  # Pa: held pressures stay this near to their mean
_NEAR, _ALIKE = 7.5, 100.0  # of held pressures: medians of their distances, and Pa more
_DRIFT = 1e-4  # rad over a plateau: bends that change by less are settled, and none is better known
_CLOCK = 0.05  # s: how far an estimated offset may be wrong
_MOST_PRESSURE = 2e6  # Pa
_MOST_BEND = 2 * math.pi
_BEND, _LIMIT = "actuator.bend_rad", "actuator.bend_limit_rad"
_CORNER = 0.02  # rad: width of a dead zone whose data show none
_SHARE, _LATE = "actuator.onset_share", ("actuator.onset_rad", "actuator.onset_width_rad")
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
        trajectory, log = recording.trajectory, _log(recording, name)
        about = trajectory.metadata.get("valve_log")
        known = not (isinstance(about, Mapping) and about.get("offset_estimated"))
        bend = _seen_bends(trajectory)
        drive = log.schedule() if log.kind == "valve" else log.shifted(-float(log.time[0]))
        hashed = fingerprint(bend, log.time, log.values)
        time = trajectory.time - log.time[0]
        return cls(name, hashed, drive, supply_pa, time, bend, clock_known=known)

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""
        return DataSet(self.name, self.sha256, role, int(np.isfinite(self.bend).sum()))


def _log(recording: Recording, name: str) -> ValveLog:
    if recording.valves is None:
        raise InputError(f"{name}: no log of valves or pressures; join one with the recording")
    return recording.valves


def _seen_bends(trajectory: Trajectory) -> np.ndarray:
    """Return bends (samples, segments), rad; NaN where a marker of the segment was filled in."""
    bend = trajectory.stack("bend").copy()
    if trajectory.has("filled"):
        filled = trajectory.stack("filled") > 0
        bend[filled[:, :-1] | filled[:, 1:]] = np.nan
    return bend


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
    found = _bend_residuals(response.name, response.bend - bend, role, math.nan)
    if response.pressure is not None and pressure is not None:
        off = response.pressure - pressure
        for j, (plus, minus) in enumerate(off.transpose(1, 2, 0), start=1):
            for side, values in (("plus", plus), ("minus", minus)):
                name = f"{response.name} pressure_{side}_{j}"
                found.append(Residual(name, "Pa", values, _PRESSURE_NOISE, role))
    return found


def _bend_residuals(name: str, off: np.ndarray, role: Role, error: np.ndarray | float) -> list[Residual]:
    """Return residuals of bends by segment, without those that were not measured.

    Those of a segment share one scale: the root mean square of its errors, `_BEND_NOISE` where one is NaN.
    """
    found = []
    for j, (column, errors) in enumerate(zip(off.T, np.broadcast_to(error, off.shape).T, strict=True)):
        seen = np.isfinite(column)
        noise = float(np.sqrt((errors[seen] ** 2).sum() / max(seen.sum(), 1)))
        noise = _BEND_NOISE if math.isnan(noise) else max(noise, _DRIFT)
        found.append(Residual(f"{name} bend_{j + 1}", "rad", column[seen], noise, role))
    return found


@dataclass(frozen=True)
class StaticTable:
    """Bends under held pressures.

    Attributes:
        name: of the file.
        sha256: of it.
        pressure: gauge, shape (points, segments, 2), Pa.
        bend: shape (points, segments), rad; NaN where it was not measured.
        bend_error: standard errors of the bends, same shape, rad; NaN where they are not known.
    """

    name: str
    sha256: str
    pressure: np.ndarray
    bend: np.ndarray
    bend_error: np.ndarray | float = math.nan

    @classmethod
    def of_recording(cls, recording: Recording, name: str, spec: RobotSpec, supply_pa: float) -> StaticTable:
        """Return the plateaus of a recording that was joined with its log (module docstring).

        Of a log of valves, chambers that fill are at supply pressure after 5 τ and those that vent at 0; of
        one that is held closed the pressure is not known, and no plateau is made.

        Raises:
            InputError: there is no log, or no plateau.
        """
        trajectory, log = recording.trajectory, _log(recording, name)
        time, bend = trajectory.time, _seen_bends(trajectory)
        pressure = np.stack([trajectory.stack(f"{log.kind}_{side}") for side in SIDES], axis=-1)
        band = np.maximum(_HELD, 3 * _scatter(log.values))
        if log.kind == "valve":
            pressure = np.select([pressure == 1, pressure == -1], [supply_pa, 0.0], np.nan)
        of_frame = trajectory.stack("bend_error") if trajectory.has("bend_error") else np.zeros_like(bend)
        wait = 5 * max(spec.actuator.tau_fill, spec.actuator.tau_vent, spec.actuator.tau_mode)
        points, longest = [], 0.0
        for begin, end in _constant(pressure, band):
            longest = max(longest, span := float(time[end - 1] - time[begin]))
            # Where the next step begins, pressures are in the band still, and clocks may differ a little.
            off = np.abs(pressure[begin:end] - np.median(pressure[begin:end], axis=0))
            near = (off <= _NEAR * np.median(off, axis=0) + _ALIKE).all(axis=(1, 2))
            since = time[begin:end] - time[begin]
            part = begin + np.flatnonzero(near & (since >= wait) & (since <= span - _CLOCK))
            if len(part) < MIN_FRAMES:
                continue
            # A slow ramp stays in any band for some time, and rises there by its whole width.
            slope = np.polyfit(since[part - begin], pressure[part].reshape(len(part), -1), 1)[0]
            if (np.abs(slope) * span > band.ravel()).any():
                continue
            signals = (pressure[part].swapaxes(0, 1), bend[part].T, of_frame[part].T)
            point = np.array([_at_rest(time[part], *each) for each in zip(*signals, strict=True)])
            if np.isfinite(point[:, 2]).any():
                points.append(point)
        if not points:
            wanted = f"{wait:.2g} s (5 times the slowest time constant) and {MIN_FRAMES} frames more"
            said = (
                f"all pressures stay constant for {longest:.2g} s at most; {wanted} are wanted, bends at rest"
            )
            if log.kind == "valve" and np.isnan(pressure).any():
                said += "; of a valve that is held (0) nobody knows the pressure: log pressures"
            raise InputError(f"{name}: no plateau: {said}")
        found = np.array(points)
        return cls(name, fingerprint(found), found[..., :2], found[..., 2], found[..., 3])

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""
        return DataSet(self.name, self.sha256, role, int(np.isfinite(self.bend).sum()))


def _constant(pressure: np.ndarray, band: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield from which frame to before which all pressures stay within ±band; none where one is NaN."""
    begin, low, high = 0, pressure[0], pressure[0]
    for k, row in enumerate(pressure[1:], start=1):
        low, high = np.minimum(low, row), np.maximum(high, row)
        if not (high - low <= 2 * band).all():
            yield begin, k
            begin, low, high = k, row, row
    yield begin, len(pressure)


def _scatter(values: np.ndarray) -> np.ndarray:
    """Return the median size of second differences of a log's noise, 1.65 σ where it is white, shape (…).

    The smaller of two estimates, since steps and slow changes of pressure are not noise. A step changes one
    first difference but two second differences; a ramp changes all first differences but no second one.
    First differences of white noise are smaller than second differences by √3.

    Args:
        values: shape (rows, …), 2 rows or more.
    """
    medians = [
        scale * np.median(np.abs(np.diff(values, order, axis=0)), axis=0)
        for order, scale in ((1, math.sqrt(3)), (2, 1.0))
        if len(values) > order
    ]
    return np.asarray(np.min(medians, axis=0))


def _at_rest(time: np.ndarray, pressure: np.ndarray, bend: np.ndarray, of_frame: np.ndarray) -> list[float]:
    """Return a segment's mean pressures, its mean bend and its error once settled; NaN where it never is."""
    kept = np.flatnonzero(np.isfinite(bend))
    while len(kept) >= MIN_FRAMES:
        since = time[kept] - time[kept].mean()
        slope, mean = np.polyfit(since, bend[kept], 1)
        left = bend[kept] - mean - slope * since
        scatter = math.sqrt(left @ left / (len(kept) - 2) * correlation_time([left], 2))
        if abs(slope) <= max(2 * scatter / math.sqrt(since @ since), _DRIFT / np.ptp(since)):
            lasting = math.sqrt(np.mean(of_frame[kept] ** 2)) / 10
            return [*pressure[kept].mean(axis=0), mean, max(scatter / math.sqrt(len(kept)), lasting)]
        kept = kept[len(kept) // 4 :]
    return [*pressure.mean(axis=0), math.nan, math.nan]


Takes = Sequence[tuple[str, Recording]]
"""Names, and recordings joined with their logs."""


def static_tables(takes: Takes, spec: RobotSpec, supply_pa: float) -> list[StaticTable]:
    """Return the plateaus of takes that a fit is made from.

    Raises:
        InputError: as `StaticTable.of_recording`, or a chamber whose pressure was logged and changed has
            fewer than 3 different pressures in all takes.
    """
    tables = [StaticTable.of_recording(take, name, spec, supply_pa) for name, take in takes]
    if any(_log(take, name).kind == "valve" for name, take in takes):
        return tables  # two pressures are all there can be
    whole = merged(tables)
    for j, k in np.ndindex(spec.segments, len(SIDES)):
        levels = np.sort(whole.pressure[np.isfinite(whole.bend[:, j]), j, k])
        levels = levels[np.diff(levels, prepend=-np.inf) > _HELD]
        if len(levels) == 2:
            wanted = "3 or more are wanted, to tell a line from a curve"
            raise InputError(f"pressure_{SIDES[k]}_{j + 1}: held at 2 different pressures only; {wanted}")
    return tables


def merged(tables: Sequence[StaticTable]) -> StaticTable:
    """Return the points of tables of recordings as one."""
    names = ("pressure", "bend", "bend_error")
    arrays = [np.concatenate([getattr(each, name) for each in tables]) for name in names]
    return StaticTable(", ".join(each.name for each in tables), fingerprint(*arrays), *arrays)


def write_static(table: StaticTable, path: str | os.PathLike[str]) -> None:
    """Write a table as a file that `read_static` reads, all digits of it."""
    points, segments = table.bend.shape
    head = [f"pressure_{side}_{j + 1}_pa" for j in range(segments) for side in SIDES]
    head += [f"{name}_{j + 1}_rad" for name in ("bend", "bend_error") for j in range(segments)]
    error = np.broadcast_to(table.bend_error, table.bend.shape)
    rows = np.hstack([table.pressure.reshape(points, -1), table.bend, error]).tolist()
    lines = (",".join("" if math.isnan(each) else repr(each) for each in row) for row in rows)
    write_text(path, "\n".join([",".join(head), *lines, ""]))


def is_static(path: str | os.PathLike[str]) -> bool:
    """Say whether a file's first line names bends and no time: a table, no recording.

    Raises:
        InputError: the file cannot be read.
    """
    names = first_line_names(path)
    timed = any(is_clock(name) for name in names)
    return not timed and any(name.startswith("bend_") for name in names)


def read_static(path: str | os.PathLike[str], spec: RobotSpec) -> StaticTable:
    """Read a static table.

    Raises:
        InputError: no such file, no bends, columns of other segments, or values that no robot has.
    """
    names = [*(f"pressure_{side}" for side in SIDES), "bend", "bend_error"]
    units = dict.fromkeys(names[:2], PRESSURES) | dict.fromkeys(names[2:], ANGLES)
    table = read_table(read_file(path), units)
    for each in table.columns:
        if not 1 <= each.number <= spec.segments or each.letter:
            raise table.error(each, f"{each.text}: {spec.name} has segments 1 to {spec.segments}")
    if not any(each.name == "bend" for each in table.columns):
        example = "pressure_plus_1,pressure_minus_1,bend_1,…"
        raise table.file.error(f"no column 'bend_1'; a static table has {example}", 1)
    given, _ = table.read(table.columns)
    values = np.zeros((len(given), spec.segments, 4))
    values[..., 2:] = np.nan
    for each, column in zip(table.columns, given.T, strict=True):
        values[:, each.number - 1, names.index(each.name)] = column
    pressure, bend, error = values[..., :2], values[..., 2], values[..., 3]
    if not (np.abs(pressure) <= _MOST_PRESSURE).all():
        allowed = f"from {-_MOST_PRESSURE:g} to {_MOST_PRESSURE:g} Pa"
        raise table.file.error(f"pressures {allowed} are wanted, in every row")
    if not np.isfinite(bend).any() or (np.abs(bend) > _MOST_BEND).any():
        wanted = f"bends up to {_MOST_BEND:.3g} rad are wanted"
        raise table.file.error(f"{wanted}; is the unit right (bend_1_deg)?")
    return StaticTable(table.file.name, table.file.sha256, pressure, bend, error)


def fit_static(
    tables: Sequence[StaticTable],
    spec: RobotSpec,
    *,
    names: Iterable[str] | None = None,
    validation: Sequence[StaticTable] = (),
    watch: Watch | None = None,
) -> Estimate:
    """Return gains, biases and the bend limit from static tables.

    Where a dead zone explains the bends better than its numbers would by chance (F-test, 1 %), these are
    found as well: first onset and width with all of the slope missing, then the share of it too.

    Args:
        tables: what was measured; the residual of each point is in the estimate.
        spec: the robot that the search starts from; `actuator.bend_rad` is held, as in `fit_actuator`.
        names: what is unknown, see `unknowns`; default gains, biases, the bend limit and a dead zone.
        validation: tables to hold the estimate against.
        watch: is told how far the search is, see `least_squares`.

    Raises:
        InputError: no table, or one to validate with that is also fitted.
    """
    everything = with_roles("static tables", tables, validation)
    largest = max(float(np.nanmax(np.abs(table.bend), initial=0.1)) for table in tables)
    unlimited = math.isinf(spec.actuator.bend_limit)

    def search(wanted: Sequence[str], fixed: Mapping[str, float], starts: Mapping[str, float]) -> Estimate:
        base = with_values(spec, fixed)

        def residuals(values: Mapping[str, float]) -> list[Residual]:
            robot, found = with_values(base, values), []
            for table, role in everything:
                off = table.bend - robot.modules.array("bias") - air_bend(robot, table.pressure)
                found += _bend_residuals(table.name, off, role, table.bend_error)
            return found

        looked_for = unknowns(base, wanted, starts=starts)
        held = _held(base, looked_for) | dict(fixed)
        found = least_squares(residuals, looked_for, held=held, watch=watch)
        if names is not None or not unlimited or _LIMIT not in wanted or found[_LIMIT].value is not None:
            return found
        # A limit that was never felt has no say in the gains: at its bound it would still flatten bends.
        without = search([each for each in wanted if each != _LIMIT], fixed, {})
        return without.with_known([found[_LIMIT]])

    starts = {_LIMIT: min(1.5 * max(largest, 0.1), 6.0)} if unlimited else {}
    wanted = [*per_segment(spec, *_OWN), _LIMIT] if names is None else list(names)
    found = search(wanted, {}, starts)
    points = sum(np.isfinite(table.bend).sum() for table in tables)
    if names is not None or spec.actuator.onset_share or points <= len(wanted) + len((*_LATE, _SHARE)):
        return found

    # A dead zone, as far as it is not fixed; with a corner as sharp as may be where no width is found.
    def zone(begin: Mapping[str, float], fixed: Mapping[str, float]) -> Estimate:
        names = [*wanted, *(each for each in (*_LATE, _SHARE) if each not in fixed)]
        found = search(names, fixed, starts | dict(begin))
        if found[_LATE[1]].value is not None:
            return found
        names.remove(_LATE[1])
        return search(names, {**fixed, _LATE[1]: _CORNER}, starts | {_LATE[0]: begin[_LATE[0]]})

    late = zone({_LATE[0]: 0.4 * largest, _LATE[1]: 0.2 * largest}, {_SHARE: 1.0})
    if not _better(late, found):
        return found
    partial = zone({_SHARE: 0.8} | late.values, {})
    chosen = partial if _better(partial, late) else late
    why = (
        f"a straight line leaves {found.rms('fit'):.3g} times the noise, a dead zone {chosen.rms('fit'):.3g}"
    )
    said = (
        replace(each, why="; ".join(filter(None, (why, each.why)))) if each.name == _LATE[0] else each
        for each in chosen.parameters
    )
    return replace(chosen, parameters=tuple(said))


def _better(more: Estimate, less: Estimate) -> bool:
    """Say whether a law with more numbers explains data better than these would by chance (F-test, 1 %)."""
    if any(more[each.name].value is None for each in more.parameters if each.name in (*_LATE, _SHARE)):
        return False
    added, left = max(len(more.values) - len(less.values), 1), more.independent - len(more.values)
    ratio = ((less.rms("fit") or 0.0) / max(more.rms("fit") or 0.0, 1e-3)) ** 2 - 1
    return left > 0 and ratio * left / added > scipy.stats.f.ppf(0.99, added, left)
