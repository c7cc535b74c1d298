"""Readers for robot logs with bends, valve states, duties or pressures.

A bend log contains the bends of a robot on a bench, in the columns ``time,bend_1,…``.
Bends are in rad unless the column name states another unit (``bend_1_deg``). A bend is
positive if the front end of the segment is turned to the left relative to the rear end.
The body positions are computed from the bends and the pose of the clamped head.

A valve log has the column ``time`` and columns of one quantity for all chambers. The
possible columns are ``valve_plus_1, valve_minus_1, …`` (1 to fill, 0 to hold, −1 to
vent), ``duty_plus_1, …``, ``pressure_plus_1, …`` and ``setpoint_plus_1, …``. Pressures
are gauge pressures in Pa unless the column name states another unit
(``pressure_plus_1_kpa``).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from srs_twin.errors import InputError, UnknownNameError, named_in_errors
from srs_twin.io.files import StrPath
from srs_twin.recordings.body.trajectories import (
    LogSummary,
    measured_trajectory,
    moving_derivative,
    numbered_columns,
    pose_columns,
)
from srs_twin.recordings.csv_table import (
    CLOCK,
    CsvColumn,
    CsvTable,
    not_used,
    read_table,
)
from srs_twin.recordings.formats import read_topics
from srs_twin.recordings.formats.topics import RecordedTopics
from srs_twin.recordings.recorded_file import (
    RecordedFile,
    laid_out,
    read_file,
    start_of,
)
from srs_twin.recordings.recording import (
    Recording,
    ValveLog,
    held_values,
)
from srs_twin.recordings.recording_map import NO_MAP, RecordingMap, as_map
from srs_twin.recordings.signals.gaps import (
    MIN_FRAMES,
    at_frames,
    check_times,
    fill_gaps,
    frame_grid,
    longest_complete,
    time_order,
)
from srs_twin.recordings.signals.units import (
    ABSOLUTE,
    QUANTITIES,
    clean,
    is_absolute,
    looks_absolute,
    unit_of,
)
from srs_twin.robot.geometry import body_shape, relative_headings
from srs_twin.robot.spec import RobotSpec

SIDES = ("plus", "minus")
AIR = ("pressure", "setpoint")
"""Kinds of logs that contain pressures, in contrast to "valve" and "duty"."""

_MAX_BEND = 2 * np.pi
"""Maximum bend, rad (a full circle)."""
_MAX_PRESSURE = 2e6
"""Maximum gauge pressure of a chamber, Pa."""
_MIN_PRESSURE = -1.1e5
"""Minimum gauge pressure of a chamber, Pa (slightly below vacuum)."""
_BEND = re.compile(r"bend_1(?!\d)")
_MAX_PERIODS = 1_000_000
_MAX_CLAMP_SHIFT = 0.05
"""Maximum displacement of a clamped head, relative to the segment length."""
_MAX_CLAMP_TURN = np.radians(5.0)
"""Maximum rotation of a clamped head, rad."""


def is_bend_log(path: StrPath, recording_map: RecordingMap = NO_MAP) -> bool:
    """Return whether a file has bend columns according to their names or the map."""
    start = start_of(path, recording_map.dialect)
    if "\0" in start.first_line:
        return False
    mapped = {clean(name).lower() for name in recording_map.meanings(["bend"])}
    names = {name.lower() for name in start.names}
    return not mapped.isdisjoint(names) or any(_BEND.match(name) for name in names)


def read_bends(
    path: StrPath,
    spec: RobotSpec,
    *,
    longest_gap_s: float,
    gait_frequency_hz: float | None = None,
    map: RecordingMap | Mapping[str, object] | StrPath = NO_MAP,  # noqa: A002
) -> Recording:
    """Read the longest interval of a bend log in which all bends are known.

    In the returned recording, the head is at the origin with a heading of 0.
    """
    table = _table(path, as_map(map), ("bend",))
    clock = table.clock(
        "the column 'time' is missing; a bend log has the columns time,bend_1,…"
    )
    chosen = table.per_segment(["bend"], spec.name, spec.segments)
    time, bend, notes, epoch_ns = table.read_timed(clock, chosen)
    check_values(table, chosen, bend)
    with named_in_errors(table.file.name):
        frames = frame_grid(time, bend)
    bend = at_frames(bend, frames)
    tracks = bend[..., None]
    kept = longest_complete(frames.time, tracks, longest_gap_s)
    if kept.stop - kept.start < MIN_FRAMES:
        raise table.file.error(
            f"no {MIN_FRAMES} successive rows contain all bends; allow longer gaps"
            " with --longest-gap"
        )
    kept_time = frames.time[kept]
    notes += frames.corrections
    if not any(column.unit for column in chosen):
        notes.append("bends without a unit are assumed to be in rad")
    notes += not_used(table.unused)
    unknown = int(np.isnan(bend[kept]).sum())
    summary = LogSummary.from_file(
        table.file, "bend log", frames, kept_time, unknown, notes
    )
    filled = fill_gaps(kept_time, tracks[kept], 1)[..., 0]
    columns = _clamped_body(kept_time, filled, spec)
    trajectory = measured_trajectory(columns, spec, summary, gait_frequency_hz)
    return Recording(trajectory, summary, epoch_ns=epoch_ns)


def check_values(
    table: CsvTable, columns: Sequence[CsvColumn], values: np.ndarray
) -> None:
    """Raise an error if a bend or a pressure is implausible.

    `values` contains the values of the columns in SI units, shape (rows, columns).
    """
    for column, each in zip(columns, values.T, strict=True):
        limits = (_MIN_PRESSURE, _MAX_PRESSURE)
        rule = "a gauge pressure must be {}"
        if column.name.startswith("bend"):
            limits = (-_MAX_BEND, _MAX_BEND)
            rule = "a bend must be {}"
            if not column.unit:
                rule += "; for degrees, add the unit to the name, as in bend_deg"
        table.check_range(column, each, limits, rule)


def _table(
    path: StrPath, recording_map: RecordingMap, kinds: Sequence[str]
) -> CsvTable:
    file = laid_out(read_file(path), recording_map.dialect)
    known = {f"{kind}_{side}": QUANTITIES[kind] for kind in kinds for side in SIDES}
    mapped = recording_map.meanings([*kinds, "time"])
    if kinds == ("bend",):
        known = {"bend": QUANTITIES["bend"]}
        # A time column in the map may belong to another file of the recording.
        mapped = {
            name: meaning
            for name, meaning in mapped.items()
            if meaning.kind != "time" or name in file.names
        }
    return read_table(file, CLOCK | known, mapped)


def _clamped_body(
    time: np.ndarray, bend: np.ndarray, spec: RobotSpec
) -> dict[str, np.ndarray]:
    geometry = spec.geometry
    shape = body_shape(
        bend, spec.mass.array(), geometry.segment_length, geometry.rigid_gap
    ) @ [1, 1j]
    relative = relative_headings(bend)
    theta = relative - relative[:, :1]
    connector = (shape - shape[:, :1]) * np.exp(-1j * relative[:, :1])
    com = -shape[:, 0] * np.exp(-1j * relative[:, 0])
    return {
        "time": time,
        **pose_columns(com, theta.mean(axis=1), connector, theta),
        **numbered_columns("bend", bend),
        **numbered_columns("bend_rate", moving_derivative(time, bend)),
    }


def read_valves(
    path: StrPath,
    spec: RobotSpec,
    map: RecordingMap | Mapping[str, object] | StrPath = NO_MAP,  # noqa: A002
) -> ValveLog:
    """Read a log of valve states, duties or pressures from a CSV file or a bag.

    `map` is a recording map, given as an object, a mapping or a path. The map states
    the meanings of columns and the carrier frequency of duties.
    """
    recording_map = as_map(map)
    if (topics := read_topics(path)) is not None:
        return log_of_topics(topics, spec, recording_map)
    table = _table(path, recording_map, ("valve", "duty", *AIR))
    file = table.file
    clock = table.clock(
        "the column 'time' is missing; a log has the columns"
        " time,valve_plus_1,valve_minus_1,… or pressures"
    )
    logged = (column for column in table.columns if column is not clock)
    kinds = sorted({column.name.partition("_")[0] for column in logged})
    if len(kinds) != 1:
        given = ", ".join(kinds) or "none of them"
        raise file.error(
            "a log must have exactly one of valve_plus_1,…, duty_plus_1,…,"
            f" pressure_plus_1,… and setpoint_plus_1,…, but this file has {given};"
            " assign other names in a map (--map)",
            file.header_lines or 1,
        )
    (kind,) = kinds
    per_side = [f"{kind}_{side}" for side in SIDES]
    chosen = table.per_segment(per_side, spec.name, spec.segments)
    rows = table.read_timed(clock, chosen)
    notes = list(rows.notes)
    if kind in AIR and not all(column.unit for column in chosen):
        notes.append("pressures without a unit are assumed to be in Pa")
    units = QUANTITIES[kind]
    named = [column.text for column in chosen if is_absolute(column.text, units)]
    if named and not recording_map.ambient:
        notes.append(
            f"the name '{named[0]}' states an absolute pressure, but the map states no"
            " ambient pressure (ambient_kpa) to subtract"
        )

    def error(row: int, k: int, problem: str) -> InputError:
        return table.error(chosen[k], f"{chosen[k].text}: {problem}", row)

    values = _checked_values(kind, rows.values, recording_map.ambient, notes, error)
    log = _log(file, kind, rows.time, values, recording_map.carrier_hz, notes)
    corrections = (*log.corrections, *not_used(table.unused))
    return replace(log, epoch_ns=rows.epoch_ns, corrections=corrections)


def log_of_topics(
    topics: RecordedTopics, spec: RobotSpec, recording_map: RecordingMap
) -> ValveLog:
    """Read a log from the topics of a bag.

    Measured pressures are interpolated. A valve state, duty or set point holds until
    the next message.
    """
    meanings = recording_map.meanings(("valve", "duty", *AIR))
    names = {meaning.key: signal for signal, meaning in meanings.items()}
    kinds = {meaning.kind for meaning in meanings.values()}
    required = [
        f"{kind}_{side}_{j + 1}"
        for kind in kinds
        for j in range(spec.segments)
        for side in SIDES
    ]
    with named_in_errors(topics.name):
        if len(kinds) != 1 or sorted(required) != sorted(names):
            listed = ", ".join(list(topics.signals)[:12]) or "none"
            raise InputError(
                f"the signals of the {spec.segments} segments are not known. Assign"
                " them in a map with `log: {valve_plus_1: SIGNAL, valve_minus_1:"
                f" SIGNAL, …}}`, where SIGNAL is one of the recorded signals {listed}"
            )
        (kind,) = kinds
        chosen = [names[key] for key in required]
        units = QUANTITIES[kind]
        factors = []
        for signal in chosen:
            if signal not in topics.signals:
                raise UnknownNameError("signal", signal, topics.signals)
            unit, _ = unit_of(signal, "", units, meanings[signal])
            factors.append(units.get(unit, 1.0))
    series = [topics.signals[signal] for signal in chosen]
    time = np.unique(np.concatenate([times for times, _ in series]))
    time = time[time >= max(times[0] for times, _ in series)]
    sample = np.interp if kind == "pressure" else held_values
    values = np.stack([sample(time, *own) for own in series], axis=1) * factors

    def error(row: int, k: int, problem: str) -> InputError:
        return InputError(f"{topics.name}: {chosen[k]}: {problem}, at {time[row]:g} s")

    notes = [*topics.notes]
    values = _checked_values(kind, values, recording_map.ambient, notes, error)
    return _log(topics, kind, time, values, recording_map.carrier_hz, notes)


def _checked_values(
    kind: str,
    values: np.ndarray,
    ambient: float,
    notes: list[str],
    error: Callable[[int, int, str], InputError],
) -> np.ndarray:
    unit = ""
    if kind in AIR:
        if ambient:
            notes.append(
                f"the pressures are absolute, so {ambient / 1e3:g} kPa were subtracted"
            )
        elif looks_absolute(values):
            notes.append(
                f"the smallest pressure is {np.nanmin(values) / 1e3:.4g} kPa."
                f" {ABSOLUTE}"
            )
        values = values - ambient
        allowed = (values >= _MIN_PRESSURE) & (values <= _MAX_PRESSURE)
        words = (
            f"it must be a gauge pressure between {_MIN_PRESSURE:g} and"
            f" {_MAX_PRESSURE:g} Pa"
        )
        unit = " Pa"
    elif kind == "duty":
        allowed = (values >= 0) & (values <= 1)
        words = (
            "a duty must be between 0 and 1; for per cent, give the unit % in the"
            " name of the column or in a map"
        )
    else:
        allowed = np.isin(values, (-1, 0, 1))
        words = "it must be -1 (vent), 0 (hold) or 1 (fill)"
    if not allowed.all():
        row, k = np.argwhere(~allowed)[0].tolist()
        if np.isnan(values[row, k]):
            raise error(row, k, f"the value is missing; {words}")
        raise error(row, k, f"{values[row, k]:g}{unit} is not allowed; {words}")
    return values


def _log(
    source: RecordedFile | RecordedTopics,
    kind: str,
    time: np.ndarray,
    values: np.ndarray,
    carrier_hz: float | None,
    notes: list[str],
) -> ValveLog:
    with named_in_errors(source.name):
        check_times(time)
        order, moved = time_order(time, values)
        # Of several commands with equal times, a valve executes the last one.
        kept = np.append(np.diff(time[order]) > 0, True)
        notes += moved
        if not kept.all():
            notes.append(
                f"{int((~kept).sum())} rows were left out, because another row with"
                " the same time follows"
            )
        if kept.sum() < 2:
            raise InputError("the log has fewer than 2 rows, but at least 2 are needed")
        time = time[order][kept]
        values = values[order][kept].reshape(kept.sum(), -1, 2)
        if kind == "setpoint":
            notes.append("set points are assumed to be the chamber pressures")
        elif kind == "duty":
            time, values = _switched_valves(time, values, carrier_hz)
            notes.append(
                f"the duties were converted to valve states at {carrier_hz:g} Hz,"
                " where each period begins with filling"
            )
        elif kind == "valve" and not (values == -1).any() and (values == 0).any():
            values = np.where(values == 0, -1.0, values)
            notes.append(
                "the states are only 0 and 1, so 0 is read as venting (−1), as for"
                " 3/2 valves"
            )
    return ValveLog(
        "pressure" if kind in AIR else "valve",
        time,
        values,
        source.name,
        source.sha256,
        tuple(notes),
        holds=kind == "setpoint",
    )


def _switched_valves(
    time: np.ndarray, duty: np.ndarray, carrier_hz: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Convert duties (0 to 1) to switching times (s) and valve states."""
    if carrier_hz is None:
        raise InputError(
            "the carrier frequency of the duties is missing; set it in a map, for"
            " example `log: {carrier_hz: 30}`"
        )
    if (time[-1] - time[0]) * carrier_hz > _MAX_PERIODS:
        raise InputError(
            f"the log has more than {_MAX_PERIODS} carrier periods; use a shorter log"
        )
    starts = np.arange(time[0], time[-1], 1 / carrier_hz)
    duty = held_values(starts + 1e-9, time, duty)
    ends = starts[:, None, None] + duty / carrier_hz
    edges = np.unique(np.concatenate([starts, ends.ravel(), time[-1:]]))
    edges = edges[edges <= time[-1]]
    filling = edges[:, None, None] < held_values(edges + 1e-9, starts, ends) - 1e-9
    return edges, np.where(filling, 1.0, -1.0)


