"""Parquet files of trajectories: truncated, damaged, too large, or with other content."""

# ruff: noqa: E501 - one malformed file per line, as a table
from __future__ import annotations

import io
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from harness import MakeFile, Malformed
from hypothesis import strategies as st
from malformed_yaml import any_data

from srs_twin.trajectory import Event, Trajectory

METADATA = {"srs_twin.events": "[]", "srs_twin.metadata": "{}"}
SAMPLES = 50


def trajectory() -> Trajectory:
    """Return a small valid trajectory."""
    time = np.arange(SAMPLES) / 100
    columns = {
        "time": time,
        "com_x": np.sin(time),
        "bend_1": np.cos(time),
        "duty": np.ones(SAMPLES),
    }
    return Trajectory(
        columns,
        {"duty": "%"},
        (Event(0.1, "contact", "wall"),),
        {"plant": "twin", "seed": 3},
    )


def content(run: Trajectory) -> bytes:
    """Return a trajectory as a Parquet file."""
    file = io.BytesIO()
    run.to_parquet(file)
    return file.getvalue()


GOOD = content(trajectory())
FOOTER = int.from_bytes(GOOD[-8:-4], "little")


def table(
    columns: Any, metadata: dict[str, Any] | None = None, **options: Any
) -> bytes:
    """Return a Parquet file with other columns or other metadata."""
    file = io.BytesIO()
    content = columns if isinstance(columns, pa.Table) else pa.table(columns)
    pq.write_table(
        content.replace_schema_metadata(METADATA if metadata is None else metadata),
        file,
        **options,
    )
    return file.getvalue()


def flipped(offset: int) -> bytes:
    """Return the valid file with one byte inverted."""
    changed = bytearray(GOOD)
    changed[offset] ^= 0xFF
    return bytes(changed)


def events(data: Any) -> bytes:
    """Return a file with other events."""
    return table(
        {"time": [0.0, 1.0]}, {**METADATA, "srs_twin.events": json.dumps(data)}
    )


def metadata(text: str | bytes) -> bytes:
    """Return a file with other metadata."""
    return table({"time": [0.0, 1.0]}, {**METADATA, "srs_twin.metadata": text})


def nested(depth: int) -> Any:
    """Return the type of nested lists of numbers."""
    kind = pa.float64()
    for _ in range(depth):
        kind = pa.list_(kind)
    return kind


def duplicate_column() -> bytes:
    """Return a file with two columns of one name."""
    return table(
        pa.Table.from_arrays([pa.array([0.0, 1.0])] * 3, names=["time", "x", "x"])
    )


def many_rows() -> bytes:
    """Return a file of 200 kB with two hundred million missing values."""
    return table(
        {"time": pa.nulls(200_000_000)}, compression="zstd", row_group_size=1 << 26
    )


def inflating() -> bytes:
    """Return a small file that unpacks to three gigabytes of zeros."""
    file = io.BytesIO()
    zeros = pa.table({"time": [bytes(1 << 22)]}).replace_schema_metadata(METADATA)
    with pq.ParquetWriter(
        file, zeros.schema, compression="zstd", use_dictionary=False
    ) as writer:
        for _ in range(768):
            writer.write_table(zeros)
    return file.getvalue()


def on_disk(make: Callable[[], bytes]) -> MakeFile:
    """Return a function that writes a large file when a test needs it."""
    return lambda path: path.write_bytes(make())


OURS = ": not a trajectory written by srs-twin ("
CUTS = {
    "the first page": 40,
    "half of it": len(GOOD) // 2,
    "in the footer": len(GOOD) - FOOTER // 2,
    "one byte": len(GOOD) - 1,
}

