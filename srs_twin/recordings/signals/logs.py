"""Logs of a robot: what its sensors measured, what was commanded of its valves or measured in its chambers.

A bend log has ``time,bend_1,…`` of a robot on a bench. Angles are in rad, or in the unit of the name
(``bend_1_deg``); positive where the front end heads to the left of the rear end. Where the body is follows
from its bends and from where its head is held.

A valve log has ``time`` and either ``valve_plus_1, valve_minus_1, …`` (+1 fill, 0 hold, −1 vent) or
``pressure_plus_1, pressure_minus_1, …`` (gauge; Pa, or the unit in the name: ``pressure_plus_1_kpa``), on a
clock of its own.

`on_bench` moves a recording into the frame of its clamp: plants on a bench are held where the head of a
straight body lies whose centre of mass is at the origin.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.recordings.body.trajectories import LogSummary, measured, moving_slope, numbered, pose_columns
from srs_twin.recordings.csv_table import (
    CLOCK,
    CsvTable,
    Meaning,
    RecordedFile,
    laid_out,
    read_file,
    read_table,
    start_of,
)
from srs_twin.recordings.formats import read_topics
from srs_twin.recordings.formats.topics import RecordedTopics
from srs_twin.recordings.recording import Recording, named_in_errors
from srs_twin.recordings.recording_map import NO_MAP, QUANTITIES, RecordingMap, log_meaning
from srs_twin.recordings.signals.gaps import (
    LEAST_FRAMES,
    at_frames,
    filled,
    frame_grid,
    longest_complete,
    time_order,
)
from srs_twin.recordings.signals.units import ABSOLUTE, clean, looks_absolute, symbol
from srs_twin.recordings.signals.valve_log import ValveLog, held_values
from srs_twin.robot.geometry import body_shape, relative_headings
from srs_twin.robot.spec import RobotSpec

SIDES = ("plus", "minus")
AIR = ("pressure", "setpoint")
"""Kinds of logs whose values are pressures; the others are valve and duty."""

_LARGEST = 2 * np.pi  # rad: no segment is a full circle
_HIGHEST = 2e6  # Pa: no chamber holds more
_LOWEST = -1.1e5
_ALLOWED = f"gauge pressures from {_LOWEST:g} to {_HIGHEST:g} Pa"
_BEND = re.compile(r"bend_(?:[a-z]+_)?1(?!\d)")
_LATEST = 1e9  # s
_MOST_PERIODS = 1_000_000  # of a carrier
_MOVED = 0.05  # of a segment's length
_TURNED = np.radians(5.0)


def is_bend_log(path: str | os.PathLike[str], map: RecordingMap = NO_MAP) -> bool:
    """Say whether a file's first line names bends, as they are or by a map.

    Raises:
        InputError: it cannot be read.
    """
    start = start_of(path, map.dialect)
    if "\0" in start.first_line:
        return False
    mapped = {clean(name).lower() for name in map.meanings(["bend"])}
    return any(_BEND.match(name.lower()) or name.lower() in mapped for name in start.names)


def read_bends(
    path: str | os.PathLike[str],
    spec: RobotSpec,
    *,
    longest_gap_s: float,
    gait_frequency_hz: float | None = None,
    map: RecordingMap = NO_MAP,
) -> Recording:
    """Read a bend log.

    Args:
        path: of the file.
        spec: the robot whose sensors they were.
        longest_gap_s: longest gap that is filled, s.
        gait_frequency_hz: Hz; None: not periodic.
        map: names of its columns, and layout of the file.

    Returns:
        The longest stretch in which all bends are known, with the head at the origin, heading along x.

    Raises:
        InputError: the file cannot be used; says where and what would do.
    """
    table = _table(path, map, ("bend",))
    clock = table.clock("no column 'time'; a bend log has time,bend_1,…")
    chosen = table.per_segment(["bend"], spec.name, spec.segments)
    time, bend, notes, epoch_ns = table.read_timed(clock, chosen)
    wrong = np.argwhere(np.abs(bend) > _LARGEST)
    if wrong.size:
        row, k = (int(each) for each in wrong[0])
        allowed = f"at most {_LARGEST:.4g} (bend_1_deg, where they are degrees)"
        what = f"{chosen[k].text}: a bend of {bend[row, k]:.4g} rad is not allowed; {allowed}"
        raise table.error(chosen[k], what, row)
    with named_in_errors(table.file.name):
        frames = frame_grid(time)
    bend = at_frames(bend, frames)
    tracks = bend[..., None]
    kept = longest_complete(frames.time, tracks, longest_gap_s)
    if kept.stop - kept.start < LEAST_FRAMES:
        raise table.file.error(
            f"no {LEAST_FRAMES} rows on end in which all bends are known; give --longest-gap"
        )
    kept_time, unknown = frames.time[kept], int(np.isnan(bend[kept]).sum())
    notes += frames.corrections
    if not any(each.unit for each in chosen):
        notes.append("bends without a unit taken as rad")
    notes += table.unused_columns()
    summary = LogSummary.of(table.file, "bend log", frames, kept, unknown, notes)
    columns = _bent_body(kept_time, filled(kept_time, tracks[kept], "linear")[..., 0], spec)
    return Recording(measured(columns, spec, summary, gait_frequency_hz), summary, epoch_ns=epoch_ns)


def _table(path: str | os.PathLike[str], map: RecordingMap, kinds: Sequence[str]) -> CsvTable:
    """Return a table with a log's columns of these quantities, by their names or by a map."""
    file = laid_out(read_file(path), map.dialect)
    known = {
        kind if kind == "bend" else f"{kind}_{side}": QUANTITIES[kind] for kind in kinds for side in SIDES
    }
    named = {name: log_meaning(name.lower()) for name in file.names}
    units = {name: Meaning(key) for name, (kind, key, unit) in named.items() if kind in kinds and unit}
    mapped = map.meanings([*kinds, "time"])
    if kinds == ("bend",):  # the time may be that of another file
        mapped = {name: each for name, each in mapped.items() if each.name != "time" or name in file.names}
    return read_table(file, CLOCK | known, units | mapped)


