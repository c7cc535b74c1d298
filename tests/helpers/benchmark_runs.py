"""Runs of the scripts in benchmarks/ and tools/."""

from __future__ import annotations

import subprocess
import sys

from conftest import ROOT


def run_benchmark(script: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Run a script of benchmarks/ in a separate process and capture its output."""
    return run_script(f"benchmarks/{script}", *options)


def run_script(script: str, *options: str) -> subprocess.CompletedProcess[str]:
    """Run a Python script of the checkout in a separate process and capture its output."""
    words = [sys.executable, str(ROOT / script), *options]
    return subprocess.run(
        words, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False
    )
