"""Strict readers of untrusted JSON, Parquet and NumPy files.

The JSON reader rejects ``NaN``, ``Infinity``, numbers such as ``1e999`` that overflow
to infinity, duplicate keys and deeply nested data. The standard library accepts all of
these except deeply nested data, which overflow its stack.

A Parquet file of 200 kB can contain a hundred million rows, so the sizes in the footer
are checked before data are read. Pages are verified if the file contains checksums, as
files written by this package do.

A NumPy archive (`.npz`) can unpack to a thousand times the size of the file, and
`numpy.load` allocates memory for whatever size an array header declares. The unpacked
size and the array headers are therefore checked first.
"""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

import numpy as np

from srs_twin.errors import InputError
from srs_twin.io.files import StrPath, display_path, read_text, require_file

if TYPE_CHECKING:
    import pyarrow
    from pyarrow.parquet import ParquetFile

MAX_DEPTH = 64
"""Maximum nesting depth of lists and objects. Result files have fewer than ten levels.
"""

MAX_JSON_BYTES = 64 << 20
"""Maximum size of a JSON file, bytes. The file with all reproduced claims has a size of
1 MB."""

MAX_ARCHIVE_BYTES = 256 << 20
"""Maximum unpacked size of a NumPy archive, bytes."""


def read_json(path: Path) -> Any:
    """Read a JSON file."""
    text = read_text(path, limit=MAX_JSON_BYTES, suffix=".json")
    return parse_json(text, display_path(path))


def parse_json(text: str, name: str) -> Any:
    """Parse JSON text, with `name` as the name of the file in messages."""
    try:
        data = json.loads(
            text,
            parse_constant=_refuse,
            parse_float=_number,
            parse_int=_integer,
            object_pairs_hook=_object,
        )
    except json.JSONDecodeError as error:
        place = f"{name}:{error.lineno}:{error.colno}"
        raise InputError(f"{place}: the file is not valid JSON: {error.msg}") from error
    except ValueError as error:
        raise InputError(f"{name}: {error}") from error
    except RecursionError:
        raise InputError(
            f"{name}: the JSON is nested more than {MAX_DEPTH} levels deep"
        ) from None
    if _depth(data) > MAX_DEPTH:
        raise InputError(
            f"{name}: the JSON is nested more than {MAX_DEPTH} levels deep"
        )
    return data


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not allowed in JSON")


def _number(text: str) -> float:
    if not math.isfinite(value := float(text)):
        raise ValueError(f"the number {text[:40]} is out of range")
    return value


def _integer(text: str) -> int | float:
    # Long integers are read as floats, which are checked for overflow.
    if len(text) < 19:
        return int(text)
    return _number(text)


def _object(pairs: list[tuple[str, object]]) -> dict[str, object]:
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        names = [name for name, _ in pairs]
        duplicate = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {duplicate[:80]!r} is given twice")
    return mapping


def _depth(data: object) -> int:
    layer = [data]
    depth = 0
    while layer and depth <= MAX_DEPTH:
        layer = [inner for value in layer for inner in _children(value)]
        depth += 1
    return depth


def _children(value: object) -> Iterator[object]:
    if isinstance(value, dict):
        yield from value.values()
    elif isinstance(value, list):
        yield from value


MAX_FILE_BYTES = 2 << 30
"""Maximum size of a Parquet file on disk, bytes."""

MAX_VALUES = 1 << 27
"""Maximum number of values in a table (1 GiB as float64)."""

MAX_COLUMNS = 4096
"""Maximum number of columns. Trajectories have about twenty columns per segment."""

MAX_CHUNKS = 100_000
"""Maximum number of column chunks (columns times row groups)."""

MAX_BYTES = 2 << 30
"""Maximum uncompressed size that the footer may declare, bytes."""

MAX_METADATA_BYTES = 32 << 20
"""Maximum size of one string in the footer, bytes."""

MAX_FOOTER_BYTES = 96 << 20
"""Maximum size of the footer, bytes. The footer contains the metadata twice, once in
base64."""


