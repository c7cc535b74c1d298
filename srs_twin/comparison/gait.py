"""Metrics of a gait: speed, turning radius, power and cost of transport, and travel of spatial snakes.

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
"""Gait periods at the start of a run that are left out of the means."""
MIN_PERIODS = 3
"""Smallest number of whole gait periods of a run with gait metrics."""
_MIN_SAMPLES_PER_PERIOD = 4
"""Smallest number of samples per gait period that resolves the gait."""
_MIN_TIMES_PER_PERIOD = 64
"""Smallest number of times per gait period at which signals are evaluated."""
_PERIOD_ROUNDING = 1e-6
"""Tolerance for comparing times, as a fraction of a gait period."""


@dataclass(frozen=True)
class GaitWindow:
    r"""Whole gait periods after the warm-up, and means over them.

    The running mean of a signal x over one period T, and its exact derivative, are

    $$\bar x(t) = \frac{1}{T} \int_t^{t+T} x\,ds, \qquad \dot{\bar x}(t) = \frac{x(t+T) - x(t)}{T},$$

    for t from the start of the window to one period before its end. Between the
    samples, x is a cubic spline, so T need not be a multiple of the sample period, and
    the window need not begin at a sample.

    Attributes:
        start: start of the window, s.
        period: T, s.
        periods: number K of whole periods in the window, 2 or more.
        times_per_period: number of times per period at which signals are evaluated.
    """

    start: float
    period: float
    periods: int
    times_per_period: int

    @classmethod
    def from_trajectory(cls, trajectory: Trajectory) -> GaitWindow | None:
        """Return the window of a run: all whole periods after a warm-up of two periods.

        The warm-up of a run of exactly three whole periods is one period, so that two
        are left for the means.

        Returns:
            None if the run has no gait frequency in its metadata, fewer than three
            whole periods, or too few samples per period.

        Raises:
            InputError: the gait frequency in the metadata is not a positive number.
        """
        frequency = positive_number(trajectory, "gait_frequency_hz")
        if frequency is None or cls.missing_reason(trajectory):
            return None
        time = trajectory.time
        whole, samples = _extent(trajectory, frequency)
        warm_up = min(WARM_UP_PERIODS, whole - 2)
        # Evaluate at four times per sample period, to include the spline between
        # samples.
        times = max(_MIN_TIMES_PER_PERIOD, int(np.ceil(4 * samples)))
        return cls(
            float(time[0]) + warm_up / frequency,
            1.0 / frequency,
            whole - warm_up,
            times,
        )

    @classmethod
    def missing_reason(cls, trajectory: Trajectory) -> str:
        """Return the reason why a run has no window, or an empty string.

        Raises:
            InputError: as `from_trajectory`.
        """
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
        """Return a window of several periods that ends at a given time.

        Args:
            trajectory: one run.
            period: T, s.
            end: end of the window, s.
            periods: number of periods.

        Returns:
            None if the window would begin before the run.
        """
        start = end - periods * period
        step = float(np.median(np.diff(trajectory.time)))
        if start < trajectory.time[0] - _PERIOD_ROUNDING * period:
            return None
        times = max(_MIN_TIMES_PER_PERIOD, math.ceil(4 * period / step))
        return cls(start, period, periods, times)

    @property
    def end(self) -> float:
        """End of the window, s."""
        return self.start + self.periods * self.period

    def times(self, periods: int) -> np.ndarray:
        """Return equally spaced times over the first periods, shape (periods · times_per_period,), s.

        They are midpoints of equal intervals. The mean of a smooth periodic signal at
        these times equals its integral over whole periods, divided by their duration,
        to rounding accuracy.
        """
        step = self.period / self.times_per_period
        return self.start + step * (np.arange(periods * self.times_per_period) + 0.5)

    def running_mean(
        self, trajectory: Trajectory, values: Array
    ) -> tuple[Array, Array]:
        """Return the running mean of a signal over one period, and its rate.

        Args:
            trajectory: run of this window.
            values: samples of the signal, shape (samples, …).

        Returns:
            Mean and rate at equally spaced times over K − 1 periods, each of shape
            (times, …).
        """
        signal = interpolant(trajectory, values)
        integral = signal.antiderivative()
        begin = self.times(self.periods - 1)
        end = begin + self.period
        mean = (integral(end) - integral(begin)) / self.period
        rate = (signal(end) - signal(begin)) / self.period
        return mean, rate

    def mean(self, trajectory: Trajectory, values: Array) -> Array:
        """Return the mean over the window of a signal with samples of shape (samples, …), shape (…)."""
        integral = interpolant(trajectory, values).antiderivative()
        duration = self.end - self.start
        mean: Array = (integral(self.end) - integral(self.start)) / duration
        return mean

    def amplitude(self, trajectory: Trajectory, values: Array) -> Array:
        """Return half the range of a signal in each period, averaged over the window.

        Args:
            trajectory: run of this window.
            values: samples of the signal, shape (samples, …).

        Returns:
            Amplitudes, shape (…).
        """
        signal = interpolant(trajectory, values)(self.times(self.periods))
        by_period = signal.reshape(
            self.periods, self.times_per_period, *values.shape[1:]
        )
        amplitude: Array = 0.5 * np.ptp(by_period, axis=1).mean(axis=0)
        return amplitude


def _extent(trajectory: Trajectory, frequency: float) -> tuple[int, float]:
    """Return the number of whole gait periods of a run, and its samples per period."""
    time = trajectory.time
    # Rounding must not shorten a run that is meant to end after a whole period.
    whole = int(np.floor((time[-1] - time[0]) * frequency + 1e-6))
    if len(time) < 2:
        return whole, 0.0
    return whole, 1.0 / (frequency * float(np.median(np.diff(time))))


MIN_TRAVEL_BODY_LENGTHS = 1e-3
"""Distance per gait period, in body lengths, below which a snake has no path."""


def displacement_per_period(
    trajectory: Trajectory, window: GaitWindow
) -> tuple[Array, Array]:
    """Return the chord (m, negative for backward motion) and the turn (rad) of each period.

    Both are means over all periods that begin within one period. A single phase would
    count the lateral oscillation of the body as a part of the radius. A window of K
    periods gives K − 1 values of each.
    """
    speed, turn_rate = running_rates(trajectory, window)
    shape = (window.periods - 1, window.times_per_period)
    chords = window.period * speed
    turns = window.period * turn_rate.reshape(shape).mean(axis=1)
    return chords.reshape(shape).mean(axis=1), turns


def running_rates(trajectory: Trajectory, window: GaitWindow) -> tuple[Array, Array]:
    """Return the speed along the period-averaged path and the rate of the period-mean heading over time.

    The speed (m/s) is negative if the mean motion is against the heading. The rate
    (rad/s) is positive to the left.
    """
    heading, turn_rate = window.running_mean(trajectory, trajectory["heading"])
    _, velocity = window.running_mean(trajectory, trajectory.com)
    forward = velocity[:, 0] * np.cos(heading) + velocity[:, 1] * np.sin(heading)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    return np.copysign(1.0, forward.mean()) * speed, turn_rate


STRAIGHT_BODY_LENGTHS = 100.0
"""Turning radius, in body lengths, above which a path counts as straight.

