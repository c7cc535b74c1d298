"""Registry of what the core looks up by name.

An entry is ``name: "module:object"``. The module is imported when the object is asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

PAGES = {"html": "srs_twin.viewing.html.report:shown"}
"""Pages of results in notebooks."""


def load(entry: str) -> Any:
    """Import the object of an entry, ``module:object``."""
    module, _, name = entry.partition(":")
    return getattr(import_module(module), name)
