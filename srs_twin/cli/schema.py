"""`srs-twin schema`: the JSON Schema of the files that a person writes, for editors."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from srs_twin.cli.options import argument
from srs_twin.errors import UnknownNameError

_KINDS = ("scenario", "sweep")


def schema(
    kind: Annotated[str, argument("KIND")] = "scenario",
) -> None:
    """Print the JSON Schema of scenario files, or of sweep files.

    Options:
        kind: Of which files: scenario or sweep.
    """
    if kind not in _KINDS:
        raise UnknownNameError("kind of file", kind, _KINDS)
    if kind == "sweep":
        from srs_twin.sweep.file import sweep_json_schema

        found = sweep_json_schema()
    else:
        from srs_twin.scenario import scenario_json_schema

        found = scenario_json_schema()
    typer.echo(json.dumps(found, indent=2))
