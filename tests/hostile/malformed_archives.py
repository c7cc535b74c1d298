"""NumPy archives that `numpy.load` reads or fails at, and that `read_arrays` and its callers must reject."""

from __future__ import annotations

import io
import json
import zipfile
from typing import Any

import numpy as np
from harness import Malformed
from hypothesis import strategies as st

from srs_twin.io.saved_state import VERSION


def archive(arrays: dict[str, Any], packed: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return an archive of arrays; bytes are written as they are."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", packed) as file:
        for name, array in arrays.items():
            member = array
            if not isinstance(array, bytes):
                content = io.BytesIO()
                np.save(content, array, allow_pickle=True)
                member = content.getvalue()
            file.writestr(f"{name}.npy", member)
    return stream.getvalue()


def npy(header: str, data: bytes = b"") -> bytes:
    """Return a .npy file of version 1.0 with a header and data."""
    return (
        b"\x93NUMPY\x01\x00"
        + len(header).to_bytes(2, "little")
        + header.encode()
        + data
    )


def declared(shape: str, kind: str) -> bytes:
    """Return a .npy file that declares a shape and a type, and has eight bytes of data."""
    return npy(
        f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}}}\n", bytes(8)
    )


def with_wrong_crc(good: bytes) -> bytes:
    """Return an archive whose first directory entry has another checksum."""
    place = good.index(b"PK\x01\x02") + 16
    return good[:place] + bytes(4) + good[place + 4 :]


def encrypted(good: bytes) -> bytes:
    """Return an archive whose entries are marked as encrypted."""
    place = good.index(b"PK\x01\x02") + 8
    return good[:place] + b"\x01" + good[place + 1 :]


def damaged(good: dict[str, Any], name: str) -> tuple[Malformed, ...]:
    """Return archives that no reader may accept.

    Args:
        good: arrays of a valid file.
        name: name of the array to replace.
    """
    raw = archive(good)

    def replaced(array: Any) -> bytes:
        return archive(good | {name: array})

    sizes = {
        "3 GB in a header": "(402653184,)",
        "2**62 numbers in a header": "(4611686018427387904,)",
        "a negative size": "(-1,)",
        "a shape of a billion zeros": "(0, 1000000000, 5)",
    }
    return (
        *(
            Malformed(what, replaced(declared(shape, "<f8")), "an array of shape")
            for what, shape in sizes.items()
        ),
        Malformed(
            "a billion empty texts",
            replaced(declared("(1000000000,)", "<U0")),
            "an array of shape",
        ),
        Malformed("300 MB", replaced(np.zeros(300 << 17)), "bytes, but at most"),
        Malformed(
            "nested signs in a header",
            replaced(npy("-" * 9000 + "1")),
            "the header of an array is damaged",
        ),
        Malformed("cut header", replaced(npy("{'descr'")), ""),
        Malformed("array of objects", replaced(np.array([{}], dtype=object)), ""),
        Malformed("array without a header", replaced(b"1.0"), ""),
        Malformed("array of bytes", replaced(b""), ""),
        Malformed("archive cut off", raw[:-30], "not a zip file"),
        Malformed("wrong checksum", with_wrong_crc(raw), "Bad CRC-32"),
        Malformed("encrypted archive", encrypted(raw), "encrypted"),
        Malformed(
            "archive packed with bz2",
            archive(good, zipfile.ZIP_BZIP2),
            "the archive is compressed with a method that NumPy does not use; write"
            " the file again with NumPy",
        ),
        Malformed(
            "archive packed with LZMA",
            archive(good, zipfile.ZIP_LZMA),
            "the archive is compressed with a method that NumPy does not use; write"
            " the file again with NumPy",
        ),
        Malformed("archive of nothing", archive({}), ""),
        Malformed("other arrays", archive({"a": np.zeros(3)}), ""),
    )


_ARRAYS = st.sampled_from(
    [
        np.zeros(2),
        np.zeros((2, 2)),
        np.zeros((3, 2)),
        np.array(1.0),
        np.array("GoTo"),
        np.array(["x_m", "y_m"]),
        np.full(2, np.nan),
        np.array([1, 2]),
        np.zeros((0, 2)),
        np.zeros(2, complex),
        np.array([], dtype="U1"),
        b"x",
    ]
)

