"""Sets of files that belong together: a new set takes the place of the earlier one whole, or not at all.

A run writes into a hidden folder ``.part-…`` in the folder of its results. When all files are written, the
folder is locked, the earlier files are moved into ``.part-…/.aside``, and the new files are moved to their
places. The first product is the completion mark: it is the first to leave and the last to arrive.

A process that is killed leaves its hidden folder, and no lock. The next run in the folder restores the
earlier set from there, unless all new files have arrived.
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

from srs_twin.errors import InputError
from srs_twin.io.files import made_folder, refuse_folders, shown

_FRESH = ".part-"
_PRODUCTS = ".products"
"""List of the products in a hidden folder, one per line."""

_ASIDE = ".aside"
"""Earlier files; no new file has arrived."""

_EARLIER = ".earlier"
"""All earlier files; new files may have arrived."""

_GONE = ".gone"
"""Earlier files after a swap that has ended."""

_WAIT_S = 60.0
"""A swap takes milliseconds: a lock that is held for longer belongs to a process that was stopped."""

# Network drives such as NFS lock no folder.
_NO_LOCKS = (errno.EBADF, errno.EINVAL, errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


@contextmanager
def replaced(folder: Path, products: Sequence[str]) -> Iterator[Path]:
    """Yield an empty folder for a set of files, which replaces the earlier set when the block ends.

    After an error or an interrupt the earlier set is restored. Other files in the folder stay. If several
    processes finish at once, the set of the last one remains.

    Args:
        folder: where the files belong; made if missing.
        products: names of all files that a run may leave there, or patterns such as ``best/*.yaml``. The
            first is the completion mark: where it exists, the set is complete.

    Raises:
        InputError: the files cannot be written, for want of space or of permission.
    """
    try:
        with made_folder(folder), _fresh(folder, products) as fresh:
            with _named_as_in(folder, fresh):
                yield fresh
            with _locked(folder):
                _swap(folder, fresh, products)
    except OSError as error:
        name = Path(os.fsdecode(error.filename or "")).name
        where = f"{name}: " if name in products else ""
        reason = os.strerror(error.errno) if error.errno else str(error)
        if isinstance(error, BlockingIOError):
            reason = "another process holds the folder's lock"
        raise InputError(
            f"{shown(folder)}: the run's files cannot be written there ({where}{reason}); "
            "an earlier run's are as they were"
        ) from error


def unmark(mark: Path) -> None:
    """Remove the completion mark of a set that no longer belongs to its folder.

    Raises:
        InputError: it cannot be removed.
    """
    try:
        mark.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{shown(mark)}: cannot be replaced ({error.strerror})") from error


@contextmanager
def _named_as_in(folder: Path, fresh: Path) -> Iterator[None]:
    """Name files in error messages by their later places."""
    try:
        yield
    except InputError as error:
        error.args = (str(error).replace(shown(fresh), shown(folder)),)
        raise


def _swap(folder: Path, fresh: Path, products: Sequence[str]) -> None:
    """Replace the earlier set by the files in a hidden folder; restore it after an error.

    Raises:
        InputError: a product is a folder, or the earlier set cannot be restored now.
        OSError: a file cannot be moved.
    """
    refuse_folders(folder, products)
    try:
        (fresh / _ASIDE).mkdir()
        _move(_names(folder, products), folder, fresh / _ASIDE)
        (fresh / _ASIDE).rename(fresh / _EARLIER)
        _move(reversed(_names(fresh, products)), fresh, folder)
        with suppress(OSError):
            (fresh / _EARLIER).rename(fresh / _GONE)
    except BaseException:
        try:
            _restore(folder, fresh)
        except OSError as error:
            raise InputError(
                f"{shown(folder)}: the run's files cannot be written there ({error.strerror}); earlier files "
                f"are in {shown(fresh)}, and the next run restores them"
            ) from error
        raise


def _names(place: Path, products: Iterable[str]) -> list[Path]:
    """Return the products that a folder holds, relative to it, in the order of the products."""
    return [path.relative_to(place) for each in products for path in sorted(place.glob(each))]


def _move(names: Iterable[Path], source: Path, target: Path) -> None:
    for name in names:
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).rename(target / name)


def _restore(folder: Path, fresh: Path) -> None:
    """Restore the earlier set after a swap that did not end.

    Wherever this is interrupted, it can be repeated.

    Raises:
        OSError: a file cannot be moved.
        ValueError: the list of products is damaged.
    """
    mark, *others = (fresh / _PRODUCTS).read_text("utf-8").splitlines()
    # With the mark in its place no file has left, or all have arrived.
    if not os.path.lexists(folder / mark):
        if (fresh / _EARLIER).is_dir():
            for name in _names(folder, others):
                (folder / name).unlink()
            (fresh / _EARLIER).rename(fresh / _ASIDE)
        _move(reversed(_names(fresh / _ASIDE, (mark, *others))), fresh / _ASIDE, folder)
    for each in (_ASIDE, _EARLIER):
        shutil.rmtree(fresh / each, ignore_errors=True)


@contextmanager
def _fresh(folder: Path, products: Sequence[str]) -> Iterator[Path]:
    """Yield a hidden folder that this process has locked; first clean up after processes that were killed."""
    with ExitStack() as held:
        # While the folder is locked, no other process takes the new hidden folder for a killed one's.
        with _locked(folder):
            _clean(folder)
            fresh = Path(tempfile.mkdtemp(prefix=_FRESH, dir=folder))
            held.enter_context(_locked(fresh))
        try:
            (fresh / _PRODUCTS).write_bytes("\n".join(products).encode())
            yield fresh
        finally:
            if not _unfinished(fresh):
                shutil.rmtree(fresh, ignore_errors=True)


def _unfinished(fresh: Path) -> bool:
    """Return whether a hidden folder holds earlier files that may have to be restored."""
    return any((fresh / each).is_dir() for each in (_ASIDE, _EARLIER))


def _clean(folder: Path) -> None:
    """Restore what killed processes have set aside, and remove their hidden folders."""
    for left in folder.glob(f"{_FRESH}*"):
        with suppress(OSError, ValueError), _locked(left, wait_s=0.0) as sure:
            if sure:
                if _unfinished(left):
                    _restore(folder, left)
                shutil.rmtree(left)


@contextmanager
def _locked(folder: Path, wait_s: float = _WAIT_S) -> Iterator[bool]:
    """Hold the lock of a folder, which ends with the process; yield False where folders have no locks.

    Raises:
        BlockingIOError: another process holds it for longer than `wait_s`.
    """
    deadline, sure = time.monotonic() + wait_s, False
    handle = os.open(folder, os.O_RDONLY)
    try:
        while not sure:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                sure = True
            except BlockingIOError:
                if time.monotonic() >= deadline:
                    raise
                time.sleep(0.002)
            except OSError as error:
                if error.errno not in _NO_LOCKS:
                    raise
                break
        yield sure
    finally:
        os.close(handle)
