r"""ClampedBends: a chain whose head is held fast; its bends are the free ones of Eq. 14, as on a bench.

Nothing but the clamp touches it, so that its motion is geometry. What its segments must exert follows from
the head to the tail and back: accelerations of the connectors outwards,

$$ a_{j+1} = a_j - (\ddot L - L\dot\psi^2)\,e(\psi) - (L\ddot\psi + 2\dot L\dot\psi)\,e_\perp(\psi), $$

with ψ the direction of chord j, and moments inwards: T_j is the force conjugate to the bend q_j.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srs_twin import shape
from srs_twin.plants import kernels
from srs_twin.plants.base import Pose
from srs_twin.plants.floor import Floor
from srs_twin.plants.given import Body, Motion
from srs_twin.plants.kinematics import Solid
from srs_twin.pneumatics import Trace


class ClampedBends(Body):
    """A chain held at its head (module docstring)."""

    def __init__(self, solid: Solid, floor: Floor) -> None:
        # In the air: the floor of the others takes no part.
        super().__init__(solid, floor._replace(mu_t=0.0, mu_n=0.0))

    def reset(self, pose: Pose) -> None:
        """See `Body.reset`; the head stays where it is then."""
        self._pose = pose
        self.state = np.zeros(kernels.STATES)
        self.state[:3] = pose
        self.velocity = np.zeros(3)
        mass = self.solid.mass
        pitch = self.solid.length + self.solid.gap
        self._ahead = pitch * float(np.arange(len(mass)) @ mass) / float(mass.sum())

    def move(self, steps: np.ndarray, trace: Trace, marks: np.ndarray) -> tuple[int, np.ndarray, np.ndarray]:
        """See `Body.move`; `look` finds out where the chain is."""
        return len(steps), np.zeros((len(marks), kernels.STATES)), np.zeros((len(marks), 3))

    def look(self, states: np.ndarray, velocities: np.ndarray, trace: Trace) -> Motion:
        """See `Body.look`; where the chain is follows from its bends alone."""
        chain = _Chain.of(trace.bend, trace.bend_rate, trace.bend_acceleration, self.solid)
        mass = self.solid.mass / self.solid.mass.sum()
        mean, rate = chain.angle.mean(axis=1), chain.spin.mean(axis=1)
        x, y, heading = self._pose
        turned = np.exp(1j * heading)
        centre = complex(x, y) + turned * (chain.place @ mass + self._ahead)
        velocity = turned * (chain.velocity @ mass)
        ahead = velocity * np.exp(-1j * (heading + mean))
        found = np.zeros((len(mean), kernels.STATES))
        found[:, kernels.X], found[:, kernels.Y], found[:, kernels.HEADING] = (
            centre.real,
            centre.imag,
            heading + mean,
        )
        found[:, kernels.VX], found[:, kernels.VY] = velocity.real, velocity.imag
        moving = np.stack([ahead.real, ahead.imag, rate], axis=1)
        return Motion(found, moving, trace.bend, trace.bend_rate, chain.moments(self.solid))


@dataclass(frozen=True)
class _Chain:
    """Places, velocities and accelerations of the connectors in the frame of the head, as complex numbers.

    Attributes:
        angle, spin, gain: headings (rad), their rates and accelerations, shape (samples, N).
        place, velocity, acceleration: shape (samples, N), m.
        direction: e(ψ) of each chord, shape (samples, segments).
        span, slope: L (m) and dL/dq (m/rad) of each chord, same shape.
    """

    angle: np.ndarray
    spin: np.ndarray
    gain: np.ndarray
    place: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    direction: np.ndarray
    span: np.ndarray
    slope: np.ndarray

    @classmethod
    def of(cls, bend: np.ndarray, rate: np.ndarray, acceleration: np.ndarray, solid: Solid) -> _Chain:
        """Return the chain with these bends (rad), rates and accelerations, shape (samples, segments)."""
        angle, spin, gain = (_behind(-values) for values in (bend, rate, acceleration))
        psi, turn, twist = ((each[:, 1:] + each[:, :-1]) / 2 for each in (angle, spin, gain))
        span, slope, curvature = shape.chords(bend, solid.length, solid.gap)
        if solid.frozen:
            span, slope, curvature = np.full_like(span, solid.length + solid.gap), 0 * slope, 0 * curvature
        stretch, swell = slope * rate, curvature * rate**2 + slope * acceleration
        e = np.exp(1j * psi)
        inward, aside = swell - span * turn**2, span * twist + 2 * stretch * turn
        return cls(
            angle, spin, gain,
            place=_behind(-span * e),
            velocity=_behind(-(stretch + 1j * span * turn) * e),
            acceleration=_behind(-(inward + 1j * aside) * e),
            direction=e, span=span, slope=slope,
        )  # fmt: skip

    def moments(self, solid: Solid) -> np.ndarray:
        """Return the net moments T_j that the bends need, shape (samples, segments), N·m."""
        segments = self.span.shape[1]
        found = np.empty(self.span.shape)
        push = np.zeros(len(found), dtype=complex)
        twist = np.zeros(len(found))
        for j in range(segments - 1, -1, -1):
            # Of all behind segment j: net force, and its moment about the connector at its rear end.
            if j < segments - 1:
                arm = self.place[:, j + 2] - self.place[:, j + 1]
                twist += (arm.conj() * push).imag
            own = solid.mass[j + 1] * self.acceleration[:, j + 1]
            push, twist = push + own, twist + solid.inertia[j + 1] * self.gain[:, j + 1]
            lever = (-self.slope[:, j] + 0.5j * self.span[:, j]) * self.direction[:, j]
            found[:, j] = (lever.conj() * push).real - twist
        return found


def _behind(steps: np.ndarray) -> np.ndarray:
    """Return what the steps from connector to connector add up to, 0 at the head; one column more."""
    start = np.zeros_like(steps[:, :1])
    found: np.ndarray = np.concatenate([start, np.cumsum(steps, axis=1)], axis=1)
    return found
