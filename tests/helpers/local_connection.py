"""Motion of a chain of connectors without inertia, from the local connection of its friction.

The module is independent of the plants. Either the friction of a connector is linear in
its slip, or its wheels do not slip sideways. Three equations then determine the
velocity of the body from the bend rates: ξ = −A(q) q̇ (Kelly and Murray 1995).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from curvature_wave import Path, continuous_snake
from scipy.integrate import solve_ivp

from srs_twin.robot.spec import Friction, RobotSpec


def wheeled(segments: int, friction: Friction) -> RobotSpec:
    """Return a snake of 1 m on wheels, whose segments bend over their whole length."""
    spec = continuous_snake(
        friction.mu_t, friction.mu_t, friction.mu_n, segments=segments
    )
    connectors = (1.0 / (segments + 1),) * (segments + 1)
    return replace(
        spec,
        skin=None,
        friction=friction,
        mass=replace(spec.mass, connectors=connectors, segments=None),
    )


def chain(q: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and headings of all connectors relative to the first, for arcs of one length."""
    heading = np.concatenate([[0.0], -np.cumsum(q)])
    chord = length * np.sinc(q / (2 * math.pi))
    middle = heading[:-1] - q / 2
    steps = -chord[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]), heading


def velocity(
    q: np.ndarray, rate: np.ndarray, spec: RobotSpec, *, slips: bool
) -> np.ndarray:
    """Return the velocity of connector 1 in its own frame, m/s and rad/s.

    Args:
        q: bends, rad.
        rate: bend rates, rad/s.
        spec: robot, for its lengths, loads and coefficients.
        slips: whether friction is proportional to the slip (`viscous`); else wheels do
            not slip sideways, which three connectors determine.
    """
    length = spec.geometry.segment_length
    small = 1e-6
    place, heading = chain(q, length)
    ahead, behind = (chain(q + side * small * rate, length) for side in (1, -1))
    place_rate, heading_rate = (
        (a - b) / (2 * small) for a, b in zip(ahead, behind, strict=True)
    )
    tangent = np.stack([np.cos(heading), np.sin(heading)], axis=1)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    # The velocity of connector i is place_rate + motions[i] @ ξ.
    motions = np.stack([np.eye(2)] * len(place))
    motions = np.concatenate(
        [motions, np.stack([-place[:, 1], place[:, 0]], axis=1)[:, :, None]], axis=2
    )
    if not slips:
        rows = np.einsum("ik,ikn->in", normal, motions)
        return np.asarray(
            np.linalg.solve(rows, -np.einsum("ik,ik->i", normal, place_rate))
        )
    load = np.array(spec.mass.connectors)
    drag = spec.friction.mu_t * np.einsum("ik,il->ikl", tangent, tangent)
    drag += spec.friction.mu_n * np.einsum("ik,il->ikl", normal, normal)
    drag *= load[:, None, None]
    resistance = np.einsum("ikm,ikl,iln->mn", motions, drag, motions)
    driven = np.einsum("ikm,ikl,il->m", motions, drag, place_rate)
    return np.asarray(np.linalg.solve(resistance, -driven))


def loop(middle: Sequence[float], radius: float, period: float = 60.0) -> Path:
    """Return a circular shape path: each bend moves about its middle value, 90° after the one ahead of it."""
    lags = -math.pi / 2 * np.arange(len(middle))
    omega = 2 * math.pi / period

    def path(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        angle = omega * time[:, None] + lags
        cosine = radius * np.cos(angle)
        sine = radius * np.sin(angle)
        return np.array(middle) + cosine, -omega * sine, -(omega**2) * cosine

    return path


def displacement(
    path: Path, period: float, spec: RobotSpec, *, slips: bool
) -> np.ndarray:
    """Return the displacement of connector 1 in a period of a closed path of shapes.

    The components are ahead (m), to the left (m) and turn (rad), in the initial frame
    of the connector.
    """

    def pose_rate(time: float, pose: np.ndarray) -> np.ndarray:
        q, rate, _ = path(np.array([time]))
        u, v, spin = velocity(q[0], rate[0], spec, slips=slips)
        c = math.cos(pose[2])
        s = math.sin(pose[2])
        return np.array([c * u - s * v, s * u + c * v, spin])

    solved = solve_ivp(pose_rate, (0.0, period), np.zeros(3), rtol=1e-8, atol=1e-12)
    return np.asarray(solved.y[:, -1])
