"""Shipped files, paths in messages, and atomic writing of single files."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import secrets
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from srs_twin.errors import InputError, UnknownNameError, WriteError, did_you_mean

MAX_BYTES = 64 * 1024
"""Maximum size of a hand-written file, bytes. A larger file is probably the wrong file.
"""

StrPath = str | os.PathLike[str]

METRICS = "metrics.json"
SWEEP_SUMMARY = "sweep.json"
STUDY_RESULT = "study.json"

SWEEP_ROWS = "rows.sqlite"
STUDY_ROWS = f"twin/{SWEEP_ROWS}"

RUN_MARKS = (METRICS,)
SWEEP_MARKS = (SWEEP_SUMMARY, SWEEP_ROWS)
STUDY_MARKS = (STUDY_RESULT, STUDY_ROWS)
_RESULT_KINDS = {
    RUN_MARKS: "a run",
    SWEEP_MARKS: "a sweep",
    STUDY_MARKS: "an optimization",
}
"""Kinds of results that share file names, keyed by the marks of each kind.

The marks are names of files. The first is the file that marks a complete set of
results. The others exist from the start.
"""

_FOLDERS = {
    "robot": "calibration/robots",
    "footprint": "calibration/footprints",
    "scenario": "scenarios",
    "sweep": "scenarios/sweeps",
    "study": "scenarios/studies",
    "table": "calibration/published",
}
_SUFFIXES = (".yaml", ".yml")
# Control characters (C0, DEL and C1) and surrogates. In file names, Python represents
# invalid UTF-8 bytes by surrogates.
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\ud800-\udfff]")


def data_root() -> Path:
    """Return the folder that contains calibration/, models/ and scenarios/.

    In an installed wheel, this is ``srs_twin/_data``, and otherwise the root of the
    repository.
    """
    package = Path(__file__).resolve().parents[1]
    packed = package / "_data"
    if packed.is_dir():
        return packed
    return package.parent


def shipped_folder(kind: str) -> Path:
    """Return the folder with the shipped files of a kind (see `find_file`)."""
    return data_root() / _FOLDERS[kind]


def shipped_names(kind: str) -> list[str]:
    """Return the sorted names of all shipped files of a kind."""
    return sorted(path.stem for path in shipped_folder(kind).glob("*.yaml"))


_LIST_COMMANDS = {
    kind: f"`srs-twin list {kind}s`" for kind in ("scenario", "robot", "sweep")
} | {"study": "`srs-twin list studies`"}


def is_path(text: str) -> bool:
    """Return whether a text is a path rather than the name of a shipped file."""
    return "/" in text or os.sep in text or text.endswith(_SUFFIXES)


def place_of(text: str, folder: Path, kind: str = "") -> str:
    """Resolve a path that is written in another file, and check that it exists.

    Args:
        text: path relative to `folder` or to the current folder.
        folder: folder of the file that contains the path.
        kind: kind of shipped files that the error message suggests, if any.
    """
    beside: Path | None = folder / text
    with suppress(OSError):  # a folder may have been removed
        if os.path.samefile(folder, os.curdir):
            beside = None
    if beside is not None and os.path.lexists(beside):
        return str(beside)
    if not os.path.lexists(text):
        suffix = Path(text).suffix or ".yaml"
        names = shipped_names(kind) if kind else ()
        require_file(Path(text), suffix=suffix, names=names, beside=beside)
    return text


def path_from(folder: Path, name_or_path: str) -> str:
    """Make a path relative to the folder of the file that will contain the path.

    Absolute paths and names of shipped files are returned unchanged.
    """
    if not is_path(name_or_path) or os.path.isabs(name_or_path):
        return name_or_path
    return Path(os.path.relpath(name_or_path, folder)).as_posix()


def find_file(kind: str, name_or_path: StrPath) -> Path:
    """Find a file by its path, or a shipped file by its name.

    A text that contains a slash or ends in .yaml or .yml is a path relative to the
    current folder. Any other text is the name of a shipped file.

    Args:
        kind: "robot", "footprint", "scenario", "sweep", "study" or "table".
        name_or_path: name or path given by the user.
    """
    text = os.fspath(name_or_path)
    names = shipped_names(kind)
    if isinstance(name_or_path, os.PathLike) or is_path(text):
        return require_file(Path(text), names=names)
    if text in names:
        return shipped_folder(kind) / f"{text}.yaml"
    if os.path.isfile(text):
        raise InputError(
            f"{text}: the name of a {kind} file must end in {' or '.join(_SUFFIXES)}"
        )
    if os.path.isdir(text):
        require_file(Path(text))
    raise UnknownNameError(
        kind, text, names, _LIST_COMMANDS.get(kind) or str(shipped_folder(kind))
    )


def results_name(path: Path) -> str:
    """Convert the stem of a path to a valid folder name and YAML key."""
    return re.sub(r"[^\w .+=-]", "_", path.stem).lstrip(". ") or "scenario"


def check_file_name(name: str, source: str) -> str:
    """Return a name after checking that it is a valid file name.

    The name has at most 60 lower-case letters, digits and _, and begins with a letter.
    The argument `source` is the option or argument that the error message mentions.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,59}", name):
        allowed = (
            "use at most 60 lower-case letters, digits and _, and begin with a letter"
        )
        raise InputError(f"{source}: '{name}' is not allowed; {allowed}")
    return name


