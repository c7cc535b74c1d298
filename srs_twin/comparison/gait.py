"""Gait metrics, such as speed, turning radius, power and cost of transport.

All means are taken over whole gait periods (`GaitWindow`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin.comparison.sampling import (
    interpolant,
    is_near_zero,
    meanings_of,
    positive_number,
    units_of,
)
from srs_twin.compute.arrays import Array
from srs_twin.robot.spec import GRAVITY
from srs_twin.trajectory import Trajectory

WARM_UP_PERIODS = 2
"""Number of initial gait periods excluded from means."""
MIN_PERIODS = 3
"""Minimum number of whole gait periods required for gait metrics."""
_MIN_SAMPLES_PER_PERIOD = 4
"""Minimum number of samples per gait period required for gait metrics."""
_MIN_TIMES_PER_PERIOD = 64
"""Minimum number of evaluation times per gait period."""
_PERIOD_ROUNDING = 1e-6
"""Tolerance when comparing times, as a fraction of a gait period."""


@dataclass(frozen=True)
class GaitWindow:
    r"""Time window of whole gait periods after the warm-up, used to compute means.

    The running mean of a signal x over one period T and its exact derivative are

    $$\bar x(t) = \frac{1}{T} \int_t^{t+T} x\,ds, \qquad \dot{\bar x}(t) = \frac{x(t+T) - x(t)}{T},$$

    where t ranges from the start of the window to one period before the end. The signal
    x is interpolated by a cubic spline. Therefore T need not be a multiple of the
    sample period, and the window need not begin at a sample.

    Attributes:
        start: start time, s.
        period: period T, s.
        periods: number of periods, K ≥ 2.
        times_per_period: number of evaluation times per period.
    """

    start: float
    period: float
    periods: int
    times_per_period: int

    @classmethod
    def from_trajectory(cls, trajectory: Trajectory) -> GaitWindow | None:
        """Return the window of all whole periods after a warm-up of two periods.

        If a run has exactly three whole periods, the warm-up is one period, so that two
        periods remain for the means. Return None if the run has no gait frequency,
        fewer than three whole periods, or too few samples per period.

        Raises:
            InputError: the gait frequency in the metadata is not a positive number.
        """
        frequency = positive_number(trajectory, "gait_frequency_hz")
        if frequency is None or cls.missing_reason(trajectory):
            return None
        time = trajectory.time
        whole, samples = _extent(trajectory, frequency)
        warm_up = min(WARM_UP_PERIODS, whole - 2)
        # Four evaluation times per sample interval resolve the spline.
        times = max(_MIN_TIMES_PER_PERIOD, int(np.ceil(4 * samples)))
        return cls(
            float(time[0]) + warm_up / frequency,
            1.0 / frequency,
            whole - warm_up,
            times,
        )

    @classmethod
    def missing_reason(cls, trajectory: Trajectory) -> str:
        """Return why a run has no window, or an empty string if there is a window."""
        frequency = positive_number(trajectory, "gait_frequency_hz")
        if frequency is None:
            return "the run has no gait frequency"
        whole, samples = _extent(trajectory, frequency)
        if whole < MIN_PERIODS:
            needed = f"{MIN_PERIODS} whole gait periods that are needed"
            return f"the run has {whole} of the {needed}"
        least = _MIN_SAMPLES_PER_PERIOD
        if samples < least or len(trajectory) < MIN_PERIODS * least:
            return f"the run has fewer than {least} samples per gait period"
        return ""

    @classmethod
    def ending_at(
        cls, trajectory: Trajectory, period: float, end: float, periods: int
    ) -> GaitWindow | None:
        """Return a window of several periods that ends at a given time (s).

        The gait period is in seconds. Return None if the window would begin before the
        run.
        """
        start = end - periods * period
        step = float(np.median(np.diff(trajectory.time)))
        if start < trajectory.time[0] - _PERIOD_ROUNDING * period:
            return None
        times = max(_MIN_TIMES_PER_PERIOD, math.ceil(4 * period / step))
        return cls(start, period, periods, times)

    @property
    def end(self) -> float:
        """End time, s."""
        return self.start + self.periods * self.period

    def times(self, periods: int) -> np.ndarray:
        """Return equally spaced times (s) over the first periods of the window.

        The times are midpoints of equal intervals. For a smooth periodic signal, the
        mean over these times equals the mean over whole periods up to rounding.
        """
        step = self.period / self.times_per_period
        return self.start + step * (np.arange(periods * self.times_per_period) + 0.5)

    def running_mean(
        self, trajectory: Trajectory, values: Array
    ) -> tuple[Array, Array]:
        """Return the running mean of a signal over one period and its derivative.

        Both are evaluated at equally spaced times over K − 1 periods. The signal has
        shape (samples, …).
        """
        signal = interpolant(trajectory, values)
        integral = signal.antiderivative()
        begin = self.times(self.periods - 1)
        end = begin + self.period
        mean = (integral(end) - integral(begin)) / self.period
        rate = (signal(end) - signal(begin)) / self.period
        return mean, rate

    def mean(self, trajectory: Trajectory, values: Array) -> Array:
        """Return the mean of a signal of shape (samples, …) over the window."""
        integral = interpolant(trajectory, values).antiderivative()
        duration = self.end - self.start
        mean: Array = (integral(self.end) - integral(self.start)) / duration
        return mean

    def amplitude(self, trajectory: Trajectory, values: Array) -> Array:
        """Return the amplitude of a signal, averaged over all periods.

        The amplitude in a period is half the signal's range in this period.
        """
        signal = interpolant(trajectory, values)(self.times(self.periods))
        by_period = signal.reshape(
            self.periods, self.times_per_period, *values.shape[1:]
        )
        amplitude: Array = 0.5 * np.ptp(by_period, axis=1).mean(axis=0)
        return amplitude


def _extent(trajectory: Trajectory, frequency: float) -> tuple[int, float]:
    """Return the number of whole gait periods and the number of samples per period."""
    time = trajectory.time
    # The tolerance keeps the last period if the run ends with a whole period.
    whole = int(np.floor((time[-1] - time[0]) * frequency + 1e-6))
    if len(time) < 2:
        return whole, 0.0
    return whole, 1.0 / (frequency * float(np.median(np.diff(time))))


MIN_TRAVEL_BODY_LENGTHS = 1e-3
"""Distance per gait period above which a snake counts as travelling, in body lengths."""


def displacement_per_period(
    trajectory: Trajectory, window: GaitWindow
) -> tuple[Array, Array]:
    """Return chord (m, negative for backward motion) and turn (rad) of each period.

    Chord and turn are averaged over all gait phases at which a period may start. With a
    single phase, the lateral oscillation of the body would distort the turning radius.
    A window of K periods yields K − 1 chords and K − 1 turns.
    """
    speed, turn_rate = running_rates(trajectory, window)
    shape = (window.periods - 1, window.times_per_period)
    chords = window.period * speed
    turns = window.period * turn_rate.reshape(shape).mean(axis=1)
    return chords.reshape(shape).mean(axis=1), turns


def running_rates(trajectory: Trajectory, window: GaitWindow) -> tuple[Array, Array]:
    """Return the speed along the period-averaged path (m/s) and the yaw rate (rad/s).

    The speed is negative if the mean motion is opposite to the heading. The yaw rate is
    positive to the left.
    """
    heading, turn_rate = window.running_mean(trajectory, trajectory["heading"])
    _, velocity = window.running_mean(trajectory, trajectory.com)
    forward = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    return np.copysign(1.0, forward.mean()) * speed, turn_rate


STRAIGHT_BODY_LENGTHS = 100.0
"""Turning radius above which a path counts as straight, in body lengths.

