"""What is what in a recording of a lab: `--map recording.yaml`, or options for one recording."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.documents import Document, load_yaml
from srs_twin.io.validation import Strict, load_model, validate
from srs_twin.recordings.marker_table import MarkerTable

LOG_NAME = re.compile(
    r"(valve|duty|pressure(?:_(?:pa|kpa|bar|psi))?|setpoint(?:_(?:pa|kpa|bar|psi))?)_(plus|minus)_(\d{1,3})"
)
"""Keys of a log: valve_plus_1, duty_minus_2, pressure_kpa_plus_1, setpoint_kpa_plus_1."""

_IN_A_LOG = "time, carrier_hz, valve_plus_1, duty_plus_1, pressure_kpa_plus_1 or setpoint_kpa_plus_1"
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


class RecordingMap(Strict):
    """What is what in the files of a recording (docs/logs.md#a-map)."""

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
    log: dict[str, str | Annotated[float, Field(gt=0, le=1e4)]] = {}
    """Log: valve_plus_1, duty_plus_1, pressure_kpa_plus_1 or setpoint_kpa_plus_1 → column; time → its column;
    carrier_hz → frequency of the duties' carrier."""

    def contradictions(self) -> list[tuple[tuple[str, ...], str]]:
        """Report keys that a log has not, and places that are none or two."""
        found: list[tuple[tuple[str, ...], str]] = []
        for key, value in self.log.items():
            if key not in ("carrier_hz", "time") and not LOG_NAME.fullmatch(key):
                found.append((("log", key), f"a log has {_IN_A_LOG}"))
            elif (key == "carrier_hz") == isinstance(value, str):
                wanted = "a number" if key == "carrier_hz" else "a column's name"
                found.append((("log", key), f"{wanted} is wanted"))
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
    def columns(self) -> dict[str, str]:
        """Column of a log → what it holds, as `valve_plus_1` or `pressure_plus_1_kpa`."""
        named = {}
        for key, column in self.log.items():
            if isinstance(column, str):
                match = LOG_NAME.fullmatch(key)
                name, _, unit = match[1].partition("_") if match else (key, "", "")
                named[column] = (
                    "_".join([name, match[2], match[3], *([unit] if unit else [])]) if match else key
                )
        return named

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
