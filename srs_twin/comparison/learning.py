"""Metrics of iterative learning: amplitudes, duty cycles, convergence and path.

Amplitudes are computed from the sensor readings in each period of a chamber
(`control.duties`). The path of the centre of mass is evaluated over the last gait
periods of a run. The lateral extent of the body is measured from this path (Fig. 58,
Table 8).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.centre_line import offset_to_sides
from srs_twin.comparison.gait import (
    MIN_TRAVEL_BODY_LENGTHS,
    GaitWindow,
    displacement_per_period,
    path_curvature,
    turning_radius,
)
from srs_twin.comparison.sampling import (
    body_length,
    label,
    meanings_of,
    positive_number,
    units_of,
)
from srs_twin.compute.arrays import Array
from srs_twin.errors import InputError
from srs_twin.trajectory import Trajectory

_PERIOD_ROUNDING = 1e-6
"""Tolerance for comparisons between times, as a fraction of a gait period."""


@dataclass(frozen=True)
class PeriodAmplitudes:
    """Amplitude, target and duty cycle of each chamber in each of K whole periods.

    All arrays have shape (K, segments, 2).

    Attributes:
        amplitude: maximum measured bend towards the side of the chamber, rad, or NaN if
            there is no valid sensor reading.
        target: target amplitude at the end of the period, rad, or NaN if there is no
            target.
        duty: duty cycle in the middle of the period.
    """

    amplitude: Array
    target: Array
    duty: Array

    @property
    def error(self) -> Array:
        """Target minus amplitude, shape (K, segments, 2), rad."""
        return self.target - self.amplitude

    @classmethod
    def from_trajectory(cls, trajectory: Trajectory) -> PeriodAmplitudes:
        """Compute the amplitudes, targets and duty cycles of a run.

        Raises:
            InputError: the metadata lack the fill times or the gait frequency.
        """
        measured_bend = trajectory.stack("measured_bend")
        period, fill_starts = _chamber_periods(trajectory, measured_bend.shape[-1])
        time = trajectory.time
        whole = int(
            math.floor(((time[-1] - fill_starts) / period).min() + _PERIOD_ROUNDING)
        )
        shape = (max(whole, 0), measured_bend.shape[-1], 2)
        result = cls(*np.full((3, *shape), math.nan))
        for side, name in enumerate(("plus", "minus")):
            target = trajectory.stack(f"target_{name}")
            duty = trajectory.stack(f"duty_{name}")
            for j in range(shape[1]):
                bend = measured_bend[:, j] if side == 0 else -measured_bend[:, j]
                edges = fill_starts[j, side] + period * (
                    np.arange(shape[0] + 1) - _PERIOD_ROUNDING
                )
                samples = np.searchsorted(time, edges)
                for n, (first, end) in enumerate(
                    zip(samples[:-1], samples[1:], strict=True)
                ):
                    valid = bend[first:end][np.isfinite(bend[first:end])]
                    result.amplitude[n, j, side] = valid.max() if len(valid) else np.nan
                    # Samples are recorded at the ends of ticks, so the sample before
                    # `end` still belongs to this period.
                    result.target[n, j, side] = target[end - 1, j]
                    result.duty[n, j, side] = duty[(first + end) // 2, j]
        return result


def _chamber_periods(trajectory: Trajectory, segments: int) -> tuple[float, Array]:
    """Return the gait period (s) and the time (s) of the first fill of each chamber."""
    frequency = positive_number(trajectory, "gait_frequency_hz")
    listed = (trajectory.metadata.get("control") or {}).get("fill_begins_s")
    fill_starts = np.array(listed if isinstance(listed, list) else [], dtype=float)
    if (
        frequency is None
        or fill_starts.shape != (segments, 2)
        or not np.isfinite(fill_starts).all()
    ):
        raise InputError(
            f"{label(trajectory)}: the fill times of the chambers are unknown; add"
            " `gait_frequency_hz` and `control.fill_begins_s` to the metadata"
        )
    return 1 / frequency, fill_starts


_STRAIGHT_PATH_TURN = 1e-4
"""Total turn of a path below which a line is fitted instead of a circle, rad.

