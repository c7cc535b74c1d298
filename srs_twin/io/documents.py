"""YAML documents with positions: every value remembers its line and column, every problem names them.

YAML 1.2 (core schema): ``yes`` is text, ``012`` is twelve. The file is parsed once, event by event, so that
bounds hold before anything is built; anchors, aliases, tags, directives, merge keys and several documents
are refused. (ruamel's round-trip loader fails with internal errors on some misplaced comments, and its
safe loader keeps no positions.)
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from operator import itemgetter
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML, events
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.representer import SafeRepresenter

from srs_twin.errors import InputError, InputFileError
from srs_twin.io.files import MAX_BYTES, printable, read_text, shown

Loc = tuple[str | int, ...]
Position = tuple[int, int]

MAX_DEPTH = 16
MAX_NODES = 10_000

_UNUSUAL = re.compile("[^\x20-\x7e\xa1-\u1fff\u2030-\ud7ff\ue000-\ufefe\U00010000-\U0010ffff]")

_CORE: tuple[tuple[re.Pattern[str], Callable[[str], Any]], ...] = (
    (re.compile(r"~|null|Null|NULL|"), lambda text: None),
    (re.compile(r"true|True|TRUE"), lambda text: True),
    (re.compile(r"false|False|FALSE"), lambda text: False),
    # Python refuses to read integers of thousands of digits; as floats they become infinite and are refused.
    (re.compile(r"[-+]?[0-9]{1,300}"), int),
    (re.compile(r"0o[0-7]{1,300}"), lambda text: int(text[2:], 8)),
    (re.compile(r"0x[0-9a-fA-F]{1,300}"), lambda text: int(text[2:], 16)),
    (re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"), float),
    (re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"), lambda text: float(text.replace(".", ""))),
)


@dataclass(frozen=True)
class Change:
    """A value that stands in no file.

    Attributes:
        words: who set it, as messages show it: "--set controller.frequency_hz=1.5".
        loc: path of the field.
        value: plain data.
    """

    words: str
    loc: Loc
    value: Any

    @classmethod
    def of(cls, words: str, field: str, value: str) -> Change:
        """Return what a dotted field and a value in YAML say.

        Raises:
            InputFileError: the value is no YAML.
            InputError: there is no field.
        """
        if not (loc := path_of(field)):
            raise InputError(f"{words}: must be FIELD=VALUE, as in controller.frequency_hz=1.5")
        return cls(words, loc, parse_yaml(value, words).data)


@dataclass
class Document:
    """Plain data of one file, where each piece stands, and what is wrong with it.

    Attributes:
        name: the file as messages show it.
        data: plain dicts, lists, text, numbers, true, false, None.
        values: path of a value → line and column (from 1) where it begins; empty for data made in memory.
        keys: path of a value → line and column of its key.
        problems: position and message of everything found so far.
        refused: positions at which the YAML itself was refused; what follows from that is not reported.
        changes: words of what was set besides the file; the position of what the k-th set is (−k, 0).
    """

    name: str
    data: Any = None
    values: dict[Loc, Position] = field(default_factory=dict)
    keys: dict[Loc, Position] = field(default_factory=dict)
    problems: list[tuple[Position, str]] = field(default_factory=list)
    refused: set[Position] = field(default_factory=set)
    changes: list[str] = field(default_factory=list)

    def change(self, change: Change) -> None:
        """Put a value in the place of the file's; what a name stands for there becomes its `base`."""
        self.changes.append(change.words)
        here = (-len(self.changes), 0)
        self.data = self.data if isinstance(self.data, dict) else {}
        data: Any = self.data
        for k, part in enumerate(change.loc):
            place = change.loc[: k + 1]
            if isinstance(data, list) and not has_child(data, part):
                self.problems.append((here, f"{dotted(place)}: there are {len(data)} entries, from 0"))
                return
            if not has_child(data, part):
                self.keys[place] = self.values[place] = here
            if place == change.loc:
                break
            below = child(data, part)
            if isinstance(below, str):
                below = {"base": below}
            data[part] = data = below if isinstance(below, dict | list) else {}
        data[part] = change.value
        self._placed(change.loc, change.value, here)

    def _placed(self, loc: Loc, value: Any, here: Position) -> None:
        self.keys[loc] = self.values[loc] = here
        if isinstance(value, dict | list):
            for part in value if isinstance(value, dict) else range(len(value)):
                self._placed((*loc, part), value[part], here)

    def setter(self, loc: Loc) -> str:
        """Say who set a value: "set by --set …", or "set in" this file."""
        line = self.values.get(loc, (0, 0))[0]
        return f"set by {self.changes[-line - 1]}" if line < 0 else f"set in {self.name}"

    def get(self, *loc: str | int) -> Any:
        """Return the value at a path, or None where there is none."""
        value = self.data
        for part in loc:
            value = child(value, part)
        return value

    def known(self, loc: Loc) -> Loc:
        """Return the part of a path, from its beginning, that the data have."""
        value = self.data
        for i, part in enumerate(loc):
            if not has_child(value, part):
                return loc[:i]
            value = child(value, part)
        return loc

    def visible(self, prefix: Loc, loc: Loc) -> Loc:
        """Return a path as a person sees it in a file that leaves parts of it to another.

        A robot's override is checked merged into its base: what is wrong with ``stiffness.value`` is there
        wrong with ``stiffness``. What stands wholly in the base keeps its path.
        """
        known = self.known(prefix + loc)
        return known if len(known) > len(prefix) + 1 or known == prefix + loc else prefix + loc

    def report(self, loc: Loc, message: str, *, at_key: bool = False) -> None:
        """Note a problem with the value (or key) at a path; what is not in the file points to its parent."""
        known = self.known(loc)
        position = (self.keys if at_key and known == loc else self.values).get(known, (0, 0))
        if position not in self.refused:
            self.problems.append((position, f"{dotted(loc)}: {message}" if loc else message))

    @contextmanager
    def reporting(self, *loc: str | int) -> Iterator[None]:
        """Note an `InputError` of a block as a problem with the value at a path."""
        try:
            yield
        except InputError as error:
            self.report(loc, str(error))

    def finish(self, foreign: Iterable[str] = ()) -> None:
        """Raise one error with all problems, in the order of the file.

        Args:
            foreign: messages about other files, put first.

        Raises:
            InputFileError: there is at least one problem.
        """
        lines = list(foreign)
        # Of a value that may be one of several things, each of them says the same.
        for (line, column), message in sorted(dict.fromkeys(self.problems), key=itemgetter(0)):
            place = f"{self.name}:{line}:{column}" if line > 0 else self.name
            lines.append(f"{self.changes[-line - 1] if line < 0 else place}: {message}")
        if lines:
            raise InputFileError(lines)


