"""dm_env environments, on the versions of Python for which dm-control can be installed."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

import pytest


def dm_environments() -> ModuleType:
    """Return `srs_twin.envs.dm`; skip a test or module on versions of Python without dm-control."""
    if sys.version_info >= (3, 13):
        pytest.skip(
            "labmaze, which dm-control requires, has no wheel for Python 3.13",
            allow_module_level=True,
        )
    return importlib.import_module("srs_twin.envs.dm")
