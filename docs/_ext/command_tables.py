"""Every command with its arguments and options, from the command line itself."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from key_tables import row

from srs_twin.cli.app import command


def commands() -> str:
    """Return a section for each command, as `--help` lists them; then the options of all."""
    whole = command()
    sections = list(_sections("srs-twin", whole))
    context = whole.make_context("srs-twin", [], resilient_parsing=True)
    return "\n\n".join([*sections[1:], "## Options of all", _table(whole, context, "option")])


def _sections(words: str, given: Any) -> Iterator[str]:
    inner = getattr(given, "commands", {})
    context = given.make_context(words, [], resilient_parsing=True)
    text = " ".join((given.help or "").split())
    parts = [f"{'##' if words.count(' ') < 2 else '###'} {words}", text]
    if not inner:
        parts.append("```text\n" + " ".join([words, *given.collect_usage_pieces(context)]) + "\n```")
        parts += [table for kind in ("argument", "option") if (table := _table(given, context, kind))]
    yield "\n\n".join(parts)
    for name, each in inner.items():
        yield from _sections(f"{words} {name}", each)


def _table(given: Any, context: Any, kind: str) -> str:
    """Return what `--help` says of the arguments or the options, as a table."""
    records = [each.get_help_record(context) for each in given.params if each.param_type_name == kind]
    rows = [row(f"`{name.strip()}`", _told(text)) for name, text in filter(None, records)]
    return "\n".join([f"| {kind} | |", "|---|---|", *rows]) if rows else ""


def _told(text: str) -> str:
    """Return a help text on one line, options in it as code: dashes would become one long one."""
    return re.sub(r"(?<!\S)--[\w=.,-]*\w", r"`\g<0>`", " ".join(text.split()))
