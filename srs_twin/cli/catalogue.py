"""Commands `srs-twin list`, `show` and `schema`."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from typing import Annotated, Any

from srs_twin.cli.console import as_started, console, launcher
from srs_twin.cli.options import JsonOption, argument, print_json
from srs_twin.errors import UnknownNameError
from srs_twin.extensions import SCHEMAS, installed, load, plugins, reading

_KINDS = ("scenarios", "robots", "sweeps", "controllers", "metrics", "studies")
_DEFAULT_KINDS = _KINDS[:-1]
"""Kinds that `list --json` prints by default, as part of the public interface."""

_BEGINNING = {
    "gen2_straight": (
        "crawl straight ahead; both plants, their difference and its cause"
    ),
    "gen2_turn": "turn, and see where the plants differ",
    "follow_fig57": "plan a path among obstacles and follow it",
    "ilc_straight": "learn to crawl straight with unequal modules",
    "module_step_direct": "control the bend of one module",
    "sensor_up": "read a curvature sensor",
}
"""Descriptions of scenarios for new users, at most one in each group."""

_GROUPS = {
    "crawl": r"(gen\d|skin)_(straight|climb)",
    "turn": r"gen\d_turn",
    "plan and follow": "(plan|follow)_.*",
    "learn": "ilc_.*",
    "one module": "module_.*",
    "sensor": "sensor_.*",
    "touch and move objects": "(pegs|push|grasp)_.*",
    "three dimensions": "spatial_.*",
}
"""Patterns of the scenario names in each group, keyed by group title."""

_FILE_KINDS = {
    "scenarios": "scenario",
    "robots": "robot",
    "sweeps": "sweep",
    "studies": "study",
}
"""Names used by `shipped_names`, keyed by the kind of file."""

_PRINTED_KINDS = (*_FILE_KINDS, "controllers")
"""Kinds that `list` prints by default."""


def list_(
    kind: Annotated[str | None, argument("KIND")] = None,
    as_json: JsonOption = False,
) -> None:
    """List scenarios, robots, sweeps, studies and controllers.

    The list begins with six scenarios for new users.

    Options:
        kind: What to list: scenarios, robots, sweeps, controllers, metrics or studies.
            [default: all except metrics]
    """
    if kind is not None and kind not in _KINDS:
        raise UnknownNameError("kind", kind, _KINDS)
    if as_json:
        kinds = _DEFAULT_KINDS if kind is None else (kind,)
        print_json({name: list(_rows(name)) for name in kinds})
        return
    for name in _PRINTED_KINDS if kind is None else (kind,):
        rows = list(_rows(name))
        if name == "scenarios":
            _print_scenarios(rows)
        else:
            _print_rows(name.capitalize(), rows)
    if kind is None:
        hint = (
            "`srs-twin list metrics` lists the metrics, and `srs-twin show NAME` shows"
            " the values in a file."
        )
        print(as_started(hint))


def _print_scenarios(rows: Sequence[Mapping[str, str]]) -> None:
    beginning = [{"name": name, "title": text} for name, text in _BEGINNING.items()]
    _print_rows(
        f"Scenarios to begin with ({launcher()}srs-twin compare NAME)", beginning
    )
    for title, group in scenario_groups(rows).items():
        _print_rows(f"Scenarios: {title} ({len(group)})", group)


def scenario_groups(
    rows: Iterable[Mapping[str, str]],
) -> dict[str, list[Mapping[str, str]]]:
    """Return the scenarios of each group, keyed by group title."""
    groups: dict[str, list[Mapping[str, str]]] = {}
    for row in rows:
        titles = (
            title
            for title, pattern in _GROUPS.items()
            if re.fullmatch(pattern, row["name"])
        )
        groups.setdefault(next(titles, "other"), []).append(row)
    return {title: groups[title] for title in (*_GROUPS, "other") if title in groups}


def _print_rows(heading: str, rows: Sequence[Mapping[str, str]]) -> None:
    cells = [[*row.values()] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)][:-1]
    print(heading)
    for row in cells:
        begin = "  " + "".join(
            f"{text:<{width}}  " for text, width in zip(row, widths, strict=False)
        )
        rest = " " * len(begin)
        for line in textwrap.wrap(
            begin + row[-1], console().width, subsequent_indent=rest
        ):
            print(line)
    print()


def _rows(kind: str) -> Iterator[dict[str, str]]:
    from srs_twin.io.documents import load_yaml
    from srs_twin.io.files import find_file, shipped_names

    if kind == "controllers":
        from srs_twin.scenario.file import controller_kinds

        for name, model in controller_kinds().items():
            yield {"name": name, "title": " ".join((model.__doc__ or "").split())}
    elif kind == "metrics":
        from srs_twin.comparison.metrics import all_units, meanings

        units = all_units()
        for name, meaning in meanings().items():
            yield {"name": name, "unit": units[name], "meaning": meaning}
    else:
        for name in shipped_names(_FILE_KINDS[kind]):
            title = load_yaml(find_file(_FILE_KINDS[kind], name)).get("title")
            yield {"name": name, "title": title or name}


def show(
    name: Annotated[str, argument("NAME", shipped=["scenario", "robot"])],
    as_json: JsonOption = False,
) -> None:
    """Show a scenario, a robot or a documentation page.

    The command prints all values of a scenario or robot, including default values, with
    units and sources.

    Options:
        name: Name of a shipped scenario or robot, path of a scenario or robot file, or
            a documentation page such as docs/planar-models.md.
    """
    page = name.partition("#")[0]
    if page.endswith(".md"):
        from srs_twin.io.files import data_root, read_text

        print(read_text(data_root() / page), end="")
        return
    document = _resolved(name)
    if as_json:
        print_json(document)
        return
    from srs_twin.io.documents import format_path
    from srs_twin.io.files import escape_unprintable

    width = console().width
    for loc, value in _leaves(document):
        text = f"{format_path(loc)}: {_text(value)}"
        if isinstance(value, Mapping):
            unit = "" if value["unit"] == "1" else f" {value['unit']}"
            text = (
                f"{format_path(loc)}: {_text(value['value'])}{unit}; {value['status']}:"
                f" {value['source']}"
            )
            if prior := {
                k: v for k, v in value.get("uncertain", {}).items() if k != "source"
            }:
                text += f"; uncertain: {' '.join(map(_text, prior.values()))}"
        for line in textwrap.wrap(
            escape_unprintable(text),
            width,
            subsequent_indent="    ",
            break_long_words=False,
        ):
            print(line)


def _resolved(name: str) -> dict[str, object]:
    from srs_twin.robot.file import load_robot_file
    from srs_twin.scenario.loading import load_scenario

    if is_robot(name):
        return load_robot_file(name).model_dump(mode="json", exclude_none=True)
    with nullcontext() if plugins() else reading():
        return dict(load_scenario(name).document)


def is_robot(name: str) -> bool:
    """Return whether a name or path refers to a robot rather than a scenario.

    Raises:
        InputError: no shipped file has this name, or the file does not exist.
    """
    from srs_twin.io.documents import load_yaml
    from srs_twin.io.files import is_path, require_file, shipped_names

    if is_path(name):
        from pathlib import Path

        document = load_yaml(require_file(Path(name)))
        return document.get("geometry") is not None or document.get("base") is not None
    robots = shipped_names("robot")
    scenarios = shipped_names("scenario")
    if name not in (*robots, *scenarios):
        raise UnknownNameError(
            "scenario or robot", name, (*scenarios, *robots), "`srs-twin list`"
        )
    return name in robots


def _leaves(
    data: Any, loc: tuple[str | int, ...] = ()
) -> Iterator[tuple[tuple[str | int, ...], object]]:
    """Yield the path and the value of each leaf in nested data.

    A value with a unit and a source counts as a single leaf.
    """
    is_block = isinstance(data, Mapping) and "unit" not in data
    if is_block or (
        isinstance(data, list) and any(isinstance(item, Mapping) for item in data)
    ):
        for key, value in data.items() if is_block else enumerate(data):
            yield from _leaves(value, (*loc, key))
    else:
        yield loc, data


def _text(value: object) -> str:
    if isinstance(value, str):
        return value
    return json.dumps(value)


def schema(
    kind: Annotated[str, argument("KIND")] = "scenario",
) -> None:
    """Print the JSON Schema of an input file or output document.

    Options:
        kind: Kind of document: scenario, sweep, study, setup or inspect.
    """
    schemas = {"scenario": "srs_twin.scenario:scenario_json_schema"} | installed(
        SCHEMAS
    )
    if kind not in schemas:
        raise UnknownNameError("kind of file", kind, schemas)
    print_json(load(schemas[kind])())
