"""CSV files of recordings, valve logs and static tables: a valid file of each kind and malformed versions."""

# ruff: noqa: E501 - one malformed file per line, as a table
from __future__ import annotations

import pickle
from functools import partial
from pathlib import Path
from typing import Any

from harness import Contents, MakeFile, Malformed
from hypothesis import strategies as st
from recorded import SPEC, plain_csv
from synthetic import Snake
from synthetic_takes import Take, motive_csv

from srs_twin import load_robot
from srs_twin.identification.static_tables import read_static_table
from srs_twin.recordings.recording import read_motion
from srs_twin.recordings.signals.logs import read_valves

MODULE = load_robot("gen4_module")
FRAMES = 40
CONNECTORS = SPEC.geometry.connectors
MOTION = Snake(duration=(FRAMES - 1) / 100).trajectory()


def _valves() -> bytes:
    names = ",".join(f"valve_plus_{j},valve_minus_{j}" for j in range(1, CONNECTORS))
    rows = [
        f"{k / 10:.1f}" + f",{(-1) ** k},{-((-1) ** k)}" * (CONNECTORS - 1)
        for k in range(8)
    ]
    return ("\n".join([f"time,{names}", *rows]) + "\n").encode()


MOTIVE = motive_csv(MOTION, Take(noise=0.0, digits=3)).encode()
PLAIN = plain_csv(MOTION, "mm", 1e3).encode()
VALVES = _valves()


def _edited(good: bytes, old: str, new: str, count: int = 1) -> bytes:
    assert old in good.decode(), old
    return good.decode().replace(old, new, count).encode()


