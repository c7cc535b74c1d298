"""Bend log: what the sensors of a robot on a bench said, ``time,bend_1,…`` in a plain CSV file.

Angles are in rad, or in the unit of the name: ``bend_1_deg``; positive where the front end heads to the left
of the rear end. Where the body is follows from its bends and from where its head is held.
"""

from __future__ import annotations

import os

import numpy as np

from srs_twin.identification.cells import read_rows
from srs_twin.identification.columns import Column, read_columns
from srs_twin.identification.frames import LEAST_FRAMES, in_order, taken
from srs_twin.identification.gaps import filled, longest_whole
from srs_twin.identification.recording import Recording
from srs_twin.identification.source import Source, read_source
from srs_twin.identification.summary import BendSummary
from srs_twin.identification.trajectories import metadata, numbered
from srs_twin.identification.units import ANGLES, TIMES
from srs_twin.identification.velocity import moving_slope
from srs_twin.shape import body_shape, relative_headings
from srs_twin.spec import RobotSpec
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
