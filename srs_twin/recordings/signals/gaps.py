"""Frame grid of a recording, and treatment of outliers and gaps in tracks."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from srs_twin.errors import InputError

MIN_FRAMES = 12
"""Minimum number of frames of a recording."""

_GRID_TOLERANCE = 0.2
"""Maximum deviation of a time step from a multiple of the frame period, in periods."""
_MAX_FRAMES_PER_ROW = 10
"""Maximum ratio of the number of frames in the grid to the number of file rows."""
_OVERFLOWS_S = 2.0**32 * np.array([1e-6, 1e-3])
"""Times after which 32-bit counters of microseconds and milliseconds overflow, s."""
_MAX_STEP_RATIO = 10.0
"""Maximum ratio of a step with an overflow to the median step."""
_MAX_RUN_CHANGES = 3.5
"""Maximum number of switches between runs per backward step.

In chronological order, a late block causes three switches: at its first row, after its
last row, and after the rows that overtook the block. Independent noise of the time
stamps caused up to 3.2 switches per backward step in 60,000 simulated recordings. Late
blocks that overlap caused more than 3.5 in up to 2 % of the simulated recordings.
"""
_MAX_BACKWARD = 0.05
"""Maximum fraction of backward steps in a file whose rows are not in random order."""
_MAX_REPEATED = 0.05
"""Maximum fraction of rows that are left out because they were sent again."""
_MAX_TIME = 1e9
"""Maximum time, above which the unit is probably wrong, s."""


@dataclass(frozen=True)
class FrameGrid:
    """Successive frames of a recording.

    Attributes:
        time: times in ascending order, s, shape (frames,).
        rows: file row of each frame, or −1 for a missing frame, shape (frames,).
    """

    time: np.ndarray
    rows: np.ndarray
    period: float
    corrections: tuple[str, ...]


def check_times(time: np.ndarray) -> None:
    """Raise an error if times are so large that their unit is probably wrong."""
    largest = float(np.abs(time).max())
    if largest > _MAX_TIME:
        raise InputError(
            f"the times reach {largest:.3g} s, so their unit is probably not s; state"
            " the unit in the name of the column (for example time_ms), or in a map"
            " (time: {column: NAME, unit: ms})"
        )


def time_order(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return the indices of the rows in chronological order, and notes.

    The indices do not include rows that were sent again. `values` contains the values
    of each row, shape (rows, …).

    Raises:
        InputError: the clock was probably set back, or its counter overflowed.
    """
    if not (np.diff(time) < 0).any():
        return np.arange(len(time)), []
    repeated = _sent_again(time, values)
    kept = np.flatnonzero(~repeated)
    notes = []
    if repeated.any():
        notes.append(
            f"{repeated.sum()} rows were left out, because they repeat the time and the"
            " values of an earlier row"
        )
    order = kept[np.argsort(time[kept], kind="stable")]
    steps = np.diff(time[kept])
    backward = int((steps < 0).sum())
    if not backward:
        return order, notes
    # A run is a sequence of rows without a backward step. Late rows seldom change the
    # run in chronological order, whereas the rows before and after a step of the clock
    # alternate.
    run = np.zeros(len(time), int)
    run[kept[1:]] = np.cumsum(steps < 0)
    changes = np.flatnonzero(np.diff(run[order]))
    gaps = np.diff(time[order])
    # When a counter overflows, its range is subtracted from a usual step.
    usual = np.median(gaps[gaps > 0])
    unwrapped = steps[:, None] + _OVERFLOWS_S
    overflow = (unwrapped > 0) & (unwrapped < _MAX_STEP_RATIO * usual)
    is_far = 2 * gaps[changes].max() > gaps.sum()
    is_rare = backward <= _MAX_BACKWARD * len(time)
    is_alternating = len(changes) > _MAX_RUN_CHANGES * backward
    if is_alternating or overflow.any() or (is_rare and is_far):
        k = int(np.argmin(steps))
        before, after = time[kept[k : k + 2]]
        raise InputError(
            f"the times go back from {before:.10g} s to {after:.10g} s after data"
            f" row {kept[k] + 1}, so the clock was probably set back, or rows were"
            " repeated; cut the file there, or correct the rows"
        )
    notes.append(
        f"the rows were not in chronological order ({backward} steps back) and were"
        " sorted"
    )
    return order, notes


