"""YAML documents that store the line and column of every value for error messages.

Documents follow the core schema of YAML 1.2. A file is parsed event by event, so that
limits apply before the data are stored in memory. Anchors, aliases, tags, directives,
merge keys and files with several documents are rejected. PyYAML's own loaders are
unsuitable, because they provide no positions and read YAML 1.1.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import reduce
from operator import itemgetter, methodcaller
from pathlib import Path
from typing import Any

import yaml
from yaml.reader import ReaderError

from srs_twin.errors import (
    AbsentPartError,
    InputError,
    InputFileError,
    named_in_errors,
)
from srs_twin.io.files import (
    MAX_BYTES,
    display_path,
    escape_unprintable,
    is_path,
    place_of,
    read_text,
)

Loc = tuple[str | int, ...]
"""Path to a value in nested data, as a tuple of keys and list indices."""

Position = tuple[int, int]
"""Line and column of a key or value, counted from 1."""

MAX_DEPTH = 16
"""Maximum nesting depth of lists and mappings, which limits the recursion of the
parser."""

MAX_NODES = 10_000
"""Maximum number of keys and values in a document."""

# Control characters, unusual spaces, surrogates and byte order marks are escaped in
# written files.
_UNUSUAL = re.compile(
    "[^\x20-\x7e\xa1-\u1fff\u2030-\ud7ff\ue000-\ufefe\U00010000-\U0010ffff]"
)

_FIELD_NAME = re.compile(r"[^.\[\]]+(\.[^.\[\]]+|\[[0-9]+\])*")
_CORE_SCHEMA: tuple[tuple[re.Pattern[str], Callable[[str], object]], ...] = (
    (re.compile(r"~|null|Null|NULL|"), lambda text: None),
    (re.compile(r"true|True|TRUE"), lambda text: True),
    (re.compile(r"false|False|FALSE"), lambda text: False),
    # Longer integers are read as floats, and are rejected if they are infinite.
    (re.compile(r"[-+]?[0-9]{1,300}"), int),
    (re.compile(r"0o[0-7]{1,300}"), lambda text: int(text[2:], 8)),
    (re.compile(r"0x[0-9a-fA-F]{1,300}"), lambda text: int(text[2:], 16)),
    (re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"), float),
    (
        re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"),
        lambda text: float(text.replace(".", "")),
    ),
)


@dataclass(frozen=True)
class Override:
    """Value from the command line or a program that replaces a value from a file.

    Attributes:
        label: origin of the value, such as "--set controller.frequency_hz=1.5".
    """

    label: str
    loc: Loc
    value: object

    @classmethod
    def parse(cls, label: str, field: str, value: str) -> Override:
        """Return an override from a dotted field name and a YAML value."""
        if not field:
            raise InputError(
                f"{label}: must be FIELD=VALUE, as in controller.frequency_hz=1.5"
            )
        document = parse_yaml(value, label)
        document.raise_problems()
        return cls(label, _field_path(label, field), document.data)

    @classmethod
    def list_of(cls, changes: Overrides) -> Sequence[Override]:
        """Convert overrides to a sequence if they are given as a mapping."""
        if not isinstance(changes, Mapping):
            return changes
        overrides = []
        for name, value in changes.items():
            label = f"set {name}={value!r}"
            try:
                # NumPy arrays and scalars have the method `tolist`.
                text = json.dumps(value, default=methodcaller("tolist"))
            except (AttributeError, TypeError, ValueError) as error:
                raise InputError(
                    f"{label}: must consist of numbers, texts, lists and mappings"
                ) from error
            overrides.append(cls(label, _field_path(label, name), json.loads(text)))
        return overrides


def _field_path(label: str, name: str) -> Loc:
    with named_in_errors(label):
        return parse_path(name)


Overrides = Mapping[str, object] | Sequence[Override]
"""Sequence of overrides, or mapping from dotted field names to values."""


@dataclass
class Document:
    """Data of one file, with the positions of its values and the problems found so far.

    Attributes:
        values: line and column of each value in the file, keyed by path.
        keys: line and column of each key in the file, keyed by path.
        refused: positions at which no further problems are reported.
        override_labels: labels of the applied overrides. A value set by the k-th
            override has the position (−k, 0).
    """

    name: str
    data: Any = None
    values: dict[Loc, Position] = field(default_factory=dict)
    keys: dict[Loc, Position] = field(default_factory=dict)
    problems: list[tuple[Position, str]] = field(default_factory=list)
    refused: set[Position] = field(default_factory=set)
    override_labels: list[str] = field(default_factory=list)
    folder: Path | None = None
    warnings: list[str] = field(default_factory=list)

    def apply(self, override: Override) -> None:
        """Apply an override to the data.

        If the override sets a key below a file name, the file name is first moved to
        the key `base` of a new mapping.
        """
        self.override_labels.append(override.label)
        position = (-len(self.override_labels), 0)
        if not isinstance(self.data, dict):
            self.data = {}
        data: Any = self.data
        for k, key in enumerate(override.loc):
            loc = override.loc[: k + 1]
            if isinstance(data, list) and not has_child(data, key):
                message = (
                    f"{format_path(loc)}: this entry does not exist; the list has"
                    f" {len(data)} entries, counted from 0"
                )
                self.problems.append((position, message))
                return
            if not has_child(data, key):
                self.keys[loc] = self.values[loc] = position
            if loc == override.loc:
                break
            inner = child(data, key)
            if isinstance(inner, str):
                inner = {"base": inner}
            # A bare number is shorthand for a mapping with the key `value`.
            elif isinstance(inner, bool | int | float) and override.loc[k + 1 :] != (
                "value",
            ):
                text = (
                    f"{format_path(loc)}: must be a block of keys, not"
                    f" {json.dumps(inner)}"
                )
                self.problems.append((self.values[loc], text))
            if not isinstance(inner, dict | list):
                is_list = inner is None and isinstance(override.loc[k + 1], int)
                inner = [] if is_list else {}
            data[key] = data = inner
        data[key] = override.value
        self._set_positions(override.loc, override.value, position)

    def _set_positions(self, loc: Loc, value: object, position: Position) -> None:
        self.keys[loc] = self.values[loc] = position
        if isinstance(value, list):
            value = dict(enumerate(value))
        if isinstance(value, dict):
            for key, inner in value.items():
                self._set_positions((*loc, key), inner, position)

    def origin(self, loc: Loc) -> str:
        """Describe the origin of a value, as in "set by --set …"."""
        line = self.values.get(loc, (0, 0))[0]
        if line < 0:
            return f"set by {self.override_labels[-line - 1]}"
        return f"set in {self.name}"

    def get(self, *loc: str | int) -> Any:
        """Return the value at a path, or None if there is no such value."""
        return reduce(child, loc, self.data)

    def locate(self, loc: Loc, kind: str = "") -> None:
        """Resolve a file path in the data, or report that the file does not exist.

        Relative paths are resolved as in `place_of`. Paths from overrides or programs
        are relative to the current folder and remain unchanged.

        Args:
            loc: key path of the entry that contains the file path.
            kind: kind of shipped files whose names are also allowed, if any.
        """
        text = self.get(*loc)
        position = self.values.get(loc, (0, 0))
        if (
            self.folder is None
            or position <= (0, 0)
            or not isinstance(text, str)
            or not text
        ):
            return
        if kind and not is_path(text):
            return
        try:
            self.get(*loc[:-1])[loc[-1]] = place_of(text, self.folder, kind)
        except InputError as error:
            self.report(loc, str(error))
            self.refused.add(position)

    def existing_prefix(self, loc: Loc) -> Loc:
        """Return the longest prefix of a path that exists in the data."""
        value = self.data
        for i, key in enumerate(loc):
            if not has_child(value, key):
                return loc[:i]
            value = child(value, key)
        return loc

    def user_path(self, prefix: Loc, loc: Loc) -> Loc:
        """Return the path in the user's file that corresponds to a path in merged data.

        For example, an error in ``stiffness.value`` of a merged robot is an error in
        ``stiffness`` of the robot override.
        """
        existing = self.existing_prefix(prefix + loc)
        missing = (prefix + loc)[len(existing) :]
        if missing[:1] == ("value",):
            # A list may be written without the key `value`.
            existing = self.existing_prefix(existing + missing[1:])
        if len(existing) > len(prefix) + 1 or existing == prefix + loc:
            return existing
        return prefix + loc

    def report(self, loc: Loc, message: str, *, at_key: bool = False) -> None:
        """Add a problem with a value, or with its key if `at_key` is true.

        A missing value is reported at the position of its parent block.
        """
        existing = self.existing_prefix(loc)
        positions = self.values
        if at_key and existing == loc:
            positions = self.keys
        position = positions.get(existing, (0, 0))
        if loc:
            message = f"{format_path(loc)}: {message}"
        if position not in self.refused:
            self.problems.append((position, message))

    def describe(self, loc: Loc, message: str) -> str:
        """Return a message that begins with the position and path of a value."""
        position = self.values.get(self.existing_prefix(loc), (0, 0))
        return self._placed(position, f"{format_path(loc)}: {message}")

    def _placed(self, position: Position, message: str) -> str:
        line, column = position
        place = self.name
        if line > 0:
            place += f":{line}:{column}"
        elif line < 0:
            place = self.override_labels[-line - 1]
        return f"{place}: {message}"

    @contextmanager
    def report_errors(self, *loc: str | int) -> Iterator[None]:
        """Report an `InputError` from the `with` block as a problem with a value."""
        try:
            yield
        except AbsentPartError:
            pass  # other functions report missing and invalid plug-ins
        except InputError as error:
            self.report(loc, str(error))

    def raise_problems(self, other_files: Iterable[str] = ()) -> None:
        """Raise an `InputFileError` that lists all problems, if there are any.

        Args:
            other_files: messages about other files, which are listed first.
        """
        lines = list(other_files)
        # Several alternatives of a union may report the same problem, so duplicates
        # are dropped.
        for position, message in sorted(
            dict.fromkeys(self.problems), key=itemgetter(0)
        ):
            lines.append(self._placed(position, message))
        if lines:
            raise InputFileError(lines)


def load_yaml(path: Path, *, limit: int = MAX_BYTES) -> Document:
    """Read and parse a YAML file of at most `limit` bytes."""
    document = parse_yaml(read_text(path, limit=limit), display_path(path))
    document.folder = path.parent
    return document


def parse_yaml(text: str, name: str) -> Document:
    """Parse YAML text.

    Rejected features that do not stop the parser are added to `Document.problems`. The
    argument `name` is the name of the file in messages.
    """
    with suppress(yaml.YAMLError, ValueError):
        return _Reader(yaml.parse(text, yaml.CSafeLoader), Document(name)).read()
    # The C parser is eight times faster, but only the messages of the Python parser
    # include the unexpected text.
    reader = _Reader(yaml.parse(text, yaml.SafeLoader), Document(name))
    try:
        reader.read()
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        begin = error.context_mark
        context = error.context or ""
        if begin and begin.line < mark.line:
            context += f" that begins on line {begin.line + 1}"
        problem = ": ".join(filter(None, (context, error.problem)))
        if "'\\t'" in problem:
            problem += "; YAML is indented with spaces, not tabs"
        else:
            problem += _explain(
                error.problem or "", text.splitlines()[mark.line : mark.line + 1], mark
            )
        reader.fail(_position(mark) if mark else (0, 0), f"not YAML: {problem}")
    except ReaderError as error:
        before = text[: error.position]
        line = before.count("\n") + 1
        column = error.position - before.rfind("\n")
        reader.fail(
            (line, column),
            f"not YAML: the character U+{ord(text[error.position]):04X} is not allowed",
        )
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        # An invalid escape sequence such as "\\UFFFFFFFF" raises ValueError or
        # OverflowError.
        reader.fail(reader.last, f"not YAML: {error}")
    return reader.document


def _explain(problem: str, lines: list[str], mark: yaml.Mark) -> str:
    before = "".join(lines)[: mark.column]
    if "mapping values are not allowed" in problem and ": " in before:
        return "; a text that contains a colon and a space must be in quotes"
    if "mapping values" in problem or re.search(
        "<block end>, but found '(<block|-)", problem
    ):
        return (
            "; the indentation is wrong, because all keys of a block must begin in the"
            " same column"
        )
    if "expected ':'" in problem:
        return "; a key must be followed by a colon and a space"
    return ""


def dump_yaml(data: object, *, compact: bool = False) -> str:
    """Return plain data as YAML text that `parse_yaml` reads back unchanged.

    If `compact` is true, each list or dict of numbers is written on one line.
    """
    text: str = yaml.dump(
        data,
        Dumper=_CompactDumper if compact else _Dumper,
        default_flow_style=False,
        allow_unicode=True,
        width=150 if compact else 110,  # 150 columns are enough for a compact list
        sort_keys=False,
    )
    return text


def format_path(loc: Loc) -> str:
    """Convert a path to a dotted name, such as ``expect[1].metric``."""
    text = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in loc)
    return text.removeprefix(".")


def parse_path(name: str) -> Loc:
    """Convert a dotted name, such as ``world.obstacles[0].x_m``, to a path.

    Raises:
        InputError: the name is not valid.
    """
    # A program may give a name of another type, as in `set={1: 2}`.
    if not (isinstance(name, str) and _FIELD_NAME.fullmatch(name)):
        raise InputError(
            f"'{name}' is not a valid field name; write it as in world.obstacles[0].x_m"
        )
    return tuple(
        int(text) if re.fullmatch("[0-9]+", text) else text
        for text in re.split(r"[.\[\]]+", name)
        if text
    )


def has_child(value: object, key: str | int) -> bool:
    """Return whether a dict contains a key, or a list contains an index."""
    if isinstance(value, Mapping):
        return key in value
    return isinstance(value, list) and isinstance(key, int) and 0 <= key < len(value)


def child(value: Any, key: str | int) -> Any:
    """Return an entry of a dict or list, or None if there is no such entry."""
    if has_child(value, key):
        return value[key]
    return None


def _position(mark: yaml.Mark) -> Position:
    return mark.line + 1, mark.column + 1


class _Reader:
    def __init__(self, parsed: Iterator[yaml.Event], document: Document) -> None:
        self.document = document
        self.last: Position = (1, 1)
        self._events = parsed
        self._nodes = 0

    def fail(self, position: Position, message: str) -> None:
        self.document.problems.append((position, message))
        self.document.raise_problems()

    def read(self) -> Document:
        documents = 0
        while not isinstance(event := self._next(), yaml.StreamEndEvent):
            if isinstance(event, yaml.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    self.fail(
                        self.last,
                        "a second YAML document begins here, but a file may have only"
                        " one",
                    )
                if event.version or event.tags:
                    self._refuse(
                        "YAML directives are not allowed; remove the line that begins"
                        " with %"
                    )
            elif isinstance(event, yaml.NodeEvent):
                self.document.data = self._value(event, ())
        return self.document

    def _next(self) -> yaml.Event:
        event = next(self._events)
        self.last = _position(event.start_mark)
        return event

    def _value(self, event: yaml.Event, loc: Loc) -> object:
        self._check(event)
        scalar = isinstance(event, yaml.ScalarEvent)
        if scalar and event.implicit[0] and not event.value:
            # The position that the parser reports for an empty value may be on the next
            # line, so the position of the key is used.
            self.last = self.document.keys.get(loc, self.last)
        self.document.values[loc] = self.last
        if scalar:
            # A value may contain line breaks and tabs, but no other control characters,
            # because they could corrupt the terminal output.
            text = self._text(event, keep="\n\t")
            if event.implicit[0]:
                return resolve_scalar(text)
            return text
        if isinstance(event, yaml.AliasEvent):
            return None
        if len(loc) >= MAX_DEPTH:
            self.fail(
                self.last,
                f"the file is nested more than {MAX_DEPTH} levels deep; use fewer"
                " levels",
            )
        if isinstance(event, yaml.MappingStartEvent):
            return self._mapping(loc)
        values: list[object] = []
        while not isinstance(event := self._next(), yaml.CollectionEndEvent):
            values.append(self._value(event, (*loc, len(values))))
        return values

    def _mapping(self, loc: Loc) -> dict[str, object]:
        mapping: dict[str, object] = {}
        while not isinstance(event := self._next(), yaml.CollectionEndEvent):
            self._check(event)
            if not isinstance(event, yaml.ScalarEvent):
                self.fail(self.last, "a key must be plain text, not a list or a block")
            key = self._text(event, keep="")
            key_loc = (*loc, key)
            if key == "<<" and event.implicit[0]:
                self._refuse("merge keys (<<) are not allowed; write the keys out")
            elif key in mapping:
                line = self.document.keys[key_loc][0]
                self._refuse(
                    f"{format_path(key_loc)}: the key is given twice; the first one is"
                    f" on line {line}"
                )
            self.document.keys[key_loc] = self.last
            mapping[key] = self._value(self._next(), key_loc)
        return mapping

    def _check(self, event: yaml.Event) -> None:
        self._nodes += 1
        if self._nodes > MAX_NODES:
            self.fail(self.last, f"the file has more than {MAX_NODES} keys and values")
        if isinstance(event, yaml.AliasEvent):
            self._refuse(
                f"aliases (*{event.anchor}) are not allowed; write the value out"
            )
            return
        if event.anchor is not None:
            self._refuse(
                f"anchors (&{event.anchor}) are not allowed; write each value out"
            )
        if event.tag is not None:
            self._refuse(f"tags ({event.tag}) are not allowed; write the plain value")

    def _text(self, event: yaml.Event, *, keep: str) -> str:
        text = escape_unprintable(event.value, keep=keep)
        if text != event.value:
            bad = event.value[len(os.path.commonprefix([text, event.value]))]
            what = f"the control character {escape_unprintable(bad)}"
            if "\ud800" <= bad <= "\udfff":
                what = "half a surrogate pair"
            self._refuse(f"{what} is not allowed in text")
        return text

    def _refuse(self, message: str) -> None:
        self.document.problems.append((self.last, message))
        self.document.refused.add(self.last)


class _Dumper(yaml.CSafeDumper):  # type: ignore[misc]  # PyYAML has no types
    """YAML dumper that quotes and escapes unusual characters.

    Without quotes, a YAML reader would treat U+0085 as a space.
    """


def _represent_text(dumper: yaml.CSafeDumper, text: str) -> yaml.ScalarNode:
    if _UNUSUAL.search(text):
        style = '"'
    elif resolve_scalar(text) is not text:
        style = "'"
    else:
        style = None
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _represent_text)


class _CompactDumper(_Dumper):
    def represent_sequence(
        self, tag: str, sequence: Collection[object], flow_style: object = None
    ) -> yaml.Node:
        return super().represent_sequence(tag, sequence, _is_row(sequence))

    def represent_mapping(
        self, tag: str, mapping: Mapping[str, object], flow_style: object = None
    ) -> yaml.Node:
        return super().represent_mapping(tag, mapping, _is_row(mapping.values()))


def _is_row(values: Collection[object]) -> bool:
    return bool(values) and all(isinstance(value, int | float) for value in values)


def resolve_scalar(text: str) -> object:
    """Return the value of an unquoted YAML scalar."""
    for pattern, convert in _CORE_SCHEMA:
        if pattern.fullmatch(text):
            return convert(text)
    return text
