"""Options of commands that read recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from srs_twin.cli.options import option

if TYPE_CHECKING:
    from srs_twin.recordings.takes import RecordingReader

_LOGS = "Logs: one for each FILE, then one for each --validate. [default: NAME.valves.csv in the same folder]"


ValvesOption = Annotated[list[str] | None, option("--valves LOG", _LOGS)]


_OFFSET = "Clock offset added to the times of the logs, s. [default: estimated]"


OffsetOption = Annotated[float | None, option("--offset S", _OFFSET)]


FrequencyOption = Annotated[
    float | None, option("--frequency HZ", "Gait frequency, Hz. [default: that of the valve pattern]")
]


@dataclass(frozen=True)
class ReadingOptions:
    """Options of `RecordingReader`.

    Options:
        up: Upward axis of the files: x, y, z, -x, -y, -z or auto.
        layout: Markers: auto, single, head, pair, middles or head_middles.
        head: Name of the marker at the head. [default: the end in the direction of motion]
        longest_gap: Longest gap that is interpolated, s. [default: 0.2]
        map: Recording map: quantities of markers and columns (docs/logs.md).
        units: Unit of lengths if the file states none: m, cm, mm, in, ft.
        rate: Frames per second if the file has no time.
        columns: Column names of a plain file without a header, e.g. time,x_1,y_1.
        separator: Cell separator of a plain file: , ; | tab or space. [default: detected]
        decimal: Decimal mark of a plain file. [default: detected]
        marker: Position of a marker, e.g. "tip=connector 3" or "m1=middle 1" (repeatable).
    """

    up: Annotated[str, option("--up AXIS")] = "auto"
    layout: Annotated[str, option("--layout NAME")] = "auto"
    head: Annotated[str | None, option("--head MARKER")] = None
    longest_gap: Annotated[float | None, option("--longest-gap S")] = None
    map: Annotated[str | None, option("--map FILE.yaml")] = None
    units: Annotated[str | None, option("--units UNIT")] = None
    rate: Annotated[float | None, option("--rate HZ")] = None
    columns: Annotated[str | None, option("--columns NAMES")] = None
    separator: Annotated[str | None, option("--separator CHARACTER")] = None
    decimal: Annotated[str | None, option("--decimal CHARACTER")] = None
    marker: Annotated[list[str] | None, option("--marker NAME=PLACE")] = None

    def given(self) -> dict[str, Any]:
        """Return the given options by the names of `RecordingReader`'s attributes; a map is plain data."""
        from srs_twin.recordings.recording_map import given_map

        options = {
            "units": self.units, "rate_hz": self.rate, "columns": self.columns, "separator": self.separator,
            "decimal": self.decimal,
        }  # fmt: skip
        values = {
            "up": self.up, "layout": self.layout, "head": self.head, "longest_gap_s": self.longest_gap,
            "map": given_map(self.map, options, self.marker or ()),
        }  # fmt: skip
        return {name: value for name, value in values.items() if value is not None}

    def reader(self, **more: Any) -> RecordingReader:
        """Return a reader with these options.

        Raises:
            InputFileError: the map is invalid.
        """
        from srs_twin.recordings.recording_map import read_map
        from srs_twin.recordings.takes import RecordingReader

        given = self.given()
        return RecordingReader(**given | {"map": read_map(given.get("map", {}))}, **more)
