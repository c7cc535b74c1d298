"""Robots whose parameters are replaced by the results of one or more fits.

The result is the block `robot: {base: …}` of a scenario, or a robot file.
"""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.fit_file import FitFile, ParameterEntry, load_fit
from srs_twin.identification.parameters import (
    free_parameters,
    is_parameter,
    with_values,
)
from srs_twin.io.arguments import checked
from srs_twin.io.documents import Document, dump_yaml
from srs_twin.io.files import StrPath, check_output_folder, display_path, write_text
from srs_twin.robot.file import RobotFile, load_robot_file, robot_in
from srs_twin.robot.sections import SPREAD_KEYS
from srs_twin.robot.sourced import split_unit
from srs_twin.robot.spec import RobotSpec

_PA_PER_KPA = 1e3
_BEND = "actuator.bend_rad"

_STDS_IN_INTERVAL = 3.92
"""Ratio of the width of a 95 % interval to the standard deviation."""

_MIN_CORRELATION = 0.05
"""Minimum magnitude of a correlation that is written to the robot file."""

_MAX_CORRELATION = 0.99
"""Maximum magnitude of a correlation that is written to the robot file.

A correlation of 1 would make the correlation matrix singular.
"""

_ROUNDING = 1e-7
"""Absolute and relative tolerance for comparisons with rounded values of a fit file."""


def robot_override(
    fit: FitFile, *, weak: bool = True, over: RobotSpec | None = None
) -> dict[str, Any]:
    """Return the block `robot` of a scenario with the result of a fit.

    A parameter that is not identifiable keeps the value of the base robot, or the
    constant value used in the fit.

    Args:
        fit: fit file, which also specifies the base robot.
        weak: whether to include values with a verdict other than "identified".
        over: robot that already has the results of other fits, by default the base
            robot. List elements that the fit does not estimate are copied from this
            robot.

    Raises:
        InputError: the base robot does not exist, a fitted parameter of this robot is
            drawn at random, or no parameter is identified.
    """
    file = load_robot_file(fit.robot)
    used = _used_parameters(fit, weak)
    if not used:
        raise InputError(
            f"{fit.name}: the fit identifies no parameter, so it does not change the"
            " robot"
        )
    base = file.spec()
    held = {name: fit.held[name] for name in (_BEND,) if name in fit.held}
    changed = _changed_fixed_values(fit, base)
    values = {parameter.name: parameter.value or 0.0 for parameter in used}
    spec = with_values(over or base, held | changed | values)
    priors = {
        parameter.name: prior for parameter in used if (prior := _prior(parameter))
    }
    block: dict[str, Any] = {"base": fit.robot}
    for name, status, source in _changes(fit, used, changed):
        section, key = name.split(".", 1)
        records = block.setdefault(section, {})
        for record_key, record in _records(spec, section, key).items():
            prior = priors.get(f"{section}.{record_key}", {})
            about = {"status": status, "source": source} | prior
            records.setdefault(record_key, record | about)
    if pairs := _correlations(fit, list(priors)):
        block["correlated"] = pairs
    for key in block.get("modules", {}) if file.modules else ():
        tolerance = SPREAD_KEYS[key.removesuffix("_rad")]
        if getattr(file.modules, tolerance) is not None:
            raise InputError(
                f"{fit.robot}: the fit cannot set `modules.{key}`, because"
                f" `{tolerance}` draws these values at random; remove `{tolerance}`"
                " from the robot file"
            )
    return block


def _changes(
    fit: FitFile, used: Sequence[ParameterEntry], changed: Iterable[str]
) -> Iterator[tuple[str, str, str]]:
    """Yield name, status and source of each value that differs from the base robot."""
    held = f"held in fit {fit.name}"
    for parameter in used:
        record = _record_key(parameter.name)
        same_record = [other for other in used if _record_key(other.name) == record]
        yield parameter.name, "calibrated", _source(fit, same_record)
    names = {parameter.name for parameter in used}
    has_gain = any(name.startswith("modules.gain") for name in names)
    if has_gain and _BEND in fit.held and _BEND not in names:
        why = "the fitted gains are multiples of this value"
        yield _BEND, "calibrated", f"{held}: {why}"
    for name in changed:
        yield name, "estimated", f"{held}; the fitted values depend on this number"


def apply_fit(fit: FitFile, robot: RobotSpec, *, weak: bool = True) -> RobotSpec:
    """Return a copy of a robot with the estimated and constant values of a fit."""
    used = _used_parameters(fit, weak)
    values = {parameter.name: parameter.value or 0.0 for parameter in used}
    base = load_robot_file(fit.robot).spec()
    return with_values(robot, _changed_fixed_values(fit, base) | values)


def _changed_fixed_values(fit: FitFile, base: RobotSpec) -> dict[str, float]:
    names = filter(is_parameter, fit.held)
    starts = {
        parameter.name: parameter.start for parameter in free_parameters(base, names)
    }
    return {
        name: fit.held[name]
        for name, start in starts.items()
        if not math.isclose(start, fit.held[name], rel_tol=_ROUNDING, abs_tol=_ROUNDING)
    }


def _used_parameters(fit: FitFile, weak: bool) -> list[ParameterEntry]:
    return [
        parameter
        for parameter in fit.parameters
        if parameter.verdict == "identified" or (weak and parameter.value is not None)
    ]