def escape_unprintable(text: str, *, keep: str = "") -> str:
    r"""Escape control characters and invalid UTF-8 bytes in a text.

    Terminals interpret control characters. For example, a title with ``\x1b[31m`` would
    colour the text after it. Characters in `keep` are not escaped.
    """
    return _UNPRINTABLE.sub(
        lambda match: match[0] if match[0] in keep else _escape(match[0]), text
    )


def _escape(character: str) -> str:
    # Python decodes invalid UTF-8 bytes from 0x80 to 0xff as U+DC80 to U+DCFF
    # ("surrogateescape").
    byte = ord(character) - 0xDC00
    if 0x80 <= byte <= 0xFF:
        return f"\\x{byte:02x}"
    return ascii(character)[1:-1]


def check_printable(argument: StrPath) -> None:
    """Check that a text has neither control characters nor invalid UTF-8 bytes."""
    text = os.fspath(argument)
    if match := _UNPRINTABLE.search(text):
        reason = "it contains a control character"
        if match[0] >= "\ud800":
            reason = "it is not valid UTF-8"
        raise InputError(
            f"{escape_unprintable(text)}: this name cannot be used ({reason}); rename"
            " it"
        )


def display_path(path: Path) -> str:
    """Return a printable path, relative to the current folder for paths inside it."""
    with suppress(OSError):  # a folder may have been removed
        if path.is_absolute() and path.is_relative_to(here := Path.cwd()):
            path = path.relative_to(here)
    return escape_unprintable(str(path))


def read_text(path: Path, *, limit: int = MAX_BYTES, suffix: str = ".yaml") -> str:
    """Read the text of a UTF-8 file of at most `limit` bytes.

    If the path is a folder, the error message names a file in it with this suffix.
    """
    try:
        with require_file(path, suffix=suffix).open("rb") as stream:
            raw = stream.read(limit + 1)
    except OSError as error:
        raise InputError(
            f"{display_path(path)}: the file cannot be read ({error.strerror})"
        ) from error
    if len(raw) > limit:
        size = f"{limit // 1024} kB" if limit < 1 << 20 else f"{limit >> 20} MB"
        raise InputError(
            f"{display_path(path)}: the file is larger than {size}, the maximum allowed"
            " size"
        )
    return decode_text(raw, display_path(path))


def decode_text(raw: bytes, name: str) -> str:
    """Decode UTF-8 bytes, without the byte order mark if there is one."""
    try:
        return raw.decode("utf-8").removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        byte = f"byte {error.start + 1} is 0x{raw[error.start]:02x}"
        raise InputError(
            f"{name}: the file is not UTF-8 text ({byte}); save it as UTF-8"
        ) from error


MAX_NEW_FOLDERS = 100
"""Maximum number of nested new folders, which limits the recursion of `Path.mkdir`."""


def missing_folders(folder: Path) -> list[Path]:
    """Return the missing folders in a path, innermost folder first."""
    missing = [path for path in (folder, *folder.parents) if not os.path.lexists(path)]
    if len(missing) > MAX_NEW_FOLDERS:
        raise OSError(
            errno.ENAMETOOLONG,
            f"the path has {len(missing)} nested new folders, but at most"
            f" {MAX_NEW_FOLDERS} are allowed",
        )
    return missing


