"""Formats of motion recordings: which one a file has; readers of Vicon, Qualisys, DeepLabCut, C3D and MCAP.

`motion_files.read_markers` chooses the reader; Motive's export and plain CSV are read there. Lengths come out
in m and times in s, in the file's own axes. Damaged files of any format raise one `InputError` that names the
file. The libraries `c3d` and `mcap` are the extra `recordings`.
"""

from __future__ import annotations

import json
import os
import re
import warnings
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass, field, replace
from io import BytesIO, StringIO
from itertools import takewhile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from srs_twin.errors import InputError, did_you_mean
from srs_twin.io.files import existing, printable, shown
from srs_twin.recordings.csv_table import (
    LENGTHS,
    MAX_COLUMNS,
    MAX_HEADER_BYTES,
    MAX_VALUES,
    RecordedFile,
    read_bytes,
)
from srs_twin.recordings.mcap_messages import RawMessage, messages
from srs_twin.recordings.tracking import MarkerTable, plausible

MOTIVE, VICON, QUALISYS = "Motive CSV", "Vicon CSV", "Qualisys TSV"
DEEPLABCUT, PLAIN, C3D, MCAP = "DeepLabCut CSV", "plain CSV", "C3D", "MCAP"
FORMATS = (MOTIVE, VICON, QUALISYS, DEEPLABCUT, PLAIN, C3D, MCAP)

LEAST_LIKELIHOOD = 0.6
"""Samples that DeepLabCut deems less likely are not seen; its own default (`pcutoff`)."""

_PEEK = 1 << 16  # bytes that tell a format
_MOST_FRAMES = 1 << 22  # of a C3D file: an hour at 1 kHz
_APART = 1.0  # s from the log's clock: stamps farther away may be another clock's
_MAGIC = b"\x89MCAP0\r\n"
_SECTIONS = ("Trajectories", "Devices", "Joints", "Segments", "Model Outputs", "Events", "Forces")
_SECTION = re.compile(rb'^"?(%s)"?[ \t,]*\r?$' % "|".join(_SECTIONS).encode(), re.MULTILINE)
_PLAIN_NAME = re.compile(r"\s*(?:t|time|[xyz]_\d+)(?![A-Za-z0-9])", re.IGNORECASE)
_UNIT = r"(?:[ _]*[\[(]?(?P<unit>mm|cm|m|in|ft)[\])]?)?"
_AXIS_LAST = re.compile(r"(?P<name>.*?)[ _.:\-\[(]*(?<![A-Za-z])(?P<axis>[xyz])[\])]?" + _UNIT, re.IGNORECASE)
_AXIS_FIRST = re.compile(r"(?P<axis>[xyz])[ _.:\-](?P<name>\w.*?)" + _UNIT, re.IGNORECASE)
_QTM_LINE = re.compile(rb"(?!NULL|NAN)[A-Z][A-Z0-9_]+[\t\r ]|Frame\t")
_MOST_EVENTS = 1000  # lines of a Qualisys header; each event has one
_EXPORT = "export CSV or C3D instead"
# Suffix or first bytes, what that is, what to do.
_OTHERS: tuple[tuple[str | bytes, str, str], ...] = (
    (".tak", "a take of Motive", "export it there (File, Export Tracking Data, CSV)"),
    (".qtm", "a measurement of Qualisys", "export it there (File, Export, To TSV)"),
    (b"#ROSBAG", "a ROS 1 bag", "convert it: `mcap convert in.bag out.mcap`"),
    (b"SQLite format 3", "a ROS 2 bag in SQLite (.db3)", "convert it: `mcap convert in.db3 out.mcap`"),
    (b"\x89HDF", "an HDF5 file", "DeepLabCut writes a CSV beside it with save_as_csv=True"),
    (b"PK\x03\x04", "a ZIP archive or an Excel workbook (.xlsx)", "unpack it, or save the sheet as CSV"),
    (b"\xd0\xcf\x11\xe0", "an Excel workbook (.xls)", "save the sheet as CSV"),
    (b"\x1f\x8b", "a gzip archive", "unpack it"),
    (b"PathFileType", "a TRC file", _EXPORT),
    (b"HIERARCHY", "a BVH file, which holds joint angles and no markers", _EXPORT),
)