def _records(spec: RobotSpec, section: str, key: str) -> dict[str, dict[str, object]]:
    if section == "modules":
        name = _record_key(key)
        values = spec.modules.array(name.removesuffix("_rad")).tolist()
        return {
            name: {"value": values, "unit": "rad" if name.endswith("_rad") else "1"}
        }
    if section == "mass":
        masses: object = list(spec.mass.connectors)
        if len(set(spec.mass.connectors)) == 1:
            masses = spec.mass.connectors[0]
        records = {"connectors_kg": {"value": masses, "unit": "kg"}}
        if key == "connectors_kg":
            records["wheel_kg"] = {"value": spec.mass.wheel, "unit": "kg"}
        return records
    if key == "bend_rad":
        nominal = spec.supply.nominal
        return {
            "bend_rad": {"value": spec.actuator.gain * nominal, "unit": "rad"},
            "at_pressure_kpa": {"value": nominal / _PA_PER_KPA, "unit": "kPa"},
        }
    attribute, unit = split_unit(key)
    return {key: {"value": getattr(getattr(spec, section), attribute), "unit": unit}}


def _record_key(name: str) -> str:
    return re.sub(r"(_plus|_minus)?_\d+$", "", name)


def _prior(parameter: ParameterEntry) -> dict[str, object]:
    low = parameter.low or 0.0
    high = parameter.high or 0.0
    if parameter.name.startswith(("modules.", "mass.")) or high <= low:
        return {}
    if low > 0.0:  # the fit estimates the logarithms of positive parameters
        factor = (high / low) ** (1 / _STDS_IN_INTERVAL)
        return {"uncertain": {"kind": "lognormal", "factor": min(factor, 100.0)}}
    return {"uncertain": {"kind": "normal", "sd": (high - low) / _STDS_IN_INTERVAL}}


def _correlations(fit: FitFile, names: Sequence[str]) -> list[dict[str, object]]:
    known = [
        parameter.name for parameter in fit.parameters if parameter.value is not None
    ]
    entries = []
    for i, j in itertools.combinations(range(len(known)), 2):
        r = float(np.clip(fit.correlation[i][j], -_MAX_CORRELATION, _MAX_CORRELATION))
        pair = [known[i], known[j]]
        if set(pair) <= set(names) and abs(r) >= _MIN_CORRELATION:
            entries.append({"of": pair, "r": round(r, 4)})
    return entries


def _source(fit: FitFile, entries: list[ParameterEntry]) -> str:
    words = "; ".join(
        f"{e.name} {e.low:.4g} to {e.high:.4g} ({e.verdict})" for e in entries
    )
    source = f"fit {fit.name} ({fit.method}), 95 %: {words}"
    return source if len(source) <= 1000 else source[:997] + "..."


def merge_overrides(
    fits: Sequence[StrPath], *, base: str | None = None, weak: bool = True
) -> dict[str, Any]:
    """Return the block `robot` of a scenario with the results of several fits.

    Args:
        fits: paths of fit files. If several files contain the same parameter, the last
            file sets its value.
        base: name or path of the robot to change, by default the robot of the first
            fit.
        weak: whether to include values with a verdict other than "identified".

    Raises:
        InputError: no fit is given, a fit is for another robot, or a fit has no
            identified parameter.
    """
    loaded = [load_fit(path) for path in fits]
    if not loaded:
        raise InputError("no fit file is given; give at least one")
    block: dict[str, Any] = {}
    spec = load_robot_file(loaded[0].robot).spec()
    for path, fit in zip(fits, loaded, strict=True):
        expected = base or loaded[0].robot
        if Path(fit.robot).resolve() != Path(expected).resolve():
            raise InputError(
                f"{path}: the fit is for robot {fit.robot}, not for {expected}; a fit"
                " can change only the robot from which it started"
            )
        override = robot_override(fit, weak=weak, over=spec)
        refitted = {parameter.name for parameter in fit.parameters}
        earlier = [
            pair
            for pair in block.get("correlated", [])
            if not refitted.intersection(pair["of"])
        ]
        if pairs := earlier + override.pop("correlated", []):
            block["correlated"] = pairs
        for key, value in override.items():
            if isinstance(value, Mapping):
                block[key] = block.get(key, {}) | value
            else:
                block[key] = value
        spec = apply_fit(fit, spec, weak=weak)
    return block


def fitted_robot(fits: Sequence[StrPath], name: str, *, weak: bool = True) -> RobotFile:
    """Return a robot file that applies the results of fits to the base robot."""
    block = merge_overrides(fits, weak=weak)
    title = f"{block['base']}, fitted: {', '.join(Path(path).stem for path in fits)}"
    return robot_in(Document(name, block | {"name": name, "title": title[:200]}))


@checked
def calibrate_robot(
    fits: Sequence[StrPath],
    name: str,
    *,
    out: StrPath | None = None,
    weak: bool = True,
    overwrite: bool = False,
) -> RobotFile:
    """Return a robot with the results of fits, as `srs-twin calibrate robot` does.

    Args:
        fits: paths of fit files of one robot. If several files contain the same
            parameter, the last file sets its value.
        name: name of the new robot.
        out: path of the robot file, or None to write nothing.
        weak: whether to include values with a verdict other than "identified".
        overwrite: whether an existing file is replaced.

    Raises:
        InputError: a fit does not match the robot, or the robot file already exists or
            cannot be written.
    """
    if out is not None:
        path = Path(out)
        check_output_folder(path.parent, (path.name,))
        if os.path.lexists(path) and not overwrite:
            raise InputError(
                f"{display_path(path)}: the file already exists; replace it with"
                " --overwrite, or give another file with --out"
            )
    robot = fitted_robot(fits, name, weak=weak)
    if out is not None:
        document = robot.model_dump(mode="json", exclude_none=True)
        write_text(out, dump_yaml(document))
    return robot
