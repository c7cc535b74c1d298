r"""Spatial body without inertia, for the model `quasistatic`.

A segment is an arc of constant curvature and twist. The rotation vector w describes the
rotation from the frame of the segment's rear connector to the frame of the front
connector. The components z, −y and x of w are the bend to the left, the bend upwards
and the twist. The generalised coordinates are the pose of the head connector and the
bends q and twists of all segments. The body has the radius r, and weight and contact
forces act at points along its axis.

**Equilibrium.** Without inertia, the forces are balanced at all times. The chambers
impose the free bends q̂, and the segments resist deviations from q̂ with stiffness k
and damping c. Point i has height z_i, mass m_i and normal load N_i. In a time step of
length h, the velocities of the coordinates minimise

$$ \tfrac12 k\,(q + h\dot q - \hat q)^2 + \tfrac h2 c\,(\dot q - \dot{\hat q})^2
   + \sum_i m_i g\,h \dot z_i + \tfrac{\kappa_i}2 \max(0, r - z_i - h\dot z_i)^2 + h
   \sum_i N_i D(s_i) + \tfrac h2 \sum_i \frac{m_i}{\tau}(\dot z_i^2 + \dot\rho_i^2). $$

The first three terms are the elastic energy, the dissipation in the segments, and the
change of the potential energy. The floor at point i has the stiffness κ_i = m_i g/δ, so
that a resting point sinks by δ. D(s_i) is the dissipation potential of the friction
law. The slip s_i is the velocity of the material point vertically below the axis. The
last term is a drag with the time constant τ. A body at rest therefore has minimum
potential energy, and a moving body dissipates minimum power on the floor.

The normal loads N_i in the friction term depend on the solution. Each step is therefore
solved up to four times, with the loads of the previous solution. Friction laws without
a potential, such as `cosine`, cannot be used, because no function could be minimised.

**Jumps.** The resting pose can become unstable. A real body then topples within a time
that depends on its inertia. In this model, inertia is replaced by the drag, which acts
on the vertical velocity ż_i and on the rolling velocity ρ̇_i of the surface. Between
jumps, the drag changes the loads by the fraction ż/(g τ), which is below 0.01. The
model counts a jump when the speed of a point exceeds √(g r)/4.

**Validity.** Inertia may be neglected if the inertia number (2πf)² A/(μ g) is small,
where f is the gait frequency, A is the amplitude of the lateral motion, and μ is the
friction coefficient. The sag number m g λ²/(k p) measures how far the weight bends the
body between its supports. Here λ is the wavelength along the body, m is the mass within
a wavelength, and p is the distance between connectors.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from srs_twin.errors import InputError
from srs_twin.plants.analytical import spatial_kinematics as kinematics
from srs_twin.plants.analytical.bodies import Body, Motion
from srs_twin.plants.analytical.quasistatic_kernels import advance
from srs_twin.plants.base import Pose, SpatialState
from srs_twin.pneumatics import Trace
from srs_twin.robot.spec import GRAVITY, RobotSpec

_DEPTH_RATIO = 1 / 2000
"""Depth by which a resting point sinks into the floor, relative to the body radius."""
_DRAG_TIME_S = 0.5
"""Time constant τ of the drag on vertical motion and rolling at a time unit of 1, s."""
_MOVE_RATIO = 0.05
"""Maximum displacement of a point in a substep, relative to the body radius."""
_JUMP_RATIO = 0.25
"""Speed of a point above which a jump is counted, relative to √(g r)."""


def make_constants(
    spec: RobotSpec, slip_speed: float, base: str
) -> kinematics.QuasistaticBody:
    """Compute the constants of a robot on a level floor or with its head clamped.

    Args:
        spec: robot whose segments bend in two directions.
        slip_speed: slip speed ε of the friction law, m/s.
        base: support of the body, "free" or "clamped".

    Raises:
        InputError: the friction law has no potential, or the segments can lengthen.
    """
    g = spec.geometry
    bending = spec.bending
    mu = spec.friction
    skin = spec.skin
    assert skin is not None and spec.mass.segments is not None, (
        "spatial robots have a skin"
    )
    if skin.friction_law != "ellipse":
        raise InputError(
            "model 'quasistatic' does not support the friction law"
            f" {skin.friction_law!r}, because it has no potential; set `contact.law`"
            " of the robot to 'ellipse'"
        )
    if spec.actuator.extension:
        raise InputError(
            "model 'quasistatic' supports only segments of constant length; remove"
            " `actuator.extension`"
        )
    place = (np.arange(skin.points) + 0.5) / skin.points * g.pitch
    half_gap = g.rigid_gap / 2
    radius = g.com_height
    stiffness = np.array(
        [bending.stiffness, bending.pitch_stiffness, bending.roll_stiffness]
    )
    times = np.array(
        [bending.damping_time, bending.damping_time, bending.out_of_plane_damping_time]
    )
    return kinematics.QuasistaticBody(
        fraction=np.clip((place - half_gap) / g.segment_length, 0.0, 1.0),
        front=np.minimum(place, half_gap),
        rear=np.maximum(0.0, place - half_gap - g.segment_length),
        mass=np.repeat(np.array(spec.mass.segments) / skin.points, skin.points),
        length=g.segment_length,
        gap=half_gap,
        stiffness=stiffness,
        damping=stiffness * times,
        radius=radius,
        depth=radius * _DEPTH_RATIO,
        friction=kinematics.SkinFriction(mu.mu_t, mu.backward, mu.mu_n, slip_speed),
        drag_time=_DRAG_TIME_S * spec.scale.time,
        longest_move=radius * _MOVE_RATIO,
        jump_speed=_JUMP_RATIO * math.sqrt(GRAVITY * radius),
        free=1.0 if base == "free" else 0.0,
    )


class QuasistaticArcs(Body):
    """Body of the model `quasistatic`, with states as in `spatial_kinematics`.

    Attributes:
        constants: constant parameters of the body and the floor.
        workspace: work arrays of a time step.
    """

    state_attributes: ClassVar[tuple[str, ...]] = ("_sampled", "_connector_heading")

    def __init__(self, spec: RobotSpec, slip_speed: float, base: str) -> None:
        """Create the body from the arguments of `make_constants`."""
        self._spec = spec
        self.constants = make_constants(spec, slip_speed, base)
        points = len(self.constants.mass)
        self.workspace = kinematics.work_arrays(spec.segments, points // spec.segments)
        self._impulses = slice(
            kinematics.BENDS + 3 * spec.segments,
            kinematics.BENDS + 3 * (spec.segments + points),
        )
        self._shapes = self._impulses.stop + points, 6 + 3 * spec.segments
        stations = (np.arange(points) + 0.5) * spec.geometry.body_length / points
        self._weights = spec.connector_weights(stations)

    @property
    def jumps(self) -> int:
        """See `Body.jumps`."""
        return int(self.state[kinematics.JUMPS])

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`. The segments start with their rest bends."""
        self.state, self.velocity = map(np.zeros, self._shapes)
        constants = self.constants
        segments = self._spec.segments
        bends = self.state[kinematics.BENDS :][: 3 * segments].reshape(segments, 3)
        bends[:, 0] = self._spec.modules.array("bias")
        self.state[self._impulses.stop :] = constants.mass * GRAVITY * constants.free
        self._turn_head(0.0)
        self._pose(self.state)
        turn = pose[2] - self._headings().mean()
        self._turn_head(turn)
        self._pose(self.state)
        self.state[:2] = np.array(pose[:2]) - self._com()[:2]
        self.state[2] = constants.radius - constants.depth
        self._sampled = self._exchanged(self.state[None])[0]
        self._connector_heading = np.full(segments + 1, float(pose[2]))

    def set_state(
        self, velocity: np.ndarray, bend: np.ndarray, rate: np.ndarray
    ) -> None:
        """Raise an `InputError`, because the body can only start straight at rest."""
        raise InputError("model 'quasistatic' can only start straight and at rest")

    def move(
        self, steps: np.ndarray, trace: Trace, sample_steps: np.ndarray
    ) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`."""
        samples = self._allocate(len(sample_steps))
        now = kinematics.QuasistaticState(self.state, self.velocity)
        free = np.ascontiguousarray(trace.bend[::2])
        done: int = advance(
            now, steps, free, sample_steps, self.constants, self.workspace, samples
        )
        return done, *samples

    def motion(
        self, states: np.ndarray, velocities: np.ndarray, trace: Trace
    ) -> Motion:
        """See `Body.motion`. Bends and moments have shape (samples, segments, 2)."""
        shape = len(states), self._spec.segments, 3
        bend = states[:, kinematics.BENDS : self._impulses.start].reshape(shape)[
            ..., :2
        ]
        rate = velocities[:, 6:].reshape(shape)[..., :2]
        stiffness = self.constants.stiffness[:2]
        damping = self.constants.damping[:2]
        torque = stiffness * (trace.bend - bend) + damping * (trace.bend_rate - rate)
        return Motion(states, velocities, bend, rate, torque)

    def observe(
        self, time: np.ndarray, motion: Motion, trace: Trace, measured_bend: np.ndarray
    ) -> SpatialState:
        """Return a history of the observable states.

        Args:
            time: times of the samples, shape (samples,), s.
            motion: motion at these times.
            trace: chamber states at these times.
            measured_bend: bends measured by the sensors, shape (samples, segments, 2),
                rad.
        """
        count = len(time)
        n = self._spec.geometry.connectors
        com = np.empty((count, 3))
        velocity = np.empty((count, 3))
        position = np.empty((count, n, 3))
        frame = np.empty((count, n, 3, 3))
        connector_heading = np.empty((count, n))
        for k, state in enumerate(motion.states):
            self._pose(state)
            position[k] = self.workspace.position
            frame[k] = self.workspace.frame
            connector_heading[k] = self._headings()
            com[k] = self._com()
            velocity[k] = self._mean(
                self.workspace.motion[:, :3] @ motion.velocities[k]
            )
        connector_heading = np.unwrap(
            np.concatenate([self._connector_heading[None], connector_heading]), axis=0
        )[1:]
        exchanged = self._exchanged(motion.states)
        interval = np.diff(exchanged, axis=0, prepend=self._sampled[None])
        if count:
            self._connector_heading = connector_heading[-1].copy()
            self._sampled = exchanged[-1]
        impulse = interval[:, :-1].reshape(count, len(self.constants.mass), 3)
        impulse /= np.maximum(interval[:, -1:, None], 1e-12)
        force = np.einsum("ik,skc->sic", self._weights, impulse)
        return SpatialState(
            time=time,
            com=com[:, :2],
            com_velocity=velocity[:, :2],
            heading=connector_heading.mean(axis=1),
            position=position[..., :2],
            connector_heading=connector_heading,
            bend=motion.bend,
            bend_rate=motion.bend_rate,
            pressure=trace.pressure,
            valves=trace.valves,
            measured_bend=measured_bend,
            contact_force=force[..., :2],
            obstacle_force=np.zeros((count, n, 2)),
            torque=motion.torque,
            work=motion.states[:, kinematics.WORK],
            internal_loss=motion.states[:, kinematics.INTERNAL_LOSS],
            pneumatic_energy=trace.pneumatic_energy,
            qpos=np.empty((count, 0)),
            height=position[..., 2],
            orientation=quaternions(frame),
            load=force[..., 2],
        )

    def _pose(self, state: np.ndarray) -> None:
        kinematics.pose(state, self.constants, self.workspace)

    def _turn_head(self, heading: float) -> None:
        c = math.cos(heading)
        s = math.sin(heading)
        self.state[kinematics.ROTATION :][:9] = c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0

    def _headings(self) -> np.ndarray:
        frame: np.ndarray = self.workspace.frame
        headings: np.ndarray = np.arctan2(frame[:, 1, 0], frame[:, 0, 0])
        return headings

    def _com(self) -> np.ndarray:
        return self._mean(self.workspace.point)

    def _mean(self, values: np.ndarray) -> np.ndarray:
        mass = self.constants.mass
        mean: np.ndarray = mass @ values / mass.sum()
        return mean

    def _exchanged(self, states: np.ndarray) -> np.ndarray:
        return np.hstack(
            [states[:, self._impulses], states[:, kinematics.CLOCK :][:, :1]]
        )


def quaternions(frames: np.ndarray) -> np.ndarray:
    """Convert rotation matrices to unit quaternions (w, x, y, z) with w ≥ 0."""
    from scipy.spatial.transform import Rotation

    turns: np.ndarray = Rotation.from_matrix(frames.reshape(-1, 3, 3)).as_quat(
        canonical=True, scalar_first=True
    )
    return turns.reshape(*frames.shape[:-2], 4)
