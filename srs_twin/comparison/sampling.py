"""Metric units, metric groups, and functions to check and interpolate trajectories."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.errors import InputError
from srs_twin.extensions import METRICS, objects, plugin_parts
from srs_twin.robot.sourced import UNITS
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


# Metric names have more unit suffixes than file keys. Because the first matching suffix
# is used, longer suffixes come first.
_UNITS = {"_rad_s": "rad/s", "_per_m": "1/m", "_w": "W", "_t": "T", **UNITS}


def split_unit(metric: str) -> tuple[str, str]:
    """Split a metric into name and unit, where the unit is "1" without a suffix."""
    suffix = next((suffix for suffix in _UNITS if metric.endswith(suffix)), "")
    return metric.removesuffix(suffix), _UNITS.get(suffix, "1")


def units_of(names: Iterable[str]) -> dict[str, str]:
    """Return the unit of each metric according to the suffix of the metric name."""
    return {name: split_unit(name)[1] for name in names}


def meanings_of(lines: str) -> dict[str, str]:
    """Parse metric descriptions from lines of the form ``metric: description``."""
    return dict(line.split(": ", 1) for line in lines.strip().splitlines())


STRAIGHT_RAD_S = 0.05
"""Yaw rate below which a run counts as straight, rad/s.

Contact creep and start-up transients can cause smaller yaw rates.
"""
ZERO = 5e-5
"""Magnitude below which a length (m), speed (m/s) or angle (rad) counts as zero."""
_RESOLUTION = {"m": ZERO, "m/s": ZERO, "rad": ZERO, "rad/s": STRAIGHT_RAD_S}
_MAX_CHANGE = 10.0
"""Maximum change that is printed in per cent, as a multiple of the reference.

