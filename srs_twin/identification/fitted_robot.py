"""Robots made of fits: one base, and what each fit found of it, later ones over earlier ones.

What a fit found becomes the `robot: {base: …}` block of a scenario, or a robot file.
"""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.fit_file import FitFile, ParameterEntry, load_fit
from srs_twin.identification.unknowns import known, unknowns, with_values
from srs_twin.io.documents import Document, dump_yaml
from srs_twin.io.files import write_text
from srs_twin.robot.file import SPREAD_KEYS, RobotFile, load_robot_file, resolve_robot
from srs_twin.robot.sourced import split_unit
from srs_twin.robot.spec import RobotSpec

_PA_PER_KPA = 1e3
_WIDE = 3.92  # standard deviations in 95 %
_LEAST, _SURE = 0.05, 0.99  # of correlations: fewer are none, more would be singular
_ROUNDED = 1e-7  # fit files have nine digits


def robot_override(fit: FitFile, *, weak: bool = True, over: RobotSpec | None = None) -> dict[str, Any]:
    """Return the block that gives a scenario's robot what a fit found: base, and records by section.

    What is not identifiable stays as the base has it, or where the fit held it.

    Args:
        fit: what was found; its robot becomes the base.
        weak: whether what is only weakly identified is taken as well.
        over: the base with what other fits found, whose lists keep the elements that this one did not look
            for; None: the base.

    Raises:
        InputError: no such base robot, one that draws at random what was fitted, or nothing was found.
    """
    file = load_robot_file(fit.robot)
    taken = _taken(fit, weak)
    if not taken:
        raise InputError(f"{fit.name}: nothing in it is identified, so there is nothing to change a robot by")
    values = {each.name: each.value for each in taken if each.value is not None}
    held, moved = fit.held.keys() & {"actuator.bend_rad"}, _moved(fit, file.spec())
    kept = {name: fit.held[name] for name in held} | moved
    spec = with_values(file.spec() if over is None else over, kept | values)
    block: dict[str, Any] = {"base": fit.robot}
    doubts = {each.name: doubt for each in taken if (doubt := _doubt(each))}

    def put(name: str, status: str, source: str, *, over: bool = True) -> None:
        section, key = name.split(".", 1)
        for where, record in _records(spec, section, key).items():
            if over or where not in block.get(section, {}):
                about = {"status": status, "source": source} | doubts.get(f"{section}.{where}", {})
                block.setdefault(section, {})[where] = record | about

    for each in taken:
        alike = [other for other in taken if _record_key(other.name) == _record_key(each.name)]
        put(each.name, "calibrated", _source(fit, alike))
    if any(name.startswith("modules.gain") for name in values) and held and "actuator.bend_rad" not in values:
        put("actuator.bend_rad", "calibrated", f"held in fit {fit.name}: gains are multiples of it")
    for name in moved:
        put(name, "estimated", f"held in fit {fit.name}: its values refer to it", over=False)
    if pairs := _correlated(fit, list(doubts)):
        block["correlated"] = pairs
    spread = file.modules
    for key in block.get("modules", {}) if spread else ():
        drawn = SPREAD_KEYS[key.removesuffix("_rad")]
        if getattr(spread, drawn) is not None:
            raise InputError(
                f"{fit.robot}: it draws modules.{key} at random ({drawn}), which a fit cannot stand "
                "on; take that out first"
            )
    return block


def fitted(fit: FitFile, over: RobotSpec, *, weak: bool = True) -> RobotSpec:
    """Return a robot with what a fit found and what it held; arguments as in `robot_override`."""
    found = {each.name: each.value for each in _taken(fit, weak) if each.value is not None}
    return with_values(over, _moved(fit, load_robot_file(fit.robot).spec()) | found)


def _moved(fit: FitFile, base: RobotSpec) -> dict[str, float]:
    """Return what a fit held elsewhere than its base has it: its values hold only beside these."""
    held = {name: value for name, value in fit.held.items() if known(name)}
    return {
        each.name: held[each.name]
        for each in unknowns(base, held)
        if not math.isclose(each.start, held[each.name], rel_tol=_ROUNDED, abs_tol=_ROUNDED)
    }


