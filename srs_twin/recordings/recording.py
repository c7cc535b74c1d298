"""Recording: a motion that was captured, as a trajectory. `read_motion` goes from file to trajectory."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.errors import InputError
from srs_twin.recordings.body import body_of
from srs_twin.recordings.floor import Floor, on_floor
from srs_twin.recordings.gaps import (
    LEAST_FRAMES,
    Frames,
    filled,
    in_order,
    longest_whole,
    outliers,
    runs,
    taken,
)
from srs_twin.recordings.layout import check_scale, choose
from srs_twin.recordings.motive import FIRST, parse_motive
from srs_twin.recordings.plain_csv import parse_plain
from srs_twin.recordings.source import read_source
from srs_twin.recordings.summary import BendSummary, LogSummary
from srs_twin.recordings.tracking import MOST, MarkerTable, follow, packed
from srs_twin.recordings.trajectories import trajectory_of
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from srs_twin.recordings.logs import ValveLog


LONGEST_GAP = 0.2
"""s. What lies in longer gaps nobody knows: the trajectory is cut there."""

_HIGHEST = 0.05  # m over or under most markers: farther nothing is on the robot
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
    """

    trajectory: Trajectory
    summary: LogSummary | BendSummary
    valves: ValveLog | None = field(default=None)


def read_markers(path: str | os.PathLike[str]) -> MarkerTable:
    """Read a Motive export or a plain CSV file as it is.

    Raises:
        InputError: with file, line and column, and what is allowed.
    """
    source = read_source(path)
    if source.raw.startswith(FIRST.encode()):
        return parse_motive(source)
    return parse_plain(source)


def read_motion(
    path: str | os.PathLike[str],
    spec: RobotSpec,
    *,
    up: str = "auto",
    layout: str = "auto",
    head: str | None = None,
    longest_gap_s: float = LONGEST_GAP,
    fill: str = "spline",
    gait_frequency_hz: float | None = None,
) -> Recording:
    """Read a captured motion.

    Args:
        path: a Motive CSV export (1.2x) or a plain CSV file.
        spec: the robot on it.
        up: the axis of the file that points up, one of `floor.UPS`.
        layout: one of `layout.LAYOUTS`.
        head: name of the column of the marker at the head; None: the end towards which the robot crawls.
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
    table = read_markers(path)
    frames = in_order(table.name, table.time)
    floor = on_floor(table.name, table.points, up, "y" if table.kind.startswith("Motive") else "z")
    plane, high = _without_high(floor)
    slots, columns = _slots(table, taken(plane, frames), len(frames.time))
    gap_frames = max(1, round(longest_gap_s / frames.period))
    geometry = spec.geometry
    check_scale(table.name, slots, geometry.pitch, spec.segments, spec.name)
    tracks = follow(table.name, slots, columns, gap_frames, _REACH * geometry.pitch)
    chosen = choose(table.name, tracks.points, geometry.connectors, geometry.pitch, layout)
    points = tracks.points[:, chosen.tracks]
    jumps = outliers(points, _JUMP * geometry.pitch)
    points[jumps] = np.nan
    kept = longest_whole(frames.time, points, longest_gap_s)
    if kept.stop - kept.start < LEAST_FRAMES:
        raise InputError(_torn(table.name, frames, points, longest_gap_s))
    time = frames.time[kept]
    missing = np.isnan(points[kept][..., 0])
    origin = np.where(missing, -1, tracks.columns[kept][:, chosen.tracks])
    body = body_of(table, time, filled(time, points[kept], fill), origin, chosen.layout, spec, head)
    summary = LogSummary(
        source=table.name,
        sha256=table.sha256,
        kind=table.kind,
        frames_read=int((frames.rows >= 0).sum()),
        header_frames=table.header_frames,
        frames_missing=int((frames.rows < 0).sum()),
        rate_hz=1 / frames.period,
        columns=len(table.labels),
        layout=chosen.layout,
        head=body.head,
        up=floor.up,
        samples_seen=int((~np.isnan(taken(floor.plane, frames)[..., 0])).sum()),
        samples_other=high + chosen.left + tracks.dropped,
        samples_rejected=int(jumps.sum()),
        samples_filled=int(missing.sum()),
        longest_filled_s=_longest(time, missing),
        moves=_moves(origin),
        frames_kept=len(time),
        start=float(time[0]),
        end=float(time[-1]),
        spacing_m=tuple(float(each) for each in body.spacing),
        residual_m=float(np.sqrt((body.residual**2).mean())),
        corrections=(*table.corrections, *frames.corrections, *floor.corrections, *body.corrections),
    )
    return Recording(trajectory_of(body, missing, time, spec, summary, gait_frequency_hz), summary)


def _without_high(floor: Floor) -> tuple[np.ndarray, int]:
    """Return the plane without what lies well over or under the robot, and how many samples those were."""
    height = floor.height
    with np.errstate(invalid="ignore"):
        off = (
            np.abs(height - np.nanmedian(height)) > _HIGHEST
            if np.isfinite(height).any()
            else np.zeros(height.shape)
        )
    off = off.astype(bool)
    return np.where(off[..., None], np.nan, floor.plane), int(off.sum())


def _slots(table: MarkerTable, plane: np.ndarray, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Return markers in slots; columns with connectors' names stay where they are."""
    if not table.connectors:
        return packed(table.name, plane)
    if len(table.connectors) > MOST:
        raise InputError(f"{table.name}: {len(table.connectors)} markers; at most {MOST} are followed")
    return plane, np.broadcast_to(np.arange(len(table.connectors)), (frames, len(table.connectors)))


def _moves(origin: np.ndarray) -> int:
    """Return how often a marker goes on in another column."""
    return sum(int((np.diff(column[column >= 0]) != 0).sum()) for column in origin.T)


def _longest(time: np.ndarray, missing: np.ndarray) -> float:
    gaps = [time[end] - time[begin - 1] for column in missing.T for begin, end in runs(column)]
    return float(max(gaps, default=0.0))


def _torn(name: str, frames: Frames, points: np.ndarray, longest_gap_s: float) -> str:
    together = (~np.isnan(points[..., 0])).all(axis=1).mean()
    return (
        f"{name}: no {LEAST_FRAMES} frames on end in which all {points.shape[1]} markers are known with gaps "
        "up to "
        f"{longest_gap_s:g} s ({len(frames.time)} frames at {1 / frames.period:.4g} Hz, all markers seen on "
        f"{100 * together:.0f} % of them); give longest_gap_s"
    )