def _bent_body(time: np.ndarray, bend: np.ndarray, spec: RobotSpec) -> dict[str, np.ndarray]:
    """Return the columns of a body that bends with its head held at the origin, heading along x."""
    geometry = spec.geometry
    shape = body_shape(bend, spec.mass.array(), geometry.segment_length, geometry.rigid_gap) @ [1, 1j]
    relative = relative_headings(bend)
    theta = relative - relative[:, :1]
    place = (shape - shape[:, :1]) * np.exp(-1j * relative[:, :1])
    com = -shape[:, 0] * np.exp(-1j * relative[:, 0])
    return {
        "time": time,
        **pose_columns(com, theta.mean(axis=1), place, theta),
        **numbered("bend", bend),
        **numbered("bend_rate", moving_slope(time, bend)),
    }


def read_valves(path: str | os.PathLike[str], spec: RobotSpec, map: RecordingMap = NO_MAP) -> ValveLog:
    """Read a log of valves, duties or pressures.

    Args:
        path: of a plain CSV file or a bag.
        spec: the robot that it is of.
        map: which columns, or signals of topics, hold what; frequency of the duties' carrier.

    Raises:
        InputError: no such file, columns missing, values that no valve or chamber has; says where.
    """
    if (topics := read_topics(path)) is not None:
        return log_of_topics(topics, spec, map)
    table = _table(path, map, ("valve", "duty", *AIR))
    file = table.file
    clock = table.clock("no column 'time'; a log has time,valve_plus_1,valve_minus_1,… or pressures")
    kinds = sorted({each.name.partition("_")[0] for each in table.columns if "_" in each.name})
    if len(kinds) != 1:
        given = ", ".join(kinds) or "neither"
        wanted = "one of valve_plus_1,…, duty_plus_1,…, pressure_plus_1,…, setpoint_plus_1,…"
        raise file.error(f"{wanted} is wanted (other names: --map); {given} given", file.header_lines or 1)
    (kind,) = kinds
    chosen = table.per_segment([f"{kind}_{side}" for side in SIDES], spec.name, spec.segments)
    time, values, notes, epoch_ns = table.read_timed(clock, chosen)
    units, unused = [each.unit for each in chosen], table.unused_columns()

    def error(row: int, k: int, what: str) -> InputError:
        return table.error(chosen[k], f"{chosen[k].text}: {what}", row)

    log = _log(file, kind, time, values, units, map, notes, error)
    return replace(log, epoch_ns=epoch_ns, corrections=(*log.corrections, *unused))


