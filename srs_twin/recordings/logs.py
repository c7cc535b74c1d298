"""Logs of a robot: what its sensors said, what was commanded of its valves or measured in its chambers.

Bend log: what the sensors of a robot on a bench said, ``time,bend_1,…`` in a plain CSV file.

Angles are in rad, or in the unit of the name: ``bend_1_deg``; positive where the front end heads to the left
of the rear end. Where the body is follows from its bends and from where its head is held.

Valve log: what was commanded of the valves, or measured in the chambers, on a clock of its own.

A plain CSV file with ``time`` and either ``valve_plus_1, valve_minus_1, …`` (+1 fill, 0 hold, −1 vent) or
``pressure_plus_1, pressure_minus_1, …`` (gauge; Pa, or the unit in the name: ``pressure_plus_1_kpa``).

Bench: a captured motion of a robot that is held at its head, in the frame of the clamp.

Plants on a bench are held where the head of a straight body lies whose centre of mass is at the origin. A
recording is turned and moved so that its head is held there.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.geometry import body_shape, relative_headings
from srs_twin.pneumatics import Schedule
from srs_twin.recordings.gaps import LEAST_FRAMES, filled, in_order, longest_whole, taken
from srs_twin.recordings.recording import Recording
from srs_twin.recordings.source import Source, read_source
from srs_twin.recordings.summary import BendSummary
from srs_twin.recordings.tables import ANGLES, PRESSURES, TIMES, Column, read_columns, read_rows
from srs_twin.recordings.trajectories import metadata, moving_slope, numbered
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

_KIND = "bend log"
_KNOWN = {"time": TIMES, "t": TIMES, "bend": ANGLES}
_LARGEST = 2 * np.pi  # rad: no segment is a full circle


def is_bend_log(path: str | os.PathLike[str]) -> bool:
    """Say whether a file's first line names bends.

    Raises:
        InputError: it cannot be read.
    """
    names = (cell.strip().lower() for cell in read_source(path).head(1)[0].split(","))
    return any(name.startswith("bend_1") for name in names)


def read_bends(
    path: str | os.PathLike[str],
    spec: RobotSpec,
    *,
    longest_gap_s: float,
    gait_frequency_hz: float | None = None,
) -> Recording:
    """Read a bend log.

    Args:
        path: of the file.
        spec: the robot whose sensors they were.
        longest_gap_s: longest gap that is filled, s.
        gait_frequency_hz: Hz; None: not periodic.

    Returns:
        The longest stretch in which all bends are known, with the head at the origin, heading along x.

    Raises:
        InputError: the file cannot be used; says where and what would do.
    """
    source = read_source(path)
    columns, width, others = read_columns(source, _KNOWN)
    clock = next((each for each in columns if each.name in ("time", "t")), None)
    if clock is None:
        raise source.error("no column 'time'; a bend log has time,bend_1,…", 1)
    chosen = _chosen(source, columns, spec)
    order = sorted([clock, *chosen], key=lambda each: each.place)
    rows = read_rows(source, 1, [each.place for each in order], width)
    place = {each.text: k for k, each in enumerate(order)}
    time = rows.values[:, place[clock.text]] * TIMES[clock.unit or "s"]
    missing = np.flatnonzero(np.isnan(time))
    if missing.size:
        raise source.error("a row without a time", rows.first_line + int(missing[0]), clock.place + 1)
    bend = np.stack([rows.values[:, place[c.text]] * ANGLES[c.unit or "rad"] for c in chosen], axis=1)
    _believable(source, chosen, bend, rows.first_line)
    frames = in_order(source.name, time)
    # Gaps are those of tracks in a plane; bends lie on its first axis.
    tracks = np.stack([taken(bend, frames), np.zeros((len(frames.time), len(chosen)))], axis=-1)
    tracks[np.isnan(tracks[..., 0])] = np.nan
    kept = longest_whole(frames.time, tracks, longest_gap_s)
    if kept.stop - kept.start < LEAST_FRAMES:
        raise source.error(f"no {LEAST_FRAMES} rows on end in which all bends are known; give longest_gap_s")
    unknown = np.isnan(tracks[kept][..., 0])
    bends, clock_kept = filled(frames.time[kept], tracks[kept], "linear")[..., 0], frames.time[kept]
    said = [*rows.corrections, *frames.corrections]
    if not any(each.unit for each in chosen):
        said.append("bends without a unit taken as rad")
    if others:
        said.append(
            f"{len(others)} columns not used: {', '.join(others[:5])}{', …' if len(others) > 5 else ''}"
        )
    summary = BendSummary(
        source.name, source.sha256, len(time), 1 / frames.period, int(unknown.sum()), len(clock_kept),
        float(clock_kept[0]), float(clock_kept[-1]), tuple(said),
    )  # fmt: skip
    return Recording(_trajectory(clock_kept, bends, unknown, spec, summary, gait_frequency_hz), summary)


def _chosen(source: Source, columns: list[Column], spec: RobotSpec) -> list[Column]:
    """Return the columns of the bends, head first."""
    found = {each.number: each for each in columns if each.name == "bend"}
    for segment in range(1, spec.segments + 1):
        if segment not in found:
            raise source.error(f"bend_{segment} is missing; {spec.name} has {spec.segments} segments", 1)
    extra = next((each for number, each in found.items() if not 1 <= number <= spec.segments), None)
    if extra is not None:
        raise source.error(f"{extra.text}: {spec.name} has {spec.segments} segments", 1, extra.place + 1)
    return [found[segment] for segment in range(1, spec.segments + 1)]


def _believable(source: Source, chosen: list[Column], bend: np.ndarray, first_line: int) -> None:
    """Refuse bends that no segment has."""
    wrong = np.argwhere(np.abs(bend) > _LARGEST)
    if wrong.size:
        row, k = (int(each) for each in wrong[0])
        raise source.error(
            f"{chosen[k].text}: a bend of {bend[row, k]:.4g} rad is not allowed; at most {_LARGEST:.4g} "
            "(bend_1_deg, where they are degrees)",
            first_line + row,
            chosen[k].place + 1,
        )


def _trajectory(
    time: np.ndarray, bend: np.ndarray, unknown: np.ndarray, spec: RobotSpec, summary: BendSummary,
    gait_frequency_hz: float | None,
) -> Trajectory:  # fmt: skip
    geometry = spec.geometry
    shape = body_shape(bend, spec.mass.array(), geometry.segment_length, geometry.rigid_gap) @ [1, 1j]
    relative = relative_headings(bend)
    theta = relative - relative[:, :1]
    place = (shape - shape[:, :1]) * np.exp(-1j * relative[:, :1])
    com = -shape[:, 0] * np.exp(-1j * relative[:, 0])
    rates = moving_slope(time, bend)
    columns = {
        "time": time, "com_x": com.real, "com_y": com.imag, "heading": theta.mean(axis=1),
        **numbered("x", place.real), **numbered("y", place.imag), **numbered("theta", theta),
        **numbered("bend", bend), **numbered("bend_rate", rates),
    }  # fmt: skip
    units = {name: "rad/s" for name in columns if name.startswith("bend_rate_")}
    about = metadata(spec, summary, gait_frequency_hz, {"kind": _KIND, "samples_filled": int(unknown.sum())})
    about["bends_only"] = True
    return Trajectory(columns, units, metadata=about)


SIDES = ("plus", "minus")
_VALVE_LOG_KNOWN = {
    "time": TIMES, "t": TIMES, "valve_plus": {}, "valve_minus": {}, "pressure_plus": PRESSURES,
    "pressure_minus": PRESSURES,
}  # fmt: skip
_HIGHEST = 2e6  # Pa: no chamber holds more
_LOWEST = -1.1e5


@dataclass(frozen=True)
class ValveLog:
    """A log of valves or pressures.

    Attributes:
        kind: "valve" or "pressure".
        time: ascending, shape (rows,), s.
        values: valve states, which hold until the next row, or gauge pressures (Pa), shape
            (rows, segments, 2), columns + and − chamber.
        source: name of the file.
        sha256: of the file.
        corrections: what was sorted, converted and assumed, in words.
    """

    kind: str
    time: np.ndarray
    values: np.ndarray
    source: str
    sha256: str
    corrections: tuple[str, ...]

    def shifted(self, offset: float) -> ValveLog:
        """Return the same log on a clock that shows `offset` (s) more."""
        return replace(self, time=self.time + offset)

    def schedule(self, span: float | None = None) -> Schedule:
        """Return the valve states as a schedule from the first row on.

        Args:
            span: its length, s; None: to the last row.

        Raises:
            InputError: pressures are no valve states.
        """
        if self.kind != "valve":
            raise InputError(f"{self.source}: a log of pressures has no schedule of valves")
        states = self.values.astype(np.int8)
        changes = np.append(0, np.flatnonzero((states[1:] != states[:-1]).any(axis=(1, 2))) + 1)
        length = float(self.time[-1] - self.time[0]) if span is None else span
        return Schedule(length, self.time[changes] - self.time[0], states[changes])

    def at(self, time: np.ndarray) -> np.ndarray:
        """Return the values at times within the log, shape (times, segments, 2)."""
        if self.kind == "valve":
            row = np.clip(np.searchsorted(self.time, time + 1e-9, side="right") - 1, 0, len(self.time) - 1)
            return np.asarray(self.values[row])
        flat = self.values.reshape(len(self.time), -1)
        columns = [np.interp(time, self.time, column) for column in flat.T]
        return np.stack(columns, axis=-1).reshape(len(time), *self.values.shape[1:])


def read_valves(path: str | os.PathLike[str], spec: RobotSpec) -> ValveLog:
    """Read a log of valves or pressures.

    Raises:
        InputError: no such file, columns missing, values that no valve or chamber has; says where.
    """
    source = read_source(path)
    columns, width, others = read_columns(source, _VALVE_LOG_KNOWN)
    clock = next((each for each in columns if each.name in ("time", "t")), None)
    if clock is None:
        raise source.error("no column 'time'; a log has time,valve_plus_1,valve_minus_1,… or pressures", 1)
    kind, chosen = _valve_log_chosen(source, columns, spec)
    order = sorted([clock, *chosen], key=lambda each: each.place)
    rows = read_rows(source, 1, [each.place for each in order], width)
    place = {each.text: k for k, each in enumerate(order)}
    time = rows.values[:, place[clock.text]] * TIMES[clock.unit or "s"]
    factor = [PRESSURES[each.unit or "pa"] if kind == "pressure" else 1.0 for each in chosen]
    values = np.stack([rows.values[:, place[each.text]] for each in chosen], axis=1) * factor
    _check(source, kind, clock, chosen, time, values, rows.first_line)
    said = [*rows.corrections]
    if kind == "valve" and not (values == -1).any() and (values == 0).any():
        values = np.where(values == 0, -1.0, values)
        said.append("states are 0 and 1 only: 0 taken as venting (−1), as of 3/2 valves")
    if kind == "pressure" and not any(each.unit for each in chosen):
        said.append("pressures without a unit taken as Pa")
    if others:
        said.append(
            f"{len(others)} columns not used: {', '.join(others[:5])}{', …' if len(others) > 5 else ''}"
        )
    time, values = _ordered(source, time, values, said)
    shaped = values.reshape(len(time), spec.segments, 2)
    return ValveLog(kind, time, shaped, source.name, source.sha256, tuple(said))


def _valve_log_chosen(source: Source, columns: list[Column], spec: RobotSpec) -> tuple[str, list[Column]]:
    """Return what the log is of, and its columns: segment by segment, + before −."""
    kinds = sorted({each.name.partition("_")[0] for each in columns if "_" in each.name})
    if len(kinds) != 1:
        given = "neither" if not kinds else "both"
        raise source.error(f"valve_plus_1,… or pressure_plus_1,… are wanted; {given} given", 1)
    (kind,) = kinds
    found = {(each.name, each.number): each for each in columns}
    chosen = []
    for segment in range(1, spec.segments + 1):
        for side in SIDES:
            column = found.pop((f"{kind}_{side}", segment), None)
            if column is None:
                raise source.error(
                    f"{kind}_{side}_{segment} is missing; {spec.name} has {spec.segments} segments", 1
                )
            chosen.append(column)
    extra = next((each for (name, _), each in found.items() if name.startswith(kind)), None)
    if extra is not None:
        raise source.error(f"{extra.text}: {spec.name} has {spec.segments} segments", 1, extra.place + 1)
    return kind, chosen


def _check(
    source: Source,
    kind: str,
    clock: Column,
    chosen: list[Column],
    time: np.ndarray,
    values: np.ndarray,
    first_line: int,
) -> None:
    """Refuse blanks and what no valve or chamber does."""
    bad = np.flatnonzero(~(np.abs(time) < 1e9))
    if bad.size:
        raise source.error("a row without a time", first_line + int(bad[0]), clock.place + 1)
    if kind == "valve":
        allowed, words = np.isin(values, (-1, 0, 1)), "-1 (vent), 0 (hold) or 1 (fill)"
    else:
        allowed = (values >= _LOWEST) & (values <= _HIGHEST)
        words = f"gauge pressures from {_LOWEST:g} to {_HIGHEST:g} Pa"
    wrong = np.argwhere(~allowed)
    if wrong.size:
        row, column = wrong[0]
        value = values[row, column]
        given = "nothing" if np.isnan(value) else f"{value:g}" + (" Pa" if kind == "pressure" else "")
        raise source.error(
            f"{chosen[column].text}: {given} is not allowed; {words}",
            first_line + int(row),
            chosen[column].place + 1,
        )


def _ordered(
    source: Source, time: np.ndarray, values: np.ndarray, said: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(time, kind="stable")
    moved = int((np.diff(time) < 0).sum())
    if moved:
        said.append(f"rows were not in the order of time ({moved} steps back): sorted")
    time, values = time[order], values[order]
    # Of rows at one time the last holds, as it would on the valve.
    kept = np.append(np.diff(time) > 0, True)
    if not kept.all():
        said.append(f"{int((~kept).sum())} rows repeat the time of another: the last of each kept")
    if kept.sum() < 2:
        raise source.error("a log has 2 rows or more")
    return time[kept], values[kept]


_MOVED = 0.05  # of a segment's length
_TURNED = np.radians(5.0)


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
            f"{recording.summary.source}: the head moves by {1e3 * moved:.3g} mm and turns by "
            f"{np.degrees(turned):.2g}°; on a bench it is held (is the other end held? Give head)"
        )
    mass = spec.mass.array()
    ahead = pitch * float(np.arange(len(mass)) @ mass) / float(mass.sum())
    return replace(recording, trajectory=_moved(trajectory, held, heading, ahead))


def _moved(trajectory: Trajectory, held: np.ndarray, heading: float, ahead: float) -> Trajectory:
    """Return a motion turned by −heading about a point, which then lies ahead on the x axis."""
    back, origin = np.exp(-1j * heading), held @ [1, 1j]

    def placed(points: np.ndarray) -> np.ndarray:
        return np.asarray((points @ [1, 1j] - origin) * back + ahead)

    com, place = placed(trajectory.com), placed(trajectory.position)
    columns = dict(trajectory.columns) | {
        "com_x": com.real, "com_y": com.imag, "heading": trajectory["heading"] - heading,
        **numbered("x", place.real), **numbered("y", place.imag),
        **numbered("theta", trajectory.stack("theta") - heading),
    }  # fmt: skip
    if "com_velocity_x" in columns:
        velocity = (columns["com_velocity_x"] + 1j * columns["com_velocity_y"]) * back
        columns |= {"com_velocity_x": velocity.real, "com_velocity_y": velocity.imag}
    return replace(trajectory, columns=columns, metadata={**trajectory.metadata, "base": "clamped"})
