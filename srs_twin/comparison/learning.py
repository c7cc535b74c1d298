"""Metrics of iterative learning: amplitudes and duties by period, convergence, the path before and after.

What is measured is what the sensors read, in the periods of each chamber's own clock (`control.duties`). The
path of the centre of mass is measured over the last periods, and with it how far the body reaches to the left
and right of it (Fig. 58, Table 8).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin.comparison.centre_line import on_both_sides
from srs_twin.comparison.gait import LEAST_WAY, GaitWindow, carried, path_curvature, turning_radius
from srs_twin.comparison.sampling import body_length, label, positive_number, units_of
from srs_twin.errors import InputError
from srs_twin.trajectory import Trajectory

_ROUNDING = 1e-6  # of a period


@dataclass(frozen=True)
class ChamberPeriods:
    """What each chamber did in its own periods, of which the run holds K in whole.

    Attributes:
        amplitude: furthest sensed bend to the chamber's side, shape (K, segments, 2), rad; NaN where
            nothing was read.
        target: at the end of the period, same shape, rad; NaN where there is none.
        duty: same shape.
    """

    amplitude: np.ndarray
    target: np.ndarray
    duty: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """Target less amplitude, shape (K, segments, 2), rad."""
        return self.target - self.amplitude

    @classmethod
    def of(cls, trajectory: Trajectory) -> ChamberPeriods:
        """Cut a run into the periods of its chambers.

        Raises:
            InputError: the metadata do not say when chambers begin to fill, or how often.
        """
        sensed = trajectory.stack("sensed")
        period, begins = _clocks(trajectory, sensed.shape[-1])
        time = trajectory.time
        whole = int(math.floor(((time[-1] - begins) / period).min() + _ROUNDING))
        shape = (max(whole, 0), sensed.shape[-1], 2)
        found = cls(*np.full((3, *shape), math.nan))
        for side, name in enumerate(("plus", "minus")):
            target, duty = trajectory.stack(f"target_{name}"), trajectory.stack(f"duty_{name}")
            for j in range(shape[1]):
                away = sensed[:, j] if side == 0 else -sensed[:, j]
                edges = begins[j, side] + period * (np.arange(shape[0] + 1) - _ROUNDING)
                cuts = np.searchsorted(time, edges)
                for n, (first, end) in enumerate(zip(cuts[:-1], cuts[1:], strict=True)):
                    good = away[first:end][np.isfinite(away[first:end])]
                    found.amplitude[n, j, side] = good.max() if len(good) else math.nan
                    # A sample shows what its tick was given: the last one of a period is still its own.
                    found.target[n, j, side] = target[end - 1, j]
                    found.duty[n, j, side] = duty[(first + end) // 2, j]
        return found


def _clocks(trajectory: Trajectory, segments: int) -> tuple[float, np.ndarray]:
    """Return the gait period (s) and when each chamber first fills, shape (segments, 2), s."""
    frequency = positive_number(trajectory, "gait_frequency_hz")
    listed = (trajectory.metadata.get("control") or {}).get("fill_begins_s")
    begins = np.array(listed, dtype=float) if isinstance(listed, list) else np.empty(0)
    if frequency is None or begins.shape != (segments, 2) or not np.isfinite(begins).all():
        raise InputError(
            f"{label(trajectory)}: metadata gait_frequency_hz and control.fill_begins_s are needed to tell "
            "the periods of the chambers"
        )
    return 1 / frequency, begins


# A path that bends by less than this over its whole length is taken for a line, rad: where a circle would be
# fitted to it, rounding would decide its radius.
_LEAST_TURN = 1e-4


@dataclass(frozen=True)
class PathFit:
    """The circle, or the line, that fits the period-averaged path of a centre of mass best.

    Attributes:
        centre: of the circle, shape (2,), m; of a line any point on it.
        radius: m, positive where the centre lies on the left of the way the snake heads; None: a line.
        ahead: unit vector along a line, shape (2,).
    """

    centre: np.ndarray
    radius: float | None
    ahead: np.ndarray

    @classmethod
    def of(cls, trajectory: Trajectory, window: GaitWindow) -> PathFit | None:
        """Return the fit over a window of whole periods; None of a snake that stays where it is."""
        mean, velocity = window.running(trajectory, trajectory.com)
        heading, turning = window.running(trajectory, trajectory["heading"])
        middle = mean.mean(axis=0)
        length = float(np.hypot(*velocity.T).mean()) * (window.periods - 1) * window.period
        if length < 1e-9:
            return None
        # Along the path the heading goes with it: which side is left is the heading's to say.
        facing = heading[len(heading) // 2]
        ahead = np.array([np.cos(facing), np.sin(facing)])
        turn = float(turning.mean()) * window.period
        x, y = (mean - middle).T / length
        # Kåsa's circle: x² + y² + a x + b y + c = 0, by least squares.
        basis = np.stack([x, y, np.ones_like(x)], axis=-1)
        (a, b, c), _, rank, _ = np.linalg.lstsq(basis, -(x**2 + y**2), rcond=1e-10)
        bent = rank == 3 and abs(turn) * (window.periods - 1) >= _LEAST_TURN
        if not bent:
            along = np.linalg.svd(mean - middle, full_matrices=False)[2][0]
            return cls(middle, None, along if along @ ahead > 0 else -along)
        centre = np.array([-a / 2, -b / 2])
        # Averaging over a period draws a circle inwards by the sinc of half the turn.
        radius = length * float(np.sqrt(centre @ centre - c)) / float(np.sinc(turn / (2 * np.pi)))
        left = ahead[0] * centre[1] - ahead[1] * centre[0]
        return cls(middle + length * centre, radius if left > 0 else -radius, ahead)

    def to_the_right(self, points: np.ndarray) -> np.ndarray:
        """Return how far points, shape (…, 2), lie to the right of the path, shape (…), m."""
        apart = points - self.centre
        if self.radius is None:
            side: np.ndarray = self.ahead[1] * apart[..., 0] - self.ahead[0] * apart[..., 1]
            return side
        beyond = np.hypot(apart[..., 0], apart[..., 1]) - abs(self.radius)
        return beyond if self.radius > 0 else -beyond


def box_edges(trajectory: Trajectory, window: GaitWindow, path: PathFit) -> tuple[float, float]:
    """Return the left and the right edge of what a body sweeps over a window, m; left is negative.

    Each connector counts with half the width of the body on either side of it, across its own heading, where
    the metadata give a width (``body_width_m``).
    """
    seen = (trajectory.time >= window.start - 1e-9) & (trajectory.time <= window.end + 1e-9)
    theta, position = trajectory.stack("theta")[seen], trajectory.position[seen]
    half = (positive_number(trajectory, "body_width_m") or 0.0) / 2
    reach = path.to_the_right(on_both_sides(position, theta, half))
    return float(reach.min()), float(reach.max())


LEARNING_UNITS = units_of("""
    amplitude_growth_rel periods_to_converge amplitude_error_end_rad amplitude_error_end_rel
    path_speed_m_s path_curvature_before_per_m path_curvature_per_m
    path_bend_before_per_m path_bend_per_m path_bend_left_rel
    path_radius_m path_radius_spread_rel heading_drift_rad
    duty_lowest duty_highest box_left_m box_right_m