def log_of_topics(topics: RecordedTopics, spec: RobotSpec, map: RecordingMap) -> ValveLog:
    """Read a log from topics; each chamber's signal holds, but measured pressures are interpolated.

    Raises:
        InputError: signals are missing, or have values that no valve or chamber has.
    """
    meanings = map.meanings(("valve", "duty", *AIR))
    names = {meaning.name: signal for signal, meaning in meanings.items()}
    kinds = {what.partition("_")[0] for what in names}
    wanted = [f"{kind}_{side}_{j + 1}" for kind in kinds for j in range(spec.segments) for side in SIDES]
    with named_in_errors(topics.name):
        if len(kinds) != 1 or sorted(wanted) != sorted(names):
            found = ", ".join(list(topics.signals)[:12]) or "none"
            raise InputError(
                f"which signals are the air of {spec.segments} segments is not known; a map has log: "
                f"{{valve_plus_1: SIGNAL, valve_minus_1: SIGNAL, …}}; signals: {found}"
            )
        for each in names.values():
            if each not in topics.signals:
                raise UnknownNameError("signal", each, topics.signals)
    (kind,), chosen = kinds, [names[each] for each in wanted]
    series = [topics.signals[each] for each in chosen]
    time = np.unique(np.concatenate([each for each, _ in series]))
    time = time[time >= max(each[0] for each, _ in series)]
    units = [symbol(meanings[each].unit or meanings[each].default, QUANTITIES[kind]) for each in chosen]
    way = np.interp if kind == "pressure" else held_values
    factors = [QUANTITIES[kind].get(unit, 1.0) for unit in units]
    values = np.stack([way(time, *own) for own in series], axis=1) * factors

    def error(row: int, k: int, what: str) -> InputError:
        return InputError(f"{topics.name}: {chosen[k]}: {what}, at {time[row]:g} s")

    return _log(topics, kind, time, values, units, map, [*topics.notes], error)


def _log(
    source: RecordedFile | RecordedTopics, kind: str, time: np.ndarray, values: np.ndarray,
    units: Sequence[str], map: RecordingMap, notes: list[str], error: Callable[[int, int, str], InputError],
) -> ValveLog:  # fmt: skip
    """Return valves or gauge pressures in the order of time.

    Args:
        source: of the values.
        kind: valve, duty, pressure or setpoint.
        time: shape (rows,), s.
        values: in SI, shape (rows, 2 segments).
        units: of the columns; empty where they have none.
        map: ambient pressure and carrier.
        notes: on the source, in words.
        error: row, column and what is wrong there → error.

    Raises:
        InputError: blanks, and what no valve or chamber does; times that no log has.
    """
    if kind in AIR:
        if map.ambient:
            notes.append(f"absolute pressures: {map.ambient / 1e3:g} kPa subtracted")
        elif looks_absolute(values):
            notes.append(f"pressures of {np.nanmin(values) / 1e3:.4g} kPa and more: {ABSOLUTE}")
        if not all(units):
            notes.append("pressures without a unit taken as Pa")
        values = values - map.ambient
    allowed, words, unit = np.isin(values, (-1, 0, 1)), "-1 (vent), 0 (hold) or 1 (fill)", ""
    if kind in AIR:
        allowed, words, unit = (values >= _LOWEST) & (values <= _HIGHEST), _ALLOWED, " Pa"
    wrong = np.argwhere(~allowed)
    if wrong.size and kind != "duty":
        row, k = (int(each) for each in wrong[0])
        given = "nothing" if np.isnan(values[row, k]) else f"{values[row, k]:g}{unit}"
        raise error(row, k, f"{given} is not allowed; {words}")
    with named_in_errors(source.name):
        if np.abs(time).max() > _LATEST:
            raise InputError(f"times up to {np.abs(time).max():.3g} s; is the unit right?")
        order, moved = time_order(time)
        # Of rows at one time the last holds, as it would on the valve.
        kept = np.append(np.diff(time[order]) > 0, True)
        notes += moved
        if not kept.all():
            notes.append(f"{int((~kept).sum())} rows repeat the time of another: the last of each kept")
        if kept.sum() < 2:
            raise InputError("a log has 2 rows or more")
        time, values = time[order][kept], values[order][kept].reshape(kept.sum(), -1, 2)
        if kind == "setpoint":
            notes.append("set-points taken as the chambers' pressures")
        elif kind == "duty":
            time, values = _switched(time, values, map.carrier_hz, notes)
        elif kind == "valve" and not (values == -1).any() and (values == 0).any():
            values = np.where(values == 0, -1.0, values)
            notes.append("states are 0 and 1 only: 0 taken as venting (−1), as of 3/2 valves")
    known, about = "pressure" if kind in AIR else "valve", (source.name, source.sha256, tuple(notes))
    return ValveLog(known, time, values, *about, holds=kind == "setpoint")


