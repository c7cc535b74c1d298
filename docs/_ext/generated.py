"""Sphinx extension that generates parts of pages.

It replaces `<!-- generated: NAME -->` by Markdown generated from the code. In a table
of contents, it includes the entry `PAGE (when written)` if the page exists.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import command_tables
import key_tables

GENERATORS: dict[str, Callable[[], str]] = {
    "scenario keys": key_tables.scenario,
    "sweep keys": key_tables.sweep,
    "robot keys": key_tables.robot,
    "inspect keys": key_tables.inspection,
    "commands": command_tables.commands,
}


def setup(app: Any) -> dict[str, bool]:
    """Register the extension."""
    app.connect("source-read", _generate)
    # These pages depend on the code, so they are outdated even if their files are
    # unchanged.
    app.connect(
        "env-get-outdated",
        lambda _app, env, *_: [p for p in env.all_docs if "/reference/" in p],
    )
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _generate(app: Any, page: str, source: list[str]) -> None:
    folder = Path(app.srcdir, page).parent

    def existing(match: re.Match[str]) -> str:
        return f"{match[1]}\n" if (folder / f"{match[1]}.md").is_file() else ""

    text = re.sub(
        r"^<!-- generated: (.+) -->$",
        lambda match: GENERATORS[match[1]](),
        source[0],
        flags=re.M,
    )
    source[0] = re.sub(r"^(\S+) \(when written\)\n", existing, text, flags=re.M)
