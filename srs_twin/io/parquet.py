"""Parquet that may come from anybody: its bounds are read and judged before its data.

A file of 200 kB can hold a hundred million rows, so what a file says of itself in its footer counts first.
Pages are checked against their checksums where the writer left some, as ours do.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from srs_twin.errors import InputError
from srs_twin.io.files import existing

if TYPE_CHECKING:
    import pyarrow


MAX_FILE_BYTES = 2 << 30
MAX_VALUES = 1 << 27
"""Rows times columns: a gigabyte of numbers."""

MAX_COLUMNS = 4096
MAX_CHUNKS = 100_000
MAX_BYTES = 2 << 30
"""Uncompressed, as the footer has it."""

MAX_METADATA_BYTES = 32 << 20
MAX_FOOTER_BYTES = 96 << 20
"""It holds the metadata twice, the second time in base64."""


def read_table(
    path: Any, what: str, check: Callable[[pyarrow.Schema], None] = lambda schema: None
) -> pyarrow.Table:
    """Read a whole Parquet file within bounds.

    Args:
        path: a path, or a file-like object.
        what: what the file should be, for the message: "a trajectory written by srs-twin".
        check: raises TypeError or ValueError where the schema is of something else, before any data are read.

    Raises:
        InputError: missing, no regular file, no Parquet, damaged, or beyond a bound; names the column where
            there is one.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if isinstance(path, str | os.PathLike):
        path = existing(Path(path), suffix=".parquet")
    try:
        if isinstance(path, Path):
            _check_size(path)
        # One file: pq.read_table would take a folder and join whatever lies in it.
        with pq.ParquetFile(
            path,
            page_checksum_verification=True,
            thrift_string_size_limit=MAX_METADATA_BYTES,
            thrift_container_size_limit=MAX_CHUNKS,
        ) as file:
            _check_bounds(file)
            check(file.schema_arrow)
            table = _read(file)
            # In a damaged file the schema of the table, which comes from the footer's other copy, can differ.
            check(table.schema)
            return table
    # MemoryError: Arrow's word for a page that says it is larger than it can be.
    except (pa.ArrowException, OSError, KeyError, TypeError, ValueError, MemoryError) as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path}: not {what} ({said})") from error


def _check_size(path: Path) -> None:
    """Refuse by the sizes of file and footer: Arrow would read a footer of gigabytes to find it too large.

    Raises:
        ValueError: one of them is beyond its bound.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(max(0, size - 8))
        footer = int.from_bytes(file.read(4), "little")
    for name, value, most in (("file", size, MAX_FILE_BYTES), ("footer", footer, MAX_FOOTER_BYTES)):
        if value > most:
            raise ValueError(f"a {name} of {value} bytes; at most {most} are read")


def _check_bounds(file: Any) -> None:
    """Refuse by the footer alone, which is all that has been read so far.

    Raises:
        ValueError: it is beyond a bound, or names a column twice.
    """
    about = file.metadata
    declared = sum(about.row_group(i).total_byte_size for i in range(about.num_row_groups))
    for name, value, most in (
        ("columns", about.num_columns, MAX_COLUMNS),
        ("column chunks", about.num_columns * about.num_row_groups, MAX_CHUNKS),
        ("values", about.num_rows * about.num_columns, MAX_VALUES),
        ("bytes, uncompressed", declared, MAX_BYTES),
    ):
        if not 0 <= value <= most:
            raise ValueError(f"{value} {name}; at most {most} are read")
    twice = [name for name, times in Counter(file.schema_arrow.names).items() if times > 1]
    if twice:
        raise ValueError(f"column {twice[0]}: given twice")


def _read(file: Any) -> pyarrow.Table:
    """Return the table, or say which column cannot be read."""
    import pyarrow as pa

    try:
        # One thread: one column at a time is unpacked, whatever its pages claim.
        table = file.read(use_threads=False)
        table.validate()
    except (pa.ArrowException, OSError) as error:
        for k in range(file.metadata.num_columns):
            try:
                file.reader.read_all(column_indices=[k], use_threads=False)
            except (pa.ArrowException, OSError) as first:
                name = file.metadata.schema.column(k).path
                raise ValueError(f"column {name}: {first}") from error
        raise
    return table
