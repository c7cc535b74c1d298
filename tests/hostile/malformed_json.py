"""JSON files that the standard library accepts or fails at, and that `read_json` must reject."""

from __future__ import annotations

import json

from harness import Malformed
from hypothesis import strategies as st

GOOD = b"""\
{
  "versions": {"srs_twin": "1"}, "scenario": "walk", "plants": {"twin": {"path_length_m": 0.5}},
  "comparison": {}, "expectations": []
}
"""


def _with(number: str) -> bytes:
    return GOOD.replace(b"0.5", number.encode())


MALFORMED = (
    Malformed("NaN", _with("NaN"), "NaN is not allowed in JSON"),
    Malformed("Infinity", _with("-Infinity"), "-Infinity is not allowed in JSON"),
    Malformed("a number beyond floats", _with("1e999"), "1e999 is out of range"),
    Malformed("an integer beyond floats", _with("9" * 400), "is out of range"),
    Malformed("an integer of 5000 digits", _with("9" * 5000), "is out of range"),
    Malformed(
        "100,000 lists deep",
        b"[" * 100_000 + b"]" * 100_000,
        "the JSON is nested more than 64 levels deep",
    ),
    Malformed(
        "100,000 lists deep, cut off",
        b"[" * 100_000,
        "the JSON is nested more than 64 levels deep",
    ),
    Malformed(
        "900 objects deep",
        b'{"a":' * 900 + b"1" + b"}" * 900,
        "the JSON is nested more than 64 levels deep",
    ),
    Malformed(
        "duplicate key",
        GOOD.replace(b'"comparison"', b'"plants"'),
        "the key 'plants' is given twice",
    ),
    Malformed("JSON cut off", GOOD[:60], ":2:"),
    Malformed("UTF-16", GOOD.decode().encode("utf-16"), "not UTF-8 text"),
    Malformed("two documents", GOOD + GOOD, "the file is not valid JSON: Extra data"),
)

_NUMBERS = st.integers(-(2**53), 2**53) | st.floats(
    allow_nan=False, allow_infinity=False
)
DATA = st.recursive(
    st.none() | st.booleans() | _NUMBERS | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=20,
)
VALUES = DATA.map(lambda data: json.dumps(data).encode())
