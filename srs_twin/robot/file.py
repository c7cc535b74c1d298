"""Robot files, which store robot parameters with their units, status and sources.

A robot is selected by its name or by the path of its file, or defined as a modification
of another robot. The shipped robot files are in `calibration/robots`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, NamedTuple, get_args

from pydantic import Field

from srs_twin.errors import InputError, InputFileError, UnitWarning, UnknownNameError
from srs_twin.io.arguments import checked
from srs_twin.io.documents import Document, Loc, child, load_yaml, parse_path
from srs_twin.io.files import StrPath, find_file
from srs_twin.io.validation import StrictModel, validate
from srs_twin.robot.plausibility import Doubt, find_doubts, likely_unit
from srs_twin.robot.rules import (
    Violation,
    direction_violations,
    kind_violations,
    mass_violations,
    tail_violations,
    wheel_violations,
)
from srs_twin.robot.scale import Scale
from srs_twin.robot.sections import (
    ActuatorFile,
    BendingFile,
    ChamberFile,
    ContactFile,
    CorrelationFile,
    FrictionFile,
    GaitSection,
    GeometryFile,
    MassFile,
    ModulesFile,
    Number,
    SupplySection,
    TailFile,
)
from srs_twin.robot.sourced import Record, Records, replace_value, split_unit
from srs_twin.robot.spec import (
    GRAVITY,
    Actuator,
    Bending,
    Chamber,
    Friction,
    Geometry,
    Mass,
    RobotSpec,
    Skin,
    Supply,
    Tail,
)

_SUSPICIOUS_RATIO = 300.0
"""Factor between an overriding and an overridden number above which a wrong unit is
suspected."""

PA_PER_KPA = 1000.0
M3_PER_ML = 1e-6


SERVO_PRESSURE_KPA = 100.0
"""Fictitious chamber pressure at which a servo reaches its maximum angle, kPa. Servos
need this pressure because they are commanded by valve states, like pneumatic actuators.
"""

_SERVO_VOLUME_M3 = 1e-12
"""Volume of the fictitious chambers of a servo, m³. It is so small that the air
consumption is negligible."""

_ROUND_TRACK = 1e-3
"""Ratio of half the track width to the body width of a round body. The ratio is small
because a round body touches the floor almost directly below its axis."""

_ROUNDNESS = 0.01
"""Maximum relative difference between the width and height of a round cross-section."""

_TWIST_RATIO = 2 / 3
"""Ratio GJ/EI of torsional to bending stiffness for a solid, incompressible rod with a
round cross-section, where J = 2 I and G = E/3."""

_RIGID_RATIO = 1000.0
"""Stiffness of a servo joint, divided by the product of robot weight and body length.
With this stiffness, floor loads bend the joint by less than 1 mrad."""


_KEY_OF: dict[str, tuple[str, ...]] = {
    "directions": ("chamber", "directions_deg"),
    "extension": ("actuator", "extension_m_per_kpa"),
    "tail": ("tail",),
    "connectors": ("mass", "connectors_kg"),
    "segments": ("mass", "segments_kg"),
    "wheel": ("mass", "wheel_kg"),
    "com": ("tail", "com_m"),
}
"""Path of each parameter in a robot file, keyed by its name in a `Violation`."""


class _Body(NamedTuple):
    geometry: Geometry
    mass: Mass
    friction: Friction
    skin: Skin | None


class _Drive(NamedTuple):
    bending: Bending
    actuator: Actuator
    chamber: Chamber
    supply: Supply


class RobotFile(StrictModel):
    """Parameters of one robot, as stored in a robot file."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$", min_length=1, max_length=40)
    """Short name of the robot."""
    title: str = Field(min_length=1, max_length=200)
    """One-line description of the robot."""
    geometry: GeometryFile
    mass: MassFile
    friction: FrictionFile = FrictionFile()
    """Wheel friction coefficients and axial drag."""
    contact: ContactFile | None = None
    """Kind of contact with the floor (default: wheels)."""
    bending: BendingFile
    actuator: ActuatorFile
    chamber: ChamberFile | None = None
    """Air volume of one chamber, required for pneumatic actuators and not allowed for
    servos."""
    supply: SupplySection | None = None
    """Supply pressure and pressure limits (gauge), required for pneumatic actuators and
    not allowed for servos."""
    gait: GaitSection
    modules: ModulesFile | None = None
    """Properties of the individual modules (default: identical nominal modules)."""
    tail: TailFile | None = None
    """Tail assembly attached to the last connector (default: none)."""
    correlated: Annotated[list[CorrelationFile], Field(max_length=500)] | None = None
    """Correlations between uncertain numbers, for example from a fit (default: none).
    """

    def records(self) -> dict[str, Number]:
        """Return all records, keyed by paths such as "bending.stiffness_nm_per_rad"."""
        return {
            f"{name}.{key}": record
            for name, section in self
            if isinstance(section, Records)
            for key, record in section
            if isinstance(record, Record)
        }

    @property
    def scale(self) -> Scale:
        """Units of the numerical settings, which depend on the robot's size."""
        return Scale.of_pitch(
            self.geometry.segment_length_m.value + self.geometry.rigid_gap_m.value
        )

    def spec(self, seed: int = 0) -> RobotSpec:
        """Return the robot parameters in SI units.

        Args:
            seed: random seed of the differences between modules, unless the section
                `modules` contains a seed.
        """
        drive = self._servos() if self.has_servos else self._air()
        body = self._body_with_skin() if self.has_skin else self._body_on_wheels()
        variation = None
        if self.modules is not None:
            segments = body.geometry.segments
            variation = self.modules.draw(segments, seed, self._chambers)
        return RobotSpec(
            name=self.name,
            title=self.title,
            phase_step=self.gait.phase_step_rad.value,
            variation=variation,
            tail=Tail(**self.tail.to_si()) if self.tail else None,
            **body._asdict(),
            **drive._asdict(),
        )

    def _body_on_wheels(self) -> _Body:
        numbers = self.mass.to_si() | {"connectors": tuple(self.masses())}
        return _Body(
            Geometry(**self.geometry.to_si()),
            Mass(**numbers),
            Friction(**self.friction.to_si()),
            skin=None,
        )

    def _body_with_skin(self) -> _Body:
        assert self.contact is not None, "a robot with skin has the section"
        geometry = self.geometry.to_si()
        # A spatial robot has a round cross-section and touches the floor along a line.
        fraction = 1 / _ROUND_TRACK if self.is_spatial else 2 * math.sqrt(3)
        geometry["half_track"] = geometry["width"] / fraction
        # The twin models the skin by spheres at the height of the body's centre line.
        geometry["wheel_radius"] = geometry["com_height"]
        return _Body(
            Geometry(**geometry),
            Mass.along_body(tuple(self.masses())),
            Friction(**self.friction.to_si() | self.contact.friction()),
            self.contact.skin(),
        )

    def _air(self) -> _Drive:
        assert self.chamber is not None, "`contradictions` reports missing keys"
        assert self.supply is not None, "`contradictions` reports missing keys"
        bending = self.bending.to_si()
        if self.is_spatial:
            stiffness = bending["stiffness"]
            bending.setdefault("pitch_stiffness", stiffness)
            bending.setdefault("roll_stiffness", _TWIST_RATIO * stiffness)
        response = self.actuator.to_si()
        if self.bending.lead is False:
            delay = bending["damping_time"] - response["tau_mode"]
            response["tau_mode"] = bending["damping_time"]
            response["tau_fill"] -= delay
            response["tau_vent"] -= delay
        if response.keys() & {"dead_zone", "dead_zone_transition"}:
            response.setdefault("onset_fraction", 1.0)
        gain = response.pop("bend") / response.pop("at_pressure")
        directions = self.chamber.directions_deg
        if directions is None:
            angles = None
        else:
            angles = tuple(map(math.radians, directions.value))
        volume = self.chamber.air_volume_ml.value * M3_PER_ML
        return _Drive(
            Bending(**bending),
            Actuator(**response, gain=gain),
            Chamber(
                dead_volume=self.chamber.dead_volume_ml.value * M3_PER_ML,
                displacement=volume / (math.pi / 2),
                directions=angles,
            ),
            Supply(
                **self.supply.to_si(), limit_source=self.supply.pulsed_limit_kpa.source
            ),
        )

    def _servos(self) -> _Drive:
        """Return the actuator parameters of a robot with servo joints.

        The equal time constants yield a critically damped response. The stiffness k is
        so high that loads hardly bend the joints. The damping k τ gives the joints of
        the twin the same response.
        """
        time = self.actuator.response_time_s
        assert time is not None, "`contradictions` reports a missing key"
        g = self.geometry
        tau = float(time.value)
        pressure = SERVO_PRESSURE_KPA * PA_PER_KPA
        body = (g.connectors.value - 1) * (
            g.segment_length_m.value + g.rigid_gap_m.value
        )
        rigid = {
            "stiffness": _RIGID_RATIO * GRAVITY * sum(self.masses()) * body,
            "damping_time": tau,
        }
        return _Drive(
            Bending(**self.bending.to_si() | rigid),
            Actuator(tau, tau, tau, gain=self.actuator.bend_rad.value / pressure),
            Chamber(_SERVO_VOLUME_M3, _SERVO_VOLUME_M3),
            Supply(pressure, pressure, pressure, "full command of a servo"),
        )

    @property
    def has_skin(self) -> bool:
        """Whether the robot slides on its belly instead of rolling on wheels."""
        return self.contact is not None and self.contact.is_skin

    @property
    def is_spatial(self) -> bool:
        """Whether the segments bend vertically as well as horizontally."""
        return self.chamber is not None and self.chamber.directions_deg is not None

    @property
    def _chambers(self) -> int:
        if self.chamber is None or self.chamber.directions_deg is None:
            return 2
        return len(self.chamber.directions_deg.value)

    def masses(self) -> list[float]:
        """Return the connector or segment masses, head first, kg.

        A robot on wheels has connector masses, and a robot with skin has segment
        masses.
        """
        connectors = self.geometry.connectors.value
        if self.has_skin:
            record = self.mass.segments_kg
            count = connectors - 1
        else:
            record = self.mass.connectors_kg
            count = connectors
        assert record is not None, "`contradictions` reports a missing mass"
        if isinstance(record.value, list):
            return list(record.value)
        return [record.value] * count

    @property
    def has_servos(self) -> bool:
        """Whether the joints are driven by servos instead of air pressure."""
        return self.actuator.kind == "position"

    def _contradictions_of_kinds(self) -> Iterator[tuple[Loc, str]]:
        contact = "skin" if self.has_skin else "wheels"
        actuator = "position" if self.has_servos else "pressure"
        for name in RobotFile.model_fields:
            if (model := _section_model(name)) is None:
                continue
            for key, kind in (model.needed_by | model.only_for).items():
                missing = getattr(getattr(self, name), key, None) is None
                fits = kind in (contact, actuator)
                robot = f"a robot with contact {contact}"
                if kind in ("pressure", "position"):
                    robot = f"a robot with actuator {actuator}"
                if missing and fits and key in model.needed_by:
                    yield (name, key), f"missing; {robot} needs this key"
                elif not missing and not fits:
                    yield (name, key), f"{robot} cannot have `{key}`; remove this key"
        for key in ("pitch_stiffness_nm_per_rad", "roll_stiffness_nm_per_rad"):
            if not self.is_spatial and getattr(self.bending, key) is None:
                yield ("bending", key), "missing; a planar robot needs this key"
        for violation in kind_violations(
            is_spatial=self.is_spatial,
            has_skin=self.has_skin,
            has_tail=self.tail is not None,
            extends=self.actuator.extension_m_per_kpa is not None,
        ):
            yield _KEY_OF[violation.parameter], violation.reason

    def doubts(self) -> Iterator[Doubt]:
        """Yield the numbers that are probably given in a wrong unit."""
        return find_doubts(
            {path: record.value for path, record in self.records().items()},
            self.masses(),
        )

    def contradictions(self) -> Iterator[tuple[Loc, str]]:
        """Yield the path and a message for each inconsistency in the file."""
        missing = list(self._contradictions_of_kinds())
        yield from missing
        if missing:
            return
        yield from self._contradictions_of_delay()
        for parameter, reason in self._violations():
            yield (*_KEY_OF[parameter], "value"), reason
        for doubt in self.doubts():
            if doubt.is_certain:
                yield (*parse_path(doubt.path), "value"), doubt.text
        if self.modules is not None:
            segments = self.geometry.connectors.value - 1
            yield from self.modules.contradictions(segments, self._chambers)
        yield from self._contradictions_of_section()
        yield from self._invalid_priors()
        yield from self._contradictions_of_supply()

    def _violations(self) -> Iterator[Violation]:
        connectors = self.geometry.connectors.value
        masses = self.masses()
        if self.has_skin:
            count = mass_violations(masses, connectors - 1, "segments")
        else:
            count = mass_violations(masses, connectors, "connectors")
        for violation in count:
            reason = f"{violation.reason}, or one number for all of them"
            yield violation._replace(reason=reason)
        if self.mass.wheel_kg:
            yield from wheel_violations(self.mass.wheel_kg.value, masses)
        if self.tail is not None:
            yield from tail_violations(self.tail.com_m.value, self.tail.axle_m.value)
        if self.chamber is not None and self.chamber.directions_deg is not None:
            yield from direction_violations(self.chamber.directions_deg.value)

    def _contradictions_of_delay(self) -> Iterator[tuple[Loc, str]]:
        if self.bending.lead is not False:
            return
        numbers = self.bending.to_si() | self.actuator.to_si()
        longest = numbers["tau_mode"] + min(numbers["tau_fill"], numbers["tau_vent"])
        if not numbers["damping_time"] < longest:
            text = (
                f"{numbers['damping_time']:g} s is too long for `lead: false`; the"
                f" damping time must be below {longest:g} s"
            )
            yield ("bending", "damping_time_s", "value"), text

    def _contradictions_of_supply(self) -> Iterator[tuple[Loc, str]]:
        if self.supply is None:
            return
        nominal = self.supply.nominal_kpa.value
        limit = self.supply.pulsed_limit_kpa.value
        if nominal > limit:
            text = (
                f"{nominal:g} kPa is above `pulsed_limit_kpa`, which is {limit:g} kPa"
            )
            if nominal > 5 * limit:
                text += f"; {likely_unit(limit, 'kPa', nominal)}"
            yield ("supply", "nominal_kpa", "value"), text

    def _contradictions_of_section(self) -> Iterator[tuple[Loc, str]]:
        width = self.geometry.width_m.value
        height = self.geometry.com_height_m.value
        if self.is_spatial and abs(width / (2 * height) - 1) > _ROUNDNESS:
            text = (
                f"{width:g} m differs from twice `com_height_m`, but a spatial robot"
                " has a round cross-section; set the width to twice `com_height_m`"
            )
            yield ("geometry", "width_m", "value"), text

    def _invalid_priors(self) -> Iterator[tuple[Loc, str]]:
        records = self.records()
        for path, record in records.items():
            section, key = path.split(".")
            bounds = getattr(self, section).bounds.get(key)
            if record.uncertain is not None:
                for reason in _prior_violations(record, bounds):
                    yield (section, key, "uncertain"), reason
        for i, pair in enumerate(self.correlated or ()):
            for k, path in enumerate(pair.of):
                if path not in records:
                    reason = str(UnknownNameError("number", path, records))
                    yield ("correlated", i, "of", k), reason


