"""Robots by name, by path, or as a scenario changes them."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from srs_twin.documents import Document, Loc, load_yaml
from srs_twin.errors import InputError, InputFileError
from srs_twin.files import find
from srs_twin.robot_file import RobotFile, units_of
from srs_twin.sourced import Record, restated
from srs_twin.validation import validate


def load_robot_file(name_or_path: str | os.PathLike[str]) -> RobotFile:
    """Load and check a robot file.

    Raises:
        InputError: not found or not readable.
        InputFileError: everything that is wrong with it.
    """
    document = load_yaml(find("robot", name_or_path))
    file = check_robot(document, document.data)
    document.finish()
    assert file is not None, "a robot without a problem was checked"
    return file


def check_robot(document: Document, data: Any, *, prefix: Loc = ()) -> RobotFile | None:
    """Return plain data as a robot, or None after reporting all that is wrong with it to the document."""
    file = validate(RobotFile, document, data, prefix=prefix)
    if file is None:
        return None
    contradictions = list(file.contradictions())
    for loc, message in contradictions:
        document.report(document.visible(prefix, loc), message)
    return None if contradictions else file


def resolve_robot(document: Document, given: Any, *, prefix: Loc) -> RobotFile | None:
    """Return the robot that a scenario names, overrides or writes out; None after reporting problems.

    Args:
        document: the scenario.
        given: a name, a path, a mapping with `base`, or a whole robot.
        prefix: path of `given` in the document.

    Raises:
        InputFileError: the robot's own file is wrong (its lines name that file).
    """
    base = given.get("base") if isinstance(given, Mapping) else given
    if isinstance(given, Mapping) and "base" not in given:
        return check_robot(document, given, prefix=prefix)
    where = (*prefix, "base") if isinstance(given, Mapping) else prefix
    if not isinstance(base, str):
        document.report(where, "must be a robot's name, a path, or a block of keys with base")
        return None
    try:
        file = load_robot_file(base)
    except InputFileError:
        raise
    except InputError as error:
        document.report(where, str(error))
        return None
    if not isinstance(given, Mapping):
        return file
    merged = _override(file.model_dump(), given, f"set in {document.name} over {base}")
    return check_robot(document, merged, prefix=prefix)


def _override(base: Mapping[str, Any], override: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return the base with plain numbers put into its records and whole records replaced."""
    merged = dict(base)
    if any(isinstance(value, Mapping) for value in override.values()) and "title" not in override:
        merged["title"] = f"{base['title']}, modified"
    for name, value in override.items():
        if name == "base":
            continue
        section = base.get(name)
        if section is None and name in base and isinstance(value, Mapping):
            section = {}
        if not (isinstance(section, Mapping) and isinstance(value, Mapping)):
            merged[name] = value
            continue
        units = units_of(name)
        merged[name] = dict(section)
        for key, entry in value.items():
            plain = key in units and not isinstance(entry, Mapping)
            merged[name][key] = restated(section.get(key), entry, units[key], source) if plain else entry
    return merged


def robot_sources(name_or_path: str | os.PathLike[str]) -> dict[str, Record[Any, Any]]:
    """Return every number of a robot with unit, status and source, by path.

    Raises:
        InputError, InputFileError: as `load_robot_file`.
    """
    return load_robot_file(name_or_path).records()
