"""Do the tests notice? Each fault of faults.yaml is put into a copy of the sources; its tests must fail."""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from ruamel.yaml import YAML

ROOT = Path(__file__).parents[1]
FOLDERS = ("srs_twin", "tests", "benchmarks", "docs", "models", "calibration", "scenarios")
FILES = ("pyproject.toml", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "Containerfile", "LICENSE")


def main() -> None:
    """Put each fault in, run its tests, take it out again; exit with 1 where one went unnoticed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", default="", help="part of the names of the faults to try")
    only = parser.parse_args().only
    listed = YAML(typ="safe").load(ROOT / "benchmarks/faults.yaml")
    faults = [fault for fault in listed if only in fault["name"]]
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in FOLDERS:
            shutil.copytree(ROOT / name, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        for name in FILES:
            shutil.copy(ROOT / name, copy)
        unnoticed = [fault["name"] for fault in faults if not noticed(copy, **fault)]
    print(f"{len(unnoticed)} of {len(faults)} faults unnoticed: {', '.join(unnoticed) or 'none'}")
    sys.exit(bool(unnoticed))


def noticed(copy: Path, name: str, file: str, old: str, new: str, tests: str) -> bool:
    """Whether the tests of a fault fail with it; a fault whose place is gone counts as unnoticed."""
    source = copy / file
    text = source.read_text("utf-8")
    if text.count(old) != 1:
        print(f"{name}: {file} holds its line {text.count(old)} times", flush=True)
        return False
    source.write_text(text.replace(old, new), "utf-8")
    pytest = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "0", "-p", "no:cacheprovider", "-m", ""]
    environment = os.environ | {"PYTHONPATH": str(copy), "NUMBA_CACHE_DIR": str(copy / "machine-code")}
    done = subprocess.run(
        [*pytest, *tests.split()], cwd=copy, env=environment, capture_output=True, text=True, timeout=1800
    )
    source.write_text(text, "utf-8")
    failed = next((line for line in done.stdout.splitlines() if line.startswith("FAILED")), "")
    print(f"{name}: {failed.partition(' - ')[0] or f'pytest ended with {done.returncode}'}", flush=True)
    return done.returncode == 1 and bool(failed)


if __name__ == "__main__":
    main()