def identify(path: str | os.PathLike[str]) -> str:
    """Return the format of a recording, one of `FORMATS`, by its first bytes.

    Raises:
        InputError: missing, a folder, empty, or of another format; says what it looks like.
    """
    place, name, raw = _begin(path)
    if kind := _binary(raw):
        return kind
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    if not raw.strip():
        raise InputError(f"{name}: empty; a recording has a header and rows of numbers")
    wide = raw.startswith((b"\xff\xfe", b"\xfe\xff"))  # the reader says how to save it
    text = raw.decode("utf-16" if wide else "utf-8", "replace")
    first = next((line for line in text.splitlines() if line.strip()), "")
    title = re.split(r"[,\t]", first)[0].strip(' "')
    if title == "Format Version":
        return MOTIVE
    if title in _SECTIONS:
        return VICON
    if re.match(r"(NO_OF_\w+|FILE_VERSION|FREQUENCY|MARKER_NAMES)\t", first):
        return QUALISYS
    if title.lower() == "scorer":
        return DEEPLABCUT
    cells = re.split(r"[,;\t]", first)
    if any(_PLAIN_NAME.match(cell) for cell in cells) or axis_columns(cells):
        return PLAIN
    for sign, what, remedy in _OTHERS:
        if raw.startswith(sign) if isinstance(sign, bytes) else place.suffix.lower() == sign:
            raise InputError(f"{name}: {what}, which is not read; {remedy}. Formats: {', '.join(FORMATS)}")
    looks = (
        "a binary file of a kind that is not known" if "\0" in text else f"its first line is '{first[:40]}'"
    )
    listed = f"formats: {', '.join(FORMATS)} (first line time,x_1,y_1,x_2,y_2,…)"
    raise InputError(printable(f"{name}:1: no motion recording that is read: {looks}; {listed}"))


def binary_format(path: str | os.PathLike[str]) -> str:
    """Return "C3D" or "MCAP" by a file's first bytes, empty for anything else.

    Raises:
        InputError: it cannot be read.
    """
    return _binary(_begin(path)[2])


def _begin(path: str | os.PathLike[str]) -> tuple[Path, str, bytes]:
    place = existing(Path(path), suffix=".csv")
    name = shown(place)
    try:
        with place.open("rb") as stream:
            return place, name, stream.read(_PEEK)
    except OSError as error:
        raise InputError(f"{name}: cannot be read ({error.strerror})") from error


def _binary(raw: bytes) -> str:
    if raw.startswith(_MAGIC):
        return MCAP
    return C3D if raw[1:2] == b"\x50" and raw[0] < 32 and raw[0] not in b"\0\t\n\r" else ""


def axis_columns(cells: Sequence[str]) -> dict[str, dict[str, tuple[int, str]]]:
    """Return marker → axis → column and unit of a header whose names end or begin with x, y or z.

    As ``base_x,base_y``, ``Tip X (mm)``, ``x_LED1``. Markers without x and y are left out.
    """
    found: dict[str, dict[str, tuple[int, str]]] = {}
    for place, cell in enumerate(cells):
        match = _AXIS_LAST.fullmatch(cell.strip(' "')) or _AXIS_FIRST.fullmatch(cell.strip(' "'))
        if match:
            found.setdefault(match["name"].strip(" _.:-") or "marker", {}).setdefault(
                match["axis"].lower(), (place, (match["unit"] or "").lower())
            )
    return {name: axes for name, axes in found.items() if {"x", "y"} <= axes.keys()}


def counted_times(frame: np.ndarray, time: np.ndarray, rate: float) -> np.ndarray:
    """Return times from frame numbers, as printed times are rounded, shape (frames,), s.

    A take exported from its middle counts frames or time from elsewhere; half a frame is rounding. Where the
    two differ by more, the printed times count.
    """
    if not np.isfinite(frame).all():
        return time
    counted = time[0] + (frame - frame[0]) / rate
    return np.asarray(counted) if np.abs(counted - time).max() < 0.5 / rate else time


def length_unit(file: RecordedFile, unit: str, line: int | None = None, column: int | None = None) -> float:
    """Return the factor from a unit of length to m.

    Raises:
        InputError: it is not known.
    """
    factor = LENGTHS.get(unit.strip().lower())
    if factor is None:
        hint, allowed = did_you_mean(unit, LENGTHS), ", ".join(LENGTHS)
        what = printable(f"unit of length '{unit[:20]}' is not known")
        raise file.error(f"{what}{hint}; allowed: {allowed}", line, column)
    return factor


