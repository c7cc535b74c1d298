"""Typer application with the core commands and the commands of extensions."""

from __future__ import annotations

import os
from functools import cache
from typing import Annotated, Any

import typer

from srs_twin import __version__
from srs_twin.cli.console import DEBUG
from srs_twin.cli.options import expand_option_groups, option
from srs_twin.extensions import COMMANDS, installed, load

_CORE_COMMANDS = {
    "list": "srs_twin.cli.catalogue:list_",
    "show": "srs_twin.cli.catalogue:show",
    "run": "srs_twin.cli.run:run",
    "compare": "srs_twin.cli.run:compare",
    "view": "srs_twin.cli.view:view",
    "play": "srs_twin.cli.view:play",
    "render": "srs_twin.cli.view:render",
    "diff": "srs_twin.cli.diff:diff",
    "schema": "srs_twin.cli.catalogue:schema",
    "doctor": "srs_twin.cli.doctor:doctor",
    "models": "srs_twin.cli.models:app",
    "new": "srs_twin.cli.new:app",
}
"""Core commands, in the same format as `extensions.COMMANDS`."""

_HELP_ORDER = [
    "list",
    "show",
    "inspect",
    "run",
    "compare",
    "plan",
    "replay",
    "sweep",
    "optimize",
    "uncertainty",
    "reproduce",
    "view",
    "play",
    "emulate",
    "shadow",
    "render",
    "export",
    "diff",
    "schema",
    "doctor",
    "calibrate",
    "models",
    "new",
]
"""Commands that the help lists first, in this order."""

_WITHOUT_PLUGINS = [
    "view",
    "render",
    "diff",
    "export",
    "schema",
    "doctor",
    "reproduce",
    "emulate",
]
"""Commands without the option `--plugin`."""


@cache
def command(only: str = "") -> Any:
    """Return the Click command of the application.

    If `only` is the name of a command, no other command is imported.
    """
    # Help and usage errors are printed without rich, because its boxes break file names
    # across lines and its import would double the duration of `--help`.
    app = typer.Typer(
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_options)
    entries = _CORE_COMMANDS | installed(COMMANDS)
    names = [only]
    if only not in entries:
        names = [name for name in _HELP_ORDER if name in entries]
        names += sorted(entries.keys() - names)
    for name in names:
        found = load(entries[name])
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=name)
        else:
            plugins = name not in _WITHOUT_PLUGINS
            app.command(name)(expand_option_groups(found, plugins=plugins))
    return typer.main.get_command(app)


def _print_version(requested: bool) -> None:
    if requested:
        typer.echo(f"srs-twin {__version__}")
        raise typer.Exit


def _options(
    debug: Annotated[
        bool,
        option("--debug", f"Print tracebacks of errors. Same as {DEBUG}=1."),
    ] = False,
    version: Annotated[
        bool,
        option(
            "--version",
            "Print the version and exit.",
            callback=_print_version,
            is_eager=True,
        ),
    ] = False,
) -> None:
    """Simulate a soft robotic snake with an analytical model and a MuJoCo twin.

    Both models accept the same valve commands. Messages refer to documentation pages as
    docs/NAME.md, which you can print with `srs-twin show docs/NAME.md`.
    """
    if debug:
        os.environ[DEBUG] = "1"
