"""Files: where the shipped data lie, how a name or path becomes text, how one file is written whole.

Folders of results: whether they can be written. `file_sets` replaces several files together.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from srs_twin.errors import InputError, UnknownNameError, did_you_mean

MAX_BYTES = 64 * 1024
"""No file that a person writes is larger; what is, was not meant for us."""

_FOLDERS = {
    "robot": "calibration/robots",
    "footprint": "calibration/footprints",
    "scenario": "scenarios",
    "sweep": "scenarios/sweeps",
    "study": "scenarios/studies",
    "table": "calibration/published",
}
_SUFFIXES = (".yaml", ".yml")
# C0, DEL and C1; halves of surrogate pairs, as which Python keeps bytes that are no UTF-8.
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


def data_root() -> Path:
    """Return the folder that holds calibration/, models/ and scenarios/.

    In a wheel that is ``srs_twin/_data``; in an editable checkout, which has none, the checkout itself.
    """
    package = Path(__file__).resolve().parents[1]
    packed = package / "_data"
    return packed if packed.is_dir() else package.parent


def shipped_folder(kind: str) -> Path:
    """Return the folder in which names of this kind (as in `find`) are looked up."""
    return data_root() / _FOLDERS[kind]


def shipped_names(kind: str) -> list[str]:
    """Return the names of this kind that come with the package, sorted."""
    return sorted(path.stem for path in shipped_folder(kind).glob("*.yaml"))


_LISTED = {kind: f"`srs-twin list {kind}s`" for kind in ("scenario", "robot", "sweep")} | {
    "study": "`srs-twin list studies`"
}


def find(kind: str, name_or_path: str | os.PathLike[str]) -> Path:
    """Return the file that a name or path means.

    A path is what has a slash or ends in .yaml or .yml, and is taken as given (from the current folder);
    anything else is a name, looked up in the shipped folder.

    Args:
        kind: "robot", "footprint", "scenario", "sweep", "study" or "table".
        name_or_path: as a person wrote it.

    Raises:
        InputError: no file is there, or something that is no file of this kind.
        UnknownNameError: no shipped file has that name.
    """
    given, names = os.fspath(name_or_path), shipped_names(kind)
    if isinstance(name_or_path, os.PathLike) or "/" in given or os.sep in given or given.endswith(_SUFFIXES):
        return existing(Path(given), names=names)
    if given in names:
        return shipped_folder(kind) / f"{given}.yaml"
    if os.path.isfile(given):
        raise InputError(f"{given}: a {kind} file ends in {' or '.join(_SUFFIXES)}")
    if os.path.isdir(given):
        existing(Path(given))
    raise UnknownNameError(kind, given, names, _LISTED.get(kind) or str(shipped_folder(kind)))


def results_name(path: Path) -> str:
    """Return what the results of a file are called: its stem, fit for a folder and for a YAML key."""
    return re.sub(r"[^\w .+=-]", "_", path.stem).lstrip(". ") or "scenario"


def printable(text: str, *, keep: str = "") -> str:
    r"""Return text with escapes for control characters and for bytes that are no UTF-8.

    A terminal obeys them: a title with ``\x1b[31m`` colours whatever follows.

    Args:
        text: from anywhere.
        keep: control characters that stay, such as line ends.
    """
    return _UNPRINTABLE.sub(lambda found: found[0] if found[0] in keep else _escape(found[0]), text)


def _escape(character: str) -> str:
    # What Python makes of a byte 0x80 to 0xff in a file name that is not UTF-8 (surrogateescape).
    byte = ord(character) - 0xDC00
    return f"\\x{byte:02x}" if 0x80 <= byte <= 0xFF else ascii(character)[1:-1]


def refuse_unprintable(given: str | os.PathLike[str]) -> None:
    """Refuse a path, or any word of a command: files of results name it, and they are UTF-8 YAML.

    Raises:
        InputError: it is not UTF-8 or has control characters.
    """
    text = os.fspath(given)
    if found := _UNPRINTABLE.search(text):
        reason = "not UTF-8" if found[0] >= "\ud800" else "a control character in it"
        raise InputError(f"{printable(text)}: cannot be used ({reason}); rename it")


def shown(path: Path) -> str:
    """Return a path as messages show it: relative to the current folder where it is inside it, printable."""
    with suppress(OSError):  # of a current folder that was removed
        if path.is_absolute() and path.is_relative_to(here := Path.cwd()):
            path = path.relative_to(here)
    return printable(str(path))


def read_text(path: Path, *, limit: int = MAX_BYTES) -> str:
    """Return the text of a small UTF-8 file; a byte order mark is dropped.

    Args:
        path: of the file.
        limit: Largest size that is read, bytes.

    Raises:
        InputError: missing, a folder, not readable, too large or not UTF-8.
    """
    try:
        with existing(path).open("rb") as stream:
            raw = stream.read(limit + 1)
    except OSError as error:
        raise InputError(f"{shown(path)}: cannot be read ({error.strerror})") from error
    if len(raw) > limit:
        raise InputError(f"{shown(path)}: larger than {limit // 1024} kB; no file of ours is")
    return decoded(raw, shown(path))


def decoded(raw: bytes, name: str) -> str:
    """Return the text of a UTF-8 file, without a byte order mark; its name is for the message.

    Raises:
        InputError: it is not UTF-8.
    """
    try:
        return raw.decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        byte = f"byte {error.start + 1} is 0x{raw[error.start]:02x}"
        raise InputError(f"{name}: not UTF-8 text ({byte}); save it as UTF-8") from error


MAX_LEVELS = 100
"""Folders are made one inside the other by recursion, whose stack is limited."""


def missing_folders(folder: Path) -> list[Path]:
    """Return a folder and its parents as far as they do not exist, the innermost first.

    Raises:
        OSError: there are more than `MAX_LEVELS` of them.
    """
    missing = [each for each in (folder, *folder.parents) if not os.path.lexists(each)]
    if len(missing) > MAX_LEVELS:
        raise OSError(errno.ENAMETOOLONG, f"{len(missing)} new folders deep; at most {MAX_LEVELS} are made")
    return missing


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove folders that hold nothing; somebody else may have begun to write to the others."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Make a folder and its parents for a block; after an error those that this made and are empty go again.

    Raises:
        OSError: it cannot be made.
    """
    missing = missing_folders(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        remove_empty(missing)
        raise


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a path beside ``path`` to write to; it becomes ``path`` when the block ends without an error.

    Missing folders are made. Whoever looks at ``path`` sees the old file or the whole new one; after an
    error nothing is left, no folder either.

    Raises:
        InputError: the place cannot be written.
    """
    target = Path(path)
    # The suffix stays last: some writers choose their format by it.
    part = target.with_name(f".{target.stem}.{secrets.token_hex(4)}.part{target.suffix}")
    try:
        with made_folder(target.parent):
            try:
                yield part
                part.replace(target)
            finally:
                # Where the folder itself cannot be used there is nothing to remove: the first error counts.
                with suppress(OSError):
                    part.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{shown(target)}: cannot be written ({error.strerror or error})") from error


def new_numbered(folder: Path, name: str) -> Path:
    """Make an empty file with the lowest free number in its name; no other process gets the same one.

    Args:
        folder: of the file; made where it is missing.
        name: of the file with "{}" for the number, such as "journal-{}.mcap".

    Raises:
        InputError: the folder cannot be written.
    """
    number = 0
    while True:
        number += 1
        path = folder / name.format(number)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            path.open("xb").close()
        except FileExistsError:
            if not folder.is_dir():
                raise InputError(f"{shown(folder)}: cannot be written (not a folder)") from None
        except OSError as error:
            raise InputError(f"{shown(path)}: cannot be written ({error.strerror})") from error
        else:
            return path


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file, whole or not at all.

    Raises:
        InputError: the place cannot be written.
    """
    with atomic_write(path) as part:
        part.write_text(text, "utf-8")


def existing(path: Path, *, suffix: str = ".yaml", remedy: str = "", names: Iterable[str] = ()) -> Path:
    """Return the path if it is a regular file: devices and pipes might never end.

    Args:
        path: as a person gave it.
        suffix: of the files that were perhaps meant.
        remedy: what to say besides where there is none.
        names: what can be given without a path, and was perhaps meant.

    Raises:
        InputError: it is something else, not there, or its name cannot be used.
    """
    refuse_unprintable(path)
    try:
        if path.is_file():
            return path
        if path.is_dir():
            inside = sorted(p.name for p in path.glob(f"*{suffix}"))
            hint = f", such as {shown(path / inside[0])}" if inside else f" ({suffix}; there is none in it)"
            raise InputError(f"{shown(path)}: a folder; give one file{hint}")
        if path.exists():
            raise InputError(f"{shown(path)}: not a regular file")
        if path.is_symlink():
            raise InputError(f"{shown(path)}: a link that leads to no file")
    except OSError as error:
        # A name too long, a folder that may not be entered.
        raise InputError(f"{shown(path)}: cannot be read ({error.strerror})") from error
    siblings = [str(path.with_name(p.name)) for p in path.parent.glob(f"*{suffix}")] if path.name else []
    hint = did_you_mean(str(path), siblings) or did_you_mean(str(path), names) or remedy
    raise InputError(f"{shown(path)}: no such file{hint}")


def open_folder(folder: Path, products: Sequence[str] = (), *, option: str = "--out") -> None:
    """See that files can be written to a folder, which need not exist; leave nothing behind.

    Args:
        folder: where the files belong.
        products: their names.
        option: of the command that names the place, for the message; empty: there is none.

    Raises:
        InputError: the folder cannot be made or written, or a folder stands where a file belongs.
    """
    refuse_unprintable(folder)
    try:
        place = Path(os.path.abspath(folder))
        missing = missing_folders(place)
        present = missing[-1].parent if missing else place
        # Permission bits say nothing to root and little on network drives: try it, names included.
        with tempfile.TemporaryDirectory(dir=present) as scratch:
            trial = scratch / place.relative_to(present)
            trial.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=trial):
                pass
    except OSError as error:
        remedy = f"; give another folder with {option}" if option else ""
        reason = error.strerror or str(error)
        raise InputError(f"{shown(folder)}: cannot write there ({reason}){remedy}") from error
    refuse_folders(folder, products)


def refuse_folders(folder: Path, products: Sequence[str]) -> None:
    """Refuse a folder that has the name of a product.

    Raises:
        InputError: there is one; names it.
    """
    for product in products:
        if (folder / product).is_dir():
            raise InputError(f"{shown(folder / product)}: cannot be replaced (a folder)")
