"""TwinSnake: the snake in MuJoCo, in three dimensions, with compliant bends, on wheels or on skids."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from typing import Any

import numpy as np

from srs_twin.compute.arrays import concatenate_records
from srs_twin.errors import DivergedError, InputError, check_choice, count_steps
from srs_twin.io.saved_state import short_digest
from srs_twin.plants.base import (
    BASES,
    PneumaticPlant,
    Pose,
    SnakeState,
    check_before,
    check_moment,
    check_plausible,
)
from srs_twin.plants.twin.mjcf.numerics import (
    LAW_OF,
    WHEELS,
    Contact,
    ContactName,
    LoadedContact,
    ModelSettings,
    Numerics,
    PreloadedContact,
    as_contact,
    preset_of,
)
from srs_twin.plants.twin.physics import ENGINE_WARNINGS, SnakePhysics, StepBatch
from srs_twin.pneumatics import Pneumatics, Schedule, Trace
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import World
from srs_twin.sensing import Sensor

_SPEED_LIMIT = 1e4  # rad/s or m/s: beyond it the state is not plausible
_DESCRIBED = {
    "law": "friction", "slip_speed": "slip_speed_m_s", "slip_time": "slip_time_s", "axle_time": "axle_time_s"
}  # fmt: skip


class TwinSnake(PneumaticPlant):
    """The MuJoCo twin: rigid bodies in three dimensions, several hinges a segment, wheels or skids.

    Its segments have stiffness k and damping c = k τ₂ and are driven by the moment k G (p⁺ − p⁻), so that a
    free segment without mass obeys Eq. 14.

    Attributes:
        stretch: how much the engine runs at a time, s: its records of every step stay small.
        physics: the `SnakePhysics`, for what the contract does not show.
        timestep: s.
        contact: how the floor holds it.
    """

    name = "twin"
    state_attributes = ("physics", "_spent", "_internal", "_theta", "_raised")
    stretch = 1.0
    has_internal_loss = True

    def __init__(
        self,
        spec: RobotSpec,
        *,
        contact: Contact | ContactName = ModelSettings.contact,
        timestep: float = ModelSettings.timestep,
        hinges_per_segment: int = ModelSettings.hinges_per_segment,
        supply_pa: float | None = None,
        tick: float = 0.02,
        layout: str = "3/2",
        pneumatics: str | Pneumatics = "lag",
        sensor: str | Sensor = "ideal",
        world: World | None = None,
        base: str = ModelSettings.base,
        numerics: Numerics = ModelSettings.numerics,
        **former: Any,
    ) -> None:
        """Build and compile the twin.

        Args:
            spec: the robot.
            contact: how the floor holds it; "loaded" and "preloaded" stand for `LoadedContact()` and
                `PreloadedContact()`.
            timestep: s; the tick is a multiple of it.
            hinges_per_segment: bending hinges per segment.
            supply_pa: supply pressure, Pa; default the robot's nominal one.
            tick: control tick, s.
            layout: valve layout, "3/2" or "in_out".
            pneumatics: "lag", "orifice", or chambers of one's own.
            sensor: of the bends, "ideal", "hall" with its defaults, or one of one's own.
            world: whose obstacles it may run into; None: an open floor.
            base: "free", or "clamped": held at the head, in the air.
            numerics: switches that only studies of the twin itself change.
            former: deprecated keywords, now fields of the contact or of `numerics`; each warns.

        Raises:
            InputError: an unknown contact or layout, a tick that is no multiple of the time step, or a time
                step that is too long for the chambers.
        """
        contact = as_contact(contact)
        if former:
            contact, numerics = _take_former(contact, numerics, former)
        check_choice("base", base, BASES)
        if world is not None and world.uneven and isinstance(contact, PreloadedContact):
            raise InputError("a floor that slopes or has steps needs contact 'loaded'")
        count_steps("tick", tick, "time step", timestep)
        self.spec, self.tick, self.timestep, self.contact = spec, tick, timestep, contact
        supply = self._equip(pneumatics, supply_pa, layout, sensor)
        self._settings = ModelSettings(timestep, hinges_per_segment, contact, base, numerics)
        self._bias = spec.modules.array("bias")
        if self.pneumatics.feels_bend and timestep > self.pneumatics.felt_s * (1 + 1e-9):
            raise InputError(
                f"time step {timestep:g} s is too long for these chambers, which feel how the segments bend; "
                f"it must be {self.pneumatics.felt_s:g} s or less (timestep_s in a scenario)"
            )
        self.touches, self.uneven = (
            world is not None and world.has_obstacles,
            world is not None and world.uneven,
        )
        self._first_step = min((step.x for step in world.steps), default=math.inf) if world else math.inf
        largest = supply * self.pneumatics.overshoot
        self._world = short_digest(world)
        self.physics = SnakePhysics.build(spec, self._settings, self.pneumatics, largest, world)
        self.reset()

    def reset(self, *, pose: Pose = (0.0, 0.0, 0.0), seed: int = 0) -> SnakeState:
        """Lay the snake straight, at rest, chambers empty. `seed` is the sensors' noise's."""
        physics = self.physics
        physics.lay_down(pose)
        foremost = float(physics.connector_positions()[:, 0].max()) + self.spec.geometry.wheel_radius
        if foremost >= self._first_step:
            raise InputError(
                f"a snake begins before the first step, which is at x = {self._first_step:g} m, not at "
                f"{foremost:.3g} m"
            )
        self._theta = np.full(self.spec.geometry.connectors, float(pose[2]))
        return self._begin(seed, self.pneumatics.resting())

    def place(self, snake: SnakeState, *, yaw_rate: float = 0.0, seed: int = 0) -> SnakeState:
        """See `Plant.place`."""
        check_moment(snake, yaw_rate, self.spec.segments)
        x, y = map(float, snake.com)
        pose = x, y, float(snake.heading)
        self.reset(pose=pose, seed=seed)
        bend = np.array(snake.bend, dtype=float)
        self.pneumatics.place(snake.pressure, bend)
        self.physics.place(pose, np.array([*snake.com_velocity, yaw_rate]), bend, np.array(snake.bend_rate))
        return self._begin(seed, self.pneumatics.now())

    def _begin(self, seed: int, trace: Trace) -> SnakeState:
        """Return the first moment of a run."""
        physics = self.physics
        self._raised = self._height(physics.center_of_mass())
        self._ticks, self.seed = 0, seed
        self._spent = self._internal = 0.0
        state = np.concatenate([[0.0], physics.data.qpos, physics.data.qvel])[None]
        force, obstacles = np.zeros((1, len(self._theta), 2, 2)), np.zeros((1, len(self._theta), 2))
        given, lost = np.array([physics.kinetic_energy()]), np.zeros(1)
        self.state = self._observe(np.zeros(1), state, trace, force, obstacles, given, lost).at(0)
        return self.state

    @property
    def sample_step(self) -> float:
        """See `Plant.sample_step`."""
        return self.timestep

    def identity(self) -> dict[str, Any]:
        """See `Plant.identity`."""
        return super().identity() | {"world": self._world}

    def _follow(self, schedule: Schedule, ticks: int, samples: int) -> SnakeState:
        """Follow a schedule of possible valve states over so many ticks."""
        interval = schedule.span / samples
        steps = count_steps("sample interval", interval, "time step", self.timestep)
        block = max(1, math.floor(self.stretch / interval))
        begun, parts = self._ticks * self.tick, []
        for first in range(0, samples, block):
            count = min(block, samples - first)
            part = schedule.part(first * interval, (first + count) * interval)
            try:
                parts.append(self._block(part, begun + first * interval, count, steps))
            except DivergedError as error:
                kept = [*parts, *([error.history] if error.history is not None else [])]
                error.history = SnakeState.history(kept) if kept else None
                raise
        self._ticks += ticks
        return check_plausible(self.name, SnakeState.history(parts))

    def describe(self) -> dict[str, Any]:
        """Return the settings worth recording."""
        settings = self._settings
        own = {_DESCRIBED.get(name, name): value for name, value in vars(self.contact).items()}
        if isinstance(self.contact, PreloadedContact):
            own["preload"] = self.contact.pressed
        rest = {name: getattr(settings, name) for name in ("hinges_per_segment", "base")}
        rest |= {"timestep_s": self.timestep, "preset": preset_of(settings)}
        return super().describe() | {"contact": self.contact.name} | own | rest | vars(settings.numerics)

    def _block(self, schedule: Schedule, begun: float, samples: int, steps: int) -> SnakeState:
        """Follow a schedule for some samples of so many steps each."""
        ENGINE_WARNINGS.last.clear()
        before = np.concatenate([[0.0], self.physics.data.qpos, self.physics.data.qvel])
        # Before the engine sees it: it would take a quaternion of any length for a direction.
        check_before(self.name, begun + self.timestep, before, self._theta, self._spent, self._internal)
        trace, record = self._drive(schedule, samples * steps)
        interval = schedule.span / samples
        times = begun + interval * np.arange(1, samples + 1)
        good = self._plausible_steps(record.states)
        whole = good // steps
        history = self._history(times[:whole], trace, record, steps)
        if good < len(record.states):
            last = record.states[good - 1] if good else before
            raise self._diverged(begun + (good + 1) * self.timestep, last, history if whole else None)
        return history

    def _drive(self, schedule: Schedule, steps: int) -> tuple[Trace, StepBatch]:
        """Advance chambers and bodies; return what the chambers did at the steps' ends, and the bodies."""
        felt = self.pneumatics.felt_s
        if not self.pneumatics.feels_bend:
            most = steps
        elif self.physics.loaded is not None:
            most = 1  # its closed chambers are stiff springs, stable with the bends of each step
        else:
            most = max(1, math.floor(felt / self.timestep * (1 + 1e-9)))
        traces, rolled = [], []
        for first in range(0, steps, most):
            last = min(first + most, steps)
            part = schedule.part(first * self.timestep, last * self.timestep)
            trace = self.physics.fill(part, last - first)
            rolled.append(self.physics.roll(trace.pressure))
            traces.append(trace.at(np.arange(1, last - first + 1)))
        return concatenate_records(traces), self.physics.recorded(
            *map(np.concatenate, zip(*rolled, strict=True))
        )

    def _history(self, times: np.ndarray, trace: Trace, record: StepBatch, steps: int) -> SnakeState:
        """Return what was to be seen at these times, each at the end of so many steps."""
        count, used = len(times), len(times) * steps
        ends = np.arange(1, count + 1) * steps - 1
        push = record.floor_force[:used, ..., :2]
        spent = self._spent + self.timestep * np.cumsum(record.power[:used])
        internal = self._internal + self.timestep * np.cumsum(record.internal[:used])
        if used:
            self._spent, self._internal = float(spent[-1]), float(internal[-1])
        given, lost = record.energy[ends] + spent[ends], internal[ends]
        force = push.reshape(count, steps, *push.shape[1:]).mean(axis=1)
        contact = record.obstacle_force[:used, :, :2]
        obstacles = contact.reshape(count, steps, *contact.shape[1:]).mean(axis=1)
        return self._observe(times, record.states[ends], trace.at(ends), force, obstacles, given, lost)

    def _observe(self, times: np.ndarray, states: np.ndarray, trace: Trace, *loads: np.ndarray) -> SnakeState:
        """Return the history of these states.

        Args:
            times: shape (samples,), s.
            states: shape (samples, 1 + nq + nv), see `StepBatch`.
            trace: what the chambers did.
            *loads: forces of floor and obstacles, N; energy that body, floor and obstacles were given, J; and
                what joints dissipated inside segments, J.
        """
        force, obstacles, given, lost = loads
        seen = self.physics.look(states)
        if self.uneven:
            given = given + self._height(seen.com) - self._raised
        # Unwrap against the last sample: a connector turns by far less than π in between.
        theta = np.concatenate([self._theta[None], seen.headings])
        if (np.abs(theta[1:] - theta[:-1]) >= math.pi).any():
            theta = np.unwrap(theta, axis=0)
        theta = theta[1:]
        if len(theta):
            self._theta = theta[-1].copy()  # what was handed out is no longer ours
        bending = self.spec.bending
        air = bending.stiffness * (self._bias + air_bend(self.spec, trace.pressure))
        return SnakeState(
            time=times,
            com=seen.com[:, :2],
            com_velocity=seen.com_velocity[:, :2],
            heading=theta.mean(axis=1),
            position=seen.positions[..., :2],
            theta=theta,
            bend=seen.bends,
            bend_rate=seen.bend_rates,
            pressure=trace.pressure,
            valves=trace.valves,
            sensed=self.sensor.read(seen.bends, times, self.seed),
            # A tail's second axle comes last: it is the last connector's as well.
            contact_force=np.add.reduceat(force.sum(axis=2), np.arange(theta.shape[1]), axis=1),
            obstacle_force=obstacles,
            torque=air - bending.stiffness * seen.bends - bending.damping * seen.bend_rates,
            # All that the torques did, ∫ Σ T q̇ dt, which moves hinges against each other as well.
            work=given + lost + self.physics.internal.stored(seen.qpos),
            internal_loss=lost,
            air=trace.air,
            qpos=seen.qpos,
        )

    def _height(self, com: np.ndarray) -> np.ndarray:
        """Return the potential energy of a centre of mass, shape (…, 3), J."""
        energy: np.ndarray = -self.spec.mass.total * (com @ self.physics.model.opt.gravity)
        return energy

    def _plausible_steps(self, states: np.ndarray) -> int:
        """Return how many steps, from the first, led to finite and plausible states."""
        clock = states[:, 0]
        moved = np.append(True, clock[1:] > clock[:-1])  # after a divergence the engine's time stands still
        speeds = states[:, 1 + self.physics.model.nq :]
        fine = moved & np.isfinite(states).all(axis=1) & (np.abs(speeds) < _SPEED_LIMIT).all(axis=1)
        return int(np.argmin(fine)) if not fine.all() else len(fine)

    def _diverged(self, time: float, before: np.ndarray, history: SnakeState | None) -> DivergedError:
        """Go back to the state before and say what it was and what MuJoCo warned of."""
        warned = " ".join(" ".join(dict.fromkeys(ENGINE_WARNINGS.last)).split())
        physics = self.physics
        count = physics.model.nq
        physics.data.qpos[:], physics.data.qvel[:] = before[1 : 1 + count], before[1 + count :]
        physics.refresh()
        x, y, z = physics.center_of_mass()
        bends = ", ".join(f"{bend:.3g}" for bend in physics.bend_angles())
        where = f"centre of mass ({x:.3g}, {y:.3g}, {z:.3g}) m, heading {float(self._theta.mean()):.3g} rad"
        fastest = f"largest speed {np.abs(before[1 + count :]).max():.3g} m/s or rad/s"
        why = warned or "speeds beyond the plausible"
        text = f"{why}; before: {where}, bends {bends} rad, {fastest}"
        return DivergedError(self.name, time, text, history=history)