def _prior_violations(
    record: Number, bounds: tuple[float, float] | None
) -> Iterator[str]:
    prior = record.uncertain
    value = record.value
    assert prior is not None, "the caller has checked it"
    if bounds is None or isinstance(value, list | int):
        yield "only a single decimal number can be uncertain; lists and counts cannot"
    elif prior.kind == "lognormal" and value <= 0:
        yield (
            "the distribution `lognormal` needs a number above 0, but the number"
            f" is {value:g}"
        )
    elif prior.low is not None and prior.high is not None:
        lowest, highest = bounds
        if prior.low < lowest or prior.high > highest:
            yield (
                f"the range from {prior.low:g} to {prior.high:g} exceeds the allowed"
                f" range from {lowest:g} to {highest:g}"
            )
        elif not prior.low <= value <= prior.high:
            yield (
                f"the number {value:g} lies outside the uniform range from"
                f" {prior.low:g} to {prior.high:g}; change the number or the range"
            )


_PLAIN_KEYS = ("seed", "kind", "law", "lead")
"""Keys whose values have neither a unit nor a source."""


def _section_model(name: str) -> type[Records] | None:
    field = RobotFile.model_fields.get(name)
    annotation = field.annotation if field else None
    for kind in get_args(annotation) or (annotation,):
        if isinstance(kind, type) and issubclass(kind, Records):
            return kind
    return None


