"""TwinSnake: the snake in MuJoCo, in three dimensions, with compliant bends and real wheels."""

from __future__ import annotations

import os
from collections import deque
from typing import Any

import numpy as np

from srs_twin.errors import DivergedError, InputError, whole_steps
from srs_twin.plants.base import Plant, Pose, SnakeState
from srs_twin.pneumatics import LagPneumatics
from srs_twin.spec import GRAVITY, RobotSpec

# Physics needs no screen. dm_control would look for one and warn; whoever renders sets it beforehand.
os.environ.setdefault("MUJOCO_GL", "disabled")

import mujoco  # noqa: E402
from dm_control import mujoco as dm  # noqa: E402
from dm_control.rl.control import PhysicsError  # noqa: E402

from srs_twin.mjcf import Numerics, preload_force, scene_mjcf  # noqa: E402

WHEELS = ("rolling",)
_HEARD: deque[str] = deque(maxlen=4)
# MuJoCo's warnings are part of a DivergedError's message; unheard they go to a log file or to stderr.
mujoco.set_mju_user_warning(_HEARD.append)
_SPEED_LIMIT = 1e4  # rad/s or m/s: beyond it the state is not plausible


class SnakePhysics(dm.Physics):
    """dm_control physics of a snake; `step` advances the chambers, then the bodies.

    The control is a valve command, held in equal slots over the next `step`.
    """

    @classmethod
    def build(
        cls, spec: RobotSpec, numerics: Numerics, pneumatics: LagPneumatics, *, supply_pa: float
    ) -> SnakePhysics:
        """Compile the scene of a robot.

        Args:
            spec: the robot.
            numerics: time step, discretisation, contact.
            pneumatics: its chambers.
            supply_pa: largest pressure that can occur, Pa.
        """
        model = scene_mjcf(spec, numerics, supply_pa=supply_pa).compile()
        physics: SnakePhysics = cls.from_model(dm.wrapper.MjModel(model))
        physics._attach(spec, numerics, pneumatics)
        return physics

    def _attach(self, spec: RobotSpec, numerics: Numerics, pneumatics: LagPneumatics) -> None:
        raw = self.model.ptr
        self._pneumatics = pneumatics
        self._preload = preload_force(spec, numerics)
        self._rest_load = np.repeat(spec.mass.array()[:, None] * GRAVITY / 2, 2, axis=1)
        self._connectors = [raw.body(f"connector_{i}").id for i in range(1, spec.geometry.connectors + 1)]
        self._valves = np.full((1, spec.segments, 2), -1, dtype=np.int8)
        self._floor_force = np.zeros((*self._preload.shape, 3))

    def lay_down(self, pose: Pose) -> None:
        """Reset to a straight snake at rest with its centre of mass at x, y (m) and heading (rad)."""
        x, y, heading = pose
        with self.reset_context():
            offset = self.named.data.xpos["connector_1", "x"] - self.data.subtree_com[0][0]
            self.data.qpos[:2] = x + offset * np.cos(heading), y + offset * np.sin(heading)
            self.data.qpos[3:7] = np.cos(heading / 2), 0, 0, np.sin(heading / 2)
        self._pneumatics.reset()
        # At rest every wheel carries its share of the weight, and its preload.
        self._floor_force = np.zeros((*self._preload.shape, 3))
        self._floor_force[..., 2] = self._preload + self._rest_load

    def set_control(self, control: np.ndarray) -> None:
        """Command the valves for the next `step`: (segments, 2) or (slots, segments, 2)."""
        self._valves = self._pneumatics.slots(control)

    def step(self, nstep: int = 1) -> None:
        """Advance chambers and bodies by `nstep` time steps.

        Pressures are those of each step's beginning: with the springs at its end, a ramp then lags by
        exactly τ₂.
        """
        model, data = self.model.ptr, self.data.ptr
        span = nstep * model.opt.timestep
        times = span * np.arange(nstep) / nstep
        controls = self._pneumatics.advance(self._valves, span, times).pressure.reshape(nstep, -1)
        force = np.zeros(model.nsensordata)
        chambers, floor = data.ctrl[: controls.shape[1]], data.sensordata
        with self.check_invalid_state():
            for row in controls:
                chambers[:] = row
                mujoco.mj_step(model, data)
                force += floor
            # Positions and velocities of the end of the step, not of its beginning.
            mujoco.mj_step1(model, data)
        self._floor_force = force.reshape(self._floor_force.shape) / nstep

    def bend_angles(self) -> np.ndarray:
        """Return the bends q_j, shape (segments,), rad."""
        return self.data.ten_length.copy()

    def bend_rates(self) -> np.ndarray:
        """Return the bend rates, shape (segments,), rad/s."""
        return self.data.ten_velocity.copy()

    def connector_positions(self) -> np.ndarray:
        """Return the connectors, head first, shape (N, 3), m."""
        return self.data.xpos[self._connectors].copy()

    def connector_headings(self) -> np.ndarray:
        """Return the connectors' headings, shape (N,), wrapped to (−π, π], rad."""
        frame = self.data.xmat[self._connectors]
        return np.arctan2(frame[:, 3], frame[:, 0])

    def center_of_mass(self) -> np.ndarray:
        """Return the snake's centre of mass, shape (3,), m."""
        return self.data.subtree_com[0].copy()

    def center_of_mass_velocity(self) -> np.ndarray:
        """Return its velocity, shape (3,), m/s."""
        mujoco.mj_subtreeVel(self.model.ptr, self.data.ptr)
        return self.data.subtree_linvel[0].copy()

    def floor_forces(self) -> np.ndarray:
        """Return the floor's force on each wheel less the preload, mean over the last `step`, world frame.

        Shape (N, 2, 3): connector, left and right wheel, x y z, N.
        """
        force = self._floor_force.copy()
        force[..., 2] -= self._preload
        return force

    def wheel_loads(self) -> np.ndarray:
        """Return the normal load of each wheel, mean over the last `step`, shape (N, 2), N.

        Below 0: without preload the wheel would lift.
        """
        return self.floor_forces()[..., 2]