def _take_former(contact: Contact, numerics: Numerics, former: dict[str, Any]) -> tuple[Contact, Numerics]:
    """Return contact and switches with deprecated keywords of `TwinSnake` applied.

    Raises:
        TypeError: an unknown keyword.
        InputError: a keyword that the contact does not have, or a bad value.
    """
    given = dict(former)
    unknown = given.keys() - {"friction", *vars(LoadedContact()), *vars(PreloadedContact()), *vars(numerics)}
    if unknown:
        raise TypeError(f"TwinSnake has no argument {min(unknown)!r}")
    switches = {name: given.pop(name) for name in list(given) if name in vars(numerics)}
    if isinstance(contact, LoadedContact):
        wheels, law = given.pop("wheels", None), given.pop("friction", None)
        if wheels is not None:
            check_choice("wheels", wheels, WHEELS)
            law = law or LAW_OF[wheels]
        given |= {"law": law} if law else {}
        # A loaded twin always ignored these.
        given = {name: value for name, value in given.items() if name not in ("slip_time", "axle_time")}
    for name in given:
        if name not in vars(contact):
            raise InputError(f"{name} is not allowed with contact {contact.name!r}")
    warnings.warn(
        f"{', '.join(former)} of TwinSnake: give contact=LoadedContact(…) or PreloadedContact(…), or "
        "numerics=Numerics(…)",
        DeprecationWarning,
        stacklevel=3,
    )
    return replace(contact, **given), replace(numerics, **switches)