def section_units(section: str) -> dict[str, str]:
    """Return the units of the keys in a section, or {} for an unknown section."""
    model = _section_model(section)
    keys = model.model_fields if model else ()
    return {key: split_unit(key)[1] for key in keys if key not in _PLAIN_KEYS}


def load_robot_file(name_or_path: StrPath) -> RobotFile:
    """Load and validate a robot file, given by its name or path.

    A `UnitWarning` is issued for each number that is probably given in a wrong unit.

    Raises:
        InputError: the file was not found or cannot be read.
        InputFileError: the file is invalid. The message lists all problems.
    """
    file, doubts = _read_robot_file(name_or_path)
    for doubt in doubts:
        warnings.warn(doubt, UnitWarning, stacklevel=2)
    return file


def _read_robot_file(name_or_path: StrPath) -> tuple[RobotFile, list[str]]:
    document = load_yaml(find_file("robot", name_or_path))
    _check_kind(document)
    file = validate(RobotFile, document, document.data)
    document.raise_problems()
    assert file is not None, "a document without problems has a model"
    doubts = [
        document.describe((*parse_path(path), "value"), text)
        for path, text, _ in file.doubts()
    ]
    return file, doubts


def _check_kind(document: Document) -> None:
    if not isinstance(document.data, Mapping):
        return
    if {"robot", "controller"} <= document.data.keys():
        document.report(
            (),
            "this is a scenario, not a robot file; run the scenario, save the block"
            " `robot` of scenario.resolved.yaml as a file, and give this file",
        )
    elif "base" in document.data:
        document.report(
            ("base",),
            "this key is allowed only in a scenario, because a robot file must be"
            " complete; copy the file of the base robot and change the numbers",
            at_key=True,
        )
    document.raise_problems()


