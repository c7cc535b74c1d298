"""Command `srs-twin new`, which writes files from commented templates."""

from __future__ import annotations

import json
import math
import re
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Annotated, NamedTuple

import typer

from srs_twin.cli.console import launcher, say
from srs_twin.cli.options import OptionRange, argument, expand_option_groups, option
from srs_twin.errors import InputError, InputFileError
from srs_twin.extensions import LOADERS, allow_plugin, load

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    help="Write a new file from a commented template.",
)

NameArgument = Annotated[
    str,
    argument("NAME", "Name of the new file: lower-case letters, digits and _."),
]
OutOption = Annotated[
    str | None,
    option(
        "--out FILE",
        "Path of the new file. [default: NAME.yaml, or NAME.py for a controller]",
    ),
]

# The values of new robots are scaled from these values of generation 2.
_PITCH_M = 0.055
"""Distance between neighbouring connectors, m."""

_MASS_KG = 0.15
_PRESSURE_KPA = 48.3
_AIR_ML = 45.0
"""Increase in chamber volume when a straight segment bends fully, ml."""

_BEND_RAD = 1.57
"""Default bend of a segment at the supply pressure, rad."""

_SERVO_BEND_RAD = 0.6
"""Default maximum angle of a servo joint, rad."""

_JOINT_FRACTION = 1 / 15
"""Length of a servo joint as a fraction of the distance between joints."""

_SERVO_PLANE_RATIO = 0.1
"""Ratio of a servo joint's pitch and roll stiffness to weight times length."""


@dataclass(frozen=True)
class NewRobotOptions:
    """Options for the size and the kind of a robot.

    Options:
        --length M: Body length in metres. [default: 0.22]
        --mass KG: Mass of the whole robot in kg. [default: mass of gen2, scaled to the
            given length and number of segments]
        --segments N: Number of bending segments. [default: 4]
        --pressure KPA: Supply pressure (gauge) in kPa. [default: 48.3]
        --bend RAD: Bend of one segment at the supply pressure, or maximum angle of a
            servo joint, in rad. [default: 1.57, or 0.6 with --servo]
        --skin: Describe a robot that slides on its belly instead of rolling on wheels.
        --servo: Describe a robot with rigid links and servo joints instead of air
            chambers.
    """

    length: float | None = None
    mass: float | None = None
    segments: Annotated[int | None, OptionRange(1, 63)] = None
    pressure: float | None = None
    bend: float | None = None
    skin: bool = False
    servo: bool = False

    def ask(self) -> RobotSize:
        """Return the size of the robot, prompting for values that are not set.

        Raises:
            InputError: a value is not positive, or a servo robot is given a supply
                pressure.
        """
        count = int(_answer("number of segments", self.segments, 4))
        length = _answer("body length, m", self.length, 4 * _PITCH_M)
        mass = _answer("mass of the robot, kg", self.mass, _default_mass(count, length))
        if not self.servo:
            supply = _answer("supply pressure, kPa", self.pressure, _PRESSURE_KPA)
            question = "bend of one segment at this pressure, rad"
            bend = _answer(question, self.bend, _BEND_RAD)
        elif self.pressure is None:
            supply = _PRESSURE_KPA
            bend = _answer("maximum joint angle, rad", self.bend, _SERVO_BEND_RAD)
        else:
            raise InputError(
                "a robot with servos has no supply pressure; remove --pressure or"
                " --servo"
            )
        size = RobotSize(count, length, mass, supply, bend)
        for name, number in size._asdict().items():
            if not 0 < number < math.inf:
                raise InputError(
                    f"--{name} {number:g} is not allowed; it must be above 0 and finite"
                )
        return size


class RobotSize(NamedTuple):
    """Size of a robot, with attributes named after the command options.

    Attributes:
        segments: number of segments.
        length: body length, m.
        mass: mass, kg.
        pressure: gauge supply pressure, kPa.
        bend: maximum bend, rad.
    """

    segments: int
    length: float
    mass: float
    pressure: float
    bend: float

    def doubts(self) -> list[str]:
        """Return a message for each value that is probably in the wrong unit.

        Each value is compared with a value that is scaled from generation 2.
        """
        from srs_twin.robot.plausibility import likely_unit

        usual = {
            "length": self.segments * _PITCH_M,
            "mass": _default_mass(self.segments, self.length),
            "pressure": _PRESSURE_KPA,
            "bend": _BEND_RAD,
        }
        found = []
        for name, (unit, low, high) in _PLAUSIBLE.items():
            value: float = getattr(self, name)
            if not low <= value / usual[name] <= high:
                text = (
                    f"--{name} {value:g} is in {unit}, which is unusual for this"
                    " robot; scaled from the generation 2 robot, it would be"
                )
                hint = likely_unit(value, unit, usual[name])
                found.append(f"{text} {usual[name]:.3g} {unit}; {hint}")
        return found


