"""Sphinx extension for docstrings: display maths in `$$ … $$`, and units that look like list items."""

from __future__ import annotations

import re
from typing import Any


def setup(app: Any) -> dict[str, bool]:
    """Register the extension."""
    app.connect("autodoc-process-docstring", _process, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _process(
    app: Any, kind: str, name: str, documented: Any, options: Any, lines: list[str]
) -> None:
    def directive(match: re.Match[str]) -> str:
        body = "\n".join(f"   {line.strip()}" for line in match[1].strip().splitlines())
        return f"\n\n.. math::\n\n{body}\n\n"

    # Escape the dot of a single letter, e.g. "s.", which would start an enumeration.
    lines[:] = [re.sub(r"(^|: )([A-Za-z])\.$", r"\1\\\2.", line) for line in lines]
    lines[:] = re.sub(
        r"^ *\$\$(.+?)\$\$ *$", directive, "\n".join(lines), flags=re.S | re.M
    ).splitlines()