class TwinSnake(Plant):
    """The MuJoCo twin.

    Attributes:
        physics: the `SnakePhysics`, for what the contract does not show.
        timestep: s.
    """

    name = "twin"

    def __init__(
        self,
        spec: RobotSpec,
        *,
        wheels: str = "rolling",
        hinges_per_segment: int = Numerics.hinges_per_segment,
        timestep: float = Numerics.timestep,
        supply_pa: float | None = None,
        tick: float = 0.02,
        layout: str = "3/2",
        slip_time: float = Numerics.slip_time,
        preload: float = Numerics.preload,
    ) -> None:
        """Build and compile the twin.

        Args:
            spec: the robot.
            wheels: "rolling", hinge wheels.
            hinges_per_segment: bending hinges a segment.
            timestep: s; the tick is a multiple of it.
            supply_pa: supply pressure, Pa; default the robot's nominal one.
            tick: control tick, s.
            layout: valve layout, "3/2" or "in_out".
            slip_time: time constant with which contact friction stops a slip, s.
            preload: by how many times its static load each wheel is pressed down besides.

        Raises:
            InputError: an unknown wheel or layout, or a tick that is no multiple of the time step.
        """
        if wheels not in WHEELS:
            raise InputError(f"wheels '{wheels}' are unknown; allowed: {', '.join(WHEELS)}")
        whole_steps("tick", tick, "time step", timestep)
        self.spec, self.tick, self.timestep, self._wheels = spec, tick, timestep, wheels
        self._numerics = Numerics(
            timestep=timestep, hinges_per_segment=hinges_per_segment, slip_time=slip_time, preload=preload
        )
        supply = spec.supply.nominal if supply_pa is None else supply_pa
        self.pneumatics = LagPneumatics(spec, supply_pa=supply, layout=layout)
        self.physics = SnakePhysics.build(spec, self._numerics, self.pneumatics, supply_pa=supply)
        self.reset()

    def reset(self, *, pose: Pose = (0.0, 0.0, 0.0), seed: int = 0) -> SnakeState:
        """Lay the snake straight, at rest, chambers empty. Nothing is random here: `seed` is unused."""
        self.physics.lay_down(pose)
        self._ticks = 0
        self._theta = np.full(self.spec.geometry.connectors, float(pose[2]))
        return self._observe(0.0)

    def advance(self, valves: np.ndarray, samples: int) -> list[SnakeState]:
        """Advance one tick; see `Plant.advance`."""
        commands = self.pneumatics.slots(valves)
        steps = whole_steps("sample interval", self.tick / samples, "time step", self.timestep)
        begun = self._ticks * self.tick
        states = []
        for k, part in enumerate(_parts(commands, samples), start=1):
            now = begun + self.tick * k / samples
            self.physics.set_control(part)
            before = self.physics.data.qpos.copy(), self.physics.data.qvel.copy()
            _HEARD.clear()
            try:
                self.physics.step(steps)
            except PhysicsError as error:
                raise self._diverged(now, before) from error
            if not self._plausible():
                raise self._diverged(now, before)
            states.append(self._observe(now))
        self._ticks += 1
        return states

    def openings(self) -> np.ndarray:
        """Return how often each chamber's inlet has opened, shape (segments, 2)."""
        return self.pneumatics.openings

    def describe(self) -> dict[str, Any]:
        """Return the settings worth recording."""
        return super().describe() | {
            "wheels": self._wheels,
            "timestep_s": self.timestep,
            "hinges_per_segment": self._numerics.hinges_per_segment,
            "slip_time_s": self._numerics.slip_time,
            "preload": self._numerics.preload,
        }

    def _plausible(self) -> bool:
        data = self.physics.data
        return bool(np.abs(data.qvel).max() < _SPEED_LIMIT) and bool(np.isfinite(data.qpos).all())

    def _diverged(self, time: float, before: tuple[np.ndarray, np.ndarray]) -> DivergedError:
        """Go back to the state before and say what it was and what MuJoCo said."""
        said = " ".join(" ".join(dict.fromkeys(_HEARD)).split()) or "speeds beyond the plausible"
        physics = self.physics
        physics.data.qpos[:], physics.data.qvel[:] = before
        mujoco.mj_step1(physics.model.ptr, physics.data.ptr)
        x, y, z = physics.center_of_mass()
        bends = ", ".join(f"{bend:.3g}" for bend in physics.bend_angles())
        return DivergedError(
            self.name,
            time,
            f"{said}; before: centre of mass ({x:.3g}, {y:.3g}, {z:.3g}) m, heading "
            f"{self._theta.mean():.3g} rad, bends {bends} rad, largest speed {np.abs(before[1]).max():.3g} "
            "m/s or rad/s",
        )

    def _observe(self, time: float) -> SnakeState:
        physics = self.physics
        # Unwrap against the last sample: a connector turns by far less than π in between.
        wrapped = physics.connector_headings()
        self._theta = self._theta + np.remainder(wrapped - self._theta + np.pi, 2 * np.pi) - np.pi
        bend = physics.bend_angles()
        return SnakeState(
            time=time,
            com=physics.center_of_mass()[:2],
            com_velocity=physics.center_of_mass_velocity()[:2],
            heading=float(self._theta.mean()),
            position=physics.connector_positions()[:, :2],
            theta=self._theta,
            bend=bend,
            bend_rate=physics.bend_rates(),
            pressure=self.pneumatics.pressure,
            valves=self.pneumatics.valves,
            sensed=bend.copy(),
            contact_force=physics.floor_forces()[..., :2].sum(axis=1),
            qpos=physics.data.qpos.copy(),
        )


def _parts(commands: np.ndarray, samples: int) -> list[np.ndarray]:
    """Split the slots of a tick evenly over its samples."""
    if len(commands) % samples:
        commands = np.repeat(commands, samples, axis=0)
    return np.split(commands, samples)