A larger change usually means that the reference is close to zero.
"""


def is_near_zero(reference: float, value: float, unit: str) -> bool:
    """Return whether a reference is too close to zero to compute a relative change."""
    least = max(_RESOLUTION.get(unit, 0.0), abs(value - reference) / _MAX_CHANGE)
    return abs(reference) <= least


def rms(values: np.ndarray) -> float:
    """Return the root mean square of all elements."""
    return float(np.sqrt(np.square(values).mean()))


def label(trajectory: Trajectory) -> str:
    """Return the plant name for messages, or "trajectory" if the plant is unknown."""
    return str(trajectory.metadata.get("plant", "trajectory"))


def check_columns(trajectory: Trajectory, *names: str) -> None:
    """Check that metrics can be computed from a trajectory.

    Args:
        trajectory: trajectory to check.
        names: required columns. A name such as ``"x"`` may also stand for the numbered
            columns ``x_1…``.

    Raises:
        InputError: a column is missing or not finite, there are no samples, or the
            times are not increasing.
    """
    run = label(trajectory)
    missing = [name for name in ("time", *names) if not trajectory.has(name)]
    if missing:
        raise InputError(
            f"{run}: the metrics cannot be computed, because the column '{missing[0]}'"
            " is missing"
        )
    if len(trajectory) == 0:
        raise InputError(f"{run}: the trajectory has no samples")
    for name in ("time", *names):
        is_column = name in trajectory.columns
        values = trajectory[name] if is_column else trajectory.stack(name)
        bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
        if bad.size:
            raise InputError(
                f"{run}: column '{name}' is not finite at sample {bad[0]}; remove this"
                " sample and all later ones"
            )
    if np.any(np.diff(trajectory.time) <= 0):
        raise InputError(
            f"{run}: the times are not increasing; each sample must be later than the"
            " sample before it"
        )


def positive_number(trajectory: Trajectory, name: str) -> float | None:
    """Return a positive number from the metadata, or None if the entry is missing.

    Raises:
        InputError: the value is neither a positive number nor null.
    """
    value = trajectory.metadata.get(name)
    if value is None:
        return None
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not 0 < value < np.inf:
        raise InputError(
            f"{label(trajectory)}: the metadata entry `{name}` is {value!r}, but must"
            " be a positive number or null"
        )
    return float(value)


def segment_lengths(trajectory: Trajectory) -> tuple[float, float]:
    """Return the arc length and the rigid gap of a segment from the metadata, m.

    Raises:
        InputError: a length is missing.
    """
    length, gap = (
        trajectory.metadata.get(name) for name in ("segment_length_m", "rigid_gap_m")
    )
    if length is None or gap is None:
        raise InputError(
            f"{label(trajectory)}: the metadata lack `segment_length_m` or"
            " `rigid_gap_m`; add both"
        )
    return float(length), float(gap)


def body_length(trajectory: Trajectory) -> float:
    """Return the body length from the metadata, m.

    Raises:
        InputError: the length is missing.
    """
    length = positive_number(trajectory, "body_length_m")
    if length is None:
        raise InputError(
            f"{label(trajectory)}: the metadata lack `body_length_m`, by which"
            " distances are divided; add this entry"
        )
    return length


def interpolant(trajectory: Trajectory, values: np.ndarray) -> CubicSpline:
    """Return the cubic spline through the samples of a signal."""
    # The import takes half a second and is not needed by commands that list metrics.
    from scipy.interpolate import CubicSpline

    return CubicSpline(trajectory.time, values)


def _no_reason(metric: str, trajectory: Trajectory) -> str:
    return ""


@dataclass(frozen=True)
class MetricGroup:
    """Metrics of one topic.

    Each metric is one number per run. The unit of a metric is given by a suffix of the
    metric name.

    Attributes:
        meanings: one-line description of each metric.
        measure: function that computes the metrics of a run, with None for undefined
            metrics.
        why_undefined: function that returns the reason why a metric is undefined, or an
            empty string if the missing value is itself a result of the run.
        relative: metrics whose difference between the plants is also printed in per
            cent.
        main: metric that only runs of this topic have, or an empty string. In the short
            table of such a run, `short_table` replaces the usual metrics. Without a
            `main` metric, `short_table` is appended to the short table of every run.
        short_table: metrics that the topic contributes to the short table.
        yes_no: boolean metrics.
    """

    meanings: Mapping[str, str]
    measure: Callable[[Trajectory], dict[str, float | None]]
    why_undefined: Callable[[str, Trajectory], str] = _no_reason
    relative: frozenset[str] = frozenset()
    main: str = ""
    short_table: tuple[str, ...] = ()
    yes_no: frozenset[str] = frozenset()

    @property
    def units(self) -> dict[str, str]:
        """Unit of each metric."""
        return units_of(self.meanings)

    def compute(self, trajectory: Trajectory) -> dict[str, float | None]:
        """Return the metrics of a run, with None for values that are not finite.

        Raises:
            InputError: `measure` returned no mapping, an unknown metric, or a value that
                is neither a number nor None.
        """
        measured = self.measure(trajectory)
        if not isinstance(measured, Mapping):
            raise InputError(
                f"`measure` of {self.measure.__module__} returned {measured!r}, but must"
                " return a mapping"
            )
        values = {}
        for name, value in measured.items():
            number = value.item() if isinstance(value, np.generic) else value
            if name not in self.meanings or not isinstance(number, float | int | None):
                raise InputError(
                    f"metric '{self.measure.__module__}:{name}' with the value"
                    f" {value!r} is not allowed; `measure` must return a number or None"
                    " for each name in `meanings`"
                )
            is_finite = number is not None and np.isfinite(number)
            values[name] = number if is_finite else None
        return values


@cache
def extension_groups() -> tuple[MetricGroup, ...]:
    """Return the metric groups of installed extensions."""
    return tuple(group for _, group in objects(METRICS))


def metric_groups() -> tuple[MetricGroup, ...]:
    """Return the metric groups of installed extensions and plug-ins."""
    return (*extension_groups(), *(group for _, group in plugin_parts(MetricGroup)))
