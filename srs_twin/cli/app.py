"""Puts the verbs together. Importing this costs typer and nothing else."""

from __future__ import annotations

import os
from functools import cache
from typing import Annotated, Any

import typer

from srs_twin import __version__
from srs_twin.cli import calibrate, models
from srs_twin.cli.catalogue import list_, schema, show
from srs_twin.cli.console import DEBUG
from srs_twin.cli.diff import diff
from srs_twin.cli.doctor import doctor
from srs_twin.cli.emulate import emulate
from srs_twin.cli.inspect import inspect
from srs_twin.cli.optimize import optimize
from srs_twin.cli.options import option, with_options
from srs_twin.cli.plan import plan
from srs_twin.cli.render import render
from srs_twin.cli.replay import replay
from srs_twin.cli.reproduce import reproduce
from srs_twin.cli.run import compare, run
from srs_twin.cli.shadow import shadow
from srs_twin.cli.sweep import sweep
from srs_twin.cli.uncertainty import uncertainty
from srs_twin.cli.view import play, view

# Without rich's markup, help and usage errors are plain text: its boxes break file names over lines, and
# importing it would double the time that `--help` takes.
app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
verbs = (
    list_,
    show,
    inspect,
    run,
    compare,
    plan,
    replay,
    sweep,
    optimize,
    uncertainty,
    reproduce,
    view,
    play,
    emulate,
    shadow,
    render,
    diff,
    schema,
    doctor,
)
for verb in verbs:
    app.command(verb.__name__.rstrip("_"))(with_options(verb))
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(models.app, name="models")


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
