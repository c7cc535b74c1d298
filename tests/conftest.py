"""What many tests share: the command line as a person starts it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

ROOT = Path(__file__).parents[1]

# Wall-clock deadlines of single examples fail on a busy machine and say nothing about the code.
settings.register_profile("srs_twin", deadline=None, print_blob=True)
settings.load_profile("srs_twin")

Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="session")
def root() -> Path:
    """The checkout."""
    return ROOT


@pytest.fixture(scope="session")
def srs_twin() -> Command:
    """Start the installed `srs-twin` in a folder: srs_twin("run", "x", cwd=tmp_path)."""
    script = Path(sys.executable).with_name("srs-twin")

    def start(*words: str, cwd: Path, **env: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(script), *words],
            cwd=cwd,
            env={**os.environ, **env},
            capture_output=True,
            text=True,
            timeout=300,
        )

    return start
