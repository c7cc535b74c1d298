"""File formats of motion recordings: identification and readers.

Each module of this package reads one format. It has a `NAME`, `recognizes(start)`, and `read(file, unstated)`
or, for a bag, `messages(file)`. Lengths are converted to m and times to s, in the axes of the file. A damaged
file of any format raises one `InputError` that names the file. The libraries `c3d` and `rosbags` are in the
extra `recordings`.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from types import ModuleType

from srs_twin.errors import InputError
from srs_twin.io.files import escape_unprintable
from srs_twin.recordings.csv_table import AS_FOUND, Dialect, read_bytes, read_file, start_of
from srs_twin.recordings.formats import (
    c3d,
    deeplabcut,
    mcap,
    motive,
    plain_csv,
    qualisys,
    ros1_bag,
    ros2_bag,
    topics,
    trc,
    tum,
    vicon,
)
from srs_twin.recordings.formats.base import Unstated, in_unit
from srs_twin.recordings.formats.topics import RecordedTopics
from srs_twin.recordings.marker_table import MarkerTable

_BAGS = (mcap, ros1_bag, ros2_bag)
_READERS = (c3d, *_BAGS, motive, vicon, qualisys, trc, tum, deeplabcut, plain_csv)
"""Readers in the order in which they are tried."""
FORMATS = tuple(reader.NAME for reader in _READERS)
"""Names of the formats."""

_TABLE = "save a table with the first line time,NAME_x,NAME_y,… as CSV"
_EXPORT = "export CSV or C3D instead"
# Suffix or pattern of the first bytes, description, remedy.
_OTHERS: tuple[tuple[str | bytes, str, str], ...] = (
    (".tak", "a take of Motive", "export it there (File, Export Tracking Data, CSV)"),
    (".qtm", "a measurement of Qualisys", "export it there (File, Export, To TSV)"),
    (rb"#ROSBAG", "a bag of an older ROS", "convert it: `rosbag fix in.bag out.bag`"),
    (rb"\x28\xb5\x2f\xfd", "a Zstandard archive, as of compressed bags", "unpack it: `zstd -d FILE`"),
    (rb"\x89HDF.*df_with_missing", "a DeepLabCut file (HDF5)", "write its CSV with save_as_csv=True"),
    (rb"\x89HDF.*track_occupancy", "a SLEAP file (HDF5)", _TABLE),
    (rb"\x89HDF", "an HDF5 file", _TABLE),
    (rb"MATLAB", "a MATLAB file", f"{_TABLE} (writetable)"),
    (rb"PK\x03\x04.{26}[^\0]{0,200}?\.npy", "a NumPy archive (.npz)", f"{_TABLE} (numpy.savetxt)"),
    (rb"\x93NUMPY", "a NumPy array (.npy)", f"{_TABLE} (numpy.savetxt)"),
    (rb"PK\x03\x04.*(xl/|\[Content_Types)", "an Excel workbook (.xlsx)", "save the sheet as CSV"),
    (rb"PK\x03\x04", "a ZIP archive", "unpack it"),
    (rb"\xd0\xcf\x11\xe0", "an Excel workbook (.xls)", "save the sheet as CSV"),
    (rb"\x1f\x8b", "a gzip archive", "unpack it"),
    (rb"PAR1", "a Parquet file", f"{_TABLE} (pandas: to_csv)"),
    (rb"\x80[\x02-\x05]", "a Python pickle", _TABLE),
    (rb"HIERARCHY", "a BVH file, which holds joint angles and no markers", _EXPORT),
)


def identify(path: str | os.PathLike[str], dialect: Dialect = AS_FOUND) -> str:
    """Return the format of a recording, one of `FORMATS`, by its first bytes.

    Args:
        path: recording.
        dialect: layout of a plain table, if it cannot be detected.

    Raises:
        InputError: the file is missing, a folder, empty, or in another format, which the message describes.
    """
    return str(_reader(path, dialect).NAME)


def read_markers(
    path: str | os.PathLike[str],
    *,
    rate_hz: float | None = None,
    unit: str | None = None,
    scale_m: float | None = None,
    dialect: Dialect = AS_FOUND,
) -> MarkerTable:
    """Read the markers of a recording in any of `FORMATS`.

    Args:
        path: recording.
        rate_hz: frames per second, if the file does not state it (DeepLabCut, plain CSV without a time,
            Qualisys with an external clock).
        unit: unit of length, if the file does not state it (DeepLabCut, plain CSV).
        scale_m: size of a pixel, m (DeepLabCut).
        dialect: layout of a plain table, if it cannot be detected.

    Raises:
        InputError: the file cannot be read; the message names file, line, column and what is allowed.
    """
    unstated = Unstated(rate_hz, unit, scale_m, dialect)
    reader = _reader(path, dialect)
    if reader in _BAGS:
        table = topics.read_markers(read_bytes(path), reader.NAME, reader.messages)
    else:
        table = reader.read(read_bytes(path) if reader is c3d else read_file(path), unstated)
    return in_unit(table, unit)


def _reader(path: str | os.PathLike[str], dialect: Dialect = AS_FOUND) -> ModuleType:
    start = start_of(path, dialect)
    name, raw = start.name, start.data
    if not raw.removeprefix(b"\xef\xbb\xbf").strip():
        raise InputError(f"{name}: the file is empty; a recording has a header and rows of numbers")
    for reader in _READERS:
        if reader.recognizes(start):
            return reader
    for sign, description, remedy in _OTHERS:
        if re.match(sign, raw, re.DOTALL) if isinstance(sign, bytes) else Path(path).suffix.lower() == sign:
            formats = ", ".join(FORMATS)
            raise InputError(f"{name}: {description} cannot be read; {remedy}. Formats: {formats}")
    if start.problem and b"\0" not in raw:
        raise InputError(f"{name}:{start.header_lines + 1}: {start.problem}")
    description = (
        "it is a binary file of an unknown kind"
        if b"\0" in raw
        else f"its first line is '{start.first_line[:40]}'"
    )
    listed = f"formats: {', '.join(FORMATS)} (first line time,x_1,y_1,x_2,y_2,…)"
    raise InputError(escape_unprintable(f"{name}:1: not a known motion recording: {description}; {listed}"))


def read_topics(path: str | os.PathLike[str]) -> RecordedTopics | None:
    """Read poses, points and signals of a bag; None if the file is not a bag. See `topics.read`.

    Raises:
        InputError: the bag is damaged or too large, or the libraries are not installed.
    """
    bag = next((reader for reader in _BAGS if reader.recognizes(start_of(path))), None)
    return None if bag is None else topics.read(read_bytes(path), bag.NAME, bag.messages)
