"""Signals for plots, computed from trajectories."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from srs_twin.comparison.centre_line import centre_lines, offset_to_sides
from srs_twin.comparison.learning import is_learning
from srs_twin.comparison.tracking import sine_frequency
from srs_twin.compute.arrays import Array
from srs_twin.robot.spec import Geometry
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.additions import added_to


def body_line(trajectory: Trajectory, geometry: Geometry, chords: int = 8) -> Array:
    """Return the body centre line, head to tail, shape (samples, points, 2), m."""
    lines = centre_lines(trajectory, geometry, chords)
    return joined_lines(lines, has_gaps=geometry.rigid_gap > 0)


def joined_lines(lines: Array, *, has_gaps: bool) -> Array:
    """Join the centre lines of all segments, without duplicate points.

    Neighbouring segments share an end. Without gaps, arc ends coincide with connectors.
    """
    unique = slice(0, -1) if has_gaps else slice(1, -2)
    inner = lines[:, :, unique].reshape(len(lines), -1, lines.shape[-1])
    return np.concatenate([inner, lines[:, -1, -1:]], axis=1)


def goal_ring(x: float, y: float, radius: float) -> Array:
    """Return points on the boundary of a circular goal, shape (n, 2), m."""
    angle = np.linspace(0, 2 * np.pi, 49)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.array([x, y]) + radius * circle


def wheel_centres(trajectory: Trajectory, geometry: Geometry) -> Array:
    """Return the centres of the left and right wheels, shape (samples, N, 2, 2), m."""
    theta = trajectory.stack("connector_heading")[..., None]
    return offset_to_sides(trajectory.position[:, :, None], theta, geometry.half_track)


def wheel_turns(trajectory: Trajectory, geometry: Geometry) -> Array:
    """Return wheel angles for rolling without slip, shape (samples, N, 2), rad.

    Forward motion increases the angles.
    """
    centres = wheel_centres(trajectory, geometry)
    theta = trajectory.stack("connector_heading")
    mean_theta = (theta[1:] + theta[:-1]) / 2
    forward = np.stack([np.cos(mean_theta), np.sin(mean_theta)], axis=-1)[:, :, None]
    paths = (np.diff(centres, axis=0) * forward).sum(axis=-1)
    turns = np.cumsum(paths / geometry.wheel_radius, axis=0)
    return np.concatenate([np.zeros((1, *turns.shape[1:])), turns])


def pressure_difference(trajectory: Trajectory) -> Array:
    """Return p⁺ − p⁻ (NaN if not recorded), shape (samples, segments), Pa."""
    if not (trajectory.has("pressure_plus") and trajectory.has("pressure_minus")):
        return np.full_like(trajectory.stack("bend"), np.nan)
    return trajectory.stack("pressure_plus") - trajectory.stack("pressure_minus")


def kind_of(trajectories: Mapping[str, Trajectory]) -> str:
    """Return the kind of experiment, such as "gait", "bench" or "learning"."""
    runs = trajectories.values()
    for run in runs:
        if run.has("reference_1") or run.metadata.get("base") == "clamped":
            return "bench"
    for run in runs:
        if pictures := added_to(run):
            return pictures.kind
    return "learning" if any(map(is_learning, runs)) else "gait"


def gait_period(trajectory: Trajectory) -> float | None:
    """Return the gait period (s), or None if the run has no gait."""
    frequency = trajectory.metadata.get("gait_frequency_hz")
    return 1.0 / frequency if frequency else None


def reference_period(trajectory: Trajectory) -> float | None:
    """Return the period of the first segment's reference bend, s.

    The result is None unless the reference is a sine wave or a square wave.
    """
    if not trajectory.has("reference_1"):
        return None
    time = trajectory.time
    reference = trajectory["reference_1"]
    changes = time[1:][np.diff(reference) != 0]
    if len(changes) < 3:
        return None
    if len(np.unique(reference)) == 2:  # the reference is a square wave
        return float(2 * np.median(np.diff(changes)))
    frequency = sine_frequency(time, reference)
    return None if frequency is None else 1 / frequency


def forward_speed(trajectory: Trajectory) -> Array:
    """Return the centre-of-mass speed along the heading, shape (samples,), m/s."""
    if len(trajectory) < 2:
        return np.zeros(len(trajectory))
    velocity = np.gradient(trajectory.com, trajectory.time, axis=0)
    heading = trajectory["heading"]
    return velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)


def period_speed(trajectory: Trajectory, period: float) -> tuple[Array, Array]:
    """Return times (s) and the period-averaged speeds at these times (m/s).

    Each speed is the displacement during one gait period, centred at the respective
    time, divided by the period. The speeds of backward motion are negative. If the run
    is shorter than one period, both arrays are empty.
    """
    time = trajectory.time
    heading = trajectory["heading"]
    first = time[0] + period / 2
    last = time[-1] - period / 2
    centres = time[(time >= first - 1e-9) & (time <= last + 1e-9)]
    begin = centres - period / 2
    end = centres + period / 2
    x, y = (
        np.interp(end, time, column) - np.interp(begin, time, column)
        for column in trajectory.com.T
    )
    direction = np.interp(centres, time, heading)
    forward = x * np.cos(direction) + y * np.sin(direction)
    return centres, np.copysign(np.hypot(x, y), forward) / period
