"""Reader for C3D files of motion capture systems.

A C3D file consists of a header block, a parameter section, and a data section that
stores the frames one after another. The processor type in the parameter section
determines the byte order and the float format. Parameters are named arrays in groups.
Names are not case-sensitive, and the first of several parameters with the same name is
used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, NamedTuple, final

import numpy as np

from srs_twin.recordings.formats.base import (
    Format,
    MarkerTable,
    Unstated,
    decoding,
    frame_rate,
    length_unit,
    marker_table,
)
from srs_twin.recordings.recorded_file import RecordedFile
from srs_twin.recordings.signals.units import LENGTHS, symbol

_BLOCK = 512
_DEC = 85
"""Processor type for DEC (VAX) floats with swapped words and another exponent bias."""
_BIG_ENDIAN = 86
"""Processor type for big-endian numbers (MIPS)."""

_MAX_FRAMES = 1 << 22
"""Maximum number of frames of a C3D file (one hour at 1 kHz)."""
_MAX_COUNTED = 65_535
"""Maximum frame number that a 16-bit field in the header can contain."""
_MAX_PARAMETERS = 20_000

_OTHER_KINDS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
"""Parameters that name Vicon model outputs, which are not positions."""

_ELEMENT_BYTES: Final = {-1: 1, 1: 1, 2: 2, 4: 4}
"""Bytes per element of each parameter type (characters, bytes, integers, floats)."""


class _Parameter(NamedTuple):
    kind: int
    shape: tuple[int, ...]
    data: bytes


@dataclass(frozen=True)
class _Contents:
    data: bytes
    processor: int
    parameters: dict[str, _Parameter]

    @property
    def order(self) -> str:
        if self.processor == _BIG_ENDIAN:
            return ">"
        return "<"

    def header_word(self, byte: int) -> int:
        return int(np.frombuffer(self.data, f"{self.order}u2", 1, byte)[0])

    def floats(self, data: bytes) -> np.ndarray:
        if self.processor != _DEC:
            return np.frombuffer(data, f"{self.order}f4")
        words = np.frombuffer(data, "<u2").reshape(-1, 2)[:, ::-1]
        return np.frombuffer(words.tobytes(), "<f4") / 4

    def number(self, key: str, header_byte: int) -> float:
        data = self.data[header_byte : header_byte + 4]
        parameter = self.parameters.get(key)
        if parameter is not None and len(parameter.data) >= 4:
            data = parameter.data[:4]
        return float(self.floats(data)[0])

    def integer(self, key: str) -> int:
        parameter = self.parameters.get(key)
        if parameter is None or len(parameter.data) < 2:
            return 0
        if parameter.kind == 4:
            value = float(self.floats(parameter.data[:4])[0])
            if 0 < value < 1e9:
                return int(value)
            return 0
        words = np.frombuffer(parameter.data[:4], f"{self.order}u2").tolist()
        return sum(word << (16 * k) for k, word in enumerate(words))

    def strings(self, key: str) -> list[str]:
        parameter = self.parameters.get(key)
        if parameter is None or not parameter.shape:
            return []
        size = max(parameter.shape[0], 1)
        starts = range(0, len(parameter.data), size)
        texts = [
            parameter.data[k : k + size].decode("utf-8", "replace") for k in starts
        ]
        return [text.strip("\0 ") for text in texts]


def _contents(file: RecordedFile) -> _Contents:
    data = file.data
    start = (data[0] - 1) * _BLOCK
    processor = data[start + 3]
    contents = _Contents(data, processor, {})
    groups: dict[int, str] = {}
    found: list[tuple[int, str, _Parameter]] = []
    place = start + 4
    for _ in range(_MAX_PARAMETERS):
        length = abs(int.from_bytes(data[place : place + 1], signed=True))
        group = int.from_bytes(data[place + 1 : place + 2], signed=True)
        if not length:
            break
        name = data[place + 2 : place + 2 + length].decode("latin-1").strip().upper()
        place += 2 + length
        step = contents.header_word(place)
        if group < 0:
            groups.setdefault(-group, name)
        else:
            found.append((group, name, _parameter(data, place + 2)))
        if not step:
            break
        place += step
    for group, name, parameter in found:
        contents.parameters.setdefault(f"{groups.get(group, '')}:{name}", parameter)
    if not found:
        raise file.error(
            "the C3D file is damaged: it has no parameters; record or export it again"
        )
    return contents


def _parameter(data: bytes, place: int) -> _Parameter:
    kind = int.from_bytes(data[place : place + 1], signed=True)
    first = place + 2 + data[place + 1]
    shape = tuple(data[place + 2 : first])
    size = _ELEMENT_BYTES[kind] * int(np.prod(shape, dtype=int))
    return _Parameter(kind, shape, data[first : first + size])


@final
class C3d(Format):
    """C3D file with marker positions. Analog channels are ignored."""

    name = "C3D"
    binary = True

    def recognizes(self, start: RecordedFile) -> bool:
        """Return whether a file starts with the bytes of a C3D header."""
        raw = start.data
        return raw[1:2] == b"\x50" and raw[0] < 32 and raw[0] not in b"\0\t\n\r"

    def read(self, file: RecordedFile, unstated: Unstated) -> MarkerTable:
        """Read the points of a C3D file.

        The time of frame 1 is 0 s. A negative residual denotes a missing point.
        """
        with decoding(file, self.name):
            contents = _contents(file)
            rate = contents.number("POINT:RATE", 20) or unstated.rate_hz or 0
            rate = frame_rate(file, str(float(rate)))
            frames = _frames(file, contents)
        samples = frames.samples
        count = samples.shape[1]
        keys = [
            "POINT:LABELS",
            *(f"POINT:LABELS{k}" for k in range(2, 2 + count // 255)),
        ]
        names = [name for key in keys for name in contents.strings(key)]
        names = (names + [""] * count)[:count]
        others = {
            label
            for kind in _OTHER_KINDS
            for label in contents.strings(f"POINT:{kind}")
            if label
        }
        chosen = [k for k in range(count) if names[k] not in others] or list(
            range(count)
        )
        units, notes = _units(file, contents, chosen, count, unstated.unit)
        if len(chosen) < count:
            skipped = count - len(chosen)
            notes.append(
                f"{skipped} points with angles, forces or similar quantities were"
                " skipped"
            )
        if len(samples) < frames.announced:
            notes.append(
                f"the file ends after {len(samples)} of {frames.announced} frames"
            )
        time = (np.arange(len(samples)) + max(frames.first - 1, 0)) / rate
        points = np.where(samples[..., 3:] <= -1, np.nan, samples[..., :3])[:, chosen]
        labels = [names[k] for k in chosen]
        table = marker_table(file, self.name, time, points, labels, notes, unit=units)
        return replace(table, header_frames=frames.announced)


def _units(
    file: RecordedFile,
    contents: _Contents,
    chosen: list[int],
    count: int,
    given: str | None,
) -> tuple[list[str], list[str]]:
    stated = [unit.lower() for unit in contents.strings("POINT:UNITS") if unit]
    if not stated and not given:
        raise file.error(
            "the unit of length (POINT:UNITS) is missing; give it with --units,"
            " or with `units` in a map"
        )
    if not stated:
        return [given or ""] * len(chosen), [
            f"the unit of length (POINT:UNITS) is missing, so {given} is used"
        ]
    of_points = [stated[k if len(stated) >= count else 0] for k in chosen]
    unknown = sorted({unit for unit in of_points if not symbol(unit, LENGTHS)})
    notes = []
    if given and unknown:
        of_points = [given if unit in unknown else unit for unit in of_points]
        notes.append(
            f"POINT:UNITS {', '.join(unknown)} is not a known unit, so the given unit"
            f" {given} is used"
        )
    return [length_unit(file, unit) for unit in of_points], notes


class _Frames(NamedTuple):
    samples: np.ndarray
    first: int
    announced: int


def _frames(file: RecordedFile, contents: _Contents) -> _Frames:
    """Return the frames of a C3D file.

    The frame numbers in the header have only 16 bits. Longer recordings state the
    number of frames in TRIAL:ACTUAL_START_FIELD and ACTUAL_END_FIELD (two 16-bit words
    each) or in POINT:LONG_FRAMES. Any of these numbers may be wrong, so the largest
    number of frames that fits the file size is used. If the last frame number in the
    header is 65,535 and no larger number is stated, the file is read to the end.
    """
    scale = contents.number("POINT:SCALE", 12)
    value_bytes = 4 if scale < 0 else 2
    count = contents.integer("POINT:USED") or contents.header_word(2)
    block = contents.header_word(16) or contents.integer("POINT:DATA_START")
    data = file.data[max(block - 1, 1) * _BLOCK :]
    first = contents.header_word(6)
    last = contents.header_word(8)
    by_header = last - first + 1
    start = contents.integer("TRIAL:ACTUAL_START_FIELD")
    end = contents.integer("TRIAL:ACTUAL_END_FIELD")
    stated = [
        by_header,
        end and end - start + 1,
        contents.integer("POINT:LONG_FRAMES"),
        contents.integer("POINT:FRAMES"),
    ]
    counts = [number for number in stated if number > 0]
    if not count or not counts:
        raise file.error("the C3D file has no points; export marker trajectories")
    analog = _analog_values(file, contents, count, counts, value_bytes, len(data))
    width = value_bytes * (4 * count + analog)
    room = len(data) // width
    announced = max((number for number in counts if number <= room), default=counts[0])
    overflow = last == _MAX_COUNTED and announced in (by_header, _MAX_COUNTED)
    frames = room if overflow else min(announced, room)
    if not 0 < frames <= _MAX_FRAMES:
        raise file.error(
            f"the C3D file has {frames} complete frames, but it must have between 1"
            f" and {_MAX_FRAMES}; record or export it again"
        )
    data = data[: frames * width]
    if scale < 0:
        numbers = contents.floats(data)
    else:
        numbers = np.frombuffer(data, f"{contents.order}i2")
    samples = (
        numbers.reshape(frames, -1)[:, : 4 * count]
        .reshape(frames, count, 4)
        .astype(float)
    )
    samples[..., :3] *= max(scale, 0.0) or 1.0
    if overflow:  # zeros fill the rest of the last block
        padding = int(samples[::-1].any(axis=(1, 2)).argmax())
        samples = samples[: frames - min(padding, _BLOCK // width)]
        announced = max(announced, len(samples))
    return _Frames(samples, start or first, announced)


def _analog_values(
    file: RecordedFile,
    contents: _Contents,
    count: int,
    counts: list[int],
    value_bytes: int,
    size: int,
) -> int:
    """Return the number of analog values per frame.

    If the header and the parameters disagree, the number that matches the size of the
    data section is used.
    """
    by_header = contents.header_word(4)
    if "ANALOG:USED" not in contents.parameters:
        return by_header
    by_parameters = contents.integer("ANALOG:USED") * contents.header_word(18)
    if by_parameters == by_header:
        return by_header

    def fills(analog: int) -> bool:
        width = value_bytes * (4 * count + analog)
        return any(0 <= size - frames * width < _BLOCK for frames in counts)

    filling = [analog for analog in (by_header, by_parameters) if fills(analog)]
    if len(filling) != 1:
        raise file.error(
            f"the header states {by_header} analog values per frame, but the"
            f" parameters state {by_parameters}, and the file size does not show"
            " which number is right; export the file again"
        )
    return filling[0]
