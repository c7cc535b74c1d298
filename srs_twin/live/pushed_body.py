r"""Motion and segment moments of a crawling snake under a lateral contact force.

The bends q(t) are periodic and known, so the motion of the body is described by a
vector u of three velocities. The vector u contains the velocity of the centre of mass
in the frame of the mean heading, and the yaw rate ω. Each connector has two wheels with
Jacobians J_c(q) and floor friction forces f_c (`robot.friction`). The equations of
motion are

$$ M \dot v = \sum f_c + F n, \qquad
\frac{d}{dt}(I(q)\,\omega + h(q, \dot q)) = \sum r_c \times f_c + r_s \times F n,
\qquad v_c = J_c u + b_c . $$

The module `plants.analytical.kernels` defines the inertia I and the angular momentum h
due to the bend rates. The contact force F acts along the body normal n at a distance s
behind the first connector. The stiff friction forces are integrated with the linearly
implicit Euler method.

**Moments.** The moment on segment j is the sum of the moments of all loads in front of
the segment about the midpoint of its chord. The loads are the friction forces, the
inertial forces of the connectors and the contact force F. If F acts on segment j
itself, the moment of F is averaged over the arc of the segment. Inertial forces due to
the bend rates are omitted, because they are equal with and without contact.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from srs_twin.robot import friction
from srs_twin.robot.geometry import body_shape, relative_headings
from srs_twin.robot.spec import GRAVITY, RobotSpec

SUBSTEP_S = 0.01
"""Maximum time step of the simulation, at a time unit of 1 (`robot.scale`), s.

