r"""Joining a captured motion and a log of its air on one clock, from the bends that both tell of.

The log's valves drive the chambers of the robot (or its pressures the free bends), which gives bends b̂_j.
Against the measured b_j, shifted by τ, with a gain a_j > 0 and an offset c_j of each segment's own,

$$ S(\tau) = \sum_j \min_{a_j, c_j} \sum_t \bigl(b_j(t) - a_j\,\hat b_j(t - \tau) - c_j\bigr)^2, $$

over the times that both cover, found for all τ at once by Fourier transforms; the least of S, a parabola
through it and its two neighbours, is the offset. Its standard error is √(2 s²/S''), with s² the residual's
variance per independent sample. A gait repeats itself: where another τ fits nearly as well, no offset is
given.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.pneumatics import LagPneumatics
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.recordings.body.trajectories import numbered
from srs_twin.recordings.recording import Recording, named_in_errors
from srs_twin.recordings.signals.gaps import LEAST_FRAMES
from srs_twin.recordings.signals.logs import SIDES
from srs_twin.recordings.signals.valve_log import ValveLog
from srs_twin.robot.spec import RobotSpec

LEAST_OVERLAP = 0.5
"""Of the shorter recording: how much both must cover."""

CLEAR = 1.5
"""How many times as large S must be at the next best offset."""

EXPLAINED = 0.5
"""Of the variance: what the best offset must explain."""

_FINEST = 1 / 500  # s
_MOST = 1 << 20  # samples


@dataclass(frozen=True)
class Offset:
    """What to add to a log's times.

    Attributes:
        seconds: s.
        error: standard error, s; 0 where it was given. What the chambers' model lags too much or too little
            is not in it.
        explained: share of the bends' variance that the log explains at this offset; 1 where it was given.
        estimated: whether it was estimated.
    """

    seconds: float
    error: float
    explained: float
    estimated: bool


def estimate_offset(
    time: np.ndarray, measured: np.ndarray, log_time: np.ndarray, driven: np.ndarray
) -> Offset:
    """Estimate what to add to a log's times.

    Args:
        time: of the motion, ascending, shape (frames,), s.
        measured: bends, shape (frames, segments), rad.
        log_time: of the log, evenly spaced, shape (rows,), s.
        driven: bends that the log's air would give, shape (rows, segments), rad.

    Raises:
        InputError: nothing to compare, no offset fits, or several do.
    """
    step = max(_FINEST, float(np.median(np.diff(time))) / 2)
    spans = (time[-1] - time[0], log_time[-1] - log_time[0])
    if sum(spans) / step > _MOST:
        step = sum(spans) / _MOST
    least = int(LEAST_OVERLAP * min(spans) / step)
    if least < 8:
        raise InputError("too short to find its offset; give --offset")
    bends = _resampled(time, measured, step)
    model = _resampled(log_time, driven, step)
    if model.std(axis=0).max() < 1e-6 or bends.std(axis=0).max() < 1e-6:
        raise InputError("nothing moves, so its offset cannot be found; give --offset")
    loss, lags, count = _losses(bends, model, least)
    best = int(np.argmin(loss))
    explained = 1 - float(loss[best])
    zero = time[0] - log_time[0]
    if explained < EXPLAINED:
        raise InputError(
            f"no offset explains the bends (the best {100 * explained:.0f} % of their variance, "
            f"{100 * EXPLAINED:.0f} % is wanted); is it the log of this run, and of this robot? Give --offset"
        )
    _refuse_ambiguous(loss, lags * step + zero, best)
    error, shift = float("inf"), 0.0
    # The parabola through the least and its neighbours.
    left, here, right = np.pad(loss, 1, constant_values=np.inf)[best : best + 3]
    curve = float(left - 2 * here + right) if np.isfinite(left + right) else 0.0
    if curve > 0:
        shift = float(np.clip((left - right) / (2 * curve), -0.5, 0.5))
        independent = max(1.0, count[best] * bends.shape[1] * _independent(bends, model, int(lags[best])))
        error = float(step * np.sqrt(2 * loss[best] / independent / curve))
    return Offset(float(zero + (lags[best] + shift) * step), error, explained, True)


def _resampled(time: np.ndarray, values: np.ndarray, step: float) -> np.ndarray:
    grid = time[0] + step * np.arange(int((time[-1] - time[0]) / step + 1e-9) + 1)
    return np.stack([np.interp(grid, time, column) for column in values.T], axis=1)


def _losses(bends: np.ndarray, model: np.ndarray, least: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return S over the variance, the lags (steps by which the model comes later), and samples in common."""
    from scipy.signal import fftconvolve

    def against(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(fftconvolve(a, b[::-1], axes=0))

    bends, model = bends - bends.mean(axis=0), model - model.mean(axis=0)
    ones, other_ones = np.ones((len(bends), 1)), np.ones((len(model), 1))
    count = np.rint(against(ones, other_ones))[:, 0]
    enough = count >= least
    n = np.maximum(count, 1.0)[:, None]
    sb, sm = against(bends, other_ones), against(ones, model)
    bb = against(bends**2, other_ones) - sb**2 / n
    mm = against(ones, model**2) - sm**2 / n
    bm = against(bends, model) - sb * sm / n
    # A segment whose model does not move explains nothing; chambers never push the other way.
    moving = mm > 1e-9 * np.maximum(mm.max(axis=0), 1e-30)
    gained = np.where(moving & (bm > 0), bm**2 / np.where(moving, mm, 1.0), 0.0)
    energy = bb.sum(axis=1)
    quiet = energy < 1e-3 * energy[enough].max() * n[:, 0] / n.max()
    loss = np.where(enough & ~quiet, 1 - gained.sum(axis=1) / np.where(quiet, 1.0, energy), np.inf)
    lags = np.arange(-len(model) + 1, len(bends))
    return np.maximum(loss, 1e-12), lags, count


def _refuse_ambiguous(loss: np.ndarray, offsets: np.ndarray, best: int) -> None:
    """Refuse where another minimum is nearly as low."""
    low = (loss[1:-1] <= loss[:-2]) & (loss[1:-1] <= loss[2:]) & np.isfinite(loss[1:-1])
    # What noise and the grid may hide of the lowest is not told from it.
    limit = CLEAR * loss[best] + 1e-6

    others = [int(k) for k in np.flatnonzero(low) + 1 if loss[k] < limit and k != best]
    # Apart from it by a ridge.
    rivals = [k for k in others if loss[min(k, best) : max(k, best) + 1].max() > limit]
    if rivals:
        nearest = sorted(offsets[[best, *rivals]], key=lambda each: abs(each - offsets[best]))[:5]
        listed = ", ".join(f"{each:.4g}" for each in sorted(nearest))
        raise InputError(
            f"the offset of its clock is ambiguous, {len(rivals) + 1} fit about equally well ({listed} s, …)"
            ": a gait repeats itself, and neither its start nor its end is in view; give --offset, or a "
            "longer recording"
        )


def _independent(bends: np.ndarray, model: np.ndarray, lag: int) -> float:
    """Return the share of samples that are independent of each other, from how a sample tells the next.

    Samples of what the model, by a lag in steps, leaves of the bends.
    """
    first, last = max(0, lag), min(len(bends), lag + len(model))
    b, m = bends[first:last], model[first - lag : last - lag]
    b, m = b - b.mean(axis=0), m - m.mean(axis=0)
    residual = b - (b * m).sum(axis=0) / np.maximum((m * m).sum(axis=0), 1e-30) * m
    power = float((residual**2).sum())
    if power == 0:
        return 1.0
    correlation = float((residual[1:] * residual[:-1]).sum()) / power
    correlation = min(max(correlation, 0.0), 0.999)
    return (1 - correlation) / (1 + correlation)


_STEP = 0.002  # s, at which driven bends are looked at
_FORGOTTEN = 5.0  # time constants after which nobody can tell what a chamber held


def join(recording: Recording, log: ValveLog, spec: RobotSpec, *, offset: float | None = None) -> Recording:
    """Put a log's columns beside a captured motion.

    Args:
        recording: the motion.
        log: its valves or pressures.
        spec: the robot; its chambers turn valves into the bends that the offset is found from.
        offset: what to add to the log's times, s; None: what times since 1970 tell where both files have them
            and overlap, else estimated by `estimate_offset`. With such times in both it is added to theirs.

    Returns:
        The part of the motion that the log covers, with columns ``valve_plus_1…`` or ``pressure_plus_1…``,
        the offset in the metadata, and the log on the motion's clock.

    Raises:
        InputError: the two have no time in common, or the offset cannot be told.
    """
    trajectory = recording.trajectory
    if log.values.shape[1] != spec.segments or trajectory.stack("bend").shape[1] != spec.segments:
        raise InputError(
            f"{log.source}: the log or the motion is not of {spec.name}'s {spec.segments} segments"
        )
    if offset is not None and not np.isfinite(offset):
        raise InputError(f"offset {offset!r} is not allowed; it must be finite")
    notes: list[str] = []
    known = None
    if recording.epoch_ns is not None and log.epoch_ns is not None:
        known = (log.epoch_ns - recording.epoch_ns) / 1e9
        begin, end = log.time[[0, -1]] + known
        if offset is None and min(end, trajectory.time[-1]) - max(begin, trajectory.time[0]) <= 0:
            notes.append(f"{log.source}: by times since 1970 it is {known:.6g} s away: these are not used")
            known = None
    found = Offset((known or 0.0) + (offset or 0.0), 0.0, 1.0, False)
    if known is None and offset is None:
        clock, driven = driven_bends(log, spec)
        with named_in_errors(log.source):
            found = estimate_offset(trajectory.time, trajectory.stack("bend"), clock, driven)
    moved = log.shifted(found.seconds)
    time = trajectory.time
    covered = (time >= moved.time[0] - 1e-9) & (time <= moved.time[-1] + 1e-9)
    if covered.sum() < LEAST_FRAMES:
        raise InputError(
            f"{log.source}: with an offset of {found.seconds:g} s it goes from {moved.time[0]:g} to "
            f"{moved.time[-1]:g} s, the motion from {time[0]:g} to {time[-1]:g} s: {int(covered.sum())} "
            "frames in common"
        )
    columns = {name: column[covered] for name, column in trajectory.columns.items()}
    values = moved.at(columns["time"])
    for k, side in enumerate(SIDES):
        columns |= numbered(f"{log.kind}_{side}", values[..., k])
    start, end = (float(columns["time"][k]) for k in (0, -1))
    about = {**trajectory.metadata, "duration_s": end - start, "valve_log": _metadata(log, found)}
    joined = replace(trajectory, columns=columns, metadata=about)
    how = f"± {1e3 * found.error:.2g} ms, estimated" if found.estimated else "as given"
    if known is not None:
        how = "from times since 1970 in both files" + (f", and {offset:g} s as given" if offset else "")
    notes += [f"{log.source}: {len(log.time)} rows of {log.kind}s; offset {found.seconds:.4f} s ({how})"]
    if not covered.all():
        notes.append(f"{int((~covered).sum())} frames that the log does not cover left out")
    notes += [f"{log.source}: {each}" for each in log.corrections]
    corrections = (*recording.summary.corrections, *notes)
    summary = replace(
        recording.summary, frames_kept=len(joined), start=start, end=end, corrections=corrections
    )
    return Recording(joined, summary, moved, recording.epoch_ns)


def driven_bends(log: ValveLog, spec: RobotSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return times (times,), s, and the bends of free segments by a log's air, (times, segments), rad.

    Where a log of valves begins while chambers fill, what was in them is not known: the bends begin when that
    is forgotten.
    """
    span = float(log.time[-1] - log.time[0])
    step = max(_STEP, span / 1e6)
    clock = step * np.arange(int(span / step + 1e-9) + 1)
    if log.kind == "pressure":
        # Bends follow pressures by τ₂, which for what is slower is a delay.
        bends = air_bend(spec, log.at(log.time[0] + clock))
        return log.time[0] + clock + spec.actuator.tau_mode, np.asarray(bends)
    chambers = LagPneumatics(spec, supply_pa=spec.supply.nominal, layout="in_out")
    trace = chambers.advance(log.schedule(), clock)
    empty = (log.values[0] == -1).all()
    forgotten = 0.0 if empty else _FORGOTTEN * max(spec.actuator.tau_fill, spec.actuator.tau_vent)
    known = clock >= forgotten
    if known.sum() < LEAST_FRAMES:
        raise InputError(f"{log.source}: {span:g} s are too short to find its offset; give --offset")
    return log.time[0] + clock[known], trace.bend[known]


def _metadata(log: ValveLog, found: Offset) -> dict[str, object]:
    return {
        "file": log.source.replace("\\", "/").rpartition("/")[2],
        "sha256": log.sha256,
        "kind": log.kind,
        "offset_s": found.seconds,
        "offset_error_s": found.error if np.isfinite(found.error) else None,
        "offset_estimated": found.estimated,
        "bends_explained": found.explained,
        "corrections": list(log.corrections),
    }
