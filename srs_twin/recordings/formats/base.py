"""What readers of recordings share: the start of a file, what a file leaves open, numbers in headers."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from srs_twin.errors import InputError, did_you_mean
from srs_twin.io.files import escape_unprintable
from srs_twin.recordings.csv_table import AS_FOUND, Dialect, RecordedFile
from srs_twin.recordings.marker_table import MarkerTable
from srs_twin.recordings.signals.units import LENGTHS, bracketed, clean, symbol

FARTHEST = 1e3
"""Markers farther than this from the origin are no marker positions, m."""

_UNIT = r"(?P<unit>mm|cm|m|in|ft|um)"
_AXIS_LAST = re.compile(
    r"(?P<name>.*?)[ _.:\-\[(]*(?<![A-Za-z])(?P<axis>[xyz])[\])]?(?:[ _]*" + _UNIT + ")?", re.IGNORECASE
)
_AXIS_FIRST = re.compile(r"(?P<axis>[xyz])[ _.:\-](?P<name>\w.*?)(?:[ _]+" + _UNIT + ")?", re.IGNORECASE)
_NO_PLACE = set(
    "rot rotation orientation orient quat quaternion q euler angle angles ang angular acc accel acceleration "
    "gyro gyr gyroscope mag magnetometer magnetic vel velocity speed omega force moment torque momentum jerk "
    "twist wrench dir direction normal std sd var cov err error residual imu".split()
)
"""Words in names of columns with axes that hold something else than places."""


class Unstated(NamedTuple):
    """What a file may leave open, as a map or options give it.

    Attributes:
        rate_hz: frames a second.
        unit: of lengths.
        scale_m: size of a pixel, m.
        dialect: layout of a plain table.
    """

    rate_hz: float | None = None
    unit: str | None = None
    scale_m: float | None = None
    dialect: Dialect = AS_FOUND


def axis_columns(cells: Sequence[str]) -> dict[str, dict[str, tuple[int, str]]]:
    """Return marker → axis → column and unit of a header whose names end or begin with x, y or z.

    As ``base_x,base_y``, ``Tip X (mm)``, ``x_LED1``. Markers without x and y are left out, and rotations,
    velocities, accelerations and forces (``c1_rot_x``), or what is in another unit than one of length.
    """
    found: dict[str, dict[str, tuple[int, str]]] = {}
    for place, cell in enumerate(cells):
        bare, bracket = bracketed(clean(cell.strip(' "')))
        unit = symbol(bracket, LENGTHS)
        if bracket and not unit:
            if bracket.lower() not in "xyz":
                continue
            bare = f"{bare} {bracket}"
        match = _AXIS_LAST.fullmatch(bare) or _AXIS_FIRST.fullmatch(bare)
        if match and not _NO_PLACE & {
            word.lower() for word in re.findall(r"[A-Z]*[a-z]+|[A-Z]+", match["name"])
        }:
            found.setdefault(match["name"].strip(" _.:-") or "marker", {}).setdefault(
                match["axis"].lower(), (place, unit or symbol(match["unit"] or "", LENGTHS))
            )
    return {name: axes for name, axes in found.items() if {"x", "y"} <= axes.keys()}


def counted_times(frame: np.ndarray, time: np.ndarray, rate: float) -> np.ndarray:
    """Return times from frame numbers, as printed times are rounded, shape (frames,), s.

    A take exported from its middle counts frames or time from elsewhere; half a frame is rounding. Where the
    two differ by more, the printed times count.
    """
    if not np.isfinite(frame).all():
        return time
    counted = time[0] + (frame - frame[0]) / rate
    return np.asarray(counted) if np.abs(counted - time).max() < 0.5 / rate else time


def length_unit(file: RecordedFile, text: str, line: int | None = None, column: int | None = None) -> str:
    """Return the symbol of a unit of length.

    Raises:
        InputError: it is not known.
    """
    if not (found := symbol(text, LENGTHS)):
        hint, allowed = did_you_mean(text, LENGTHS), ", ".join(LENGTHS)
        what = escape_unprintable(f"unit of length '{text[:20]}' is not known")
        raise file.error(f"{what}{hint}; allowed: {allowed}", line, column)
    return found


def is_rate(given: str) -> bool:
    """Say whether a text is a number of frames a second."""
    try:
        return 0 < float(given) < 1e6
    except ValueError:
        return False


def frame_rate(file: RecordedFile, given: str, line: int | None = None) -> float:
    """Return the frames a second that a file or a map gives.

    Raises:
        InputError: no positive number.
    """
    if not is_rate(given):
        raise file.error(f"frame rate '{given[:20]}' is not allowed; frames a second are wanted", line)
    return float(given)


class Rows(NamedTuple):
    """Rows of a table of markers.

    Attributes:
        time: shape (frames,), s.
        points: in the file's unit, shape (frames, markers, 3).
        others: other columns, shape (frames, others).
        notes: samples that were left out, in words.
    """

    time: np.ndarray
    points: np.ndarray
    others: np.ndarray
    notes: list[str]


def marker_rows(
    file: RecordedFile,
    header_lines: int,
    width: int,
    first: Sequence[int],
    *,
    clock: Sequence[int] = (0,),
    rate: float | None = None,
    others: Sequence[int] = (),
    section: bool = False,
) -> Rows:
    """Read the rows of a table of markers.

    Args:
        file: the table.
        header_lines: lines above its rows.
        width: cells of a row.
        first: first of each marker's three columns, counted from 0.
        clock: columns of the frame number and the time; of one of the two; none where rows are counted.
        rate: frames a second; None: the column holds times.
        others: other columns to read.
        section: whether the rows end at an empty line.

    Raises:
        InputError: as `RecordedFile.rows`, or a row without its time.
    """
    columns = [*clock, *(k + axis for k in first for axis in range(3)), *others]
    values, notes = file.rows(header_lines, columns, width, section=section)
    count, end = len(clock), len(clock) + 3 * len(first)
    time = values[:, count - 1] if clock else np.arange(len(values)) + 0.0
    if (missing := np.isnan(time)).any():
        what = "time" if rate is None or count > 1 else "frame number"
        line = header_lines + 1 + int(missing.argmax())
        raise file.error(f"a row without a {what}", line, clock[-1] + 1)
    if rate is not None:
        time = counted_times(values[:, 0], time, rate) if count > 1 else time / rate
    return Rows(time, values[:, count:end].reshape(len(values), -1, 3), values[:, end:], notes)


def announced(text: str) -> int | None:
    """Return the number of frames that a header announces; None where it is no number."""
    return int(text) if text.isdecimal() and len(text) < 10 else None


def marker_table(
    file: RecordedFile,
    kind: str,
    time: np.ndarray,
    points: np.ndarray,
    names: Sequence[str],
    notes: Sequence[str],
    *,
    unit: str | Sequence[str] = "m",
    **more: Any,
) -> MarkerTable:
    """Return markers as a reader found them, without implausible points and with printable names.

    Args:
        file: the recording.
        kind: its format.
        time: shape (frames,), s.
        points: in `unit`, shape (frames, markers, 2 or 3).
        names: of the markers.
        notes: on the file, in words.
        unit: of all lengths, or of each marker's.
        **more: attributes of `MarkerTable`.
    """
    units = [unit] if isinstance(unit, str) else unit
    others = ", ".join(sorted({*units} - {"m"}))
    if others:
        notes = [*notes, f"lengths converted from {others} to m"]
    points = points * np.array([[LENGTHS[each]] for each in units])
    partly = ~np.isfinite(points).all(axis=-1) & np.isfinite(points).any(axis=-1)
    with np.errstate(invalid="ignore"):
        far = (np.abs(points) > FARTHEST).any(axis=-1)
    points = np.where((partly | far)[..., None], np.nan, points)
    for which, why in ((partly, "lacked a coordinate"), (far, f"lay over {FARTHEST:g} m away")):
        if which.any():
            notes = [*notes, f"{int(which.sum())} positions {why}: taken as not seen"]
    if (turns := more.get("rotations")) is not None:
        unseen = np.isnan(points[..., :1] + turns.sum(axis=-1, keepdims=True))
        more["rotations"] = np.where(unseen, np.nan, turns)
    labels = tuple(escape_unprintable(name) or f"point {k}" for k, name in enumerate(names, start=1))
    more["unit"] = ", ".join(sorted({*units}))
    return MarkerTable(file.name, file.sha256, kind, time, points, labels, tuple(notes), **more)


def in_unit(table: MarkerTable, given: str | None) -> MarkerTable:
    """Return a table, whose lengths are in the unit that a map or an option gives, or where none is given.

    Raises:
        InputError: the file states another unit.
    """
    if given not in (None, table.unit):
        what = f"lengths are in {table.unit} by the file, in {given} by the map or --units"
        raise InputError(f"{table.name}: {what}; correct one")
    return table


@contextmanager
def decoding(file: RecordedFile, kind: str) -> Iterator[None]:
    """Turn what a library raises on a damaged file, or its absence, into one `InputError`."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except ModuleNotFoundError as error:
        how = "`uv sync --extra recordings`, or `pip install 'srs-twin[recordings]'`"
        raise file.error(f"{kind} needs the package {error.name}, which is an extra: {how}") from error
    except Exception as error:  # libraries raise whatever their first wrong byte leads to
        said = escape_unprintable(" ".join(str(error).split()))[:120]
        reason = f" ({said})" if isinstance(error, ValueError) else ""
        raise file.error(f"a damaged {kind} file{reason}; record or export it anew") from error
