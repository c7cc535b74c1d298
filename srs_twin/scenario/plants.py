"""Section `plants` of a scenario, which selects the plants and their options."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal, Self

from pydantic import model_validator

from srs_twin.plants.analytical.options import (
    SLIP_SPEED_M_S,
    TIMESTEP_S,
    AnalyticalOptions,
    default_timestep,
)
from srs_twin.plants.twin.mjcf.numerics import (
    FRICTION_LAW_OF,
    PRESETS,
    Contact,
    ContactName,
    LawOnLoads,
    LoadedContact,
    ModelSettings,
    PreloadedContact,
    Preset,
    Wheels,
)
from srs_twin.robot.friction import FrictionLaw
from srs_twin.robot.scale import Scale, divide
from srs_twin.scenario.fields import Section, constructor_default, quantity

PLANTS = ("analytical", "twin")
"""Names of the plants. Comparisons use the first plant as the reference."""


class _PlantFile(Section):
    """Base class of the plant sections.

    Attributes:
        floor_keys: keys for the floor contact, which are not allowed on a bench.
        scaled_keys: keys whose defaults are multiplied by the robot's time unit.
        kind_key: key that determines what the plant supports (`plants.base.refusals`).
        wheel_keys: keys for wheels or skids, which are not allowed for a robot with
            skin.
    """

    floor_keys: ClassVar[tuple[str, ...]]
    kind_key: ClassVar[str]
    wheel_keys: ClassVar[tuple[str, ...]]
    scaled_keys: ClassVar[tuple[str, ...]] = ("timestep_s",)

    gaps: bool = True
    """Whether the segments have rigid gaps."""
    timestep_s: float
    tick_s: float | None = quantity(1e-6, 10.0, None)
    """Control tick, which on the twin must be a multiple of timestep_s (default: 0.02
    times the robot's time unit, or 0.001 times the time unit on a bench)."""

    def scaled_to(self, scale: Scale, tick: float) -> Self:
        """Return the section with default times and speeds scaled to a robot.

        Args:
            scale: units of the robot.
            tick: control tick, s.
        """
        scaled = self.with_scaled_defaults(self.scaled_keys, scale.time)
        scaled.__dict__["tick_s"] = tick
        return scaled


class AnalyticalFile(_PlantFile):
    """Planar model of the dissertation."""

    constructors = (AnalyticalOptions,)
    floor_keys = ("friction", "load", "friction_torque", "slip_speed_m_s")
    kind_key = "model"
    wheel_keys = ("friction",)

    scaled_keys = ("timestep_s", "slip_speed_m_s")

    timestep_s: float = quantity(1e-6, 1.0, TIMESTEP_S)
    """Maximum time step of the integrator (default: 0.002 times the robot's time unit).
    """
    model: Literal["complete", "simplified", "compliant", "quasistatic"] = (
        constructor_default()
    )
    """Body model; "complete" prescribes the bends. "simplified" also replaces the
    segments by chords of constant length. "compliant" computes the bends from load and
    inertia. "quasistatic" computes bends in two directions without inertia and requires
    a robot with chamber.directions_deg."""
    friction_torque: bool = constructor_default()
    """Whether friction exerts a moment about the centre of mass; only the model
    simplified allows false."""
    inertia: Literal["point", "connector", "lumped"] = constructor_default()
    """Moment of inertia of each connector; "point" is zero. "connector" assumes a
    compact body with two wheels. "lumped" is the dissertation's value, which counts the
    inertia of the segments twice."""
    friction: FrictionLaw = constructor_default()
    """Friction law; "axis" has one contact per connector, as in the dissertation.
    "wheel" has two wheels at the track, "ellipse" and "cosine" have two skids at the
    track. "viscous" is intended for tests. A robot with skin defines its own law."""
    load: Literal["static", "instantaneous"] = constructor_default()
    """Load on a wheel or skid; "static" is half the weight of the connector.
    "instantaneous" adds the load transfer due to lateral forces (not with axis). A skin
    has pairs of contacts along the whole body, which are loaded in the same way."""
    contact: bool | None = None
    """Whether the body collides with obstacles; this needs the model compliant. By
    default, the body passes through obstacles."""
    slip_speed_m_s: float = quantity(1e-9, 1.0, SLIP_SPEED_M_S)
    """Slip speed below which Coulomb friction is regularised (default: 0.00025 times the
    robot's time unit)."""

    def scaled_to(self, scale: Scale, tick: float) -> Self:
        """Return the section with default times and speeds scaled to a robot."""
        scaled = super().scaled_to(scale, tick)
        if "timestep_s" not in self.model_fields_set:
            scaled.__dict__["timestep_s"] = default_timestep(tick, scale)
        return scaled


BENCH_TICK_S = 0.001
"""Default control tick (s) on a bench for a robot with time unit 1. It is short because
controllers on a bench track fast references."""


class TwinFile(_PlantFile):
    """MuJoCo twin."""

    constructors = (ModelSettings, PreloadedContact)
    floor_keys = ("preset", "wheels", "contact", "friction")
    kind_key = "contact"
    wheel_keys = ("wheels", "friction")

    preset: Preset | None = None
    """Named time step, used if timestep_s is not set; "fast" is 2 ms and suits search
    and learning. "reference" is 0.25 ms and suits published results."""
    timestep_s: float = quantity(1e-6, 1.0)
    """Time step of the integrator (default: 0.001 times the robot's time unit)."""
    wheels: Wheels = constructor_default()
    """Wheels; "rolling" selects wheels with the friction law wheel. "skid"
    selects skids with the friction law ellipse."""
    contact: ContactName = LoadedContact.name
    """Floor contact; "loaded" applies a friction law to the loads computed by MuJoCo.
    "preloaded" uses MuJoCo's own friction with an additional normal force and is meant
    for comparison."""
    friction: LawOnLoads | None = None
    """Friction law of a loaded contact; by default, the law selected by wheels."""
    hinges_per_segment: int = quantity(1, 32)
    """Number of bending hinges per segment."""

    @model_validator(mode="after")
    def _take_preset(self) -> TwinFile:
        if "timestep_s" not in self.model_fields_set:
            # `__dict__` is set because the model is frozen and `model_fields_set` must
            # contain only keys of the file.
            self.__dict__["timestep_s"] = preset_timestep(self.preset)
        return self

    def scaled_to(self, scale: Scale, tick: float) -> Self:
        """Return the section with default times and speeds scaled to a robot."""
        scaled = super().scaled_to(scale, tick)
        if "timestep_s" not in self.model_fields_set:
            scaled.__dict__["timestep_s"] = divide(tick, scaled.timestep_s)
        return scaled

    @property
    def friction_law(self) -> LawOnLoads:
        """Friction law of the contact; by default, the law of the wheels or skids."""
        return self.friction or FRICTION_LAW_OF[self.wheels]

    def build_contact(self) -> Contact:
        """Return the contact model."""
        if self.contact == "loaded":
            return LoadedContact(self.friction_law)
        return PreloadedContact(self.wheels)

    def arguments(self, *constructors: Callable[..., Any]) -> dict[str, Any]:
        """Return the arguments of `TwinSnake`."""
        return super().arguments(ModelSettings) | {"contact": self.build_contact()}

    @property
    def fast_preset(self) -> str | None:
        """Name of the preset "fast" if a time step overrides the preset, or None."""
        if self.preset != "fast":
            return None
        override = f" with timestep_s {self.timestep_s}"
        return self.preset + override * (
            self.timestep_s != preset_timestep(self.preset)
        )

    @model_validator(mode="after")
    def _friction_is_loaded(self) -> TwinFile:
        if self.friction is not None and self.contact == "preloaded":
            raise ValueError(
                "`friction` is allowed only with `contact: loaded`, because with"
                " `contact: preloaded` the wheels determine the friction law; remove"
                " `friction`, or set `contact: loaded`"
            )
        return self


def preset_timestep(preset: object) -> float | None:
    """Return the time step of a preset (s), or None for an unknown preset."""
    if preset:
        return PRESETS.get(str(preset), {}).get("timestep")
    return ModelSettings.timestep


def with_preset(twin: Mapping[str, Any], preset: Any) -> dict[str, Any]:
    """Set the preset of a twin and keep a time step that overrides the preset."""
    data = {**twin, "preset": preset}
    if twin.get("timestep_s") == preset_timestep(twin.get("preset")):
        data.pop("timestep_s", None)
    return data


PRESET = ("plants", "twin", "preset")
"""Path of the key `preset` in a scenario."""

PlantFile = AnalyticalFile | TwinFile


class PlantsFile(Section):
    """Plants to simulate, with their options. A plant without a section does not run."""

    analytical: AnalyticalFile | None = None
    """Analytical model; {} selects the default values."""
    twin: TwinFile | None = None
    """MuJoCo twin; {} selects the default values."""

    @property
    def running(self) -> dict[str, PlantFile]:
        """Sections of the plants that run, keyed by name."""
        return {
            kind: getattr(self, kind)
            for kind in PLANTS
            if getattr(self, kind) is not None
        }

    @model_validator(mode="after")
    def _has_a_plant(self) -> PlantsFile:
        empty = [
            name
            for name in PLANTS
            if name in self.model_fields_set and getattr(self, name) is None
        ]
        if empty:
            raise ValueError(
                f"the section `{empty[0]}` is empty; write `{empty[0]}: {{}}` to use"
                " its default values"
            )
        if not self.model_fields_set:
            raise ValueError(
                "the section names no plant; write `analytical: {}`, `twin: {}` or both"
            )
        return self
