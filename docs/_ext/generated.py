"""What changes in a page when it is read.

`<!-- generated: NAME -->` becomes Markdown made from the code. In a table of contents, `PAGE (when written)`
counts as soon as there is such a page.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import command_tables
import key_tables

PARTS: dict[str, Callable[[], str]] = {
    "scenario keys": key_tables.scenario,
    "sweep keys": key_tables.sweep,
    "robot keys": key_tables.robot,
    "inspect keys": key_tables.inspection,
    "commands": command_tables.commands,
}


def setup(app: Any) -> dict[str, bool]:
    """Take part in the reading of pages."""
    app.connect("source-read", _filled)
    # Made from the code, these pages may differ though their files do not.
    app.connect("env-get-outdated", lambda _app, env, *_: [p for p in env.all_docs if "/reference/" in p])
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _filled(app: Any, page: str, source: list[str]) -> None:
    folder = Path(app.srcdir, page).parent

    def written(found: re.Match[str]) -> str:
        return f"{found[1]}\n" if (folder / f"{found[1]}.md").is_file() else ""

    text = re.sub(r"^<!-- generated: (.+) -->$", lambda found: PARTS[found[1]](), source[0], flags=re.M)
    source[0] = re.sub(r"^(\S+) \(when written\)\n", written, text, flags=re.M)