def _taken(fit: FitFile, weak: bool) -> list[ParameterEntry]:
    """Return the parameters that change a robot."""
    return [
        each for each in fit.parameters if each.verdict == "identified" or (weak and each.value is not None)
    ]


def _records(spec: RobotSpec, section: str, key: str) -> dict[str, dict[str, Any]]:
    """Return the records of a robot file that a parameter decides, by key."""
    if section == "modules":
        name = _record_key(key)
        values = spec.modules.array(name.removesuffix("_rad")).tolist()
        return {name: {"value": values, "unit": "rad" if name.endswith("_rad") else "1"}}
    if section == "mass":
        masses = list(spec.mass.connectors)
        alike = len(set(masses)) == 1
        found = {"connectors_kg": {"value": masses[0] if alike else masses, "unit": "kg"}}
        if key == "connectors_kg":
            found["wheel_kg"] = {"value": spec.mass.wheel, "unit": "kg"}
        return found
    if key == "bend_rad":
        nominal = spec.supply.nominal
        return {
            "bend_rad": {"value": spec.actuator.gain * nominal, "unit": "rad"},
            "at_pressure_kpa": {"value": nominal / _PA_PER_KPA, "unit": "kPa"},
        }
    attribute, unit = split_unit(key)
    return {key: {"value": getattr(getattr(spec, section), attribute), "unit": unit}}


def _record_key(name: str) -> str:
    """Return the record of a robot file that a parameter stands in."""
    return re.sub(r"(_plus|_minus)?_\d+$", "", name)


def _doubt(found: ParameterEntry) -> dict[str, Any]:
    """Return how well a number is known, as its record says it; nothing of an element of a list."""
    if found.name.startswith(("modules.", "mass.")) or None in (found.value, found.low, found.high):
        return {}
    value, low, high = float(found.value or 0.0), float(found.low or 0.0), float(found.high or 0.0)
    if low > 0.0:  # fits search positive numbers by their logarithms
        factor = (high / low) ** (1 / _WIDE)
        return (
            {"uncertain": {"kind": "lognormal", "factor": min(factor, 100.0)}}
            if factor > 1.0 and value
            else {}
        )
    return {"uncertain": {"kind": "normal", "sd": (high - low) / _WIDE}} if high > low else {}


def _correlated(fit: FitFile, names: Sequence[str]) -> list[dict[str, Any]]:
    """Return the correlations of what a fit found, as a robot file says them."""
    known = [each.name for each in fit.parameters if each.value is not None]
    found = []
    for i, j in itertools.combinations(range(len(known)), 2):
        r = float(np.clip(fit.correlation[i][j], -_SURE, _SURE))
        if known[i] in names and known[j] in names and abs(r) >= _LEAST:
            found.append({"of": [known[i], known[j]], "r": round(r, 4)})
    return found


def _source(fit: FitFile, entries: list[ParameterEntry]) -> str:
    words = "; ".join(f"{e.name} {e.low:.4g} to {e.high:.4g} ({e.verdict})" for e in entries)
    source = f"fit {fit.name} ({fit.method}), 95 %: {words}"
    return source if len(source) <= 1000 else source[:997] + "..."


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
        if fit.robot != (wanted := base or loaded[0].robot):
            raise InputError(
                f"{path}: a fit of robot {fit.robot}, where {wanted} is wanted; fits are put over the robot "
                "that they started from"
            )
        override = robot_override(fit, weak=weak, over=spec)
        again = {each.name for each in fit.parameters}
        earlier = [pair for pair in block.get("correlated", []) if not again.intersection(pair["of"])]
        if pairs := earlier + override.pop("correlated", []):
            block["correlated"] = pairs
        for key, value in override.items():
            block[key] = block.get(key, {}) | value if isinstance(value, Mapping) else value
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
    document.raise_problems()
    assert robot is not None, "a robot without a problem was resolved"
    return robot


def write_robot(robot: RobotFile, path: str | os.PathLike[str]) -> None:
    """Write a robot file, whole or not at all.

    Raises:
        InputError: the place cannot be written.
    """
    write_text(path, dump_yaml(robot.model_dump(mode="json", exclude_none=True)))
