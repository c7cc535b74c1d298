r"""ClampedBends: a chain whose head is held fast; its bends are the free ones of Eq. 14, as on a bench.

Nothing but the clamp touches it, so that its motion is geometry. What its segments must exert follows from
the head to the tail and back: accelerations of the connectors outwards,

$$ a_{j+1} = a_j - (\ddot L - L\dot\psi^2)\,e(\psi) - (L\ddot\psi + 2\dot L\dot\psi)\,e_\perp(\psi), $$

with ψ the direction of chord j, and moments inwards: T_j is the force conjugate to the bend q_j.
"""

from __future__ import annotations

import math

import numpy as np

from srs_twin.compiled import compiled
from srs_twin.plants import kernels
from srs_twin.plants.base import Pose
from srs_twin.plants.floor import Floor
from srs_twin.plants.given import Body, Motion
from srs_twin.plants.kinematics import Solid, chord_terms
from srs_twin.pneumatics import Trace


class ClampedBends(Body):
    """A chain held at its head (module docstring)."""

    def __init__(self, solid: Solid, floor: Floor) -> None:
        # In the air: the floor of the others takes no part.
        super().__init__(solid, floor._replace(mu_t=0.0, mu_n=0.0))

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`; the head stays where it is then."""
        self.state = np.zeros(kernels.STATES)
        self.state[:3] = pose
        self.velocity = np.zeros(3)
        mass = self.solid.mass
        pitch = self.solid.length + self.solid.gap
        ahead = pitch * float(np.arange(len(mass)) @ mass) / float(mass.sum())
        x, y, heading = pose
        self._head = np.array([x + ahead * math.cos(heading), y + ahead * math.sin(heading), heading])

    def move(self, steps: np.ndarray, trace: Trace, marks: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`; `look` finds out where the chain is."""
        return len(steps), np.zeros((len(marks), kernels.STATES)), np.zeros((len(marks), 3))

    def look(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """See `Body.look`; where the chain is follows from its bends alone."""
        torque = np.empty_like(trace.bend)
        hang(
            trace.bend, trace.bend_rate, trace.bend_acceleration, self.solid, self._head,
            states, velocities, torque,
        )  # fmt: skip
        return Motion(states, velocities, trace.bend, trace.bend_rate, torque)


@compiled
def hang(bends, rates, accelerations, solid, head, states, velocities, torque):  # type: ignore[no-untyped-def]
    """Fill what follows from the bends of a chain that is held at its head.

    Args:
        bends: shape (samples, segments), rad.
        rates: same shape, rad/s.
        accelerations: same shape, rad/s².
        solid: the chain.
        head: where it is held: x, y (m), heading (rad).
        states: out, pose and velocity of the centre of mass by the indices in `kernels`, world frame.
        velocities: out, the same velocity in the mean-heading frame and the mean spin, shape (samples, 3).
        torque: out, net moments that the bends need, shape (samples, segments), N·m.
    """
    n, total = solid.mass.shape[0], solid.mass.sum()
    place, pull, gain = np.empty((n, 2)), np.empty((n, 2)), np.empty(n)
    lever = np.empty((n - 1, 2))
    for k in range(bends.shape[0]):
        angle, spin, mean, mean_spin = head[2], 0.0, head[2], 0.0
        gain[0] = 0.0
        place[0], pull[0] = 0.0, 0.0
        v_x = v_y = com_x = com_y = com_vx = com_vy = 0.0
        for j in range(n - 1):
            q, dq, ddq = bends[k, j], rates[k, j], accelerations[k, j]
            psi, turn, twist = angle - q / 2, spin - dq / 2, gain[j] - ddq / 2
            angle, spin, gain[j + 1] = angle - q, spin - dq, gain[j] - ddq
            _, _, span, slope, curvature = chord_terms(q, solid)
            stretch, swell = slope * dq, curvature * dq * dq + slope * ddq
            inward, aside = swell - span * turn * turn, span * twist + 2 * stretch * turn
            c, s = math.cos(psi), math.sin(psi)
            place[j + 1, 0], place[j + 1, 1] = place[j, 0] - span * c, place[j, 1] - span * s
            v_x, v_y = v_x - stretch * c + span * turn * s, v_y - stretch * s - span * turn * c
            pull[j + 1, 0] = pull[j, 0] - inward * c + aside * s
            pull[j + 1, 1] = pull[j, 1] - inward * s - aside * c
            # The bend's lever on what is behind: the chord shortens, and turns by half of the bend.
            lever[j, 0], lever[j, 1] = -slope * c - span / 2 * s, -slope * s + span / 2 * c
            share = solid.mass[j + 1] / total
            com_x, com_y = com_x + share * place[j + 1, 0], com_y + share * place[j + 1, 1]
            com_vx, com_vy = com_vx + share * v_x, com_vy + share * v_y
            mean, mean_spin = mean + (angle - head[2]) / n, mean_spin + spin / n
        states[k, kernels.X], states[k, kernels.Y] = head[0] + com_x, head[1] + com_y
        states[k, kernels.HEADING] = mean
        states[k, kernels.VX], states[k, kernels.VY] = com_vx, com_vy
        c, s = math.cos(mean), math.sin(mean)
        velocities[k, 0], velocities[k, 1] = com_vx * c + com_vy * s, com_vy * c - com_vx * s
        velocities[k, 2] = mean_spin
        push_x = push_y = moment = 0.0
        for j in range(n - 2, -1, -1):
            # Of all behind segment j: net force, and its moment about the connector at its rear end.
            if j < n - 2:
                arm_x, arm_y = place[j + 2, 0] - place[j + 1, 0], place[j + 2, 1] - place[j + 1, 1]
                moment += arm_x * push_y - arm_y * push_x
            push_x += solid.mass[j + 1] * pull[j + 1, 0]
            push_y += solid.mass[j + 1] * pull[j + 1, 1]
            moment += solid.inertia[j + 1] * gain[j + 1]
            torque[k, j] = lever[j, 0] * push_x + lever[j, 1] * push_y - moment
