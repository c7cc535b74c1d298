"""Units and groups of metrics, checks of trajectories, and interpolation of their samples."""

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


# Unit suffixes of metric names in addition to those of file keys; longer suffixes come
# first.
_UNITS = {"_rad_s": "rad/s", "_per_m": "1/m", "_w": "W", "_t": "T", **UNITS}


def split_unit(metric: str) -> tuple[str, str]:
    """Return the name of a metric without its unit suffix, and the unit; "1" if there is no suffix."""
    suffix = next((suffix for suffix in _UNITS if metric.endswith(suffix)), "")
    return metric.removesuffix(suffix), _UNITS.get(suffix, "1")


def units_of(names: Iterable[str]) -> dict[str, str]:
    """Return metric → unit, as the names of the metrics state."""
    return {name: split_unit(name)[1] for name in names}


def meanings_of(lines: str) -> dict[str, str]:
    """Return metric → meaning for a text with a line ``metric: meaning`` for each."""
    return dict(line.split(": ", 1) for line in lines.strip().splitlines())


STRAIGHT_RAD_S = 0.05
"""Yaw rate below which a run counts as straight, rad/s; contact creep and the start turn the body as well."""
ZERO = 5e-5
"""Magnitude below which a length, speed or angle counts as zero, m, m/s or rad: a tenth of a millimetre."""
_RESOLUTION = {"m": ZERO, "m/s": ZERO, "rad": ZERO, "rad/s": STRAIGHT_RAD_S}
_MAX_CHANGE = 10.0
"""Largest change, as a multiple of the reference, that is stated in per cent.

A larger per cent would mainly measure how near to zero the reference is."""


def is_near_zero(reference: float, value: float, unit: str) -> bool:
    """Return whether a reference is too near to zero for a change in per cent of it.

    Args:
        reference: old value.
        value: new value.
        unit: their unit.
    """
    least = max(_RESOLUTION.get(unit, 0.0), abs(value - reference) / _MAX_CHANGE)
    return abs(reference) <= least


def rms(values: np.ndarray) -> float:
    """Return the root mean square of values."""
    return float(np.sqrt(np.square(values).mean()))


def label(trajectory: Trajectory) -> str:
    """Return the name of a trajectory for messages: its plant, or 'trajectory'."""
    return str(trajectory.metadata.get("plant", "trajectory"))


def check_columns(trajectory: Trajectory, *names: str) -> None:
    """Check that metrics can be computed from a trajectory.

    Args:
        trajectory: one run.
        names: columns that must exist in addition to ``time``; ``"x"`` means ``x_1…``.

    Raises:
        InputError: a column is missing or contains a value that is not finite, there is
            no sample, or the time does not increase between samples.
    """
    run = label(trajectory)
    missing = [name for name in ("time", *names) if not trajectory.has(name)]
    if missing:
        raise InputError(
            f"{run}: no column '{missing[0]}'; the metrics cannot be computed"
            " without it"
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
    """Return a positive number from the metadata, or None if it is null or missing.

    Raises:
        InputError: the value is neither a positive number nor null.
    """
    value = trajectory.metadata.get(name)
    if value is None:
        return None
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not 0 < value < np.inf:
        raise InputError(
            f"{label(trajectory)}: metadata {name} is {value!r}; it must be a positive"
            " number or null"
        )
    return float(value)


def segment_lengths(trajectory: Trajectory) -> tuple[float, float]:
    """Return the arc length of a segment and its rigid gap from the metadata, m.

    Raises:
        InputError: one of them is missing.
    """
    length, gap = (
        trajectory.metadata.get(name) for name in ("segment_length_m", "rigid_gap_m")
    )
    if length is None or gap is None:
        raise InputError(
            f"{label(trajectory)}: metadata segment_length_m or rigid_gap_m is missing"
        )
    return float(length), float(gap)


def body_length(trajectory: Trajectory) -> float:
    """Return the body length from the metadata, m.

    Raises:
        InputError: it is missing.
    """
    length = positive_number(trajectory, "body_length_m")
    if length is None:
        raise InputError(
            f"{label(trajectory)}: metadata body_length_m is missing; distances are"
            " divided by it"
        )
    return length


def interpolant(trajectory: Trajectory, values: np.ndarray) -> CubicSpline:
    """Return the cubic spline through samples of a trajectory.

    Its error is of fourth order in the sample period; the error of its integral over a
    gait period is smaller.

    Args:
        trajectory: run with two samples or more.
        values: shape (samples, …).
    """
    # Imported here because it takes half a second, which commands that only list
    # metrics do not need.
    from scipy.interpolate import CubicSpline

    return CubicSpline(trajectory.time, values)


def _no_reason(metric: str, trajectory: Trajectory) -> str:
    return ""


@dataclass(frozen=True)
class MetricGroup:
    """Metrics of one topic. Each is one number per run, and its name ends in its unit.

    Attributes:
        meanings: metric → meaning in one line.
        measure: returns the values of a run by metric, None where a metric is
            undefined.
        why_undefined: returns the reason why a metric has no value; empty if this is
            the outcome of the run.
        relative: metrics whose difference between the plants is also shown in per cent.
        main: metric that only runs of this topic have; `short_table` is then the whole
            short table of such a run. If empty, `short_table` is appended to the short
            table of every run.
        short_table: metrics of the short table.
        yes_no: metrics that are 1 or 0, shown as yes or no.
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
        """Metric → unit, as its name states."""
        return units_of(self.meanings)


@cache
def extension_groups() -> tuple[MetricGroup, ...]:
    """Return the groups of the installed extensions."""
    return tuple(group for _, group in objects(METRICS))


def metric_groups() -> tuple[MetricGroup, ...]:
    """Return the groups of the installed extensions and of the plug-ins."""
    return (*extension_groups(), *(group for _, group in plugin_parts(MetricGroup)))
