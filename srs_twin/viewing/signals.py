"""What is plotted but not recorded: speeds and pressure differences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from srs_twin.comparison.following import following
from srs_twin.comparison.learning import is_learning
from srs_twin.comparison.sines import frequency_of
from srs_twin.trajectory import Trajectory

Kind = Literal["gait", "bench", "learning", "following"]


def pressure_difference(trajectory: Trajectory) -> np.ndarray:
    """Return p⁺ − p⁻ of every segment, shape (samples, segments), Pa; NaN where not recorded."""
    if not (trajectory.has("pressure_plus") and trajectory.has("pressure_minus")):
        return np.full_like(trajectory.stack("bend"), np.nan)
    return trajectory.stack("pressure_plus") - trajectory.stack("pressure_minus")


def kind_of(trajectories: Mapping[str, Trajectory]) -> Kind:
    """Return what kind of experiment runs are of: it decides which plots matter."""
    runs = trajectories.values()
    if any(run.has("reference_1") or run.metadata.get("base") == "clamped" for run in runs):
        return "bench"
    if any(following(run) is not None for run in runs):
        return "following"
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