POLICY = {
    "task": np.array("GoTo"),
    "observations": np.array(["x_m", "y_m"]),
    "weights_0": np.ones((3, 2), np.float32),
    "biases_0": np.ones(3, np.float32),
}


def _policy(message: str, **changed: Any) -> Malformed:
    return Malformed(
        " ".join(f"{changed}: {message}".split()), archive(POLICY | changed), message
    )


_NO_FIT = "the shapes of its layers do not match"
POLICY_MALFORMED = damaged(POLICY, "biases_0") + (
    _policy("no vector of numbers 'biases_0'", biases_0=np.array(1.0)),
    _policy("no vector of numbers 'biases_0'", biases_0=np.ones((3, 7))),
    _policy("no vector of numbers 'biases_0'", biases_0=np.array(["1", "2", "3"])),
    _policy("no matrix of numbers 'weights_0'", weights_0=np.ones((3, 2), complex)),
    _policy("no matrix of numbers 'weights_1'", weights_2=np.ones((3, 3))),
    _policy("no list of texts 'observations'", observations=np.array("x_m")),
    _policy("no list of texts 'observations'", observations=np.array([1.0, 2.0])),
    _policy("no text 'task'", task=np.array(["GoTo"])),
    _policy("no text 'task'", task=np.array(b"GoTo")),
    _policy(_NO_FIT, biases_0=np.array([0.0, np.nan, 0.0])),
    _policy(_NO_FIT, weights_0=np.full((3, 2), np.inf)),
    _policy(_NO_FIT, weights_0=np.ones((3, 4))),
    _policy(_NO_FIT, observations=np.array([], dtype="U1"), weights_0=np.ones((3, 2))),
)
POLICY_VALUES = st.fixed_dictionaries(
    {name: st.just(array) | _ARRAYS for name, array in POLICY.items()}
).map(archive)

_DOCUMENT = {
    "version": VERSION,
    "of": {},
    "content": {"@": "dict", "items": [["a", {"@": "array", "name": "array_0"}]]},
}
STATE = {"state": np.array(json.dumps(_DOCUMENT)), "array_0": np.ones(3)}


def _state(name: str, message: str = "not a saved state", **changed: Any) -> Malformed:
    return Malformed(
        name,
        archive(STATE | {"state": np.array(json.dumps(_DOCUMENT | changed))}),
        message,
    )


STATE_MALFORMED = damaged(STATE, "array_0") + (
    _state("settings in a list", of=[]),
    _state("settings as a number", of=3),
    _state("content as a number", content=3.0),
    _state("content in a list", content={"@": "list", "items": []}),
    _state(
        "unknown array",
        content={"@": "dict", "items": [["a", {"@": "array", "name": "b"}]]},
    ),
    _state("a class of another package", content={"@": "os:system", "items": ["true"]}),
    Malformed(
        "a number as document",
        archive(STATE | {"state": np.array(3.0)}),
        "not a saved state",
    ),
    Malformed(
        "a list as document",
        archive(STATE | {"state": np.array("[]")}),
        "not a saved state",
    ),
    Malformed(
        "a document of 20 MB",
        archive(STATE | {"state": np.array("[" * (20 << 20))}),
        "characters, but at most",
    ),
    Malformed(
        "deeply nested document",
        archive(STATE | {"state": np.array("[" * 100_000)}),
        "not a saved state",
    ),
)
_JSON = st.recursive(
    st.none()
    | st.integers()
    | st.floats()
    | st.text(max_size=4)
    | st.just({"@": "array", "name": "array_0"}),
    lambda inner: st.fixed_dictionaries(
        {
            "@": st.sampled_from(["dict", "list", "tuple", "array", "os:x"]),
            "items": st.lists(inner, max_size=2),
        }
    ),
    max_leaves=6,
)
STATE_VALUES = st.fixed_dictionaries(
    {"version": st.just(VERSION) | _JSON, "of": st.just({}) | _JSON, "content": _JSON}
).map(lambda data: archive(STATE | {"state": np.array(json.dumps(data))}))
