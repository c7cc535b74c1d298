r"""Chamber volumes, and the bend law φ that maps chamber pressures to free bends.

**Volume.** A chamber expands when the segment bends towards the side of the chamber.
The minimum volume is the dead volume V₀:

$$ V^\pm(q) = V_0 + A\,\max(0, \pm q). $$

The displacement A is the air volume for a bend of 90°, divided by π/2. The dissertation
gives air volumes of 15, 45 and 70 ml (Sections 2.1.1–2.1.3). Air is modelled as an
ideal gas at constant temperature. The amount of air in a chamber is expressed as n = P
V in J, where P is the absolute pressure.

**Bend law.** The chambers of a segment have the gauge pressures p⁺ and p⁻ and the gains
g⁺ and g⁻ relative to the nominal gain G. The free bend q, which the segment has without
load, is the rest bend b plus a function of the pressures:
$$ x = G\,(g^+ p^+ - g^- p^-), \qquad q = b + \varphi(x), \qquad
\varphi(x) = \frac{y}{\bigl(1 + (y/q_m)^4\bigr)^{1/4}}, \qquad
y = x - \frac{s w}{2} \ln \frac{\cosh((x + d)/w)}{\cosh((x - d)/w)}. $$

The linear bend x is the free bend, relative to b, that the pressures would cause
without dead zone and saturation. While the pressures change, x lags the value given by
this equation with the mode time constant τ₂. The function φ is odd and smooth, and
increases monotonically if s ≤ 1. With s = 0 and infinite q_m, φ is linear, as in the
dissertation (Eq. 14).

- *Saturation.* The bend is limited to q_m by inextensible strips and by chambers that
  touch each other. For |y| ≤ q_m/2, φ deviates from y by at most 1.5 %. At a bend of
  0.87 q_m, the derivative dφ/dy is about one third.
- *Dead zone.* The walls of some modules must swell before the module bends. For |x| <
  d, the dead zone reduces the slope dy/dx by the fraction s. For |x| > d, it reduces
  |y| by s d. The transition between these ranges has the width w and is sharp for w ≪
  d. At x = 0, the slope is 1 − s tanh(d/w). For w ≈ d, the curve y(x) resembles a power
  law with an exponent above 1.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from srs_twin.compute.arrays import Array
from srs_twin.compute.compiled import compiled, kernel_only
from srs_twin.errors import InputError
from srs_twin.robot.spec import RobotSpec

AMBIENT_PA = 101_325.0
"""Absolute pressure of the surrounding air, Pa."""


@compiled
def volume(dead, displacement, bend, side):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the volume of a chamber (m³) and its derivative (m³/rad).

    Args:
        dead: dead volume V₀, m³.
        displacement: displacement A, m³/rad.
        bend: bend q of the segment, rad.
        side: 0 for the + chamber, 1 for the − chamber.
    """
    sign = 1.0 - 2.0 * float(side)
    if sign * bend > 0.0:
        return dead + displacement * sign * bend, displacement * sign
    return dead, 0.0


# Value of |x| (rad) below which φ(x)/x is replaced by its limit for x → 0.
_MIN_LINEAR_RAD = 1e-9

# Value of |x| (rad) at which `invert_bend_law` stops extending its search interval.
_SEARCH_LIMIT_RAD = 1e3

NO_LIMIT_RAD = 1e3
"""Bend limit q_m above which saturation is neglected, rad."""


class BendLaw(NamedTuple):
    """Parameters of the bend law φ.

    Attributes:
        bend_limit: bend limit q_m, rad.
        onset_fraction: fraction s by which the dead zone reduces the slope,
            dimensionless.
        dead_zone: linear bend d at the end of the dead zone, rad.
        dead_zone_transition: width w of the transition at the end of the dead zone,
            rad.
    """

    bend_limit: float
    onset_fraction: float
    dead_zone: float
    dead_zone_transition: float


def bend_law_of(spec: RobotSpec) -> BendLaw:
    """Return the bend law of a robot."""
    return BendLaw(*(getattr(spec.actuator, name) for name in BendLaw._fields))


@kernel_only
def log_cosh(z):  # type: ignore[no-untyped-def]
    """Return ln(2 cosh z), computed without overflow."""
    return abs(z) + np.log(1.0 + np.exp(-2.0 * abs(z)))


@compiled
def apply_bend_law(x, bend_law):  # type: ignore[no-untyped-def]
    """Return φ(x) (rad), its first derivative and its second derivative (1/rad).

    Args:
        x: linear bend, rad.
        bend_law: `BendLaw`, or another record that contains the fields of `BendLaw`.
    """
    limit = bend_law.bend_limit
    fraction = bend_law.onset_fraction
    dead_zone = bend_law.dead_zone
    width = bend_law.dead_zone_transition
    y = x
    rise = 1.0
    curve = 0.0
    if fraction != 0.0:
        above = (dead_zone + x) / width
        below = (dead_zone - x) / width
        up = math.tanh(above)
        down = math.tanh(below)
        y = x - 0.5 * fraction * width * (log_cosh(above) - log_cosh(below))
        rise = 1.0 - 0.5 * fraction * (up + down)
        curve = 0.5 * fraction * (up * up - down * down) / width
    if limit > NO_LIMIT_RAD:
        return y, rise, curve
    ratio = (y / limit) * (y / limit)
    grown = 1.0 + ratio * ratio
    root = grown**-0.25
    derivative = root / grown
    bow = -5.0 * ratio / limit * (y / limit) * root / (grown * grown)
    return y * root, derivative * rise, bow * rise * rise + derivative * curve


