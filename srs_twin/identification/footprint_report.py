"""Conversion of footprint measurements to footprint files."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, fields, is_dataclass
from pathlib import Path

from srs_twin.errors import InputError
from srs_twin.identification.footprint import (
    FREQUENCY_HZ,
    FootprintMeasurement,
    FootprintStudy,
    GaitSetup,
    default_changes,
    footprint_study,
)
from srs_twin.identification.paths import SteadyPath
from srs_twin.io.arguments import checked
from srs_twin.io.files import (
    StrPath,
    check_file_name,
    check_output_folder,
    display_path,
    read_text,
)
from srs_twin.planning.footprint import Transient
from srs_twin.planning.footprint_file import (
    FootprintFile,
    TransientFile,
    save_footprint,
)
from srs_twin.robot.file import load_robot
from srs_twin.robot.spec import RobotSpec
from srs_twin.scenario.provenance import versions

_DIGITS = 4
"""Number of decimals in a footprint file."""

_SPREADS = {
    "curvature_per_m": "curvature",
    "speed_m_s": "speed",
    "left_m": "left",
    "right_m": "right",
}
"""Attributes of `SteadyPath` whose spread is written, by key in the footprint file."""


def footprint_file(measured: FootprintMeasurement, name: str) -> FootprintFile:
    """Convert a measurement to a footprint file."""
    setup = measured.setup
    paths = measured.steady
    phases = f"{measured.repeats} gait phases"
    plant = _plant_text(setup)
    source = (
        f"measured on {plant} by `srs-twin calibrate footprint`, over"
        f" {measured.periods} gait periods from each of {phases}"
    )
    edge = "as curvature_per_m; maximum over all runs"
    # This is an upper bound, because a snake is longest when it is straight.
    body = setup.spec.geometry
    straight = round((body.body_length + body.width) / 2, _DIGITS)

    def record(value: object, unit: str, source: str) -> dict[str, object]:
        return {"value": value, "unit": unit, "status": "calibrated", "source": source}

    content: dict[str, object] = {
        "name": name,
        "title": (
            f"{setup.spec.title.split(':')[0]}, {setup.frequency:g} Hz, "
            f"{setup.supply_pa / 1000:.4g} kPa, as measured on {plant}"
        ),
        "robot": setup.spec.name,
        "contact": setup.twin_contact,
        "offset": record(list(measured.offsets), "1", "chosen"),
        "curvature_per_m": record(_column(paths, "curvature"), "1/m", source),
        "speed_m_s": record(
            _column(paths, "speed"), "m/s", "as curvature_per_m; along the arc"
        ),
        "left_m": record(_column(paths, "left"), "m", edge),
        "right_m": record(_column(paths, "right"), "m", "as left_m"),
        "ahead_m": record(
            max(*_column(paths, "ahead"), straight),
            "m",
            "as left_m, or half a straight robot",
        ),
        "behind_m": record(max(*_column(paths, "behind"), straight), "m", "as ahead_m"),
        "spread": {
            "source": f"half the range over runs from {phases}",
            **{key: _column(measured.spread, name) for key, name in _SPREADS.items()},
        },
    }
    if measured.transients:
        content["transients"] = {
            "status": "calibrated",
            "source": (
                f"as curvature_per_m, for changes at {phases}: maximum widths and"
                " lengths, and mean displacement"
            ),
            "changes": [_change_entry(transient) for transient in measured.transients],
        }
    return FootprintFile.model_validate(content)


@checked
def calibrate_footprint(
    robot: StrPath | RobotSpec,
    *,
    out: StrPath | None = None,
    name: str | None = None,
    overwrite: bool = False,
    controller: str = "gait",
    frequency_hz: float | None = None,
    supply_pa: float | None = None,
    target_rad: float = 0.7,
    plant: str = "twin",
    contact: str | None = None,
    chambers: str = "lag",
    offsets: Sequence[float] | None = None,
    transients: bool = True,
    periods: int = 6,
    phases: int = 4,
    workers: int | None = None,
    progress: Callable[[int, int], object] = max,
) -> FootprintMeasurement:
    """Measure the area swept at each offset, as `srs-twin calibrate footprint` does.

    Args:
        robot: name or path of the robot, or a loaded robot.
        out: folder for the footprint file, or None to write nothing.
        name: name of the footprint and of its file, by default the names of the robot
            and the controller.
        overwrite: whether an existing file from another measurement is replaced.
        controller: controller, "gait" (open loop) or "ilc" (iterative learning
            control).
        frequency_hz: gait frequency, Hz, by default the frequency of the controller in
            `FREQUENCY_HZ`.
        supply_pa: supply pressure, Pa, by default the nominal pressure of the robot.
        target_rad: target bend amplitude of the learning controller, rad.
        plant: simulated plant, "twin" or "analytical".
        contact: contact model of the twin, or None for the default contact model.
        chambers: pneumatic model, "lag" or "orifice".
        offsets: steering offsets to measure, by default `GaitSetup.offsets`.
        transients: whether changes of offset are measured.
        periods: number of measured gait periods in each simulation.
        phases: number of simulations per offset, which start at different phases of the
            gait.
        workers: number of parallel simulations, by default one per processor.
        progress: function called with the number of finished simulations and the total
            number of simulations.

    Raises:
        InputError: a setting is not allowed, or the footprint file contains another
            measurement or cannot be written.
        DivergedError: a simulation diverged.
    """
    spec = load_robot(robot)
    if frequency_hz is None:
        frequency_hz = FREQUENCY_HZ.get(controller, 1.0)
    supply = spec.supply.nominal if supply_pa is None else supply_pa
    setup = GaitSetup(
        spec,
        frequency_hz,
        supply,
        controller,
        target_rad,
        plant,
        chambers=chambers,
        contact=contact,
    )
    rows = setup.offsets if offsets is None else sorted(offsets)
    changes = None if transients else ()
    study = footprint_study(
        setup, offsets=rows, changes=changes, periods=periods, phases=phases
    )
    file_name = check_file_name(name or f"{spec.name}_{controller}", "--name")
    robot_name = spec.name if isinstance(robot, RobotSpec) else os.fspath(robot)
    path = Path(out or ".") / f"{file_name}.yaml"
    if out is not None:
        _check_writable(path, _identity(study, robot_name, file_name), overwrite)
    measured = study.measure(threads=workers, progress=progress)
    if out is not None:
        header = header_lines(study, robot_name, file_name, versions())
        save_footprint(footprint_file(measured, file_name), path, header=header)
    return measured


def calibrate_command(study: FootprintStudy, robot: str, name: str) -> str:
    """Return the command that repeats a measurement."""
    setup = study.setup
    words = [
        f"srs-twin calibrate footprint {robot} --name {name}",
        f"--controller {setup.controller} --frequency {setup.frequency:g}",
        f"--pressure {setup.supply_pa / 1000:.9g}",
    ]
    if setup.controller == "ilc":
        words.append(f"--target {setup.target:g}")
    if setup.plant == "twin":
        words.append(f"--contact {setup.twin_contact}")
    else:
        words.append(f"--plant {setup.plant}")
    if setup.chambers != "lag":
        words.append(f"--chambers {setup.chambers}")
    if study.offsets != setup.offsets:
        words.append("--offsets=" + ",".join(f"{offset:g}" for offset in study.offsets))
    if study.changes != default_changes(study.offsets):
        words.append("--no-transients")
    words.append(f"--periods {study.periods} --phases {study.phases}")
    return " ".join(words)


def header_lines(
    study: FootprintStudy, robot: str, name: str, versions: Mapping[str, str]
) -> list[str]:
    """Return the comment lines at the start of a footprint file."""
    with_versions = ", ".join(map(" ".join, versions.items()))
    return [*_identity(study, robot, name), f"with: {with_versions}"]


def robot_hash(spec: RobotSpec) -> str:
    """Return the SHA-256 of all values of a robot that differ from their defaults.

    Adding a parameter with a default value to the package does not change the hash.
    """

    def non_defaults(section: object) -> object:
        if not is_dataclass(section):
            return section
        return {
            field.name: non_defaults(value)
            for field in fields(section)
            if (value := getattr(section, field.name)) != field.default
        }

    return hashlib.sha256(repr(non_defaults(spec)).encode()).hexdigest()


def _check_writable(path: Path, identity: list[str], overwrite: bool) -> None:
    if os.path.lexists(path) and not overwrite:
        first = read_text(path).splitlines()[: len(identity)]
        if [line.removeprefix("# ") for line in first] != identity:
            raise InputError(
                f"{display_path(path)}: the file already contains another footprint;"
                " replace it with --overwrite, or choose another file with --name or"
                " --out"
            )
    check_output_folder(path.parent, (path.name,))


def _identity(study: FootprintStudy, robot: str, name: str) -> list[str]:
    return [
        f"measured by: {calibrate_command(study, robot, name)}",
        (
            f"robot {study.setup.spec.name}, sha256 of its numbers:"
            f" {robot_hash(study.setup.spec)}"
        ),
    ]


def _column(paths: Sequence[SteadyPath], key: str) -> list[float]:
    # Adding 0.0 converts −0.0 to 0.0.
    return [round(getattr(path, key), _DIGITS) + 0.0 for path in paths]


def _change_entry(transient: Transient) -> dict[str, float]:
    values = zip(TransientFile.model_fields, astuple(transient), strict=True)
    return {key: round(value, _DIGITS) + 0.0 for key, value in values}


def _plant_text(setup: GaitSetup) -> str:
    if callable(setup.plant):
        return "a custom plant"
    text = "the twin" if setup.plant == "twin" else "the analytical model compliant"
    if setup.chambers != "lag":
        text += f" with {setup.chambers} chambers"
    return text
