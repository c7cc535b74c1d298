"""Plants of a scenario: which run, and how."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal

from pydantic import field_validator, model_validator

from srs_twin.errors import TimeStepError, count_steps
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.plants.twin.mjcf.numerics import (
    LAW_OF,
    PRESETS,
    Contact,
    ContactName,
    LoadedContact,
    ModelSettings,
    PreloadedContact,
    Preset,
    Wheels,
)
from srs_twin.plants.twin.mjcf.numerics import (
    Law as LawOnLoads,
)
from srs_twin.pneumatics.valves import SLOT_S
from srs_twin.robot.friction import TWO_POINT_LAWS, Law
from srs_twin.scenario.fields import Section, constructor_default, quantity

PLANTS = ("analytical", "twin")


class _PlantFile(Section):
    """What both plants have in common.

    Attributes:
        on_a_floor: keys that say how a snake meets the floor; a module on a bench hangs in the air.
    """

    on_a_floor: ClassVar[tuple[str, ...]]

    gaps: bool = True
    """Whether the rigid gaps of the segments are part of the body."""
    timestep_s: float
    tick_s: float | None = quantity(1e-5, 1.0, None)
    """Control tick, above 0.1 ms a multiple of it, the twin's of timestep_s (default: 0.02, on a bench
    0.001)."""

    @field_validator("tick_s")
    @classmethod
    def _whole_slots(cls, tick: float | None) -> float | None:
        if tick is not None:
            try:
                count_steps("tick", tick, "valve slot", min(SLOT_S, tick))
            except TimeStepError as error:
                raise ValueError(str(error)) from error
        return tick


class AnalyticalFile(_PlantFile):
    """The dissertation's planar model."""

    constructors = (AnalyticalSnake,)
    on_a_floor = ("friction", "load", "friction_torque", "slip_speed_m_s")

    timestep_s: float = quantity(1e-5, 0.02)
    """Longest step of the integrator."""
    model: Literal["complete", "simplified", "compliant"] = constructor_default()
    """complete: bends as the actuators give them; simplified: chords frozen at their straight length
    besides; compliant: bends that load and inertia deflect."""
    friction_torque: bool = constructor_default()
    """Whether friction's moment about the centre of mass acts; only simplified goes without."""
    inertia: Literal["point", "connector", "lumped"] = constructor_default()
    """Of each connector about itself; point: none, connector: a compact body with two wheels, lumped: the
    dissertation's, which counts the segments twice."""
    friction: Law = constructor_default()
    """Law of the floor; axis: one point a connector (the text's), wheel: two wheels at the track, ellipse:
    two skids at the track, viscous: a law for tests."""
    load: Literal["static", "momentary"] = constructor_default()
    """Of a wheel or skid; static: half its connector's weight, momentary: what the force across shifts
    between the two (not with axis)."""
    slip_speed_m_s: float = quantity(1e-6, 0.1)
    """Slip speed below which friction is smoothed."""

    @model_validator(mode="after")
    def _torque_is_there(self) -> AnalyticalFile:
        if not self.friction_torque and self.model != "simplified":
            raise ValueError(f"model {self.model} has a friction torque; only simplified goes without")
        if self.load == "momentary" and self.friction not in TWO_POINT_LAWS:
            raise ValueError(
                f"friction {self.friction} acts in one point a connector; momentary loads need two"
            )
        return self


TICK_S: float = inspect.signature(AnalyticalSnake).parameters["tick"].default
BENCH_TICK_S = 0.001
"""Control ticks that suit gaits and a bench."""


class TwinFile(_PlantFile):
    """The MuJoCo twin."""

    constructors = (ModelSettings, PreloadedContact)
    on_a_floor = ("preset", "wheels", "contact", "friction")

    preset: Preset | None = None
    """Time step by a name, where timestep_s is not given; fast: 2 ms, for search and learning; reference:
    0.25 ms, for published results."""
    timestep_s: float = quantity(1e-5, 0.02)
    """Time step of the integrator."""
    wheels: Wheels = constructor_default()
    """Wheels: rolling (friction law wheel) or skid (runners, law ellipse)."""
    contact: ContactName = LoadedContact.name
    """How the floor holds it; loaded: friction by a law on the loads that MuJoCo finds, preloaded: MuJoCo's
    own friction on wheels or skids that are pressed down, for comparison."""
    friction: LawOnLoads | None = None
    """Law of a loaded contact (default: what suits the wheels)."""
    hinges_per_segment: int = quantity(1, 32)
    """Bending hinges a segment."""

    @model_validator(mode="after")
    def _take_preset(self) -> TwinFile:
        settings = preset_keys(self.preset)
        # Frozen for others; what the file itself gives stays known by `model_fields_set`.
        self.__dict__.update({key: settings[key] for key in settings.keys() - self.model_fields_set})
        return self

    @property
    def law(self) -> LawOnLoads:
        """Friction law: the given one, else that of the wheels or skids."""
        return self.friction or LAW_OF[self.wheels]

    def build_contact(self) -> Contact:
        """Return how the floor holds it."""
        return LoadedContact(self.law) if self.contact == "loaded" else PreloadedContact(self.wheels)

    def arguments(self, *of: Callable[..., Any]) -> dict[str, Any]:
        """Return the arguments of `TwinSnake`."""
        return super().arguments(ModelSettings) | {"contact": self.build_contact()}

    @property
    def searched_with(self) -> str | None:
        """`fast`, with the keys that override it; None if the preset is another one."""
        if self.preset != "fast":
            return None
        own = ((key, getattr(self, key), value) for key, value in preset_keys(self.preset).items())
        besides = ", ".join(f"{key} {used}" for key, used, value in own if used != value)
        return f"{self.preset} with {besides}" if besides else self.preset

    @model_validator(mode="after")
    def _law_is_taken(self) -> TwinFile:
        if self.friction is not None and self.contact == "preloaded":
            raise ValueError("friction needs contact: loaded; with preloaded, wheels decide")
        return self


def preset_keys(preset: Any) -> dict[str, Any]:
    """Return the keys that a preset sets, with values; of none the defaults, of an unknown one nothing."""
    given = PRESETS.get(str(preset), {}) if preset else {"timestep": ModelSettings.timestep}
    return {f"{name}_s": value for name, value in given.items()}


def with_preset(twin: Mapping[str, Any], preset: Any) -> dict[str, Any]:
    """Return plain data of a twin with another preset; of the former only what was given besides stays."""
    before = preset_keys(twin.get("preset"))
    besides = {key: value for key, value in twin.items() if key not in before or before[key] != value}
    return {**preset_keys(preset), **besides, "preset": preset}


PRESET = ("plants", "twin", "preset")
"""Path of that key."""

PlantFile = AnalyticalFile | TwinFile


class PlantsFile(Section):
    """Which plants run, and how; one that is not named does not run."""

    analytical: AnalyticalFile | None = None
    """The analytical model; {} for its defaults."""
    twin: TwinFile | None = None
    """The MuJoCo twin; {} for its defaults."""

    @property
    def running(self) -> dict[str, PlantFile]:
        """The plants that run."""
        return {kind: getattr(self, kind) for kind in PLANTS if getattr(self, kind) is not None}

    @model_validator(mode="after")
    def _some(self) -> PlantsFile:
        empty = [name for name in PLANTS if name in self.model_fields_set and getattr(self, name) is None]
        if empty:
            raise ValueError(f"{empty[0]} has nothing after it; write '{empty[0]}: {{}}' for its defaults")
        if not self.model_fields_set:
            raise ValueError("names no plant; write 'analytical: {}', 'twin: {}' or both")
        return self
