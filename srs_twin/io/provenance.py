"""Provenance of a result, which records everything that determines the result.

Two results belong to the same run if their provenances have equal keys.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field

_MAX_NAMED = 3
"""Maximum number of differences listed in a message."""

_MAX_VALUE_LENGTH = 60
"""Maximum total length of an old and a new value in a message, characters."""


@dataclass(frozen=True)
class Provenance:
    """Input, files, source code and package versions that determine a result.

    Attributes:
        content: complete input as JSON values, such as a scenario with all default
            values.
        files: SHA-256 of each file that the run reads, keyed by path.
        sources: SHA-256 of each source file that the run uses, keyed by module. Sources
            and versions are empty if only the input matters.
        versions: version of each package that affects the result, keyed by package.
    """

    content: dict[str, object]
    files: dict[str, str] = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Hexadecimal SHA-256 that identifies the result.

        File contents affect the key, but file names do not.
        """
        code = {"sources": self.sources, "versions": self.versions}
        data = self.content | {"files": list(self.files.values())}
        data |= {name: digests for name, digests in code.items() if digests}
        return hashlib.sha256(_text(data).encode()).hexdigest()

    @property
    def text(self) -> str:
        """Provenance as JSON text, as stored in files."""
        return json.dumps(asdict(self))

    def difference(self, before: Provenance) -> str:
        """Describe what changed since an earlier run, or return an empty string.

        >>> now = Provenance({"duration_s": 3}, versions={"mujoco": "3.17.0"})
        >>> now.difference(Provenance({"duration_s": 2}, versions={"mujoco": "3.16.0"}))
        'mujoco 3.17.0, was 3.16.0; duration_s 3, was 2'
        """
        changes = list(_changes(before.versions, self.versions))
        for old, new in ((before.sources, self.sources), (before.files, self.files)):
            names = [name for name in new | old if old.get(name) != new.get(name)]
            changes += [f"{name} changed" for name in names]
        changes += _changes(before.content, self.content)
        more = len(changes) - _MAX_NAMED
        if more > 0:
            changes[_MAX_NAMED:] = [f"and {more} more"]
        return "; ".join(changes)


def short_digest(*values: object) -> str:
    """Return the first 16 hexadecimal digits of a SHA-256 over the `repr` of values."""
    return hashlib.sha256(repr(values).encode()).hexdigest()[:16]


def _changes(before: object, now: object, path: str = "") -> Iterator[str]:
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for key in {**now, **before}:
            inner = f"{path}.{key}".lstrip(".")
            yield from _changes(before.get(key), now.get(key), inner)
        return
    old = _text(before)
    new = _text(now)
    if old == new or json.loads(old) == json.loads(new):  # 1 is equal to 1.0
        return
    if len(old + new) > _MAX_VALUE_LENGTH:
        yield f"{path} changed"
    else:
        yield f"{path} {new}, was {old}".replace('"', "")


def _text(value: object) -> str:
    return json.dumps(value, sort_keys=True)