def read_table(
    path: StrPath | BinaryIO,
    kind: str,
    check: Callable[[pyarrow.Schema], None] = lambda schema: None,
) -> pyarrow.Table:
    """Read a Parquet file after checking its sizes.

    Args:
        path: path or file-like object.
        kind: expected kind of file in messages, such as "a trajectory written by
            srs-twin".
        check: function that raises TypeError or ValueError for an unexpected schema.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if isinstance(path, str | os.PathLike):
        path = require_file(Path(path), suffix=".parquet")
    try:
        if isinstance(path, Path):
            _check_size(path)
        # Unlike ParquetFile, pq.read_table would accept a folder and concatenate its
        # files.
        with pq.ParquetFile(
            path,
            page_checksum_verification=True,
            thrift_string_size_limit=MAX_METADATA_BYTES,
            thrift_container_size_limit=MAX_CHUNKS,
        ) as file:
            _check_bounds(file)
            check(file.schema_arrow)
            table = _read(file)
            # The schema of the table comes from a second copy in the footer, which may
            # differ from the first copy in a damaged file.
            check(table.schema)
            return table
    # Arrow raises MemoryError for a page whose declared size is impossible.
    except (
        pa.ArrowException,
        OSError,
        KeyError,
        TypeError,
        ValueError,
        MemoryError,
    ) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not {kind} ({reason})") from error


def _check_size(path: Path) -> None:
    """Check the sizes of the file and its footer before Arrow reads them."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - 8))
        footer = int.from_bytes(file.read(4), "little")
    _check_limit("file", size, "bytes", MAX_FILE_BYTES)
    _check_limit("footer", footer, "bytes", MAX_FOOTER_BYTES)


def _check_limit(owner: str, value: int, unit: str, limit: int) -> None:
    if not 0 <= value <= limit:
        raise ValueError(
            f"the {owner} has {value} {unit}, but at most {limit} are allowed"
        )


def _check_bounds(file: ParquetFile) -> None:
    footer = file.metadata
    columns = footer.num_columns
    declared_bytes = sum(
        footer.row_group(i).total_byte_size for i in range(footer.num_row_groups)
    )
    _check_limit("file", columns, "columns", MAX_COLUMNS)
    _check_limit("file", columns * footer.num_row_groups, "column chunks", MAX_CHUNKS)
    _check_limit("file", columns * footer.num_rows, "values", MAX_VALUES)
    _check_limit("file", declared_bytes, "uncompressed bytes", MAX_BYTES)
    duplicates = [
        name for name, count in Counter(file.schema_arrow.names).items() if count > 1
    ]
    if duplicates:
        raise ValueError(f"column '{duplicates[0]}' is given twice")


def _read(file: ParquetFile) -> pyarrow.Table:
    import pyarrow as pa

    try:
        # Declared page sizes may be false. To limit memory use, a single thread unpacks
        # one column at a time.
        table = file.read(use_threads=False)
        table.validate()
    except (pa.ArrowException, OSError) as error:
        for k in range(file.metadata.num_columns):
            try:
                file.reader.read_all(column_indices=[k], use_threads=False)
            except (pa.ArrowException, OSError) as column_error:
                name = file.metadata.schema.column(k).path
                raise ValueError(f"column {name}: {column_error}") from error
        raise
    return table


def read_arrays(path: Path, what: str) -> dict[str, np.ndarray]:
    """Return the numeric and text arrays in a NumPy archive (npz), keyed by name."""
    try:
        with require_file(path, suffix=".npz").open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            # Opening an archive reads its directory, which can be as large as the file.
            _check_limit("file", size, "bytes", MAX_ARCHIVE_BYTES)
            with zipfile.ZipFile(file) as archive:
                members = archive.infolist()
                unpacked = sum(member.file_size for member in members)
                _check_limit("unpacked content", unpacked, "bytes", MAX_ARCHIVE_BYTES)
                if any(member.compress_type not in _PACKING for member in members):
                    raise ValueError(
                        "the archive is compressed with a method that NumPy does"
                        " not use; write the file again with NumPy"
                    )
                return {
                    member.filename.removesuffix(".npy"): _parse_array(
                        archive.read(member)
                    )
                    for member in members
                }
    except OSError as error:
        raise InputError(
            f"{display_path(path)}: the file cannot be read: {error.strerror or error}"
        ) from error
    # For an encrypted member, zipfile raises RuntimeError.
    except (
        ValueError,
        RuntimeError,
        EOFError,
        zipfile.BadZipFile,
        zlib.error,
    ) as error:
        raise InputError(f"{display_path(path)}: not a {what} ({error})") from error


_PACKING = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def _parse_array(raw: bytes) -> np.ndarray:
    stream = io.BytesIO(raw)
    try:
        version = np.lib.format.read_magic(stream)
        if version == (1, 0):
            read_header = np.lib.format.read_array_header_1_0
        else:
            read_header = np.lib.format.read_array_header_2_0
        shape, _, kind = read_header(stream)
    # NumPy parses the header as Python code, which can raise any kind of error.
    except Exception as error:
        raise ValueError(
            f"the header of an array is damaged: {type(error).__name__}"
        ) from error
    stored = len(raw) - stream.tell()
    is_possible = all(0 <= length <= len(raw) for length in shape)
    if not is_possible or math.prod(shape) * kind.itemsize != stored:
        raise ValueError(
            f"an array of shape {shape} and type {kind} does not fit its {stored} bytes"
        )
    stream.seek(0)
    return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))