def load_yaml(path: Path, *, limit: int = MAX_BYTES) -> Document:
    """Read and parse a YAML file; see `parse_yaml`.

    Args:
        path: of the file.
        limit: Largest size that is read, bytes.

    Raises:
        InputError: the file cannot be read.
        InputFileError: it is no YAML at all.
    """
    return parse_yaml(read_text(path, limit=limit), shown(path))


def parse_yaml(text: str, name: str) -> Document:
    """Parse YAML text into a document, whose `problems` hold what is refused but does not stop the parser.

    Args:
        text: the file's text.
        name: the file's name for messages.

    Raises:
        InputFileError: a syntax error, nesting or size beyond the bounds, a second document.
    """
    reader = _Reader(YAML(typ="safe", pure=True).parse(text), Document(name))
    try:
        reader.read()
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        problem = ": ".join(filter(None, (error.context, error.problem)))
        if "'\\t'" in problem:
            problem += "; YAML is indented with spaces, not tabs"
        reader.fail(_position(mark) if mark else (0, 0), f"not YAML: {problem}")
    except ReaderError as error:
        before = text[: error.position]
        line, column = before.count("\n") + 1, error.position - before.rfind("\n")
        reader.fail((line, column), f"not YAML: unusable character U+{ord(text[error.position]):04X}")
    except (YAMLError, ValueError, OverflowError) as error:
        # ValueError and OverflowError: an escape such as "\\UFFFFFFFF" that is no character.
        reader.fail(reader.last, f"not YAML: {error}")
    return reader.document


def dump_yaml(data: Any, *, compact: bool = False) -> str:
    """Return plain data as YAML text that `parse_yaml` reads back as equal data.

    Args:
        data: dicts, lists, text, numbers, true, false, None.
        compact: write lists and dicts that hold numbers alone in one line, as people do.
    """
    yaml = YAML(typ="safe", pure=True)
    yaml.Representer = _CompactRepresenter if compact else _Representer
    yaml.default_flow_style = False
    yaml.allow_unicode = True
    yaml.width = 150 if compact else 110  # a row stays a row
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    stream = io.StringIO()
    yaml.dump(data, stream)
    return stream.getvalue()


def dotted(loc: Loc) -> str:
    """Return a path as people read it: ``expect[1].metric``."""
    text = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc)
    return text.removeprefix(".")


def path_of(name: str) -> Loc:
    """Return the path that a dotted field means: ``world.obstacles[0].x_m``."""
    return tuple(int(text) if text.isdigit() else text for text in re.split(r"[.\[\]]+", name) if text)


def has_child(value: Any, part: str | int) -> bool:
    """Say whether a dict has this key or a list this index."""
    if isinstance(value, Mapping):
        return part in value
    return isinstance(value, list) and isinstance(part, int) and 0 <= part < len(value)


def child(value: Any, part: str | int) -> Any:
    """Return an entry of a dict or list, None where there is none."""
    return value[part] if has_child(value, part) else None


def _position(mark: Any) -> Position:
    return mark.line + 1, mark.column + 1


