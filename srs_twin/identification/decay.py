"""Recordings of a segment that is bent, released, and then swings freely.

A recording is a CSV file with the columns ``time_s`` and ``bend_rad`` (or
``bend_deg``), sampled at 100 Hz or more. The optional columns ``pressure_plus_kpa`` and
``pressure_minus_kpa`` contain the gauge pressures of closed chambers.

By default, the free swing begins at the maximum bend rate, about a quarter of a period
after the release. The fitted interval is twice as long as the interval in which the
half swings are visible above the noise.

The rows of the trajectory matrix are windows of successive bends. The noise is
estimated from the third smallest singular value of this matrix. Without noise, this
value would be 0, because successive samples of a free swing satisfy a linear
recurrence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from srs_twin.errors import InputError, named_in_errors
from srs_twin.identification.estimate import Role
from srs_twin.identification.fit_file import DataSet
from srs_twin.io.files import StrPath
from srs_twin.recordings.csv_table import CLOCK, not_used, read_table
from srs_twin.recordings.recorded_file import read_file
from srs_twin.recordings.signals.gaps import distinct_rows
from srs_twin.recordings.signals.logs import check_values
from srs_twin.recordings.signals.units import ANGLES, PRESSURES

DECAY_COLUMNS = "time_s,bend_rad"
"""Header line of a recording of a free swing."""

_NEEDED = f"a recording of a decay has the columns {DECAY_COLUMNS}"

_MIN_RATE_HZ = 100.0
_MIN_SAMPLES = 20
_MIN_SAMPLES_PER_SWING = 5.0
_MIN_HALF_SWINGS = 3

_MIN_TURN = 6.0
"""Minimum size of a visible half swing, in standard deviations of the noise."""

_MIN_SIZE = 12.0
"""Minimum range of the bends, in standard deviations of the noise.

Noise alone has a range of about 6 standard deviations.
"""

_MIN_TURN_FRACTION = 0.02
"""Minimum size of a visible half swing, as a fraction of the bend range."""

_LEAST_DECREMENT = 0.01
"""Minimum initial value of the logarithmic decrement in a search."""

_WINDOW = 12
"""Number of columns of the trajectory matrix.

