"""Typer application with the commands of the core and of the extensions."""

from __future__ import annotations

import os
from functools import cache
from typing import Annotated, Any

import typer

from srs_twin import __version__
from srs_twin.cli import models, new
from srs_twin.cli.catalogue import list_, schema, show
from srs_twin.cli.console import DEBUG
from srs_twin.cli.diff import diff
from srs_twin.cli.doctor import doctor
from srs_twin.cli.options import expand_option_groups, option
from srs_twin.cli.run import compare, run
from srs_twin.cli.view import play, render, view
from srs_twin.extensions import COMMANDS, objects

# Help and usage errors are plain text: the boxes of rich break file names across lines,
# and its import would double the duration of `--help`.
app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_CORE_COMMANDS = {
    "list": list_,
    "show": show,
    "run": run,
    "compare": compare,
    "view": view,
    "play": play,
    "render": render,
    "diff": diff,
    "schema": schema,
    "doctor": doctor,
    "models": models.app,
    "new": new.app,
}
_HELP_ORDER = (
    *(
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
    ),
    *(
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
    ),
    *("calibrate", "models", "new"),
)
"""Order of the commands in the help; other commands come last."""


_WITHOUT_PLUGINS = (
    "view",
    "render",
    "diff",
    "export",
    "schema",
    "doctor",
    "reproduce",
    "emulate",
)
"""Commands that read finished runs or no files of the user; they never import parts from outside."""


def _add_commands() -> None:
    commands: dict[str, Any] = _CORE_COMMANDS | dict(objects(COMMANDS))
    position = {name: index for index, name in enumerate(_HELP_ORDER)}
    for name in sorted(commands, key=lambda name: position.get(name, len(position))):
        if isinstance(commands[name], typer.Typer):
            app.add_typer(commands[name], name=name)
        else:
            app.command(name)(
                expand_option_groups(
                    commands[name], plugins=name not in _WITHOUT_PLUGINS
                )
            )


_add_commands()


@cache
def command() -> Any:
    """Return the click command of the application, built once; call it with ``args`` and ``prog_name``."""
    return typer.main.get_command(app)


def _print_version(requested: bool) -> None:
    if requested:
        typer.echo(f"srs-twin {__version__}")
        raise typer.Exit


@app.callback()
def options(
    debug: Annotated[
        bool, option("--debug", f"Show the traceback of an error (or set {DEBUG}=1).")
    ] = False,
    version: Annotated[
        bool,
        option(
            "--version", "Print the version.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Simulate a soft robotic snake: equal valve commands drive an analytical model and a MuJoCo twin.

    Texts name pages as docs/NAME.md; `srs-twin show docs/NAME.md` prints one.
    """
    if debug:
        os.environ[DEBUG] = "1"
