"""Static tables: pressures that were held, and the bends at which free segments came to rest.

A plain CSV file with ``pressure_plus_1,pressure_minus_1,bend_1,…`` (``pressure_plus_1_kpa``,
``bend_1_deg``; Pa and rad without a unit). A pressure that is not there is 0, an empty bend was not
measured. Gain, bias and bend limit can be told from it; nothing that takes time, and no mass.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.cells import read_rows
from srs_twin.identification.columns import Column, read_columns
from srs_twin.identification.data_set import DataSet, data_sets, keep_apart
from srs_twin.identification.estimate import Estimate, Residual, Role
from srs_twin.identification.least_squares import least_squares
from srs_twin.identification.search import Watch
from srs_twin.identification.source import read_source
from srs_twin.identification.units import PRESSURES
from srs_twin.identification.unknowns import per_segment, unknowns, with_values
from srs_twin.identification.valve_log import SIDES
from srs_twin.pneumatics.bending import air_bend
from srs_twin.spec import RobotSpec

_ANGLES = {"rad": 1.0, "deg": math.pi / 180}
_KNOWN = {"pressure_plus": PRESSURES, "pressure_minus": PRESSURES, "bend": _ANGLES}
_MOST_PRESSURE = 2e6  # Pa
_MOST_BEND = 2 * math.pi
_NOISE = 0.01  # rad
_LIMIT = "actuator.bend_limit_rad"


@dataclass(frozen=True)
class StaticTable:
    """Bends under held pressures.

    Attributes:
        name: of the file.
        sha256: of it.
        pressure: gauge, shape (points, segments, 2), Pa.
        bend: shape (points, segments), rad; NaN where it was not measured.
    """

    name: str
    sha256: str
    pressure: np.ndarray
    bend: np.ndarray

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""
        return DataSet(self.name, self.sha256, role, int(np.isfinite(self.bend).sum()))


def is_static(path: str | os.PathLike[str]) -> bool:
    """Say whether a file's first line names bends as its columns: a table, no recording.

    Raises:
        InputError: the file cannot be read.
    """
    names = "".join(read_source(path).head(1)).lower().split(",")
    return any(name.strip().startswith("bend_") for name in names)


def read_static(path: str | os.PathLike[str], spec: RobotSpec) -> StaticTable:
    """Read a static table.

    Raises:
        InputError: no such file, no bends, columns of other segments, or values that no robot has.
    """
    source = read_source(path)
    columns, width, _ = read_columns(source, _KNOWN)
    found = {(each.name, each.number): each for each in columns}
    for each in columns:
        if not 1 <= each.number <= spec.segments or each.which:
            raise source.error(
                f"{each.text}: {spec.name} has segments 1 to {spec.segments}", 1, each.place + 1
            )
    if not any(name == "bend" for name, _ in found):
        raise source.error(
            "no column 'bend_1'; a static table has pressure_plus_1,pressure_minus_1,bend_1,…", 1
        )
    order = sorted(columns, key=lambda each: each.place)
    rows = read_rows(source, 1, [each.place for each in order], width)
    place = {(each.name, each.number): k for k, each in enumerate(order)}

    def column(name: str, number: int, missing: float) -> np.ndarray:
        if (name, number) not in place:
            return np.full(len(rows.values), missing)
        with np.errstate(over="ignore"):  # refused below
            return np.asarray(rows.values[:, place[name, number]] * _factor(found[name, number]))

    numbers = range(1, spec.segments + 1)
    pressure = np.stack(
        [np.stack([column(f"pressure_{side}", j, 0.0) for side in SIDES], axis=-1) for j in numbers], axis=1
    )
    bend = np.stack([column("bend", j, math.nan) for j in numbers], axis=1)
    if not (np.abs(pressure) <= _MOST_PRESSURE).all():
        raise source.error(
            f"pressures from {-_MOST_PRESSURE:g} to {_MOST_PRESSURE:g} Pa are wanted, in every row"
        )
    if not np.isfinite(bend).any() or (np.abs(bend) > _MOST_BEND).any():
        raise source.error(f"bends up to {_MOST_BEND:.3g} rad are wanted; is the unit right (bend_1_deg)?")
    return StaticTable(source.name, source.sha256, pressure, bend)


def fit_static(
    tables: Sequence[StaticTable],
    spec: RobotSpec,
    *,
    names: Iterable[str] | None = None,
    validation: Sequence[StaticTable] = (),
    noise: float = _NOISE,
    watch: Watch | None = None,
) -> Estimate:
    """Return gains, biases and the bend limit from static tables.

    Args:
        tables: what was measured; the residual of each point is in the estimate.
        spec: the robot that the search starts from; `actuator.bend_rad` is held, as in `fit_actuator`.
        names: what is unknown, see `unknowns`; default gains, biases and the bend limit.
        validation: tables to hold the estimate against.
        noise: of a measured bend, rad.
        watch: is told how far the search is, see `least_squares`.

    Raises:
        InputError: no table, or one to validate with that is also fitted.
    """
    if not tables:
        raise InputError("static tables are wanted; none was given")
    keep_apart(data_sets(tables, validation))

    def residuals(values: Mapping[str, float]) -> list[Residual]:
        robot = with_values(spec, values)
        fitted = [each for table in tables for each in _compared(table, robot, noise, "fit")]
        return fitted + [
            each for table in validation for each in _compared(table, robot, noise, "validation")
        ]

    modules = per_segment(spec, "modules.gain_plus", "modules.gain_minus", "modules.bias_rad")
    wanted = [*modules, _LIMIT] if names is None else list(names)
    largest = max(float(np.nanmax(np.abs(table.bend), initial=0.1)) for table in tables)
    starts = {_LIMIT: min(1.5 * max(largest, 0.1), 6.0)} if math.isinf(spec.actuator.bend_limit) else {}
    held = {"actuator.at_pressure_kpa": spec.supply.nominal / 1e3}
    if "actuator.bend_rad" not in wanted:
        held["actuator.bend_rad"] = spec.actuator.gain * spec.supply.nominal
    return least_squares(residuals, unknowns(spec, wanted, starts=starts), held=held, watch=watch)


def _compared(table: StaticTable, spec: RobotSpec, noise: float, role: Role) -> list[Residual]:
    off = table.bend - spec.modules.array("bias") - air_bend(spec, table.pressure)
    return [
        Residual(f"{table.name} bend_{j + 1}", "rad", column[np.isfinite(column)], noise, role)
        for j, column in enumerate(off.T)
    ]


def _factor(column: Column) -> float:
    units = _KNOWN[column.name]
    return units[column.unit or ("pa" if units is PRESSURES else "rad")]
