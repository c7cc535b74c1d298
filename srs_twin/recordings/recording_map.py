"""What is what in a recording of a lab: `--map recording.yaml`, or options for one recording."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.documents import Document, load_yaml
from srs_twin.io.validation import Strict, load_model, validate
from srs_twin.recordings.csv_table import Dialect, Meaning
from srs_twin.recordings.marker_table import MarkerTable
from srs_twin.recordings.signals.units import ANGLES, PRESSURES, SHARES, TIMES, symbol

LOG_NAME = re.compile(
    r"(?:(valve|duty|pressure|setpoint)(?:_([^\W_]+))?_(plus|minus)|(bend)(?:_([a-z]+))?)_(\d{1,3})"
)
"""Keys of a log: valve_plus_1, duty_minus_2, pressure_kpa_plus_1, setpoint_kpa_plus_1, bend_deg_1."""

QUANTITIES: dict[str, dict[str, float]] = {
    "time": TIMES, "valve": {}, "duty": SHARES, "pressure": PRESSURES, "setpoint": PRESSURES, "bend": ANGLES,
}  # fmt: skip
"""Quantities of a log and their units."""

_NUMBERS = ("carrier_hz", "ambient_kpa")
_IN_A_LOG = "time, carrier_hz, valve_plus_1, duty_plus_1, pressure_kpa_plus_1, ambient_kpa or bend_1"
_SEPARATORS = {"tab": "\t", "space": " "}
_PLACE = re.compile(r"(connector|middle) (\d{1,3})(?: (ahead|behind|left|right))?")


class MarkerPlace(Strict):
    """Where a marker or a rigid body is on the robot."""

    connector: Annotated[int, Field(ge=1, le=999)] | None = None
    """On this connector, 1 at the head."""
    middle: Annotated[int, Field(ge=1, le=999)] | None = None
    """At the middle of this segment, 1 at the head."""
    side: Literal["ahead", "behind", "left", "right"] | None = None
    """Beside the connector's centre; two without a side lie on both sides of it."""

    @property
    def station(self) -> tuple[int, str]:
        """Station and side; see `body.Places`."""
        at = 2 * (self.connector - 1) if self.connector is not None else 2 * (self.middle or 0) - 1
        return at, self.side or ""


class LogColumn(Strict):
    """A column of a log, or a signal, and its unit."""

    column: str
    """Name of the column."""
    unit: str = ""
    """Unit, where the name states none: s, ms, kPa, bar, deg, …"""


