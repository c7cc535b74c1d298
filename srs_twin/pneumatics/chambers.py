r"""Chambers: how much air is where, and the bend that their pressures give.

A chamber grows as the segment bends its own way, by the volume that bending displaces, and is never
smaller than its dead volume:

$$ V^\pm(q) = V_0 + A\,\max(0, \pm q). $$

A is the air volume that the dissertation gives for 90° (Sections 2.1.1–2.1.3: 15, 45, 70 ml) over π/2. Air is
an ideal gas at one temperature, so its amount is told by n = P V in J, with P the absolute pressure.

The bend that pressures give is linear at first, and never beyond what the module can do. With the gain g of
each chamber as a multiple of the nominal G, and the module's bias b,

$$ x = G\,(g^+ p^+ - g^- p^-), \qquad q = b + \varphi(x), \qquad
\varphi(x) = \frac{x}{\bigl(1 + (x/q_m)^4\bigr)^{1/4}}. $$

Up to half of q_m the law is linear within 1.5 %; its slope is a third at 0.87 q_m. Strips that do not
stretch and chambers that touch end the bending; without a q_m the law is linear throughout, as the
dissertation's (Eq. 14). In time x lags by τ₂ and q follows it at once.

A joint with stiffness k and damping k τ₂ feels the moment k φ(x) of the momentary pressures and rests at b:
as long as the bend is linear in pressure, that is the same.
"""

from __future__ import annotations

import numpy as np

from srs_twin.compiled import compiled
from srs_twin.robot.spec import RobotSpec

AMBIENT_PA = 101_325.0
"""Absolute pressure of the surrounding air, Pa."""


@compiled
def volume(dead, displacement, bend, side):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return a chamber's volume (m³) and its slope over the bend (m³/rad).

    Args:
        dead: V₀, m³.
        displacement: A, m³/rad.
        bend: q, rad.
        side: 0 for the + chamber, 1 for the − chamber.
    """
    way = 1.0 - 2.0 * side
    if way * bend > 0.0:
        return dead + displacement * way * bend, displacement * way
    return dead, 0.0


LARGEST = 1e3
"""Limit of the bend beyond which there is none, rad."""


@compiled
def flattened(x, limit):  # type: ignore[no-untyped-def]
    """Return φ(x) (rad) and its first two derivatives.

    Args:
        x: linear bend, rad.
        limit: q_m, rad; may be infinite.
    """
    if limit > LARGEST:
        return x, 1.0, 0.0
    ratio = (x / limit) ** 2
    grown = 1.0 + ratio * ratio
    root = grown**-0.25
    return x * root, root / grown, -5.0 * ratio / limit * (x / limit) * root / (grown * grown)


def gains(spec: RobotSpec) -> np.ndarray:
    """Return the linear bend over pressure of each chamber, positive, shape (segments, 2), rad/Pa."""
    return spec.actuator.gain * spec.modules.array("gain")


def air_bend(spec: RobotSpec, pressure: np.ndarray) -> np.ndarray:
    """Return φ(x), by which pressures bend free segments from where they rest, rad.

    Args:
        spec: the robot.
        pressure: gauge, shape (…, segments, 2), Pa.

    Returns:
        Shape (…, segments).
    """
    linear = _linear(spec, pressure)
    limit = spec.actuator.bend_limit
    return linear if np.isinf(limit) else linear * _share(linear, limit)


def as_felt(spec: RobotSpec, pressure: np.ndarray) -> np.ndarray:
    """Return pressures that would bend as far if the law were linear up to them; shapes as in `air_bend`."""
    limit = spec.actuator.bend_limit
    if np.isinf(limit):
        return pressure
    return pressure * _share(_linear(spec, pressure), limit)[..., None]


def largest_bend(spec: RobotSpec, supply_pa: float) -> float:
    """Return the bend of a nominal free segment with one chamber at the supply's pressure (Pa), rad."""
    linear = spec.actuator.gain * supply_pa
    return linear * float(_share(np.array(linear), spec.actuator.bend_limit))


def _linear(spec: RobotSpec, pressure: np.ndarray) -> np.ndarray:
    signed = gains(spec) * [1.0, -1.0]
    bends: np.ndarray = (signed * pressure).sum(axis=-1)
    return bends


def _share(linear: np.ndarray, limit: float) -> np.ndarray:
    """Return φ(x)/x."""
    share: np.ndarray = (1.0 + (linear / limit) ** 4) ** -0.25
    return share
