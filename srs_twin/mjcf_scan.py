"""What an MJCF file would make MuJoCo do, read before MuJoCo does it.

A hundred bytes of ``<replicate>`` keep MuJoCo's compiler busy for minutes, and its parser opens whatever
path a file names. So the XML is read here first, element by element: no document types (entities), bounded
depth, size and number of what it multiplies to, and paths that stay in the model's folder.
"""

from __future__ import annotations

import math
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn
from xml.parsers import expat

MAX_FILE_BYTES = 4 << 20
MAX_ASSET_BYTES = 32 << 20
MAX_DEPTH = 400
MAX_ELEMENTS = 10_000
MAX_BODIES = 1_000
MAX_CELLS = 1 << 24
"""Pixels of all textures and points of all height fields together."""

_SIZE_LIMITS = {"memory": 1 << 30, "nstack": 1 << 27, "njmax": 1 << 20, "nconmax": 1 << 20, "nkey": 10_000}
_OTHER_SIZE_LIMIT = 1_000
_FOLDERS = ("assetdir", "meshdir", "texturedir")
_UNITS = {"K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40, "P": 1 << 50, "E": 1 << 60}
_PNG = b"\x89PNG\r\n\x1a\n"


class _Refused(Exception):  # noqa: N818
    """Nothing further is to be read."""


@dataclass
class _Count:
    """What a file and all that it includes multiply to."""

    elements: int = 0
    bodies: int = 0
    cells: int = 0
    attached: int = 0


@dataclass
class _Scan:
    """What holds for all files of one model.

    Attributes:
        root: the model's own file.
        faults: found so far.
        folders: in which assets may be looked up.
        assets: where each path stands that is not itself MJCF, and the path.
        models: what each attachable model multiplies to; None while it is being read.
        seen: files that were included.
        bytes: size of all files together.
    """

    root: Path
    faults: list[str] = field(default_factory=list)
    folders: set[str] = field(default_factory=lambda: {"."})
    assets: list[tuple[str, str]] = field(default_factory=list)
    models: dict[Path, _Count | None] = field(default_factory=dict)
    seen: set[Path] = field(default_factory=set)
    bytes: int = 0

    @property
    def folder(self) -> Path:
        return self.root.parent


def scan_mjcf(path: Path) -> list[str]:
    """Return what is wrong with an MJCF file, and what it refers to, before anything is compiled.

    Args:
        path: the file, resolved; whatever it names has to lie in its folder.

    Returns:
        One line a fault, with the line of the file in which it stands.
    """
    scan = _Scan(path)
    try:
        _Reader(scan, path, _Count()).read()
        _check_assets(scan)
    except _Refused as fault:
        scan.faults.append(str(fault))
    return scan.faults


class _Reader:
    """Reads one file, element by element."""

    def __init__(self, scan: _Scan, path: Path, count: _Count) -> None:
        self._scan, self._path, self._count = scan, path, count
        self._times = [1]
        self._models: list[_Count] = []
        self._parser = expat.ParserCreate()
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._doctype

    def read(self) -> None:
        """Take the whole file.

        Raises:
            _Refused: it is no XML, or beyond a bound.
        """
        try:
            self._scan.bytes += self._path.stat().st_size
            if self._scan.bytes > MAX_FILE_BYTES:
                raise _Refused(f"over {MAX_FILE_BYTES >> 20} MB of XML")
            self._parser.Parse(self._path.read_bytes(), True)
        except expat.ExpatError as error:
            self._refuse(f"not readable as XML ({expat.ErrorString(error.code)})", error.lineno)
        except (OSError, LookupError, ValueError) as error:
            # LookupError, ValueError: an encoding that does not exist, or has no place in XML.
            self._refuse(f"not readable as XML ({error})")
        self._count.elements += self._count.attached * sum(model.elements for model in self._models)
        self._count.bodies += self._count.attached * sum(model.bodies for model in self._models)
        self._check_count()

    def _start(self, tag: str, attributes: Mapping[str, str]) -> None:
        times = self._times[-1]
        if tag in ("replicate", "composite", "flexcomp"):
            made = _product(attributes.get("count", "1"))
            self._count.bodies += times * made if tag != "replicate" else 0
            self._count.elements += times * made
            times *= made if tag == "replicate" else 1
        self._times.append(times)
        self._count.elements += times
        self._count.bodies += times if tag == "body" else 0
        self._count.attached += times if tag == "attach" else 0
        self._count.cells += _cells(attributes, "width", "height") + _cells(attributes, "nrow", "ncol")
        self._check_count()
        if len(self._times) > MAX_DEPTH:
            self._refuse(f"nested more than {MAX_DEPTH} deep")
        if tag == "size":
            self._check_sizes(attributes)
        for name, value in attributes.items():
            if name in _FOLDERS:
                self._check_path(tag, value)
                self._scan.folders.add(value)
            elif name.startswith("file"):
                self._refer(tag, value)

    def _end(self, tag: str) -> None:
        self._times.pop()

    def _doctype(self, *_: object) -> None:
        self._refuse("a document type (<!DOCTYPE>) is not allowed; MJCF needs no entities")

    def _check_count(self) -> None:
        for what, number, most in (
            ("elements", self._count.elements, MAX_ELEMENTS),
            ("bodies", self._count.bodies, MAX_BODIES),
            ("pixels of textures and points of height fields", self._count.cells, MAX_CELLS),
        ):
            if number > most:
                self._refuse(f"more than {most} {what}, counting what is replicated")

    def _check_sizes(self, attributes: Mapping[str, str]) -> None:
        for name, value in attributes.items():
            most = _SIZE_LIMITS.get(name, _OTHER_SIZE_LIMIT)
            if _bytes(value) > most:
                self._refuse(f"<size> asks for {name} {value}; at most {most} is allowed")

    def _check_path(self, tag: str, given: str) -> Path | None:
        """Return the file that is meant, or None after noting that it lies elsewhere."""
        try:
            target = (self._scan.folder / given).resolve()
            inside = target.is_relative_to(self._scan.folder.resolve())
        except (OSError, RuntimeError, ValueError) as error:
            self._note(f"<{tag}> names {given!r}, which cannot be looked up ({error})")
            return None
        if not inside:
            self._note(f"<{tag}> names '{given}', outside the model's folder")
        return target if inside else None

    def _refer(self, tag: str, given: str) -> None:
        target = self._check_path(tag, given)
        if target is None:
            return
        if tag not in ("include", "model"):
            self._scan.assets.append((self._place(), given))
        elif not _is_file(target):
            self._refuse(f"<{tag}> names '{given}', which is not a file")
        elif tag == "include" and target not in self._scan.seen:
            self._scan.seen.add(target)
            _Reader(self._scan, target, self._count).read()
        elif tag == "model":
            self._models.append(self._model(given, target))

    def _model(self, given: str, target: Path) -> _Count:
        """Return what an attachable model multiplies to, read once."""
        models = self._scan.models
        if target not in models and target != self._scan.root:
            models[target] = None
            count = _Count()
            _Reader(self._scan, target, count).read()
            models[target] = count
        found = models.get(target)
        if found is None:
            self._refuse(f"<model> names '{given}', which is a part of itself")
        return found

    def _note(self, fault: str) -> None:
        self._scan.faults.append(f"{self._place()}: {fault}")

    def _refuse(self, fault: str, line: int | None = None) -> NoReturn:
        raise _Refused(f"{self._place(line)}: {fault}")

    def _place(self, line: int | None = None) -> str:
        number = line or self._parser.CurrentLineNumber
        here = self._path == self._scan.root
        return f"line {number}" if here else f"{self._path.name}:{number}"


def _check_assets(scan: _Scan) -> None:
    """Refuse files that MuJoCo would open but are none, lie elsewhere, or are too large."""
    total = 0
    root = scan.folder.resolve()
    for place, given in scan.assets:
        for folder in sorted(scan.folders):
            path = scan.folder / folder / given
            try:
                status = path.stat()
            except (OSError, ValueError):
                continue  # MuJoCo will say that it is missing
            if not stat.S_ISREG(status.st_mode):
                raise _Refused(f"{place}: '{given}' is not a file")
            if not path.resolve().is_relative_to(root):
                raise _Refused(f"{place}: '{given}' leads outside the model's folder")
            total += status.st_size
            if total > MAX_ASSET_BYTES:
                raise _Refused(f"{place}: '{given}' brings the assets above {MAX_ASSET_BYTES >> 20} MB")
            if _png_pixels(path) > MAX_CELLS:
                raise _Refused(f"{place}: '{given}' is a picture of more than {MAX_CELLS} pixels")


def _png_pixels(path: Path) -> int:
    with path.open("rb") as stream:
        head = stream.read(24)
    return int.from_bytes(head[16:20]) * int.from_bytes(head[20:24]) if head.startswith(_PNG) else 0


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _numbers(text: str) -> list[float]:
    """Return the finite numbers of a text; what is none, MuJoCo will say."""
    found = []
    for word in text.split():
        try:
            number = float(word)
        except ValueError:
            continue
        found.append(number if math.isfinite(number) else 1e18)
    return found


def _product(text: str) -> int:
    """Return what numbers such as '10 10 1' multiply to, at least 1 and not beyond all bounds."""
    product = 1.0
    for number in _numbers(text):
        product = min(product * max(1.0, number), 1e18)
    return int(product)


def _cells(attributes: Mapping[str, str], rows: str, columns: str) -> int:
    # What is missing is 0 to MuJoCo: nothing is made then.
    if not {rows, columns} <= attributes.keys():
        return 0
    return _product(attributes[rows]) * _product(attributes[columns])


def _bytes(text: str) -> float:
    """Return a size such as '100', '-1' or '2G'."""
    unit = _UNITS.get(text.strip()[-1:].upper(), 1)
    return unit * max(_numbers(text.strip().rstrip("KMGTPEkmgtpe")), default=0.0)