This number must exceed the number of exponentials that describe a swing.
"""

_KEPT_SPANS = 2.0
"""Duration of the fitted interval divided by the duration of the visible swing."""

_MIN_CALM_SAMPLES = 5


@dataclass(frozen=True)
class Decay:
    """Free swing of a released segment.

    Attributes:
        time: times of the free swing, s, shape (samples,).
        bend: measured bends, rad, shape (samples,).
        before: bends recorded up to and including the first sample of the free swing,
            rad, shape (earlier samples + 1,).
        before_time: sample times of `before`, s.
        pressure: measured gauge pressures of the + and − chamber, Pa, shape (samples,
            2), or None if the pressures were not measured.
        noise: standard deviation of a measured bend, rad.
        half_period: mean time between successive turning points, s.
        log_decrement: mean logarithm of the ratio of two successive half swings.
        corrections: notes on corrected and ignored data of the recording.
    """

    name: str
    sha256: str
    time: np.ndarray
    bend: np.ndarray
    before: np.ndarray
    before_time: np.ndarray
    pressure: np.ndarray | None
    noise: float
    half_period: float
    log_decrement: float
    corrections: tuple[str, ...] = ()

    @property
    def pulsation(self) -> float:
        """Approximate angular frequency ω, rad/s."""
        return math.pi / self.half_period

    def first_state(self) -> tuple[float, float]:
        """Return the bend (rad) and bend rate (rad/s) at the first sample."""
        first = self.time <= self.time[0] + 2 * self.half_period
        phase = self.pulsation * (self.time[first] - self.time[0])
        sine = np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)], axis=1)
        mean, at_start, forward = np.linalg.lstsq(sine, self.bend[first], rcond=None)[0]
        return float(mean + at_start), float(forward) * self.pulsation

    def text(self) -> str:
        """Describe the free swing in one line, followed by the corrections."""
        line = (
            f"{self.name}: free swing from {self.time[0]:.3f} to {self.time[-1]:.3f} s,"
            f" about {0.5 / self.half_period:.3g} Hz, noise {self.noise:.2g} rad"
        )
        return "\n".join([line, *(f"corrected: {text}" for text in self.corrections)])

    def data_set(self, role: Role) -> DataSet:
        """Return the name, hash and size of the free swing."""
        return DataSet(
            self.name,
            self.sha256,
            role,
            len(self.time),
            float(self.time[0]),
            float(self.time[-1]),
        )


def read_decay(
    path: StrPath, *, start: float | None = None, noise: float | None = None
) -> Decay:
    """Read a recording and extract its free swing.

    The free swing starts at the time `start` (s), by default the time of the maximum
    bend rate. The standard deviation `noise` of a recorded bend (rad) is estimated by
    default.
    """
    pressures = dict.fromkeys(("pressure_plus", "pressure_minus"), PRESSURES)
    table = read_table(read_file(path), CLOCK | {"bend": ANGLES} | pressures)
    file = table.file
    by_name = {column.name: column for column in table.columns if not column.number}
    if "bend" not in by_name:
        raise file.error(f"the column 'bend_rad' is missing; {_NEEDED}", 1)
    measured = [name for name in pressures if name in by_name]
    if len(measured) == 1:
        raise file.error(
            f"only the column '{measured[0]}' is given; give the pressures of both"
            " chambers, or of none",
            1,
        )
    clock = table.clock(f"the time column is missing; {_NEEDED}")
    chosen = [by_name[name] for name in ("bend", *measured)]
    rows = table.read_timed(clock, chosen)
    check_values(table, chosen, rows.values)
    known = np.isfinite(rows.values).all(axis=1)
    if (count := known.sum()) < _MIN_SAMPLES:
        raise file.error(
            f"the recording has {count} samples, but at least {_MIN_SAMPLES} are needed"
        )
    time = rows.time[known]
    values = rows.values[known]
    with named_in_errors(file.name):
        order, moved = distinct_rows(time, values)
    time = time[order]
    values = values[order]
    rate = 1 / float(np.median(np.diff(time)))
    if rate < _MIN_RATE_HZ * (1 - 1e-3):
        raise file.error(
            f"the recording has {rate:.3g} samples per second, but at least"
            f" {_MIN_RATE_HZ:g} are needed; record faster"
        )
    decay = free_swing(
        file.name,
        file.sha256,
        time,
        values[:, 0],
        values[:, 1:] if measured else None,
        start=start,
        noise=noise,
    )
    notes = (*rows.notes, *moved, *not_used(table.unused))
    return replace(decay, corrections=notes)


def free_swing(
    name: str,
    sha256: str,
    time: np.ndarray,
    bend: np.ndarray,
    pressure: np.ndarray | None = None,
    *,
    start: float | None = None,
    noise: float | None = None,
) -> Decay:
    """Extract the free swing from recorded bends (rad) and gauge pressures (Pa)."""
    noise = _noise(bend) if noise is None else noise
    if start is None:
        first = int(np.argmax(np.abs(np.diff(bend) / np.diff(time)))) + 1
    else:
        first = int(np.searchsorted(time, start))
    if first >= len(time):
        raise InputError(
            f"{name}: the recording ends at {time[-1]:g} s, before the free swing"
            f" starts at {start:g} s"
        )
    turns = _visible_turns(name, bend, first, noise)
    half_period = float(time[turns[-1]] - time[turns[0]]) / (len(turns) - 1)
    spacing = float(np.median(np.diff(time)))
    if 2 * half_period < _MIN_SAMPLES_PER_SWING * spacing:
        raise InputError(
            f"{name}: the recording has {2 * half_period / spacing:.2g} samples per"
            f" swing, but at least {_MIN_SAMPLES_PER_SWING:g} are needed; record"
            " faster"
        )
    end = time[first] + _KEPT_SPANS * (time[turns[-1]] - time[first])
    used = slice(first, int(np.searchsorted(time, end, side="right")))
    if len(time[used]) < _MIN_SAMPLES:
        raise InputError(
            f"{name}: the recording has {len(time[used])} samples of free swing, but"
            f" at least {_MIN_SAMPLES} are needed; record longer or faster"
        )
    swings = np.abs(np.diff(bend[turns]))
    decrements = np.log(swings[:-1] / swings[1:])
    return Decay(
        name,
        sha256,
        time[used],
        bend[used],
        before=bend[: first + 1],
        before_time=time[: first + 1],
        pressure=None if pressure is None else pressure[used],
        noise=noise,
        half_period=half_period,
        log_decrement=max(float(np.mean(decrements)), _LEAST_DECREMENT),
    )


def _visible_turns(name: str, bend: np.ndarray, first: int, noise: float) -> list[int]:
    size = float(np.ptp(bend[max(first - 1, 0) :]))
    threshold = max(_MIN_TURN * noise, _MIN_TURN_FRACTION * size)
    if size <= _MIN_SIZE * noise:
        raise InputError(
            f"{name}: the amplitude is not above the noise ({noise:.2g} rad); release"
            " the segment from a larger bend"
        )
    turns = [first + turn for turn in _turning_points(bend[first:], threshold)]
    if len(turns) < _MIN_HALF_SWINGS:
        raise InputError(
            f"{name}: the recording has {len(turns)} visible half swings, but at least"
            f" {_MIN_HALF_SWINGS} are needed; hang a heavier body, or record longer"
            " (an overdamped decay determines only the product k T)"
        )
    return turns


def _noise(bend: np.ndarray) -> float:
    windows = sliding_window_view(bend - bend.mean(), _WINDOW)
    singular = np.linalg.svd(windows, compute_uv=False)
    return max(float(singular[-3]) / math.sqrt(len(windows)), 1e-9)


def _turning_points(bend: np.ndarray, threshold: float) -> list[int]:
    turns: list[int] = []
    extreme = 0
    direction = 0.0
    for k, value in enumerate(bend):
        ahead = (value - bend[extreme]) * direction
        if direction == 0.0 and abs(value - bend[0]) > threshold:
            extreme = k
            direction = math.copysign(1.0, value - bend[0])
        elif ahead > 0:
            extreme = k
        elif ahead < -threshold:
            turns.append(extreme)
            extreme = k
            direction = -direction
    return turns


def calm_samples(decay: Decay) -> int:
    """Return the number of initial samples at which the segment is at rest."""
    moved = (
        np.abs(decay.before - np.median(decay.before[:_MIN_CALM_SAMPLES]))
        > _MIN_TURN * decay.noise
    )
    calm = int(np.argmax(moved)) if moved.any() else len(moved)
    held = decay.before[decay.before_time < decay.time[0] - decay.half_period]
    bent = float(np.abs(held - decay.before[0]).max(initial=0.0))
    if calm < _MIN_CALM_SAMPLES or bent < float(np.ptp(decay.bend)) / 4:
        raise InputError(
            f"{decay.name}: the recording with closed valves begins with a bent or"
            " moving segment. Close the valves at rest, start recording, and only"
            " then bend and release the segment, or record the pressures"
        )
    return calm
