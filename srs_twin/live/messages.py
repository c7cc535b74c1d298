"""Messages of a robot and its controller as JSON over MQTT, and poses from motion capture.

Topics and keys are fixed (docs/live.md): ``srs/NAME/command``, ``valves``,
``pressures``, ``bends``, ``status``, ``control``, ``supply``, ``contact``. Lists start
at the head, ``t`` is the sender's clock. Messages of a spatial robot have one list per
chamber (``chamber_1``…) and also the bends upwards. Invalid messages are refused with a
reason and counted; only decoding raises an error.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

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
"""Kinds of messages that a link receives over MQTT."""
PAUSE = "pause"
GO = "go"
STOP = "stop"
VENT = "vent"
WORDS = (PAUSE, GO, STOP, VENT)
"""Texts of a `control` message."""
PREFIX = "srs"
"""Prefix of all topics."""
LATEST_S = 9e9
"""Largest accepted time of a sender's clock, s: the year 2255 in Unix time.

Journals store ns in 64 bits.
"""
_PA_PER_KPA = 1000.0
_BOUNDS = {
    COMMAND: (-1.0, 1.0),
    VALVES: (-1.0, 1.0),
    PRESSURES: (-100.0, 1000.0),
    SUPPLY: (0.0, 1000.0),
}
_BEND = 2 * math.pi
_SIDES = ("plus", "minus")
_BEND_KEYS = ("rad", "pitch_rad")
_PLAIN_WORDS = tuple(word.encode() for word in WORDS)
_LONGEST_TEXT = 1000


class BadMessageError(ValueError):
    """An invalid message, with the reason."""


@dataclass(frozen=True, eq=False)
class Message:
    """One message.

    Attributes:
        kind: one of `KINDS`, or `POSES`.
        source: sender whose clock `sent` is on: the robot of the topic, or a motion
            capture system.
        sent: sending time on the sender's clock, s.
        arrived: arrival time on our monotonic clock, s.
        values: commands and valves (segments, 2), or (segments, chambers) of a spatial
            robot; pressures the same, Pa; of the supply (), Pa; bends (segments,), or
            (segments, 2) to the left and upwards, rad, NaN where none; poses (bodies,
            4): x, y, z (m, z up) and heading (rad, NaN where unknown); else empty.
        names: names of the bodies; for `status` and `control` the text.
    """

    kind: str
    source: str
    sent: float
    arrived: float
    values: np.ndarray = field(default_factory=lambda: np.empty(0))
    names: tuple[str, ...] = ()


def topic(robot: str, kind: str) -> str:
    """Return the topic of a kind of message."""
    return f"{PREFIX}/{robot}/{kind}"


def encode(kind: str, time: float, values: np.ndarray | str) -> bytes:
    """Return the JSON of a message.

    Args:
        kind: one of `KINDS`.
        time: time on our clock, s.
        values: as in `Message`; for `status` and `control` the text.
    """
    content: dict[str, object]
    if isinstance(values, str):
        content = {"text": values}
    elif kind == BENDS:
        content = dict(
            zip(_BEND_KEYS, np.atleast_2d(np.asarray(values).T).tolist(), strict=False)
        )
    elif kind == SUPPLY:
        content = {"kpa": round(float(values) / _PA_PER_KPA, 6)}
    else:
        sides = np.asarray(values, dtype=float) / (
            _PA_PER_KPA if kind == PRESSURES else 1.0
        )
        keys = _chamber_keys(0 if sides.shape[1] == len(_SIDES) else sides.shape[1])
        content = dict(zip(keys, map(_plain, sides.T), strict=True))
    return strict_json({"t": time} | content)


def strict_json(document: Mapping[str, object]) -> bytes:
    """Return a document as JSON, which has null for every number that is not finite."""
    return to_json(document, inf_nan_mode="null")


def _chamber_keys(chambers: int) -> tuple[str, ...]:
    """Return the keys of the lists of a message by chamber; 0 chambers: those of a planar robot."""
    return tuple(f"chamber_{c}" for c in range(1, chambers + 1)) or _SIDES


def encode_contact(time: float, contact: ContactEstimate) -> bytes:
    """Return the JSON of a contact estimate at a time on our clock, s; null: no contact."""
    keys: dict[str, object] = {
        "t": time,
        "touched": contact.touched,
        "score": contact.score,
    }
    values = {"n": contact.force, "n_interval": contact.force_interval}
    values |= {"m": contact.place, "m_interval": contact.place_interval}
    return strict_json(keys | (values if contact.touched else dict.fromkeys(values)))


def _plain(values: np.ndarray) -> list[float]:
    return [
        int(value) if value.is_integer() else round(value, 6)
        for value in values.tolist()
    ]


def decode(
    kind: str,
    payload: bytes,
    *,
    source: str,
    arrived: float,
    segments: int,
    chambers: int = 0,
) -> Message:
    """Return the message in a payload.

    Args:
        kind: kind, from the topic.
        payload: received bytes.
        source: sender.
        arrived: arrival time on our clock, s.
        segments: number of segments of the robot.
        chambers: number of chambers per segment of a spatial robot; 0: the robot is
            planar.

    Raises:
        BadMessageError: the payload is invalid, or has another number of segments.
    """
    if kind not in KINDS:
        raise BadMessageError(f"no kind of message is called {kind!r}")
    if kind == CONTROL and payload in _PLAIN_WORDS:  # by hand, in a hurry
        return Message(kind, source, arrived, arrived, names=(payload.decode(),))
    if len(payload) > LARGEST_BYTES:
        raise BadMessageError(f"more bytes than the {LARGEST_BYTES} that are allowed")
    try:
        document = json.loads(payload)
    except (ValueError, RecursionError) as error:
        # Omit the position in the text: reasons are counted, so there must be few
        # different ones.
        if isinstance(error, json.JSONDecodeError):
            reason = error.msg
        else:
            reason = type(error).__name__
        raise BadMessageError(f"no JSON: {reason}") from None
    if not isinstance(document, Mapping):
        raise BadMessageError(f"a JSON object is needed, not {type(document).__name__}")
    sent = _number(document, "t", -LATEST_S, LATEST_S)
    if kind in (STATUS, CONTROL):
        text = document.get("text", "")
        if not isinstance(text, str) or len(text) > _LONGEST_TEXT:
            raise BadMessageError(f"text is needed, {_LONGEST_TEXT} characters at most")
        if kind == CONTROL and text not in WORDS:
            raise BadMessageError(f"a control is one of {', '.join(WORDS)}")
        return Message(kind, source, sent, arrived, names=(text,))
    if kind == BENDS:
        axes = [
            _numbers(document, key, segments, -_BEND, _BEND, gaps=True)
            for key in (_BEND_KEYS if chambers else _BEND_KEYS[:1])
        ]
        return Message(
            kind,
            source,
            sent,
            arrived,
            np.array(axes).T if chambers else np.array(axes[0]),
        )
    low, high = _BOUNDS[kind]
    if kind == SUPPLY:
        pressure = _PA_PER_KPA * _number(document, "kpa", low, high)
        return Message(kind, source, sent, arrived, np.array(pressure))
    sides = [
        _numbers(document, key, segments, low, high) for key in _chamber_keys(chambers)
    ]
    values = np.array(sides).T * (_PA_PER_KPA if kind == PRESSURES else 1.0)
    return Message(kind, source, sent, arrived, values)


def _number(document: Mapping[str, Any], key: str, low: float, high: float) -> float:
    given = document.get(key)
    if (
        isinstance(given, bool)
        or not isinstance(given, int | float)
        or not low <= given <= high
    ):
        raise BadMessageError(f"{key}: a number from {low:g} to {high:g} is needed")
    return float(given)


def _numbers(
    document: Mapping[str, Any],
    key: str,
    count: int,
    low: float,
    high: float,
    *,
    gaps: bool = False,
) -> list[float]:
    given = document.get(key)
    if not isinstance(given, Sequence) or isinstance(given, str) or len(given) != count:
        raise BadMessageError(
            f"{key}: a list of {count} numbers is needed, one a segment"
        )
    return [
        math.nan if gaps and value is None else _number({key: value}, key, low, high)
        for value in given
    ]
