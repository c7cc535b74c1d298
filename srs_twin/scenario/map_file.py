"""Maps of other programs: occupancy grids as ROS has them, and lists of circles.

A map is a YAML file that names a picture (PGM or PNG) with its resolution and the pose of its lower left
corner. A pixel of value v is occupied with probability (255 − v)/255, or v/255 where the map says `negate`;
above `occupied_thresh` it is occupied, below `free_thresh` free. What is between them is not known, and is
taken for occupied: a snake is not to be sent there.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.documents import load_yaml
from srs_twin.io.files import read_text, shown
from srs_twin.world import Circle, Polygon

_MODES = ("trinary", "scale")
_MOST_PIXELS = 25_000_000
CIRCLE_COLUMNS = ("x_m", "y_m", "radius_m")


def read_map(path: Path) -> tuple[Polygon, ...]:
    """Return rectangles that cover the occupied cells of a map and nothing else.

    Args:
        path: of the map's YAML file.

    Raises:
        InputFileError: it cannot be read as YAML.
        InputError: it says something that a map cannot, or its picture cannot be read.
    """
    document = load_yaml(path)
    document.finish()
    given, name = document.data, shown(path)
    if not isinstance(given, dict) or "image" not in given:
        raise InputError(f"{name}: no map: it needs image, resolution and origin")
    if (mode := given.get("mode", "trinary")) not in _MODES:
        raise InputError(f"{name}: mode {mode!r} is not read; trinary and scale are")
    size = _numbers(given, "resolution", 1, name)[0]
    x, y, turn = _numbers(given, "origin", 3, name)
    free, occupied = (_numbers(given, key, 1, name)[0] for key in ("free_thresh", "occupied_thresh"))
    if not (0 < size <= 100 and 0 <= free <= occupied <= 1):
        raise InputError(
            f"{name}: resolution {size:g} m must be above 0, and 0 <= free_thresh <= occupied_thresh <= 1"
        )
    grey = _picture(path.parent / str(given["image"])) / 255
    chance = grey if given.get("negate", 0) else 1 - grey
    c, s = math.cos(turn), math.sin(turn)
    polygons = []
    for column, row, wide, high in _rectangles(chance[::-1] >= free):
        corners = ((column, row), (column + wide, row), (column + wide, row + high), (column, row + high))
        places = ((size * u, size * v) for u, v in corners)
        polygons.append(Polygon(tuple((x + c * u - s * v, y + s * u + c * v) for u, v in places)))
    return tuple(polygons)


def pictures_of(path: Path) -> list[Path]:
    """Return the picture that a map names, if it can be told."""
    try:
        return [path.parent / str(load_yaml(path).data["image"])]
    except (InputError, KeyError, TypeError):
        return []


def read_circles(path: Path) -> tuple[Circle, ...]:
    """Return the circles of a CSV file with the columns x_m, y_m and radius_m.

    Raises:
        InputError: it cannot be read, lacks a column, or a row is no circle.
    """
    name, rows = shown(path), csv.DictReader(read_text(path).splitlines())
    missing = [column for column in CIRCLE_COLUMNS if column not in (rows.fieldnames or ())]
    if missing:
        raise InputError(f"{name}:1: columns {', '.join(CIRCLE_COLUMNS)} are needed; {missing[0]} is missing")
    found = []
    for line, row in enumerate(rows, start=2):
        try:
            x, y, radius = (float(row[column]) for column in CIRCLE_COLUMNS)
        except (TypeError, ValueError):
            raise InputError(f"{name}:{line}: not three numbers") from None
        if not (math.isfinite(x) and math.isfinite(y) and 0 < radius < math.inf):
            raise InputError(f"{name}:{line}: numbers must be finite, and the radius above 0")
        found.append(Circle(x, y, radius))
    return tuple(found)


def _numbers(given: dict[str, Any], key: str, count: int, name: str) -> list[float]:
    value = given.get(key, {"free_thresh": 0.196, "occupied_thresh": 0.65}.get(key))
    values = list(value) if isinstance(value, list) else [value]
    numbers = [each for each in values if isinstance(each, int | float) and math.isfinite(each)]
    if len(values) != count or len(numbers) != count:
        raise InputError(f"{name}: {key}: {count} finite number{'s' * (count > 1)} needed, not {value!r}")
    return [float(each) for each in numbers]


def _picture(path: Path) -> np.ndarray:
    """Return the grey values of a picture, 0 to 255, shape (rows, columns), the upper row first."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as picture:
            if picture.width * picture.height > _MOST_PIXELS:
                raise InputError(f"{shown(path)}: over {_MOST_PIXELS} pixels")
            # What is transparent is taken for what its colour says.
            return np.asarray(picture.convert("L"), dtype=float)
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError) as error:
        raise InputError(f"{shown(path)}: no picture that can be read (PGM or PNG): {error}") from None


def _rectangles(full: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Return column, row, width and height of rectangles that cover the full cells, each once."""
    open_runs: dict[tuple[int, int], int] = {}
    found = []
    for row in range(len(full) + 1):
        cells = full[row] if row < len(full) else np.zeros(full.shape[1], dtype=bool)
        edges = np.flatnonzero(np.diff(np.r_[False, cells, False].astype(np.int8)))
        runs = set(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
        for run in [each for each in open_runs if each not in runs]:
            begin = open_runs.pop(run)
            found.append((run[0], begin, run[1] - run[0], row - begin))
        for run in runs:
            open_runs.setdefault(run, row)
    return sorted(found)
