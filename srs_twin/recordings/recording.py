"""Recorded robot motion as a trajectory, with a valve or pressure log."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from srs_twin.errors import (
    InputError,
    UnknownNameError,
    check_choice,
    named_in_errors,
)
from srs_twin.io.files import StrPath
from srs_twin.plants.base import Pose
from srs_twin.pneumatics import Schedule
from srs_twin.recordings.body.floor import UPS, FloorPlane, map_to_floor
from srs_twin.recordings.body.layout import (
    LAYOUTS,
    check_scale,
    foreign_tracks,
    robot_markers,
)
from srs_twin.recordings.body.markers import CapturedMarkers, TrackedBody, tracked_body
from srs_twin.recordings.body.tracking import (
    MAX_MARKERS,
    Tracks,
    pack_slots,
    track_markers,
)
from srs_twin.recordings.body.trajectories import (
    LogSummary,
    MarkerCounts,
    body_trajectory,
)
from srs_twin.recordings.formats import read_markers
from srs_twin.recordings.formats.base import MarkerTable
from srs_twin.recordings.recording_map import NO_MAP, RecordingMap, as_map
from srs_twin.recordings.signals.gaps import (
    MIN_FRAMES,
    FrameGrid,
    at_frames,
    fill_gaps,
    frame_grid,
    longest_complete,
    outliers,
    runs,
)
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

LONGEST_GAP = 0.2
"""Default maximum duration of a gap that is interpolated, s.

The trajectory ends at a longer gap.
"""

_BODY_MARKER_OFFSET = 0.01
"""Distance from the centre of a rigid body to the markers that replace it, m."""
_MIN_JUMP = 0.06
"""Minimum distance of an outlier from its track, relative to the segment length."""
_REACH = 0.8
"""Maximum distance of a marker from its expected position, in segment lengths."""

_MIN_OPENINGS = 4
_MAX_UNEVENNESS = 0.05
"""Maximum relative deviation of the opening intervals in a periodic log."""
_CARRIER_S = 0.07
"""Minimum interval between two valve openings of a gait, s.

Shorter intervals are due to pulse-width modulation.
"""
_STILL_S = 1e-9
_MAX_EMPTY_PA = 1e3


@dataclass(frozen=True)
class ValveLog:
    """Log of valve states or pressures.

    Attributes:
        kind: kind of the log, "valve" or "pressure".
        time: times of the rows in ascending order, s, shape (rows,).
        values: valve states or gauge pressures (Pa), shape (rows, segments, 2). The
            last axis contains the + and the − chamber. A valve state holds until the
            next row.
        epoch_ns: Unix time that corresponds to a time of 0 s, ns, or None if the file
            contains no Unix times.
        holds: whether pressures hold until the next row, as set points do. Otherwise,
            pressures are interpolated.
    """

    kind: str
    time: np.ndarray
    values: np.ndarray
    source: str
    sha256: str
    corrections: tuple[str, ...]
    epoch_ns: int | None = None
    holds: bool = False

    def shifted(self, offset: float) -> ValveLog:
        """Return a copy with `offset` (s) added to all times."""
        return replace(self, time=self.time + offset)

    def schedule(self) -> Schedule:
        """Return the valve states as a schedule from the first to the last row."""
        states = self.values.astype(np.int8)
        changes = np.append(
            0, np.flatnonzero((states[1:] != states[:-1]).any(axis=(1, 2))) + 1
        )
        return Schedule(
            float(self.time[-1] - self.time[0]),
            self.time[changes] - self.time[0],
            states[changes],
        )

    def at(self, time: np.ndarray) -> np.ndarray:
        """Return the values at times inside the log, shape (times, segments, 2)."""
        if self.kind == "valve" or self.holds:
            return held_values(time + 1e-9, self.time, self.values)
        return interpolated_values(time, self.time, self.values)

    def breakpoints(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times and pressures whose linear interpolation gives `at`.

        A step between set points is represented by two breakpoints.
        """
        if not self.holds:
            return self.time, self.values
        time = np.repeat(self.time, 2)[1:]
        time[1::2] = np.nextafter(time[1::2], -np.inf)
        return time, np.repeat(self.values, 2, axis=0)[:-1]

    def gait_frequency(self) -> float | None:
        """Return the gait frequency (Hz), or None without periodic valve states.

        The gait frequency is the rate at which each valve opens for filling. The first
        opening is ignored, because a gait may start within a period. Openings in quick
        succession are due to pulse-width modulation and are counted as one opening.
        """
        if self.kind != "valve":
            return None
        opened = (self.values[1:] == 1) & (self.values[:-1] != 1)
        periods = []
        for column in opened.reshape(len(opened), -1).T:
            times = self.time[1:][column]
            first = np.append(True, np.diff(times) > _CARRIER_S)[: len(times)]
            times = times[first][1:]
            if len(times) < _MIN_OPENINGS:
                return None
            gaps = np.diff(times)
            period = float(gaps.mean())
            if np.abs(gaps - period).max() > _MAX_UNEVENNESS * period:
                return None
            periods.append(period)
        period = float(np.mean(periods))
        if np.ptp(periods) <= _MAX_UNEVENNESS * period:
            return 1 / period
        return None


