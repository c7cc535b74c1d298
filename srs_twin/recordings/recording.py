"""Recording: a motion that was captured, as a trajectory. `read_motion` goes from file to trajectory."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.errors import InputError, UnknownNameError, check_choice
from srs_twin.recordings.body.floor import UPS, FloorPlane, on_floor, strangers
from srs_twin.recordings.body.markers import (
    LAYOUTS,
    CapturedMarkers,
    TrackedBody,
    check_scale,
    likeliest_layout,
    robot_markers,
    tracked_body,
)
from srs_twin.recordings.body.tracking import MOST, follow, pack_slots
from srs_twin.recordings.body.trajectories import LogSummary, MarkerCounts, body_trajectory
from srs_twin.recordings.formats import read_markers
from srs_twin.recordings.marker_table import MarkerTable
from srs_twin.recordings.recording_map import NO_MAP, RecordingMap
from srs_twin.recordings.signals.gaps import (
    LEAST_FRAMES,
    WAYS,
    FrameGrid,
    at_frames,
    filled,
    frame_grid,
    longest_complete,
    outliers,
    runs,
)
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from srs_twin.recordings.signals.valve_log import ValveLog


LONGEST_GAP = 0.2
"""s. What lies in longer gaps nobody knows: the trajectory is cut there."""

_ARM = 0.01  # m: from a rigid body to the markers that stand for it
_JUMP = 0.06  # of a segment's length: no smaller jump is an outlier
_REACH = 0.8  # of a segment's length: no marker appears farther from where it is expected


@dataclass(frozen=True)
class Recording:
    """A captured motion.

    Attributes:
        trajectory: with the columns of a plant's, and ``filled_1…`` (1 where a marker of that connector was
            filled in), ``residual``, ``com_velocity_x``, ``com_velocity_y``, ``yaw_rate``, ``bend_rate_1…``;
            of a log of bends only the last of these.
        summary: what was made of the file.
        valves: what was commanded or measured of the air, on the clock of the trajectory; None at first.
        epoch_ns: time since 1970 at 0 s, ns; None where the file's clock does not tell.
    """

    trajectory: Trajectory
    summary: LogSummary
    valves: ValveLog | None = None
    epoch_ns: int | None = None


@contextmanager
def named_in_errors(file: str) -> Iterator[None]:
    """Put a file's name before the messages of a block."""
    try:
        yield
    except UnknownNameError as error:
        error.args = (f"{file}: {error}",)
        raise
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


def read_motion(
    path: str | os.PathLike[str],
    spec: RobotSpec,
    *,
    up: str = "auto",
    layout: str = "auto",
    head: str | None = None,
    map: RecordingMap = NO_MAP,
    longest_gap_s: float = LONGEST_GAP,
    fill: str = "spline",
    gait_frequency_hz: float | None = None,
) -> Recording:
    """Read a captured motion.

    Args:
        path: a recording in one of `formats.FORMATS`.
        spec: the robot on it.
        up: the axis of the file that points up, one of `floor.UPS`.
        layout: one of `body.LAYOUTS`.
        head: name of the column of the marker at the head; None: the end towards which the robot crawls.
        map: which marker or rigid body is what, and what the file does not say.
        longest_gap_s: longest gap that is filled, from the last sample before it to the first after, s.
        fill: "spline" or "linear".
        gait_frequency_hz: of the gait, for the metrics; None: not periodic.

    Returns:
        The longest stretch in which all markers are known.

    Raises:
        InputError: the file cannot be used; says where and what would do.
    """
    if not 0 <= longest_gap_s <= 10:
        raise InputError(f"longest_gap_s {longest_gap_s!r} is not allowed; it must be from 0 to 10 s")
    check_choice("up", up, UPS)
    check_choice("fill", fill, WAYS)
    if layout not in LAYOUTS:
        raise UnknownNameError("layout", layout, LAYOUTS)
    table = read_markers(path, rate_hz=map.rate_hz, unit=map.units, scale_m=map.scale_m, dialect=map.dialect)
    up = map.up if map.up and up == "auto" else up
    with named_in_errors(table.name):
        table = bodies_as_pairs(map.applied(table))
        geometry = spec.geometry
        frames = frame_grid(table.time)
        floor = on_floor(table.points, up, table.usual_up)
        slots, columns = in_slots(table, at_frames(floor.points, frames))
        gap_frames = max(1, round(longest_gap_s / frames.period))
        check_scale(slots[..., :2], spec)
        tracks, columns, dropped = follow(slots, columns, gap_frames, _REACH * geometry.pitch)
        tracks, columns, others, notes = without_strangers(tracks, columns, table)
        layouts, chosen = robot_markers(
            tracks, geometry.connectors, geometry.pitch, layout, len(table.places)
        )
        left_out = int((~np.isnan(np.delete(tracks, chosen, axis=1)[..., 0])).sum())
        points = tracks[:, chosen]
        jumps = outliers(points, _JUMP * geometry.pitch)
        points[jumps] = np.nan
        kept = longest_complete(frames.time, points, longest_gap_s)
        if kept.stop - kept.start < LEAST_FRAMES:
            together = 100 * (~np.isnan(points[..., 0])).all(axis=1).mean()
            raise InputError(
                f"no {LEAST_FRAMES} frames on end in which all {points.shape[1]} markers are known with gaps "
                f"up to {longest_gap_s:g} s ({len(frames.time)} frames at {1 / frames.period:.4g} Hz, all "
                f"markers seen on {together:.0f} % of them); give --longest-gap"
            )
        time = frames.time[kept]
        origin = np.where(np.isnan(points[kept][..., 0]), -1, columns[kept][:, chosen])
        whole, other = filled(time, points[kept], fill), others + left_out + dropped
        markers = CapturedMarkers(table, layouts[0], time, whole, origin, int(jumps.sum()), other)
        markers = likeliest_layout(markers, layouts, spec, head)
        body = tracked_body(markers, spec, head)
        said = *table.corrections, *frames.corrections, *floor.corrections, *notes, *body.corrections
        counts, unseen = _counts(frames, floor, markers, body), int(markers.missing.sum())
        summary = LogSummary.of(table, table.kind, frames, kept, unseen, said, counts)
        trajectory = body_trajectory(body, markers, spec, summary, gait_frequency_hz)
        return Recording(trajectory, summary, epoch_ns=table.epoch_ns)