def on_bench(recording: Recording, spec: RobotSpec) -> Recording:
    """Transform a recording to the clamp frame.

    The origin of this frame is the centre of mass of the straight body.
    """
    trajectory = recording.trajectory
    head = trajectory.position[:, 0]
    head_heading = trajectory["connector_heading_1"]
    clamp = np.median(head, axis=0)
    heading = float(np.median(head_heading))
    shift = float(np.quantile(np.linalg.norm(head - clamp, axis=1), 0.95))
    turn = float(np.quantile(np.abs(head_heading - heading), 0.95))
    pitch = spec.geometry.pitch
    if shift > _MAX_CLAMP_SHIFT * pitch or turn > _MAX_CLAMP_TURN:
        raise InputError(
            f"{recording.summary.source}: the head moves by {1e3 * shift:.0f} mm and"
            f" turns by {np.degrees(turn):.2g}°, but a bench requires a clamped head; if"
            " the other end is clamped, give --head"
        )
    mass = spec.mass.array()
    # Points are rotated by −heading about the clamp, which then moves to the positive x
    # axis.
    distance = pitch * float(np.arange(len(mass)) @ mass) / float(mass.sum())
    rotation = np.exp(-1j * heading)
    origin = clamp @ [1, 1j]
    com = (trajectory.com @ [1, 1j] - origin) * rotation + distance
    connector = (trajectory.position @ [1, 1j] - origin) * rotation + distance
    theta = trajectory.stack("connector_heading") - heading
    pose = pose_columns(com, trajectory["heading"] - heading, connector, theta)
    columns = {**trajectory.columns, **pose}
    if "com_velocity_x" in columns:
        velocity = (
            columns["com_velocity_x"] + 1j * columns["com_velocity_y"]
        ) * rotation
        columns |= {"com_velocity_x": velocity.real, "com_velocity_y": velocity.imag}
    metadata = {**trajectory.metadata, "base": "clamped"}
    return replace(
        recording, trajectory=replace(trajectory, columns=columns, metadata=metadata)
    )
