"""Trajectory: what a rollout recorded. Named columns over time with units, events, metadata; Parquet."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import numpy as np

from srs_twin.errors import InputError
from srs_twin.extensions import PAGES, load
from srs_twin.io.parquet import read_table

_NAMES = {
    "s": "time",
    "m": "com_x com_y x y cross_track estimate_x estimate_y",
    "rad": "heading theta bend sensed heading_error estimate_heading reference error"
    " target_plus target_minus amplitude_plus amplitude_minus",
    "rad/s": "sigma rate",
    "Pa": "pressure_plus pressure_minus",
    "N": "obstacle_force_x obstacle_force_y",
    "N·m": "torque",
    "J": "work internal_loss air",
    "mixed": "qpos",
}
# Column without its number → unit; all others are pure numbers.
_UNITS = {name: unit for unit, names in _NAMES.items() for name in names.split()}

_OURS = "a trajectory written by srs-twin"


@dataclass(frozen=True)
class Event:
    """Something that happened at one moment (an ILC update, replanning, saturation, contact).

    Attributes:
        time: s.
        kind: short name, e.g. ``"ilc_update"``.
        text: one line for people.
    """

    time: float
    kind: str
    text: str


class Shown:
    """Result that a notebook shows as HTML.

    Attributes:
        page: entry of `extensions.PAGES`.
    """

    page: ClassVar[str] = "run"

    def _repr_html_(self) -> str:
        page: str = load(PAGES[self.page])(self)
        return page


@dataclass(frozen=True)
class Trajectory(Shown):
    """Columns over time of one rollout. Frozen; arrays are not to be written to.

    Column names are fixed: ``time``, ``com_x``, ``com_y``, ``heading``, ``x_1…N``, ``y_1…``, ``theta_1…``
    (head first), ``bend_1…``, ``sensed_1…``, ``torque_1…``, ``work``, ``air``,
    ``pressure_plus_1…``,
    ``pressure_minus_1…``, ``valve_plus_1…``, ``valve_minus_1…``, the controller's signals, and for the twin
    ``qpos_1…``.

    Attributes:
        columns: name → float array, each of shape (samples,).
        units: name → unit, for the columns that the project does not name itself.
        events: in order of time.
        metadata: JSON values: plant, robot, tick, gait frequency, switch counts. No wall times.
    """

    columns: Mapping[str, np.ndarray]
    units: Mapping[str, str] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __getitem__(self, name: str) -> np.ndarray:
        """Return one column, shape (samples,)."""
        return self.columns[name]

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time)

    @property
    def time(self) -> np.ndarray:
        """Sample times, shape (samples,), s."""
        return self.columns["time"]

    @property
    def com(self) -> np.ndarray:
        """Centre of mass in the world, shape (samples, 2), m."""
        return np.stack([self["com_x"], self["com_y"]], axis=-1)

    @property
    def position(self) -> np.ndarray:
        """Connector positions in the world, head first, shape (samples, N, 2), m."""
        return np.stack([self.stack("x"), self.stack("y")], axis=-1)

    def stack(self, name: str) -> np.ndarray:
        """Return numbered columns side by side: ``stack("bend")`` has shape (samples, segments).

        Raises:
            KeyError: there is no ``<name>_1``.
        """
        arrays: list[np.ndarray] = []
        while (column := self.columns.get(f"{name}_{len(arrays) + 1}")) is not None:
            arrays.append(column)
        if not arrays:
            raise KeyError(name)
        return np.stack(arrays, axis=-1)

    def has(self, name: str) -> bool:
        """Say whether a column ``name`` or ``name_1`` is there."""
        return name in self.columns or f"{name}_1" in self.columns

    def unit(self, name: str) -> str:
        """Return the unit of a column."""
        return self.units.get(name) or _UNITS.get(re.sub(r"_\d+$", "", name), "1")

    def to_parquet(self, path: Any) -> None:
        """Write to a Parquet file or file-like object; equal trajectories give equal bytes.

        Units stand in each field's metadata, events and metadata as JSON in the schema's.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        fields = [pa.field(n, pa.float64(), metadata={"unit": self.unit(n)}) for n in self.columns]
        about = {
            "srs_twin.events": json.dumps([asdict(e) for e in self.events]),
            "srs_twin.metadata": json.dumps(dict(self.metadata), sort_keys=True),
        }
        table = pa.Table.from_arrays(
            [pa.array(np.ascontiguousarray(c, dtype=float)) for c in self.columns.values()],
            schema=pa.schema(fields, metadata=about),
        )
        options = {"compression": "zstd", "use_dictionary": False, "write_page_checksum": True}
        pq.write_table(
            table, path, **options, column_encoding=dict.fromkeys(self.columns, "BYTE_STREAM_SPLIT")
        )

    @classmethod
    def from_parquet(cls, path: Any) -> Trajectory:
        """Read what `to_parquet` wrote.

        Raises:
            InputError: not a Parquet file, not one of a trajectory, damaged, or beyond all bounds.
        """
        table = read_table(path, _OURS, _check_schema)
        about = table.schema.metadata or {}
        try:
            events = tuple(_event(each) for each in json.loads(about[b"srs_twin.events"]))
            metadata = json.loads(about[b"srs_twin.metadata"])
            units = {f.name: (f.metadata or {}).get(b"unit", b"1").decode() for f in table.schema}
            if not isinstance(metadata, dict):
                raise TypeError("its metadata is no mapping")
            columns = {name: _numbers(name, table.column(name)) for name in table.column_names}
        except (TypeError, ValueError, RecursionError) as error:
            raise InputError(f"{path}: not {_OURS} ({error})") from error
        if "time" not in columns:
            raise InputError(f"{path}: a trajectory needs a column 'time'")
        time = columns["time"]
        if not (np.isfinite(time).all() and (np.diff(time) > 0).all()):
            raise InputError(f"{path}: column time: must be finite and rise from sample to sample")
        return cls(columns, units, events, metadata)


def _check_schema(schema: Any) -> None:
    """Refuse a file of something else before its data are read.

    Raises:
        TypeError: it holds something else than numbers, or is none of ours.
    """
    if not {b"srs_twin.events", b"srs_twin.metadata"} <= (schema.metadata or {}).keys():
        raise TypeError("a Parquet file of something else")
    for each in schema:
        if str(each.type) != "double":
            raise TypeError(f"column {each.name} holds {each.type}, not float64")


def _numbers(name: str, column: Any) -> np.ndarray:
    """Return a Parquet column as an array.

    Raises:
        TypeError: it has gaps.
    """
    if column.null_count:
        raise TypeError(f"column {name} has {column.null_count} gaps")
    return np.asarray(column.to_numpy())


def _event(given: Any) -> Event:
    """Return an event as it was written.

    Raises:
        TypeError, ValueError: it is none.
    """
    event = Event(**given)
    if not (isinstance(event.kind, str) and isinstance(event.text, str)):
        raise TypeError("an event's kind and text must be text")
    if isinstance(event.time, bool) or not math.isfinite(event.time):
        raise ValueError("an event's time must be finite")
    return event