A circle fitted to a nearly straight path would have an arbitrary radius.
"""


@dataclass(frozen=True)
class PathFit:
    """Circle or line fitted to the period-averaged path of the centre of mass.

    Attributes:
        centre: centre of the circle, or a point on the line, shape (2,), m.
        radius: radius of the circle, m, positive if the centre lies to the left of the
            heading, or None for a line.
        direction: unit vector along the line, or along the heading in the middle of the
            circular path, shape (2,).
    """

    centre: Array
    radius: float | None
    direction: Array

    @classmethod
    def from_trajectory(
        cls, trajectory: Trajectory, window: GaitWindow
    ) -> PathFit | None:
        """Fit a circle or a line, or return None if the snake does not move."""
        mean, velocity = window.running_mean(trajectory, trajectory.com)
        heading, turn_rate = window.running_mean(trajectory, trajectory["heading"])
        centroid = mean.mean(axis=0)
        speed = float(np.hypot(*velocity.T).mean())
        length = speed * (window.periods - 1) * window.period
        if length < 1e-9:
            return None
        # Left and right refer to the heading even if the snake moves backward.
        middle_heading = heading[len(heading) // 2]
        direction = np.array([np.cos(middle_heading), np.sin(middle_heading)])
        turn = float(turn_rate.mean()) * window.period
        x, y = (mean - centroid).T / length
        # Kåsa's method fits the circle x² + y² + a x + b y + c = 0 by least squares.
        basis = np.stack([x, y, np.ones_like(x)], axis=-1)
        (a, b, c), _, rank, _ = np.linalg.lstsq(basis, -(x**2 + y**2), rcond=1e-10)
        curved = rank == 3 and abs(turn) * (window.periods - 1) >= _STRAIGHT_PATH_TURN
        if not curved:
            axis = np.linalg.svd(mean - centroid, full_matrices=False)[2][0]
            return cls(centroid, None, axis if axis @ direction > 0 else -axis)
        centre = np.array([-a / 2, -b / 2])
        # Averaging over a period multiplies the radius by sinc(turn/2).
        reduction = float(np.sinc(turn / (2 * np.pi)))
        radius = length * float(np.sqrt(centre @ centre - c)) / reduction
        if direction[0] * centre[1] - direction[1] * centre[0] <= 0:
            radius = -radius
        return cls(centroid + length * centre, radius, direction)

    def right_offset(self, points: Array) -> Array:
        """Return distances of points (…, 2) from the path, positive on the right, m."""
        x, y = np.moveaxis(points - self.centre, -1, 0)
        if self.radius is None:
            side: Array = self.direction[1] * x - self.direction[0] * y
            return side
        outward: Array = np.hypot(x, y) - abs(self.radius)
        return outward if self.radius > 0 else -outward


def box_edges(
    trajectory: Trajectory, window: GaitWindow, path: PathFit
) -> tuple[float, float]:
    """Return the left and right edges of the area that the body covers, m.

    Edges are distances from the path, positive to the right. If the metadata contain
    the body width (``body_width_m``), half the width is added on both sides of each
    connector.
    """
    part = trajectory.between(window.start, window.end)
    half = (positive_number(trajectory, "body_width_m") or 0.0) / 2
    sides = offset_to_sides(part.position, part.stack("connector_heading"), half)
    offset = path.right_offset(sides)
    return float(offset.min()), float(offset.max())


LEARNING_MEANINGS = meanings_of("""
amplitude_growth_rel: mean amplitude in the last period before a duty changes, divided by that in the first
periods_to_converge: first period from which all amplitudes stay within 5 % of their targets
amplitude_error_end_rad: largest amplitude error in the last period
amplitude_error_end_rel: largest amplitude error in the last period, divided by the target
amplitude_error_rad: amplitude error of each chamber in each period
duty: learnt duty of each chamber in each period
duty_lowest: smallest duty in the last period
duty_highest: largest duty in the last period
path_speed_m_s: speed along the chords of the last five periods
path_curvature_before_per_m: curvature of the path before learning; positive to the left
path_curvature_per_m: curvature of the path in the last five periods
path_bend_before_per_m: magnitude of the curvature before learning
path_bend_per_m: magnitude of the curvature in the last five periods
path_bend_left_rel: fraction of the magnitude of the curvature that remains after learning
path_radius_m: radius of the path in the last five periods
path_radius_spread_rel: range of the path radii in the last five periods, divided by their mean
heading_drift_rad: turn of the heading per period, mean over the last five periods
heading_drift_by_period_rad: turn of the heading in each period
extent_left_m: extent of the body to the left of the path
extent_right_m: extent of the body to the right of the path
""")
LEARNING_LIST_UNITS = units_of(
    ["amplitude_error_rad", "duty", "heading_drift_by_period_rad"]
)
"""Units of metrics with one entry per period.

