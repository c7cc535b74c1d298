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
"""Names of the plants, of which comparisons use the first as the reference."""


class _PlantFile(Section):
    """Base class of the plant sections.

    Attributes:
        floor_keys: keys for the floor contact, which are not allowed on a bench.
        scaled_keys: keys whose defaults are multiplied by the robot's time unit.
        kind_key: key that determines what the plant supports (`plants.base.refusals`).
        wheel_keys: keys for wheels or skids, which are not allowed for a robot with a
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
    """Control tick, which must be a multiple of timestep_s for the twin (default: 0.02
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
    """Analytical model of the dissertation."""

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
    """Body model; "complete" prescribes the bends. The model "simplified" also replaces
    the segments with chords of constant length. The model "compliant" computes the
    bends from load and inertia. The model "quasistatic" computes bends in two
    directions without inertia and requires a robot with chamber.directions_deg."""
    friction_torque: bool = constructor_default()
    """Whether friction exerts a moment about the centre of mass; false is allowed only
    for the simplified model."""
    inertia: Literal["point", "connector", "lumped"] = constructor_default()
    """Moment of inertia of each connector; "point" sets it to zero, and "connector"
    assumes a compact body with two wheels. The value "lumped", from the dissertation,
    counts the inertia of the segments twice."""
    friction: FrictionLaw = constructor_default()
    """Friction law; "axis" has one contact per connector, as in the dissertation. The
    law "wheel" has two wheels per connector, and the laws "ellipse" and "cosine" have
    two skids. The law "viscous" is intended for tests. A robot with a skin defines its
    own friction law."""
    load: Literal["static", "instantaneous"] = constructor_default()
    """Load on a wheel or skid; "static" is half the weight of the connector. The load
    "instantaneous" also includes the load transfer due to lateral forces and requires
    two contacts per connector. The same loads apply to the pairs of contacts along a
    skin."""
    contact: bool | None = None
    """Whether the body collides with obstacles (default: false); collisions require the
    model "compliant"."""
    slip_speed_m_s: float = quantity(1e-9, 1.0, SLIP_SPEED_M_S)
    """Slip speed below which Coulomb friction is regularised (default: 0.00025 times
    the robot's time unit)."""

    def scaled_to(self, scale: Scale, tick: float) -> Self:
        """Return the section with default times and speeds scaled to a robot."""
        scaled = super().scaled_to(scale, tick)
        if "timestep_s" not in self.model_fields_set:
            scaled.__dict__["timestep_s"] = default_timestep(tick, scale)
        return scaled


BENCH_TICK_S = 0.001
"""Default control tick on a bench for a robot with a time unit of 1, s."""


class TwinFile(_PlantFile):
    """MuJoCo twin."""

    constructors = (ModelSettings, PreloadedContact)
    floor_keys = ("preset", "wheels", "contact", "friction")
    kind_key = "contact"
    wheel_keys = ("wheels", "friction")

    preset: Preset | None = None
    """Named time step, used if timestep_s is not set; "fast" is 2 ms and suits search
    and learning, and "reference" is 0.25 ms and suits published results."""
    timestep_s: float = quantity(1e-6, 1.0)
    """Time step of the integrator (default: 0.001 times the robot's time unit)."""
    wheels: Wheels = constructor_default()
    """Wheels or skids; "rolling" selects wheels with the friction law "wheel", and
    "skid" selects skids with the friction law "ellipse"."""
    contact: ContactName = LoadedContact.name
    """Floor contact; "loaded" applies a friction law to the loads computed by MuJoCo.
    The contact "preloaded" uses MuJoCo's own friction with an additional normal force
    and is meant for comparisons."""
    friction: LawOnLoads | None = None
    """Friction law of a loaded contact (default: law selected by the key wheels)."""
    hinges_per_segment: int = quantity(1, 32)
    """Number of bending hinges per segment."""

    @model_validator(mode="after")
    def _take_preset(self) -> TwinFile:
        if "timestep_s" not in self.model_fields_set:
            # The model is frozen, and `model_fields_set` must contain only keys of the
            # file.
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
        """Friction law of the contact, by default that of the wheels or skids."""
        return self.friction or FRICTION_LAW_OF[self.wheels]

    def build_contact(self) -> Contact:
        """Return the contact model."""
        if self.contact == "loaded":
            return LoadedContact(self.friction_law)
        return PreloadedContact(self.wheels)

    def arguments(self, *constructors: Callable[..., object]) -> dict[str, Any]:
        """Return the arguments of `TwinSnake`."""
        return super().arguments(ModelSettings) | {"contact": self.build_contact()}

    @property
    def fast_preset(self) -> str | None:
        """Text that describes the preset "fast", or None for other presets."""
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
    """Return the time step of a preset (s), or None for an unknown preset.

    Without a preset, the default time step is returned.
    """
    if preset:
        return PRESETS.get(str(preset), {}).get("timestep")
    return ModelSettings.timestep


def with_preset(twin: Mapping[str, object], preset: object) -> dict[str, object]:
    """Return a twin section with another preset.

    A time step that overrides the previous preset is kept.
    """
    data = {**twin, "preset": preset}
    if twin.get("timestep_s") == preset_timestep(twin.get("preset")):
        data.pop("timestep_s", None)
    return data


PRESET = ("plants", "twin", "preset")
"""Path of the key `preset` in a scenario."""

PlantFile = AnalyticalFile | TwinFile


class PlantsFile(Section):
    """Plants to simulate and their options. A plant without a section does not run."""

    analytical: AnalyticalFile | None = None
    """Analytical model; an empty section {} selects the default values."""
    twin: TwinFile | None = None
    """MuJoCo twin; an empty section {} selects the default values."""

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
