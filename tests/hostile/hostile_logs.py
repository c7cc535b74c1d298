"""Recordings that are cut, bent, blown up, or of something else; good ones are made by hand."""

# ruff: noqa: E501 - one malformed file a line, as a table

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from harness import Generated, Malformed
from hypothesis import strategies as st

from srs_twin import load_robot
from srs_twin.recordings.recording import Recording, read_motion
from srs_twin.recordings.signals.logs import read_valves
from srs_twin.recordings.signals.valve_log import ValveLog

SPEC = load_robot("gen2")
FRAMES = 40
CONNECTORS = SPEC.geometry.connectors


def _places(frame: int) -> list[tuple[float, float]]:
    """Return connectors of a wave that crawls along x, m."""
    places, x, y = [], 0.01 * frame, 0.0
    for k in range(CONNECTORS):
        places.append((x, y))
        angle = 0.4 * math.sin(0.5 * frame - 1.5 * k)
        x, y = x - 0.0545 * math.cos(angle), y - 0.0545 * math.sin(angle)
    return places


def _motive() -> bytes:
    count = CONNECTORS
    header = [
        "Format Version,1.21,Take Name,good,Capture Frame Rate,100.0,Export Frame Rate,100.0,"
        f"Total Exported Frames,{FRAMES},Rotation Type,Quaternion,Length Units,Millimeters,Coordinate Space,Global",
        "",
        ",Type" + ",Marker" * 3 * count,
        ",Name" + "".join(f",Unlabeled {k}" * 3 for k in range(count)),
        ",ID" + "".join(f",{k}" * 3 for k in range(count)),
        "," + ",Position" * 3 * count,
        "Frame,Time (Seconds)" + ",X,Y,Z" * count,
    ]  # fmt: skip
    rows = [
        f"{k},{k / 100:.6f}," + ",".join(f"{1e3 * x:.3f},30.000,{-1e3 * y:.3f}" for x, y in _places(k))
        for k in range(FRAMES)
    ]
    return ("\r\n".join([*header, *rows]) + "\r\n").encode()


def _plain() -> bytes:
    names = ",".join(f"x_{k}_mm,y_{k}_mm" for k in range(1, CONNECTORS + 1))
    rows = [
        f"{k / 100:.2f}," + ",".join(f"{1e3 * x:.3f},{1e3 * y:.3f}" for x, y in _places(k))
        for k in range(FRAMES)
    ]
    return ("\n".join([f"time,{names}", *rows]) + "\n").encode()


def _valves() -> bytes:
    names = ",".join(f"valve_plus_{j},valve_minus_{j}" for j in range(1, CONNECTORS))
    rows = [f"{k / 10:.1f}" + f",{(-1) ** k},{-((-1) ** k)}" * (CONNECTORS - 1) for k in range(8)]
    return ("\n".join([f"time,{names}", *rows]) + "\n").encode()


MOTIVE, PLAIN, VALVES = _motive(), _plain(), _valves()


def motion(path: Path) -> Recording:
    """Read a motion of gen2."""
    return read_motion(path, SPEC)


def valves(path: Path) -> ValveLog:
    """Read a log of gen2's valves."""
    return read_valves(path, SPEC)


def same_motion(one: Recording, other: Recording) -> bool:
    """Say whether two recordings hold the same bits."""
    return one.summary == other.summary and all(
        one.trajectory[name].tobytes() == other.trajectory[name].tobytes() for name in one.trajectory.columns
    )


def same_valves(one: ValveLog, other: ValveLog) -> bool:
    """Say whether two logs hold the same bits."""
    return (one.kind, one.sha256, one.values.tobytes()) == (other.kind, other.sha256, other.values.tobytes())


def _edited(good: bytes, old: str, new: str, count: int = 1) -> bytes:
    assert old in good.decode(), old
    return good.decode().replace(old, new, count).encode()


