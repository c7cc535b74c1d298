"""Folders of results: can they be written, and how a set of files takes the place of an earlier one."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from srs_twin.errors import InputError
from srs_twin.files import made_folder, missing_folders, refuse_unprintable, shown

_FRESH = ".part-"


def open_folder(folder: Path, products: Sequence[str] = ()) -> None:
    """See that files can be written to a folder, which need not exist; leave nothing behind.

    Args:
        folder: where the files belong.
        products: their names.

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
        reason = error.strerror or str(error)
        raise InputError(
            f"{shown(folder)}: cannot write there ({reason}); give another folder with --out"
        ) from error
    _refuse_folders(folder, products)


def _refuse_folders(folder: Path, products: Sequence[str]) -> None:
    """Refuse a folder that stands where a file belongs."""
    for product in products:
        if (folder / product).is_dir():
            raise InputError(f"{shown(folder / product)}: cannot be replaced (a folder)")


@contextlib.contextmanager
def replaced(folder: Path, products: Sequence[str]) -> Iterator[Path]:
    """Give an empty folder for a run's files; they take the places of an earlier run's at the block's end.

    After an error nothing of the block is left, and what the earlier run wrote is as it was. The folder never
    holds files of two runs beside the first product: that goes first and comes last.

    Args:
        folder: where the files belong; made where it is missing.
        products: names of all files that a run may leave there.

    Raises:
        InputError: the files cannot be written, for want of space or of permission.
    """
    try:
        with made_folder(folder), _fresh(folder) as fresh:
            yield fresh
            _refuse_folders(folder, products)
            for product in products:
                (folder / product).unlink(missing_ok=True)
            for product in reversed(products):
                if (fresh / product).exists():
                    (fresh / product).replace(folder / product)
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        raise InputError(
            f"{shown(folder)}: the run's files cannot be written there ({reason}); "
            "an earlier run's are as they were"
        ) from error


@contextlib.contextmanager
def _fresh(folder: Path) -> Iterator[Path]:
    """Give a folder of this run's own; remove those of runs that were killed: nobody locks them any more."""
    for left in folder.glob(f"{_FRESH}*"):
        with contextlib.suppress(OSError), _locked(left):
            shutil.rmtree(left)
    fresh = Path(tempfile.mkdtemp(prefix=_FRESH, dir=folder))
    try:
        with _locked(fresh):
            yield fresh
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold a folder's lock, which ends with the process; raise BlockingIOError where another one holds it."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)
