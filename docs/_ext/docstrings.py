"""Docstrings for Sphinx: formulas, `$$ … $$` as in Markdown, and units that look like list items."""

from __future__ import annotations

import re
from typing import Any


def setup(app: Any) -> dict[str, bool]:
    """Take part in the reading of docstrings."""
    app.connect("autodoc-process-docstring", _read, priority=100)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _read(app: Any, what: str, name: str, given: Any, options: Any, lines: list[str]) -> None:
    def directive(found: re.Match[str]) -> str:
        body = "\n".join(f"   {line.strip()}" for line in found[1].strip().splitlines())
        return f"\n\n.. math::\n\n{body}\n\n"

    # "s." alone would begin an enumeration.
    lines[:] = [re.sub(r"(^|: )([A-Za-z])\.$", r"\1\\\2.", line) for line in lines]
    lines[:] = re.sub(r"^ *\$\$(.+?)\$\$ *$", directive, "\n".join(lines), flags=re.S | re.M).splitlines()
