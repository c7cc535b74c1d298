"""The assumptions that may differ between the plants, and how each is switched.

On the analytical side a switch turns an assumption of the model into what the twin has; any subset of them is
a model. What the twin alone has is refined: by how much it is made smaller and how its effect then shrinks
give what it contributes in all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from srs_twin.mjcf_numerics import PRELOAD, Numerics
from srs_twin.plants.base import Plant
from srs_twin.scenario.scenario import AnalyticalSettings, Scenario, TwinSettings
from srs_twin.spec import RobotSpec

LAW_OF = {"rolling": "wheel", "skid": "ellipse"}
"""What the twin stands on → the friction law that describes it."""

FROZEN = "frozen chords"
STIFF = 45.0
"""How many times stiffer the bends of the matched setting are: gen 2's 0.44 become 20 N·m/rad."""

Change = Callable[[RobotSpec], RobotSpec]


@dataclass(frozen=True)
class Switch:
    """An assumption of the analytical model that the twin does not make.

    Attributes:
        name: short name.
        title: what it is, from → to.
    """

    name: str
    title: str


@dataclass(frozen=True)
class Refinement:
    """Something that one plant alone has, made smaller.

    Attributes:
        name: short name.
        title: what it is, and how it was made smaller.
        plant: "twin" or "analytical".
        options: changed arguments of the plant.
        factor: all of its effect over the part that the refinement took away.
        base: changed arguments of the plant that it is compared with.
        change: of the robot.
    """

    name: str
    title: str
    plant: str
    options: dict[str, Any]
    factor: float
    base: dict[str, Any] = field(default_factory=dict)
    change: Change = lambda spec: spec


