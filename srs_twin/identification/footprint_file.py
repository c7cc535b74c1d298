"""A measured footprint as a file: what stands in it, where it comes from, and whether it is current."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import astuple
from pathlib import Path

from srs_twin.errors import InputError
from srs_twin.identification.footprint import Drive, Measured, Study, changes_between
from srs_twin.identification.paths import SteadyPath
from srs_twin.io.files import read_text, shown
from srs_twin.planning.footprint import FootprintFile, Transient
from srs_twin.robot.spec import RobotSpec

_DIGITS = 4
_SPREADS = {"curvature_per_m": "curvature", "speed_m_s": "speed", "left_m": "left", "right_m": "right"}


def footprint_file(measured: Measured, name: str) -> FootprintFile:
    """Return a measurement as a file's content, each column with unit, status and source."""
    drive, paths, source = measured.drive, measured.steady, _source(measured)
    edge = "as curvature_per_m; the farthest that any repeat reached"

    def record(value: object, unit: str, source: str) -> dict[str, object]:
        return {"value": value, "unit": unit, "status": "calibrated", "source": source}

    content = {
        "name": name,
        "title": f"{drive.spec.title.split(':')[0]}, {drive.frequency:g} Hz, "
        f"{drive.supply_pa / 1000:.4g} kPa, as measured on {_plant_text(drive)}",
        "robot": drive.spec.name,
        "offset": record(list(measured.offsets), "1", "chosen"),
        "curvature_per_m": record(_column(paths, "curvature"), "1/m", source),
        "speed_m_s": record(_column(paths, "speed"), "m/s", "as curvature_per_m; along the arc"),
        "left_m": record(_column(paths, "left"), "m", edge),
        "right_m": record(_column(paths, "right"), "m", "as left_m"),
        "ahead_m": record(max(_column(paths, "ahead")), "m", "as left_m, at any offset"),
        "behind_m": record(max(_column(paths, "behind")), "m", "as ahead_m"),
        "spread": {
            "source": f"half the range over {measured.repeats} phases of the gait at the start",
            **{key: _column(measured.spread, name) for key, name in _SPREADS.items()},
        },
    }
    if measured.transients:
        content["transients"] = {
            "status": "calibrated",
            "source": f"as curvature_per_m, each change at {measured.repeats} phases of the gait: the widest "
            "and longest of them, and the mean jump",
            "changes": [_change(each) for each in measured.transients],
        }
    return FootprintFile.model_validate(content)


def command(study: Study, robot: str, name: str) -> str:
    """Return the command that measures the same again.

    Args:
        study: what was measured.
        robot: as it was given, a name or a path.
        name: of the footprint.
    """
    drive = study.drive
    words = [
        f"srs-twin calibrate footprint {robot} --name {name} --controller {drive.controller}",
        f"--frequency {drive.frequency:g} --pressure {drive.supply_pa / 1000:.9g}",
    ]
    if drive.controller == "ilc":
        words.append(f"--target {drive.target:g}")
    if drive.plant != "twin":
        words.append(f"--plant {drive.plant}")
    if study.offsets != drive.offsets:
        words.append("--offsets=" + ",".join(f"{offset:g}" for offset in study.offsets))
    if study.changes != changes_between(study.offsets):
        words.append("--no-transients")
    words.append(f"--periods {study.periods} --phases {study.phases}")
    return " ".join(words)


def header(study: Study, robot: str, name: str, versions: Mapping[str, str]) -> list[str]:
    """Return the lines that say how a file came to be, those that identify it first."""
    with_versions = ", ".join(f"{package} {version}" for package, version in versions.items())
    return [*_identity(study, robot, name), f"with: {with_versions}"]


def robot_hash(spec: RobotSpec) -> str:
    """Return the SHA-256 of a robot's numbers in SI."""
    # Without a tail of its own a robot is what it was before there were any.
    return hashlib.sha256(repr(spec).replace(", tail=None", "").encode()).hexdigest()


def refuse_other(path: Path, study: Study, robot: str, name: str) -> None:
    """Refuse a place where another file stands than one that this study wrote.

    Raises:
        InputError: it does, or the place cannot be read.
    """
    if not path.exists():
        return
    first = [line.removeprefix("# ") for line in read_text(path).splitlines()[:2]]
    if first != _identity(study, robot, name):
        raise InputError(
            f"{shown(path)}: another footprint stands there; --overwrite replaces it, --name and --out lead "
            "elsewhere"
        )


def _identity(study: Study, robot: str, name: str) -> list[str]:
    return [
        f"measured by: {command(study, robot, name)}",
        f"robot {study.drive.spec.name}, sha256 of its numbers: {robot_hash(study.drive.spec)}",
    ]


def _column(paths: Sequence[SteadyPath], key: str) -> list[float]:
    # Not -0.0, which a straight path may round to.
    return [round(getattr(path, key), _DIGITS) + 0.0 for path in paths]


def _change(each: Transient) -> dict[str, float]:
    keys = ("from_offset", "to_offset", "left_m", "right_m", "length_m", "dx_m", "dy_m", "dheading_rad")
    values = dict(zip(keys, astuple(each), strict=True))
    return {key: round(value, _DIGITS) + 0.0 for key, value in values.items()}


def _source(measured: Measured) -> str:
    return (
        f"measured on {_plant_text(measured.drive)} by `srs-twin calibrate footprint`, over "
        f"{measured.periods} gait periods at each of {measured.repeats} phases of the gait at the start"
    )


def _plant_text(drive: Drive) -> str:
    if not isinstance(drive.plant, str):
        return "a plant of one's own"
    return {"twin": "the twin", "analytical": "the analytical model compliant"}[drive.plant]


def rows(measured: Measured) -> list[Sequence[str]]:
    """Return the table that people read: offset, then speed, curvature and edges with their spread."""
    found: list[Sequence[str]] = []
    for offset, path, spread in zip(measured.offsets, measured.steady, measured.spread, strict=True):
        names = ("speed", "curvature", "left", "right")
        cells = (f"{getattr(path, name):.4f} ± {getattr(spread, name):.4f}" for name in names)
        found.append((f"{offset:g}", *cells))
    return found
