"""Valve log: what was commanded of the valves, or measured in the chambers, on a clock of its own.

A plain CSV file with ``time`` and either ``valve_plus_1, valve_minus_1, …`` (+1 fill, 0 hold, −1 vent) or
``pressure_plus_1, pressure_minus_1, …`` (gauge; Pa, or the unit in the name: ``pressure_plus_1_kpa``).
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.cells import read_rows
from srs_twin.identification.columns import Column, read_columns
from srs_twin.identification.source import Source, read_source
from srs_twin.identification.units import PRESSURES, TIMES
from srs_twin.pneumatics import Schedule
from srs_twin.spec import RobotSpec

SIDES = ("plus", "minus")
_KNOWN = {
    "time": TIMES, "t": TIMES, "valve_plus": {}, "valve_minus": {}, "pressure_plus": PRESSURES,
    "pressure_minus": PRESSURES,
}  # fmt: skip
_HIGHEST = 2e6  # Pa: no chamber holds more
_LOWEST = -1.1e5


@dataclass(frozen=True)
class ValveLog:
    """A log of valves or pressures.

    Attributes:
        kind: "valve" or "pressure".
        time: ascending, shape (rows,), s.
        values: valve states, which hold until the next row, or gauge pressures (Pa), shape
            (rows, segments, 2), columns + and − chamber.
        source: name of the file.
        sha256: of the file.
        corrections: what was sorted, converted and assumed, in words.
    """

    kind: str
    time: np.ndarray
    values: np.ndarray
    source: str
    sha256: str
    corrections: tuple[str, ...]

    def shifted(self, offset: float) -> ValveLog:
        """Return the same log on a clock that shows `offset` (s) more."""
        return replace(self, time=self.time + offset)

    def schedule(self, span: float | None = None) -> Schedule:
        """Return the valve states as a schedule from the first row on.

        Args:
            span: its length, s; None: to the last row.

        Raises:
            InputError: pressures are no valve states.
        """
        if self.kind != "valve":
            raise InputError(f"{self.source}: a log of pressures has no schedule of valves")
        states = self.values.astype(np.int8)
        changes = np.append(0, np.flatnonzero((states[1:] != states[:-1]).any(axis=(1, 2))) + 1)
        length = float(self.time[-1] - self.time[0]) if span is None else span
        return Schedule(length, self.time[changes] - self.time[0], states[changes])

    def at(self, time: np.ndarray) -> np.ndarray:
        """Return the values at times within the log, shape (times, segments, 2)."""
        if self.kind == "valve":
            row = np.clip(np.searchsorted(self.time, time + 1e-9, side="right") - 1, 0, len(self.time) - 1)
            return np.asarray(self.values[row])
        flat = self.values.reshape(len(self.time), -1)
        columns = [np.interp(time, self.time, column) for column in flat.T]
        return np.stack(columns, axis=-1).reshape(len(time), *self.values.shape[1:])


def read_valves(path: str | os.PathLike[str], spec: RobotSpec) -> ValveLog:
    """Read a log of valves or pressures.

    Raises:
        InputError: no such file, columns missing, values that no valve or chamber has; says where.
    """
    source = read_source(path)
    columns, width, others = read_columns(source, _KNOWN)
    clock = next((each for each in columns if each.name in ("time", "t")), None)
    if clock is None:
        raise source.error("no column 'time'; a log has time,valve_plus_1,valve_minus_1,… or pressures", 1)
    kind, chosen = _chosen(source, columns, spec)
    order = sorted([clock, *chosen], key=lambda each: each.place)
    rows = read_rows(source, 1, [each.place for each in order], width)
    place = {each.text: k for k, each in enumerate(order)}
    time = rows.values[:, place[clock.text]] * TIMES[clock.unit or "s"]
    factor = [PRESSURES[each.unit or "pa"] if kind == "pressure" else 1.0 for each in chosen]
    values = np.stack([rows.values[:, place[each.text]] for each in chosen], axis=1) * factor
    _check(source, kind, clock, chosen, time, values, rows.first_line)
    said = [*rows.corrections]
    if kind == "valve" and not (values == -1).any() and (values == 0).any():
        values = np.where(values == 0, -1.0, values)
        said.append("states are 0 and 1 only: 0 taken as venting (−1), as of 3/2 valves")
    if kind == "pressure" and not any(each.unit for each in chosen):
        said.append("pressures without a unit taken as Pa")
    if others:
        said.append(
            f"{len(others)} columns not used: {', '.join(others[:5])}{', …' if len(others) > 5 else ''}"
        )
    time, values = _ordered(source, time, values, said)
    shaped = values.reshape(len(time), spec.segments, 2)
    return ValveLog(kind, time, shaped, source.name, source.sha256, tuple(said))


def _chosen(source: Source, columns: list[Column], spec: RobotSpec) -> tuple[str, list[Column]]:
    """Return what the log is of, and its columns: segment by segment, + before −."""
    kinds = sorted({each.name.partition("_")[0] for each in columns if "_" in each.name})
    if len(kinds) != 1:
        given = "neither" if not kinds else "both"
        raise source.error(f"valve_plus_1,… or pressure_plus_1,… are wanted; {given} given", 1)
    (kind,) = kinds
    found = {(each.name, each.number): each for each in columns}
    chosen = []
    for segment in range(1, spec.segments + 1):
        for side in SIDES:
            column = found.pop((f"{kind}_{side}", segment), None)
            if column is None:
                raise source.error(
                    f"{kind}_{side}_{segment} is missing; {spec.name} has {spec.segments} segments", 1
                )
            chosen.append(column)
    extra = next((each for (name, _), each in found.items() if name.startswith(kind)), None)
    if extra is not None:
        raise source.error(f"{extra.text}: {spec.name} has {spec.segments} segments", 1, extra.place + 1)
    return kind, chosen


def _check(
    source: Source,
    kind: str,
    clock: Column,
    chosen: list[Column],
    time: np.ndarray,
    values: np.ndarray,
    first_line: int,
) -> None:
    """Refuse blanks and what no valve or chamber does."""
    bad = np.flatnonzero(~(np.abs(time) < 1e9))
    if bad.size:
        raise source.error("a row without a time", first_line + int(bad[0]), clock.place + 1)
    if kind == "valve":
        allowed, words = np.isin(values, (-1, 0, 1)), "-1 (vent), 0 (hold) or 1 (fill)"
    else:
        allowed = (values >= _LOWEST) & (values <= _HIGHEST)
        words = f"gauge pressures from {_LOWEST:g} to {_HIGHEST:g} Pa"
    wrong = np.argwhere(~allowed)
    if wrong.size:
        row, column = wrong[0]
        value = values[row, column]
        given = "nothing" if np.isnan(value) else f"{value:g}" + (" Pa" if kind == "pressure" else "")
        raise source.error(
            f"{chosen[column].text}: {given} is not allowed; {words}",
            first_line + int(row),
            chosen[column].place + 1,
        )


def _ordered(
    source: Source, time: np.ndarray, values: np.ndarray, said: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    order = np.argsort(time, kind="stable")
    moved = int((np.diff(time) < 0).sum())
    if moved:
        said.append(f"rows were not in the order of time ({moved} steps back): sorted")
    time, values = time[order], values[order]
    # Of rows at one time the last holds, as it would on the valve.
    kept = np.append(np.diff(time) > 0, True)
    if not kept.all():
        said.append(f"{int((~kept).sum())} rows repeat the time of another: the last of each kept")
    if kept.sum() < 2:
        raise source.error("a log has 2 rows or more")
    return time[kept], values[kept]
