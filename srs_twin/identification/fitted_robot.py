"""Robots made of fits: one base, and what each fit found of it, later ones over earlier ones."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from srs_twin.documents import Document, dump_yaml
from srs_twin.errors import InputError
from srs_twin.files import atomic_write
from srs_twin.identification.fit_file import FitFile, load_fit
from srs_twin.identification.overrides import fitted, robot_override
from srs_twin.robot_file import RobotFile
from srs_twin.robots import load_robot_file, resolve_robot


def overrides_of(
    fits: Sequence[str | os.PathLike[str]], *, base: str | None = None, weak: bool = True
) -> dict[str, Any]:
    """Return the block that gives a scenario's robot what several fits found.

    Args:
        fits: paths of fit files; of what two of them found, the later one's counts.
        base: the robot to change; None: that of the fits.
        weak: whether what is only weakly identified is taken as well.

    Raises:
        InputError: no fit, fits of other robots, or one in which nothing was found.
        InputFileError: a file that is no fit.
    """
    loaded = [load_fit(path) for path in fits]
    if not loaded:
        raise InputError("fits are wanted; none was given")
    block: dict[str, Any] = {}
    spec = load_robot_file(loaded[0].robot).spec()
    for path, fit in zip(fits, loaded, strict=True):
        _same_robot(str(path), fit, base or loaded[0].robot)
        block = _merged(block, robot_override(fit, weak=weak, over=spec))
        spec = fitted(fit, spec, weak=weak)
    return block


def fitted_robot(fits: Sequence[str | os.PathLike[str]], name: str, *, weak: bool = True) -> RobotFile:
    """Return a whole robot: the fits' base with what they found.

    Args:
        fits: paths of fit files.
        name: of the new robot.
        weak: whether what is only weakly identified is taken as well.

    Raises:
        InputError: as `overrides_of`.
        InputFileError: the fits do not make up a robot.
    """
    block = overrides_of(fits, weak=weak)
    title = f"{block['base']}, fitted: {', '.join(Path(path).stem for path in fits)}"
    document = Document(name, block | {"name": name, "title": title[:200]})
    robot = resolve_robot(document, document.data, prefix=())
    document.finish()
    assert robot is not None, "a robot without a problem was resolved"
    return robot


def write_robot(robot: RobotFile, path: str | os.PathLike[str]) -> None:
    """Write a robot file, whole or not at all.

    Raises:
        InputError: the place cannot be written.
    """
    with atomic_write(path) as part:
        part.write_text(dump_yaml(robot.model_dump(mode="json", exclude_none=True)), encoding="utf-8")


def _same_robot(path: str, fit: FitFile, base: str) -> None:
    if fit.robot != base:
        raise InputError(
            f"{path}: a fit of robot {fit.robot}, where {base} is wanted; fits are put over the robot that "
            "they started from"
        )


def _merged(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """Return blocks put together, section by section; records of the other replace those of the one."""
    merged = dict(one)
    for key, value in other.items():
        section = merged.get(key)
        both = isinstance(value, Mapping) and isinstance(section, Mapping)
        merged[key] = {**section, **value} if both else value  # type: ignore[dict-item]
    return merged
