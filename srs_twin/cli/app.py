"""The command line, put together from the commands of the core and of the extensions."""

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
from srs_twin.cli.doctor.command import doctor
from srs_twin.cli.options import option, with_options
from srs_twin.cli.render import render
from srs_twin.cli.run import compare, run
from srs_twin.cli.view import play, view
from srs_twin.extensions import COMMANDS, objects

# Without rich's markup, help and usage errors are plain text: its boxes break file names over lines, and
# importing it would double the time that `--help` takes.
app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_CORE = {
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
_ORDER = (
    *("list", "show", "inspect", "run", "compare", "plan", "replay", "sweep", "optimize", "uncertainty"),
    *("reproduce", "view", "play", "emulate", "shadow", "render", "export", "diff", "schema", "doctor"),
    *("calibrate", "models", "new"),
)
"""Order in the help; other commands come last."""


def _add_commands() -> None:
    commands: dict[str, Any] = _CORE | dict(objects(COMMANDS))
    for name in sorted(commands, key=lambda name: _ORDER.index(name) if name in _ORDER else len(_ORDER)):
        if isinstance(commands[name], typer.Typer):
            app.add_typer(commands[name], name=name)
        else:
            app.command(name)(with_options(commands[name]))


_add_commands()


@cache
def command() -> Any:
    """Return the whole command, to be called with ``args`` and ``prog_name``; it is put together once."""
    return typer.main.get_command(app)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"srs-twin {__version__}")
        raise typer.Exit


@app.callback()
def options(
    debug: Annotated[bool, option("--debug", f"Show the traceback of an error (also {DEBUG}=1).")] = False,
    version: Annotated[
        bool, option("--version", "Print the version.", callback=_version, is_eager=True)
    ] = False,
) -> None:
    """Soft robotic snake: the same valve commands drive an analytical model and a MuJoCo twin."""
    if debug:
        os.environ[DEBUG] = "1"
