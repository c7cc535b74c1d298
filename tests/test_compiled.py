"""Machine code of kernels is kept where it can be; where not, they run all the same, with one warning."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
from numba.core.caching import IndexDataCacheFile

from srs_twin.compute import compiled as module
from srs_twin.compute.compiled import compiled
from srs_twin.errors import CacheWarning

# numba's own way to be left without any folder: the one kind it may look for is not given.
NOWHERE = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator", "NUMBA_CACHE_DIR": ""}
SAID = "machine code cannot be kept, every start compiles anew"


def add(a, b):
    return a + b


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """A kernel that nobody has called, its machine code in a folder of its own."""
    monkeypatch.setattr(module, "_warned", False)
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path))
    return compiled(add)


def test_what_one_kernel_kept_the_next_loads(kernel):
    again = compiled(add)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (kernel(1, 2), again(1, 2)) == (3, 3)
    assert (again.stats.cache_hits.total(), again.stats.cache_misses.total()) == (1, 0)


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_costs_the_machine_code_and_nothing_else(kernel, monkeypatch):
    monkeypatch.setattr(IndexDataCacheFile, "_save_data", full)
    with pytest.warns(CacheWarning, match=f"{SAID} .*No space left on device") as heard:
        assert (kernel(1, 2), kernel(1.0, 2.0), compiled(add)(1, 2)) == (3, 3.0, 3)
    assert len(heard) == 1


def writable(folder):
    folder.chmod(0o777)


def foreign(folder):
    os.chown(folder, 65534, 65534)


@pytest.mark.parametrize(
    ("where", "change", "words"),
    [
        ("folder", writable, "can be written by all users"),
        ("folder", lambda folder: folder.chmod(0o1777), "can be written by all users"),
        ("parent", writable, "can be written by all users"),
        ("folder", foreign, "belongs to another user"),
    ],
)
def test_machine_code_of_a_folder_that_others_can_write_is_not_loaded(kernel, where, change, words, tmp_path):
    """The pickle there would create a file."""
    cache = kernel._cache
    folder, index = Path(cache.cache_path), Path(cache._cache_file._index_path)
    folder.mkdir(exist_ok=True)
    index.write_bytes(b"cposix\nsystem\n(S'touch " + os.fsencode(tmp_path / "executed") + b"'\ntR.")
    if change is foreign and os.getuid() != 0:
        pytest.skip("only root can give a folder away")
    change(folder if where == "folder" else folder.parent)
    with pytest.warns(CacheWarning, match=f"{SAID} .*{words}.*NUMBA_CACHE_DIR.* only you can write") as heard:
        assert (kernel(1, 2), kernel(1.0, 2.0)) == (3, 3.0)
    assert len(heard) == 1 and not (tmp_path / "executed").exists()
    assert list(folder.iterdir()) == [index]


def test_a_private_folder_within_tmp_is_used(kernel, tmp_path):
    Path(kernel._cache.cache_path).parent.chmod(0o1777)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert kernel(1, 2) == 3
    assert list(tmp_path.rglob("*.nbc"))


@pytest.mark.parametrize("damage", [Path.mkdir, Path.touch, lambda path: path.write_bytes(b"junk")])
def test_an_index_that_cannot_be_read_is_done_without(kernel, damage):
    index = Path(kernel._cache._cache_file._index_path)
    index.parent.mkdir(exist_ok=True)
    damage(index)
    with pytest.warns(CacheWarning, match=SAID) as heard:
        assert kernel(1, 2) == 3
    assert len(heard) == 1


LAW = """
from srs_twin.compute.compiled import compiled
SLOPE = 2.0
@compiled
def law(x):
    return SLOPE * x
"""
CALLER = """
import law as laws
from law import law
from srs_twin.compute.compiled import compiled
@compiled
def twice(x):
    return law(x) + law(x)
print(twice(1.0), twice.stats.cache_hits.total())
"""


@pytest.mark.slow
def test_what_a_kernel_inlines_decides_and_a_comment_does_not(tmp_path):
    def answer(law):
        (tmp_path / "law.py").write_text(law)
        (tmp_path / "caller.py").write_text(CALLER)
        env = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "kept"), "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(
            [sys.executable, "caller.py"], cwd=tmp_path, env=env, capture_output=True, text=True, check=True
        )
        return tuple(map(float, done.stdout.split()))

    assert answer(LAW) == (4.0, 0.0)
    assert answer(LAW) == (4.0, 1.0)
    assert answer(LAW + "# a comment, and a function that no kernel knows\ndef other(): return 1\n") == (
        4.0,
        1.0,
    )
    assert answer(LAW.replace("2.0", "3.0")) == (6.0, 0.0)
    assert answer(LAW.replace("SLOPE * x", "SLOPE * x * x + 1.0")) == (6.0, 0.0)


PROGRAM = """
from srs_twin.compute.workers import each
from test_compiled import in_a_worker
import srs_twin.planning.search_kernels, srs_twin.pneumatics.orifice_kernels
print(sorted(done.result for done in each(in_a_worker, [1, 2, 3], workers=2)))
"""


def in_a_worker(number):
    """A task that loads kernels."""
    import srs_twin.pneumatics.orifice_kernels as kernels

    assert kernels
    return number


@pytest.mark.slow
def test_without_a_folder_one_process_says_it_once_and_workers_do_not(tmp_path):
    (tmp_path / "program.py").write_text(PROGRAM)
    done = subprocess.run(
        [sys.executable, "program.py"],
        cwd=tmp_path, env=os.environ | NOWHERE | {"PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert (done.returncode, done.stdout) == (0, "[1, 2, 3]\n"), done.stderr
    assert done.stderr.count(SAID) == 1 and "Error" not in done.stderr


@pytest.mark.slow
def test_a_command_goes_on_and_says_it_in_a_line(tmp_path, srs_twin_process):
    """As far as one gets without compiling anything, which takes half a minute."""
    done = srs_twin_process("sweep", "fig41", "-q", "--out", "/dev/null/x", cwd=tmp_path, **NOWHERE)
    first, second = done.stderr.splitlines()
    assert first.startswith(f"warning: {SAID} (no folder for it can be written); set NUMBA_CACHE_DIR to")
    assert (done.returncode, second.partition(" (")[0]) == (2, "/dev/null/x: cannot write there")
