"""Signals recorded during a rollout, with units and events."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, BinaryIO, ClassVar

import numpy as np

from srs_twin.compute.arrays import Array
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.extensions import PAGES, load
from srs_twin.io.files import StrPath
from srs_twin.io.untrusted import read_table

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow

_COLUMNS_OF_UNIT = {
    "s": "time",
    "m": (
        "com_x com_y x y z clearance cross_track estimate_x estimate_y object_x"
        " object_y"
    ),
    "rad": (
        "heading connector_heading bend pitch measured_bend measured_pitch heading_error estimate_heading"
        " object_heading reference error target_plus target_minus amplitude_plus"
        " amplitude_minus grip phase_step"
    ),
    "rad/s": "sigma rate",
    "Pa": "pressure_plus pressure_minus pressure",
    "N": "obstacle_force_x obstacle_force_y load",
    "N·m": "torque torque_pitch",
    "J": "work internal_loss pneumatic_energy",
    "mixed": "qpos",
}
# Numbered columns are listed without their number, for example "bend". Columns that are
# not listed are dimensionless.
_UNIT_OF_COLUMN = {
    name: unit for unit, names in _COLUMNS_OF_UNIT.items() for name in names.split()
}

_FILE_KIND = "a trajectory written by srs-twin"
_TIME_ROUNDING_S = 1e-9
"""Maximum difference between two times that count as equal, s."""


@dataclass(frozen=True)
class Event:
    """Event of a run, such as an ILC update, replanning, saturation or a contact.

    Attributes:
        time: time of the event, s.
        kind: type of the event, for example ``"ilc_update"``.
        text: one-line description of the event.
    """

    time: float
    kind: str
    text: str


class UnknownColumnError(UnknownNameError, KeyError):
    """Error for a column that a trajectory does not have."""

    # The method `__str__` of KeyError would print the message in quotes.
    __str__ = Exception.__str__


class HtmlResult:
    """Base class of results that notebooks display as an HTML page."""

    page: ClassVar[str] = "run"

    def _repr_html_(self) -> str:
        page: str = load(PAGES[self.page])(self)
        return page


@dataclass(frozen=True)
class Trajectory(HtmlResult):
    """Signals recorded during one rollout, stored as columns.

    The arrays are read-only. The columns have the following names.

    - The columns of the body are ``time``, ``heading``, ``com_x`` and ``com_y`` (centre
      of mass), and ``x_1…N``, ``y_1…N`` and ``connector_heading_1…N`` (connector poses
      from the head). The energies are ``work``, ``internal_loss`` and
      ``pneumatic_energy``, of which some plants record only the first.
    - The columns of the segments are ``bend_1…``, ``measured_bend_1…`` and
      ``torque_1…``. The columns of the chambers are ``pressure_plus_1…``,
      ``pressure_minus_1…``, ``valve_plus_1…`` and ``valve_minus_1…``.
    - The controller adds its own signals, and the twin adds its generalised positions
      ``qpos_1…``.
    - In a world with objects, the object poses are ``object_x_1…``, ``object_y_1…`` and
      ``object_heading_1…``. In a world with obstacles or objects, ``clearance`` is the
      distance from the body to the nearest obstacle or object. A plant that simulates
      contact adds the forces ``obstacle_force_x_1…`` and ``obstacle_force_y_1…``.
    - A spatial robot also has ``pitch_1…`` (upward bends), ``measured_pitch_1…``,
      ``torque_pitch_1…``, ``z_1…``, ``quaternion_w_1…`` to ``quaternion_z_1…`` and
      ``load_1…``. In this case, the chamber columns are ``pressure_c_1…`` and
      ``valve_c_1…`` for each chamber number c.

    Attributes:
        columns: float array of each column, keyed by column name, shape (samples,).
        units: units of columns that are not listed above, keyed by column name.
        events: events in chronological order.
        metadata: JSON values such as plant, robot, tick, gait frequency and valve
            switch counts, without computing times.
    """

    columns: Mapping[str, Array]
    units: Mapping[str, str] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # Views are protected instead of the arrays of the caller.
        columns = {name: column.view() for name, column in self.columns.items()}
        for column in columns.values():
            column.flags.writeable = False
        object.__setattr__(self, "columns", columns)

    def __getitem__(self, name: str) -> Array:
        """Return one column, shape (samples,).

        Raises:
            UnknownColumnError: the trajectory has no such column.
        """
        if name not in self.columns:
            raise UnknownColumnError("column", str(name), self.columns)
        return self.columns[name]

    def __contains__(self, name: object) -> bool:
        return name in self.columns

    def __len__(self) -> int:
        return len(self.time)

    @property
    def time(self) -> Array:
        """Sample times, shape (samples,), s."""
        return self.columns["time"]

    @property
    def com(self) -> Array:
        """Centre of mass in the world frame, shape (samples, 2), m."""
        return np.stack([self["com_x"], self["com_y"]], axis=-1)

    @property
    def position(self) -> Array:
        """Connector positions in the world frame, shape (samples, N, 2), m."""
        return np.stack([self.stack("x"), self.stack("y")], axis=-1)

    def stack(self, name: str) -> Array:
        """Return numbered columns as one array.

        For example, ``stack("bend")`` has shape (samples, segments).

        Raises:
            UnknownColumnError: the trajectory has no column ``<name>_1``.
        """
        arrays: list[Array] = []
        while (column := self.columns.get(f"{name}_{len(arrays) + 1}")) is not None:
            arrays.append(column)
        if not arrays:
            stems = {
                column.removesuffix("_1")
                for column in self.columns
                if column.endswith("_1")
            }
            raise UnknownColumnError("numbered columns", name, stems)
        return np.stack(arrays, axis=-1)

    def between(self, begin: float, end: float) -> Trajectory:
        """Return the samples between two times, including samples at both times.

        Args:
            begin: start time, s.
            end: end time, s.
        """
        kept = (self.time >= begin - _TIME_ROUNDING_S) & (
            self.time <= end + _TIME_ROUNDING_S
        )
        return replace(
            self, columns={name: column[kept] for name, column in self.columns.items()}
        )

    def has(self, name: str) -> bool:
        """Return whether the trajectory has a column ``name`` or ``name_1``."""
        return name in self.columns or f"{name}_1" in self.columns

    def unit(self, name: str) -> str:
        """Return the unit of a column, or of numbered columns such as ``"bend"``.

        Raises:
            UnknownColumnError: the trajectory has no such column.
        """
        if not self.has(name):
            raise UnknownColumnError("column", name, self.columns)
        return self.units.get(name) or _UNIT_OF_COLUMN.get(
            re.sub(r"(_\d+)+$", "", name), "1"
        )

    def to_pandas(self) -> pd.DataFrame:
        """Return the columns as a pandas data frame, indexed by time (s).

        The attribute ``attrs["units"]`` contains the unit of each column and of the
        index.

        Raises:
            InputError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise InputError(
                "`to_pandas` needs the optional package pandas; run Python with `uv run"
                " --with pandas python`, or install it with `pip install pandas`"
            ) from error
        frame = pd.DataFrame(dict(self.columns)).set_index("time")
        frame.attrs["units"] = {name: self.unit(name) for name in self.columns}
        return frame

    def to_parquet(self, path: StrPath | BinaryIO) -> None:
        """Write the trajectory to a Parquet file or a file-like object.

        Equal trajectories produce identical files. The metadata of the Parquet fields
        contain the units. The metadata of the Parquet schema contain the events and the
        metadata of the trajectory as JSON.
        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        fields = [
            pa.field(name, pa.float64(), metadata={"unit": self.unit(name)})
            for name in self.columns
        ]
        schema_metadata = {
            "srs_twin.events": json.dumps([asdict(event) for event in self.events]),
            "srs_twin.metadata": json.dumps(dict(self.metadata), sort_keys=True),
        }
        # The arrays are passed as buffers, because pa.array() imports pandas if it is
        # installed, which takes half a second.
        values = [
            np.ascontiguousarray(column, dtype=float)
            for column in self.columns.values()
        ]
        table = pa.Table.from_arrays(
            [
                pa.Array.from_buffers(
                    pa.float64(), len(each), [None, pa.py_buffer(each)]
                )
                for each in values
            ],
            schema=pa.schema(fields, metadata=schema_metadata),
        )
        # BYTE_STREAM_SPLIT compresses smooth signals better than a dictionary.
        encoding = dict.fromkeys(self.columns, "BYTE_STREAM_SPLIT")
        options = {
            "compression": "zstd",
            "use_dictionary": False,
            "write_page_checksum": True,
        }
        pq.write_table(table, path, **options, column_encoding=encoding)

    @classmethod
    def from_parquet(cls, path: StrPath | BinaryIO) -> Trajectory:
        """Read a trajectory from a file that was written by `to_parquet`.

        Raises:
            InputError: the file is damaged, too large, or not a trajectory in Parquet
                format.
        """
        table = read_table(path, _FILE_KIND, _check_schema)
        schema_metadata = table.schema.metadata or {}
        try:
            events = tuple(
                _parse_event(data)
                for data in json.loads(schema_metadata[b"srs_twin.events"])
            )
            metadata = json.loads(schema_metadata[b"srs_twin.metadata"])
            units = {
                field.name: (field.metadata or {}).get(b"unit", b"1").decode()
                for field in table.schema
            }
            if not isinstance(metadata, dict):
                raise TypeError("its metadata is not a mapping")
            columns = {
                name: _to_array(name, table.column(name)) for name in table.column_names
            }
        except (TypeError, ValueError, RecursionError) as error:
            raise InputError(f"{path}: not {_FILE_KIND} ({error})") from error
        if "time" not in columns:
            raise InputError(
                f"{path}: a trajectory needs a column 'time', but the file has none"
            )
        time = columns["time"]
        if not (np.isfinite(time).all() and (np.diff(time) > 0).all()):
            raise InputError(
                f"{path}: the values in column 'time' must be finite and increase from"
                " sample to sample"
            )
        return cls(columns, units, events, metadata)


def _check_schema(schema: pyarrow.Schema) -> None:
    if not {b"srs_twin.events", b"srs_twin.metadata"} <= (schema.metadata or {}).keys():
        raise TypeError("the Parquet file has no metadata of srs-twin")
    for column in schema:
        if str(column.type) != "double":
            raise TypeError(
                f"column '{column.name}' contains values of type {column.type},"
                " but must contain float64"
            )


def _to_array(name: str, column: pyarrow.ChunkedArray) -> Array:
    if column.null_count:
        raise TypeError(f"column '{name}' has {column.null_count} missing values")
    return np.asarray(column.to_numpy())


def _parse_event(data: Any) -> Event:
    event = Event(**data)
    if not (isinstance(event.kind, str) and isinstance(event.text, str)):
        raise TypeError("the kind and the text of an event must be text")
    if isinstance(event.time, bool) or not math.isfinite(event.time):
        raise ValueError("the time of an event must be finite")
    return event