@checked
def load_robot(robot: StrPath | RobotSpec) -> RobotSpec:
    """Load a shipped robot by its name, such as gen2, or a robot file by its path.

    A `RobotSpec` is returned unchanged.

    Raises:
        InputError: the file was not found, cannot be read, or is invalid
            (`InputFileError`).
    """
    if isinstance(robot, RobotSpec):
        return robot
    return load_robot_file(robot).spec()


def resolve_robot(
    document: Document, robot: object, *, prefix: Loc
) -> RobotFile | None:
    """Return the robot of a scenario, or None if the robot is invalid.

    Problems, and warnings about implausible numbers, are added to the document.

    Args:
        document: parsed scenario file.
        robot: name of a robot, path of a robot file, or mapping. A mapping with the key
            `base` modifies another robot. Any other mapping contains all parameters.
        prefix: key path of the robot in the document.

    Raises:
        InputFileError: the robot file named in the scenario is invalid.
    """
    base = robot
    base_loc = prefix
    if isinstance(robot, Mapping):
        if "base" not in robot:
            whole = validate(RobotFile, document, robot, prefix=prefix)
            _add_warnings(document, prefix, find_unit_mistakes(whole) if whole else {})
            return whole
        base = robot["base"]
        base_loc = (*prefix, "base")
    if not isinstance(base, str):
        document.report(
            base_loc, "must be a robot name, a path, or a block of keys with `base`"
        )
        return None
    try:
        file, doubts = _read_robot_file(base)
    except InputFileError:
        raise
    except InputError as error:
        document.report(base_loc, str(error))
        return None
    document.warnings += doubts
    if not isinstance(robot, Mapping):
        return file
    merged = _merge_override(
        file.model_dump(),
        robot,
        lambda loc: f"{document.origin(prefix + loc)} over {base}",
    )
    changed = validate(RobotFile, document, merged, prefix=prefix)
    _add_warnings(
        document, prefix, find_unit_mistakes(changed, file, robot) if changed else {}
    )
    return changed