def remove_empty_folders(folders: Iterable[Path]) -> None:
    """Remove those of the given folders that are empty."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


@contextmanager
def folder_or_temporary(folder: StrPath | None) -> Iterator[Path]:
    """Yield a folder, or a temporary folder if `folder` is None.

    The temporary folder is deleted when the block ends.
    """
    if folder is not None:
        yield Path(folder)
        return
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@contextmanager
def make_folder(folder: Path) -> Iterator[None]:
    """Create a folder and its parents for a `with` block.

    After an error in the block, the new folders that are still empty are removed.
    """
    missing = missing_folders(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        remove_empty_folders(missing)
        raise


@contextmanager
def atomic_write(path: StrPath) -> Iterator[Path]:
    """Yield a temporary path that replaces ``path`` when the block ends.

    Missing folders are created. Readers of ``path`` see either the old file or the
    complete new file. After an error, the temporary file and the new folders are
    removed.
    """
    target = Path(path)
    try:
        with make_folder(target.parent), _temporary_file(target) as temporary:
            yield temporary
            temporary.replace(target)
    except OSError as error:
        raise WriteError(
            f"{display_path(target)}: the file cannot be written"
            f" ({error.strerror or error})"
        ) from error


@contextmanager
def _temporary_file(target: Path) -> Iterator[Path]:
    """Yield a hidden file in the folder of a target, and remove it after an error.

    All processes use the same temporary name for a target, so that the next process
    overwrites a file left behind by a killed process. If another process has locked
    this file, a random name is used.
    """
    # The suffix remains at the end of the name, because some libraries infer the file
    # format from it.
    temporary = target.with_name(f".{target.stem}.part{target.suffix}")
    with ExitStack() as stack:
        try:
            lock = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW, 0o666)
            stack.callback(os.close, lock)
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Another process may have renamed the file before the lock was obtained.
            is_usable = os.path.samestat(os.fstat(lock), temporary.stat())
        except OSError:  # the file is locked, or it cannot be locked or written
            is_usable = False
        if not is_usable:
            temporary = target.with_name(
                f".{target.stem}.{secrets.token_hex(4)}.part{target.suffix}"
            )
        try:
            yield temporary
        except BaseException:
            # An error during removal would hide the first error.
            with suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


def create_numbered_file(folder: Path, name: str) -> Path:
    """Create an empty file with the lowest free number in its name.

    Concurrent processes create different files. The argument `name` has a placeholder
    for the number, as in "journal-{}.mcap".
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
                raise InputError(
                    f"{display_path(folder)}: this is not a folder, so no file can"
                    " be written there"
                ) from None
        except OSError as error:
            raise WriteError(
                f"{display_path(path)}: the file cannot be written ({error.strerror})"
            ) from error
        else:
            return path


def write_text(path: StrPath, text: str) -> None:
    """Write a text file atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, "utf-8")


def require_file(
    path: Path,
    *,
    suffix: str = ".yaml",
    remedy: str = "",
    names: Iterable[str] = (),
    beside: Path | None = None,
) -> Path:
    """Return a path after checking that it is a regular file.

    Devices and pipes are refused, because reading them might never finish.
    """
    check_printable(path)
    try:
        if path.is_file():
            return path
        if path.is_dir():
            inside = sorted(p.name for p in path.glob(f"*{suffix}"))
            hint = f" ({suffix}; this folder contains none)"
            if inside:
                hint = f", such as {display_path(path / inside[0])}"
            raise InputError(
                f"{display_path(path)}: this is a folder; give one file{hint}"
            )
        if path.exists():
            raise InputError(
                f"{display_path(path)}: this is not a regular file; give a regular file"
            )
        if path.is_symlink():
            raise InputError(
                f"{display_path(path)}: this is a broken link, which points to no file"
            )
    except OSError as error:
        # The name is too long, or the folder is not accessible.
        raise InputError(
            f"{display_path(path)}: the file cannot be read ({error.strerror})"
        ) from error
    places = dict.fromkeys([beside or path, path])
    siblings = [
        str(path.with_name(found.name))
        for place in places
        for found in place.parent.glob(f"*{suffix}")
        if path.name
    ]
    hint = did_you_mean(str(path), siblings) or did_you_mean(str(path), names) or remedy
    looked = ""
    if len(places) > 1:
        looked = f" (looked for {' and '.join(map(display_path, places))})"
    raise InputError(f"{display_path(path)}: no such file{looked}{hint}")


def check_output_folder(
    folder: Path,
    products: Sequence[str] = (),
    *,
    marks: tuple[str, ...] = (),
    option: str = "--out",
) -> None:
    """Check that files can be written to a folder, which may not exist yet.

    Args:
        folder: output folder.
        products: names of the files.
        marks: marks of the results, such as `RUN_MARKS`, or an empty tuple if the
            folder may contain results of any kind.
        option: option that names the folder in error messages.

    Raises:
        InputError: the folder is not writable, contains a folder with the name of a
            file, or contains results of another kind with the same file names.
    """
    check_printable(folder)
    try:
        target = Path(os.path.abspath(folder))
        missing = missing_folders(target)
        present = missing[-1].parent if missing else target
        # A test file is written, because permission bits do not apply to root and are
        # unreliable on network drives.
        with tempfile.TemporaryDirectory(dir=present) as scratch:
            trial = scratch / target.relative_to(present)
            trial.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=trial):
                pass
    except OSError as error:
        problem = f"cannot write there ({error.strerror or error})"
        if option:
            problem += f"; give another folder with {option}"
        raise InputError(f"{display_path(folder)}: {problem}") from error
    check_not_folders(folder, products)
    if marks:
        _check_result_kind(folder, marks, option)


def _check_result_kind(folder: Path, own: tuple[str, ...], option: str) -> None:
    for marks, kind in _RESULT_KINDS.items():
        if marks != own and any((folder / mark).exists() for mark in marks):
            raise InputError(
                f"{display_path(folder)}: the folder contains {kind}; give another"
                f" folder with {option}"
            )


def check_not_folders(folder: Path, products: Sequence[str]) -> None:
    """Check that no folder has the same name as an output file."""
    for product in products:
        if (folder / product).is_dir():
            raise InputError(
                f"{display_path(folder / product)}: a folder has the name of an output"
                " file; remove or rename this folder"
            )