def _switched(
    time: np.ndarray, duty: np.ndarray, carrier_hz: float | None, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return times (rows,), s, and valves (rows, …) that fill for their share of each carrier period.

    Duties hold until the next row, are from 0 to 1, or to 100 per cent.
    """
    if carrier_hz is None:
        raise InputError("duties need the frequency of their carrier: log: {carrier_hz: 30} in a map")
    if not ((duty >= 0) & (duty <= 100)).all():
        raise InputError("duties from 0 to 1, or 0 to 100 per cent, are wanted")
    if (time[-1] - time[0]) * carrier_hz > _MOST_PERIODS:
        raise InputError(f"over {_MOST_PERIODS} periods of the carrier; cut the log")
    if duty.max() > 1:
        duty = duty / 100
        notes.append("duties taken as per cent")
    begins = np.arange(time[0], time[-1], 1 / carrier_hz)
    share = held_values(begins + 1e-9, time, duty)
    ends = begins[:, None, None] + share / carrier_hz
    edges = np.unique(np.concatenate([begins, ends.ravel(), time[-1:]]))
    edges = edges[edges <= time[-1]]
    filling = edges[:, None, None] < held_values(edges + 1e-9, begins, ends) - 1e-9
    notes.append(f"duties switched at {carrier_hz:g} Hz, filling first")
    return edges, np.where(filling, 1.0, -1.0)


def on_bench(recording: Recording, spec: RobotSpec) -> Recording:
    """Return a recording in the frame of its clamp.

    Raises:
        InputError: the head moves, so that nothing holds it.
    """
    trajectory = recording.trajectory
    head, aim = trajectory.position[:, 0], trajectory["theta_1"]
    # Medians: a few frames that are wrong do not count.
    held, heading = np.median(head, axis=0), float(np.median(aim))
    moved = float(np.quantile(np.linalg.norm(head - held, axis=1), 0.95))
    turned = float(np.quantile(np.abs(aim - heading), 0.95))
    pitch = spec.geometry.pitch
    if moved > _MOVED * pitch or turned > _TURNED:
        raise InputError(
            f"{recording.summary.source}: the head moves by {1e3 * moved:.0f} mm and turns by "
            f"{np.degrees(turned):.2g}°; on a bench it is held (is the other end held? Give --head)"
        )
    mass = spec.mass.array()
    # Turned by −heading about the clamp, which then lies ahead on the x axis.
    ahead = pitch * float(np.arange(len(mass)) @ mass) / float(mass.sum())
    back, origin = np.exp(-1j * heading), held @ [1, 1j]
    com = (trajectory.com @ [1, 1j] - origin) * back + ahead
    place = (trajectory.position @ [1, 1j] - origin) * back + ahead
    pose = pose_columns(com, trajectory["heading"] - heading, place, trajectory.stack("theta") - heading)
    columns = {**trajectory.columns, **pose}
    if "com_velocity_x" in columns:
        velocity = (columns["com_velocity_x"] + 1j * columns["com_velocity_y"]) * back
        columns |= {"com_velocity_x": velocity.real, "com_velocity_y": velocity.imag}
    about = {**trajectory.metadata, "base": "clamped"}
    return replace(recording, trajectory=replace(trajectory, columns=columns, metadata=about))
