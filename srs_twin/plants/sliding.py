r"""A straight body that slides without turning: a point under the friction laws of the floor.

Thrown across the floor, all its connectors move alike, so its mass cancels:

$$ \dot v = f(v; \mu_t/(1 + s), \mu_n), \qquad s = \sum_w \frac{I_w}{M R^2}, $$

with f the law for a load of g a unit mass. s is 0 where wheels have no inertia; wheels that have to stop
spinning as well lengthen the way along by 1 + s, because the floor brakes them with that much less than their
axles do. One implicit step of Rosenbrock's kind takes the stiff end, where Coulomb friction has stopped the body.
"""

from __future__ import annotations

import numpy as np

from srs_twin.compiled import compiled
from srs_twin.friction import LAWS
from srs_twin.plants.floor import Floor, connector_friction
from srs_twin.spec import GRAVITY, RobotSpec

_STEP = 5e-4  # s
_SLIP = 2.5e-4  # m/s, as the analytical plant's


def spin_share(spec: RobotSpec) -> float:
    """Return s, the inertia of solid wheels over the mass of the whole robot."""
    return 2 * spec.geometry.connectors * (spec.mass.wheel / 2) / spec.mass.total


def slide(
    velocity: tuple[float, float], times: np.ndarray, *, law: str, mu_t: float, mu_n: float, share: float = 0.0
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
        if steps > 0:
            h = (times[k] - now) / steps
        for _ in range(steps):
            t, n, _m, tt, tn, _tm, nn, _nm, _mm = connector_friction(along, across, 0.0, GRAVITY, floor)
            # (1 − h f') Δv = h f
            a, b, d = 1 - h * tt, -h * tn, 1 - h * nn
            scale = h / (a * d - b * b)
            faster, aside = scale * (d * t - b * n), scale * (a * n - b * t)
            x += h * (along + faster / 2)
            y += h * (across + aside / 2)
            along += faster
            across += aside
        now = times[k]
        place[k, 0], place[k, 1] = x, y