class _Reader:
    """Reads a document from ruamel's parse events by recursive descent, within bounds."""

    def __init__(self, parsed: Iterator[Any], document: Document) -> None:
        self.document = document
        self.last: Position = (1, 1)
        self._events = parsed
        self._nodes = 0

    def fail(self, position: Position, message: str) -> None:
        """Stop with this problem and those found before."""
        self.document.problems.append((position, message))
        self.document.finish()

    def read(self) -> None:
        """Read the stream, which may hold one document."""
        documents = 0
        while not isinstance(event := self._next(), events.StreamEndEvent):
            if isinstance(event, events.DocumentStartEvent):
                documents += 1
                if documents > 1:
                    self.fail(self.last, "a second document begins here; one file holds one")
                if event.version or event.tags:
                    self._refuse("YAML directives are not allowed; remove the line that begins with %")
            elif isinstance(event, events.NodeEvent):
                self.document.data = self._value(event, ())

    def _next(self) -> Any:
        event = next(self._events)
        self.last = _position(event.start_mark)
        return event

    def _value(self, event: Any, loc: Loc) -> Any:
        """Return the value at a path, which begins with an event; note where it stands."""
        self._check(event)
        scalar = isinstance(event, events.ScalarEvent)
        if scalar and event.implicit[0] and not event.value and loc in self.document.keys:
            # Nothing after the colon: the parser's mark is in the next line, the key's is of more use.
            self.last = self.document.keys[loc]
        self.document.values[loc] = self.last
        if scalar:
            # A value may have several lines; anything else that a terminal would obey is no text.
            text = self._text(event, keep="\n\t")
            return _plain(text) if event.implicit[0] else text
        if isinstance(event, events.AliasEvent):
            return None
        if len(loc) >= MAX_DEPTH:
            self.fail(self.last, f"nested more than {MAX_DEPTH} deep")
        if isinstance(event, events.MappingStartEvent):
            return self._mapping(loc)
        values: list[Any] = []
        while not isinstance(event := self._next(), events.CollectionEndEvent):
            values.append(self._value(event, (*loc, len(values))))
        return values

    def _mapping(self, loc: Loc) -> dict[str, Any]:
        found: dict[str, Any] = {}
        while not isinstance(event := self._next(), events.CollectionEndEvent):
            self._check(event)
            if not isinstance(event, events.ScalarEvent):
                self.fail(self.last, "a key must be plain text")
            key = self._text(event, keep="")
            place = (*loc, key)
            if key == "<<" and event.implicit[0]:
                self._refuse("merge keys (<<) are not allowed; write the keys out")
            elif key in found:
                line = self.document.keys[place][0]
                self._refuse(f"{dotted(place)}: given twice; the first is in line {line}")
            self.document.keys[place] = self.last
            found[key] = self._value(self._next(), place)
        return found

    def _check(self, event: Any) -> None:
        """Count a node; refuse what it must not have."""
        self._nodes += 1
        if self._nodes > MAX_NODES:
            self.fail(self.last, f"more than {MAX_NODES} keys and values")
        if isinstance(event, events.AliasEvent):
            self._refuse(f"aliases (*{event.anchor}) are not allowed; write the value out")
            return
        if event.anchor is not None:
            self._refuse(f"anchors (&{event.anchor}) are not allowed; write each value out")
        if event.tag is not None:
            self._refuse(f"tags ({event.tag}) are not allowed; write the plain value")

    def _text(self, event: Any, *, keep: str) -> str:
        text = printable(event.value, keep=keep)
        if text != event.value:
            bad = event.value[len(os.path.commonprefix([text, event.value]))]
            surrogate = "\ud800" <= bad <= "\udfff"
            what = "half a surrogate pair" if surrogate else f"the control character {printable(bad)}"
            self._refuse(f"{what} is no character of a text")
        return text

    def _refuse(self, message: str) -> None:
        self.document.problems.append((self.last, message))
        self.document.refused.add(self.last)


class _Representer(SafeRepresenter):
    """Writes text with unusual characters in quotes, escaped: U+0085 would come back as a blank."""


def _text(representer: SafeRepresenter, text: str) -> Any:
    style = '"' if _UNUSUAL.search(text) else None
    return representer.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Representer.add_representer(str, _text)


class _CompactRepresenter(_Representer):
    """Writes lists and dicts of numbers alone as rows."""

    def represent_sequence(self, tag: Any, sequence: Any, flow_style: Any = None) -> Any:
        """See ruamel."""
        return super().represent_sequence(tag, sequence, _is_row(sequence))

    def represent_mapping(self, tag: Any, mapping: Any, flow_style: Any = None) -> Any:
        """See ruamel."""
        return super().represent_mapping(tag, mapping, _is_row(mapping.values()))


def _is_row(values: Collection[Any]) -> bool:
    return bool(values) and all(isinstance(value, int | float) for value in values)


def _plain(text: str) -> Any:
    """Return what unquoted text means in YAML 1.2's core schema."""
    for pattern, convert in _CORE:
        if pattern.fullmatch(text):
            return convert(text)
    return text
