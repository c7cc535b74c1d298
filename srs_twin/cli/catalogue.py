"""`srs-twin list`, `show` and `schema`: what there is, what one of it holds, and what a file may hold."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, get_args

from srs_twin.cli.console import console, new_table
from srs_twin.cli.options import JsonOption, argument, print_json
from srs_twin.errors import UnknownNameError
from srs_twin.extensions import SCHEMAS, installed, load

_KINDS = ("scenarios", "robots", "sweeps", "controllers", "metrics", "studies")
_ALL = _KINDS[:-1]
"""What is listed together: `--json` has these keys, which files of others rely on."""
_SHIPPED = {"scenarios": "scenario", "robots": "robot", "sweeps": "sweep", "studies": "study"}


def list_(
    kind: Annotated[str | None, argument("KIND")] = None,
    as_json: JsonOption = False,
) -> None:
    """List scenarios, robots, studies, metrics and the like.

    Options:
        kind: scenarios, robots, sweeps, controllers, metrics or studies. [default: all but studies]
    """
    if kind is not None and kind not in _KINDS:
        raise UnknownNameError("kind", kind, _KINDS)
    found = {name: list(_listed(name)) for name in (_ALL if kind is None else (kind,))}
    if as_json:
        print_json(found)
        return
    for name, rows in found.items():
        shown = new_table(*(key.replace("name", name) for key in rows[0]), left=range(3))
        shown.columns[-1].no_wrap = False
        for row in rows:
            shown.add_row(*row.values())
        console().print(shown)


def _listed(kind: str) -> Iterator[dict[str, str]]:
    """Yield what there is of a kind: names, and what each is."""
    from srs_twin.io.documents import load_yaml
    from srs_twin.io.files import find, shipped_names

    if kind == "controllers":
        from srs_twin.scenario.file import CONTROLLERS

        for model in CONTROLLERS:
            (name,) = get_args(model.model_fields["kind"].annotation)
            yield {"name": name, "title": " ".join((model.__doc__ or "").split())}
    elif kind == "metrics":
        from srs_twin.comparison.metrics import COMPARISON_UNITS, LIST_METRIC_UNITS, METRIC_UNITS, meanings

        units = METRIC_UNITS | LIST_METRIC_UNITS | COMPARISON_UNITS
        for name, meaning in meanings().items():
            yield {"name": name, "unit": units[name], "meaning": meaning}
    else:
        for name in shipped_names(_SHIPPED[kind]):
            title = load_yaml(find(_SHIPPED[kind], name)).get("title")
            yield {"name": name, "title": title or name}


def show(
    name: Annotated[str, argument("NAME", of=["scenario", "robot"])],
    as_json: JsonOption = False,
) -> None:
    """Show what a scenario or robot holds, and its sources.

    Every default is written out.

    Options:
        name: A shipped scenario or robot, or a file of one.
    """
    document = _resolved(name)
    if as_json:
        print_json(document)
        return
    import textwrap

    from srs_twin.io.documents import dotted
    from srs_twin.io.files import printable

    width = console().width
    for loc, value in _leaves(document):
        text = f"{dotted(loc)}: {_words(value)}"
        if isinstance(value, Mapping):
            unit = "" if value["unit"] == "1" else f" {value['unit']}"
            text = f"{dotted(loc)}: {_words(value['value'])}{unit}; {value['status']}: {value['source']}"
            if doubt := {k: v for k, v in value.get("uncertain", {}).items() if k != "source"}:
                text += f"; uncertain: {' '.join(_words(each) for each in doubt.values())}"
        for line in textwrap.wrap(printable(text), width, subsequent_indent="    ", break_long_words=False):
            print(line)


def _resolved(name: str) -> dict[str, Any]:
    """Return plain data of a scenario, or of a robot where no scenario has the name."""
    from srs_twin.io.documents import load_yaml
    from srs_twin.io.files import existing, shipped_names
    from srs_twin.robot.file import load_robot_file
    from srs_twin.scenario.loading import load_scenario

    robots, scenarios = shipped_names("robot"), shipped_names("scenario")
    a_file = "/" in name or name.endswith((".yaml", ".yml"))
    if a_file:
        from pathlib import Path

        is_robot = load_yaml(existing(Path(name))).get("geometry") is not None
    elif name in (*robots, *scenarios):
        is_robot = name in robots
    else:
        raise UnknownNameError("scenario or robot", name, (*scenarios, *robots), "`srs-twin list`")
    if is_robot:
        return load_robot_file(name).model_dump(mode="json", exclude_none=True)
    return dict(load_scenario(name).document)


def _leaves(data: Any, loc: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], Any]]:
    """Yield path and value of what holds no more blocks; a number with its source is one."""
    block = isinstance(data, Mapping) and "unit" not in data
    if block or (isinstance(data, list) and any(isinstance(each, Mapping) for each in data)):
        for part, value in data.items() if block else enumerate(data):
            yield from _leaves(value, (*loc, part))
    else:
        yield loc, data


def _words(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def schema(
    kind: Annotated[str, argument("KIND")] = "scenario",
) -> None:
    """Print the JSON Schema of input files or results.

    Options:
        kind: Kind of document: scenario, sweep, study, setup or inspect.
    """
    schemas = {"scenario": "srs_twin.scenario:scenario_json_schema"} | installed(SCHEMAS)
    if kind not in schemas:
        raise UnknownNameError("kind of file", kind, schemas)
    print_json(load(schemas[kind])())