Each entry is a nested list over segments and chambers, except that the entries of
``heading_drift_by_period_rad`` are numbers.
"""
LEARNING_UNITS = units_of(
    name for name in LEARNING_MEANINGS if name not in LEARNING_LIST_UNITS
)

CONVERGENCE_TOLERANCE = 0.05
"""Maximum relative amplitude error of a converged chamber."""
LAST_PERIODS = 5
"""Number of final periods over which the path is evaluated."""

_MIN_CURVATURE = 1e-3
"""Curvature before learning below which no relative change is computed, 1/m."""


def is_learning(trajectory: Trajectory) -> bool:
    """Return whether a run uses iterative learning."""
    return all(
        trajectory.has(name) for name in ("measured_bend", "duty_plus", "target_plus")
    )


def learning_metrics(trajectory: Trajectory) -> dict[str, object]:
    """Compute the metrics of a run with iterative learning (`LEARNING_MEANINGS`).

    A metric that is not applicable is None. Amplitudes refer to the periods of each
    chamber, the first of which may begin before time 0. Amplitude errors are target
    minus amplitude. Modules with a fault have no target and therefore no amplitude
    error. ``amplitude_growth_rel`` is 1 if the pressure cycles of the chambers do not
    change before learning begins.

    The path curvature is 2 sin(turn/2)/chord with the mean chord and turn of a period
    (`gait.displacement_per_period`). The curvature before learning is computed from the
    last two periods before the first update of a duty cycle. It is None if these
    periods begin less than half a period after the start of the run. ``extent_left_m``
    and ``extent_right_m`` are measured from the circle or line that is fitted to the
    last five periods (`PathFit`).

    Raises:
        InputError: columns or metadata are missing or unusable.
    """
    by_period = PeriodAmplitudes.from_trajectory(trajectory)
    period = 1 / (positive_number(trajectory, "gait_frequency_hz") or math.nan)
    path = _path(trajectory, period)
    before = _curvature_before(trajectory, period)
    return {
        **dict.fromkeys(LEARNING_UNITS),
        **_amplitudes(by_period),
        "amplitude_growth_rel": _growth(by_period),
        **path,
        "path_curvature_before_per_m": before,
        **_curvature_change(before, path.get("path_curvature_per_m")),
        "amplitude_error_rad": _nested_lists(by_period.error),
        "duty": _nested_lists(by_period.duty),
        "heading_drift_by_period_rad": _turn_by_period(trajectory, period).tolist(),
    }


def _amplitudes(by_period: PeriodAmplitudes) -> dict[str, float | None]:
    if not np.isfinite(by_period.target[-1:]).any():
        return {}
    working = ~np.isnan(by_period.target[-1])
    error = np.abs(by_period.error[:, working])
    target = by_period.target[:, working]
    converged = np.all(error <= CONVERGENCE_TOLERANCE * target, axis=1)
    outside = np.flatnonzero(~converged)
    # `outside[-1]` is the index of the last period that exceeds the tolerance. Periods
    # are numbered from 1, so the first converged period has the number
    # `outside[-1] + 2`.
    first = int(outside[-1]) + 2 if len(outside) else 1
    duty = by_period.duty[-1, working]
    metrics: dict[str, float | None] = {
        "duty_lowest": float(duty.min()),
        "duty_highest": float(duty.max()),
    }
    if first <= len(converged):
        metrics["periods_to_converge"] = float(first)
    if np.isfinite(error[-1]).all():
        metrics["amplitude_error_end_rad"] = float(error[-1].max())
        metrics["amplitude_error_end_rel"] = float((error[-1] / target[-1]).max())
    return metrics


def _growth(by_period: PeriodAmplitudes) -> float | None:
    if not len(by_period.duty):
        return None
    unchanged = (by_period.duty == by_period.duty[0]).all(axis=(1, 2))
    last = len(unchanged) - 1
    if not unchanged.all():
        last = int(np.argmin(unchanged)) - 1
    first_mean = by_period.amplitude[0].mean()
    last_mean = by_period.amplitude[last].mean()
    if last > 0 and first_mean > 0:
        return float(last_mean / first_mean)
    return None


def _path(trajectory: Trajectory, period: float) -> dict[str, float | None]:
    window = GaitWindow.ending_at(
        trajectory, period, float(trajectory.time[-1]), LAST_PERIODS
    )
    if window is None:
        return {}
    chords, turns = displacement_per_period(trajectory, window)
    chord = float(chords.mean())
    turn = float(turns.mean())
    metrics: dict[str, float | None] = {
        "heading_drift_rad": turn,
        "path_speed_m_s": chord / period,
    }
    length = body_length(trajectory)
    path = None
    if abs(chord) >= MIN_TRAVEL_BODY_LENGTHS * length:
        path = PathFit.from_trajectory(trajectory, window)
    if path is None:
        return metrics
    metrics["path_curvature_per_m"] = path_curvature(chord, turn)
    speeds = chords / period
    yaw_rates = turns / period
    mean = turning_radius(float(speeds.mean()), float(yaw_rates.mean()), period, length)
    pairs = zip(speeds.tolist(), yaw_rates.tolist(), strict=True)
    radii = [
        turning_radius(speed, yaw_rate, period, length) for speed, yaw_rate in pairs
    ]
    if mean is not None and None not in radii:
        metrics["path_radius_spread_rel"] = float(
            np.ptp(np.array(radii, dtype=float)) / abs(mean)
        )
    metrics["path_radius_m"] = mean
    left, right = box_edges(trajectory, window, path)
    metrics["extent_left_m"] = -left
    metrics["extent_right_m"] = right
    return metrics


def _curvature_before(trajectory: Trajectory, period: float) -> float | None:
    duty = np.concatenate(
        [trajectory.stack("duty_plus"), trajectory.stack("duty_minus")], axis=-1
    )
    changed = np.flatnonzero((duty != duty[0]).any(axis=1))
    end = float(
        trajectory.time[changed[0] - 1] if len(changed) else trajectory.time[-1]
    )
    window = GaitWindow.ending_at(trajectory, period, end, 2)
    earliest = 0.5 * period * (1 - _PERIOD_ROUNDING)
    if window is None or window.start - float(trajectory.time[0]) < earliest:
        return None
    chords, turns = displacement_per_period(trajectory, window)
    chord = float(chords.mean())
    if not abs(chord) >= MIN_TRAVEL_BODY_LENGTHS * body_length(trajectory):
        return None
    return path_curvature(chord, float(turns.mean()))


def _curvature_change(
    before: float | None, after: float | None
) -> dict[str, float | None]:
    first, last = (
        None if curvature is None else abs(curvature) for curvature in (before, after)
    )
    if first is None or last is None or first < _MIN_CURVATURE:
        ratio = None
    else:
        ratio = last / first
    return {
        "path_bend_before_per_m": first,
        "path_bend_per_m": last,
        "path_bend_left_rel": ratio,
    }


def _turn_by_period(trajectory: Trajectory, period: float) -> Array:
    duration = trajectory.time[-1] - trajectory.time[0]
    whole = int(math.floor(duration / period + _PERIOD_ROUNDING))
    starts = trajectory.time[0] + period * np.arange(whole + 1)
    return np.diff(np.interp(starts, trajectory.time, trajectory["heading"]))


def _nested_lists(values: Array) -> list[object]:
    plain = values.astype(object)
    plain[np.isnan(values)] = None
    lists: list[object] = plain.tolist()
    return lists