def bodies_as_pairs(table: MarkerTable) -> MarkerTable:
    """Return a table in which two markers stand for each rigid body with a rotation, on one of its axes.

    The axis is the one that turns most: an upright one would tell no heading.
    """
    if table.rotations is None:
        return table
    from scipy.spatial.transform import Rotation

    points, owners = list[np.ndarray](), list[int]()
    for k in range(len(table.labels)):
        turns, place = table.rotations[:, k], table.points[:, k]
        known = np.isfinite(turns).all(axis=1)
        arms = np.zeros((1, 3))
        if known.any():
            axes = np.full((len(turns), 3, 3), np.nan)
            axes[known] = Rotation.from_quat(turns[known]).as_matrix()
            arms = axes[..., int(np.nanvar(axes, axis=0).sum(axis=0).argmax())] * _ARM
        ends = [place + arms, place - arms] if known.any() else [place]
        points, owners = points + ends, owners + [k] * len(ends)
    labels = tuple(table.labels[k] for k in owners)
    places = tuple(table.places[k] for k in owners) if table.places else ()
    return replace(table, points=np.stack(points, axis=1), labels=labels, places=places, rotations=None)


def _counts(
    frames: FrameGrid, floor: FloorPlane, markers: CapturedMarkers, body: TrackedBody
) -> MarkerCounts:
    """Return what became of the markers of a file."""
    table, time, columns = markers.table, markers.time, markers.columns
    gaps = [time[end] - time[begin - 1] for column in markers.missing.T for begin, end in runs(column)]
    return MarkerCounts(
        header_frames=table.header_frames,
        frames_missing=int((frames.rows < 0).sum()),
        columns=len(table.labels),
        layout=markers.layout,
        head=body.head,
        up=floor.up,
        samples_seen=int((~np.isnan(at_frames(floor.points, frames)[..., 0])).sum()),
        samples_other=markers.other,
        samples_rejected=markers.rejected,
        longest_filled_s=float(max(gaps, default=0.0)),
        moves=sum(int((np.diff(column[column >= 0]) != 0).sum()) for column in columns.T),
        spacing_m=tuple(float(each) for each in body.spacing),
        residual_m=float(np.sqrt((body.shape.residual**2).mean())),
        noise_m=body.shape.noise,
        bend_error_rad=float(np.sqrt((body.shape.bend_error**2).mean())),
    )


def without_strangers(
    tracks: np.ndarray, columns: np.ndarray, table: MarkerTable
) -> tuple[np.ndarray, np.ndarray, int, list[str]]:
    """Return tracks that may be the robot's, in the plane.

    Args:
        tracks: over the floor, shape (frames, tracks, 3), m.
        columns: from which column of the file each sample came, −1 where it was not seen, (frames, tracks).
        table: the file; columns that have a place on the robot are the robot's.

    Returns:
        Shape (frames, tracks, 2), m; columns; how many samples the others had; words on them.
    """
    out = {} if table.places else strangers(tracks)
    mine = np.array([k for k in range(tracks.shape[1]) if k not in out], dtype=int)
    samples, notes = 0, []
    for k, why in out.items():
        own = columns[columns[:, k] >= 0, k]
        samples += own.size
        if own.size >= LEAST_FRAMES:
            notes.append(f"marker '{table.labels[np.bincount(own).argmax()]}' left out: {why}")
    return tracks[:, mine, :2], columns[:, mine], samples, notes


def in_slots(table: MarkerTable, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return markers in slots; columns with connectors' names stay where they are."""
    count = len(table.places)
    if not count:
        return pack_slots(points)
    if count > MOST:
        raise InputError(f"{count} markers; at most {MOST} are followed")
    return points, np.broadcast_to(np.arange(count), (len(points), count))
