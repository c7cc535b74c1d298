"""Recording map (`--map FILE.yaml`) with the meaning of columns and markers."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from srs_twin.errors import InputError, UnknownNameError, did_you_mean
from srs_twin.io.documents import Document
from srs_twin.io.files import StrPath
from srs_twin.io.validation import StrictModel, load_model, validate
from srs_twin.recordings.body.floor import Up
from srs_twin.recordings.formats.base import MarkerTable, Unstated
from srs_twin.recordings.recorded_file import Dialect
from srs_twin.recordings.signals.units import QUANTITIES, Meaning, bracketed, symbol

_LOG_NAME = re.compile(
    r"(?P<kind>valve|duty|pressure|setpoint|bend)"
    r"(?:_(?P<unit>(?!plus|minus)[^\W_]+))?"
    r"(?P<side>_plus|_minus)?_(?P<number>\d{1,3})"
)

_NUMBERS = ("carrier_hz", "ambient_kpa")
_LOG_KEYS = (
    "time, carrier_hz, valve_plus_1, duty_plus_1, pressure_kpa_plus_1, ambient_kpa or"
    " bend_1"
)
_SEPARATORS = {"tab": "\t", "space": " "}
_PLACE = re.compile(
    r"ignore|(?P<kind>connector|middle) (?P<number>[1-9]\d{0,2})"
    r"(?: (?P<side>ahead|behind|left|right))?"
)


class MarkerPlace(StrictModel):
    """Place of a marker or a rigid body on the robot."""

    connector: Annotated[int, Field(ge=1, le=999)] | None = None
    """Connector number, counted from 1 at the head."""
    middle: Annotated[int, Field(ge=1, le=999)] | None = None
    """Number of the segment with a marker at its middle, counted from 1 at the head."""
    side: Literal["ahead", "behind", "left", "right"] | None = None
    """Side of the connector on which the marker lies (default: the centre, or both
    sides for a pair of markers)."""

    @property
    def station(self) -> tuple[int, str]:
        """Station and side of the marker, as defined in `body.markers.Places`."""
        if self.connector is not None:
            return 2 * (self.connector - 1), self.side or ""
        return 2 * (self.middle or 0) - 1, self.side or ""


class LogColumn(StrictModel):
    """Column or signal of a log, with its unit."""

    column: str
    """Name of the column."""
    unit: str = ""
    """Unit of the column (s, ms, kPa, bar, deg, …), if its name does not state one."""


class RecordingMap(StrictModel):
    """Meaning of recorded columns and markers (docs/recordings.md#recording-map)."""

    units: Literal["m", "cm", "mm", "in", "ft", "px"] | None = None
    """Unit of length, if the file does not state one."""
    scale_m: Annotated[float, Field(gt=0, lt=1)] | None = None
    """Size of a pixel, m, if the unit of length is px."""
    up: Up | None = None
    """Vertical axis of the file (default: determined from the markers)."""
    level: bool | None = None
    """Whether the tilt of the floor is removed (default: only if it is certain)."""
    rate_hz: Annotated[float, Field(gt=0, le=1e5)] | None = None
    """Frame rate of a file without times, Hz."""
    markers: dict[str, MarkerPlace | Literal["ignore"]] = {}
    """Place of each marker on the robot: {connector: 1}, {middle: 1}, {connector: 1,
    side: ahead} or ignore. If any marker has a place, all markers without a place are
    ignored."""
    bodies: dict[str, MarkerPlace | Literal["ignore"]] = {}
    """Place of each rigid body on the robot, in the same format as for markers."""
    log: dict[str, str | Annotated[float, Field(gt=0, le=1e4)] | LogColumn] = {}
    """Column of each logged quantity, given as a name or as {column: P1, unit: bar}.
    Possible keys are time, valve_plus_1, duty_plus_1, pressure_kpa_plus_1,
    setpoint_kpa_plus_1, bend_1 and so on. The key carrier_hz sets the carrier frequency
    of duties. The key ambient_kpa sets the pressure that is subtracted from absolute
    pressures."""
    columns: list[str] = []
    """Column names of a plain file without a header."""
    separator: Literal[",", ";", "|", "tab", "space"] | None = None
    """Cell separator of a plain file (default: detected)."""
    decimal: Literal[".", ","] | None = None
    """Decimal mark of a plain file (default: detected)."""

    def contradictions(self) -> Iterator[tuple[tuple[str, str], str]]:
        """Yield errors for invalid keys, unknown units and ambiguous marker places."""
        for key, value in self.log.items():
            for problem in _log_problems(key, value):
                yield ("log", key), problem
        problem = "give either `connector` or `middle`, counted from the head"
        for block, places in (("markers", self.markers), ("bodies", self.bodies)):
            for name, place in places.items():
                if isinstance(place, MarkerPlace) and (
                    (place.connector is None) == (place.middle is None)
                ):
                    yield (block, name), problem

    @property
    def carrier_hz(self) -> float | None:
        """Carrier frequency of duties, Hz, or None if the map does not state it."""
        return self._number("carrier_hz")

    @property
    def ambient(self) -> float:
        """Pressure that is subtracted from absolute pressures, Pa (default 0)."""
        return 1e3 * (self._number("ambient_kpa") or 0.0)

    def _number(self, key: str) -> float | None:
        value = self.log.get(key)
        return value if isinstance(value, float) else None

    @property
    def dialect(self) -> Dialect:
        """Layout of plain tables, as stated in the map."""
        separator = self.separator or ""
        return Dialect(
            tuple(self.columns),
            _SEPARATORS.get(separator, separator),
            self.decimal or "",
        )

    @property
    def unstated(self) -> Unstated:
        """Information in the map that a marker file may lack."""
        return Unstated(self.rate_hz, self.units, self.scale_m, self.dialect)

    def meanings(self, kinds: Collection[str]) -> dict[str, Meaning]:
        """Return the meanings of log columns with one of the given quantities."""
        meanings = {}
        for key, value in self.log.items():
            meaning = log_meaning(key)
            if meaning is None or meaning.kind not in kinds:
                continue
            if isinstance(value, LogColumn):
                meanings[value.column] = meaning._replace(unit=value.unit)
            elif isinstance(value, str):
                meanings[value] = meaning
        return meanings

    def applied(self, table: MarkerTable) -> MarkerTable:
        """Return the markers that belong to the robot according to the map.

        If the map states no places, only the markers with the entry "ignore" are
        removed.
        """
        named = {**self.markers, **self.bodies}
        for name in named:
            if name not in table.labels:
                raise UnknownNameError("marker", name, table.labels)
        placed = {
            name: place.station
            for name, place in named.items()
            if isinstance(place, MarkerPlace)
        }
        chosen = [
            k
            for k, label in enumerate(table.labels)
            if (label in placed if placed else label not in named)
        ]
        ignored = len(table.labels) - len(chosen)
        if not (ignored or placed):
            return table
        notes = table.corrections
        if ignored:
            notes += (f"{ignored} markers are ignored according to the map",)
        labels = tuple(table.labels[k] for k in chosen)
        return replace(
            table,
            points=table.points[:, chosen],
            labels=labels,
            places=tuple(placed[label] for label in labels) if placed else (),
            rotations=None if table.rotations is None else table.rotations[:, chosen],
            corrections=notes,
        )


NO_MAP = RecordingMap()


def _log_problems(key: str, value: str | float | LogColumn) -> Iterator[str]:
    meaning = log_meaning(key)
    if key in _NUMBERS:
        if not isinstance(value, float):
            yield "the value must be a number"
        return
    if meaning is None:
        number = re.sub(r"\D", "", key)[:3] or "1"
        keys = _LOG_KEYS.replace(" or", ",").replace("1", number)
        names = f"{keys}, {keys.replace('plus', 'minus')}".split(", ")
        close = did_you_mean(key, dict.fromkeys(names))
        yield f"unknown key{close or f'; the section `log` has the keys {_LOG_KEYS}'}"
        return
    if isinstance(value, float):
        yield "the value must be the name of a column"
    units = QUANTITIES[meaning.kind]
    given = value.unit if isinstance(value, LogColumn) else ""
    for unit in (meaning.default, given):
        if unit and not symbol(unit, units):
            allowed = ", ".join(units) or "none"
            yield f"unknown unit '{unit}'; allowed units: {allowed}"


def log_meaning(key: str) -> Meaning | None:
    """Return the meaning of a log key such as `pressure_kpa_plus_1`, or None."""
    if key == "time":
        return Meaning("time", "time")
    match = _LOG_NAME.fullmatch(key)
    if match is None or (match["kind"] == "bend") == bool(match["side"]):
        return None
    name = match["kind"] + (match["side"] or "")
    return Meaning(match["kind"], name, int(match["number"]), match["unit"] or "")


def given_map(
    path: str | None, options: Mapping[str, object], markers: Sequence[str]
) -> dict[str, object]:
    """Combine a map file, options and marker places into plain data.

    Options that are not None override the values in the file. A marker place has the
    form "NAME=connector 1", "NAME=middle 2", "NAME=connector 1 ahead" or "NAME=ignore".
    """
    data: dict[str, Any] = {}
    if path is not None:
        data = load_model(RecordingMap, Path(path)).model_dump(exclude_unset=True)
    places = data.get("markers", {})
    data |= {key: value for key, value in options.items() if value is not None}
    for name, character in _SEPARATORS.items():
        if data.get("separator") == character:
            data["separator"] = name
    columns = data.get("columns")
    if isinstance(columns, str):
        data["columns"] = [name.strip() for name in columns.split(",")]
    for option in markers:
        name, _, place = option.rpartition("=")
        match = _PLACE.fullmatch(place.strip())
        if not name or not match:
            raise InputError(
                f"--marker '{option}' is not allowed; use NAME=connector 1, NAME=middle"
                " 1, NAME=connector 1 ahead (behind, left, right) or NAME=ignore"
            )
        places[name] = "ignore"
        if match["kind"]:
            side = {"side": match["side"]} if match["side"] else {}
            places[name] = {match["kind"]: int(match["number"]), **side}
    if places:
        data["markers"] = places
    return data


def read_map(data: Mapping[str, object], source: str = "map") -> RecordingMap:
    """Return a recording map from the plain data that `given_map` returns.

    Error messages begin with `source`.
    """
    document = Document(source, dict(data))
    model = validate(RecordingMap, document, document.data)
    document.raise_problems()
    assert model is not None, "a map without a problem was checked"
    return model


def as_map(given: RecordingMap | Mapping[str, object] | StrPath) -> RecordingMap:
    """Return a recording map that is given as an object, a mapping or a path.

    Raises:
        InputError: the map is not valid, or `given` has another type.
    """
    if isinstance(given, RecordingMap):
        return given
    if isinstance(given, Mapping):
        return read_map(given)
    if isinstance(given, str | os.PathLike):
        return read_map(given_map(os.fspath(given), {}, ()))
    raise InputError(
        f"map {given!r} is not allowed; it must be the path of a recording map, its"
        " entries as a dictionary, or a RecordingMap"
    )


def canonical_key(name: str) -> str:
    """Return the map key without a unit for a column, such as `pressure_plus_1`."""
    match = re.fullmatch(r"(.+_\d{1,3})(?:[_ ]+[a-z]+)?", bracketed(name)[0].lower())
    return match[1] if match else name.lower()
