"""C3D: points of a file, read with the library `c3d`.

The library reads the header and the parameters. The data section is read here in one piece, because the
library reads it frame by frame and needs the scales of all analog channels, which are not used.
"""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np

from srs_twin.recordings.csv_table import RecordedFile
from srs_twin.recordings.formats.base import (
    Unstated,
    decoding,
    frame_rate,
    length_unit,
    marker_table,
)
from srs_twin.recordings.marker_table import MarkerTable

NAME = "C3D"
_MAX_FRAMES = 1 << 22
"""Largest number of frames of a C3D file: an hour at 1 kHz."""
_MAX_COUNTED = 65_535
"""Largest number of frames in the 16 bits of the header."""
_BLOCK = 512
"""Size of a block, bytes."""
_OTHER_KINDS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
"""Parameters with labels of points that are not positions (of Vicon's models)."""


def recognizes(start: RecordedFile) -> bool:
    """Return whether a file starts with the bytes of a C3D header."""
    raw = start.data
    return raw[1:2] == b"\x50" and raw[0] < 32 and raw[0] not in b"\0\t\n\r"


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read the points of a C3D file; frame 1 is at 0 s, and a residual below 0 marks a missing point.

    Raises:
        InputError: the file is damaged or has no points, rate or unit, or the library is not installed.
    """
    with decoding(file, NAME):
        import c3d

        class Reader(c3d.Reader):
            """Reader that accepts files whose header and parameters differ in unused values."""

            def _check_metadata(self) -> None:
                pass

        reader = Reader(BytesIO(file.data))
        rate = frame_rate(file, str(float(reader.point_rate) or unstated.rate_hz or 0))
        samples, first, announced = _samples(file, reader)
        count = samples.shape[1]
        keys = ["POINT:LABELS", *(f"POINT:LABELS{k}" for k in range(2, 2 + count // 255))]
        names = ([name for key in keys for name in _strings(reader, key)] + [""] * count)[:count]
        # One unit for all points, or one for each.
        stated = [unit.lower() for unit in _strings(reader, "POINT:UNITS") if unit]
        given = stated or [unstated.unit or "mm"]
        others = {label for kind in _OTHER_KINDS for label in _strings(reader, f"POINT:{kind}") if label}
        chosen = [k for k in range(count) if names[k] not in others] or list(range(count))
        units = [length_unit(file, given[k if len(given) >= count else 0]) for k in chosen]
    notes = [] if stated else [f"POINT:UNITS is missing: {given[0]} assumed"]
    if len(chosen) < count:
        notes.append(f"{count - len(chosen)} points with angles, forces or similar quantities skipped")
    if len(samples) < announced:
        notes.append(f"the file ends after {len(samples)} of {announced} frames")
    time = (np.arange(len(samples)) + max(first - 1, 0)) / rate
    points = np.where(samples[..., 3:] <= -1, np.nan, samples[..., :3])[:, chosen]
    labels = [names[k] for k in chosen]
    return marker_table(file, NAME, time, points, labels, notes, unit=units, header_frames=announced)


def _samples(file: RecordedFile, reader: Any) -> tuple[np.ndarray, int, int]:
    """Return samples (x, y, z, residual), shape (frames, points, 4), first frame and stated frame count.

    The frame numbers of the header have 16 bits. Longer recordings state their frames in
    TRIAL:ACTUAL_START_FIELD and ACTUAL_END_FIELD (two 16-bit words each) or in POINT:LONG_FRAMES, but some of
    these may be wrong. The largest number that fits into the file is used. If all of them are at most 65,535,
    the file is read to its end.
    """
    from c3d.c3d import DEC_to_IEEE_BYTES

    header, scale, dtypes = reader.header, float(reader.point_scale), reader._dtypes
    count, kind = int(reader.point_used), np.dtype(dtypes.float32 if scale < 0 else dtypes.int16)
    width = (4 * count + int(header.analog_count)) * kind.itemsize
    block = int(header.data_block) or _integer(reader, "POINT:DATA_START")
    data = file.data[max(block - 1, 1) * _BLOCK :]
    by_header = int(header.last_frame) - int(header.first_frame) + 1
    start, end, long, short = (
        _integer(reader, key)
        for key in ("TRIAL:ACTUAL_START_FIELD", "TRIAL:ACTUAL_END_FIELD", "POINT:LONG_FRAMES", "POINT:FRAMES")
    )
    stated = [by_header, end and end - start + 1, long, short]
    counts = [number for number in stated if number > 0]
    if not count or not counts:
        raise file.error("the C3D file has no points; export marker trajectories")
    room = len(data) // width
    announced = max((number for number in counts if number <= room), default=counts[0])
    overflow = header.last_frame == _MAX_COUNTED and announced in (by_header, _MAX_COUNTED)
    frames = room if overflow else min(announced, room)
    if not 0 < frames <= _MAX_FRAMES:
        raise file.error(
            f"the C3D file has {frames} whole frames; it must have 1 to {_MAX_FRAMES} (record or export it "
            "again)"
        )
    data = data[: frames * width]
    numbers = DEC_to_IEEE_BYTES(data) if dtypes.is_dec and scale < 0 else np.frombuffer(data, kind)
    samples = numbers.reshape(frames, -1)[:, : 4 * count].reshape(frames, count, 4).astype(float)
    samples[..., :3] *= max(scale, 0.0) or 1.0
    if overflow:  # the last block is padded with zeros
        padding = int(samples[::-1].any(axis=(1, 2)).argmax())
        samples = samples[: frames - min(padding, _BLOCK // width)]
        announced = max(announced, len(samples))
    return samples, start or int(header.first_frame), announced


def _integer(reader: Any, key: str) -> int:
    """Return an integer parameter, stored as a float or as 16-bit words; 0 if it is missing."""
    param = reader.get(key)
    if param is None or len(param.bytes) < 2:
        return 0
    if param.bytes_per_element == 4:
        value = float(param.float_value)
        return int(value) if 0 < value < 1e9 else 0
    words = np.frombuffer(param.bytes[:4], reader._dtypes.uint16)
    return int(words[0]) + (int(words[1]) << 16 if len(words) > 1 else 0)


def _strings(reader: Any, key: str) -> list[str]:
    """Return the strings of a parameter; empty if it is missing."""
    param = reader.get(key)
    if param is None or not param.dimensions:
        return []
    strings = param.string_array if len(param.dimensions) > 1 else [param.string_value]
    return [str(string).strip("\0 ") for string in strings]
