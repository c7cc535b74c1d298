"""Messages of a robot and its controller, encoded as JSON for MQTT.

The topics and keys are described in docs/live.md.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from pydantic_core import to_json

from srs_twin.live.contact_observer import ContactEstimate

LARGEST_BYTES = 65_536
COMMAND = "command"
VALVES = "valves"
PRESSURES = "pressures"
BENDS = "bends"
STATUS = "status"
CONTROL = "control"
POSES = "poses"
SUPPLY = "supply"
CONTACT = "contact"
KINDS = (COMMAND, VALVES, PRESSURES, BENDS, STATUS, CONTROL, SUPPLY)
"""Message kinds that can be received over MQTT."""
PAUSE = "pause"
GO = "go"
STOP = "stop"
VENT = "vent"
WORDS = (PAUSE, GO, STOP, VENT)
"""Control words that are allowed as texts of `control` messages."""
PREFIX = "srs"
LATEST_S = 9e9
"""Latest accepted time stamp, s (the year 2255 in Unix time).

Up to this limit, a time in nanoseconds fits into the 64-bit field of a journal entry.
"""
_SI = {PRESSURES: 1000.0, SUPPLY: 1000.0}
"""Factors that convert message values to SI units, keyed by message kind, Pa/kPa."""
_BOUNDS = {
    COMMAND: (-1.0, 1.0),
    VALVES: (-1.0, 1.0),
    PRESSURES: (-100.0, 1000.0),
    SUPPLY: (0.0, 1000.0),
    BENDS: (-2 * math.pi, 2 * math.pi),
}
"""Allowed range of the values in a message, keyed by message kind."""
_SIDES = ("plus", "minus")
_BEND_KEYS = ("rad", "pitch_rad")
_PLAIN_WORDS = tuple(word.encode() for word in WORDS)
_LONGEST_TEXT = 1000


class BadMessageError(ValueError):
    """Exception raised for an invalid message."""


@dataclass(frozen=True, eq=False)
class Message:
    """Message from a robot, its controller or a motion capture system.

    The values depend on the kind of the message:

    - Commands, valve states and pressures (Pa) have shape (segments, 2), or
      (segments, chambers) for a spatial robot.
    - The supply pressure (Pa) is a scalar.
    - Bends (rad) have shape (segments,). The bends of a spatial robot have shape
      (segments, 2), where the second axis contains leftward and upward bends. Missing
      bends are NaN.
    - Poses have shape (bodies, 4) and contain x, y, z (m) and heading (rad), where
      z points upwards. Unknown headings are NaN.
    - Messages of other kinds have no values.

    Attributes:
        kind: kind of the message, one of `KINDS` or `POSES`.
        source: name of the robot or the motion capture system that sent the message.
        sent: sending time on the sender's clock, s.
        arrived: time of arrival on the local monotonic clock, s.
        values: values of the message, as described above.
        names: names of the bodies in a `poses` message, or the single text of a
            `status` or `control` message.
    """

    kind: str
    source: str
    sent: float
    arrived: float
    values: np.ndarray = field(default_factory=lambda: np.empty(0))
    names: tuple[str, ...] = ()


def topic(robot: str, kind: str) -> str:
    """Return the MQTT topic for one message kind of a robot."""
    return f"{PREFIX}/{robot}/{kind}"


def encode(kind: str, time: float, values: np.ndarray | str) -> bytes:
    """Encode a message as JSON.

    Args:
        kind: kind of the message, one of `KINDS`.
        time: time stamp on the local clock, s.
        values: values as described in `Message`, or the text of a `status` or `control`
            message.
    """
    content: dict[str, object]
    if isinstance(values, str):
        content = {"text": values}
        return strict_json({"t": time} | content)
    numbers = np.asarray(values, dtype=float) / _SI.get(kind, 1.0)
    if kind == BENDS:
        axes = np.atleast_2d(numbers.T).tolist()
        content = dict(zip(_BEND_KEYS, axes, strict=False))
    elif kind == SUPPLY:
        content = {"kpa": round(float(numbers), 6)}
    else:
        chambers = numbers.shape[1]
        keys = _SIDES if chambers == len(_SIDES) else _chamber_keys(chambers)
        content = dict(zip(keys, map(_plain, numbers.T), strict=True))
    return strict_json({"t": time} | content)


def strict_json(document: Mapping[str, object]) -> bytes:
    """Encode a document as JSON, with null in place of NaN and infinity."""
    return to_json(document, inf_nan_mode="null")


def _chamber_keys(chambers: int) -> tuple[str, ...]:
    return tuple(f"chamber_{c}" for c in range(1, chambers + 1))


def encode_contact(time: float, contact: ContactEstimate) -> bytes:
    """Encode a contact estimate and its time stamp (s) as JSON.

    The force and position are null if no contact is detected.
    """
    keys: dict[str, object] = {
        "t": time,
        "touched": contact.touched,
        "score": contact.score,
    }
    values = {
        "n": contact.force,
        "n_interval": contact.force_interval,
        "m": contact.place,
        "m_interval": contact.place_interval,
    }
    if not contact.touched:
        values = dict.fromkeys(values)
    return strict_json(keys | values)


def _plain(values: np.ndarray) -> list[float]:
    return [
        int(value) if value.is_integer() else round(value, 6)
        for value in values.tolist()
    ]


def decode(
    kind: str,
    payload: bytes | bytearray,
    *,
    source: str,
    arrived: float,
    segments: int,
    chambers: int = 0,
) -> Message:
    """Decode a received message.

    Args:
        kind: kind of the message, as stated in its topic.
        payload: received bytes.
        source: name of the sender.
        arrived: time of arrival on the local clock, s.
        segments: number of segments of the robot.
        chambers: number of chambers per segment of a spatial robot, or 0 for a planar
            robot.

    Raises:
        BadMessageError: the kind or the payload is invalid, or the number of segments
            is wrong.
    """
    if kind not in KINDS:
        raise BadMessageError(f"{kind!r} is not a kind of message")
    if kind == CONTROL and payload in _PLAIN_WORDS:
        return Message(kind, source, arrived, arrived, names=(payload.decode(),))
    document = _document(payload)
    sent = _number(document.get("t"), "t", -LATEST_S, LATEST_S)
    if kind in (STATUS, CONTROL):
        return Message(kind, source, sent, arrived, names=(_text(document, kind),))
    if kind == SUPPLY:
        numbers = np.array(_number(document.get("kpa"), "kpa", *_BOUNDS[kind]))
    elif kind == BENDS and not chambers:
        numbers = np.array(_numbers(document, _BEND_KEYS[0], segments, kind))
    else:
        keys = _chamber_keys(chambers) or _SIDES
        if kind == BENDS:
            keys = _BEND_KEYS
        numbers = np.array([_numbers(document, key, segments, kind) for key in keys]).T
    values = np.asarray(numbers * _SI.get(kind, 1.0))
    return Message(kind, source, sent, arrived, values)


def _document(payload: bytes | bytearray) -> Mapping[str, object]:
    if len(payload) > LARGEST_BYTES:
        raise BadMessageError(f"the message has more than {LARGEST_BYTES} bytes")
    try:
        document = json.loads(payload)
    except (ValueError, RecursionError) as error:
        # The position of the error is omitted, so that errors of one type are counted
        # together.
        reason = getattr(error, "msg", type(error).__name__)
        raise BadMessageError(f"the message is not JSON: {reason}") from None
    if not isinstance(document, Mapping):
        raise BadMessageError(
            f"the message must be a JSON object, not {type(document).__name__}"
        )
    return document


def _text(document: Mapping[str, object], kind: str) -> str:
    text = document.get("text", "")
    if not isinstance(text, str) or len(text) > _LONGEST_TEXT:
        raise BadMessageError(
            f"`text` must be a string with at most {_LONGEST_TEXT} characters"
        )
    if kind == CONTROL and text not in WORDS:
        raise BadMessageError(
            f"`text` of a control message must be one of {', '.join(WORDS)}"
        )
    return text


def _number(given: object, key: str, low: float, high: float) -> float:
    is_number = isinstance(given, int | float) and not isinstance(given, bool)
    if not (is_number and low <= given <= high):  # type: ignore[operator]
        raise BadMessageError(f"`{key}` must be a number between {low:g} and {high:g}")
    return float(given)  # type: ignore[arg-type]


def _numbers(
    document: Mapping[str, object], key: str, count: int, kind: str
) -> list[float]:
    given = document.get(key)
    if not isinstance(given, list) or len(given) != count:
        raise BadMessageError(
            f"`{key}` must be a list of {count} numbers, one per segment"
        )
    return [
        math.nan
        if kind == BENDS and value is None
        else _number(value, key, *_BOUNDS[kind])
        for value in given
    ]