def _rate(file: RecordedFile, given: str, line: int | None = None) -> float:
    try:
        rate = float(given)
    except ValueError:
        rate = 0.0
    if not 0 < rate < 1e6:
        raise file.error(f"frame rate '{given[:20]}' is not allowed; frames a second are wanted", line)
    return rate


def _numbered(file: RecordedFile, numbers: np.ndarray, header_lines: int, what: str) -> np.ndarray:
    """Return a column of which no cell may be blank."""
    if (missing := np.isnan(numbers)).any():
        raise file.error(f"a row without a {what}", header_lines + 1 + int(missing.argmax()), 1)
    return numbers


def read_vicon(file: RecordedFile) -> MarkerTable:
    """Read the section Trajectories of a Vicon Nexus export; frame 1 is at 0 s.

    Raises:
        InputError: with file, line and column, and what is allowed.
    """
    sections = [(found[1].decode(), found.start()) for found in _SECTION.finditer(file.raw)]
    at = next((start for title, start in sections if title == "Trajectories"), None)
    if at is None:
        titles = ", ".join(dict.fromkeys(title for title, _ in sections))
        raise file.error(f"no section Trajectories (sections: {titles}); export trajectories from Nexus")
    above = file.raw.count(b"\n", 0, at) + 1
    lines = file.head(4, above)
    if len(lines) < 4 or [cell.strip() for cell in lines[2][:2]] != ["Frame", "Sub Frame"]:
        wanted = "rate, names, 'Frame,Sub Frame,X,Y,Z,…' and units are wanted below 'Trajectories'"
        raise file.error(f"the header is cut: {wanted}", above + 1)
    rate = _rate(file, lines[0][0] if lines[0] else "", above + 1)
    axes = [cell.strip() for cell in lines[2]]
    width = len(axes)
    names, units = ([cell.strip() for cell in (line + [""] * width)[:width]] for line in (lines[1], lines[3]))
    places = [k for k in range(2, width - 2) if axes[k : k + 3] == ["X", "Y", "Z"]]
    if not places:
        raise file.error("no columns X,Y,Z", above + 3)
    columns = [k + axis for k in places for axis in range(3)]
    factors = [length_unit(file, units[k], above + 4, k + 1) for k in columns]
    values, notes = file.rows(above + 4, [0, *columns], width, section=True)
    frame = _numbered(file, values[:, 0], above + 4, "frame number")
    points, implausible = plausible((values[:, 1:] * factors).reshape(len(values), -1, 3))
    skipped = [title for title, start in sections if start != at]
    notes += [f"section {title} skipped" for title in skipped]
    if other := sorted({units[k] for k in columns} - {"m"}):
        notes.append(f"lengths converted from {', '.join(other)} to m")
    labels = tuple(printable(names[k]) or f"column {k + 1}" for k in places)
    corrections = (*notes, *implausible)
    return MarkerTable(file.name, file.sha256, VICON, (frame - 1) / rate, points, labels, corrections)