""")
"""Metrics of a run under iterative learning, each one number or None."""

LEARNING_LIST_UNITS = units_of("amplitude_error_rad duty heading_drift_by_period_rad")
"""Histories: a list a period, of a list a segment, of the + and − chamber; the heading's numbers a period."""

CONVERGED = 0.05
"""Share of its target by which an amplitude may miss it."""
LAST_PERIODS = 5
"""Over how many periods at the end the path is measured."""

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
    pairs = zip(speeds.tolist(), yaw_rates.tolist(), strict=True)
    radii = [turning_radius(*each, period, length) for each in pairs]
    if mean is not None and None not in radii:
        found["path_radius_spread_rel"] = float(np.ptp(np.array(radii, dtype=float)) / abs(mean))
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
    first, second = (None if each is None else abs(each) for each in (before, after))
    left = None if first is None or second is None or first < _LEAST_CURVATURE else second / first
    return {"path_bend_before_per_m": first, "path_bend_per_m": second, "path_bend_left_rel": left}


def _turns(trajectory: Trajectory, period: float) -> np.ndarray:
    """Return by how much each whole period of a run turns the body, rad."""
    whole = int(math.floor((trajectory.time[-1] - trajectory.time[0]) / period + _ROUNDING))
    begins = trajectory.time[0] + period * np.arange(whole + 1)
    return np.diff(np.interp(begins, trajectory.time, trajectory["heading"]))


def _listed(values: np.ndarray) -> list[Any]:
    """Return nested lists, None in place of NaN."""
    if values.ndim > 1:
        return [_listed(each) for each in values]
    return [None if math.isnan(each) else each for each in values.tolist()]
