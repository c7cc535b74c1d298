"""Marker tables, base class for file formats, and helpers for axes and units."""

from __future__ import annotations

import re
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from srs_twin.errors import InputError, did_you_mean
from srs_twin.io.files import escape_unprintable
from srs_twin.recordings.csv_table import CsvColumn
from srs_twin.recordings.recorded_file import AS_FOUND, Dialect, RecordedFile
from srs_twin.recordings.signals.units import LENGTHS, bracketed, clean, symbol

MAX_DISTANCE = 1e3
"""Maximum magnitude of a coordinate that is accepted as a position, m."""

_MIN_ZEROS = 3
"""Minimum number of frames at (0, 0, 0) for treating this position as missing."""

_UNIT = r"(?P<unit>mm|cm|m|in|ft|um)"
_AXIS_LAST = re.compile(
    r"(?P<name>.*?)[ _.:\-\[(]*(?<![A-Za-z])(?P<axis>[xyz])[\])]?(?:[ _]*"
    + _UNIT
    + ")?",
    re.IGNORECASE,
)
_AXIS_FIRST = re.compile(
    r"(?P<axis>[xyz])[ _.:\-](?P<name>\w.*?)(?:[ _]+" + _UNIT + ")?", re.IGNORECASE
)
_NOT_A_POSITION = re.compile(
    r"rot|rotation|orientation|orient|quat|quaternion|q|euler|angle|angles|"
    r"ang|angular|acc|accel|acceleration|gyro|gyr|gyroscope|mag|magnetometer|"
    r"magnetic|vel|velocity|speed|omega|force|moment|torque|momentum|jerk|"
    r"twist|linear|wrench|dir|direction|normal|std|sd|var|cov|err|error|"
    r"residual|imu",
    re.IGNORECASE,
)
"""Words that exclude a column with an axis letter from the positions."""


class UnknownFormatError(InputError):
    """Error for a file in an unknown format, or for a plain table without positions."""


class Unstated(NamedTuple):
    """Information from a map or from options that a file may lack.

    Attributes:
        rate_hz: frame rate of a file without a frame rate or times, Hz.
        unit: unit of length of a file that does not state it.
        scale_m: size of a pixel, m, for coordinates in pixels.
    """

    rate_hz: float | None = None
    unit: str | None = None
    scale_m: float | None = None
    dialect: Dialect = AS_FOUND


@dataclass(frozen=True)
class MarkerTable:
    """Marker positions in a file over time, in SI units and in the axes of the file.

    Attributes:
        kind: name of the file format, including the version if there are several.
        points: marker positions, m, shape (frames, columns, 3), or (…, 2) for positions
            in a plane. The position of a hidden marker is NaN.
        places: station and side of each column (see `body.markers.Places`), or an empty
            tuple if the column names do not state the places.
        header_frames: number of frames stated in the header, or None if the header
            states none.
        rotations: quaternions (x, y, z, w) of rigid bodies in the axes of the file,
            shape (frames, columns, 4), or None without rigid bodies. The rotations of
            other columns are NaN.
        bodies: whether the columns are rigid bodies. The two points that replace a
            rigid body are adjacent columns with the name of the body.
        epoch_ns: Unix time that corresponds to a time of 0 s, ns, or None if the file
            contains no Unix times.
        unit: unit of length in the file, which is stated, given by the user or assumed.
    """

    name: str
    sha256: str
    kind: str
    time: np.ndarray
    points: np.ndarray
    labels: tuple[str, ...]
    corrections: tuple[str, ...]
    places: tuple[tuple[int, str], ...] = ()
    header_frames: int | None = None
    rotations: np.ndarray | None = None
    bodies: bool = False
    epoch_ns: int | None = None
    unit: str = "m"

    @property
    def usual_up(self) -> str:
        """Usual vertical axis of the file format."""
        if self.kind.startswith(("Motive", "TRC")):
            return "y"
        return "z"


class Format(ABC):
    """Base class for the file formats of motion recordings.

    Subclasses convert lengths to m and times to s, and keep the axes of the file.
    """

    name: ClassVar[str]
    binary: ClassVar[bool] = False

    @abstractmethod
    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether the first bytes of a file match this format."""

    @abstractmethod
    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read the markers of a whole file.

        `unstated` contains information that the file may lack.

        Raises:
            InputError: the file is damaged, or required information is missing.
        """