def robot_in(document: Document, *loc: str) -> RobotFile:
    """Return the robot stored under a key path in a document.

    Raises:
        InputFileError: the robot is invalid, or the document has other problems.
    """
    robot = resolve_robot(document, document.get(*loc), prefix=loc)
    document.raise_problems()
    assert robot is not None, "a document without problems gives a robot"
    return robot


def _add_warnings(document: Document, prefix: Loc, mistakes: Mapping[str, str]) -> None:
    for path, text in mistakes.items():
        loc = document.user_path(prefix, (*parse_path(path), "value"))
        document.warnings.append(document.describe(loc, text))


def find_unit_mistakes(
    robot: RobotFile, base: RobotFile | None = None, override: Mapping[str, object] = {}
) -> dict[str, str]:
    """Return a message for each number with a doubtful unit, keyed by path.

    Args:
        robot: robot to check.
        base: robot that the override modifies. Numbers that are already implausible in
            this robot are not reported.
        override: entries that replace numbers of the base robot. An entry is reported
            if it differs from the replaced number by a factor of more than 300.
    """
    known = {doubt.path for doubt in base.doubts()} if base else ()
    mistakes = {
        doubt.path: doubt.text for doubt in robot.doubts() if doubt.path not in known
    }
    for path, record in base.records().items() if base else ():
        section, key = path.split(".")
        new = child(child(override, section), key)
        old = record.value
        new = child(new, "value") if isinstance(new, Mapping) else new
        if not all(isinstance(number, int | float) and number for number in (new, old)):
            continue
        if not 1 / _SUSPICIOUS_RATIO < abs(new / old) < _SUSPICIOUS_RATIO:
            ratio = new / old
            if abs(ratio) > 1:
                comparison = f"{ratio:.0f} times"
            else:
                comparison = f"1/{1 / ratio:.0f} of"
            comparison += f" the {old:.4g} of {override['base']}"
            hint = likely_unit(abs(new), record.unit, abs(old))
            mistakes[path] = f"{new:g} {record.unit} is {comparison}; {hint}"
    return mistakes


def _merge_override(
    base: Mapping[str, Any],
    override: Mapping[str, object],
    source: Callable[[Loc], str],
) -> dict[str, Any]:
    """Merge an override into the data of its base robot.

    A number without a source gets the text `source(path)` as its source.
    """
    merged = dict(base)
    if (
        any(isinstance(value, Mapping) for value in override.values())
        and "title" not in override
    ):
        merged["title"] = f"{base['title']}, modified"
    for name, value in override.items():
        if name == "base":
            continue
        section = base.get(name)
        if section is None and name in base and isinstance(value, Mapping):
            section = {}  # optional section that the base robot lacks
        if not (isinstance(section, Mapping) and isinstance(value, Mapping)):
            merged[name] = value
            continue
        units = section_units(name)
        merged[name] = dict(section)
        for key, entry in value.items():
            is_number = key in units and not isinstance(entry, Mapping)
            merged[name][key] = entry
            if is_number:
                merged[name][key] = replace_value(
                    section.get(key), entry, units[key], source((name, key))
                )
    return merged
