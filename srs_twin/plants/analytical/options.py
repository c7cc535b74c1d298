"""Physical assumptions and numerical settings of the analytical models."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypedDict

from srs_twin.compute.arrays import check_positive
from srs_twin.errors import InputError, check_choice
from srs_twin.io.arguments import check_types
from srs_twin.plants.base import BASES, refusals
from srs_twin.robot.friction import FRICTION_LAWS, TWO_POINT_LAWS
from srs_twin.robot.rules import Violation, raise_violations
from srs_twin.robot.scale import SHIPPED, Scale, divide
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World

MODELS = ("complete", "simplified", "compliant", "quasistatic")
LOADS = ("static", "instantaneous")
INERTIAS = ("point", "connector", "lumped")

TIMESTEP_S = 0.002
"""Default maximum time step for robots with a time unit of 1 (`robot.scale`), s."""
TOLERANCE_M_S = 0.0002
"""Default error tolerance of a time step for robots with a time unit of 1, m/s."""
SLIP_SPEED_M_S = 0.00025
"""Default slip speed ε of the friction law for robots with a time unit of 1, m/s."""


def default_timestep(tick: float, scale: Scale) -> float:
    """Return the default maximum time step (s) for a control tick (s) and a scale."""
    if scale == SHIPPED:
        return TIMESTEP_S
    return divide(tick, TIMESTEP_S * scale.time)


class OptionKeywords(TypedDict, total=False):
    """Keyword arguments of `AnalyticalSnake` that set fields of `AnalyticalOptions`."""

    model: str
    friction: str
    load: str
    friction_torque: bool
    inertia: str
    base: str
    track: float | None
    contact: bool
    cells: int
    timestep: float | None
    tolerance: float | None
    slip_speed: float | None


@dataclass(frozen=True)
class AnalyticalOptions:
    """Assumptions and numerical settings of an analytical model.

    Attributes:
        model: model of the bends. In "complete" and "simplified", the chambers
            prescribe the bends. In "simplified", all chords also have the constant
            length l + L_o. In "compliant", the bends also depend on load and inertia.
            Robots whose segments bend in two directions require "quasistatic" (module
            `quasistatic`), which supports no other robots.
        friction: friction law of a robot on wheels. "axis" is the law of the
            dissertation, with one contact per connector. A connector has two wheels in
            "wheel", and two skids in "ellipse" and "cosine". "viscous" is intended for
            tests. A robot with skin has the friction law of the skin instead.
        load: load on a wheel or skid. "static" is half the weight of the connector.
            "instantaneous" adds the load transfer due to the lateral force (module
            `floor`).
        friction_torque: whether the moment of friction about the centre of mass acts.
            The value False requires "simplified" and selects the first model of the
            dissertation.
        inertia: moment of inertia of each connector. "point" sets the moment to 0.
            "connector" assumes a compact body with two wheels, as in the twin. "lumped"
            is the dissertation's j(i) = Σ m L²/3, which counts the masses of the
            segments twice (E19).
        base: support of the snake, "free" on the floor, or with the head "clamped" in
            the air. The model "compliant" does not support "clamped".
        track: distance from a connector's centre line to each of its two contacts, or 0
            for one contact per connector, m. The default is the robot's half track for
            laws with wheels or skids, and 0 for other laws.
        contact: whether the body touches obstacles instead of passing through them
            (module `obstacles`). The value True requires the model "compliant".
        cells: approximate number of cells per segment of a wheeled robot that can touch
            obstacles.
        timestep: maximum time step, by default `TIMESTEP_S` times the time unit of the
            robot (`robot.scale`), s. For time units other than 1, the default is
            adjusted so that it divides the tick.
        tolerance: estimated error above which a time step with prescribed bends is
            divided (module `steps`), expressed as a velocity, m/s. The default is
            `TOLERANCE_M_S` times the time unit.
        slip_speed: slip speed ε of the friction law, by default `SLIP_SPEED_M_S` times
            the time unit, m/s.
    """

    model: str = "complete"
    friction: str = "axis"
    load: str = "static"
    friction_torque: bool = True
    inertia: str = "point"
    base: str = "free"
    track: float | None = None
    contact: bool = False
    cells: int = 8
    timestep: float | None = None
    tolerance: float | None = None
    slip_speed: float | None = None

    def __post_init__(self) -> None:
        check_types("AnalyticalSnake", AnalyticalOptions, vars(self))
        check_choice("model", self.model, MODELS)
        check_choice("friction law", self.friction, FRICTION_LAWS)
        check_choice("load", self.load, LOADS)
        check_choice("inertia", self.inertia, INERTIAS)
        check_choice("base", self.base, BASES)
        for name, value, unit in (
            ("time step", self.timestep, "s"),
            ("tolerance", self.tolerance, "m/s"),
        ):
            if value is not None:
                check_positive(name, value, unit)
        if self.cells < 1:
            raise InputError(
                f"`cells` {self.cells} is not allowed; a segment needs 1 or more cells"
            )

    def friction_law_on(self, spec: RobotSpec) -> str:
        """Return the friction law of the skin, or `friction` for a robot on wheels."""
        return self.friction if spec.skin is None else spec.skin.friction_law

    def track_of(self, spec: RobotSpec) -> float:
        """Return the distance of a robot's contacts from its centre line, m."""
        if self.track is not None:
            return self.track
        if self.friction_law_on(spec) in TWO_POINT_LAWS:
            return spec.geometry.half_track
        return 0.0

    def check(self, spec: RobotSpec, world: World) -> None:
        """Check that a robot in a world can be simulated with these options.

        Raises:
            InputError: the robot cannot be simulated, for the reasons in the message.
        """
        raise_violations(
            (*refusals("model", self.model, spec, world), *self.violations(spec))
        )

    def violations(self, spec: RobotSpec | None) -> Iterator[Violation]:
        """Yield the conflicts between options, and between options and the robot."""
        if not self.friction_torque and self.model != "simplified":
            yield Violation(
                "friction_torque",
                f"model '{self.model}' always has a friction torque; use model"
                " 'simplified' to leave it out",
            )
        if self.base == "clamped" and self.model == "compliant":
            yield Violation(
                "model",
                "model 'compliant' needs base 'free'; for a clamped robot, as on a"
                " bench, use model 'complete' or the twin",
            )
        if self.contact and self.model != "compliant":
            yield Violation(
                "contact",
                f"model '{self.model}' cannot touch obstacles, because its bends are"
                " prescribed; use model 'compliant'",
            )
        if spec is not None:
            yield from self._violations_of_robot(spec)

    def _violations_of_robot(self, spec: RobotSpec) -> Iterator[Violation]:
        if spec.skin is not None and self.inertia == "lumped":
            yield Violation(
                "inertia",
                "inertia 'lumped' is not allowed for a robot with skin, because its"
                " mass is distributed along its length; use 'point' or 'connector'",
            )
        friction_law = self.friction_law_on(spec)
        if self.load == "instantaneous" and friction_law not in TWO_POINT_LAWS:
            yield Violation(
                "load",
                "instantaneous loads need two contacts per connector, but friction"
                f" '{friction_law}' has only one; use friction 'wheel' or 'ellipse'",
            )
        elif self.load == "instantaneous" and self.track_of(spec) == 0.0:
            yield Violation(
                "track",
                "instantaneous loads need the distance of the two contacts of a"
                " connector from the centre line; set `track` above 0",
            )
