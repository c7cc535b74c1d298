"""What readers of recordings share: the start of a file, what a file leaves open, numbers in headers."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from srs_twin.errors import InputError, did_you_mean
from srs_twin.io.files import printable, shown
from srs_twin.recordings.csv_table import AS_FOUND, Dialect, RecordedFile, laid_out, recording_file
from srs_twin.recordings.marker_table import MarkerTable, plausible
from srs_twin.recordings.signals.units import LENGTHS, bracketed, clean, symbol

_PEEK = 1 << 16  # bytes that tell a format
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


@dataclass(frozen=True)
class Start:
    """The start of a file.

    Attributes:
        name: of the file, as messages show it.
        raw: its first bytes, with a byte order mark where it has one.
        dialect: layout of a plain table, where it is not found.
    """

    name: str
    raw: bytes
    dialect: Dialect = AS_FOUND

    @cached_property
    def table(self) -> RecordedFile:
        """The start as a plain table."""
        return laid_out(RecordedFile(self.name, self.raw), self.dialect)

    @cached_property
    def line(self) -> str:
        """The first line of text that is not blank."""
        raw = self.raw.removeprefix(b"\xef\xbb\xbf")
        wide = raw.startswith((b"\xff\xfe", b"\xfe\xff"))  # the reader says how to save it
        text = raw.decode("utf-16" if wide else "utf-8", "replace")
        return next((line for line in text.splitlines() if line.strip()), "")

    @property
    def title(self) -> str:
        """The first cell of that line."""
        return re.split(r"[,\t]", self.line)[0].strip(' "')


def start_of(path: str | os.PathLike[str], dialect: Dialect = AS_FOUND) -> Start:
    """Read the start of a file.

    Raises:
        InputError: it is missing or cannot be read.
    """
    place = recording_file(path)
    name = shown(place)
    try:
        with place.open("rb") as stream:
            return Start(name, stream.read(_PEEK), dialect)
    except OSError as error:
        raise InputError(f"{name}: cannot be read ({error.strerror})") from error


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


def length_unit(file: RecordedFile, unit: str, line: int | None = None, column: int | None = None) -> float:
    """Return the factor from a unit of length to m.

    Raises:
        InputError: it is not known.
    """
    factor = LENGTHS.get(symbol(unit, LENGTHS))
    if factor is None:
        hint, allowed = did_you_mean(unit, LENGTHS), ", ".join(LENGTHS)
        what = printable(f"unit of length '{unit[:20]}' is not known")
        raise file.error(f"{what}{hint}; allowed: {allowed}", line, column)
    return factor


def frame_rate(file: RecordedFile, given: str, line: int | None = None) -> float:
    """Return the frames a second that a file or a map gives.

    Raises:
        InputError: no positive number.
    """
    try:
        rate = float(given)
    except ValueError:
        rate = 0.0
    if not 0 < rate < 1e6:
        raise file.error(f"frame rate '{given[:20]}' is not allowed; frames a second are wanted", line)
    return rate


def numbered(
    file: RecordedFile, numbers: np.ndarray, header_lines: int, what: str, column: int = 1
) -> np.ndarray:
    """Return a column, counted from 1, of which no cell may be blank."""
    if (missing := np.isnan(numbers)).any():
        raise file.error(f"a row without a {what}", header_lines + 1 + int(missing.argmax()), column)
    return numbers


def announced(text: str) -> int | None:
    """Return the number of frames that a header announces; None where it is no number."""
    return int(text) if text.isdecimal() and len(text) < 10 else None


def converted(units: Iterable[str]) -> list[str]:
    """Return that lengths were converted, in words; empty where all are m."""
    others = ", ".join(sorted({*units} - {"m"}))
    return [f"lengths converted from {others} to m"] if others else []


def marker_table(
    file: RecordedFile, kind: str, time: np.ndarray, points: np.ndarray, names: Sequence[str],
    notes: Sequence[str], *, frames: int | None = None, rotations: np.ndarray | None = None,
    epoch_ns: int | None = None,
) -> MarkerTable:  # fmt: skip
    """Return markers as a reader found them, without implausible points and with printable names."""
    points, implausible = plausible(points)
    if rotations is not None:
        rotations = np.where(
            np.isnan(points[..., :1] + rotations.sum(axis=-1, keepdims=True)), np.nan, rotations
        )
    labels = tuple(printable(name) or f"point {k}" for k, name in enumerate(names, start=1))
    corrections = (*notes, *implausible)
    about = file.name, file.sha256, kind
    return MarkerTable(*about, time, points, labels, corrections, (), frames, rotations, epoch_ns)


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
        said = printable(" ".join(str(error).split()))[:120]
        reason = f" ({said})" if isinstance(error, ValueError) else ""
        raise file.error(f"a damaged {kind} file{reason}; record or export it anew") from error
