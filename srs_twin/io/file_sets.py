"""Atomic replacement of a set of files.

A run writes its files into a hidden staging folder ``.part-…`` inside the results
folder. When all files are written, the run locks the results folder, moves the earlier
files into ``.part-…/.aside``, and moves the new files into the results folder. The
first file of the set is its completion mark, which is moved away before all other files
and moved in after them.

A killed process leaves its staging folder behind, but no lock. The next run in the
results folder restores the earlier set from the staging folder, unless all new files
were moved in.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from srs_twin.errors import InputError, WriteError
from srs_twin.io.files import check_not_folders, display_path, make_folder

_STAGING_PREFIX = ".part-"
_PRODUCT_LIST = ".products"
"""File in a staging folder that lists the names of the new files, one per line."""

_ASIDE = ".aside"
"""Name of the subfolder for the earlier files while they are being moved away."""

_SAVED = ".earlier"
"""Name of the subfolder for the earlier files while the new files are being moved in.
"""

_OBSOLETE = ".gone"
"""Name of the subfolder for the earlier files after all new files have been moved in.
"""

_LOCK_TIMEOUT_S = 60.0
"""Maximum time to wait for a lock, s.

A replacement takes milliseconds, so a process that holds the lock for longer is
probably suspended.
"""

# Errors raised by file systems without folder locks, such as some network drives.
_LOCKS_UNSUPPORTED = (
    errno.EBADF,
    errno.EINVAL,
    errno.ENOLCK,
    errno.ENOSYS,
    errno.EOPNOTSUPP,
)


@contextmanager
def replace_files(folder: Path, products: Sequence[str]) -> Iterator[Path]:
    """Yield an empty folder whose files replace the earlier set when the block ends.

    After an error or an interrupt, the files of the earlier set are restored. Other
    files in the folder are kept.

    Args:
        folder: folder that contains the set.
        products: names of all files in the set, or patterns such as ``best/*.yaml``.
            The first file is the completion mark, which exists only in a complete set.
    """
    try:
        with make_folder(folder), _staging_folder(folder, products) as staging:
            with _rename_in_errors(folder, staging):
                yield staging
            with _lock(folder):
                _swap(folder, staging, products)
    except OSError as error:
        name = Path(os.fsdecode(error.filename or "")).name
        where = f"{name}: " if name in products else ""
        reason = os.strerror(error.errno) if error.errno else str(error)
        if isinstance(error, BlockingIOError):
            reason = "another process has locked the folder"
        raise WriteError(
            f"{display_path(folder)}: the run's files cannot be written there"
            f" ({where}{reason}); the files of an earlier run are unchanged"
        ) from error


def remove_completion_mark(mark: Path) -> None:
    """Remove the completion mark of an outdated set of files."""
    try:
        mark.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(
            f"{display_path(mark)}: the file cannot be replaced ({error.strerror})"
        ) from error


@contextmanager
def _rename_in_errors(folder: Path, staging: Path) -> Iterator[None]:
    try:
        yield
    except InputError as error:
        error.args = (str(error).replace(display_path(staging), display_path(folder)),)
        raise


def _swap(folder: Path, staging: Path, products: Sequence[str]) -> None:
    check_not_folders(folder, products)
    try:
        (staging / _ASIDE).mkdir()
        _move(_existing_products(folder, products), folder, staging / _ASIDE)
        (staging / _ASIDE).rename(staging / _SAVED)
        _move(reversed(_existing_products(staging, products)), staging, folder)
        with suppress(OSError):
            (staging / _SAVED).rename(staging / _OBSOLETE)
    except BaseException:
        try:
            _restore(folder, staging)
        except OSError as error:
            raise WriteError(
                f"{display_path(folder)}: the run's files cannot be written there"
                f" ({error.strerror}); earlier files are in {display_path(staging)},"
                " and the next run restores them"
            ) from error
        raise


def _existing_products(folder: Path, products: Iterable[str]) -> list[Path]:
    return [
        path.relative_to(folder)
        for pattern in products
        for path in sorted(folder.glob(pattern))
    ]


def _move(names: Iterable[Path], source: Path, target: Path) -> None:
    for name in names:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).rename(target / name)


def _restore(folder: Path, staging: Path) -> None:
    """Restore the earlier set after an incomplete replacement or restoration."""
    mark, *others = (staging / _PRODUCT_LIST).read_text("utf-8").splitlines()
    # If the completion mark exists, then either no earlier file was moved away or all
    # new files were moved in.
    if not os.path.lexists(folder / mark):
        if (staging / _SAVED).is_dir():
            for name in _existing_products(folder, others):
                (folder / name).unlink()
            (staging / _SAVED).rename(staging / _ASIDE)
        _move(
            reversed(_existing_products(staging / _ASIDE, (mark, *others))),
            staging / _ASIDE,
            folder,
        )
    for subfolder in (_ASIDE, _SAVED):
        shutil.rmtree(staging / subfolder, ignore_errors=True)


@contextmanager
def _staging_folder(folder: Path, products: Sequence[str]) -> Iterator[Path]:
    with ExitStack() as locks:
        # While the staging folder is unlocked, the lock on `folder` prevents other
        # processes from removing it.
        with _lock(folder):
            _clean_up(folder)
            staging = Path(tempfile.mkdtemp(prefix=_STAGING_PREFIX, dir=folder))
            locks.enter_context(_lock(staging))
        try:
            (staging / _PRODUCT_LIST).write_bytes("\n".join(products).encode())
            yield staging
        finally:
            if not _has_saved_files(staging):
                shutil.rmtree(staging, ignore_errors=True)


def _has_saved_files(staging: Path) -> bool:
    return any((staging / name).is_dir() for name in (_ASIDE, _SAVED))


def _clean_up(folder: Path) -> None:
    for staging in folder.glob(f"{_STAGING_PREFIX}*"):
        with suppress(OSError, ValueError), _lock(staging, timeout_s=0.0) as locked:
            if locked:
                if _has_saved_files(staging):
                    _restore(folder, staging)
                shutil.rmtree(staging)


@contextmanager
def _lock(folder: Path, timeout_s: float = _LOCK_TIMEOUT_S) -> Iterator[bool]:
    """Lock a folder for a `with` block, and yield whether the folder was locked.

    If the file system does not support locks, the folder remains unlocked.
    """
    deadline = time.monotonic() + timeout_s
    locked = False
    handle = os.open(folder, os.O_RDONLY)
    try:
        while not locked:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                locked = True
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    raise
                time.sleep(0.002)
            except OSError as error:
                if error.errno not in _LOCKS_UNSUPPORTED:
                    raise
                break
        yield locked
    finally:
        os.close(handle)