def read_qualisys(file: RecordedFile, rate_hz: float | None = None) -> MarkerTable:
    """Read a 3D export of Qualisys Track Manager (mm); 0,0,0 is not seen.

    Args:
        file: tab-separated, with its header; with or without the columns Frame and Time.
        rate_hz: frames a second, where FREQUENCY is EXT and there is no column Time.

    Raises:
        InputError: a 2D or 6D export, or damaged; with file and line.
    """
    file = replace(file, separator="\t")
    lines = file.raw[:MAX_HEADER_BYTES].split(b"\n", _MOST_EVENTS)
    header = next((k for k, line in enumerate(lines) if not _QTM_LINE.match(line)), len(lines))
    *above, row = [[cell.strip() for cell in cells] for cells in file.head(header + 1)]
    about = {cells[0]: cells[1:] for cells in reversed(above)}
    kind = "".join(about.get("DATA_INCLUDED", ["3D"])[:1])
    if not about.keys().isdisjoint({"NO_OF_BODIES", "BODY_NAMES"}):
        kind = "6D"
    if kind != "3D":
        what = printable(f"a {kind[:20]} export of Qualisys")
        raise file.error(f"{what}; 3D is read (File, Export, To TSV, 3D data)")
    names = list(takewhile(bool, about.get("MARKER_NAMES", [])))
    if not names or len(row) < 3:
        raise file.error("the header is cut: MARKER_NAMES and rows of numbers are wanted", header + 1)
    width = len(row)
    # A row may end in a tab, and begin with the frame and the time.
    first = {0: 0, 1: 0, 2: 2, 3: 2}.get(width - 3 * len(names))
    if first is None:
        wanted = f"{3 * len(names)}, or {3 * len(names) + 2} with Frame and Time, are wanted"
        raise file.error(f"{width} cells for {len(names)} markers; {wanted}", header + 1)
    values, notes = file.rows(header, range(first + 3 * len(names)), width)
    given = "".join(about.get("FREQUENCY", [])[:1])
    if given in ("EXT", "") and rate_hz:
        given = str(rate_hz)
    time = _numbered(file, values[:, 1], header, "time") if first else np.arange(len(values)) + 0.0
    if not first:
        time /= _rate(file, given)
    elif given != "EXT":
        time = counted_times(values[:, 0], time, _rate(file, given))
    points = values[:, first:].reshape(len(values), -1, 3) * LENGTHS["mm"]
    points[(points == 0).all(axis=-1)] = np.nan
    points, implausible = plausible(points)
    corrections = (*notes, "lengths converted from mm to m", "0,0,0 taken as not seen", *implausible)
    count = "".join(about.get("NO_OF_FRAMES", [])[:1])
    frames = int(count) if count.isdecimal() and len(count) < 10 else None
    labels = tuple(printable(name) for name in names)
    return MarkerTable(file.name, file.sha256, QUALISYS, time, points, labels, corrections, (), frames)


