"""Readers for position tables in the formats TRC, TUM, DeepLabCut and plain CSV."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from string import ascii_letters
from typing import final

import numpy as np

from srs_twin.recordings.csv_table import (
    CLOCK,
    CsvColumn,
    CsvTable,
    not_used,
    read_table,
)
from srs_twin.recordings.formats.base import (
    Format,
    MarkerTable,
    UnknownFormatError,
    Unstated,
    announced,
    axis_columns,
    frame_rate,
    length_unit,
    marker_rows,
    marker_table,
)
from srs_twin.recordings.recorded_file import Dialect, RecordedFile, laid_out
from srs_twin.recordings.signals.units import LENGTHS, is_clock

_AXES_LINE = 5
"""Number of the line X1, Y1, Z1, …, after which an empty line may follow."""


@final
class Trc(Format):
    """TRC file with tab-separated marker positions (OpenSim, Cortex)."""

    name = "TRC"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with the key `PathFileType`."""
        return start.title.split(maxsplit=1)[:1] == ["PathFileType"]

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read the markers, where empty cells denote missing markers."""
        file = replace(file, separator="\t")
        lines = file.head(_AXES_LINE + 2)
        if len(lines) <= _AXES_LINE or lines[3][:1] != ["Frame#"]:
            raise file.error(
                "the header is incomplete; line 4 must have 'Frame#', 'Time' and the"
                " names of the markers",
                4,
            )
        header = _AXES_LINE + (not any(lines[_AXES_LINE]))
        fields = dict(zip(lines[1], lines[2], strict=False))
        names = [name for name in lines[3][2:] if name]
        row = lines[min(header, len(lines) - 1)]
        width = len(row)
        required = 2 + 3 * len(names)
        # A row may end with additional tabs.
        if not names or width < required or any(row[required:]):
            raise file.error(
                f"the row has {width} cells for {len(names)} markers; each row must"
                f" have {required} cells",
                header + 1,
            )
        stated = fields.get("DataRate")
        rate = frame_rate(file, stated, 3) if stated else None
        unit = length_unit(file, fields.get("Units") or unstated.unit or "", 3)
        time, points, _, notes = marker_rows(
            file, header, width, range(2, required, 3), clock=(0, 1), rate=rate
        )
        table = marker_table(file, self.name, time, points, names, notes, unit=unit)
        return replace(table, header_frames=announced(fields.get("NumFrames", "")))


_COMMENTS = re.compile(rb"(?:[ \t]*#[^\n]*\n|[ \t\r]*\n)*")
_TUM_START = re.compile(
    _COMMENTS.pattern + rb"[ \t]*(?:[-+.\deE]+[ \t]+){7}[-+.\deE]+[ \t\r]*\n"
)
_TUM_POSE = Dialect(("time", "x", "y", "z", "qx", "qy", "qz", "qw"), " ")
_NO_NAME = re.compile(r"[#,]|\[.*?\]|\(.*?\)")
"""Parts of a comment that are not column names, such as units in brackets."""
_MAX_NORM_ERROR = 0.01


@final
class Tum(Format):
    """Trajectory of one body in the TUM format of SLAM tools, in s and m.

    Each line contains ``timestamp tx ty tz qx qy qz qw``. A comment with these names
    may state another order of the quaternion.
    """

    name = "TUM trajectory"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether the first data line contains eight numbers without commas."""
        return bool(_TUM_START.match(start.data.removeprefix(b"\xef\xbb\xbf")))

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read the poses of one body."""
        file = laid_out(file, _TUM_POSE)
        _, points, quaternions, notes = marker_rows(
            file, file.header_lines, 8, [1], others=_quaternion_columns(file)
        )
        times = file.times(0, "s")
        if (np.abs(np.linalg.norm(quaternions, axis=-1) - 1) > _MAX_NORM_ERROR).any():
            raise file.error(
                "eight numbers per line are read as time, x, y, z and a quaternion,"
                " but the norm of the quaternion is not 1"
            )
        table = marker_table(
            file,
            self.name,
            times.time,
            points,
            [Path(file.name).stem],
            notes + times.notes,
            rotations=quaternions[:, None],
        )
        return replace(table, epoch_ns=times.epoch_ns)


def _quaternion_columns(file: RecordedFile) -> list[int]:
    """Return the columns of qx, qy, qz and qw, as a comment of a TUM file states."""
    names = ("qx", "qy", "qz", "qw")
    comments = file.raw[: file.offset_of(file.header_lines)]
    for line in comments.decode("utf-8", "replace").lower().splitlines():
        words = _NO_NAME.sub(" ", line).split()
        if len(words) == 8 and {*names} <= {*words}:
            return [words.index(name) for name in names]
    return [4, 5, 6, 7]


MIN_LIKELIHOOD = 0.6
"""Minimum likelihood of a valid sample (default of `pcutoff` in DeepLabCut)."""


@final
class DeepLabCut(Format):
    """CSV file of DeepLabCut, with coordinates in pixels or in a unit of length.

    The file has three header rows for one animal and four for several animals.
    """

    name = "DeepLabCut CSV"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with the row `scorer`."""
        return start.title.lower() == "scorer"

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read the tracks in the image plane.

        The coordinates are in pixels if the unit in `unstated` is None or "px".
        """
        factor = _dlc_scale(file, unstated)
        rate = frame_rate(file, str(unstated.rate_hz))
        lines = {cells[0]: cells for cells in file.head(4) if cells}
        if not {"bodyparts", "coords"} <= lines.keys():
            raise file.error(
                "the header is incomplete; it must have the rows scorer,"
                " (individuals,) bodyparts and coords",
                2,
            )
        coords = lines["coords"]
        parts = lines["bodyparts"]
        animals = lines.get("individuals")
        top = 4 if animals else 3
        width = len(coords)
        if width < 4 or coords[1:] != ["x", "y", "likelihood"] * (width // 3):
            raise file.error(
                "each body part must have the columns x, y and likelihood", top
            )
        if len(parts) != width or (animals and len(animals) != width):
            raise file.error(f"the rows of the header must have {width} cells", top)
        places = range(1, width, 3)
        names = [f"{animals[k]}:{parts[k]}" if animals else parts[k] for k in places]
        time, samples, _, notes = marker_rows(file, top, width, places, rate=rate)
        points = samples[..., :2] * [factor, -factor]
        seen = np.isfinite(points).all(axis=-1)
        unlikely = seen & ~(samples[..., 2] >= MIN_LIKELIHOOD)
        points[unlikely] = np.nan
        notes += [
            (
                f"{int(unlikely.sum())} samples with a likelihood below"
                f" {MIN_LIKELIHOOD} are read as missing"
            ),
            "y is reversed, because it points down in images",
            f"the coordinates are multiplied by {factor:g} to convert them to m",
        ]
        table = marker_table(file, self.name, time, points, names, notes)
        return replace(table, unit=unstated.unit or "px")


def _dlc_scale(file: RecordedFile, unstated: Unstated) -> float:
    pixels = unstated.unit in (None, "px")
    missing = []
    if not unstated.rate_hz:
        missing.append("`rate_hz` (frames per second of the video)")
    if pixels and not unstated.scale_m:
        missing.append(
            "`scale_m` (m per pixel, or `unit` if the coordinates are lengths)"
        )
    if missing:
        raise file.error(
            "DeepLabCut files contain only frame numbers and pixel coordinates; give"
            f" {' and '.join(missing)}"
        )
    if pixels:
        return unstated.scale_m or 0.0
    return LENGTHS[length_unit(file, unstated.unit or "")]


_NUMBERED = re.compile(r"[xyz]_\d+(?![A-Za-z0-9]{2})", re.IGNORECASE)
_CONNECTOR = re.compile(r"\d+[A-Za-z]?")


@final
class PlainCsv(Format):
    """Plain CSV file, usually with the columns ``time`` and ``x_1,y_1…``.

    The markers are numbered from the head. Two markers on one connector have the
    columns ``x_1a,y_1a,x_1b,y_1b``. Columns for heights, such as ``z_1``, are optional.
    A column name may contain a unit (``time_ms``, ``x_1_mm`` or ``x_1 (mm)``). The
    default units are s and m.
    """

    name = "plain CSV"

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether the first line names a time or position column."""
        return any(map(is_clock, start.names)) or bool(axis_columns(start.names))

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read the markers of a plain CSV file."""
        file = laid_out(file, unstated.dialect)
        numbered = any(map(_NUMBERED.match, file.names))
        table = read_table(file, CLOCK)
        clock = next(iter(table.columns), None)
        markers = _marker_columns(table, numbered, unstated.unit)
        if not clock and not unstated.rate_hz:
            raise file.error(
                "the column 'time' is missing, and no frame rate is given. The first"
                " line must name the columns (time,x_1,y_1,x_2,y_2,…), or give the"
                " frame rate with --rate or `rate_hz`",
                file.header_lines or 1,
            )
        chosen = _in_given_unit(table, markers, unstated)
        rows = table.read_timed(clock, chosen, unstated.rate_hz)
        used = [clock, *chosen] if clock else chosen
        notes = rows.notes + _unit_notes(used, unstated.unit)
        places = {column.place for column in used}
        notes += not_used(
            [name or "''" for k, name in enumerate(file.names) if k not in places]
        )
        points = rows.values.reshape(len(rows.time), len(markers), -1)
        stated = min({column.unit for column in chosen} - {""}, default="m")
        return replace(
            marker_table(file, self.name, rows.time, points, list(markers), notes),
            places=tuple(
                (2 * (_place(name)[0] - 1), "") for name in markers if numbered
            ),
            epoch_ns=rows.epoch_ns,
            unit=unstated.unit or stated,
        )


def _in_given_unit(
    table: CsvTable, markers: dict[str, list[CsvColumn]], unstated: Unstated
) -> list[CsvColumn]:
    unit = unstated.unit
    scale = LENGTHS.get(unit or "m")
    if unit == "px":
        scale = unstated.scale_m
    if not scale:
        raise table.file.error(
            "the unit px needs the size of a pixel in m; give it as `scale_m`"
        )
    columns = [column for axes in markers.values() for column in axes]
    if not unit:
        table.check_units(columns)
    for column in columns:
        if unit and column.unit not in ("", unit):
            raise table.error(
                column,
                f"'{column.text}' is in {column.unit} according to its name, but in"
                f" {unit} according to the map or --units; correct one of them",
            )
    return [
        column if column.unit else replace(column, factor=scale) for column in columns
    ]


def _unit_notes(used: list[CsvColumn], given: str | None) -> list[str]:
    notes = []
    units = sorted({column.unit or given or "" for column in used} - {"", "m", "s"})
    if units:
        notes.append(f"values were converted from {', '.join(units)} to SI units")
    without = [column.text for column in used if not column.unit]
    if without and not given:
        notes.append(
            f"{len(without)} columns without a unit ({without[0]}, …) are assumed to"
            " be in s and m"
        )
    return notes


def _place(marker: str) -> tuple[int, str]:
    number = marker.rstrip(ascii_letters)
    return int(number), marker[len(number) :]


def _refuse_two_units(file: RecordedFile, place: int, units: Sequence[str]) -> None:
    raise file.error(
        f"the name '{file.names[place]}' has two units, {' and '.join(units)}; remove"
        " one, or state the unit in a map or with --units",
        file.header_lines or 1,
        place + 1,
    )


def _marker_columns(
    table: CsvTable, numbered: bool, given: str | None
) -> dict[str, list[CsvColumn]]:
    file = table.file
    line = table.file.header_lines or 1
    names = [
        name if not numbered or _NUMBERED.match(name) else "" for name in file.names
    ]
    refuse = None if given else partial(_refuse_two_units, file)
    markers = axis_columns(names, refuse)
    if numbered:
        markers = {
            name: markers[name]
            for name in sorted(filter(_CONNECTOR.fullmatch, markers), key=_place)
        }
    if not markers:
        required = "columns x_1,y_1,x_2,y_2,… (head first) or NAME_x,NAME_y"
        problem = f"the file contains no positions; it must have {required}"
        raise UnknownFormatError(str(file.error(problem, line)))
    used = {column.place for axes in markers.values() for column in axes.values()}
    for place, name in enumerate(names):
        if file.names.count(name) > 1:
            raise file.error(
                f"two columns have the name '{name}'; rename one of them",
                line,
                place + 1,
            )
        if numbered and name and place not in used:
            required = (
                "each marker must have one column x and one column y, in"
                f" {', '.join(LENGTHS)}"
            )
            raise file.error(
                f"the column '{name}' belongs to no marker; {required}", line, place + 1
            )
    numbers = [_place(name)[0] for name in markers if numbered]
    if missing := {*range(1, max(numbers, default=0))} - {*numbers}:
        problem = (
            f"the column 'x_{min(missing)}' is missing; connectors are numbered from"
            " 1 at the head"
        )
        raise file.error(problem, line)
    if any("z" in axes for axes in markers.values()):
        letters = "xyz"
    else:
        letters = "xy"
    for name, axes in markers.items():
        if letters[-1] not in axes:
            raise file.error(
                f"the column {name}_z is missing, although other markers have such a"
                " column; add it, or remove all z columns",
                line,
            )
    return {name: [axes[axis] for axis in letters] for name, axes in markers.items()}
