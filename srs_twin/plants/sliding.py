r"""A straight body that slides without turning: a point under the friction laws of the floor.

Thrown across the floor, all its connectors move alike, so its mass cancels:

$$ \dot v = f(v; \mu_t/(1 + s), \mu_n), \qquad s = \sum_w \frac{I_w}{M R^2}, $$

with f the law for a load of g a unit mass. s is 0 where wheels have no inertia; wheels that have to stop
spinning as well lengthen the way along by 1 + s, because the floor brakes them with that much less than
their axles do. Nothing pushes such a body, so neither velocity ever changes its sign: each is followed by
the midpoint rule until it is 0, and stays so. Places are smooth in the velocities and coefficients, as a
fit needs them.
"""

from __future__ import annotations

import numpy as np

from srs_twin.compiled import compiled
from srs_twin.friction import LAWS
from srs_twin.plants.floor import Floor, connector_friction
from srs_twin.spec import GRAVITY, RobotSpec

_STEP = 5e-4  # s
_SLIP = 1e-9  # m/s: nothing but 0/0 is to be avoided


def spin_share(spec: RobotSpec) -> float:
    """Return s, the inertia of solid wheels over the mass of the whole robot."""
    return 2 * spec.geometry.connectors * (spec.mass.wheel / 2) / spec.mass.total


def slide(
    velocity: tuple[float, float],
    times: np.ndarray,
    *,
    law: str,
    mu_t: float,
    mu_n: float,
    share: float = 0.0,
) -> np.ndarray:
    """Return where a thrown body is, in the frame of its heading, from where it was thrown.

    Args:
        velocity: along and across at time 0, m/s.
        times: ascending from 0 on, shape (times,), s.
        law: one of `friction.LAWS`.
        mu_t: coefficient along.
        mu_n: coefficient across.
        share: s, see above.

    Returns:
        Shape (times, 2), along and across, m.
    """
    floor = Floor(LAWS.index(law), 0.0, mu_t / (1 + share), mu_n, _SLIP)
    place = np.empty((len(times), 2))
    _slide(float(velocity[0]), float(velocity[1]), np.ascontiguousarray(times, dtype=float), floor, place)
    return place


@compiled
def _slide(along, across, times, floor, place):  # type: ignore[no-untyped-def]
    """Fill the places at `times`."""
    x, y, now = 0.0, 0.0, 0.0
    for k in range(times.shape[0]):
        steps = int(np.ceil((times[k] - now) / _STEP))
        for _ in range(steps):
            h = (times[k] - now) / steps
            a_t, a_n = _slowing(along, across, floor)
            a_t, a_n = _slowing(_midway(along, h * a_t), _midway(across, h * a_n), floor)
            x += _way(along, a_t, h)
            y += _way(across, a_n, h)
            along, across = _still(along, h * a_t), _still(across, h * a_n)
        now = times[k]
        place[k, 0], place[k, 1] = x, y


@compiled
def _slowing(along, across, floor):  # type: ignore[no-untyped-def]
    """Return the accelerations along and across, m/s²."""
    forces = connector_friction(along, across, 0.0, GRAVITY, floor)
    return forces[0], forces[1]


@compiled
def _still(speed, change):  # type: ignore[no-untyped-def]
    """Return a velocity after a change, 0 where that would turn its sign."""
    after = speed + change
    return after if after * speed > 0.0 else 0.0


@compiled
def _midway(speed, change):  # type: ignore[no-untyped-def]
    """Return the mean velocity of a step, or of its part before it stops."""
    return speed + change / 2 if (speed + change) * speed > 0.0 else speed / 2


@compiled
def _way(speed, slowing, h):  # type: ignore[no-untyped-def]
    """Return how far a step takes it, or how far it gets before it stops within."""
    if speed == 0.0:
        return 0.0
    if (speed + h * slowing) * speed > 0.0:
        return h * (speed + h * slowing / 2)
    return -speed * speed / (2.0 * slowing)
