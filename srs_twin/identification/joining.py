"""Joining a captured motion and a log of its air on one clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.clock import Offset, estimate_offset
from srs_twin.identification.frames import LEAST_FRAMES
from srs_twin.identification.recording import Recording
from srs_twin.identification.trajectories import numbered
from srs_twin.identification.valve_log import SIDES, ValveLog
from srs_twin.pneumatics import LagPneumatics
from srs_twin.pneumatics.bending import air_bend
from srs_twin.spec import RobotSpec
from srs_twin.trajectory import Trajectory

_STEP = 0.002  # s, at which driven bends are looked at
_FORGOTTEN = 5.0  # time constants after which nobody can tell what a chamber held


def join(recording: Recording, log: ValveLog, spec: RobotSpec, *, offset: float | None = None) -> Recording:
    """Put a log's columns beside a captured motion.

    Args:
        recording: the motion.
        log: its valves or pressures.
        spec: the robot; its chambers turn valves into the bends that the offset is found from.
        offset: what to add to the log's times, s; None: estimated (see `clock`).

    Returns:
        The part of the motion that the log covers, with columns ``valve_plus_1…`` or ``pressure_plus_1…``,
        the offset in the metadata, and the log on the motion's clock.

    Raises:
        InputError: the two have no time in common, or the offset cannot be told.
    """
    trajectory = recording.trajectory
    if log.values.shape[1] != spec.segments or trajectory.stack("bend").shape[1] != spec.segments:
        raise InputError(
            f"{log.source}: the log or the motion is not of {spec.name}'s {spec.segments} segments"
        )
    if offset is None:
        clock, driven = driven_bends(log, spec)
        found = estimate_offset(log.source, trajectory.time, trajectory.stack("bend"), clock, driven)
    elif np.isfinite(offset):
        found = Offset(float(offset), 0.0, 1.0, False)
    else:
        raise InputError(f"offset {offset!r} is not allowed; it must be finite")
    moved = log.shifted(found.seconds)
    time = trajectory.time
    covered = (time >= moved.time[0] - 1e-9) & (time <= moved.time[-1] + 1e-9)
    if covered.sum() < LEAST_FRAMES:
        raise InputError(
            f"{log.source}: with an offset of {found.seconds:g} s it goes from {moved.time[0]:g} to "
            f"{moved.time[-1]:g} "
            f"s, the motion from {time[0]:g} to {time[-1]:g} s: {int(covered.sum())} frames in common"
        )
    columns = {name: column[covered] for name, column in trajectory.columns.items()}
    values = moved.at(columns["time"])
    for k, side in enumerate(SIDES):
        columns |= numbered(f"{log.kind}_{side}", values[..., k])
    joined = Trajectory(
        columns, trajectory.units, trajectory.events, _metadata(trajectory, log, found, covered)
    )
    summary = replace(
        recording.summary,
        frames_kept=len(joined),
        start=float(joined.time[0]),
        end=float(joined.time[-1]),
        corrections=(*recording.summary.corrections, *_said(log, found, covered)),
    )
    return Recording(joined, summary, moved)


def driven_bends(log: ValveLog, spec: RobotSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return times (times,), s, and the bends of free segments by a log's air, (times, segments), rad.

    Where a log of valves begins while chambers fill, what was in them is not known: the bends begin when that
    is forgotten.
    """
    span = float(log.time[-1] - log.time[0])
    step = max(_STEP, span / 1e6)
    clock = step * np.arange(int(span / step + 1e-9) + 1)
    if log.kind == "pressure":
        # Bends follow pressures by τ₂, which for what is slower is a delay.
        return log.time[0] + clock + spec.actuator.tau_mode, np.asarray(
            air_bend(spec, log.at(log.time[0] + clock))
        )
    chambers = LagPneumatics(spec, supply_pa=spec.supply.nominal, layout="in_out")
    trace = chambers.advance(log.schedule(), clock)
    forgotten = (
        0.0
        if (log.values[0] == -1).all()
        else _FORGOTTEN * max(spec.actuator.tau_fill, spec.actuator.tau_vent)
    )
    known = clock >= forgotten
    if known.sum() < LEAST_FRAMES:
        raise InputError(f"{log.source}: {span:g} s are too short to find its offset; give offset")
    return log.time[0] + clock[known], trace.bend[known]


def _metadata(trajectory: Trajectory, log: ValveLog, found: Offset, covered: np.ndarray) -> dict[str, object]:
    about = {
        "file": log.source.replace("\\", "/").rpartition("/")[2],
        "sha256": log.sha256,
        "kind": log.kind,
        "offset_s": found.seconds,
        "offset_error_s": found.error if np.isfinite(found.error) else None,
        "offset_estimated": found.estimated,
        "bends_explained": found.explained,
        "corrections": list(log.corrections),
    }
    time = trajectory.time[covered]
    return {**trajectory.metadata, "duration_s": float(time[-1] - time[0]), "valve_log": about}


def _said(log: ValveLog, found: Offset, covered: np.ndarray) -> list[str]:
    how = f"± {1e3 * found.error:.2g} ms, estimated" if found.estimated else "as given"
    said = [f"{log.source}: {len(log.time)} rows of {log.kind}s; offset {found.seconds:.4f} s ({how})"]
    if not covered.all():
        said.append(f"{int((~covered).sum())} frames that the log does not cover left out")
    return said + [f"{log.source}: {each}" for each in log.corrections]