def axis_columns(
    cells: Sequence[str], refuse: Callable[[int, Sequence[str]], None] | None = None
) -> dict[str, dict[str, CsvColumn]]:
    """Return the position columns in a header, keyed by marker name and axis.

    A column name ends or begins with the axis, for example ``base_x``, ``Tip X (mm)``
    or ``x_LED1``. Markers without x or y and columns of other quantities, such as
    rotations (``c1_rot_x``), are excluded. If a name contains two units, the column has
    no unit, and `refuse` is called with the column index and the units.
    """
    markers: dict[str, dict[str, CsvColumn]] = {}
    for index, cell in enumerate(cells):
        bare, bracket = bracketed(clean(cell.strip(' "')))
        unit = symbol(bracket, LENGTHS)
        if bracket and not unit:
            if bracket.lower() not in "xyz":
                continue
            bare = f"{bare} {bracket}"
        match = _AXIS_LAST.fullmatch(bare) or _AXIS_FIRST.fullmatch(bare)
        words = re.findall(r"[A-Z]*[a-z]+|[A-Z]+", match["name"]) if match else []
        if match and not any(map(_NOT_A_POSITION.fullmatch, words)):
            axis = match["axis"].lower()
            stated = sorted({unit, symbol(match["unit"] or "", LENGTHS)} - {""})
            unit = stated[0] if len(stated) == 1 else ""
            if len(stated) > 1 and refuse:
                refuse(index, stated)
            markers.setdefault(match["name"].strip(" _.:-") or "marker", {}).setdefault(
                axis, CsvColumn(index, axis, 0, unit, LENGTHS.get(unit, 1.0), cell)
            )
    return {name: axes for name, axes in markers.items() if {"x", "y"} <= axes.keys()}


def counted_times(frame: np.ndarray, time: np.ndarray, rate: float) -> np.ndarray:
    """Compute exact times from frame numbers, because times in files are rounded.

    The given times are returned if the computed times differ by more than half a frame
    period, for example in an incomplete export.
    """
    if not np.isfinite(frame).all():
        return time
    counted = time[0] + (frame - frame[0]) / rate
    if np.abs(counted - time).max() < 0.5 / rate:
        return np.asarray(counted)
    return time


def length_unit(
    file: RecordedFile, text: str, line: int | None = None, column: int | None = None
) -> str:
    """Return the symbol of a unit of length in any spelling."""
    if not (found := symbol(text, LENGTHS)):
        hint = did_you_mean(text, LENGTHS)
        allowed = ", ".join(LENGTHS)
        problem = escape_unprintable(f"the unit of length '{text[:20]}' is not known")
        raise file.error(f"{problem}{hint}; allowed: {allowed}", line, column)
    return found


def frame_rate(file: RecordedFile, given: str, line: int | None = None) -> float:
    """Return the frame rate (Hz) from text in a file or a map."""
    with suppress(ValueError):
        if 0 < float(given) < 1e6:
            return float(given)
    raise file.error(
        f"the frame rate '{given[:20]}' is not allowed; give a number of frames per"
        " second above 0",
        line,
    )