For generation 2 it is about 20 m; a path of 2 m then deviates from its tangent by 0.1
m.
"""
STRAIGHT_TURN_RAD = 1e-3
"""Turn per gait period below which a path counts as straight, rad.

Contact creep causes turns of about this size (0.06°) in a snake that does not move
forward.
"""


def turning_radius(
    speed: float, yaw_rate: float, period: float, length: float
) -> float | None:
    """Return the signed turning radius, m, positive to the left; None for a straight path.

    In one period the body moves along a chord of length speed · period and turns by
    yaw_rate · period, which determines the radius of the circle. Speed divided by yaw
    rate would be the radius of the averaged path, which is smaller: by 1 % if the body
    turns by half a radian per period.

    Args:
        speed: mean speed along the heading, m/s.
        yaw_rate: rad/s.
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
    """Return the curvature (1/m) of a circle from a chord (m, not 0) and the turn along it (rad)."""
    return 2 * math.sin(turn / 2) / chord


ENERGY_MEANINGS = meanings_of("""
mechanical_power_w: mean power of the torques of the segments
internal_power_w: mean power dissipated by relative motion of the hinges of a segment
cost_of_transport: mechanical power divided by weight and speed
pneumatic_power_w: mean power of the air that the chambers draw
pneumatic_cost_of_transport: pneumatic power divided by weight and speed
""")
"""Power and cost of transport of a gait."""


