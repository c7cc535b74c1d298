r"""Synchronisation of a recorded motion with a valve or pressure log.

From the valve states or pressures in the log, the chamber model of the robot computes
the bends b̂_j without load. For a delay τ, the loss function compares these modelled
bends with the measured bends b_j:

$$ S(\tau) = \sum_j \min_{a_j, c_j} \sum_t \bigl(b_j(t) - a_j\,\hat b_j(t - \tau) - c_j\bigr)^2, $$

where a_j > 0 is the gain and c_j the offset of segment j. The sum over t includes the
times that are covered by both the motion and the log. Fast Fourier transforms evaluate
S for all delays. A parabola is fitted to the smallest value of S and its two
neighbours, and the clock offset is the minimum of the parabola. The standard error of
the offset is √(2 s²/S''), where s² is the variance of the residual per independent
sample. An error is raised if S has several minima of similar size, which may occur for
a periodic gait.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError, named_in_errors
from srs_twin.pneumatics import LagPneumatics
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.recordings.body.trajectories import name_of, numbered_columns
from srs_twin.recordings.recording import Recording, ValveLog, interpolated_values
from srs_twin.recordings.signals.gaps import MIN_FRAMES
from srs_twin.recordings.signals.logs import SIDES
from srs_twin.robot.spec import RobotSpec

MIN_OVERLAP = 0.5
"""Minimum overlap of two recordings, as a fraction of the shorter recording."""

MIN_RIVAL_RATIO = 1.5
"""Minimum ratio of the second-smallest to the smallest minimum of S."""

MIN_EXPLAINED = 0.5
"""Minimum fraction of the bend variance that the best offset explains."""

_MIN_STEP = 1 / 500
"""Minimum step between delays, s."""
_MAX_SAMPLES = 1 << 20
_MODEL_STEP = 0.002
"""Time step of the modelled bends, s."""
_SETTLED_TIME_CONSTANTS = 5.0
"""Number of time constants after which unknown initial pressures have no effect."""


@dataclass(frozen=True)
class Offset:
    """Offset between the clocks of a motion and a log.

    Attributes:
        seconds: value to add to the times of the log, s.
        error: standard error of the offset, s, or 0 if the offset was given. Errors in
            the modelled lag of the chambers are not included.
        explained: fraction of the bend variance that the log explains, or 1 if the
            offset was given.
    """

    seconds: float
    error: float = 0.0
    explained: float = 1.0
    estimated: bool = False


def estimate_offset(
    time: np.ndarray, measured: np.ndarray, log_time: np.ndarray, driven: np.ndarray
) -> Offset:
    """Estimate the offset between the clocks of a motion and a log.

    `driven` contains the bends (rad) computed from the log at the times `log_time` (s).
    """
    step = max(_MIN_STEP, float(np.median(np.diff(time))) / 2)
    spans = (time[-1] - time[0], log_time[-1] - log_time[0])
    step = max(step, sum(spans) / _MAX_SAMPLES)
    min_count = int(MIN_OVERLAP * min(spans) / step)
    if min_count < 8:
        raise InputError(
            "the recording or the log is too short to estimate the clock offset; give"
            " the offset with --offset"
        )
    bends = _resampled(time, measured, step)
    model = _resampled(log_time, driven, step)
    if model.std(axis=0).max() < 1e-6 or bends.std(axis=0).max() < 1e-6:
        raise InputError(
            "the clock offset cannot be estimated, because nothing moves; give the"
            " offset with --offset"
        )
    loss, lags, count = _losses(bends, model, min_count)
    best = int(np.argmin(loss))
    explained = 1 - float(loss[best])
    start_difference = time[0] - log_time[0]
    if explained < MIN_EXPLAINED:
        raise InputError(
            "no clock offset explains the bends. The best offset explains"
            f" {100 * explained:.0f} % of the bend variance, but at least"
            f" {100 * MIN_EXPLAINED:.0f} % are needed; check that the log belongs to"
            " this run and to this robot, or give --offset"
        )
    _check_unambiguous(loss, lags * step + start_difference, best)
    error = float("inf")
    shift = 0.0
    left, middle, right = np.pad(loss, 1, constant_values=np.inf)[best : best + 3]
    # The curvature is infinite if a neighbour lies outside the compared delays.
    curvature = float(left - 2 * middle + right)
    if 0 < curvature < np.inf:
        shift = float(np.clip((left - right) / (2 * curvature), -0.5, 0.5))
        fraction = _independent_fraction(bends, model, int(lags[best]))
        independent = max(1.0, count[best] * bends.shape[1] * fraction)
        # The loss is S divided by the variance, so this expression equals √(2 s²/S'').
        error = float(step * np.sqrt(2 * loss[best] / independent / curvature))
    return Offset(
        float(start_difference + (lags[best] + shift) * step), error, explained, True
    )


def _grid(span: float, step: float) -> np.ndarray:
    return step * np.arange(int(span / step + 1e-9) + 1)


def _resampled(time: np.ndarray, values: np.ndarray, step: float) -> np.ndarray:
    grid = time[0] + _grid(time[-1] - time[0], step)
    return interpolated_values(grid, time, values)


def _losses(
    bends: np.ndarray, model: np.ndarray, min_count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return S relative to the variance, delays in steps, and common sample counts."""
    from scipy.signal import fftconvolve

    def correlate(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(fftconvolve(a, b[::-1], axes=0))

    bends = bends - bends.mean(axis=0)
    model = model - model.mean(axis=0)
    ones = np.ones((len(bends), 1))
    other_ones = np.ones((len(model), 1))
    count = np.rint(correlate(ones, other_ones))[:, 0]
    enough = count >= min_count
    n = np.maximum(count, 1.0)[:, None]
    # For each delay, the sums include the samples that motion and log have in common.
    # In names, b is the measured bend, m the modelled bend, and s a sum.
    sb = correlate(bends, other_ones)
    sm = correlate(ones, model)
    bb = correlate(bends**2, other_ones) - sb**2 / n
    mm = correlate(ones, model**2) - sm**2 / n
    bm = correlate(bends, model) - sb * sm / n
    # A segment explains no variance if it does not move in the model or if its fitted
    # gain is not positive.
    moving = mm > 1e-9 * np.maximum(mm.max(axis=0), 1e-30)
    explained = np.where(moving & (bm > 0), bm**2 / np.where(moving, mm, 1.0), 0.0)
    energy = bb.sum(axis=1)
    # Intervals in which the robot hardly moves are excluded, because any model would
    # fit them.
    quiet = energy < 1e-3 * energy[enough].max() * n[:, 0] / n.max()
    loss = np.where(
        enough & ~quiet,
        1 - explained.sum(axis=1) / np.where(quiet, 1.0, energy),
        np.inf,
    )
    lags = np.arange(-len(model) + 1, len(bends))
    return np.maximum(loss, 1e-12), lags, count


def _check_unambiguous(loss: np.ndarray, offsets: np.ndarray, best: int) -> None:
    low = (loss[1:-1] <= loss[:-2]) & (loss[1:-1] <= loss[2:]) & np.isfinite(loss[1:-1])
    # If S is close to 0, the added constant accounts for noise and for the delay step.
    limit = MIN_RIVAL_RATIO * loss[best] + 1e-6
    others = [int(k) for k in np.flatnonzero(low) + 1 if loss[k] < limit and k != best]
    # Two minima are counted as one if no loss between them exceeds the limit.
    rivals = [k for k in others if loss[min(k, best) : max(k, best) + 1].max() > limit]
    if rivals:
        nearest = sorted(
            offsets[[best, *rivals]], key=lambda offset: abs(offset - offsets[best])
        )[:5]
        listed = ", ".join(f"{offset:.4g}" for offset in sorted(nearest))
        raise InputError(
            "the clock offset is ambiguous, because the gait is periodic and neither"
            f" its start nor its end is recorded. {len(rivals) + 1} offsets fit about"
            f" equally well ({listed} s, …); give --offset, or a longer recording"
        )


def _independent_fraction(bends: np.ndarray, model: np.ndarray, lag: int) -> float:
    first = max(0, lag)
    last = min(len(bends), lag + len(model))
    b = bends[first:last]
    m = model[first - lag : last - lag]
    b = b - b.mean(axis=0)
    m = m - m.mean(axis=0)
    residual = b - (b * m).sum(axis=0) / np.maximum((m * m).sum(axis=0), 1e-30) * m
    power = float((residual**2).sum())
    if power == 0:
        return 1.0
    correlation = float((residual[1:] * residual[:-1]).sum()) / power
    correlation = min(max(correlation, 0.0), 0.999)
    return (1 - correlation) / (1 + correlation)


def join(
    recording: Recording, log: ValveLog, spec: RobotSpec, *, offset: float | None = None
) -> Recording:
    """Synchronise a log with a motion, and add the logged columns to the motion.

    If both files contain Unix times, the difference between these times is added to
    `offset`. If `offset` is None and the files have no overlapping Unix times,
    `estimate_offset` estimates the offset.

    Args:
        recording: recorded motion.
        log: valve or pressure log.
        spec: robot whose chamber model computes bends from the log.
        offset: value to add to the times of the log, s, or None to determine it from
            the files.

    Returns:
        Recording of the part of the motion that the log covers, with the log on the
        clock of the motion. The trajectory also has the columns ``valve_plus_1…`` or
        ``pressure_plus_1…``, and its metadata contain the offset.
    """
    trajectory = recording.trajectory
    logged = log.values.shape[1]
    moving = trajectory.stack("bend").shape[1]
    if {logged, moving} != {spec.segments}:
        raise InputError(
            f"{log.source}: {spec.name} has {spec.segments} segments, but the log has"
            f" {logged} and the motion {moving}"
        )
    if offset is not None and not np.isfinite(offset):
        raise InputError(f"offset {offset!r} is not allowed; it must be finite")
    found = _find_offset(recording, log, spec, offset)
    moved = log.shifted(found.offset.seconds)
    covered = _covered(trajectory.time, moved, found.offset.seconds)
    columns = {name: column[covered] for name, column in trajectory.columns.items()}
    values = moved.at(columns["time"])
    for k, side in enumerate(SIDES):
        columns |= numbered_columns(f"{log.kind}_{side}", values[..., k])
    start, end = columns["time"][[0, -1]].tolist()
    metadata = {
        **trajectory.metadata,
        "duration_s": end - start,
        "valve_log": _metadata(log, found.offset),
    }
    notes = [
        *found.notes,
        f"{log.source}: {len(log.time)} rows of {log.kind}s; offset"
        f" {found.offset.seconds:.4f} s ({found.how})",
    ]
    if not covered.all():
        notes.append(f"{int((~covered).sum())} frames outside the log were left out")
    notes += [f"{log.source}: {text}" for text in log.corrections]
    summary = replace(
        recording.summary,
        frames_kept=len(columns["time"]),
        start=start,
        end=end,
        corrections=(*recording.summary.corrections, *notes),
    )
    joined = replace(trajectory, columns=columns, metadata=metadata)
    return Recording(joined, summary, moved, recording.epoch_ns)


def _covered(time: np.ndarray, log: ValveLog, offset: float) -> np.ndarray:
    start, end = log.time[[0, -1]]
    covered = (time >= start - 1e-9) & (time <= end + 1e-9)
    if covered.sum() < MIN_FRAMES:
        raise InputError(
            f"{log.source}: with an offset of {offset:g} s, the log covers {start:g}"
            f" to {end:g} s and the motion {time[0]:g} to {time[-1]:g} s, so they have"
            f" only {int(covered.sum())} frames in common; check the offset and the"
            " files"
        )
    return np.asarray(covered)


class _FoundOffset(NamedTuple):
    offset: Offset
    how: str
    notes: list[str]


def _find_offset(
    recording: Recording, log: ValveLog, spec: RobotSpec, offset: float | None
) -> _FoundOffset:
    time = recording.trajectory.time
    notes = []
    if recording.epoch_ns is not None and log.epoch_ns is not None:
        difference = (log.epoch_ns - recording.epoch_ns) / 1e9
        begin, end = log.time[[0, -1]] + difference
        if offset is not None or min(end, time[-1]) > max(begin, time[0]):
            how = "from times since 1970 in both files"
            if offset:
                how += f", plus {offset:g} s as given"
            return _FoundOffset(Offset(difference + (offset or 0.0)), how, [])
        notes.append(
            f"{log.source}: the times since 1970 are not used, because they differ by"
            f" {difference:.6g} s from the times of the motion"
        )
    if offset is not None:
        return _FoundOffset(Offset(offset or 0.0), "as given", notes)
    clock, driven = driven_bends(log, spec)
    with named_in_errors(log.source):
        bends = recording.trajectory.stack("bend")
        estimate = estimate_offset(time, bends, clock, driven)
    how = f"± {1e3 * estimate.error:.2g} ms, estimated"
    return _FoundOffset(estimate, how, notes)


def driven_bends(log: ValveLog, spec: RobotSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return the times (s) and the bends without load (rad) computed from a log.

    Unless all chambers vent at the start of a valve log, the initial pressures are
    unknown. In this case, the bends start after the effect of these pressures has
    decayed.
    """
    span = float(log.time[-1] - log.time[0])
    step = max(_MODEL_STEP, span / 1e6)
    clock = _grid(span, step)
    if log.kind == "pressure":
        # For slow signals, the lag of the bends is equivalent to a delay of τ₂.
        bends = air_bend(spec, log.at(log.time[0] + clock))
        return log.time[0] + clock + spec.actuator.tau_mode, np.asarray(bends)
    chambers = LagPneumatics(spec, supply_pa=spec.supply.nominal, layout="in_out")
    trace = chambers.advance(log.schedule(), clock)
    empty = (log.values[0] == -1).all()
    longest = max(spec.actuator.tau_fill, spec.actuator.tau_vent)
    settled = 0.0 if empty else _SETTLED_TIME_CONSTANTS * longest
    known = clock >= settled
    if known.sum() < MIN_FRAMES:
        raise InputError(
            f"{log.source}: the log lasts only {span:g} s, which is too short to"
            " estimate the clock offset; give the offset with --offset"
        )
    return log.time[0] + clock[known], trace.bend[known]


def _metadata(log: ValveLog, estimate: Offset) -> dict[str, object]:
    return {
        "file": name_of(log.source),
        "sha256": log.sha256,
        "kind": log.kind,
        "offset_s": estimate.seconds,
        "offset_error_s": estimate.error if np.isfinite(estimate.error) else None,
        "offset_estimated": estimate.estimated,
        "bends_explained": estimate.explained,
        "corrections": list(log.corrections),
    }
