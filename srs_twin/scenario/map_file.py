"""Obstacles from ROS occupancy maps and from CSV lists of circles.

A map is a YAML file for the ROS package ``map_server``. The file names a picture and
states the pixel size and the pose of the lower left corner. The colour c of a pixel is
the mean of red, green and blue (0 to 255). The occupancy of the cell is (255 − c)/255,
or c/255 if `negate` is true.

In the mode ``trinary``, a cell is free if the occupancy is below `free_thresh`. In the
mode ``scale``, a cell is free if 100 (occupancy − `free_thresh`)/(`occupied_thresh` −
`free_thresh`) rounds to 0 or less. All other cells, including unknown cells, become
obstacles.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field, field_validator

from srs_twin.errors import InputError
from srs_twin.io.documents import Document, load_yaml
from srs_twin.io.files import display_path, read_text, require_file
from srs_twin.io.validation import StrictModel, validate
from srs_twin.robot.world import Circle, Polygon

CIRCLE_COLUMNS = ("x_m", "y_m", "radius_m")
"""Columns of a CSV file that lists circles."""
MAX_PIXELS = 25_000_000
"""Maximum number of pixels in a map, enough for 250 m by 250 m with 0.05 m pixels."""
MAX_RECTANGLES = 20_000
"""Maximum number of rectangular obstacles in a map. Each rectangle adds 1 ms to the
planning time. It also adds 2 ms and 40 kB of memory to a run of the twin."""

_MODES = ("1", "L", "P", "RGB")
"""Pillow image modes without transparency and with at most 8 bits per channel."""
_DEPTH_BYTE = 24
"""Index of the byte in a PNG file that states the number of bits per channel. The byte
is read directly, because Pillow reduces 16-bit colours to 8 bits."""
_ALLOWED = (
    "the picture has an unsupported format; use a PNG or PGM picture with at most 8"
    " bits per channel and without transparency"
)
_WHITE = 3 * 255
"""Sum of red, green and blue of a white pixel."""
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_QUOTED_LIST = re.compile(
    rf"\s*\[?\s*{_NUMBER.pattern}(?:\s*,\s*{_NUMBER.pattern}){{2}}\s*\]?\s*"
)
_BOOLEANS = dict.fromkeys(("0", "n", "no", "off", "false"), False)
_BOOLEANS |= dict.fromkeys(("1", "y", "yes", "on", "true"), True)
"""Words for Boolean values in YAML 1.1."""


class MapFile(StrictModel):
    """YAML file of an occupancy map. As in ROS, unknown keys are ignored."""

    model_config = ConfigDict(extra="ignore")

    image: Annotated[str, Field(min_length=1, max_length=1000)]  # Picture path.
    resolution: Annotated[float, Field(ge=1e-4, le=100.0)]  # Side of a pixel, m.
    # Position x, y (m) and rotation (rad) of the lower left corner.
    origin: tuple[Annotated[float, Field(ge=-1e4, le=1e4)], ...]
    mode: Literal["trinary", "scale"] = "trinary"
    negate: bool = False
    occupied_thresh: Annotated[float, Field(ge=0.0, le=1.0)] = 0.65
    free_thresh: Annotated[float, Field(ge=0.0, le=1.0)] = 0.196

    @field_validator("mode", mode="before")
    @classmethod
    def _any_case(cls, mode: object) -> object:
        if isinstance(mode, str):
            return mode.lower()
        return mode

    @field_validator("origin", mode="before")
    @classmethod
    def _unquoted(cls, value: object) -> object:
        """Parse a list that is written as a string, such as "[0.0, 0.0, 0.0]"."""
        if isinstance(value, str) and _QUOTED_LIST.fullmatch(value):
            value = [float(number) for number in _NUMBER.findall(value)]
        # A validator in a strict model must return a tuple instead of a list.
        if isinstance(value, list):
            return tuple(value)
        return value

    @field_validator("negate", mode="before")
    @classmethod
    def _boolean(cls, text: object) -> bool:
        """Parse a YAML 1.1 boolean, which may be quoted."""
        if (value := _BOOLEANS.get(str(text).lower())) is None:
            raise ValueError(
                f"must be true, yes, on, 1 or false, no, off, 0, not {text!r:.50}"
            )
        return value

    def contradictions(self) -> Iterator[tuple[tuple[str], str]]:
        """Yield the path and message of each contradiction between keys."""
        if (count := len(self.origin)) != 3:
            yield (
                ("origin",),
                (
                    "must be a list of 3 numbers, x, y and rotation, not a list of"
                    f" {count}"
                ),
            )
        if self.free_thresh >= self.occupied_thresh:
            yield (
                ("free_thresh",),
                f"must be below `occupied_thresh`, which is {self.occupied_thresh:g}",
            )

    def blocked(self, colour: np.ndarray) -> np.ndarray:
        """Return a mask of the cells that become obstacles.

        Args:
            colour: sum of red, green and blue of each cell.
        """
        levels = np.arange(_WHITE + 1)
        if not self.negate:
            levels = levels[::-1]
        above = levels / _WHITE - self.free_thresh
        if self.mode == "trinary":
            occupied = above >= 0
        else:
            occupied = 200 * above > self.occupied_thresh - self.free_thresh
        wall: np.ndarray = occupied[colour]
        return wall


def read_map(path: Path) -> tuple[Polygon, ...]:
    """Return rectangles that cover exactly the cells of a map that are not free.

    Raises:
        InputFileError: a value is not allowed, or the picture cannot be read.
        InputError: the file cannot be read.
    """
    document = _document(path)
    rectangles: list[list[int]] = []
    if file := validate(MapFile, document, document.data):
        with document.report_errors("image"):
            rectangles = _rectangles(file.blocked(_colours(Path(file.image)))[::-1])
    document.raise_problems()
    assert file is not None, "no problem was reported"
    size, (x, y, turn) = file.resolution, file.origin
    c = math.cos(turn)
    s = math.sin(turn)
    polygons = []
    for column, row, right, top in rectangles:
        corners = ((column, row), (right, row), (right, top), (column, top))
        places = ((size * u, size * v) for u, v in corners)
        polygons.append(
            Polygon(tuple((x + c * u - s * v, y + s * u + c * v) for u, v in places))
        )
    return tuple(polygons)


def _document(path: Path) -> Document:
    document = load_yaml(path)
    document.locate(("image",))
    return document


def pictures_of(path: Path) -> list[Path]:
    """Return a list with the picture path of a map, or an empty list on error."""
    try:
        return [Path(_document(path).data["image"])]
    except (InputError, KeyError, TypeError):
        return []


def read_circles(path: Path) -> tuple[Circle, ...]:
    """Return the circles of a CSV file with the columns x_m, y_m and radius_m.

    Raises:
        InputError: the file cannot be read, a column is missing or repeated, or a row
            is not a circle.
    """
    name = display_path(path)
    rows = csv.DictReader(read_text(path).splitlines())
    header = rows.fieldnames or ()
    missing = [column for column in CIRCLE_COLUMNS if column not in header]
    if missing:
        raise InputError(
            f"{name}:1: the column '{missing[0]}' is missing; the columns"
            f" {', '.join(CIRCLE_COLUMNS)} are required"
        )
    repeated = [column for column in CIRCLE_COLUMNS if header.count(column) > 1]
    if repeated:
        raise InputError(
            f"{name}:1: the column '{repeated[0]}' is repeated; remove or rename one"
        )
    circles = []
    for row in rows:
        line = rows.line_num  # empty lines are skipped
        if None in row:
            raise InputError(
                f"{name}:{line}: the row has more values than the header; remove"
                " trailing commas, and write decimals with a point"
            )
        try:
            x, y, radius = (float(row[column]) for column in CIRCLE_COLUMNS)
        except (TypeError, ValueError):
            raise InputError(
                f"{name}:{line}: the row must have three numbers"
                f" ({', '.join(CIRCLE_COLUMNS)})"
            ) from None
        if not (math.isfinite(x) and math.isfinite(y) and 0 < radius < math.inf):
            raise InputError(
                f"{name}:{line}: the numbers must be finite and the radius above 0"
            )
        circles.append(Circle(x, y, radius))
    return tuple(circles)


def _colours(path: Path) -> np.ndarray:
    """Return the sum of red, green and blue of each pixel, shape (rows, columns).

    Raises:
        InputError: the picture has an unsupported format, is damaged or is too large.
    """
    from PIL import Image, UnidentifiedImageError

    name = display_path(require_file(path, suffix=".pgm"))
    too_large = (
        f"the picture must have between 1 and {MAX_PIXELS:,} pixels; crop it or"
        " reduce its size"
    )
    try:
        with path.open("rb") as stream:
            depth = stream.read(_DEPTH_BYTE + 1)[_DEPTH_BYTE:]
            picture = Image.open(stream, formats=["PNG", "PPM"])
            width, height = picture.size
            if not 0 < width * height <= MAX_PIXELS:
                raise InputError(f"{name}: {width} x {height} pixels; {too_large}")
            is_deep = picture.format == "PNG" and depth > b"\x08"
            is_clear = picture.has_transparency_data
            if is_deep or is_clear or picture.mode not in _MODES:
                raise InputError(f"{name}: {_ALLOWED}")
            colours = np.asarray(picture.convert("RGB"))
            total: np.ndarray = colours.sum(axis=2, dtype=np.uint32)
            return total
    except InputError:
        raise
    except UnidentifiedImageError:
        raise InputError(f"{name}: {_ALLOWED}") from None
    except Image.DecompressionBombError:
        raise InputError(f"{name}: {too_large}") from None
    except Exception as error:  # a decoder may raise any exception for a damaged file
        raise InputError(
            f"{name}: the picture is damaged ({error}); save it again as PNG or PGM"
        ) from error


def _rectangles(full: np.ndarray) -> list[list[int]]:
    """Cover the occupied cells with rectangles (left, bottom, right, top).

    Each rectangle covers a run of occupied cells in one row, and in all following rows
    that contain the same run.

    Raises:
        InputError: more than `MAX_RECTANGLES` rectangles are needed.
    """
    width = full.shape[1] + 1
    edges = np.flatnonzero(
        np.diff(np.pad(full, ((0, 0), (0, 1))).ravel(), prepend=False)
    )
    begin = edges[::2]
    end = edges[1::2]

    def has_equal(shift: int) -> np.ndarray:
        at = np.minimum(np.searchsorted(begin, begin + shift), len(begin) - 1)
        equal: np.ndarray = (begin[at] == begin + shift) & (end[at] == end + shift)
        return equal

    first, last = (np.flatnonzero(~has_equal(shift)) for shift in (-width, width))
    if len(first) > MAX_RECTANGLES:
        raise InputError(
            f"the occupied cells of the map need {len(first):,} rectangles, but only"
            f" {MAX_RECTANGLES:,} are allowed; remove specks with a median filter,"
            " crop the map or reduce its size"
        )
    # Rectangles in the same columns do not overlap, so the n-th start row of a column
    # range belongs to its n-th end row.
    first, last = (
        x[np.lexsort((x, end[x] % width, begin[x] % width))] for x in (first, last)
    )
    left = begin[first] % width
    bottom = begin[first] // width
    corners = np.transpose([left, bottom, end[first] % width, begin[last] // width + 1])
    rectangles: list[list[int]] = corners.tolist()
    return rectangles
