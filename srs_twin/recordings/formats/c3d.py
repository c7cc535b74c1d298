"""C3D: points of a file, by the library `c3d`; its analog channels are skipped, whatever they lack.

The library reads header and parameters. The data section is read here in one piece: the library goes through
it frame by frame and cannot without the scales of all analog channels.
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
_MOST_FRAMES = 1 << 22  # of a C3D file: an hour at 1 kHz
_MOST_COUNTED = 65_535  # frames, in the 16 bits of the header
_BLOCK = 512  # bytes
_OTHER_KINDS = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")
"""Parameters that list labels of points which are no positions (Vicon's models)."""


def recognizes(start: RecordedFile) -> bool:
    """Say whether a file starts with the bytes of a C3D header."""
    raw = start.data
    return raw[1:2] == b"\x50" and raw[0] < 32 and raw[0] not in b"\0\t\n\r"


def read(file: RecordedFile, unstated: Unstated) -> MarkerTable:
    """Read the points of a C3D file; frame 1 is at 0 s, and a residual below 0 is not seen.

    Raises:
        InputError: damaged, without points, rate or unit, or the library is not installed.
    """
    with decoding(file, NAME):
        import c3d

        class Reader(c3d.Reader):
            """Takes files whose header and parameters differ in what is not read here."""

            def _check_metadata(self) -> None:
                pass

        reader = Reader(BytesIO(file.data))
        rate = frame_rate(file, str(float(reader.point_rate) or unstated.rate_hz or 0))
        samples, first, announced = _samples(file, reader)
        count = samples.shape[1]
        keys = ["POINT:LABELS", *(f"POINT:LABELS{k}" for k in range(2, 2 + count // 255))]
        names = ([name for key in keys for name in _strings(reader, key)] + [""] * count)[:count]
        # One unit of all points, or one of each.
        stated = [unit.lower() for unit in _strings(reader, "POINT:UNITS") if unit]
        given = stated or [unstated.unit or "mm"]
        others = {label for kind in _OTHER_KINDS for label in _strings(reader, f"POINT:{kind}") if label}
        chosen = [k for k in range(count) if names[k] not in others] or list(range(count))
        units = [length_unit(file, given[k if len(given) >= count else 0]) for k in chosen]
    notes = [] if stated else [f"POINT:UNITS is not given: {given[0]} taken"]
    if len(chosen) < count:
        notes.append(f"{count - len(chosen)} points that are angles, forces or the like skipped")
    if len(samples) < announced:
        notes.append(f"the file ends after {len(samples)} of {announced} frames")
    time = (np.arange(len(samples)) + max(first - 1, 0)) / rate
    points = np.where(samples[..., 3:] <= -1, np.nan, samples[..., :3])[:, chosen]
    labels = [names[k] for k in chosen]
    return marker_table(file, NAME, time, points, labels, notes, unit=units, header_frames=announced)


def _samples(file: RecordedFile, reader: Any) -> tuple[np.ndarray, int, int]:
    """Return x, y, z and residual, shape (frames, points, 4), the first frame, and the frames announced.

    The header counts to 65,535. Longer takes say their frames in TRIAL:ACTUAL_START_FIELD and
    ACTUAL_END_FIELD (two 16-bit words each) or in POINT:LONG_FRAMES; not all of them need be right. Of those
    that the file has room for, the largest counts. Where all stop at 65,535, the file is read to its end.
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
    counts = [each for each in (by_header, end and end - start + 1, long, short) if each > 0]
    if not count or not counts:
        raise file.error("no points in this C3D file; export marker trajectories")
    room = len(data) // width
    announced = max((each for each in counts if each <= room), default=counts[0])
    overflow = header.last_frame == _MOST_COUNTED and announced in (by_header, _MOST_COUNTED)
    frames = room if overflow else min(announced, room)
    if not 0 < frames <= _MOST_FRAMES:
        wanted = f"1 to {_MOST_FRAMES} are read"
        raise file.error(f"{frames} whole frames in this C3D file; {wanted} (record or export it anew)")
    data = data[: frames * width]
    numbers = DEC_to_IEEE_BYTES(data) if dtypes.is_dec and scale < 0 else np.frombuffer(data, kind)
    samples = numbers.reshape(frames, -1)[:, : 4 * count].reshape(frames, count, 4).astype(float)
    samples[..., :3] *= max(scale, 0.0) or 1.0
    if overflow:  # the last block is filled up with zeros
        padding = int(samples[::-1].any(axis=(1, 2)).argmax())
        samples = samples[: frames - min(padding, _BLOCK // width)]
        announced = max(announced, len(samples))
    return samples, start or int(header.first_frame), announced


def _integer(reader: Any, key: str) -> int:
    """Return a parameter as a whole number, of a float or of 16-bit words; 0 where it is missing."""
    param = reader.get(key)
    if param is None or len(param.bytes) < 2:
        return 0
    if param.bytes_per_element == 4:
        value = float(param.float_value)
        return int(value) if 0 < value < 1e9 else 0
    words = np.frombuffer(param.bytes[:4], reader._dtypes.uint16)
    return int(words[0]) + (int(words[1]) << 16 if len(words) > 1 else 0)


def _strings(reader: Any, key: str) -> list[str]:
    """Return a parameter's texts; empty where it is missing."""
    param = reader.get(key)
    if param is None or not param.dimensions:
        return []
    found = param.string_array if len(param.dimensions) > 1 else [param.string_value]
    return [str(each).strip("\0 ") for each in found]
