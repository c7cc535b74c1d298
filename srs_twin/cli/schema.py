"""`srs-twin schema`: the JSON Schema of a scenario file, for editors."""

from __future__ import annotations

import json

import typer


def schema() -> None:
    """Print the JSON Schema of scenario files."""
    from srs_twin.scenario import scenario_json_schema

    typer.echo(json.dumps(scenario_json_schema(), indent=2))
