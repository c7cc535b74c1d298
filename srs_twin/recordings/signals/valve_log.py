"""Log of valve states or pressures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.pneumatics import Schedule


@dataclass(frozen=True)
class ValveLog:
    """Log of valve states or pressures.

    Attributes:
        kind: "valve" or "pressure".
        time: ascending, shape (rows,), s.
        values: valve states, which hold until the next row, or gauge pressures (Pa), shape (rows, segments,
            2), columns + and − chamber.
        source: name of the file.
        sha256: checksum of the file.
        corrections: texts on sorting, conversions and assumptions.
        epoch_ns: time since 1970 at 0 s, ns; None if the clock of the file is another one.
        holds: whether pressures hold until the next row, as set points do; otherwise they are interpolated.
    """

    kind: str
    time: np.ndarray
    values: np.ndarray
    source: str
    sha256: str
    corrections: tuple[str, ...]
    epoch_ns: int | None = None
    holds: bool = False

    def shifted(self, offset: float) -> ValveLog:
        """Return the log with `offset` (s) added to its times."""
        return replace(self, time=self.time + offset)

    def schedule(self) -> Schedule:
        """Return the valve states as a schedule from the first row to the last.

        Raises:
            InputError: the log contains pressures.
        """
        if self.kind != "valve":
            raise InputError(f"{self.source}: a log of pressures has no schedule of valves")
        states = self.values.astype(np.int8)
        changes = np.append(0, np.flatnonzero((states[1:] != states[:-1]).any(axis=(1, 2))) + 1)
        return Schedule(
            float(self.time[-1] - self.time[0]), self.time[changes] - self.time[0], states[changes]
        )

    def at(self, time: np.ndarray) -> np.ndarray:
        """Return the values at times inside the log, shape (times, segments, 2)."""
        if self.kind == "valve" or self.holds:
            return held_values(time + 1e-9, self.time, self.values)
        flat = self.values.reshape(len(self.time), -1)
        columns = [np.interp(time, self.time, column) for column in flat.T]
        return np.stack(columns, axis=-1).reshape(len(time), *self.values.shape[1:])

    def breakpoints(self) -> tuple[np.ndarray, np.ndarray]:
        """Return times and pressures for linear interpolation as in `at`; two for each step of set points."""
        if not self.holds:
            return self.time, self.values
        time = np.repeat(self.time, 2)[1:]
        # The last instant before a step.
        time[1::2] = np.nextafter(time[1::2], -np.inf)
        return time, np.repeat(self.values, 2, axis=0)[:-1]


def held_values(time: np.ndarray, rows: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the values of the last row at or before each time, or else those of the first row."""
    return np.asarray(values[np.maximum(np.searchsorted(rows, time, side="right") - 1, 0)])
