r"""Chambers: how much air is where, and the bend that their pressures give.

A chamber grows as the segment bends its own way, by the volume that bending displaces, and is never
smaller than its dead volume:

$$ V^\pm(q) = V_0 + A\,\max(0, \pm q). $$

A is the air volume that the dissertation gives for 90° (Sections 2.1.1–2.1.3: 15, 45, 70 ml) over π/2. Air is
an ideal gas at one temperature, so its amount is told by n = P V in J, with P the absolute pressure.

The bend that pressures give is linear in the middle, and never beyond what the module can do. With the gain g
of each chamber as a multiple of the nominal G, and the module's bias b,

$$ x = G\,(g^+ p^+ - g^- p^-), \qquad q = b + \varphi(x), \qquad
\varphi(x) = \frac{y}{\bigl(1 + (y/q_m)^4\bigr)^{1/4}}, \qquad
y = x - \frac{s w}{2} \ln \frac{\cosh((x + d)/w)}{\cosh((x - d)/w)}. $$

A module whose walls must swell before they bend has a dead zone: up to d the share s of the slope is missing,
beyond it s d of the bend is lost for good, and w is how softly one goes over into the other. The slope at
rest is 1 − s tanh(d/w). With w ≪ d the zone has corners; with w near d the curve is convex from the start, as
powers of the pressure are. Up to half of q_m a linear law stays so within 1.5 %; its slope is a third at
0.87 q_m: strips that do not stretch and chambers that touch end the bending. Odd, smooth and monotone
whatever s ≤ 1, d, w and q_m; with s = 0 and without a q_m it is linear throughout, as the dissertation's
(Eq. 14). In time x lags by τ₂ and q follows it at once.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import brentq

from srs_twin.compute.compiled import compiled
from srs_twin.errors import InputError
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
    way = 1.0 - 2.0 * float(side)
    if way * bend > 0.0:
        return dead + displacement * way * bend, displacement * way
    return dead, 0.0


_AT_REST = 1e-9  # rad
_FAR = 1e3

LARGEST = 1e3
"""Limit of the bend beyond which there is none, rad."""


BendLaw = tuple[float, float, float, float]
"""q_m (rad), s, d (rad) and w (rad) of φ."""


def bend_law(spec: RobotSpec) -> BendLaw:
    """Return what `bent` takes."""
    actuator = spec.actuator
    return actuator.bend_limit, actuator.onset_share, actuator.onset, actuator.onset_width


@compiled
def _log_cosh(z):  # type: ignore[no-untyped-def]
    return abs(z) + np.log(1.0 + np.exp(-2.0 * abs(z)))  # and ln 2


@compiled
def bent(x, law):  # type: ignore[no-untyped-def]
    """Return φ(x) (rad) and its first two derivatives.

    Args:
        x: linear bend, rad.
        law: as `bend_law` returns it.
    """
    limit, share, onset, width = law[0], law[1], law[2], law[3]
    y, rise, curve = x, 1.0, 0.0
    if share != 0.0:
        above, below = (onset + x) / width, (onset - x) / width
        up, down = math.tanh(above), math.tanh(below)
        y = x - 0.5 * share * width * (_log_cosh(above) - _log_cosh(below))
        rise = 1.0 - 0.5 * share * (up + down)
        curve = 0.5 * share * (up * up - down * down) / width
    if limit > LARGEST:
        return y, rise, curve
    ratio = (y / limit) * (y / limit)
    grown = 1.0 + ratio * ratio
    root = grown**-0.25
    slope, bow = root / grown, -5.0 * ratio / limit * (y / limit) * root / (grown * grown)
    return y * root, slope * rise, bow * rise * rise + slope * curve


def unbent(bends: np.ndarray, law: BendLaw) -> np.ndarray:
    """Return the linear bends x whose φ(x) these are, rad.

    Raises:
        InputError: a bend that φ does not reach.
    """
    found = []
    for bend in np.ravel(bends):
        low = high = float(bend)
        while bent(low, law)[0] > bend and low > -_FAR:
            low = 2 * low - 0.1
        while bent(high, law)[0] < bend and high < _FAR:
            high = 2 * high + 0.1
        if not bent(low, law)[0] <= bend <= bent(high, law)[0]:
            raise InputError(f"no pressure bends a segment by {bend:.4g} rad; its limit is {law[0]:.4g}")
        off = lambda x, bend=bend: bent(x, law)[0] - bend  # noqa: E731
        found.append(low if low == high else brentq(off, low, high, xtol=1e-14, rtol=1e-14))
    return np.array(found).reshape(np.shape(bends))


def reached(pressure: np.ndarray, largest: float) -> np.ndarray:
    """Return pressures (Pa, gauge) that chambers can have.

    Raises:
        InputError: one below 0 or above the largest.
    """
    pressure = np.array(pressure, dtype=float)
    outside = ~((pressure >= -1e-6) & (pressure <= largest * (1 + 1e-9)))
    if outside.any():
        raise InputError(f"a chamber has 0 to {largest:g} Pa here, not {pressure[outside][0]:g} Pa")
    return np.maximum(pressure, 0.0)


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
    return free_bends(spec, _linear(spec, pressure))


def as_felt(spec: RobotSpec, pressure: np.ndarray) -> np.ndarray:
    """Return pressures that would bend as far if the law were linear up to them; shapes as in `air_bend`."""
    linear = _linear(spec, pressure)
    found = free_bends(spec, linear)
    if found is linear:
        return pressure
    # φ(x)/x tends to its slope at rest.
    at_rest = bent(0.0, bend_law(spec))[1]
    share = np.where(np.abs(linear) > _AT_REST, found / np.where(linear == 0.0, 1.0, linear), at_rest)
    return np.asarray(pressure * share[..., None])


def largest_bend(spec: RobotSpec, supply_pa: float) -> float:
    """Return the bend of a nominal free segment with one chamber at the supply's pressure (Pa), rad."""
    return float(free_bends(spec, np.array(spec.actuator.gain * supply_pa)))


def _linear(spec: RobotSpec, pressure: np.ndarray) -> np.ndarray:
    signed = gains(spec) * [1.0, -1.0]
    bends: np.ndarray = (signed * pressure).sum(axis=-1)
    return bends


def free_bends(spec: RobotSpec, linear: np.ndarray) -> np.ndarray:
    """Return φ of linear bends, rad, any shape; these themselves where the law is linear."""
    limit, share, d, w = bend_law(spec)
    found = linear
    if share != 0.0:
        above, below = (d + linear) / w, (d - linear) / w
        lost = np.logaddexp(above, -above) - np.logaddexp(below, -below)
        found = linear - 0.5 * share * w * lost
    return found if np.isinf(limit) else np.asarray(found * (1.0 + (found / limit) ** 4) ** -0.25)
