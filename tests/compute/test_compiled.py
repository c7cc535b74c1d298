"""Kernels are cached on disk; without a usable cache folder they run as well, with one warning."""

# ruff: noqa: SLF001 - the caches of numba have no public names
from __future__ import annotations

import errno
import os
import pickle
import subprocess
import sys
import warnings
from pathlib import Path

import numba
import pytest
from numba.core.caching import IndexDataCacheFile

from srs_twin.compute import compiled as module
from srs_twin.compute.compiled import compiled
from srs_twin.errors import CacheWarning

# Numba finds no cache folder: the only allowed locator is not configured.
NO_FOLDER = {
    "NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator",
    "NUMBA_CACHE_DIR": "",
}
WARNING = "compiled kernels cannot be cached, so every start compiles them again"


def add(a, b):
    return a + b


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """Return an uncompiled kernel with its own cache folder."""
    monkeypatch.setattr(module, "_warned", [])
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path))
    return compiled(add)


def test_second_kernel_loads_the_cache_of_the_first(kernel):
    again = compiled(add)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (kernel(1, 2), again(1, 2)) == (3, 3)
    assert (
        again.entry.stats.cache_hits.total(),
        again.entry.stats.cache_misses.total(),
    ) == (1, 0)


def raise_full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_full_disk_disables_only_the_cache(kernel, monkeypatch):
    monkeypatch.setattr(IndexDataCacheFile, "_save_data", raise_full)
    with pytest.warns(
        CacheWarning, match=f"{WARNING} .*No space left on device"
    ) as warned:
        assert (kernel(1, 2), kernel(1.0, 2.0), compiled(add)(1, 2)) == (3, 3.0, 3)
    assert len(warned) == 1


def writable(folder):
    folder.chmod(0o777)


def foreign(folder):
    os.chown(folder, 65534, 65534)


@pytest.mark.default_cases(2)
@pytest.mark.parametrize(
    ("place", "change", "reason"),
    [
        ("folder", writable, "is writable by all users"),
        ("folder", lambda folder: folder.chmod(0o1777), "is writable by all users"),
        ("parent", writable, "is writable by all users"),
        ("folder", foreign, "belongs to another user"),
    ],
)
def test_cache_folder_that_others_can_write_is_not_used(
    kernel, place, change, reason, tmp_path
):
    """The pickle in the folder would create a file."""
    cache = kernel.entry._cache
    folder = Path(cache.cache_path)
    index = Path(cache._cache_file._index_path)
    folder.mkdir(exist_ok=True)
    index.write_bytes(
        b"cposix\nsystem\n(S'touch " + os.fsencode(tmp_path / "executed") + b"'\ntR."
    )
    if change is foreign and os.getuid() != 0:
        pytest.skip("only root can give a folder away")
    change(folder if place == "folder" else folder.parent)
    with pytest.warns(
        CacheWarning,
        match=f"{WARNING} .*{reason}.*NUMBA_CACHE_DIR.* only you can write to",
    ) as warned:
        assert (kernel(1, 2), kernel(1.0, 2.0)) == (3, 3.0)
    assert len(warned) == 1 and not (tmp_path / "executed").exists()
    assert list(folder.iterdir()) == [index]


def test_private_folder_in_a_sticky_folder_is_used(kernel, tmp_path):
    Path(kernel.entry._cache.cache_path).parent.chmod(0o1777)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert kernel(1, 2) == 3
    assert list(tmp_path.rglob("*.nbc"))


@pytest.mark.parametrize(
    "damage", [Path.mkdir, Path.touch, lambda path: path.write_bytes(b"junk")]
)
def test_unreadable_index_disables_the_cache(kernel, damage):
    index = Path(kernel.entry._cache._cache_file._index_path)
    index.parent.mkdir(exist_ok=True)
    damage(index)
    with pytest.warns(CacheWarning, match=WARNING) as warned:
        assert kernel(1, 2) == 3
    assert len(warned) == 1


def test_index_that_names_a_removed_function_is_replaced(kernel):
    """Kernels that took a friction law as an argument contain its name, and an edit can remove the law."""
    index = Path(kernel.entry._cache._cache_file._index_path)
    index.parent.mkdir(exist_ok=True)
    index.write_bytes(
        pickle.dumps(numba.__version__) + b"csrs_twin.robot.friction\nremoved\n."
    )
    again = compiled(add)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (kernel(1, 2), again(1, 2)) == (3, 3)
    assert again.entry.stats.cache_hits.total() == 1


SOURCE = """
from srs_twin.compute.compiled import compiled
SLOPE = 2.0
@compiled
def force(x):
    return SLOPE * x
"""
CALLER = """
import force as forces
from force import force
from srs_twin.compute.compiled import compiled
@compiled
def twice(x):
    return force(x) + force(x)
print(twice(1.0), twice.entry.stats.cache_hits.total())
"""


@pytest.mark.slow
def test_inlined_code_invalidates_the_cache_and_comments_do_not(tmp_path):
    def answer(source):
        (tmp_path / "force.py").write_text(source)
        (tmp_path / "caller.py").write_text(CALLER)
        env = os.environ | {
            "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        done = subprocess.run(
            [sys.executable, "caller.py"],
            cwd=tmp_path,
            env=env,
            capture_output=True,
            text=True,
            check=True,
        )
        return tuple(map(float, done.stdout.split()))

    assert answer(SOURCE) == (4.0, 0.0)
    assert answer(SOURCE) == (4.0, 1.0)
    assert answer(
        SOURCE
        + "# a comment, and a function that no kernel calls\ndef other(): return 1\n"
    ) == (
        4.0,
        1.0,
    )
    assert answer(SOURCE.replace("2.0", "3.0")) == (6.0, 0.0)
    assert answer(SOURCE.replace("SLOPE * x", "SLOPE * x * x + 1.0")) == (6.0, 0.0)


PROGRAM = """
from srs_twin.compute.workers import run_tasks
from test_compiled import in_a_worker
import srs_twin.planning.best_first, srs_twin.pneumatics.orifice_kernels
print(sorted(done.result for done in run_tasks(in_a_worker, [1, 2, 3], workers=2)))
"""


def in_a_worker(number):
    """Task that loads kernels."""
    import srs_twin.pneumatics.orifice_kernels as kernels

    assert kernels
    return number


@pytest.mark.slow
def test_missing_cache_folder_is_warned_about_once(tmp_path):
    (tmp_path / "program.py").write_text(PROGRAM)
    done = subprocess.run(
        [sys.executable, "program.py"],
        check=False,
        cwd=tmp_path,
        env=os.environ | NO_FOLDER | {"PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert (done.returncode, done.stdout) == (0, "[1, 2, 3]\n"), done.stderr
    assert done.stderr.count(WARNING) == 1 and "Error" not in done.stderr
    assert (
        "(no writable cache folder exists); set the environment variable"
        " NUMBA_CACHE_DIR to" in done.stderr
    )