class RecordingMap(Strict):
    """What is what in the files of a recording (docs/logs.md#recording-map)."""

    units: Literal["m", "cm", "mm", "in", "ft", "px"] | None = None
    """Unit of length of files that do not state it."""
    scale_m: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Size of a pixel, m (units px)."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Axis of the file that points up (default: found)."""
    rate_hz: Annotated[float, Field(gt=0, le=1e5)] | None = None
    """Frames a second of files without times."""
    markers: dict[str, MarkerPlace | Literal["ignore"]] = {}
    """Marker → {connector: 1}, {middle: 1}, {connector: 1, side: ahead} or ignore; others are ignored if any
    has a place."""
    bodies: dict[str, MarkerPlace | Literal["ignore"]] = {}
    """Rigid body → as markers; its rotation gives a heading."""
    log: dict[str, str | Annotated[float, Field(gt=0, le=1e4)] | LogColumn] = {}
    """Log: valve_plus_1, duty_plus_1, pressure_kpa_plus_1, setpoint_kpa_plus_1 or bend_1 → column, or
    {column: P1, unit: bar}; time → its column; carrier_hz → frequency of the duties' carrier; ambient_kpa →
    pressure to subtract from absolute pressures."""
    columns: list[str] = []
    """Names of the columns of a plain file whose first line has none."""
    separator: Literal[",", ";", "|", "tab", "space"] | None = None
    """Separator of the cells of a plain file (default: found)."""
    decimal: Literal[".", ","] | None = None
    """Decimal mark of a plain file (default: found)."""

    def contradictions(self) -> list[tuple[tuple[str, ...], str]]:
        """Report keys that a log has not, and places that are none or two."""
        found: list[tuple[tuple[str, ...], str]] = []
        for key, value in self.log.items():
            kind, name, default = log_meaning(key)
            if key not in _NUMBERS and not name:
                found.append((("log", key), f"a log has {_IN_A_LOG}"))
                continue
            if (key in _NUMBERS) != isinstance(value, float):
                wanted = "a number" if key in _NUMBERS else "a column's name"
                found.append((("log", key), f"{wanted} is wanted"))
            units, allowed = QUANTITIES.get(kind, {}), ", ".join(QUANTITIES.get(kind, {})) or "none"
            for each in filter(None, (default, value.unit if isinstance(value, LogColumn) else "")):
                if not symbol(each, units):
                    found.append((("log", key), f"unit '{each}' is not known; allowed: {allowed}"))
        for block, places in (("markers", self.markers), ("bodies", self.bodies)):
            for name, place in places.items():
                if isinstance(place, MarkerPlace) and (place.connector is None) == (place.middle is None):
                    found.append(
                        ((block, name), "either connector or middle is wanted, counted from the head")
                    )
        return found

    @property
    def carrier_hz(self) -> float | None:
        """Frequency of the carrier of duties, Hz."""
        found = self.log.get("carrier_hz")
        return found if isinstance(found, float) else None

    @property
    def ambient(self) -> float:
        """Pressure to subtract from absolute pressures, Pa; 0 where they are gauge pressures."""
        found = self.log.get("ambient_kpa")
        return 1e3 * found if isinstance(found, float) else 0.0

    @property
    def dialect(self) -> Dialect:
        """Layout of plain files."""
        separator = self.separator or ""
        return Dialect(tuple(self.columns), _SEPARATORS.get(separator, separator), self.decimal or "")

    def meanings(self, kinds: Collection[str]) -> dict[str, Meaning]:
        """Return column → meaning of the columns of a log that are of these quantities."""
        found = {}
        for key, value in self.log.items():
            kind, name, default = log_meaning(key)
            if kind in kinds and not isinstance(value, float):
                column = value if isinstance(value, LogColumn) else LogColumn(column=value)
                found[column.column] = Meaning(name, default, column.unit)
        return found

    def applied(self, table: MarkerTable) -> MarkerTable:
        """Return the markers that have a place, with it; all but those to be ignored where none has.

        Raises:
            UnknownNameError: a marker that the file has not.
        """
        named = {**self.markers, **self.bodies}
        for name in named:
            if name not in table.labels:
                raise UnknownNameError("marker", name, table.labels)
        placed = {name: each.station for name, each in named.items() if isinstance(each, MarkerPlace)}
        chosen = [
            k for k, label in enumerate(table.labels) if (label in placed if placed else label not in named)
        ]
        if len(chosen) == len(table.labels) and not placed:
            return table
        rotations = None if table.rotations is None else table.rotations[:, chosen]
        labels = tuple(table.labels[k] for k in chosen)
        left = len(table.labels) - len(chosen)
        notes = (f"{left} markers ignored, as the map asks",) if left else ()
        places = tuple(placed[label] for label in labels) if placed else ()
        return replace(
            table, points=table.points[:, chosen], labels=labels, places=places, rotations=rotations,
            corrections=(*table.corrections, *notes),
        )  # fmt: skip


NO_MAP = RecordingMap()


def log_meaning(key: str) -> tuple[str, str, str]:
    """Return quantity, name and unit of a log's key: pressure_kpa_plus_1 is pressure_plus_1 in kpa."""
    if key == "time":
        return key, key, ""
    match = LOG_NAME.fullmatch(key)
    if match is None:
        return "", "", ""
    kind, unit, side = match[1] or match[4], match[2] or match[5] or "", match[3]
    return kind, "_".join(filter(None, [kind, side, match[6]])), unit


def given_map(path: str | None, options: Mapping[str, Any], markers: Sequence[str]) -> dict[str, Any] | None:
    """Return a map as plain data, of a file and of options, which go before it; None where nothing is given.

    Args:
        path: of the file.
        options: keys of the map; those that are None are left out.
        markers: "NAME=connector 1", "NAME=middle 2", "NAME=connector 1 ahead" or "NAME=ignore".

    Raises:
        InputError: no such place, or what is wrong with the file.
    """
    data: dict[str, Any] = {}
    if path is not None:
        load_model(RecordingMap, Path(path))
        data = dict(load_yaml(Path(path)).data)
    data |= {key: value for key, value in options.items() if value is not None}
    named = {mark: name for name, mark in _SEPARATORS.items()}
    if data.get("separator") in named:
        data["separator"] = named[data["separator"]]
    if isinstance(data.get("columns"), str):
        data["columns"] = [name.strip() for name in data["columns"].split(",")]
    for each in markers:
        name, _, place = each.rpartition("=")
        match = _PLACE.fullmatch(place.strip())
        if not name or not (match or place.strip() == "ignore"):
            wanted = (
                "NAME=connector 1, NAME=middle 1, NAME=connector 1 ahead (behind, left, right) or NAME=ignore"
            )
            raise InputError(f"--marker: '{each}' is not allowed; {wanted}")
        where: Any = "ignore"
        if match:
            where = {match[1]: int(match[2]), **({"side": match[3]} if match[3] else {})}
        data["markers"] = {**data.get("markers", {}), name: where}
    return data or None


def read_map(data: Mapping[str, Any]) -> RecordingMap:
    """Return a map of plain data, as `given_map` returns them.

    Raises:
        InputFileError: everything that is wrong with them.
    """
    document = Document("--map", dict(data))
    found = validate(RecordingMap, document, document.data)
    document.finish()
    assert found is not None, "a map without a problem was checked"
    return found
