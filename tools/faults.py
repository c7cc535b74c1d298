"""Fault injection: each fault of faults.yaml is put into a copy of the sources, and its tests must fail."""

from __future__ import annotations

import argparse
import functools
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Insert each fault, run its tests and remove it; exit with 1 if a fault is not detected."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument(
        "--only", default="", help="only faults whose name contains one of these words"
    )
    only = parser.parse_args().only
    listed = yaml.safe_load((ROOT / "tools/faults.yaml").read_text("utf-8"))
    faults = [fault for fault in listed if only in fault["name"]]
    with tempfile.TemporaryDirectory() as folder:
        copy = copied_to(Path(folder) / "copy")
        unnoticed = [fault["name"] for fault in faults if not noticed(copy, **fault)]
    print(
        f"{len(unnoticed)} of {len(faults)} faults not detected:"
        f" {', '.join(unnoticed) or 'none'}"
    )
    sys.exit(bool(unnoticed))


def noticed(copy: Path, name: str, file: str, old: str, new: str, tests: str) -> bool:
    """Return whether the tests of a fault fail; False if the file no longer contains the original line."""
    source = copy / file
    text = source.read_text("utf-8")
    if text.count(old) != 1:
        print(f"{name}: {file} holds its line {text.count(old)} times", flush=True)
        return False
    source.write_text(text.replace(old, new), "utf-8")
    failed = first_failure(copy, ["-n", "0", "-m", "", *tests.split()])
    source.write_text(text, "utf-8")
    print(f"{name}: {failed or 'no test fails'}", flush=True)
    return failed is not None


def copied_to(folder: Path) -> Path:
    """Copy the files of the checkout, including uncommitted changes, into a folder; return the folder."""
    listed = subprocess.run(
        ["git", "ls-files", "-zco", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def first_failure(copy: Path, words: list[str]) -> str | None:
    """Run pytest in a copy until the first failure; return the failed test, or None if all pass."""
    return next(iter(failures(copy, ["-x", *words])), None)


def failures(copy: Path, words: list[str], cpu_s: int = 1800) -> list[str]:
    """Run pytest in a copy and return the failed tests.

    Args:
        copy: folder of the copy, which also keeps the compiled kernels.
        words: test files and options.
        cpu_s: limit on the processor time of one process, s.

    Returns:
        Names of the tests, or one message if pytest itself failed.
    """
    pytest = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-rfE",
        "-p",
        "no:cacheprovider",
        *words,
    ]
    environment = os.environ | {
        "PYTHONPATH": str(copy),
        "NUMBA_CACHE_DIR": str(copy / "machine-code"),
    }
    limit = functools.partial(resource.setrlimit, resource.RLIMIT_CPU, (cpu_s, cpu_s))
    done = subprocess.run(
        pytest,
        cwd=copy,
        env=environment,
        capture_output=True,
        text=True,
        preexec_fn=limit,
        check=False,
    )
    if done.returncode == 0:
        return []
    lines = [
        line
        for line in done.stdout.splitlines()
        if line.startswith(("FAILED", "ERROR"))
    ]
    if lines:
        return [line.split(" ", 1)[1].partition(" - ")[0] for line in lines]
    return [f"pytest ended with {done.returncode}"]


if __name__ == "__main__":
    main()