def read_deeplabcut(
    file: RecordedFile, rate_hz: float | None, unit: str | None, scale_m: float | None = None
) -> MarkerTable:
    """Read the tracks of DeepLabCut in a plane, of one animal (3 header rows) or several (4).

    Args:
        file: its CSV.
        rate_hz: frames a second of the video.
        unit: of the coordinates where they are lengths; None or "px": pixels.
        scale_m: size of a pixel, m.

    Raises:
        InputError: rate or scale are not given, or the file is damaged; with line and column.
    """
    missing = [] if rate_hz else ["`rate_hz` (frames a second of the video)"]
    pixels = unit in (None, "px")
    if pixels and not scale_m:
        missing.append("`scale_m` (m per pixel; or `unit`, where coordinates are lengths)")
    if missing:
        raise file.error(f"DeepLabCut counts frames and pixels; give {' and '.join(missing)}")
    rate = _rate(file, str(rate_hz))
    factor = float(scale_m or 0.0) if pixels else length_unit(file, unit or "")
    if not 0 < factor < 1e3:
        raise file.error(f"scale_m {factor:g} is not allowed; m per pixel are wanted")
    lines = {cells[0].strip(): cells for cells in file.head(4) if cells}
    if not {"bodyparts", "coords"} <= lines.keys():
        raise file.error("the header is cut: rows scorer, (individuals,) bodyparts and coords are wanted", 2)
    rows = 4 if "individuals" in lines else 3
    width = len(lines["coords"])
    coords = [cell.strip() for cell in lines["coords"][1:]]
    if len(coords) % 3 or coords != ["x", "y", "likelihood"] * (len(coords) // 3) or not coords:
        raise file.error("columns x,y,likelihood are wanted for each body part", rows)
    values, notes = file.rows(rows, range(width), width)
    frame = _numbered(file, values[:, 0], rows, "frame number")
    samples = values[:, 1:].reshape(len(values), -1, 3)
    points = samples[..., :2] * [factor, -factor]
    unlikely = ~(samples[..., 2] >= LEAST_LIKELIHOOD) & np.isfinite(points).all(axis=-1)
    points[unlikely] = np.nan
    points, implausible = plausible(points)
    notes += [
        f"{int(unlikely.sum())} samples of likelihood below {LEAST_LIKELIHOOD} taken as not seen",
        "y flipped: it runs down in pictures",
        f"coordinates multiplied by {factor:g} to m",
    ]
    parts, animals = lines["bodyparts"], lines.get("individuals")
    if len(parts) != width or (animals and len(animals) != width):
        raise file.error(f"rows of the header have other than {width} cells", rows)
    names = (f"{animals[k]}:{parts[k]}" if animals else parts[k] for k in range(1, width, 3))
    labels = tuple(printable(name) for name in names)
    return MarkerTable(
        file.name, file.sha256, DEEPLABCUT, frame / rate, points, labels, (*notes, *implausible)
    )


@contextmanager
def _decoding(file: RecordedFile, kind: str) -> Iterator[None]:
    """Turn what a library raises on a damaged file, or its absence, into one `InputError`."""
    try:
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            yield
    except InputError:
        raise
    except ModuleNotFoundError as error:
        how = "`uv sync --extra recordings`, or `pip install 'srs-twin[recordings]'`"
        raise file.error(f"{kind} needs the package {error.name}, which is an extra: {how}") from error
    except Exception as error:  # libraries raise whatever their first wrong byte leads to
        said = printable(" ".join(str(error).split()))[:120]
        reason = f" ({said})" if isinstance(error, ValueError) else ""
        raise file.error(f"a damaged {kind} file{reason}; record or export it anew") from error


def read_c3d(path: str | os.PathLike[str]) -> MarkerTable:
    """Read the points of a C3D file; frame 1 is at 0 s, and a residual below 0 is not seen.

    Raises:
        InputError: damaged, without points, rate or unit, or the library is not installed.
    """
    file = read_bytes(path)
    with _decoding(file, C3D):
        import c3d

        class Reader(c3d.Reader):
            """Takes files whose header and parameters differ in what is not read here."""

            def _check_metadata(self) -> None:
                pass

        reader = Reader(BytesIO(file.data))
        count, announced = reader.point_used, reader.frame_count
        if not count or announced < 1:
            raise file.error("no points in this C3D file; export marker trajectories")
        if announced > _MOST_FRAMES:
            raise file.error(f"{announced} frames; at most {_MOST_FRAMES} are read (export a shorter take)")
        rate = _rate(file, str(reader.point_rate))
        text = reader.get("POINT:UNITS")
        unit = text.string_value.strip("\0 ").lower() if text else ""
        factor = length_unit(file, unit or "mm")
        frames = (points[:, :4] for _, points, _ in reader.read_frames(copy=False))
        samples = np.fromiter(frames, np.dtype((np.float32, (count, 4)))).astype(float)
        time = (np.arange(len(samples)) + reader.first_frame - 1) / rate
        keys = ["LABELS", *(f"LABELS{k}" for k in range(2, 2 + count // 255))]
        texts = [reader.get(f"POINT:{key}") for key in keys]
        names = [str(name).strip("\0 ") for each in texts if each is not None for name in each.string_array]
    if not len(samples):
        raise file.error("a damaged C3D file (it ends before its first frame)")
    points = np.where(samples[..., 3:] < 0, np.nan, samples[..., :3] * factor)
    points, implausible = plausible(points)
    notes = []
    if unit != "m":
        notes.append(f"lengths converted from {unit} to m" if unit else "POINT:UNITS is not given: mm taken")
    if len(samples) < announced:
        notes.append(f"the file ends after {len(samples)} of {announced} frames")
    names += [""] * count
    labels = tuple(printable(names[k]) or f"point {k + 1}" for k in range(count))
    corrections = (*notes, *implausible)
    return MarkerTable(file.name, file.sha256, C3D, time, points, labels, corrections, (), announced)


@dataclass(frozen=True)
class McapTopics:
    """What an MCAP file holds, on one clock that begins at its first message.

    Attributes:
        name: of the file, as messages show it.
        sha256: of the file.
        origin_ns: log time of the first message, ns; 0 s of all times here.
        markers: positions and rotations of bodies and points; None where no topic has any.
        signals: (time, values) by name, each of shape (samples,), s and as recorded: ``/joy.axes[0]``,
            ``/joints.NAME.position``, ``/topic.data[2]``, ``/topic.dotted.path`` of JSON.
        notes: what was skipped or is odd, in words.
    """

    name: str
    sha256: str
    origin_ns: int
    markers: MarkerTable | None
    signals: dict[str, tuple[np.ndarray, np.ndarray]]
    notes: tuple[str, ...]


def read_mcap(path: str | os.PathLike[str], *, signals: bool = True) -> McapTopics:
    """Read poses, points and signals of ROS 2 (CDR) and JSON topics.

    Times are header stamps where messages have them, else log times. Frames are the messages of the marker
    topic that has most; of other topics the nearest message within half a frame counts.

    Args:
        path: of the file.
        signals: whether to read the topics without positions.

    Raises:
        InputError: damaged, too large, or the libraries are not installed.
    """
    file = read_bytes(path)
    topics = _Topics(file, signals)
    cut = not file.data.endswith(_MAGIC) or len(file.data) < 2 * len(_MAGIC)
    with _decoding(file, MCAP):
        try:
            for schema, channel, message in messages(file):
                topics.add(schema, channel, message)
        except (InputError, ModuleNotFoundError):
            raise
        except Exception:  # a file without its end holds half a record somewhere
            if not (cut and topics.messages):
                raise
            topics.notes.append("the file is cut: read up to there")
        return topics.result()


_Series = tuple["array[int]", "array[float]"]  # ns; one or seven numbers a sample


@dataclass
class _Topics:
    """What has been read of an MCAP file up to now."""

    file: RecordedFile
    with_signals: bool = True
    origin: int = 0
    signals: dict[str, _Series] = field(default_factory=dict)
    bodies: dict[str, dict[str, _Series]] = field(default_factory=dict)  # topic → label → poses
    skipped: Counter[int] = field(default_factory=Counter)  # channel → messages
    topics: dict[int, tuple[str, str, Callable[[bytes], Any] | None]] = field(default_factory=dict)
    messages: int = 0
    numbers: int = 0
    apart: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, schema: Any, channel: Any, message: RawMessage) -> None:
        """Take in one message."""
        self.messages += 1
        self.origin = message.log_time if self.messages == 1 else min(self.origin, message.log_time)
        if channel.id not in self.topics:
            kind = schema.name.replace("/msg/", "/") if schema else channel.message_encoding
            self.topics[channel.id] = (
                kind,
                printable(channel.topic[:200]),
                self._decoder(kind, schema, channel),
            )
        kind, topic, decode = self.topics[channel.id]
        if decode is None:
            self.skipped[channel.id] += 1
            return
        if kind not in _BODIES and not self.with_signals:
            return
        said = decode(bytes(message.data))
        stamp = getattr(getattr(said, "header", None), "stamp", None)
        time, whole, part = message.log_time, getattr(stamp, "sec", None), getattr(stamp, "nanosec", None)
        if isinstance(whole, int) and isinstance(part, int) and (whole or part):
            time = whole * 10**9 + part
            self.apart.setdefault(topic, abs(time - message.log_time) / 1e9)
        if kind in _BODIES:
            for k, pose in enumerate(_BODIES[kind](said), start=1):
                label = topic if kind != "geometry_msgs/PoseArray" else f"{topic}_{k}"
                self._append(self.bodies.setdefault(topic, {}), label, time, _pose_numbers(pose))
        else:
            for name, value in _numbers(kind, said):
                self._append(self.signals, f"{topic}{printable(name)}", time, (float(value),))

    @staticmethod
    def _decoder(kind: str, schema: Any, channel: Any) -> Callable[[bytes], Any] | None:
        if channel.message_encoding == "json":
            return _json
        if kind in _BODIES or kind in _SIGNALS or _STD.fullmatch(kind):
            from mcap_ros2.decoder import DecoderFactory

            with redirect_stderr(StringIO()):  # prints lines of schemas that it cannot read
                return DecoderFactory().decoder_for(channel.message_encoding, schema)
        return None

    def _append(self, series: dict[str, _Series], name: str, time: int, values: tuple[float, ...]) -> None:
        times, numbers = series.setdefault(name, (array("q"), array("d")))
        times.append(time)
        numbers.extend(values)
        self.numbers += 1 + len(values)
        if self.numbers > MAX_VALUES or len(series) > MAX_COLUMNS:
            raise self.file.error(f"at most {MAX_VALUES} numbers of {MAX_COLUMNS} signals are read")

    def result(self) -> McapTopics:
        """Return all topics on one clock."""
        skipped: Counter[str] = Counter()
        for channel, count in self.skipped.items():
            kind, topic, _ = self.topics[channel]
            skipped[f"{topic} ({printable(kind[:80])})"] += count
        self.notes += [f"topic {topic} skipped: {count} messages" for topic, count in skipped.items()]
        self.notes += [
            f"stamps of {topic} lie {apart:.3g} s from the log's clock"
            for topic, apart in self.apart.items()
            if apart > _APART
        ]
        signals = {}
        for name, (stamps, values) in self.signals.items():
            time, order = self._clock(stamps)
            signals[name] = (time, np.array(values)[order])
        markers = self._markers() if self.bodies else None
        return McapTopics(self.file.name, self.file.sha256, self.origin, markers, signals, tuple(self.notes))

    def _clock(self, stamps: array[int]) -> tuple[np.ndarray, np.ndarray]:
        """Return ascending times, s, and the order that sorts samples by them."""
        whole = np.array(stamps, dtype=np.int64) - self.origin
        order = np.argsort(whole, kind="stable")
        return whole[order] / 1e9, order

    def _markers(self) -> MarkerTable:
        stamps = {
            topic: np.unique(np.concatenate([self._clock(each)[0] for each, _ in series.values()]))
            for topic, series in self.bodies.items()
        }
        main = max(stamps, key=lambda topic: len(stamps[topic]))
        time = stamps[main]
        half = 0.5 * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        labels = [(topic, label) for topic, series in self.bodies.items() for label in series]
        if len(time) * len(labels) * 7 > MAX_VALUES:
            raise self.file.error(f"{len(time)} frames of {len(labels)} bodies; at most {MAX_VALUES} numbers")
        poses = np.full((len(time), len(labels), 7), np.nan)
        for k, (topic, label) in enumerate(labels):
            own, order = self._clock(self.bodies[topic][label][0])
            after = np.searchsorted(own, time).clip(max=len(own) - 1)
            before = np.maximum(after - 1, 0)
            nearest = np.where(time - own[before] <= own[after] - time, before, after)
            near = np.abs(own[nearest] - time) <= (0.0 if topic == main else half)
            poses[near, k] = np.array(self.bodies[topic][label][1]).reshape(-1, 7)[order][nearest[near]]
        points, implausible = plausible(poses[..., :3])
        turned = np.linalg.norm(poses[..., 3:], axis=-1)
        valid = (turned > 0.5) & (turned < 2.0) & ~np.isnan(points[..., 0])
        rotations = np.where(valid[..., None], poses[..., 3:], np.nan) if valid.any() else None
        corrections, names = (*self.notes, *implausible), tuple(label for _, label in labels)
        return MarkerTable(
            self.file.name, self.file.sha256, MCAP, time, points, names, corrections, rotations=rotations
        )


_STD = re.compile(r"std_msgs/(Bool|(Float|U?Int)\d+(MultiArray)?)")
_SIGNALS = ("sensor_msgs/Joy", "sensor_msgs/JointState")
_BODIES: dict[str, Callable[[Any], list[Any]]] = {
    "geometry_msgs/PoseStamped": lambda said: [said.pose],
    "geometry_msgs/Pose": lambda said: [said],
    "geometry_msgs/PoseArray": lambda said: said.poses,
    "geometry_msgs/PointStamped": lambda said: [SimpleNamespace(position=said.point)],
    "geometry_msgs/Point": lambda said: [SimpleNamespace(position=said)],
}


def _pose_numbers(pose: Any) -> tuple[float, ...]:
    """Return x, y, z and the quaternion x, y, z, w; NaN where a point has none."""
    at, turn = pose.position, getattr(pose, "orientation", None)
    return (at.x, at.y, at.z, *((turn.x, turn.y, turn.z, turn.w) if turn is not None else (np.nan,) * 4))


def _json(data: bytes) -> Any:
    """Return a JSON message; objects are namespaces, as decoded ROS messages are."""
    return json.loads(data, object_hook=lambda each: SimpleNamespace(**each))


def _numbers(kind: str, said: Any) -> Iterator[tuple[str, float]]:
    """Yield (name below the topic, number) of a message."""
    if kind == "sensor_msgs/JointState":
        for quantity in ("position", "velocity", "effort"):
            for joint, value in zip(said.name, getattr(said, quantity), strict=False):
                yield f".{joint}.{quantity}", value
    elif kind == "sensor_msgs/Joy":
        yield from _leaves(".axes", list(said.axes))
        yield from _leaves(".buttons", list(said.buttons))
    elif _STD.fullmatch(kind):
        yield from _leaves(".data", said.data if isinstance(said.data, int | float) else list(said.data))
    else:
        yield from _leaves("", said)


def _leaves(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield all numbers inside lists and namespaces, by dotted path."""
    if isinstance(value, SimpleNamespace):
        for key, inner in vars(value).items():
            yield from _leaves(f"{name}.{key}", inner)
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            yield from _leaves(f"{name}[{k}]", inner)
    elif isinstance(value, int | float):
        yield name, value
