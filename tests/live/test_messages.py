"""Messages decode as they were sent; all other input is refused with a reason."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from srs_twin.live.messages import (
    BENDS,
    COMMAND,
    CONTROL,
    KINDS,
    LARGEST_BYTES,
    PRESSURES,
    STATUS,
    SUPPLY,
    VALVES,
    WORDS,
    BadMessageError,
    decode,
    encode,
)

SEGMENTS = 4


def back(kind, values, time=1.5):
    return decode(
        kind, encode(kind, time, values), source="gen4", arrived=2.0, segments=SEGMENTS
    )


@pytest.mark.parametrize("kind", [COMMAND, VALVES, PRESSURES])
def test_two_lists_come_back(kind):
    rng = np.random.default_rng(1)
    values = rng.integers(-1, 2, (SEGMENTS, 2)) * (
        1.0 if kind != PRESSURES else 12_345.0
    )
    found = back(kind, values)
    assert found.values == pytest.approx(values)
    assert (found.kind, found.source, found.sent, found.arrived) == (
        kind,
        "gen4",
        1.5,
        2.0,
    )


def test_units_and_names_of_keys_are_the_fixed_ones():
    said = json.loads(encode(PRESSURES, 0.25, np.array([[20e3, 0.0]])))
    assert said == {"t": 0.25, "plus": [20], "minus": [0]}
    assert json.loads(encode(COMMAND, 1.0, np.array([[1, -1]]))) == {
        "t": 1.0,
        "plus": [1],
        "minus": [-1],
    }
    assert json.loads(encode(BENDS, 1.0, np.array([0.5, math.nan]))) == {
        "t": 1.0,
        "rad": [0.5, None],
    }


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_every_message_is_strict_json(kind, wrong):
    values = {
        SUPPLY: np.array(wrong),
        BENDS: np.full(2, wrong),
        STATUS: "fine",
        CONTROL: "stop",
    }
    payload = encode(kind, wrong, values.get(kind, np.full((2, 2), wrong)))
    assert json.loads(payload, parse_constant=pytest.fail)["t"] is None


def test_a_bend_that_nobody_read_is_none():
    found = back(BENDS, np.array([0.1, math.nan, -0.2, 0.0]))
    assert np.array_equal(found.values, [0.1, math.nan, -0.2, 0.0], equal_nan=True)
    assert back(STATUS, "fine").names == ("fine",)


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        (b"", "not JSON"),
        (b"[1]", "must be a JSON object, not list"),
        (b"{}", "`t` must be a number"),
        (b'{"t": true}', "`t` must be a number"),
        (b'{"t": 1e400}', "`t` must be a number"),
        (b'{"t": 1, "plus": [1, 1, 1, 1]}', "`minus` must be a list of 4 numbers"),
        (b'{"t": 1, "plus": [1], "minus": [1]}', "`plus` must be a list of 4"),
        (
            b'{"t": 1, "plus": "1111", "minus": [1, 1, 1, 1]}',
            "`plus` must be a list of 4",
        ),
        (
            b'{"t": 1, "plus": [null, 0, 0, 0], "minus": [0, 0, 0, 0]}',
            "`plus` must be a number between -1 and 1",
        ),
        (b"[" * 100_000, "more than 65536 bytes"),
        (b"[" * 60_000, "not JSON"),
    ],
)
def test_what_is_no_command_is_refused(payload, why):
    with pytest.raises(BadMessageError, match=why):
        decode(COMMAND, payload, source="x", arrived=0.0, segments=SEGMENTS)
    assert len(b"[" * 60_000) < LARGEST_BYTES


@pytest.mark.parametrize(
    ("kind", "low", "high"),
    [
        (COMMAND, -1, 1),
        (VALVES, -1, 1),
        (PRESSURES, -100, 1000),
        (BENDS, -2 * math.pi, 2 * math.pi),
    ],
)
def test_values_are_accepted_up_to_their_limits_in_every_place(kind, low, high):
    def document(values: list[float], time: float = 0.0) -> bytes:
        first = values[:SEGMENTS]
        lists = {"rad": first, "plus": first, "minus": values[SEGMENTS:]}
        return json.dumps({"t": time} | lists).encode()

    def read(payload: bytes) -> np.ndarray:
        return decode(kind, payload, source="x", arrived=0.0, segments=SEGMENTS).values

    unit = 1000.0 if kind == PRESSURES else 1.0  # kPa
    for limit in (low, high):
        assert (read(document([limit] * 2 * SEGMENTS, 9e9)) == unit * limit).all()
        for place in range(SEGMENTS if kind == BENDS else 2 * SEGMENTS):
            beyond = [0.0] * 2 * SEGMENTS
            beyond[place] = 1.001 * limit
            with pytest.raises(BadMessageError, match=f"between {low:g} and {high:g}"):
                read(document(beyond))
    with pytest.raises(BadMessageError, match="`t` must be a number"):
        read(document([0.0] * 2 * SEGMENTS, 9.001e9))


def test_supply_pressures_from_0_to_1000_kpa_are_read():
    for pressure in (0.0, 47.5e3, 1e6):
        message = back(SUPPLY, np.array(pressure))
        assert (message.values, message.sent) == (pressure, 1.5)
    for pressure in (-100.0, 1_000_100.0):
        with pytest.raises(BadMessageError, match="`kpa` .* between 0 and 1000"):
            back(SUPPLY, np.array(pressure))


@pytest.mark.parametrize("word", WORDS)
def test_a_control_is_json_or_the_plain_word(word):
    for payload in (word.encode(), encode(CONTROL, 1.0, word)):
        found = decode(CONTROL, payload, source="x", arrived=2.0, segments=SEGMENTS)
        assert (found.kind, found.names) == (CONTROL, (word,))
    for payload in (
        b"Stop",
        b'{"t": 1, "text": "halt"}',
        b'"stop"',
        b'{"text": "stop"}',
    ):
        with pytest.raises(BadMessageError):
            decode(CONTROL, payload, source="x", arrived=2.0, segments=SEGMENTS)