For generation 2, this radius is about 20 m. At this radius, a path of 2 m deviates from
its tangent by 0.1 m.
"""
STRAIGHT_TURN_RAD = 1e-3
"""Turn per gait period below which a path counts as straight, rad.

Due to contact creep, a snake that does not move forward turns by about 0.06°.
"""


def turning_radius(
    speed: float, yaw_rate: float, period: float, length: float
) -> float | None:
    """Return the signed turning radius (m), or None for a straight path.

    The radius is positive to the left. It is computed from the chord (speed · period)
    and the turn (yaw_rate · period) in one period. The quotient of speed and yaw rate
    would give the radius of the averaged path, which is smaller by 1 % if the body
    turns by half a radian per period.

    Args:
        speed: forward speed, m/s.
        yaw_rate: yaw rate, rad/s.
        period: gait period, s.
        length: body length, m.
    """
    turn = yaw_rate * period
    if abs(turn) < STRAIGHT_TURN_RAD:
        return None
    radius = speed * period / (2 * math.sin(turn / 2))
    if abs(radius) <= STRAIGHT_BODY_LENGTHS * length:
        return radius
    return None


def path_curvature(chord: float, turn: float) -> float:
    """Return the curvature (1/m) of an arc with a given chord (m) and turn (rad)."""
    return 2 * math.sin(turn / 2) / chord


ENERGY_MEANINGS = meanings_of("""
mechanical_power_w: mean power delivered by the segment torques
internal_power_w: mean power dissipated by relative motion between the hinges of a segment
cost_of_transport: mechanical power divided by weight and speed
pneumatic_power_w: mean power of the air drawn by the chambers
pneumatic_cost_of_transport: pneumatic power divided by weight and speed
""")
"""Power and cost of transport of a gait."""


def energy_metrics(
    trajectory: Trajectory, window: GaitWindow, speed: float
) -> dict[str, Any]:
    """Compute power and cost of transport (`ENERGY_MEANINGS`) at a mean speed (m/s).

    The mechanical power is the power dissipated by friction and in the segments. The
    pneumatic power is the supply pressure times the volume flow of consumed air at the
    supply pressure. A metric is None if the run lacks the required columns.
    """
    mass = positive_number(trajectory, "mass_kg")
    metrics: dict[str, Any] = dict.fromkeys(ENERGY_MEANINGS)
    if trajectory.has("internal_loss"):
        metrics["internal_power_w"] = _mean_rate(trajectory, window, "internal_loss")
    for source, power, cost in (
        ("work", "mechanical_power_w", "cost_of_transport"),
        ("pneumatic_energy", "pneumatic_power_w", "pneumatic_cost_of_transport"),
    ):
        if trajectory.has(source):
            metrics[power] = _mean_rate(trajectory, window, source)
            if mass is not None and speed != 0:
                metrics[cost] = metrics[power] / (mass * GRAVITY * abs(speed))
    return metrics


def _mean_rate(trajectory: Trajectory, window: GaitWindow, name: str) -> float:
    start, end = np.interp(
        [window.start, window.end], trajectory.time, trajectory[name]
    )
    return float((end - start) / (window.end - window.start))


SPATIAL_MEANINGS = meanings_of("""
travel_speed_m_s: speed of a spatial snake in any direction, mean over whole gait periods
travel_direction_rad: direction of travel relative to the mean heading; positive to the left
body_height_m: maximum height of a connector of a spatial snake
contact_fraction: mean fraction of connectors that press on the floor
supports: mean number of separate parts of the body that press on the floor
roll_turns: rotation of the body about its axis over the whole run in turns, mean over the connectors
""")
SPATIAL_UNITS = units_of(SPATIAL_MEANINGS)
"""Units of the spatial metrics, each of which is a number or None."""

SPATIAL_DIFFERENCE_MEANINGS = meanings_of("""
travel_speed_rel: travel speed difference (twin minus analytical) divided by the analytical travel speed
travel_direction_abs: magnitude of the difference between the travel directions
contact_agreement: fraction of samples in which a connector touches the floor on both plants or on neither
""")
SPATIAL_DIFFERENCES = units_of(SPATIAL_DIFFERENCE_MEANINGS) | {
    "travel_direction_abs": "rad"
}
"""Units of the differences between two runs of a spatial snake."""


def spatial_metrics(trajectory: Trajectory) -> dict[str, float | None]:
    """Compute the metrics of a spatial snake (`SPATIAL_MEANINGS`).

    A sidewinder travels across its body axis, so the forward speed is smaller than the
    travel speed. A body with two separate supports can roll over. Speed and direction
    of travel are None if the run has fewer than three whole gait periods.
    """
    if not trajectory.has("z"):
        return {}
    metrics: dict[str, float | None] = dict.fromkeys(SPATIAL_UNITS)
    window = GaitWindow.from_trajectory(trajectory)
    used = slice(None)
    if window is not None:
        heading, _ = window.running_mean(trajectory, trajectory["heading"])
        _, velocity = window.running_mean(trajectory, trajectory.com)
        c = np.cos(heading)
        s = np.sin(heading)
        forward = float((c * velocity[:, 0] + s * velocity[:, 1]).mean())
        left = float((c * velocity[:, 1] - s * velocity[:, 0]).mean())
        metrics["travel_speed_m_s"] = math.hypot(forward, left)
        metrics["travel_direction_rad"] = math.atan2(left, forward)
        used = slice(int(np.searchsorted(trajectory.time, window.start)), None)
    metrics["body_height_m"] = float(trajectory.stack("z")[used].max())
    touches = trajectory.stack("load")[used] > 0.0
    metrics["contact_fraction"] = float(touches.mean())
    metrics["supports"] = float(
        (np.diff(touches, axis=1, prepend=False) & touches).sum(axis=1).mean()
    )
    w, x, y, z = (trajectory.stack(f"quaternion_{axis}") for axis in "wxyz")
    # The heights of the left and upper axis tips determine the roll angle.
    roll = np.unwrap(np.arctan2(2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)), axis=0)
    metrics["roll_turns"] = float(abs(roll[-1] - roll[0]).mean() / (2 * math.pi))
    return metrics


def spatial_differences(
    reference: Trajectory, candidate: Trajectory, time: Array
) -> dict[str, float | None]:
    """Compare two runs of a spatial snake (`SPATIAL_DIFFERENCE_MEANINGS`).

    The runs are compared at the times `time` (s). If they have whole gait periods,
    contacts are compared over whole periods.
    """
    if not (reference.has("z") and candidate.has("z")):
        return {}
    differences: dict[str, float | None] = dict.fromkeys(SPATIAL_DIFFERENCES)
    before = spatial_metrics(reference)
    after = spatial_metrics(candidate)
    speed = before["travel_speed_m_s"]
    other = after["travel_speed_m_s"]
    if speed is not None and other is not None:
        turn = (after["travel_direction_rad"] or 0.0) - (
            before["travel_direction_rad"] or 0.0
        )
        if not is_near_zero(speed, other, "m/s"):
            differences["travel_speed_rel"] = other / speed - 1
        differences["travel_direction_abs"] = abs(math.remainder(turn, 2 * math.pi))
    window = GaitWindow.from_trajectory(reference)
    used = time[time >= window.start] if window else time
    touches = [
        interpolant(run, run.stack("load"))(used) > 0.0
        for run in (reference, candidate)
    ]
    differences["contact_agreement"] = float((touches[0] == touches[1]).mean())
    return differences
