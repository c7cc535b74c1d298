"""Export of robots to MJCF files with the layout of MuJoCo Menagerie.

The file ``<robot>.xml`` contains the robot. The file ``scene.xml`` includes the robot
file and adds a floor, a light, contact pairs and sensors for the floor forces. The file
``scene_mjx.xml`` omits the features that MJX and MuJoCo Warp do not support. All
numbers have full precision, so that ``scene.xml`` compiles to a model that is
bit-identical to the twin with preloaded contact.

The controls are chamber pressures. If the damping time c/k of the segments differs from
the time constant τ₂ of the bending mode, each chamber has two actuators. In segment 1,
for example, the control of `plus_1` is the pressure, and the control of `plus_1_lag` is
the mean pressure during the time step.

The actuators are linear in the pressures, so a bend limit is exported as a limit on the
moment. A robot with a dead zone is rejected by default. Users can request a linear
model and convert the pressures with `pneumatics.chambers.equivalent_linear_pressure`
before they apply the pressures as controls.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from xml.dom import minidom

import mujoco

from srs_twin.errors import InputError
from srs_twin.io.file_sets import replace_files
from srs_twin.plants.twin.mjcf.model import robot_mjcf, scene_mjcf
from srs_twin.plants.twin.mjcf.numerics import ModelSettings, PreloadedContact
from srs_twin.robot.file import RobotFile
from srs_twin.robot.spec import RobotSpec

SCENE = "scene.xml"
SCENE_MJX = "scene_mjx.xml"

_LOADS = "is approximate, because it acts on the static loads and no wheel lifts"
_PRESSURES = "is left out, because the controls are pressures, which change instantly"
_VOLUMES = "is left out, because the controls are pressures, which consume no air"
_CONVERT = "convert pressures with equivalent_linear_pressure (models/README.md)"
_ONSET = f"is left out; {_CONVERT}"
_LIMIT = f"is approximate, because bends near it are up to 19 % too large; {_CONVERT}"
_SENSORS = "is left out, because the tendon lengths are the exact bends"
_DRAWN = "is drawn at random once, with the seed modules.seed (default 0)"

_DEPARTURES = {
    "friction.mu_t": _LOADS,
    "friction.mu_n": _LOADS,
    "actuator.tau_fill_s": _PRESSURES,
    "actuator.tau_vent_s": _PRESSURES,
    "actuator.response_time_s": _PRESSURES,
    "actuator.bend_limit_rad": _LIMIT,
    "actuator.onset_fraction": _ONSET,
    "actuator.dead_zone_rad": _ONSET,
    "actuator.dead_zone_transition_rad": _ONSET,
    "chamber.dead_volume_ml": _VOLUMES,
    "chamber.air_volume_ml": _VOLUMES,
    "modules.tau_fill": _PRESSURES,
    "modules.tau_vent": _PRESSURES,
    "modules.tau_spread": _PRESSURES,
    "modules.gain_spread": _DRAWN,
    "modules.bias_spread_rad": _DRAWN,
    "modules.sensor_gain": _SENSORS,
    "modules.sensor_bias_rad": _SENSORS,
    "modules.sensor_gain_spread": _SENSORS,
    "modules.sensor_bias_spread_rad": _SENSORS,
}
"""Differences between exported models and the twin, for keys of a robot file."""


def describe_departures(robot: RobotFile) -> Iterator[str]:
    """Yield a line of text for each property that the export omits or approximates."""
    on_bench = robot.geometry.connectors.value == 2
    for path, record in robot.records().items():
        departure = _DEPARTURES.get(path)
        if departure and not (on_bench and departure is _LOADS):
            unit = "" if record.unit == "1" else f" {record.unit}"
            yield f"{path} = {record.value}{unit} {departure}"


def export_robot(spec: RobotSpec, folder: Path) -> list[Path]:
    """Write the files of `robot_files` and return their paths.

    Raises:
        InputError: the folder cannot be written, or the robot cannot be exported.
    """
    return write_files(robot_files(spec), folder)


def write_files(files: dict[str, str], folder: Path) -> list[Path]:
    """Write files into a folder and return their paths.

    The folder is created if necessary. Included files must precede the files that
    include them.

    Raises:
        InputError: the folder cannot be written.
    """
    with replace_files(folder, tuple(reversed(files))) as temporary:
        for name, text in files.items():
            (temporary / name).write_text(text, "utf-8")
    return [folder / name for name in files]


def robot_files(
    spec: RobotSpec, *, supply_pa: float | None = None, linear: bool = False
) -> dict[str, str]:
    """Return a robot's MJCF files as a mapping from file name to text.

    Args:
        spec: robot to export.
        supply_pa: upper limit of the pressure controls, unless the robot has higher
            pressure limits, Pa.
        linear: whether to omit the dead zone of a robot instead of raising an error.

    Raises:
        InputError: the robot has a skin or a tail with two axles, or it has a dead zone
            and `linear` is false.
    """
    if spec.skin is not None:
        raise InputError(
            f"{spec.name} cannot be exported, because an MJCF file cannot contain the"
            " friction law of a skin; export a robot with wheels"
        )
    if spec.actuator.onset_fraction > 0.0 and not linear:
        raise InputError(
            f"{spec.name} has a dead zone (`actuator.onset_fraction`"
            f" {spec.actuator.onset_fraction:g}, `dead_zone_rad`"
            f" {spec.actuator.dead_zone:g} rad), but the actuators of an MJCF file are"
            " linear, so the exported model would move as if it had no dead zone."
            " Export it with --linear if you convert its controls (models/README.md)"
        )
    # A robot with a single segment cannot crawl, so it is exported with a clamped head.
    bench = spec.segments == 1
    timestep = ModelSettings.timestep * spec.scale.time
    base = "clamped" if bench else "free"
    settings = ModelSettings(timestep, contact=PreloadedContact(), base=base)
    robot = robot_mjcf(spec, settings, supply_pa=supply_pa)
    scene = scene_mjcf(spec, settings, supply_pa=supply_pa)
    for model in (robot, scene):
        _add_lags(model, spec)
        _limit_moments(model, spec)
        model.keys[0].qpos = model.compile().qpos_spring
    robot.comment = _comment(
        f"{spec.title}.",
        f"Generated from the robot '{spec.name}' (shipped ones: calibration/robots) by",
        "`srs-twin models export`. Change the robot's numbers, not this file.",
    )
    support = "held at its head" if bench else "on a floor"
    scene.comment = _comment(
        f"{spec.title}, {support}.", "Generated by `srs-twin models export`."
    )
    scene.modelname = f"{spec.name} scene"
    name = f"{spec.name}.xml"
    text = _text(robot)
    files = {name: text, SCENE: _include_robot(name, text, _text(scene))}
    _adapt_to_mjx(scene)
    return files | {SCENE_MJX: _text(scene)}


def _add_lags(mj: mujoco.MjSpec, spec: RobotSpec) -> None:
    """Give each chamber a second actuator that lags behind the pressure.

    The compressed air in a segment exerts the moment k x + c ẋ, with free bend x,
    stiffness k and damping c. The free bend obeys τ₂ ẋ = G (p⁺ − p⁻) − x, with time
    constant τ₂, gain G and chamber pressures p⁺ and p⁻. With T = c/k, the moment is
    therefore (1 − T/τ₂) k x + (T/τ₂) k G (p⁺ − p⁻). If T = τ₂, no second actuator is
    needed.
    """
    fraction = spec.bending.damping_time / spec.actuator.tau_mode
    if math.isclose(fraction, 1.0, rel_tol=1e-9):
        return
    for chamber in [
        each for each in mj.actuators if each.name.startswith(("plus_", "minus_"))
    ]:
        name = f"{chamber.name}_lag"
        lagged = mj.add_actuator(
            mj.find_default("muscle"), name=name, target=chamber.target
        )
        lagged.trntype = chamber.trntype
        lagged.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        lagged.dynprm[0] = spec.actuator.tau_mode
        lagged.gainprm[0] = (1 - fraction) * chamber.gainprm[0]
        chamber.gainprm[0] *= fraction
    mj.keys[0].ctrl = [0.0] * len(mj.actuators)
    mj.keys[0].act = [0.0] * sum(each.name.endswith("_lag") for each in mj.actuators)


def _limit_moments(mj: mujoco.MjSpec, spec: RobotSpec) -> None:
    limit = spec.bending.stiffness * spec.actuator.bend_limit
    for tendon in mj.tendons if math.isfinite(limit) else ():
        tendon.actfrclimited = True
        tendon.actfrcrange = [-limit, limit]


def _adapt_to_mjx(mj: mujoco.MjSpec) -> None:
    # The integrator of MJX and MuJoCo Warp adds no damping to springs, so the damping
    # coefficients are not reduced.
    for sensor in mj.sensors:
        mj.delete(sensor)
    mj.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    mj.option.disableflags = 0
    classes = [mj.find_default(name).joint for name in ("hinge", "pitch", "roll")]
    for joint in [*classes, *mj.joints]:
        joint.damping[0] += mj.option.timestep * joint.stiffness[0]


def _comment(*lines: str) -> str:
    # XML comments must not contain two consecutive hyphens, but titles of robots may.
    return "\n       ".join(lines).replace("--", "- -")


def _text(mj: mujoco.MjSpec) -> str:
    mj.compiler.savecompiled = False
    mj.compiler.savecanonical = False
    text: str = mj.to_xml()
    return text


def _include_robot(name: str, robot: str, scene: str) -> str:
    # MuJoCo cannot write an `include` element, or contact pairs whose geoms are
    # missing.
    document = minidom.parseString(scene)
    top = document.documentElement
    robot_top = minidom.parseString(robot).documentElement
    assert top is not None and robot_top is not None  # parsed without an error
    included = {section.tagName: section for section in _elements(robot_top)}
    for section in _elements(top):
        if section.tagName not in included:
            continue
        of_robot = {element.toxml() for element in _elements(included[section.tagName])}
        for element in _elements(section):
            if element.toxml() in of_robot:
                _remove(section, element)
        if not _elements(section):
            _remove(top, section)
    include = document.createElement("include")
    include.setAttribute("file", name)
    first = _elements(top)[0]
    top.insertBefore(include, first)
    top.insertBefore(document.createTextNode("\n\n  "), first)
    return f"{top.toxml()}\n"


def _elements(node: minidom.Element) -> list[minidom.Element]:
    return [child for child in node.childNodes if isinstance(child, minidom.Element)]


def _remove(parent: minidom.Element, element: minidom.Element) -> None:
    before = element.previousSibling
    if isinstance(before, minidom.Text):
        parent.removeChild(before)
    parent.removeChild(element)
