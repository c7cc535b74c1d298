"""What all metrics share: their units, the checks of a trajectory, and smooth signals from its samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from srs_twin.errors import InputError
from srs_twin.robot.sourced import UNITS
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline


# How names of metrics end besides keys of files, and the unit that this means; longer ends first.
_UNITS = {"_rad_s": "rad/s", "_per_m": "1/m", "_w": "W", "_t": "T", **UNITS}


def split_unit(metric: str) -> tuple[str, str]:
    """Return the name of a metric without its unit, and the unit; "1" where it names none."""
    ending = next((each for each in _UNITS if metric.endswith(each)), "")
    return metric.removesuffix(ending), _UNITS.get(ending, "1")


def units_of(names: str) -> dict[str, str]:
    """Return metric → unit of the metrics in a text."""
    return {name: split_unit(name)[1] for name in names.split()}


def rms(values: np.ndarray) -> float:
    """Return the root of the mean of the squares."""
    return float(np.sqrt(np.square(values).mean()))


def label(trajectory: Trajectory) -> str:
    """Return what to call a trajectory in a message: its plant, or 'trajectory'."""
    return str(trajectory.metadata.get("plant", "trajectory"))


def require(trajectory: Trajectory, *names: str) -> None:
    """Check that a trajectory can be measured.

    Args:
        trajectory: one run.
        names: columns that must be there besides ``time``; ``"x"`` stands for ``x_1…``.

    Raises:
        InputError: a column is missing or holds a non-finite value, there is no sample, or time does not
            increase from sample to sample.
    """
    who = label(trajectory)
    missing = [name for name in ("time", *names) if not trajectory.has(name)]
    if missing:
        raise InputError(f"{who}: no column '{missing[0]}'; it cannot be measured without")
    if len(trajectory) == 0:
        raise InputError(f"{who}: the trajectory holds no samples")
    for name in ("time", *names):
        values = trajectory[name] if name in trajectory.columns else trajectory.stack(name)
        bad = np.flatnonzero(~np.isfinite(values.reshape(len(values), -1)).all(axis=1))
        if bad.size:
            raise InputError(
                f"{who}: column '{name}' is not finite at sample {bad[0]}; cut the run before it"
            )
    if np.any(np.diff(trajectory.time) <= 0):
        raise InputError(f"{who}: time must increase from sample to sample")


def positive_number(trajectory: Trajectory, name: str) -> float | None:
    """Return a positive number from the metadata, or None where it is null or absent.

    Raises:
        InputError: something else stands there.
    """
    value = trajectory.metadata.get(name)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < np.inf:
        raise InputError(
            f"{label(trajectory)}: metadata {name} is {value!r}; it must be a positive number or null"
        )
    return float(value)


def segment_lengths(trajectory: Trajectory) -> tuple[float, float]:
    """Return the length of a segment that bends and that of its straight ends from the metadata, m.

    Raises:
        InputError: one of them is not there.
    """
    length, gap = (trajectory.metadata.get(name) for name in ("segment_length_m", "rigid_gap_m"))
    if length is None or gap is None:
        raise InputError(f"{label(trajectory)}: metadata segment_length_m or rigid_gap_m is missing")
    return float(length), float(gap)


def body_length(trajectory: Trajectory) -> float:
    """Return the body length from the metadata, m.

    Raises:
        InputError: it is not there.
    """
    length = positive_number(trajectory, "body_length_m")
    if length is None:
        raise InputError(
            f"{label(trajectory)}: metadata body_length_m is missing; distances are measured against it"
        )
    return length


def interpolant(trajectory: Trajectory, values: np.ndarray) -> CubicSpline:
    """Return the cubic spline through samples of a trajectory.

    Its error is of fourth order in the sample period, that of its antiderivative over a period smaller still.

    Args:
        trajectory: two samples or more.
        values: shape (samples, …).
    """
    # Imported here: half a second that nobody who only asks for the names of the metrics should pay.
    from scipy.interpolate import CubicSpline

    return CubicSpline(trajectory.time, values)
