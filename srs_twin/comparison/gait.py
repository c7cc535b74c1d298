"""Gait metrics, such as speed, turning radius, power and cost of transport.

All means are taken over whole gait periods (`GaitWindow`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
"""Number of initial gait periods that are excluded from means."""
MIN_PERIODS = 3
"""Minimum number of whole gait periods required for gait metrics."""
_MIN_SAMPLES_PER_PERIOD = 4
"""Minimum number of samples per gait period required for gait metrics."""
_MIN_TIMES_PER_PERIOD = 64
"""Minimum number of evaluation times per gait period."""
_PERIOD_ROUNDING = 1e-6
"""Tolerance for comparisons between times, as a fraction of a gait period."""


@dataclass(frozen=True)
class GaitWindow:
    r"""Time window of whole gait periods over which means are computed.

    The running mean of a signal x over one period T, and the derivative of this mean,
    are

    $$\bar x(t) = \frac{1}{T} \int_t^{t+T} x\,ds, \qquad \dot{\bar x}(t) = \frac{x(t+T) - x(t)}{T},$$

    where t ranges from the start of the window to one period before the end. Because
    the signal x is interpolated by a cubic spline, T need not be a multiple of the
    sample period, and the window need not begin at a sample.

    Attributes:
        start: start time, s.
        period: period T, s.
        periods: number K of periods, at least 2.
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
        periods remain for the means. The result is None if the run has no gait
        frequency, fewer than three whole periods, or too few samples per period.

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
        """Return the reason why a run has no window, or an empty string."""
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
        """Return a window that ends at a given time.

        Args:
            trajectory: run.
            period: gait period, s.
            end: end time of the window, s.
            periods: number of periods in the window.

        Returns:
            Window, or None if the window would begin before the run.
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
        """Return the midpoints (s) of equal intervals in the first `periods` periods.

        The mean of a smooth periodic signal over these times equals the exact mean over
        whole periods up to rounding errors.
        """
        step = self.period / self.times_per_period
        return self.start + step * (np.arange(periods * self.times_per_period) + 0.5)

    def running_mean(
        self, trajectory: Trajectory, values: Array
    ) -> tuple[Array, Array]:
        """Return the running mean of a signal, and the derivative of this mean.

        The signal `values` has shape (samples, …). Mean and derivative are evaluated at
        the equally spaced `times` of the first K − 1 periods.
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

        The amplitude in a period is half the range of the signal in this period.
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
    # The tolerance ensures that the last period counts if the run ends with it.
    whole = int(np.floor((time[-1] - time[0]) * frequency + 1e-6))
    if len(time) < 2:
        return whole, 0.0
    return whole, 1.0 / (frequency * float(np.median(np.diff(time))))


MIN_TRAVEL_BODY_LENGTHS = 1e-3
"""Distance per gait period above which a snake counts as moving, in body lengths."""


def displacement_per_period(
    trajectory: Trajectory, window: GaitWindow
) -> tuple[Array, Array]:
    """Return the chord (m) and the turn (rad) of each gait period.

    The chord is the displacement of the centre of mass in a period, negative for
    backward motion, and the turn is the change of the heading. Both are averaged over
    all gait phases at which a period may start, because the lateral oscillation of the
    body distorts the result of a single phase. A window of K periods yields K − 1
    chords and K − 1 turns.
    """
    speed, turn_rate = running_rates(trajectory, window)
    shape = (window.periods - 1, window.times_per_period)
    chords = window.period * speed
    turns = window.period * turn_rate.reshape(shape).mean(axis=1)
    return chords.reshape(shape).mean(axis=1), turns


def running_rates(trajectory: Trajectory, window: GaitWindow) -> tuple[Array, Array]:
    """Return the speed along the period-averaged path (m/s) and the yaw rate (rad/s).

    The speed is negative if the mean motion is opposite to the heading. The yaw rate is
    positive for turns to the left.
    """
    heading, turn_rate = window.running_mean(trajectory, trajectory["heading"])
    _, velocity = window.running_mean(trajectory, trajectory.com)
    forward = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    return np.copysign(1.0, forward.mean()) * speed, turn_rate


STRAIGHT_BODY_LENGTHS = 100.0
"""Turning radius above which a path counts as straight, in body lengths.

For generation 2, this radius is about 20 m, at which a path of 2 m deviates from its
tangent by 0.1 m.
"""
STRAIGHT_TURN_RAD = 1e-3
"""Turn per gait period below which a path counts as straight, rad.

Because of contact creep, a snake turns by about 0.06° per period even if it does not
move forward.
"""


def turning_radius(
    speed: float, yaw_rate: float, period: float, length: float
) -> float | None:
    """Return the signed turning radius (m), or None for a straight path.

    The radius is positive for turns to the left. It is computed from the chord (speed ·
    period) and the turn (yaw_rate · period) of one period. The quotient of speed and
    yaw rate would be the radius of the period-averaged path, which is 1 % smaller at a
    turn of half a radian per period.

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


def energy_metrics(
    trajectory: Trajectory, window: GaitWindow, speed: float
) -> dict[str, float | None]:
    """Compute power and cost of transport (`ENERGY_MEANINGS`) at a mean speed (m/s).

    The mechanical power is dissipated by friction and in the segments. The pneumatic
    power is the gauge supply pressure times the volume flow of consumed air at this
    pressure. A power is None if its energy column is missing. A cost of transport is
    also None if the mass is unknown or the speed is 0.
    """
    mass = positive_number(trajectory, "mass_kg")
    metrics: dict[str, float | None] = dict.fromkeys(ENERGY_MEANINGS)
    if trajectory.has("internal_loss"):
        metrics["internal_power_w"] = _mean_rate(trajectory, window, "internal_loss")
    for source, power, cost in (
        ("work", "mechanical_power_w", "cost_of_transport"),
        ("pneumatic_energy", "pneumatic_power_w", "pneumatic_cost_of_transport"),
    ):
        if trajectory.has(source):
            rate = _mean_rate(trajectory, window, source)
            metrics[power] = rate
            if mass is not None and speed != 0:
                metrics[cost] = rate / (mass * GRAVITY * abs(speed))
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

    Speed and direction of travel are None if the run has fewer than three whole gait
    periods. The result is empty for a planar snake.
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
    # The vertical components of the left and upward body axes determine the roll angle.
    roll = np.unwrap(np.arctan2(2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)), axis=0)
    metrics["roll_turns"] = float(abs(roll[-1] - roll[0]).mean() / (2 * math.pi))
    return metrics


def spatial_differences(
    reference: Trajectory, candidate: Trajectory, time: Array
) -> dict[str, float | None]:
    """Compare two runs of a spatial snake (`SPATIAL_DIFFERENCE_MEANINGS`).

    Contacts are compared at the given times (s). Times before the `GaitWindow` of the
    reference are excluded.
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
