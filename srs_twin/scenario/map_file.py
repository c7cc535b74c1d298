"""Obstacles from ROS occupancy maps and from CSV lists of circles.

A map is a YAML file of the ROS ``map_server`` with a picture, its resolution and the
pose of its lower left corner. With the mean c of the colour channels and the value w of
white (255, 65535 or the maxval of a PGM file), the occupancy of a pixel is (w − c)/w,
or c/w with `negate`. A cell is free

- in mode ``trinary`` if occupancy < `free_thresh`. In a picture with transparency, c is
  the mean of red, green, blue and alpha, as in ROS;
- in mode ``scale`` if 100 (occupancy − `free_thresh`)/(`occupied_thresh` −
  `free_thresh`) rounds to 0 or less and the pixel is opaque.

All other cells are obstacles, including unknown ones, which the snake must not enter.
"""

from __future__ import annotations

import csv
import io
import math
import re
import struct
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
"""Columns of a CSV file of circles."""
MAX_PIXELS = 25_000_000
"""Largest number of pixels: 250 m by 250 m at 0.05 m."""
MAX_RECTANGLES = 20_000
"""Largest number of obstacles: each one costs a plan 1 ms, and a run of the twin 2 ms and 40 kB."""

_PNG = b"\x89PNG\r\n\x1a\n"
"""Signature of PNG files."""
_PGM = re.compile(
    rb"P([25])" + 3 * rb"(?:\s|#[^\r\n]*[\r\n])+(\d{1,9})" + rb"(?:#[^\r\n]*)?\s"
)
"""Header of PGM files: format, width, height and maxval, with comments."""
_OTHERS = re.compile(
    rb"(?P<PBM>P[14]\s)|(?P<PPM>P[36]\s)|(?P<JPEG>\xff\xd8\xff)|(?P<BMP>BM)|(?P<GIF>GIF8)|(?P<PDF>%PDF)|"
    rb"(?P<TIFF>II\*\0|MM\0\*)|(?P<EPS>%!PS|\xc5\xd0\xd3\xc6)|(?P<WebP>RIFF.{4}WEBP)",
    re.DOTALL,
)
"""Signatures of other formats, for error messages."""
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_QUOTED_LIST = re.compile(
    rf"\s*\[?\s*{_NUMBER.pattern}(?:\s*,\s*{_NUMBER.pattern}){{2}}\s*\]?\s*"
)
_BOOLEANS = dict.fromkeys(("0", "n", "no", "off", "false"), False)
_BOOLEANS |= dict.fromkeys(("1", "y", "yes", "on", "true"), True)
"""Booleans of YAML 1.1."""


class MapFile(StrictModel):
    """YAML file of an occupancy map; unknown keys are ignored, as in ROS."""

    model_config = ConfigDict(extra="ignore")

    image: Annotated[str, Field(min_length=1, max_length=1000)]  # path of the picture
    resolution: Annotated[float, Field(ge=1e-4, le=100.0)]  # side of a pixel, m
    # x and y of the lower left corner, m, and rotation, rad
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
        """Return the list in a text such as "[0.0, 0.0, 0.0]", as some map editors write it."""
        if isinstance(value, str) and _QUOTED_LIST.fullmatch(value):
            value = [float(number) for number in _NUMBER.findall(value)]
        # A strict model accepts only a tuple from a validator in Python.
        if isinstance(value, list):
            return tuple(value)
        return value

    @field_validator("negate", mode="before")
    @classmethod
    def _boolean(cls, text: object) -> bool:
        """Return the value of a YAML 1.1 boolean, quoted or not, as ROS does."""
        if (value := _BOOLEANS.get(str(text).lower())) is None:
            raise ValueError(
                f"must be true, yes, on, 1 or false, no, off, 0, not {text!r:.50}"
            )
        return value

    def contradictions(self) -> Iterator[tuple[tuple[str], str]]:
        """Yield path and message of contradictions between the keys."""
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
                f"must be below occupied_thresh, {self.occupied_thresh:g}",
            )

    def blocked(
        self, colour: np.ndarray, alpha: np.ndarray | None, white: int
    ) -> np.ndarray:
        """Return a mask of occupied and unknown cells; the arguments are the results of `_picture`."""
        whole = 3 * white
        if self.mode == "trinary" and alpha is not None:
            colour = colour + alpha
            whole = 4 * white
        levels = np.arange(whole + 1)
        above = (levels if self.negate else whole - levels) / whole - self.free_thresh
        occupied = above >= 0
        if self.mode != "trinary":
            occupied = (
                200 * above > self.occupied_thresh - self.free_thresh
            )  # not rounded to 0 %
        wall: np.ndarray = occupied[colour]
        if self.mode != "trinary" and alpha is not None:
            wall |= alpha < white
        return wall


