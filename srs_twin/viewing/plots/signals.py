"""What is drawn but not recorded: speeds, pressures, the whole centre line, wheels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from srs_twin.comparison.centre_line import centre_lines, on_both_sides
from srs_twin.comparison.learning import is_learning
from srs_twin.comparison.tracking import frequency_of
from srs_twin.errors import InputError
from srs_twin.robot.spec import Geometry
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.additions import added_to

pass


def check_drawable(trajectories: Mapping[str, Trajectory]) -> None:
    """Refuse what no picture can be made of.

    Raises:
        InputError: there is no trajectory, or one of them is empty.
    """
    if not trajectories:
        raise InputError("nothing to show: no plant left a trajectory; run the scenario first")
    for plant, run in trajectories.items():
        if not len(run):
            raise InputError(f"nothing to show: the trajectory of '{plant}' has no samples")


def body_line(trajectory: Trajectory, geometry: Geometry, pieces: int = 8) -> np.ndarray:
    """Return the whole centre line, head to tail, shape (samples, points, 2), m."""
    lines = centre_lines(trajectory, geometry, pieces)
    # Without a gap the ends of the arc are the connectors: every point stands once.
    once = slice(0, -1) if geometry.rigid_gap else slice(1, -2)
    inner = lines[:, :, once].reshape(len(lines), -1, 2)
    return np.concatenate([inner, lines[:, -1, -1:]], axis=1)


def goal_ring(goal: Mapping[str, float]) -> np.ndarray:
    """Return the edge of a goal, shape (n, 2), m."""
    angle = np.linspace(0, 2 * np.pi, 49)
    around = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.array([goal["x"], goal["y"]]) + goal["radius"] * around


def wheel_centres(trajectory: Trajectory, geometry: Geometry) -> np.ndarray:
    """Return the wheels at ± half the track, shape (samples, N, 2, 2), m: left, then right."""
    theta = trajectory.stack("theta")[..., None]
    return on_both_sides(trajectory.position[:, :, None], theta, geometry.half_track)


def wheel_turns(trajectory: Trajectory, geometry: Geometry) -> np.ndarray:
    """Return how far each wheel has rolled without slip, shape (samples, N, 2), rad, forward positive."""
    centres, theta = wheel_centres(trajectory, geometry), trajectory.stack("theta")
    middle = (theta[1:] + theta[:-1]) / 2
    ahead = np.stack([np.cos(middle), np.sin(middle)], axis=-1)[:, :, None]
    rolled = (np.diff(centres, axis=0) * ahead).sum(axis=-1) / geometry.wheel_radius
    return np.concatenate([np.zeros((1, *rolled.shape[1:])), np.cumsum(rolled, axis=0)])


def pressure_difference(trajectory: Trajectory) -> np.ndarray:
    """Return p⁺ − p⁻ of every segment, shape (samples, segments), Pa; NaN where not recorded."""
    if not (trajectory.has("pressure_plus") and trajectory.has("pressure_minus")):
        return np.full_like(trajectory.stack("bend"), np.nan)
    return trajectory.stack("pressure_plus") - trajectory.stack("pressure_minus")


def kind_of(trajectories: Mapping[str, Trajectory]) -> str:
    """Return the kind of experiment, which decides the plots: gait, bench, learning, or an extension's."""
    runs = trajectories.values()
    if any(run.has("reference_1") or run.metadata.get("base") == "clamped" for run in runs):
        return "bench"
    for run in runs:
        if pictures := added_to(run):
            return pictures.kind
    return "learning" if any(map(is_learning, runs)) else "gait"


def gait_period(trajectory: Trajectory) -> float | None:
    """Return the gait period in s, None where nothing is periodic."""
    frequency = trajectory.metadata.get("gait_frequency_hz")
    return 1.0 / frequency if frequency else None


def reference_period(trajectory: Trajectory) -> float | None:
    """Return the period of the first segment's reference in s: of a sine, or of what jumps to and fro."""
    if not trajectory.has("reference_1"):
        return None
    time, reference = trajectory.time, trajectory["reference_1"]
    jumps = time[1:][np.diff(reference) != 0]
    if len(jumps) < 3:
        return None
    if len(np.unique(reference)) == 2:
        return float(2 * np.median(np.diff(jumps)))
    frequency = frequency_of(time, reference)
    return None if frequency is None else 1 / frequency


def forward_speed(trajectory: Trajectory) -> np.ndarray:
    """Return the centre of mass velocity along the heading, shape (samples,), m/s; 0 with one sample."""
    if len(trajectory) < 2:
        return np.zeros(len(trajectory))
    velocity = np.gradient(trajectory.com, trajectory.time, axis=0)
    heading = trajectory["heading"]
    return velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)


def period_speed(trajectory: Trajectory, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times (s) and the speed of the period-averaged path around each (m/s).

    That is the displacement over one gait period, negative where it runs against the heading; the first
    and the last half period have none. Both arrays are empty when the run is shorter than a period.
    """
    time, heading = trajectory.time, trajectory["heading"]
    first, last = time[0] + period / 2, time[-1] - period / 2
    middle = time[(time >= first - 1e-9) & (time <= last + 1e-9)]
    before, after = middle - period / 2, middle + period / 2
    moved = [np.interp(after, time, c) - np.interp(before, time, c) for c in trajectory.com.T]
    facing = np.interp(middle, time, heading)
    ahead = moved[0] * np.cos(facing) + moved[1] * np.sin(facing)
    return middle, np.copysign(np.hypot(*moved), ahead) / period