def held_values(time: np.ndarray, rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the values of the last row at or before each time.

    Times before the first row have the values of the first row.
    """
    return np.asarray(
        values[np.maximum(np.searchsorted(rows, time, side="right") - 1, 0)]
    )


def interpolated_values(
    time: np.ndarray, rows: np.ndarray, values: np.ndarray
) -> np.ndarray:
    """Interpolate values of shape (rows, …) linearly between the times of the rows."""
    flat = values.reshape(len(rows), -1)
    columns = [np.interp(time, rows, column) for column in flat.T]
    return np.stack(columns, axis=-1).reshape(len(time), *values.shape[1:])


@dataclass(frozen=True)
class Recording:
    """Measured motion of a robot.

    Attributes:
        trajectory: measured motion with the columns of a simulated motion and the bend
            rates ``bend_rate_1…``. A motion from markers also has the columns
            ``residual``, ``com_velocity_x``, ``com_velocity_y``, ``yaw_rate`` and
            ``filled_1…`` (1 if a marker of the connector was interpolated).
        valves: log of valve states or pressures on the clock of the trajectory, or None
            before `join` adds the log.
    """

    trajectory: Trajectory
    summary: LogSummary
    valves: ValveLog | None = None
    epoch_ns: int | None = None

    @property
    def only_bends(self) -> bool:
        """Whether the recording contains only bends, without positions."""
        return bool(self.trajectory.metadata.get("bends_only"))

    def pressures(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the recorded pressures, or None if there are none.

        Returns:
            Times since the first sample of the trajectory, s, shape (rows,), and gauge
            pressures, Pa, shape (rows, segments, 2).
        """
        if self.valves is None or self.valves.kind == "valve":
            return None
        time, values = self.valves.breakpoints()
        return time - self.trajectory.time[0], values

    def commands(self, name: str) -> Schedule:
        """Return the valve states from the first sample of the trajectory.

        If pressures were recorded instead, all valves vent. `name` identifies the
        recording in error messages.
        """
        log = self.valves
        time = self.trajectory.time
        if log is None:
            raise InputError(
                f"{name}: the recording has no log of valves or pressures; give one"
                " with `valves`"
            )
        if log.kind != "valve":
            vented = np.full((1, *log.values.shape[1:]), -1, dtype=np.int8)
            return Schedule(float(time[-1] - time[0]), np.zeros(1), vented)
        schedule = log.schedule()
        begin = min(max(float(time[0] - log.time[0]), 0.0), schedule.span - _STILL_S)
        return schedule.slice(begin, schedule.span)

    def starts_at_rest(self) -> bool:
        """Return whether all chambers are empty at the start of the trajectory."""
        if self.valves is None:
            return True
        before = self.valves.values[
            self.valves.time <= self.trajectory.time[0] + _STILL_S
        ]
        if self.valves.kind == "valve":
            empty = before == -1
        else:
            empty = np.abs(before) < _MAX_EMPTY_PA
        return bool(empty.all())

    def start_pose(self) -> Pose:
        """Return the mean pose of the body before the first chamber is filled."""
        trajectory = self.trajectory
        log = self.valves
        moves = trajectory.time[0]
        if log is not None:
            busy = (log.values > (0 if log.kind == "valve" else _MAX_EMPTY_PA)).any(
                axis=(1, 2)
            )
            moves = log.time[busy].min(initial=trajectory.time[-1])
        still = trajectory.time <= max(moves, trajectory.time[0]) + _STILL_S
        x, y = trajectory.com[still].mean(axis=0)
        return float(x), float(y), float(trajectory["heading"][still].mean())


def read_motion(
    path: StrPath,
    spec: RobotSpec,
    *,
    up: str = "auto",
    layout: str = "auto",
    head: str | None = None,
    map: RecordingMap | Mapping[str, object] | StrPath = NO_MAP,  # noqa: A002
    longest_gap_s: float = LONGEST_GAP,
    gait_frequency_hz: float | None = None,
) -> Recording:
    """Read a measured motion from a file.

    Args:
        path: recording in one of `formats.FORMATS`.
        spec: specification of the recorded robot.
        up: vertical axis of the file, one of `floor.UPS`.
        layout: marker layout, one of `body.layout.LAYOUTS`.
        head: column name of the marker at the head, or None to detect the head from the
            markers and their motion.
        map: recording map, given as an object, a mapping or a path. The map states the
            places of markers and rigid bodies, and adds information that the file
            lacks.
        longest_gap_s: maximum duration of a gap that is interpolated, s.
        gait_frequency_hz: gait frequency, Hz, or None if the motion is not periodic.

    Returns:
        Longest part of the motion in which all marker positions are known.

    Raises:
        InputError: the file cannot be used, `up` is unknown, or `longest_gap_s` is out
            of range.
        UnknownNameError: the value of `layout` or `head` is unknown.
    """
    if not 0 <= longest_gap_s <= 10:
        raise InputError(
            f"`longest_gap_s` {longest_gap_s!r} is not allowed; it must be between 0"
            " and 10 s"
        )
    check_choice("up", up, UPS)
    if layout not in LAYOUTS:
        raise UnknownNameError("layout", layout, LAYOUTS)
    recording_map = as_map(map)
    table = read_markers(path, recording_map.unstated)
    with named_in_errors(table.name):
        table = bodies_as_pairs(recording_map.applied(table))
        frames = frame_grid(table.time, table.points)
        if up == "auto":
            up = recording_map.up or up
        floor = map_to_floor(table.points, up, table.usual_up, recording_map.level)
        points = at_frames(floor.points, frames)
        markers, notes = _captured_markers(
            table, spec, frames, points, layout, longest_gap_s
        )
        body = tracked_body(markers, spec, head)
        texts = (
            *table.corrections,
            *frames.corrections,
            *floor.corrections,
            *notes,
            *body.corrections,
        )
        counts = _counts(frames, floor, markers, body)
        hidden = int(markers.missing.sum())
        summary = LogSummary.from_file(
            table, table.kind, frames, markers.time, hidden, texts, counts
        )
        trajectory = body_trajectory(body, markers, spec, summary, gait_frequency_hz)
        return Recording(trajectory, summary, epoch_ns=table.epoch_ns)


def _captured_markers(
    table: MarkerTable,
    spec: RobotSpec,
    frames: FrameGrid,
    points: np.ndarray,
    layout: str,
    longest_gap_s: float,
) -> tuple[CapturedMarkers, list[str]]:
    geometry = spec.geometry
    slots = in_slots(table, points)
    # A wrong unit of length is reported before the tracking, because the tracking
    # compares distances with the size of the robot.
    check_scale(slots.points[..., :2], spec)
    tracks, notes = robot_tracks(
        table, slots, longest_gap_s / frames.period, _REACH * geometry.pitch
    )
    if table.bodies and layout == "auto":
        layout = "pair"
    layouts, chosen = robot_markers(
        tracks.points, geometry.connectors, geometry.pitch, layout, len(table.places)
    )
    places = tracks.points[:, chosen]
    other = int(
        np.isfinite(slots.points[..., 0]).sum() - np.isfinite(places[..., 0]).sum()
    )
    jumps = outliers(places, _MIN_JUMP * geometry.pitch)
    places[jumps] = np.nan
    kept = _kept_frames(frames, places, longest_gap_s)
    time = frames.time[kept]
    places = places[kept]
    origin = np.where(np.isnan(places[..., 0]), -1, tracks.columns[kept][:, chosen])
    filled = fill_gaps(time, places, 3)
    return (
        CapturedMarkers(table, layouts, time, filled, origin, int(jumps.sum()), other),
        notes,
    )


def _kept_frames(frames: FrameGrid, points: np.ndarray, longest_gap_s: float) -> slice:
    kept = longest_complete(frames.time, points, longest_gap_s)
    if kept.stop - kept.start < MIN_FRAMES:
        complete = 100 * (~np.isnan(points[..., 0])).all(axis=1).mean()
        raise InputError(
            f"no {MIN_FRAMES} successive frames contain all {points.shape[1]} markers"
            f" with gaps of at most {longest_gap_s:g} s. All markers are visible in"
            f" {complete:.0f} % of the {len(frames.time)} frames at"
            f" {1 / frames.period:.4g} Hz; allow longer gaps with --longest-gap"
        )
    return kept


def bodies_as_pairs(table: MarkerTable) -> MarkerTable:
    """Replace each rigid body with an orientation by two markers on a body axis.

    The markers lie on the axis whose direction varies most, because a vertical axis
    does not indicate the heading.
    """
    if table.rotations is None:
        return table
    from scipy.spatial.transform import Rotation

    known = np.isfinite(table.rotations).all(axis=2)
    owners = np.repeat(np.arange(len(table.labels)), 1 + known.any(axis=0))
    points = table.points[:, owners]
    for k in np.flatnonzero(known.any(axis=0)):
        axes = np.full((len(points), 3, 3), np.nan)
        axes[known[:, k]] = Rotation.from_quat(
            table.rotations[known[:, k], k]
        ).as_matrix()
        most_variable = int(np.nanvar(axes, axis=0).sum(axis=0).argmax())
        offset = _BODY_MARKER_OFFSET * axes[..., most_variable]
        front, rear = np.flatnonzero(owners == k)
        points[:, front] += offset
        points[:, rear] -= offset
    return replace(
        table,
        points=points,
        labels=tuple(table.labels[k] for k in owners),
        places=tuple(table.places[k] for k in owners) if table.places else (),
        rotations=None,
        bodies=True,
    )


def _counts(
    frames: FrameGrid, floor: FloorPlane, markers: CapturedMarkers, body: TrackedBody
) -> MarkerCounts:
    table = markers.table
    time = markers.time
    gaps = [
        time[end] - time[begin - 1]
        for column in markers.missing.T
        for begin, end in runs(column)
    ]
    return MarkerCounts(
        header_frames=table.header_frames,
        frames_missing=int((frames.rows < 0).sum()),
        columns=len(table.labels),
        layout=body.layout,
        head=body.head,
        up=floor.up,
        samples_seen=int((~np.isnan(at_frames(floor.points, frames)[..., 0])).sum()),
        samples_other=markers.other,
        samples_rejected=markers.rejected,
        longest_filled_s=float(max(gaps, default=0.0)),
        moves=sum(
            int((np.diff(column[column >= 0]) != 0).sum())
            for column in markers.columns.T
        ),
        spacing_m=tuple(body.spacing.tolist()),
        residual_m=float(np.sqrt((body.shape.residual**2).mean())),
        noise_m=body.shape.noise,
        bend_error_rad=float(np.sqrt((body.shape.bend_error**2).mean())),
    )


def in_slots(table: MarkerTable, points: np.ndarray) -> Tracks:
    """Combine columns that may contain the same marker (see `pack_slots`).

    Columns stay separate if they contain rigid bodies or have known places on the
    robot.
    """
    slots = Tracks(
        points, np.where(np.isnan(points[..., 0]), -1, np.arange(len(table.labels))), 0
    )
    if not (table.places or table.bodies):
        slots = pack_slots(points)
    if (count := slots.points.shape[1]) > MAX_MARKERS:
        raise InputError(
            f"{count} markers are in the same frame, but at most {MAX_MARKERS} can be"
            " tracked"
        )
    return slots


def robot_tracks(
    table: MarkerTable, slots: Tracks, longest_gap: float, reach: float
) -> tuple[Tracks, list[str]]:
    """Return the tracks that may belong to the robot, and notes on other tracks.

    Rigid bodies are not tracked, because their names identify them. Columns with known
    places always belong to the robot. The returned positions omit the height.
    `longest_gap` is the maximum length of a gap in frames. `reach` is the maximum
    distance of a marker from its expected position in m.
    """
    tracks = slots
    if not table.bodies:
        tracks = track_markers(
            slots.points, slots.columns, max(1, round(longest_gap)), reach
        )
    foreign = {} if table.places else foreign_tracks(tracks.points)
    notes = []
    for k, reason in foreign.items():
        visible = tracks.columns[tracks.columns[:, k] >= 0, k]
        if visible.size >= MIN_FRAMES:
            notes.append(
                f"the marker '{table.labels[np.bincount(visible).argmax()]}' was left"
                f" out: {reason}"
            )
    points, columns = (
        np.delete(values, list(foreign), axis=1) for values in tracks[:2]
    )
    return Tracks(points[..., :2], columns, tracks.unassigned), notes
