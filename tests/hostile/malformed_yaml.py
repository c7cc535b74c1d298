"""YAML files that no parser may accept, and tools that derive files from a valid one."""

# ruff: noqa: E501 - one malformed file per line, as a table
from __future__ import annotations

import copy
import json
import re
from collections.abc import Iterable, Iterator
from typing import Any

from harness import Malformed
from hypothesis import strategies as st

from srs_twin.io.documents import Loc, child, has_child, parse_yaml

# Characters that look like other characters or are invisible.
CONFUSABLES = {
    "cyrillic o in robot": ("r\u043ebot", "unknown key"),
    "full-width colon": ("robot\uff1a gen2", ""),
    "zero-width space in a key": ("robo\u200bt", "unknown key"),
    "right-to-left override": ("\u202erobot", "unknown key"),
    "combining accent": ("robo\u0301t", "unknown key"),
}


def laughs() -> bytes:
    """Return ten levels of lists, each with nine aliases of the level before: a billion entries."""
    lines = ["a0: &a0 [lol]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 10)]
    return "\n".join(lines).encode()


STRUCTURE: tuple[Malformed, ...] = (
    Malformed("comment only", b"# nothing\n", ": must be a block of keys ("),
    Malformed("plain text", b"just text\n", ":1:1: must be a block of keys ("),
    Malformed("a list", b"- 1\n- 2\n", ":1:1: must be a block of keys ("),
    Malformed("no keys", b"{}", ": missing; it must be"),
    Malformed(
        "UTF-16 with its mark",
        "title: x\n".encode("utf-16"),
        ": the file is not UTF-8 text (byte 1 is 0xff)",
    ),
    Malformed(
        "UTF-16 without its mark",
        "title: x\n".encode("utf-16-le"),
        ":1:2: not YAML: the character U+0000",
    ),
    Malformed(
        "UTF-32, big end first",
        b"\0\0\xfe\xff" + "a: b".encode("utf-32-be"),
        ": the file is not UTF-8 text (byte 3 is 0xfe",
    ),
    Malformed("UTF-7", b"+AHQ-itle: x\n", ":1:1: +AHQ-itle: unknown key"),
    Malformed(
        "surrogate in UTF-8",
        b"title: \xed\xa0\x80\n",
        ": the file is not UTF-8 text (byte 8 is 0xed)",
    ),
    Malformed("unknown escape", b'title: "\\q"\n', ":1:10: not YAML:"),
    Malformed(
        "a byte order mark inside", "title: x\n\ufefftitle: y\n".encode(), ":2:1: "
    ),
    Malformed(
        "escape sequence of a terminal",
        b"title: \x1b[2J\n",
        ":1:8: not YAML: the character U+001B",
    ),
    Malformed(
        "not a character",
        "title: \ufffe\n".encode(),
        ":1:8: not YAML: the character U+FFFE",
    ),
    Malformed(
        "more than 64 kB", b"a: " + b"x" * 70_000, ": the file is larger than 64 kB"
    ),
    Malformed("64 kB of spaces", b" " * 65_000, ": must be a block of keys ("),
    Malformed("64 kB of quotes", b"title: " + b'"' * 65_000, ":1:"),
    Malformed("64 kB of escapes", b'title: "' + b"\\n" * 32_000, ":1:64009: not YAML:"),
    Malformed("60 kB key", b"x" * 60_000 + b": 1\n", ":1:60001: not YAML"),
    Malformed("60 kB scalar", b"title: " + b"x" * 60_000, ":1:8: title: "),
    Malformed(
        "unclosed brackets",
        b"a: " + b"[" * 60_000,
        ":1:19: the file is nested more than 16 levels deep",
    ),
    Malformed(
        "nested dashes",
        b"- " * 30_000,
        ":1:33: the file is nested more than 16 levels deep",
    ),
    Malformed("nested question marks", b"? " * 30_000, ":1:"),
    Malformed(
        "deep indentation",
        b"".join(b" " * k + b"a:\n" for k in range(300)),
        ":17:17: the file is nested more than 16",
    ),
    Malformed("a billion laughs", laughs(), ":1:5: anchors (&a0) are not allowed"),
    Malformed(
        "a list that contains itself",
        b"a: &a [*a]\n",
        ":1:4: anchors (&a) are not allowed",
    ),
    Malformed(
        "anchor on a key", b"&k title: x\n", ":1:1: anchors (&k) are not allowed"
    ),
    Malformed(
        "Python tag",
        b"title: !!python/object/apply:os.system [id]\n",
        ":1:8: tags (tag:yaml.org,2002:python/object/",
    ),
    Malformed("verbatim tag", b"title: !<x> 1\n", ":1:8: tags (x) are not allowed"),
    Malformed(
        "tag directive",
        b"%TAG ! tag:x,2000:\n---\ntitle: !a x\n",
        ":1:1: YAML directives are not allowed",
    ),
    Malformed("YAML 9.9", b"%YAML 9.9\n---\ntitle: x\n", ":1:1: not YAML"),
    Malformed("brace too many", b"title: x\nworld: {}}\n", ":2:10: not YAML:"),
    Malformed("bracket of the wrong kind", b"a: [1, 2}\n", ":1:9: not YAML:"),
    Malformed(
        "carriage returns as line ends",
        b"title: x\rtitle: y\r",
        ":2:1: title: the key is given twice",
    ),
    Malformed("on as key", b"on: x\n", ":1:1: on: unknown key"),
    Malformed("a number as key", b"1: x\n", ":1:1: 1: unknown key"),
    Malformed("empty key", b": x\n", ":1:1: "),
    Malformed("__class__", b"__class__: x\n", ":1:1: __class__: unknown key"),
    *(
        Malformed(name, f"{key}: x\n".encode(), message)
        for name, (key, message) in CONFUSABLES.items()
    ),
)

# Text in place of a number → its description in the message.
NOT_NUMBERS: dict[str, str] = {
    ".nan": "NaN",
    ".inf": "infinity",
    "1e999": "infinity",
    "9" * 5000: "infinity",
    "0x" + "f" * 300: "infinity",
    "1." + "0" * 3000 + "e400": "infinity",
    "NaN": "text 'NaN'",
    "0b1": "text '0b1'",
    "1_000": "text '1_000'",
    "1,5": "",
    "'2.0'": "text '2.0'; write the number without quotes",
    "true": "true",
    "yes": "text 'yes'",
    "~": "nothing",
    "": "nothing",
    "[2]": "a list of 1",
    "{a: 1}": "a block of keys",
    "2Hz": "text '2Hz'; write the number without its unit, which the key states",
    "1:30": "text '1:30'",
    "\u0662": "text '\u0662'",
    "2000-01-01": "text '2000-01-01'",
    "+-1": "text '+-1'",
    "1e": "text '1e'",
    "0o9": "text '0o9'",
    "-0x1": "text '-0x1'",
    "1e308": "infinity",
}


def not_numbers(good: bytes, key: str, loc: str) -> tuple[Malformed, ...]:
    """Return files with other text in place of a number.

    Args:
        good: a valid file.
        key: regular expression of the key, which occurs once with a plain number after
            it.
        loc: path of the key in messages.
    """
    text = good.decode()
    match = re.search(rf"\b{key}: ([-+.0-9e]+)", text)
    assert match, key
    line = text.count("\n", 0, match.start(1)) + 1
    return tuple(
        Malformed(
            f"{key}: {written[:20] or 'nothing'}",
            (text[: match.start(1)] + written + text[match.end(1) :]).encode(),
            f"{loc}: must be a " if description else f":{line}:",
        )
        for written, description in NOT_NUMBERS.items()
    )


def edited(good: bytes, edits: list[tuple[str, str, str]]) -> tuple[Malformed, ...]:
    """Return files with one edit each, from a table of old text, new text and part of the message."""
    text = good.decode()
    assert all(old in text for old, _, _ in edits)
    return tuple(
        Malformed(
            f"{old} → {new}",
            text.replace(old, new, 1).encode("utf-8", "surrogatepass"),
            message,
        )
        for old, new, message in edits
    )


def plain_data(text: bytes) -> dict[str, Any]:
    """Return the data of a valid YAML file."""
    data: dict[str, Any] = parse_yaml(text.decode(), "good").data
    return data


any_data = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=5,
)


def arbitrary_values(good: bytes, keys: Iterable[str]) -> st.SearchStrategy[bytes]:
    """Return a strategy for versions of a valid file with arbitrary values at any depth.

    Args:
        good: a valid file.
        keys: names of keys that may be added.
    """
    data = plain_data(good)
    paths = list(_paths(data))

    def build(changes: list[tuple[Loc, object]], extra: dict[str, object]) -> bytes:
        changed = copy.deepcopy(data)
        for path, value in changes:
            target: Any = changed
            for key in path[:-1]:
                target = child(target, key)
            if has_child(target, path[-1]):
                target[path[-1]] = value
        # JSON is YAML except for some numbers, and is written ten times as fast.
        text = json.dumps({**changed, **extra}, indent=1)
        return text.replace("NaN", ".nan").replace("Infinity", ".inf").encode()

    changes = st.lists(st.tuples(st.sampled_from(paths), any_data), max_size=3)
    extra = st.dictionaries(
        st.sampled_from(list(keys)) | st.text(max_size=8), any_data, max_size=2
    )
    return st.builds(build, changes, extra)


def _paths(value: object, path: Loc = ()) -> Iterator[Loc]:
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, inner in items:
        yield (*path, key)
        yield from _paths(inner, (*path, key))
