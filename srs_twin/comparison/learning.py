"""Metrics of iterative learning: amplitudes and duties by period, convergence, the path before and after.

What is measured is what the sensors said, in the periods of each chamber's own clock (`control.cycles`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from srs_twin.comparison.chamber_periods import ChamberPeriods
from srs_twin.comparison.gait_window import GaitWindow
from srs_twin.comparison.lateral import PathFit, box_edges
from srs_twin.comparison.period_path import LEAST_WAY, carried
from srs_twin.comparison.sampling import body_length, positive_number
from srs_twin.comparison.turning import path_curvature, turning_radius
from srs_twin.trajectory import Trajectory

# Metrics of a run under iterative learning, each one number or None.
LEARNING_UNITS = {
    "amplitude_growth_rel": "1",
    "periods_to_converge": "1",
    "amplitude_error_end_rad": "rad",
    "amplitude_error_end_rel": "1",
    "path_speed_m_s": "m/s",
    "path_curvature_before_per_m": "1/m",
    "path_curvature_per_m": "1/m",
    "path_bend_before_per_m": "1/m",
    "path_bend_per_m": "1/m",
    "path_bend_left_rel": "1",
    "path_radius_m": "m",
    "path_radius_spread_rel": "1",
    "heading_drift_rad": "rad",
    "duty_lowest": "1",
    "duty_highest": "1",
    "box_left_m": "m",
    "box_right_m": "m",
}

# Histories: a list a period, of a list a segment, of the + and − chamber; the heading's a number a period.
LEARNING_LIST_UNITS = {"amplitude_error_rad": "rad", "duty": "1", "heading_drift_by_period_rad": "rad"}

CONVERGED = 0.05
"""Share of its target by which an amplitude may miss it."""
LAST_PERIODS = 5
"""Over how many periods at the end the path is measured."""

_ROUNDING = 1e-6  # of a period
_LEAST_CURVATURE = 1e-3
"""Of a path that is not straight beforehand, 1/m."""


def is_learning(trajectory: Trajectory) -> bool:
    """Say whether a run was under iterative learning."""
    return all(trajectory.has(name) for name in ("sensed", "duty_plus", "target_plus"))


def learning_metrics(trajectory: Trajectory) -> dict[str, Any]:
    """Measure one run under iterative learning; None where a metric does not apply.

    Amplitudes, in the periods of each chamber, numbered from 1 (a period that had begun before the start
    counts); chambers without a target, those of modules left out, do not count:

    - ``amplitude_growth_rel``: mean amplitude of the last period before a duty changes over that of the
      first; 1 where the air is there from the start.
    - ``periods_to_converge``: the first period from which on all amplitudes stay within 5 % of their target.
    - ``amplitude_error_end_rad`` and ``…_rel``: the largest error in the last period, and over its target.
    - ``duty_lowest`` and ``duty_highest``: of the last period.
    - ``amplitude_error_rad`` (target less amplitude, None without a target) and ``duty``: by period, segment
      and chamber.

    The path, by periods of which each carries the centre of mass along a chord and turns the body, means over
    the phase (so that five periods have four of them); curvature 2 sin(turn/2)/chord, positive to the left:

    - ``path_curvature_before_per_m``: over the two periods before the first update of a duty, None where they
      would begin less than half a period after the start.
    - ``path_speed_m_s`` (chord over period), ``path_curvature_per_m``, ``path_radius_m``,
      ``heading_drift_rad`` (turn a period): means over the last five.
      ``path_radius_spread_rel``: largest less smallest radius among them, over their mean.
    - ``path_bend_before_per_m``, ``path_bend_per_m``: the sizes of both curvatures; ``path_bend_left_rel``:
      the second over the first, what learning has left of it.
    - ``box_left_m``, ``box_right_m``: how far the body reaches to the left (negative) and right of the circle
      or line through the period-averaged path of the last five.
    - ``heading_drift_by_period_rad``: turn of every whole period of the run.

    Args:
        trajectory: a run with ``sensed``, ``duty_…`` and ``target_…``.

    Raises:
        InputError: columns or metadata are missing or unusable.
    """
    by_period = ChamberPeriods.of(trajectory)
    period = 1 / (positive_number(trajectory, "gait_frequency_hz") or math.nan)
    path, before = _path(trajectory, period), _before(trajectory, period)
    return {
        **dict.fromkeys(LEARNING_UNITS),
        **_amplitudes(by_period),
        "amplitude_growth_rel": _growth(by_period),
        **path,
        "path_curvature_before_per_m": before,
        **_straightened(before, path.get("path_curvature_per_m")),
        "amplitude_error_rad": _listed(by_period.error),
        "duty": _listed(by_period.duty),
        "heading_drift_by_period_rad": _turns(trajectory, period).tolist(),
    }


def _amplitudes(by_period: ChamberPeriods) -> dict[str, float | None]:
    counted = ~np.isnan(by_period.target[-1:]) if len(by_period.target) else np.zeros((0, 0, 2), dtype=bool)
    if not counted.any():
        return {}
    error, target = np.abs(by_period.error[:, counted[0]]), by_period.target[:, counted[0]]
    there = (error <= CONVERGED * target).all(axis=1)
    away = np.flatnonzero(~there)
    since = int(away[-1]) + 2 if len(away) else 1
    known = not np.isnan(error[-1]).any()
    duty = by_period.duty[-1, counted[0]]
    return {
        "periods_to_converge": float(since) if since <= len(there) else None,
        "amplitude_error_end_rad": float(error[-1].max()) if known else None,
        "amplitude_error_end_rel": float((error[-1] / target[-1]).max()) if known else None,
        "duty_lowest": float(duty.min()),
        "duty_highest": float(duty.max()),
    }


def _growth(by_period: ChamberPeriods) -> float | None:
    """Return by how much amplitudes grew while all duties stayed what they were."""
    if not len(by_period.duty):
        return None
    same = (by_period.duty == by_period.duty[0]).all(axis=(1, 2))
    last = len(same) - 1 if same.all() else int(np.argmin(same)) - 1
    first, grown = by_period.amplitude[0].mean(), by_period.amplitude[last].mean()
    return float(grown / first) if last > 0 and first > 0 else None


def _path(trajectory: Trajectory, period: float) -> dict[str, float | None]:
    window = GaitWindow.last(trajectory, period, float(trajectory.time[-1]), LAST_PERIODS)
    if window is None:
        return {}
    chords, turns = carried(trajectory, window)
    found: dict[str, float | None] = {
        "heading_drift_rad": float(turns.mean()),
        "path_speed_m_s": float(chords.mean()) / period,
    }
    length = body_length(trajectory)
    path = PathFit.of(trajectory, window) if abs(chords.mean()) >= LEAST_WAY * length else None
    if path is None:
        return found
    found["path_curvature_per_m"] = path_curvature(float(chords.mean()), float(turns.mean()))
    speeds, yaw_rates = chords / period, turns / period
    mean = turning_radius(float(speeds.mean()), float(yaw_rates.mean()), period, length)
    radii = [
        turning_radius(*each, period, length)
        for each in zip(speeds.tolist(), yaw_rates.tolist(), strict=True)
    ]
    each = np.array([radius for radius in radii if radius is not None])
    if mean is not None and len(each) == len(radii):
        found["path_radius_spread_rel"] = float(np.ptp(each) / abs(mean))
    found["path_radius_m"] = mean
    found["box_left_m"], found["box_right_m"] = box_edges(trajectory, window, path)
    return found


def _before(trajectory: Trajectory, period: float) -> float | None:
    """Return the curvature of the path over the two periods before a duty changes."""
    duty = np.concatenate([trajectory.stack("duty_plus"), trajectory.stack("duty_minus")], axis=-1)
    changed = np.flatnonzero((duty != duty[0]).any(axis=1))
    end = float(trajectory.time[changed[0] - 1] if len(changed) else trajectory.time[-1])
    window = GaitWindow.last(trajectory, period, end, 2)
    if window is None or window.start - float(trajectory.time[0]) < 0.5 * period * (1 - _ROUNDING):
        return None
    chords, turns = carried(trajectory, window)
    if not abs(chords.mean()) >= LEAST_WAY * body_length(trajectory):
        return None
    return path_curvature(float(chords.mean()), float(turns.mean()))


def _straightened(before: float | None, after: float | None) -> dict[str, float | None]:
    sizes = [None if each is None else abs(each) for each in (before, after)]
    first, second = sizes
    left = None if first is None or second is None or first < _LEAST_CURVATURE else second / first
    return {"path_bend_before_per_m": first, "path_bend_per_m": second, "path_bend_left_rel": left}


def _turns(trajectory: Trajectory, period: float) -> np.ndarray:
    """Return by how much each whole period of a run turns the body, rad."""
    whole = int(math.floor((trajectory.time[-1] - trajectory.time[0]) / period + _ROUNDING))
    heading = np.interp(
        trajectory.time[0] + period * np.arange(whole + 1), trajectory.time, trajectory["heading"]
    )
    return np.diff(heading)


def _listed(values: np.ndarray) -> list[Any]:
    """Return nested lists, None in place of NaN."""
    if values.ndim > 1:
        return [_listed(each) for each in values]
    return [None if math.isnan(each) else each for each in values.tolist()]