class Ladder:
    """The plants of a scenario with any of their assumptions switched.

    Attributes:
        first: what is switched before all others: arcs come before they can yield.
        switches: those of the analytical side that differ here and go in any order.
        same: names of those that do not.
        refinements: of what one plant alone has.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        analytical, twin = scenario.plants.get("analytical"), scenario.plants.get("twin")
        self._model = analytical if isinstance(analytical, AnalyticalSettings) else AnalyticalSettings()
        self._twin = twin if isinstance(twin, TwinSettings) else TwinSettings()
        every = self._all_switches()
        differing = [switch for switch, differs in every if differs]
        self.first = [switch for switch in differing if switch.name == FROZEN]
        self.switches = [switch for switch in differing if switch.name != FROZEN]
        self.same = [switch.name for switch, differs in every if not differs]
        self.refinements = self._refinements()

    def _all_switches(self) -> list[tuple[Switch, bool]]:
        model, twin, spec = self._model, self._twin, self._scenario.robot
        law, bending = LAW_OF[twin.wheels], spec.bending
        compliant = model.model == "compliant"
        off_tau = bending.damping_time != spec.actuator.tau_mode
        return [
            (Switch("friction law", f"friction law: {model.friction} → {law}"), model.friction != law),
            (
                Switch("wheel track", "contacts: one point a connector → two at the track"),
                model.friction not in LAW_OF.values(),
            ),
            (Switch("rigid gaps", f"rigid gaps: {model.gaps} → {twin.gaps}"), model.gaps != twin.gaps),
            (
                Switch(FROZEN, "chords frozen, and friction torque where it is left out → arcs"),
                model.model == "simplified",
            ),
            (Switch("compliance", "bends: as given → springs that load and inertia deflect"), not compliant),
            (
                Switch("damping", f"damping c/k: τ₂ → {1e3 * bending.damping_time:g} ms"),
                off_tau and not compliant,
            ),
            (
                Switch(
                    "connector inertia", f"inertia of a connector about itself: {model.inertia} → compact"
                ),
                model.inertia != "connector",
            ),
        ]

    def _refinements(self) -> list[Refinement]:
        numerics = Numerics(wheels=self._twin.wheels, preload=PRELOAD[self._twin.wheels])
        softness = {
            "slip_time": numerics.slip_time / 2,
            "axle_time": numerics.axle_time / 2,
            "preload": 2 * numerics.preload,
        }
        step, hinges = self._twin.timestep, self._twin.hinges_per_segment
        arcs = {"constant_curvature": True}
        model = {"timestep": self._model.timestep / 4, "slip_speed": self._model.slip_speed / 4}
        spin = Refinement(
            "wheel inertia", "wheels' inertia about their axles", "twin", {"wheel_spin": 0.25}, 4 / 3
        )
        return [
            Refinement("curvature not constant", "segments under load bend to an S", "twin", arcs, 1.0),
            Refinement(
                "bending discretisation", f"{hinges} hinges a segment for an arc", "twin",
                arcs | {"hinges_per_segment": 2 * hinges}, 4 / 3, arcs,
            ),
            *([spin] if self._twin.wheels == "rolling" else []),
            Refinement("contact softness", "contacts that slip before they hold", "twin", softness, 2.0),
            Refinement(
                "out-of-plane motion", "segments that pitch and roll", "twin", {}, 4 / 3,
                change=_stiffer_out_of_plane,
            ),
            Refinement(
                "link mass", "mass between the hinges", "twin", {"link_share": numerics.link_share / 2}, 2.0
            ),
            Refinement("twin time step", f"its {1e3 * step:g} ms", "twin", {"timestep": step / 2}, 2.0),
            Refinement("model time step", "the model's time step and slip speed", "analytical", model, 4 / 3),
        ]  # fmt: skip

    def analytical(self, on: frozenset[str], **options: Any) -> Plant:
        """Return the analytical model with these switches on.

        Args:
            on: names of switches.
            options: further changes.
        """
        model, spec = self._model, self._scenario.robot
        changes: dict[str, Any] = {}
        if "friction law" in on or "wheel track" in on:
            at_track = "wheel track" in on or model.friction in LAW_OF.values()
            changes["track"] = spec.geometry.half_track if at_track else 0.0
        if "friction law" in on:
            changes["friction"] = LAW_OF[self._twin.wheels]
        if "rigid gaps" in on:
            changes["gaps"] = self._twin.gaps
        if FROZEN in on:
            changes |= {"model": "complete", "friction_torque": True}
        if "compliance" in on:
            changes |= {"model": "compliant", "friction_torque": True}
        if "connector inertia" in on:
            changes["inertia"] = "connector"
        if "damping" not in on and model.model != "compliant":
            spec = replace(spec, bending=replace(spec.bending, damping_time=spec.actuator.tau_mode))
        return self._scenario.build_plant("analytical", robot=spec, **changes | options)

    def twin(self, change: Change = lambda spec: spec, **options: Any) -> Plant:
        """Return the twin with these changes of the robot and of its own arguments."""
        return self._scenario.build_plant("twin", robot=change(self._scenario.robot), **options)

    def stiff_twin(self) -> Plant:
        """Return the twin with the stiff bends of the match."""

        def stiffer(spec: RobotSpec) -> RobotSpec:
            stiffness, lag = STIFF * spec.bending.stiffness, spec.actuator.tau_mode
            return replace(spec, bending=replace(spec.bending, stiffness=stiffness, damping_time=lag))

        return self.twin(stiffer)

    def matched(self) -> Plant:
        """Return the analytical model with the twin's friction, inertia and gaps, and its bends as given."""
        on = {"friction law", "wheel track", "rigid gaps", "connector inertia"}
        return self.analytical(frozenset(on), model="complete", friction_torque=True)


def _stiffer_out_of_plane(spec: RobotSpec) -> RobotSpec:
    bending = spec.bending
    stiffer = replace(
        bending, pitch_stiffness=4 * bending.pitch_stiffness, roll_stiffness=4 * bending.roll_stiffness
    )
    return replace(spec, bending=stiffer)
