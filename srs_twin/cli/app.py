"""Puts the verbs together. Importing this costs typer and nothing else."""

from __future__ import annotations

import os
from typing import Annotated, Any

import typer

from srs_twin import __version__
from srs_twin.cli import (
    DEBUG,
    calibrate,
    diff,
    doctor,
    models,
    plan,
    play,
    render,
    replay,
    reproduce,
    run,
    schema,
    sweep,
    view,
)
from srs_twin.cli.options import option, with_options

# Without rich's markup, help and usage errors are plain text: its boxes break file names over lines, and
# importing it would double the time that `--help` takes.
app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command()(with_options(run.run))
app.command()(with_options(run.compare))
app.command()(with_options(plan.plan))
app.command()(with_options(replay.replay))
app.command()(with_options(sweep.sweep))
app.command()(with_options(reproduce.reproduce))
app.command()(with_options(view.view))
app.command()(with_options(play.play))
app.command()(with_options(render.render))
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(models.app, name="models")
app.command()(with_options(diff.diff))
app.command()(with_options(schema.schema))
app.command()(with_options(doctor.doctor))


def command() -> Any:
    """Return the whole command, to be called with ``args`` and ``prog_name``."""
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