def invert_bend_law(bends: Array, bend_law: BendLaw) -> Array:
    """Return the linear bends x for which φ(x) equals the given bends, rad.

    Raises:
        InputError: a bend is outside the range of φ.
    """
    linear = []
    for bend in np.ravel(bends):
        low = high = float(bend)
        while apply_bend_law(low, bend_law)[0] > bend and low > -_SEARCH_LIMIT_RAD:
            low = 2 * low - 0.1
        while apply_bend_law(high, bend_law)[0] < bend and high < _SEARCH_LIMIT_RAD:
            high = 2 * high + 0.1
        if (
            not apply_bend_law(low, bend_law)[0]
            <= bend
            <= apply_bend_law(high, bend_law)[0]
        ):
            raise InputError(
                f"no pressure bends a segment by {bend:.4g} rad; the bend must be"
                f" below the limit {bend_law.bend_limit:.4g} rad"
            )
        if low < high:
            low = brentq(
                _bend_error, low, high, args=(bend, bend_law), xtol=1e-14, rtol=1e-14
            )
        linear.append(low)
    return np.array(linear).reshape(np.shape(bends))


def _bend_error(x: float, bend: float, bend_law: BendLaw) -> float:
    return float(apply_bend_law(x, bend_law)[0] - bend)


def check_pressure(pressure: Array, largest: float) -> Array:
    """Check that gauge pressures (Pa) are within [0, `largest`], and return them.

    Raises:
        InputError: a pressure is negative or above the maximum.
    """
    pressure = np.array(pressure, dtype=float)
    outside = ~((pressure >= -1e-6) & (pressure <= largest * (1 + 1e-9)))
    if outside.any():
        raise InputError(
            f"chamber pressure {pressure[outside][0]:g} Pa is not allowed; it must be"
            f" between 0 and {largest:g} Pa"
        )
    return np.maximum(pressure, 0.0)


def chamber_gains(spec: RobotSpec) -> Array:
    """Return the gain G g of each chamber, shape (segments, 2), rad/Pa."""
    return spec.actuator.gain * spec.modules.array("gain")


def air_bend(spec: RobotSpec, pressure: Array) -> Array:
    """Return the free bends φ(x) without the rest bends, shape (…, segments), rad.

    The argument `pressure` contains gauge pressures, shape (…, segments, 2), Pa.
    """
    return free_bends(spec, _linear_bend(spec, pressure))


def vector_bends(spec: RobotSpec, pressure: Array) -> Array:
    """Return the free bends φ(|x|) x/|x| of a spatial robot without the rest bends.

    Args:
        spec: robot specification.
        pressure: gauge pressures, shape (…, segments, chambers), Pa.

    Returns:
        Bend components to the left and upwards, shape (…, segments, 2), rad.
    """
    linear = (chamber_gains(spec) * pressure) @ spec.chamber.axes
    size = np.linalg.norm(linear, axis=-1, keepdims=True)
    safe = np.maximum(size, _MIN_LINEAR_RAD)
    return np.asarray(linear * free_bends(spec, safe) / safe)


def free_extensions(spec: RobotSpec, pressure: Array) -> Array:
    r"""Return the free extensions of spatial segments, shape (…, segments), m.

    The C chambers of a segment have equal cross-sections, so that their forces are
    proportional to their gauge pressures p_c. With an extension e per mean gauge
    pressure (m/Pa), the free extension is

    $$ \Delta l = \frac{e}{C} \sum_c p_c . $$
    """
    return np.asarray(spec.actuator.extension * pressure.mean(axis=-1))


def equivalent_linear_pressure(spec: RobotSpec, pressure: Array) -> Array:
    """Return the gauge pressures (Pa) at which a linear law would give the bends φ(x).

    MuJoCo's actuators are linear and therefore receive these pressures. The argument
    `pressure` contains the actual gauge pressures, shape (…, segments, 2), Pa.
    """
    linear = _linear_bend(spec, pressure)
    bends = free_bends(spec, linear)
    if bends is linear:
        return pressure
    derivative = apply_bend_law(0.0, bend_law_of(spec))[1]
    ratio = np.where(
        np.abs(linear) > _MIN_LINEAR_RAD,
        bends / np.where(linear == 0.0, 1.0, linear),
        derivative,
    )
    return np.asarray(pressure * ratio[..., None])


def largest_bend(spec: RobotSpec, supply_pa: float) -> float:
    """Return the free bend (rad) of a nominal segment with one fully filled chamber."""
    return float(free_bends(spec, np.array(spec.actuator.gain * supply_pa)))


def _linear_bend(spec: RobotSpec, pressure: Array) -> Array:
    signed = chamber_gains(spec) * [1.0, -1.0]
    bends: Array = (signed * pressure).sum(axis=-1)
    return bends


def free_bends(spec: RobotSpec, linear: Array) -> Array:
    """Return φ(x) (rad) for linear bends x (rad).

    If the bend law is linear, the array `linear` itself is returned.
    """
    limit, fraction, d, w = bend_law_of(spec)
    y = linear
    if fraction != 0.0:
        above = (d + linear) / w
        below = (d - linear) / w
        log_ratio = np.logaddexp(above, -above) - np.logaddexp(below, -below)
        y = linear - 0.5 * fraction * w * log_ratio
    if np.isinf(limit):
        return y
    return np.asarray(y * (1.0 + (y / limit) ** 4) ** -0.25)