def read_map(path: Path) -> tuple[Polygon, ...]:
    """Return rectangles that cover exactly the occupied cells of a map.

    Args:
        path: path of the YAML file.

    Raises:
        InputFileError: a value is not allowed, or the picture cannot be read.
        InputError: the file cannot be read.
    """
    document = _document(path)
    rectangles: list[list[int]] = []
    if file := validate(MapFile, document, document.data):
        with document.report_errors("image"):
            rectangles = _rectangles(file.blocked(*_picture(Path(file.image)))[::-1])
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
    """Return the path of the picture of a map; an empty list if the map cannot be read."""
    try:
        return [Path(_document(path).data["image"])]
    except (InputError, KeyError, TypeError):
        return []


def read_circles(path: Path) -> tuple[Circle, ...]:
    """Return the circles of a CSV file with the columns x_m, y_m and radius_m.

    Raises:
        InputError: the file cannot be read, a column is missing, or a row is not a
            circle.
    """
    name = display_path(path)
    rows = csv.DictReader(read_text(path).splitlines())
    missing = [
        column for column in CIRCLE_COLUMNS if column not in (rows.fieldnames or ())
    ]
    if missing:
        raise InputError(
            f"{name}:1: columns {', '.join(CIRCLE_COLUMNS)} are required; {missing[0]}"
            " is missing"
        )
    circles = []
    for line, row in enumerate(rows, start=2):
        try:
            x, y, radius = (float(row[column]) for column in CIRCLE_COLUMNS)
        except (TypeError, ValueError):
            raise InputError(f"{name}:{line}: not three numbers") from None
        if not (math.isfinite(x) and math.isfinite(y) and 0 < radius < math.inf):
            raise InputError(
                f"{name}:{line}: numbers must be finite and the radius above 0"
            )
        circles.append(Circle(x, y, radius))
    return tuple(circles)


def _picture(path: Path) -> tuple[np.ndarray, np.ndarray | None, int]:
    """Return red + green + blue and alpha of shape (rows, columns), and the value of white.

    Alpha is None for an opaque picture.

    Raises:
        InputError: the file is not a PNG or PGM file, is damaged, or is too large.
    """
    name = display_path(
        require_file(path, suffix=".png" if path.suffix == ".png" else ".pgm")
    )
    header = None
    try:
        with path.open("rb") as stream:
            raw = stream.read(2**16)
            if raw.startswith(_PNG):
                width, height = struct.unpack_from(">II", raw.ljust(24, b"\0"), 16)
            elif header := _PGM.match(raw):
                width = int(header[2])
                height = int(header[3])
            else:
                other = _OTHERS.match(raw)
                if other:
                    what = f"{other.lastgroup} is not read"
                else:
                    what = "neither PNG nor PGM"
                raise InputError(f"{name}: {what}; save it as PNG or PGM")
            if not 0 < width * height <= MAX_PIXELS:
                allowed = f"1 to {MAX_PIXELS:,} are allowed; crop it or reduce its size"
                raise InputError(f"{name}: {width} x {height} pixels; {allowed}")
            # A pixel takes at most 8 bytes in a PNG file, and 5 digits with blanks in a
            # text PGM file.
            raw += stream.read(12 * width * height + 2**24)
    except OSError as error:
        raise InputError(f"{name}: cannot be read ({error.strerror})") from error
    try:
        values, white = (
            _decoded_pgm(raw, header) if header else _decoded_png(raw, (width, height))
        )
    except Exception as error:  # decoders may raise any exception for a damaged file
        reason = re.sub(" <.*", "", str(error))  # without the stream that Pillow names
        raise InputError(
            f"{name}: damaged ({reason}); save it again as PNG or PGM"
        ) from error
    channels = values.shape[2]
    colour = values[..., : 3 if channels > 2 else 1].sum(axis=2, dtype=np.uint32)
    return (
        colour * (1 if channels > 2 else 3),
        None if channels % 2 else values[..., -1],
        white,
    )