MALFORMED: tuple[Malformed, ...] = (
    *(Malformed(f"cut: {name}", GOOD[:length], OURS) for name, length in CUTS.items()),
    Malformed("a footer of 4 GB", GOOD[:-8] + b"\xff\xff\xff\xffPAR1", OURS),
    Malformed("magic number of encrypted files", GOOD[:-4] + b"PARE", OURS),
    *(
        Malformed(f"inverted page byte {offset}", flipped(offset), f"{OURS}column ")
        for offset in (60, 700)
    ),
    Malformed(
        "footer of noise", GOOD[: -FOOTER - 8] + b"\xa5" * FOOTER + GOOD[-8:], OURS
    ),
    Malformed(
        "200,000,000 rows",
        on_disk(many_rows),
        f"{OURS}the file has 200000000 values, but at most ",
    ),
    Malformed(
        "3 GB in a small file",
        on_disk(inflating),
        " uncompressed bytes, but at most 2147483648",
    ),
    Malformed(
        "5,000 columns",
        table({"time": [0.0], **{f"x{k}": [0.0] for k in range(5000)}}),
        f"{OURS}the file has 5001 columns, but at most ",
    ),
    Malformed(
        "metadata of 100 MB",
        on_disk(lambda: metadata('"' + "x" * 10**8 + '"')),
        f"{OURS}",
    ),
    Malformed(
        "no metadata",
        table({"time": [1.0]}, {}),
        f"{OURS}the Parquet file has no metadata of srs-twin)",
    ),
    Malformed("metadata that are not JSON", metadata("{"), OURS),
    Malformed("metadata that are not text", metadata(b"\xff\xfe"), OURS),
    Malformed(
        "metadata that are a list",
        metadata("[]"),
        f"{OURS}its metadata is not a mapping)",
    ),
    Malformed("metadata a million deep", metadata("[" * 10**6 + "]" * 10**6), OURS),
    Malformed(
        "metadata with a number of 5,000 digits",
        metadata('{"a": ' + "9" * 5000 + "}"),
        OURS,
    ),
    Malformed(
        "event with an unknown key",
        events([{"time": 0, "kind": "a", "text": "b", "x": 1}]),
        OURS,
    ),
    Malformed(
        "event at NaN",
        events([{"time": float("nan"), "kind": "a", "text": "b"}]),
        f"{OURS}the time of an event must be",
    ),
    Malformed(
        "text as event time", events([{"time": "0", "kind": "a", "text": "b"}]), OURS
    ),
    Malformed(
        "list as event kind",
        events([{"time": 0, "kind": ["a"], "text": "b"}]),
        f"{OURS}the kind and the text of an event",
    ),
    Malformed("mapping as events", events({"time": 1}), OURS),
    Malformed("no time", table({"x": [1.0]}), ": a trajectory needs a column 'time'"),
    Malformed(
        "half precision",
        table({"time": [0.0], "x": pa.array(np.zeros(1, np.float16))}),
        f"{OURS}column 'x' contains values of type halffloat",
    ),
    Malformed(
        "a list in a column",
        table({"time": [0.0], "x": [[1.0]]}),
        f"{OURS}column 'x' contains values of type list<",
    ),
    Malformed("very deep lists", table({"time": pa.nulls(1, nested(300))}), OURS),
    Malformed(
        "missing times",
        table({"time": [0.0, None, 1.0]}),
        f"{OURS}column 'time' has 1 missing values)",
    ),
    Malformed(
        "column of nulls",
        table({"time": [0.0, 1.0], "x": [None, None]}, None),
        f"{OURS}column 'x' contains values of type null",
    ),
    Malformed(
        "NaN in time",
        table({"time": [0.0, float("nan"), 1.0]}),
        ": the values in column 'time' must be finite and increase",
    ),
    Malformed(
        "repeated time",
        table({"time": [0.0, 1.0, 1.0]}),
        ": the values in column 'time' must be finite and increase",
    ),
    Malformed(
        "duplicate column", duplicate_column(), f"{OURS}column 'x' is given twice)"
    ),
    Malformed(
        "unit that is not text",
        table(
            pa.table(
                [pa.array([0.0])],
                pa.schema([pa.field("time", pa.float64(), metadata={"unit": b"\xff"})]),
            )
        ),
        OURS,
    ),
)

numbers = st.floats(width=64)
columns_of_three = st.one_of(
    st.lists(numbers, min_size=3, max_size=3),
    st.lists(st.integers(-9, 9), min_size=3, max_size=3),
    st.lists(st.none() | numbers, min_size=3, max_size=3),
    st.lists(st.text(max_size=3), min_size=3, max_size=3),
    st.lists(st.lists(numbers, max_size=2), min_size=3, max_size=3),
    st.just([0.0, 0.5, 1.0]),
)


def _any_table(
    columns: dict[str, Any], metadata: dict[str, Any], compression: str
) -> bytes:
    return table(
        columns,
        {key: json.dumps(value) for key, value in metadata.items()},
        compression=compression,
    )


VALUES = st.builds(
    _any_table,
    st.dictionaries(
        st.sampled_from(["time", "com_x", "x_1", "qpos_1"]) | st.text(max_size=5),
        columns_of_three,
        max_size=4,
    ).filter(
        lambda columns: all("\0" not in name and name.isprintable() for name in columns)
    ),
    st.dictionaries(
        st.sampled_from(["srs_twin.events", "srs_twin.metadata", "x"]),
        any_data,
        max_size=3,
    )
    | st.builds(
        lambda events, metadata: {
            "srs_twin.events": events,
            "srs_twin.metadata": metadata,
        },
        st.lists(
            st.dictionaries(
                st.sampled_from(["time", "kind", "text"]), any_data, max_size=3
            ),
            max_size=2,
        ),
        st.dictionaries(st.text(max_size=5), any_data, max_size=3),
    ),
    st.sampled_from(["none", "zstd", "snappy", "gzip"]),
)


def same(one: Trajectory, other: Trajectory) -> bool:
    """Return whether two trajectories are equal to the bit."""
    return (
        list(one.columns) == list(other.columns)
        and all(one[name].tobytes() == other[name].tobytes() for name in one.columns)
        and all(one.unit(name) == other.unit(name) for name in one.columns)
        and one.events == other.events
        and json.dumps(one.metadata, sort_keys=True)
        == json.dumps(other.metadata, sort_keys=True)
    )