A time step of 4 ms changes the median error of the estimated force by less than 1 %
(docs/objects.md).
"""
SLIP_SPEED_M_S = 0.005
"""Slip speed below which friction is viscous, at a time unit of 1 (`robot.scale`), m/s.
"""
_SETTLING_S = 3.0
"""Time after which the motion without contact is periodic, at a time unit of 1, s."""


class _Motion(NamedTuple):
    """Motion of the N connectors relative to the centre of mass during one period.

    Vectors refer to the frame of the mean heading and have shape (steps, N, 2).

    Attributes:
        place: positions of the connectors, m.
        forward: unit vectors along the connectors.
        lateral: unit vectors to the left of the connectors.
        rate: time derivatives of the positions, m/s.
        spin: time derivatives of the headings, shape (steps, N), rad/s.
    """

    place: np.ndarray
    forward: np.ndarray
    lateral: np.ndarray
    rate: np.ndarray
    spin: np.ndarray

    def every(self, steps: int) -> _Motion:
        return _Motion(*(values[::steps] for values in self))

    @property
    def middle(self) -> np.ndarray:
        """Midpoints of the segment chords, m."""
        return np.asarray((self.place[:, :-1] + self.place[:, 1:]) / 2)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


class PushedBody:
    """Snake with periodic bends and a contact force at one of several positions.

    Attributes:
        free_velocity: velocities u without a contact force, shape (period, 3), m/s and
            rad/s.
        free_moment: segment moments without a contact force, shape (period, segments),
            N·m.
    """

    def __init__(
        self, spec: RobotSpec, bends: np.ndarray, sample_s: float, stations: np.ndarray
    ) -> None:
        """Compute the Jacobians of one period, and simulate the motion without contact.

        Args:
            spec: robot specification.
            bends: bends at the samples of one period, shape (period, segments), rad.
            sample_s: time between samples, s.
            stations: distances from the first connector to the possible contact
                positions, shape (stations,), m.
        """
        self._spec = spec
        g = spec.geometry
        unit = spec.scale.time
        self._steps = max(1, round(sample_s / (SUBSTEP_S * unit)))
        self._h = sample_s / self._steps
        self._mass = spec.mass.array()
        period = len(bends)
        count = period * self._steps
        knots = np.arange(period + 1) * sample_s
        spline = CubicSpline(
            knots, np.concatenate([bends, bends[:1]]), bc_type="periodic"
        )
        q = spline(np.arange(count) * self._h)
        place = body_shape(q, self._mass, g.segment_length, g.rigid_gap)
        angle = relative_headings(q)
        forward = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        lateral = np.stack([-forward[..., 1], forward[..., 0]], axis=-1)
        motion = _Motion(place, forward, lateral, self._rate(place), self._rate(angle))
        self._tabulate_wheels(motion)
        squares = self._mass * (place**2).sum(axis=-1)
        self._inertia = (squares + spec.yaw_inertia()).sum(axis=-1)
        self._growth = self._rate(self._inertia)
        momenta = self._mass * _cross(place, motion.rate)
        self._relative = (momenta + spec.yaw_inertia() * motion.spin).sum(axis=-1)
        self._tabulate_moments(motion.every(self._steps))
        self._tabulate_push(motion, stations)
        self.free_velocity = np.zeros((period, 3))
        self.free_moment = np.zeros((period, spec.segments))
        u = np.zeros((1, 3))
        none = np.zeros(1)
        laps = int(np.ceil(_SETTLING_S * unit / (period * sample_s))) + 1
        for k in range(1, laps * period + 1):
            u, moment = self.step(k, u, none, np.zeros(1, dtype=int))
            self.free_velocity[k % period] = u[0]
            self.free_moment[k % period] = moment[0]

    def _rate(self, table: np.ndarray) -> np.ndarray:
        return np.asarray(
            (np.roll(table, -1, axis=0) - np.roll(table, 1, axis=0)) / (2 * self._h)
        )

    def _tabulate_wheels(self, motion: _Motion) -> None:
        arm = self._spec.geometry.half_track
        jacobian = []
        drift = []
        for direction in (motion.forward, motion.lateral):
            for side in (arm, -arm):
                turn = _cross(motion.place + side * motion.lateral, direction)
                jacobian.append(np.concatenate([direction, turn[..., None]], axis=-1))
                speed = (motion.rate * direction).sum(axis=-1)
                if direction is motion.forward:
                    speed -= motion.spin * side
                drift.append(speed)
        self._jacobian = np.concatenate(jacobian, axis=1)
        self._drift = np.concatenate(drift, axis=1)
        along, across = np.split(self._jacobian, 2, axis=1)
        products = [
            np.einsum("gca,gcb->gcab", first, second).reshape(*along.shape[:2], 9)
            for first in (along, across)
            for second in (along, across)
        ]
        self._products = np.concatenate(products, axis=1)

    def _tabulate_moments(self, motion: _Motion) -> None:
        place = motion.place[:, None]
        n = self._spec.segments
        front = np.arange(n + 1) <= np.arange(n)[:, None]
        arms = front[..., None] * (place - motion.middle[:, :, None])
        mass = self._mass[:, None]
        x = -(arms[..., 1:] * mass).sum((2, 3))
        y = (arms[..., :1] * mass).sum((2, 3))
        squares = self._mass * (arms * place).sum(-1)
        turn = (squares + front * self._spec.yaw_inertia()).sum(-1)
        on_acceleration = np.stack([x, y, turn], axis=-1)
        self._on_acceleration = on_acceleration.transpose(0, 2, 1)
        self._on_square = (self._mass * _cross(arms, place)).sum(-1)
        speeds = (arms * motion.rate[:, None]).sum(-1)
        self._on_rate = 2 * (self._mass * speeds).sum(-1)
        # The Jacobian contains the moments of unit wheel forces about the centre of
        # mass, which are converted to moments about the midpoints of the chords.
        jacobian = self._jacobian[:: self._steps, :, None]
        moved = jacobian[..., 2] - _cross(motion.middle[:, None], jacobian[..., :2])
        self._on_friction = np.tile(front.T, (4, 1)) * moved

    def _tabulate_push(self, motion: _Motion, stations: np.ndarray) -> None:
        g = self._spec.geometry
        n = self._spec.segments
        j = np.minimum((stations / g.pitch).astype(int), n - 1)
        fraction = (stations / g.pitch - j)[:, None]
        point = (1 - fraction) * motion.place[:, j] + fraction * motion.place[:, j + 1]
        normal = (1 - fraction) * motion.lateral[:, j] + fraction * motion.lateral[
            :, j + 1
        ]
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        self._push = np.concatenate([normal, _cross(point, normal)[..., None]], axis=-1)
        arms = (
            point[:: self._steps, :, None] - motion.every(self._steps).middle[:, None]
        )
        moments = _cross(arms, normal[:: self._steps, :, None])
        self._on_push = np.where(j[:, None] < np.arange(n), moments, 0.0)
        # The lever arm max(c - s, 0) of the force is averaged over the cross-sections c
        # of the arc.
        begin = g.rigid_gap / 2
        end = g.rigid_gap / 2 + g.segment_length
        behind = fraction[:, 0] * g.pitch
        at = np.clip(behind, begin, end)
        lever = (end - at) ** 2 / (2 * g.segment_length)
        lever += np.maximum(begin - behind, 0.0)
        self._on_push[:, np.arange(len(stations)), j] += lever

    def step(
        self, k: int, u: np.ndarray, force: np.ndarray, station: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advance several bodies by one sample interval.

        Args:
            k: index of the sample at the end of the step.
            u: velocities u at sample k − 1, shape (bodies, 3), m/s and rad/s.
            force: contact force F on each body, positive to the left, shape (bodies,),
                N.
            station: index of the contact position at which the force acts, shape
                (bodies,).

        Returns:
            Velocities u at sample k, shape (bodies, 3), and moments on the segments,
            shape (bodies, segments), N·m.
        """
        total = self._mass.sum()
        inertia = self._inertia
        h = self._h
        for i in range(self._steps):
            g = ((k - 1) * self._steps + i + 1) % len(inertia)
            # Without forces, the velocity in the world frame and the angular momentum
            # are constant, while the frame of the mean heading turns by `turned`.
            forward, lateral, yaw = u.T
            spin = inertia[g - 1] * yaw + self._relative[g - 1] - self._relative[g]
            turned = h * yaw
            u = np.stack(
                [
                    forward + turned * lateral,
                    lateral - turned * forward,
                    spin / inertia[g],
                ],
                axis=-1,
            )
            push = force[:, None] * self._push[g, station]
            wheels, derivative = self._friction(g, u)
            # The linearly implicit Euler method solves (M - h df/du) Δu = h f.
            matrix = np.diag([total, total, inertia[g]]) - h * derivative
            impulse = h * (wheels @ self._jacobian[g] + push)
            u = u + np.linalg.solve(matrix, impulse[..., None])[..., 0]
        wheels, _ = self._friction(g, u)
        # The moments are caused by the wheel forces, the contact force, the yaw rate w
        # (centrifugal and Coriolis terms) and the acceleration of the body.
        load = wheels @ self._jacobian[g] + push
        load[:, 2] -= self._growth[g] * u[:, 2]
        s = g // self._steps
        w = u[:, 2:]
        moment = wheels @ self._on_friction[s]
        moment += force[:, None] * self._on_push[s, station]
        moment += self._on_square[s] * w**2 - self._on_rate[s] * w
        moment -= load / [total, total, inertia[g]] @ self._on_acceleration[s]
        return u, moment

    def _friction(self, g: int, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the wheel forces, and the derivative of their resultant.

        The shapes are (bodies, 4N) and (bodies, 3, 3).
        """
        spec = self._spec
        mu = spec.friction
        friction_law = getattr(
            friction, spec.skin.friction_law if spec.skin else "wheel"
        )
        along, across = np.split(u @ self._jacobian[g].T + self._drift[g], 2, axis=1)
        load = np.tile(self._mass, 2) * GRAVITY / 2
        mu_t = mu.mu_t + mu.drag / (self._mass.sum() * GRAVITY)
        slip_speed = SLIP_SPEED_M_S * spec.scale.speed
        t, n, *derivatives = friction_law(
            along, across, load, mu_t, mu.mu_n, slip_speed
        )
        sum_of_derivatives = np.concatenate(derivatives, axis=-1) @ self._products[g]
        return np.concatenate([t, n], axis=-1), sum_of_derivatives.reshape(-1, 3, 3)
