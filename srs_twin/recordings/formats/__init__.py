"""Detection of the file format of motion recordings, and reading of the files.

Each format is a subclass of `base.Format`, and each message container is a subclass of
`topics.Bag`. `extensions.FORMATS` lists the built-in formats. Detection tries formats
from plug-ins before plain tables.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from srs_twin import extensions
from srs_twin.errors import InputError
from srs_twin.io.files import StrPath, escape_unprintable
from srs_twin.recordings.formats.base import (
    Format,
    MarkerTable,
    UnknownFormatError,
    Unstated,
    in_unit,
)
from srs_twin.recordings.formats.topics import Bag, RecordedTopics
from srs_twin.recordings.recorded_file import (
    AS_FOUND,
    Dialect,
    read_bytes,
    read_file,
    start_of,
)

_FORMATS: tuple[Format, ...] = tuple(
    kind() for _, kind in extensions.objects(extensions.FORMATS)
)
"""Built-in formats in the order of detection."""
FORMATS = tuple(form.name for form in _FORMATS)
BAG_SUFFIXES = tuple(form.suffix for form in _FORMATS if isinstance(form, Bag))
"""Usual file suffixes of bags, which may contain both positions and logs."""

_NOTHING = Unstated()
_TABLE = "save a table with the first line time,NAME_x,NAME_y,… as CSV"
_EXPORT = "export CSV or C3D instead"
# Unreadable formats: suffix or pattern of the first bytes, description, and remedy.
_OTHERS: tuple[tuple[str | bytes, str, str], ...] = (
    (
        ".tak",
        "a take of Motive",
        "export it in Motive (File, Export Tracking Data, CSV)",
    ),
    (
        ".qtm",
        "a measurement of Qualisys",
        "export it in Qualisys (File, Export, To TSV)",
    ),
    (
        rb"#ROSBAG",
        "a bag of an older ROS version",
        "convert it: `rosbag fix in.bag out.bag`",
    ),
    (
        rb"\x28\xb5\x2f\xfd",
        "a Zstandard archive, such as a compressed bag,",
        "unpack it: `zstd -d FILE`",
    ),
    (
        rb"\x89HDF.*df_with_missing",
        "a DeepLabCut file (HDF5)",
        "write its CSV with save_as_csv=True",
    ),
    (rb"\x89HDF.*track_occupancy", "a SLEAP file (HDF5)", _TABLE),
    (rb"\x89HDF", "an HDF5 file", _TABLE),
    (rb"MATLAB", "a MATLAB file", f"{_TABLE} (writetable)"),
    (
        rb"PK\x03\x04.{26}[^\0]{0,200}?\.npy",
        "a NumPy archive (.npz)",
        f"{_TABLE} (numpy.savetxt)",
    ),
    (rb"\x93NUMPY", "a NumPy array (.npy)", f"{_TABLE} (numpy.savetxt)"),
    (
        rb"PK\x03\x04.*(xl/|\[Content_Types)",
        "an Excel workbook (.xlsx)",
        "save the sheet as CSV",
    ),
    (rb"PK\x03\x04", "a ZIP archive", "unpack it"),
    (rb"\xd0\xcf\x11\xe0", "an Excel workbook (.xls)", "save the sheet as CSV"),
    (rb"\x1f\x8b", "a gzip archive", "unpack it"),
    (rb"PAR1", "a Parquet file", f"{_TABLE} (pandas: to_csv)"),
    (rb"\x80[\x02-\x05]", "a Python pickle", _TABLE),
    (rb"HIERARCHY", "a BVH file, which holds joint angles and no markers,", _EXPORT),
)


def identify(path: StrPath, dialect: Dialect = AS_FOUND) -> str:
    """Return the format name of a recording, detected from its first bytes.

    `dialect` describes a plain table whose layout cannot be detected.
    """
    return _format(path, dialect).name


def read_markers(path: StrPath, unstated: Unstated = _NOTHING) -> MarkerTable:
    """Read the markers of a recording in any of `FORMATS`.

    `unstated` contains information that the file does not state.
    """
    form = _format(path, unstated.dialect)
    file = read_bytes(path) if form.binary else read_file(path)
    return in_unit(form.read(file, unstated), unstated.unit)


def _formats() -> Iterator[Format]:
    *special, plain = _FORMATS
    yield from special
    yield from (kind() for _, kind in extensions.plugin_parts(Format))
    yield from (
        extensions.part("format", name, (Format,))()
        for name in extensions.registered("format")
    )
    yield plain


def _format(path: StrPath, dialect: Dialect) -> Format:
    start = start_of(path, dialect)
    name = start.name
    raw = start.data
    if not raw.removeprefix(b"\xef\xbb\xbf").strip():
        raise InputError(
            f"{name}: the file is empty; a recording has a header and rows of numbers"
        )
    for form in _formats():
        if form.recognizes(start):
            return form
    for sign, description, remedy in _OTHERS:
        if (
            re.match(sign, raw, re.DOTALL)
            if isinstance(sign, bytes)
            else Path(path).suffix.lower() == sign
        ):
            listed = ", ".join(FORMATS)
            raise InputError(
                f"{name}: {description} cannot be read; {remedy}. Readable formats are"
                f" {listed}"
            )
    if start.problem and b"\0" not in raw:
        raise InputError(f"{name}:{start.header_lines + 1}: {start.problem}")
    description = f"its first line is '{start.first_line[:40]}'"
    if b"\0" in raw:
        description = "it is a binary file of an unknown kind"
    listed = (
        f"readable formats are {', '.join(FORMATS)} (first line time,x_1,y_1,x_2,y_2,…)"
    )
    raise UnknownFormatError(
        escape_unprintable(
            f"{name}:1: the file is not a known motion recording, because"
            f" {description}; {listed}"
        )
    )


def read_topics(path: StrPath) -> RecordedTopics | None:
    """Read poses, points and signals from a bag.

    The result is None if the file is not a bag.
    """
    start = start_of(path)
    for form in _formats():
        if isinstance(form, Bag) and form.recognizes(start):
            return form.read_topics(read_bytes(path))
    return None