def _sent_again(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the mask of rows that repeat the time and the values of an earlier row.

    Repeated rows with constant values are not included, because a clock that was set
    back may also produce them. However, such a clock returns to all times up to the
    latest one. If the times continue after the latest time, the values must therefore
    change only between the earlier row and its repetition.
    """
    rows = np.column_stack([time, values.reshape(len(time), -1)])
    # np.unique would treat equal rows with NaN as different.
    rows = np.where(np.isnan(rows), np.inf, rows)
    _, first, group = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    earlier = first[group.ravel()]
    latest = np.maximum.accumulate(time)
    repeated = earlier < np.arange(len(time))
    for begin, end in runs(repeated):
        compared = rows[begin:end, 1:]
        if end < len(time) and time[end] > latest[begin]:
            compared = rows[earlier[begin] : end, 1:]
        if (compared == compared[0]).all():
            repeated[begin:end] = False
    if repeated.mean() > _MAX_REPEATED:
        repeated[:] = False
    return repeated


def distinct_rows(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return the indices of the rows in order of increasing times, and notes.

    Of several rows with equal times, only the first one is included.
    """
    check_times(time)
    order, notes = time_order(time, values)
    step = np.diff(time[order])
    period = 0.0
    if (step > 0).any():
        period = float(np.median(step[step > 0]))
    kept = np.concatenate([[True], step > 1e-3 * period])
    if not kept.all():
        notes.append(
            f"{int((~kept).sum())} rows were left out, because they repeat the time of"
            " another row"
        )
    return order[kept], notes


def frame_grid(time: np.ndarray, values: np.ndarray) -> FrameGrid:
    """Sort rows by time and insert the missing frames.

    `time` contains the finite time of each row, s, shape (rows,). `values` contains the
    values of each row, shape (rows, …).
    """
    rows, notes = distinct_rows(time, values)
    ordered = time[rows]
    if len(rows) < MIN_FRAMES:
        raise InputError(
            f"the recording has {len(rows)} frames, but at least {MIN_FRAMES} are"
            " needed"
        )
    period = float(np.median(np.diff(ordered)))
    return FrameGrid(*_on_grid(ordered, rows, period, notes), period, tuple(notes))


def _on_grid(
    time: np.ndarray, rows: np.ndarray, period: float, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    steps = np.diff(time)
    whole = np.rint(steps / period)
    if np.abs(steps - whole * period).max() > _GRID_TOLERANCE * period:
        if np.abs(steps / period - 1).max() > _GRID_TOLERANCE:
            notes.append(
                "the frames are not evenly spaced in time, and their times are kept"
            )
        return time, rows
    indices = np.append(0, np.cumsum(whole)).astype(int)
    count = int(indices[-1]) + 1
    if count > _MAX_FRAMES_PER_ROW * len(rows):
        worst = int(np.argmax(steps))
        raise InputError(
            f"the recording has {len(rows)} of {count} frames, and none between"
            f" {time[worst]:g} s and {time[worst + 1]:g} s; cut the recording there"
        )
    if missing := count - len(rows):
        notes.append(
            f"{missing} frames are missing in the file and were inserted without"
            " markers"
        )
        every = np.full(count, -1)
        every[indices] = rows
        time = np.interp(np.arange(count), indices, time)
        rows = every
    return time, rows


def at_frames(values: np.ndarray, frames: FrameGrid) -> np.ndarray:
    """Return the values at all frames, with NaN at missing frames."""
    picked = values[frames.rows]
    picked[frames.rows < 0] = np.nan
    return np.asarray(picked)


_NEIGHBOURS = np.array([-2, -1, 1, 2])
"""Indices of the samples that predict a sample, relative to this sample."""
_OUTLIER_RATIO = 8.0
"""Minimum deviation of an outlier from its prediction, in standard deviations."""
_STD_PER_MAD = 1.4826
"""Ratio of standard deviation to median absolute deviation of a normal variable."""


def outliers(points: np.ndarray, min_jump: float) -> np.ndarray:
    """Return the mask of isolated outliers, shape (frames, tracks).

    `min_jump` is the minimum distance of an outlier from its track, m.
    """
    result = np.zeros(points.shape[:2], dtype=bool)
    for track in range(points.shape[1]):
        frames = np.flatnonzero(~np.isnan(points[:, track, 0]))
        if len(frames) > 2 * len(_NEIGHBOURS):
            result[frames, track] = _track_outliers(
                frames, points[frames, track], min_jump
            )
    return result


def _track_outliers(
    frames: np.ndarray, points: np.ndarray, min_jump: float
) -> np.ndarray:
    """Return the mask of outliers in one track, shape (samples,).

    The residuals r = A p are the deviations of the samples p from cubic polynomials.
    Each polynomial passes through the two samples before and the two samples after the
    tested sample. The error of a polynomial is proportional to the product of the four
    time differences between these samples and the tested sample. Each row of A is
    divided by this product, relative to the product of 4 frames⁴ without gaps. An
    outlier of size d at sample k adds d a_k to the residuals, where a_k is column k of
    A. Therefore |a_k·r| / |a_k| has its maximum at the outlier, and |a_k·r| / |a_k|² is
    the size of the outlier.
    """
    from scipy.ndimage import maximum_filter1d
    from scipy.sparse import csr_array

    middle = np.arange(2, len(frames) - 2)
    neighbours = middle[:, None] + _NEIGHBOURS
    time = (frames[neighbours] - frames[middle, None]).astype(float)
    # The weights follow from Lagrange interpolation at time 0.
    weight = -np.ones_like(time)
    for k, other in permutations(range(len(_NEIGHBOURS)), 2):
        weight[:, k] *= time[:, other] / (time[:, other] - time[:, k])
    rows = (
        np.column_stack([weight, np.ones(len(middle))])
        * (4 / np.abs(time.prod(axis=1)))[:, None]
    )
    columns = np.column_stack([neighbours, middle])
    cubics = csr_array(
        (rows.ravel(), columns.ravel(), 5 * np.arange(len(middle) + 1)),
        (len(middle), len(frames)),
    )
    # For every sample k, `projection` is |a_k·r| and `size` is |a_k|. `cubics` is A.
    projection = np.linalg.norm(cubics.T @ (cubics @ points), axis=1)
    size = np.sqrt((cubics**2).sum(axis=0))
    score = projection / size
    usual = np.median(score[score > 0]) if (score > 0).any() else 0.0
    peak = maximum_filter1d(score, 9, mode="constant")
    large = projection > min_jump * size**2
    outlier = large & (score > _OUTLIER_RATIO * _STD_PER_MAD * usual) & (score >= peak)
    # The first two and the last two samples cannot be tested, because they affect too
    # few polynomials. Their scores are included in the peak, so that their errors do
    # not affect other samples.
    outlier[[0, 1, -2, -1]] = False
    return np.asarray(outlier)


def runs(missing: np.ndarray) -> np.ndarray:
    """Return the start and the exclusive end of each run of True, shape (runs, 2)."""
    edges = np.flatnonzero(
        np.diff(np.concatenate([[False], missing, [False]]).astype(np.int8))
    )
    return edges.reshape(-1, 2)


def longest_complete(time: np.ndarray, points: np.ndarray, longest: float) -> slice:
    """Return the longest interval without long gaps.

    All tracks are visible in the first and the last frame of the interval. `longest` is
    the maximum time between the samples before and after a gap, s.
    """
    allowed = np.ones(len(time), dtype=bool)
    visible = ~np.isnan(points[..., 0])
    for column in visible.T:
        for begin, end in runs(~column):
            inner = begin > 0 and end < len(time)
            if not inner or time[end] - time[begin - 1] > longest + 1e-9:
                allowed[begin:end] = False
    complete = visible.all(axis=1)
    best = slice(0, 0)
    for begin, end in runs(allowed):
        full = np.flatnonzero(complete[begin:end])
        if full.size and full[-1] - full[0] + 1 > best.stop - best.start:
            best = slice(int(begin + full[0]), int(begin + full[-1]) + 1)
    return best


def fill_gaps(time: np.ndarray, points: np.ndarray, degree: int) -> np.ndarray:
    """Interpolate gaps in tracks whose first and last positions are known.

    Tracks with at most `degree` samples are interpolated linearly.
    """
    from scipy.interpolate import make_interp_spline

    result = points.copy()
    for track, missing in zip(
        result.swapaxes(0, 1), np.isnan(points[..., 0]).T, strict=True
    ):
        if missing.any():
            own_degree = degree if (~missing).sum() > degree else 1
            track[missing] = make_interp_spline(
                time[~missing], track[~missing], own_degree
            )(time[missing])
    return result