_PLAUSIBLE = {
    "length": ("m", 1 / 16, 16.0),
    "mass": ("kg", 1 / 50, 50.0),
    "pressure": ("kPa", 1 / 6, 20.0),
    "bend": ("rad", 0.0, 4.0),
}
"""Unit of each option, and plausible range of its ratio to the scaled gen2 value."""


def _default_mass(segments: int, length: float) -> float:
    scale = length / max(segments, 1) / _PITCH_M
    return float(f"{_MASS_KG / 5 * (segments + 1) * scale**3:.3g}")


_DEFAULT_ROBOT = NewRobotOptions()


def robot(
    name: NameArgument, options: NewRobotOptions = _DEFAULT_ROBOT, out: OutOption = None
) -> None:
    """Write a robot file for a robot of a given size.

    The values in the file are scaled from the robot gen2. On a terminal, the command
    prompts for values that are not set by options.
    """
    size = options.ask()
    from srs_twin.robot.file import load_robot

    values = _robot_values(size, servo=options.servo)
    parts = {
        "wheels": "" if options.skin else "wheels_geometry.txt",
        "contact": "skin_contact.txt" if options.skin else "wheels_contact.txt",
        "spring": "" if options.servo else "pressure_spring.txt",
        "drive": "servo_drive.txt" if options.servo else "pressure_drive.txt",
    }
    for part, template in parts.items():
        values[part] = _filled(template, values) if template else ""
    title = f"{name}: {size.segments} segments, {size.length:g} m, {size.mass:g} kg"
    doubts = size.doubts()
    path = _write(
        "robot.yaml", name, out, load_robot, doubts=doubts, title=title, **values
    )
    say(*(f"warning: {doubt}" for doubt in doubts))
    _print_next_command(path, "new", "scenario", f"{name}_straight", "--robot", path)


_CHAMBER_SOURCES = {
    "segment_source": "0.67 of the pitch, as generation 2",
    "gap_source": "0.33 of the pitch, as generation 2",
    "plane_source": "scaled from generation 2",
    "plane_interval": "generations 1 and 4, scaled: 0.7 and 0.3 of it",
    "plane_damping": "loss factor of silicone",
}
_SERVO_SOURCES = {
    "segment_source": "width of a joint",
    "gap_source": "rigid link",
    "plane_source": "assumption: a tenth of weight times length",
    "plane_interval": "assumption",
    "plane_damping": "assumption",
}
"""Sources that replace `_CHAMBER_SOURCES` for robots with servo joints."""


def _robot_values(size: RobotSize, *, servo: bool) -> dict[str, object]:
    from srs_twin.robot.spec import GRAVITY

    count, length, mass, supply, bend = size
    scale = length / count / _PITCH_M
    air = _AIR_ML * scale**3
    fraction = 0.037 / _PITCH_M
    plane = 0.1 * scale**4
    sources = _CHAMBER_SOURCES
    if servo:
        fraction = _JOINT_FRACTION
        plane = _SERVO_PLANE_RATIO * GRAVITY * mass * length
        sources = _SERVO_SOURCES
    return {
        "segments": count,
        "connectors": count + 1,
        "segment": fraction * scale * _PITCH_M,
        "gap": (1 - fraction) * scale * _PITCH_M,
        "track": 0.015 * scale,
        "radius": 0.008 * scale,
        "height": 0.015 * scale,
        "width": 0.04 * scale,
        "mass": mass / (count + 1),
        "segment_mass": mass / count,
        "wheel": 0.0015 * scale**3,
        "stiffness": 0.5 * 1e3 * supply * 1e-6 * air / bend**2,
        "plane": plane,
        "damping": 0.00214 * math.sqrt(scale),
        "loss": 0.021 * math.sqrt(scale),
        "bend": bend,
        "pressure": supply,
        "limit": 1.4 * supply,
        "air": air,
        "dead": 11.0 * scale**3,
        "phase": 2 * math.pi / count,
        **sources,
    }