def _large(head: bytes, line: bytes, megabytes: int = 200) -> MakeFile:
    def make(path: Path) -> None:
        with path.open("wb") as stream:
            stream.write(head)
            block = line * ((1 << 20) // len(line))
            for _ in range(megabytes):
                stream.write(block)

    return make


_LINES = MOTIVE.split(b"\r\n")
_HEADER = b"\r\n".join(_LINES[:7]) + b"\r\n"
_ROW = _LINES[7] + b"\r\n"

MOTIVE_MALFORMED: tuple[Malformed, ...] = (
    Malformed(
        "older format version",
        _edited(MOTIVE, "1.21", "0.9"),
        ":1:2: the format version '0.9' cannot be read; supported: 1.0",
    ),
    Malformed(
        "an unknown unit",
        _edited(MOTIVE, "Millimeters", "Milimeters"),
        ":1: the unit of length 'Milimeters' is not known",
    ),
    Malformed(
        "the header cut before Frame",
        b"\r\n".join(_LINES[:6]) + b"\r\n",
        ": the header is incomplete, because the line 'Frame",
    ),
    Malformed(
        "no rows Type and Name",
        _LINES[0] + b"\r\n" + b"\r\n".join(_LINES[6:]),
        ":2: the header is incomplete; it must have the rows Type",
    ),
    Malformed("a header only", _HEADER, ":8: no rows follow the header"),
    Malformed(
        "one row",
        _HEADER + _ROW,
        ": the recording has 1 frames, but at least 12 are needed",
    ),
    Malformed(
        "a word in place of a number",
        MOTIVE.replace(b"30.000", b"3O.000", 7).replace(b"3O.000", b"30.000", 6),
        ":9:7: '3O.000' is not a number",
    ),
    Malformed(
        "decimal commas",
        MOTIVE.replace(b"30.000", b"30,000"),
        ":8: the row has 22 cells, but the header has 17",
    ),
    Malformed(
        "missing cell",
        _edited(MOTIVE, "\r\n5,0.050000,", "\r\n5,"),
        ":13: the row has 16 cells, but the header has 17",
    ),
    Malformed(
        "no time", _edited(MOTIVE, "5,0.050000,", "5,,"), ":13:2: the row has no time"
    ),
    Malformed(
        "only rotations",
        MOTIVE.replace(b"Position", b"Rotation"),
        ":7: the header contains no positions of markers",
    ),
    Malformed(
        "only bones",
        MOTIVE.replace(b",Marker", b",Bone"),
        "export one of the types Marker",
    ),
    Malformed(
        "no visible marker",
        _HEADER
        + b"".join(b"%d,%.3f" % (k, k / 100) + b"," * 15 + b"\r\n" for k in range(40)),
        "",
    ),
    Malformed(
        "missing marker",
        _HEADER
        + b"".join(
            line[: line.rfind(b",", 0, line.rfind(b",", 0, line.rfind(b",")))]
            + b",,,\r\n"
            for line in _LINES[7:-1]
        ),
        ": 4 markers may belong to the robot, but 5 connectors need 5 (single), 6"
        " (head), 10 (pair)",
    ),
    Malformed("duplicate marker", _HEADER.replace(b"\r\n", b",\r\n") + _ROW, ""),
    Malformed(
        "UTF-16",
        MOTIVE.decode().encode("utf-16"),
        ": the file is not UTF-8 text (byte 1 is 0xff)",
    ),
    Malformed(
        "a zero byte",
        MOTIVE[:900] + b"\0" + MOTIVE[900:],
        ": this is not a text file, because byte 901 is 0x00",
    ),
    Malformed(
        "unclosed quote",
        _edited(MOTIVE, "Take Name,", 'Take Name,"'),
        ":1: the line is not valid CSV",
    ),
    Malformed(
        "200 MB of junk after the header",
        _large(_HEADER, b"junk,junk\n"),
        "rows of 17 cells, but at most",
    ),
    Malformed(
        "200 MB without a line end",
        _large(_HEADER, b"1", 9),
        ":8: the header, or one line, is longer than 4 MB",
    ),
)

PLAIN_MALFORMED: tuple[Malformed, ...] = (
    Malformed(
        "decimal commas and points",
        PLAIN.replace(b",", b";").replace(b".", b",", 50),
        " is not a number",
    ),
    Malformed(
        "missing y",
        _edited(PLAIN, "y_3_mm", "q_3_mm"),
        ":1:6: the column 'x_3_mm' belongs to no marker; each marker must have one"
        " column x and one column y, in m, cm, mm",
    ),
    Malformed(
        "missing connector",
        _edited(PLAIN, "x_2_mm,y_2_mm", "x_7_mm,y_7_mm"),
        ":1: the column 'x_2' is missing; connectors are numbered",
    ),
    Malformed(
        "an unknown unit",
        _edited(PLAIN, "x_2_mm", "x_2_mile"),
        ":1:4: the column 'x_2_mile' belongs to no marker; each marker must have one"
        " column x and one column y, in m, cm, mm, in, ft",
    ),
    Malformed(
        "only time",
        b"time\n" + b"".join(b"%d\n" % k for k in range(40)),
        ":1: the file contains no positions",
    ),
    Malformed(
        "a word", _edited(PLAIN, "\n0.05,", "\nhalf,"), ":7:1: 'half' is not a number"
    ),
    Malformed(
        "200 MB of junk",
        _large(b"", b"junk,junk\n"),
        ":1: the file is not a known motion recording, because its first line is",
    ),
    Malformed(
        "300 MB", _large(PLAIN, b"1,2\n", 300), " MB, but at most 256 MB are allowed"
    ),
)

VALVE_MALFORMED: tuple[Malformed, ...] = (
    Malformed(
        "one row",
        b"\n".join(VALVES.split(b"\n")[:2]) + b"\n",
        ": the log has fewer than 2 rows",
    ),
    Malformed(
        "200 MB of junk",
        _large(VALVES, b"junk\n"),
        " rows of 9 cells, but at most 20000 columns",
    ),
)

STATIC = b"pressure_plus_1_kpa,pressure_minus_1_kpa,bend_1_deg\n" + b"".join(
    b"%d,0,%d.5\n" % (5 * k, 5 * k) for k in range(8)
)

STATIC_MALFORMED: tuple[Malformed, ...] = (
    Malformed("words", b"just text\n", ":1: the column 'bend_1' is missing"),
    Malformed(
        "no bends",
        STATIC.replace(b"bend_1", b"bent_1"),
        ":1: the column 'bend_1' is missing",
    ),
    Malformed(
        "invalid segment",
        STATIC.replace(b"bend_1", b"bend_2"),
        ":1:3: bend_2_deg: this segment does not exist; gen4_module has segments 1"
        " to 1",
    ),
    Malformed(
        "an unknown unit",
        STATIC.replace(b"kpa", b"ata", 1),
        ":1:1: pressure_plus_1_ata: unknown unit 'ata'",
    ),
    Malformed(
        "no pressure",
        STATIC.replace(b"10,0", b",0"),
        ":4: a pressure is missing; give all pressures in every row",
    ),
    Malformed(
        "a word", STATIC.replace(b"10,0", b"ten,0"), ":4:1: 'ten' is not a number"
    ),
    Malformed(
        "degrees as radians",
        STATIC.replace(b"_deg", b""),
        ":4:3: bend_1: 10.5 is not allowed; a bend must be between",
    ),
    Malformed("a header only", STATIC.split(b"\n")[0] + b"\n", ""),
)

_READ_MARKERS = "srs_twin.recordings.formats:read_markers"
_READ_FILE = "srs_twin.recordings.recorded_file:read_file"
# Name, valid file, reading function, malformed files, and the function for a separate
# process.
TABLES = (
    (
        "Motive export",
        MOTIVE,
        partial(read_motion, spec=SPEC),
        MOTIVE_MALFORMED,
        _READ_MARKERS,
    ),
    (
        "plain motion",
        PLAIN,
        partial(read_motion, spec=SPEC),
        PLAIN_MALFORMED,
        _READ_MARKERS,
    ),
    ("valve log", VALVES, partial(read_valves, spec=SPEC), VALVE_MALFORMED, _READ_FILE),
    (
        "static table",
        STATIC,
        partial(read_static_table, spec=MODULE),
        STATIC_MALFORMED,
        _READ_FILE,
    ),
)


def same(one: Any, other: Any) -> bool:
    """Return whether two results of a reading function are equal to the bit."""
    return pickle.dumps(one) == pickle.dumps(other)


def values(good: bytes) -> Contents:
    """Return a strategy for a valid file with arbitrary cells."""
    rows = [line.split(",") for line in good.decode().splitlines()]
    cell = st.one_of(
        st.sampled_from(
            [
                "",
                "nan",
                "inf",
                "-inf",
                "1e308",
                "1e-320",
                "0",
                "-1",
                "999999",
                "x",
                '"',
                " 5 ",
            ]
        ),
        st.floats(-2e3, 2e3).map(repr),
    )
    edit = st.tuples(st.integers(0, len(rows) - 1), st.integers(0, 40), cell)

    def apply(edits: list[tuple[int, int, str]]) -> bytes:
        edited = [list(row) for row in rows]
        for row, column, new in edits:
            edited[row][column % len(edited[row])] = new
        return ("\n".join(",".join(row) for row in edited) + "\n").encode()

    return st.lists(edit, min_size=1, max_size=12).map(apply)
