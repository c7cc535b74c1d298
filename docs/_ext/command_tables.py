"""Reference of all commands, generated from the command line."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from key_tables import row

from srs_twin.cli.app import command


def commands() -> str:
    """Return one section per command in the order of `--help`, and the global options."""
    root = command()
    sections = list(_sections("srs-twin", root))
    context = root.make_context("srs-twin", [], resilient_parsing=True)
    return "\n\n".join(
        [*sections[1:], "## Global options", _table(root, context, "option")]
    )


def _sections(path: str, command: Any) -> Iterator[str]:
    """Yield the section of a command and those of its subcommands.

    Args:
        path: full name of the command, e.g. "srs-twin models export".
        command: click command.
    """
    subcommands = getattr(command, "commands", {})
    context = command.make_context(path, [], resilient_parsing=True)
    description = " ".join((command.help or "").split())
    blocks = [f"{'##' if path.count(' ') < 2 else '###'} {path}", description]
    if not subcommands:
        blocks.append(
            "```text\n"
            + " ".join([path, *command.collect_usage_pieces(context)])
            + "\n```"
        )
        blocks += [
            table
            for kind in ("argument", "option")
            if (table := _table(command, context, kind))
        ]
    yield "\n\n".join(blocks)
    for name, subcommand in subcommands.items():
        yield from _sections(f"{path} {name}", subcommand)


def _table(command: Any, context: Any, kind: str) -> str:
    """Return the help of the arguments or options of a command as a table."""
    parameters = [
        parameter for parameter in command.params if parameter.param_type_name == kind
    ]
    records = filter(
        None, (parameter.get_help_record(context) for parameter in parameters)
    )
    rows = [row(f"`{name.strip()}`", _mark_options(text)) for name, text in records]
    return "\n".join([f"| {kind} | meaning |", "|---|---|", *rows]) if rows else ""


def _mark_options(text: str) -> str:
    """Return a help text in one line with options in code font, so that their hyphens are kept."""
    return re.sub(r"(?<!\S)--[\w=.,-]*\w", r"`\g<0>`", " ".join(text.split()))