class Rows(NamedTuple):
    """Rows of a marker table.

    Attributes:
        points: marker positions in the unit of the file, shape (frames, markers, 3).
        others: values of the additional columns, shape (frames, columns).
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
    """Read the rows of a marker table.

    Args:
        file: recorded table.
        header_lines: number of header lines.
        width: number of cells per row.
        first: index of the first of the three columns of each marker.
        clock: indices of the columns with the frame number, the time or both. If
            `clock` is empty, the row numbers are used instead.
        rate: frame rate, Hz, or None if a column contains times.
        others: indices of additional columns.
        section: whether the rows end at an empty line.
    """
    columns = [*clock, *(k + axis for k in first for axis in range(3)), *others]
    values, notes = file.rows(header_lines, columns, width, section=section)
    count = len(clock)
    end = len(clock) + 3 * len(first)
    if clock:
        time = values[:, count - 1]
    else:
        time = np.arange(len(values)) + 0.0
    if (missing := ~np.isfinite(time)).any():
        if rate is None or count > 1:
            missing_name = "time"
        else:
            missing_name = "frame number"
        line = file.line_of_row(int(missing.argmax()), header_lines)
        raise file.error(f"the row has no {missing_name}", line, clock[-1] + 1)
    if rate is not None:
        if count > 1:
            time = counted_times(values[:, 0], time, rate)
        else:
            time = time / rate
    return Rows(
        time, values[:, count:end].reshape(len(values), -1, 3), values[:, end:], notes
    )


def announced(text: str) -> int | None:
    """Return the number of frames in a header, or None if the text is not a number."""
    if text.isdecimal() and len(text) < 10:
        return int(text)
    return None


def marker_table(
    file: RecordedFile,
    kind: str,
    time: np.ndarray,
    points: np.ndarray,
    names: Sequence[str],
    notes: Sequence[str],
    *,
    unit: str | Sequence[str] = "m",
    rotations: np.ndarray | None = None,
) -> MarkerTable:
    """Build a marker table in m, without implausible positions.

    `unit` is the unit of the given positions, or a sequence with the unit of each
    marker.
    """
    if not len(time):
        raise file.error("the recording has no frames; record or export it again")
    units = [unit] if isinstance(unit, str) else unit
    notes = list(notes)
    if converted := ", ".join(sorted({*units} - {"m"})):
        notes.append(f"lengths were converted from {converted} to m")
    points = points * np.array([[LENGTHS[symbol]] for symbol in units])
    unseen = _unseen(points, rotations)
    points[unseen] = np.nan
    finite = np.isfinite(points)
    incomplete = ~finite.all(axis=-1) & finite.any(axis=-1)
    with np.errstate(invalid="ignore"):
        far = (np.abs(points) > MAX_DISTANCE).any(axis=-1) & ~incomplete
    points[incomplete | far] = np.nan
    for samples, reason in (
        (unseen, "are exactly 0, 0, 0"),
        (incomplete, "lack a finite coordinate"),
        (far, f"are over {MAX_DISTANCE:g} m away"),
    ):
        if samples.any():
            notes.append(
                f"{int(samples.sum())} positions {reason} and are read as missing"
            )
    if rotations is not None:
        with np.errstate(invalid="ignore"):
            sums = points[..., :1] + rotations.sum(axis=-1, keepdims=True)
        missing = ~np.isfinite(sums)
        rotations = np.where(missing, np.nan, rotations)
    return MarkerTable(
        file.name,
        file.sha256,
        kind,
        time,
        points,
        tuple(
            escape_unprintable(name) or f"point {k}"
            for k, name in enumerate(names, start=1)
        ),
        tuple(notes),
        rotations=rotations,
        unit=", ".join(sorted({*units})),
    )


def _unseen(points: np.ndarray, rotations: np.ndarray | None) -> np.ndarray:
    """Return the mask of hidden markers, which some programs write as (0, 0, 0).

    A measured position is never exactly at the origin in several frames. Rigid bodies
    are excluded, because odometry starts at the origin.
    """
    zero = (points == 0).all(axis=-1)
    zero[:, zero.sum(axis=0) < _MIN_ZEROS] = False
    if points.shape[-1] < 3:
        zero[:] = False
    if rotations is not None:
        zero &= ~np.isfinite(rotations).any(axis=(0, 2))
    return np.asarray(zero)


def in_unit(table: MarkerTable, given: str | None) -> MarkerTable:
    """Return the table, or raise an error if its unit differs from the given unit."""
    if given not in (None, table.unit):
        raise InputError(
            f"{table.name}: the lengths are in {table.unit} according to the file, but"
            f" in {given} according to the map or --units; correct one of them"
        )
    return table


@contextmanager
def decoding(file: RecordedFile, kind: str) -> Iterator[None]:
    """Convert exceptions from a missing or failing library to `InputError`."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except ModuleNotFoundError as error:
        how = "`uv sync --extra recordings`, or `pip install 'srs-twin[recordings]'`"
        raise file.error(
            f"{kind} needs the optional package {error.name}; install it with {how}"
        ) from error
    except Exception as error:  # libraries raise any kind of error for damaged files
        message = escape_unprintable(" ".join(str(error).split()))[:120]
        if isinstance(error, ValueError):
            reason = f" ({message})"
        else:
            reason = ""
        raise file.error(
            f"the {kind} file is damaged{reason}; record or export it again"
        ) from error