def scenario(
    name: NameArgument,
    robot: str = "gen2",
    frequency: float = 1.5,
    duration: float = 5.0,
    out: OutOption = None,
) -> None:
    """Write a scenario file with a robot, a gait and expectations.

    Options:
        --robot -r ROBOT: Name of a shipped robot, or path of a robot file.
        --frequency HZ: Gait frequency in Hz.
        --duration S: Simulated time in seconds.
    """
    title = f"{name}: straight at {frequency:g} Hz"
    from srs_twin.scenario.loading import load_scenario

    path = _write(
        "scenario.yaml",
        name,
        out,
        load_scenario,
        title=title,
        robot=json.dumps(robot),
        frequency=frequency,
        duration=duration,
    )
    _print_next_command(path, "compare", path)


def study(
    name: NameArgument,
    scenario: str = "gen2_straight",
    out: OutOption = None,
) -> None:
    """Write a study file for finding the fastest gait of a scenario.

    Options:
        --scenario SCENARIO: Name of a shipped scenario, or path of a scenario file.
    """
    check = load(LOADERS["study"])
    title = f"{name}: fastest gait"
    path = _write(
        "study.yaml", name, out, check, title=title, scenario=json.dumps(scenario)
    )
    _print_next_command(path, "optimize", path)


def controller(name: NameArgument, out: OutOption = None) -> None:
    """Write a controller in Python and a scenario that uses it."""
    from srs_twin.scenario.loading import load_scenario

    cls = "".join(part.capitalize() for part in name.split("_"))
    path = _write("controller.txt", name, out, allow_plugin, cls=cls)
    module = path.stem
    beside = str(path.with_suffix(".yaml"))
    try:
        scenario = _write(
            "own_controller.yaml",
            name,
            beside,
            load_scenario,
            cls=cls,
            module=module,
            plugin=path,
        )
    except BaseException:
        path.unlink()
        raise
    say(f"wrote {path}; it is valid")
    _print_next_command(scenario, "compare", scenario, "--plugin", path)


for _command in (robot, scenario, controller, study):
    app.command(_command.__name__)(
        expand_option_groups(_command, plugins=_command is study)
    )


def _answer(question: str, value: float | None, default: float) -> float:
    """Return the value of an option, prompting for it on a terminal if it is not set.

    Without a terminal, the default is returned.
    """
    if value is not None:
        return value
    if not sys.stdin.isatty():
        return default
    return float(typer.prompt(question, default=default, err=True))


def _write(
    template: str,
    name: str,
    out: str | None,
    check: Callable[[Path], object],
    *,
    doubts: Sequence[str] = (),
    **values: object,
) -> Path:
    """Write a file from a template, and remove the file if the check fails.

    If the file is invalid, the error message lists `doubts` about values, if any.
    """
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise InputError(
            f"the name {name!r} is not allowed; begin with a lower-case letter and"
            " use only lower-case letters, digits and _"
        )
    # A template of a Python file has the suffix .txt.
    suffix = Path(template).suffix.replace(".txt", ".py")
    path = Path(out or f"{name}{suffix}")
    if suffix == ".py" and path.suffix != ".py":
        raise InputError(f"--out {path}: the name of the file must end in .py")
    if path.exists():
        raise InputError(
            f"{path} already exists; choose another name, or another path with --out"
        )
    from srs_twin.io.files import write_text

    write_text(path, _filled(template, {"name": name, "file": path, **values}))
    try:
        check(path)
    except BaseException as error:
        path.unlink(missing_ok=True)
        if isinstance(error, InputFileError):
            # Line numbers are omitted, because the file no longer exists.
            place = re.compile(rf"{re.escape(str(path))}[\d:]*: ")
            raise InputError(
                "\n".join(doubts or [place.sub("", line) for line in error.lines])
            ) from error
        raise
    return path


def _filled(template: str, values: dict[str, object]) -> str:
    text = files("srs_twin.cli").joinpath("templates", template).read_text("utf-8")
    texts = {
        key: f"{value:.4g}" if isinstance(value, float) else value
        for key, value in values.items()
    }
    return Template(text).substitute(texts)


def _print_next_command(path: Path, *words: str | Path) -> None:
    say(f"wrote {path}; it is valid")
    print(f"next: {launcher()}srs-twin {shlex.join(map(str, words))}")