def energy_metrics(
    trajectory: Trajectory, window: GaitWindow, speed: float
) -> dict[str, Any]:
    """Compute the power and cost of transport of a gait over whole periods.

    - ``mechanical_power_w``: mean power of the torques, which friction and segments
      dissipate.
    - ``internal_power_w``: part of it that the segments of a twin dissipate.
    - ``cost_of_transport``: mechanical power divided by weight and speed.
    - ``pneumatic_power_w``: supply pressure times the volume of air drawn at that
      pressure, per time.
    - ``pneumatic_cost_of_transport``: pneumatic power divided by weight and speed.

    A metric is None if the run does not record the required columns.

    Args:
        trajectory: one run.
        window: its gait periods.
        speed: mean speed, m/s.
    """
    mass = positive_number(trajectory, "mass_kg")
    metrics: dict[str, Any] = dict.fromkeys(ENERGY_MEANINGS)
    if trajectory.has("internal_loss"):
        metrics["internal_power_w"] = _mean_rate(trajectory, window, "internal_loss")
    for source, power, cost in (
        ("work", "mechanical_power_w", "cost_of_transport"),
        ("air", "pneumatic_power_w", "pneumatic_cost_of_transport"),
    ):
        if trajectory.has(source):
            metrics[power] = _mean_rate(trajectory, window, source)
            if mass is not None and speed != 0:
                metrics[cost] = metrics[power] / (mass * GRAVITY * abs(speed))
    return metrics


def _mean_rate(trajectory: Trajectory, window: GaitWindow, name: str) -> float:
    """Return the mean rate of a cumulative column over the window."""
    start, end = np.interp(
        [window.start, window.end], trajectory.time, trajectory[name]
    )
    return float((end - start) / (window.end - window.start))


SPATIAL_MEANINGS = meanings_of("""
travel_speed_m_s: speed of a spatial snake in any direction, mean over whole gait periods
travel_direction_rad: direction of travel relative to the mean heading; positive to the left
body_height_m: largest height of a connector of a spatial snake
contact_share: mean share of connectors that press on the floor
supports: mean number of separate parts of the body that press on the floor
roll_turns: turns of the body about its axis over the whole run, mean over the connectors
""")
SPATIAL_UNITS = units_of(SPATIAL_MEANINGS)
"""Metrics of a spatial snake; each is one number or None."""

SPATIAL_DIFFERENCE_MEANINGS = meanings_of("""
travel_speed_rel: travel speed of the twin minus that of the analytical model, divided by the latter
travel_direction_abs: magnitude of the difference of the directions of travel
contact_agreement: share of samples in which a connector touches the floor on both plants or on neither
""")
SPATIAL_DIFFERENCES = units_of(SPATIAL_DIFFERENCE_MEANINGS) | {
    "travel_direction_abs": "rad"
}
"""Differences between two runs of a spatial snake."""


def spatial_metrics(trajectory: Trajectory) -> dict[str, float | None]:
    """Compute the metrics of a run of a spatial snake; a planar one has none of them.

    - ``travel_speed_m_s``: magnitude of the mean velocity of the centre of mass over
      whole gait periods. A sidewinder travels across its body, so that its forward
      speed is only a part of it.
    - ``travel_direction_rad``: direction of that velocity relative to the mean heading,
      positive to the left, −π to π.
    - ``body_height_m``: largest height of a connector in the same periods.
    - ``contact_share``: mean share of connectors that press on the floor.
    - ``supports``: mean number of separate parts of the body that press on the floor;
      with two, it can roll over.
    - ``roll_turns``: turns of the body about its axis over the whole run, mean over the
      connectors.

    The first two are None without a gait of at least three whole periods.
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
        ahead = float((c * velocity[:, 0] + s * velocity[:, 1]).mean())
        left = float((c * velocity[:, 1] - s * velocity[:, 0]).mean())
        metrics["travel_speed_m_s"] = math.hypot(ahead, left)
        metrics["travel_direction_rad"] = math.atan2(left, ahead)
        used = slice(int(np.searchsorted(trajectory.time, window.start)), None)
    metrics["body_height_m"] = float(trajectory.stack("z")[used].max())
    touches = trajectory.stack("load")[used] > 0.0
    metrics["contact_share"] = float(touches.mean())
    metrics["supports"] = float(
        (np.diff(touches, axis=1, prepend=False) & touches).sum(axis=1).mean()
    )
    w, x, y, z = (trajectory.stack(f"quaternion_{axis}") for axis in "wxyz")
    # Heights of the tips of the left and the upper axis of a connector.
    roll = np.unwrap(np.arctan2(2 * (y * z + w * x), 1 - 2 * (x**2 + y**2)), axis=0)
    metrics["roll_turns"] = float(abs(roll[-1] - roll[0]).mean() / (2 * math.pi))
    return metrics


def spatial_differences(
    reference: Trajectory, candidate: Trajectory, time: Array
) -> dict[str, float | None]:
    """Compare two runs of a spatial snake; planar ones have none of these differences.

    - ``travel_speed_rel``: (candidate − reference) / reference.
    - ``travel_direction_abs``: magnitude of the difference of the directions of travel,
      0 to π.
    - ``contact_agreement``: share of the samples of all connectors in which both or
      neither press on the floor, in whole gait periods if there are any.

    Args:
        reference: run of the analytical model.
        candidate: run of the twin.
        time: compared times, s.
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