def _large(head: bytes, piece: bytes, megabytes: int = 200) -> Callable[[Path], None]:
    def make(path: Path) -> None:
        with path.open("wb") as stream:
            stream.write(head)
            block = piece * ((1 << 20) // len(piece))
            for _ in range(megabytes):
                stream.write(block)

    return make


_LINES = MOTIVE.split(b"\r\n")
_HEADER = b"\r\n".join(_LINES[:7]) + b"\r\n"
_ROW = _LINES[7] + b"\r\n"

MOTIVE_MALFORMED: tuple[Malformed, ...] = (
    Malformed("an older format", _edited(MOTIVE, "1.21", "0.9"), ":1:2: Format Version '0.9' is not read; allowed: 1.0"),
    Malformed("no version", _edited(MOTIVE, "1.21", ""), ":1:2: Format Version '' is not read"),
    Malformed("an unknown unit", _edited(MOTIVE, "Millimeters", "Milimeters"), ":1: Length Units 'Milimeters' is not known; did you mean Millimeters?"),
    Malformed("no unit", _edited(MOTIVE, "Length Units,", "Length,"), ":1: Length Units '' is not known"),
    Malformed("a wrong unit", _edited(MOTIVE, "Millimeters", "Meters"), "apart, the connectors of gen2 55 mm; were lengths in mm?"),
    Malformed("the header cut after one line", _LINES[0] + b"\r\n", ":2: the header is cut"),
    Malformed("the header cut before Frame", b"\r\n".join(_LINES[:6]) + b"\r\n", ": the header is cut: no line 'Frame"),
    Malformed("no rows that say what is what", _LINES[0] + b"\r\n" + b"\r\n".join(_LINES[6:]), ": the header is cut: rows Type"),
    Malformed("a header only", _HEADER, ":8: a header and no rows below it"),
    Malformed("one row", _HEADER + _ROW, ": 1 frames; a recording has 12 or more"),
    Malformed("the same row forty times", _HEADER + _ROW * 40, ": 1 frames; a recording has 12 or more"),
    Malformed("a word among the numbers", MOTIVE.replace(b"30.000", b"3O.000", 7).replace(b"3O.000", b"30.000", 6), ":9:7: '3O.000' is no number"),
    Malformed("decimal commas", MOTIVE.replace(b"30.000", b"30,000"), ":8: 22 cells where the header has 17"),
    Malformed("a cell too few", _edited(MOTIVE, "\r\n5,0.050000,", "\r\n5,"), ":13: 16 cells where the header has 17"),
    Malformed("no time", _edited(MOTIVE, "5,0.050000,", "5,,"), ":13:2: a row without a time"),
    Malformed("only rotations", MOTIVE.replace(b"Position", b"Rotation"), ":7: no positions of markers in the header"),
    Malformed("only bones", MOTIVE.replace(b",Marker", b",Bone"), "types with positions: Bone; wanted: Marker"),
    Malformed("all markers hidden", _HEADER + b"".join(b"%d,%.3f" % (k, k / 100) + b"," * 15 + b"\r\n" for k in range(40)), ""),
    Malformed("a marker too few", _HEADER + b"".join(line[: line.rfind(b",", 0, line.rfind(b",", 0, line.rfind(b",")))] + b",,,\r\n" for line in _LINES[7:-1]), ": 4 markers that could be the robot's; 5 connectors carry 5 (single), 6 (head), 10 (pair)"),
    Malformed("a marker twice", _HEADER.replace(b"\r\n", b",\r\n") + _ROW, ""),
    Malformed("nothing crawls", _HEADER + b"".join(b"%d,%.3f" % (k, k / 100) + _ROW[10:] for k in range(40)), ": which end is the head cannot be told"),
    Malformed("time in another unit", _HEADER + b"".join(b"%d,%d" % (k * 10**9, k * 10**9) + _ROW[10:] for k in range(40)), "is the unit right?"),
    Malformed("latin-1", _edited(MOTIVE, "good", "größe").decode().encode("latin-1"), ": not UTF-8 text (byte "),
    Malformed("UTF-16", MOTIVE.decode().encode("utf-16"), ": not UTF-8 text (byte 1 is 0xff)"),
    Malformed("a zero byte", MOTIVE[:900] + b"\0" + MOTIVE[900:], ": not text (byte 901 is 0x00)"),
    Malformed("a quote that never ends", _edited(MOTIVE, "Take Name,", 'Take Name,"'), ":1: no line of a CSV file"),
    Malformed("200 MB of junk after the header", _large(_HEADER, b"junk,junk\n"), ":8: 2 cells where the header has 17"),
    Malformed("200 MB without a line end", _large(_HEADER, b"1", 9), ":8: the header, or a line, is longer than 4 MB"),
    Malformed("a header of 200 MB", _large(b"Format Version,1.21,", b"x,", 9), ":1: the header, or a line, is longer than 4 MB"),
)  # fmt: skip

PLAIN_MALFORMED: tuple[Malformed, ...] = (
    Malformed("words", b"just text\n", ":1: no motion recording that is read: its first line is"),
    Malformed("no names", PLAIN.split(b"\n", 1)[1], ":1: 11 numbers and no names of columns: give --columns"),
    Malformed("decimal commas and points", PLAIN.replace(b",", b";").replace(b".", b",", 50), " is no number"),
    Malformed("decimal commas between commas", PLAIN.replace(b".", b","), " cells where the header has 11"),
    Malformed("a y too few", _edited(PLAIN, "y_3_mm", "q_3_mm"), ":1:6: x_3_mm: y_3 is missing"),
    Malformed("a connector too few", _edited(PLAIN, "x_2_mm,y_2_mm", "x_7_mm,y_7_mm"), ":1: x_2 is missing; connectors are numbered"),
    Malformed("one name twice", _edited(PLAIN, "x_2_mm", "x_1_mm"), ":1:4: x_1_mm: the same as column 'x_1_mm'"),
    Malformed("an unknown unit", _edited(PLAIN, "x_2_mm", "x_2_mile"), ":1:4: x_2_mile: unit 'mile' is not known; allowed: m, cm, mm, in, ft"),
    Malformed("no number", _edited(PLAIN, "x_2_mm", "x"), ":1:4: x: a number is wanted: x_1 at the head"),
    Malformed("only time", b"time\n" + b"".join(b"%d\n" % k for k in range(40)), ":1: no positions"),
    Malformed("a word", _edited(PLAIN, "\n0.05,", "\nhalf,"), ":7:1: 'half' is no number"),
    Malformed("200 MB of junk", _large(b"", b"junk,junk\n"), ":1: no motion recording that is read: its first line is"),
    Malformed("300 MB", _large(PLAIN, b"1,2\n", 300), " MB; at most 256 MB are read"),
)  # fmt: skip

VALVE_MALFORMED: tuple[Malformed, ...] = (
    Malformed("words", b"just text\n", ":1: no column 'time'"),
    Malformed("a state that no valve has", _edited(VALVES, "0.3,-1", "0.3,7"), ":5:2: valve_plus_1: 7 is not allowed"),
    Malformed("a chamber too few", _edited(VALVES, "valve_minus_3", "valve_minus_8"), ":1: valve_minus_3 is missing"),
    Malformed("one row", b"\n".join(VALVES.split(b"\n")[:2]) + b"\n", ": a log has 2 rows or more"),
    Malformed("200 MB of junk", _large(VALVES, b"junk\n"), " rows of 9 cells; at most 20000 columns"),
)  # fmt: skip


def values(good: bytes) -> Generated:
    """Return a good file with arbitrary cells anywhere."""
    lines = good.decode().splitlines()
    cell = st.one_of(
        st.sampled_from(["", "nan", "inf", "-inf", "1e308", "1e-320", "0", "-1", "999999", "x", '"', " 5 "]),
        st.floats(-2e3, 2e3).map(repr),
    )
    place = st.tuples(st.integers(0, len(lines) - 1), st.integers(0, 40), cell)

    def apply(edits: list[tuple[int, int, str]]) -> bytes:
        cells = [line.split(",") for line in lines]
        for row, column, new in edits:
            cells[row][column % len(cells[row])] = new
        return ("\n".join(",".join(each) for each in cells) + "\n").encode()

    return st.lists(place, min_size=1, max_size=12).map(apply)