def _decoded_pgm(raw: bytes, header: re.Match[bytes]) -> tuple[np.ndarray, int]:
    """Return pixels of shape (rows, columns, 1) and maxval; Pillow would round the grey levels."""
    width, height, white = (int(number) for number in header.groups()[1:])
    if not 0 < white < 65536:
        raise ValueError(f"maxval {white}; 1 to 65535 is allowed")
    if header[1] == b"5":
        grey = np.frombuffer(
            raw, ">u2" if white > 255 else "u1", width * height, header.end()
        )
    else:
        text = re.sub(rb"#[^\r\n]*", b"", raw[header.end() :])
        if text.translate(None, b"0123456789 \t\n\v\f\r"):
            raise ValueError("not all pixels are numbers")
        grey = np.fromstring(text, np.int64, sep=" ")[: width * height]
    if (highest := grey.max(initial=0)) > white:
        raise ValueError(f"grey level {highest} above maxval {white}")
    return grey.reshape(height, width, 1), white


def _decoded_png(raw: bytes, size: tuple[int, int]) -> tuple[np.ndarray, int]:
    """Return pixels of shape (rows, columns, channels) and the value of white.

    The channels are grey or RGB, with or without alpha.
    """
    from PIL import Image

    def opened(raw_mode: str = "") -> Image.Image:
        picture = Image.open(io.BytesIO(raw), formats=["PNG"])
        if picture.size != size:
            raise ValueError("two headers")
        if raw_mode:
            picture.tile = [tile._replace(args=raw_mode) for tile in picture.tile]
        return picture

    depth, kind = raw[24:26]
    picture = opened()
    if depth in (2, 4) and kind == 0 and "transparency" in picture.info:
        picture.info["transparency"] *= 255 // (
            2**depth - 1
        )  # Pillow scales the pixels only
    if depth < 16:
        return (
            np.asarray(
                picture.convert("RGBA" if picture.has_transparency_data else "RGB")
            ),
            255,
        )
    # Pillow returns the upper bytes of 16-bit colours; read as little-endian, it
    # returns the lower bytes.
    if kind == 0:
        values = np.asarray(picture)[..., None]
    elif kind == 4:
        values = np.asarray(opened("RGBA")).view(">u2")
    else:
        lower = np.asarray(opened("RGBA;16L" if kind == 6 else "RGB;16L"))
        values = np.asarray(picture).astype(np.uint16) << 8 | lower
    if "transparency" in picture.info:  # one transparent colour
        clear = (values == np.array(picture.info["transparency"])).all(axis=2)
        values = np.dstack([values, np.where(clear, 0, 65535)])
    return values, 65535


def _rectangles(full: np.ndarray) -> list[list[int]]:
    """Return left, bottom, right and top of rectangles that cover the occupied cells, each cell once.

    A rectangle is a run of occupied cells in a row, together with equal runs in the
    rows above it.

    Raises:
        InputError: there are more than `MAX_RECTANGLES`.
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
            f"{len(first):,} rectangles are needed for its occupied cells;"
            f" {MAX_RECTANGLES:,} are allowed: remove specks (median filter), crop it"
            " or reduce its size"
        )
    # Rectangles with the same columns do not overlap: sorted starts and ends belong
    # together.
    first, last = (
        x[np.lexsort((x, end[x] % width, begin[x] % width))] for x in (first, last)
    )
    left = begin[first] % width
    bottom = begin[first] // width
    corners = np.transpose([left, bottom, end[first] % width, begin[last] // width + 1])
    rectangles: list[list[int]] = corners.tolist()
    return rectangles
