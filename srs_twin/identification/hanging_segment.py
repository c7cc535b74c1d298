r"""Free swing of a body that hangs from one segment.

The upper end of the segment is clamped so that the segment hangs straight down. The
lower end carries a body of mass m, whose moment of inertia about its centre is J. At
bend q, the chord of the segment has length L(q) (`robot.geometry`) and is inclined by
q/2 to the vertical. Lagrange's equation is

$$ M \ddot q + \tfrac12 M' \dot q^2 - m g\,\frac{d}{dq}\bigl(L \cos\tfrac q2\bigr)
   = k\,d + k T \dot d + \sum_i e_i, \qquad M = m \Bigl(L'^2 + \frac{L^2}{4}\Bigr) + J, \qquad
   d = b(t) + \varphi(x) - q . $$

Here φ(x) is the bend law of `pneumatics.chambers`, which converts the pressures to a
bend, and b is the rest bend without pressure. A real material recovers slowly after
being bent, so b(t) contains decaying exponentials.

**Air.** If the chambers are open, φ = 0. The air in a closed chamber of volume V has a
constant temperature and the absolute pressure P. Through a leak with rate λ, the amount
of air n = P V tends to its value at the ambient pressure p₀:

$$ \dot n = -\lambda\,(n - p_0 V) . $$

**Material.** The material is viscous with the damping time T. Maxwell branches may add
moments e_i, which satisfy ė_i = g_i ḋ − e_i/τ_i. Five branches give a nearly constant
loss factor around the angular frequency ω if their relaxation times τ_i span two
decades around 1/ω.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq, newton

from srs_twin.compute.arrays import Array
from srs_twin.compute.compiled import allocating, kernel_only
from srs_twin.pneumatics.chambers import AMBIENT_PA, BendLaw, apply_bend_law, volume
from srs_twin.robot.geometry import (
    chord_derivatives,
    chord_from_half_angle,
    half_angle_terms,
)
from srs_twin.robot.spec import GRAVITY

_half_angle_terms = kernel_only(half_angle_terms)
_chord = kernel_only(chord_from_half_angle)

_LARGEST_REST_RAD = 3.0

_SMALL_BEND_RAD = 1e-4
"""Step of finite differences with respect to the bend, rad."""

_MAX_ANGLE_STEP = 0.06
"""Maximum product of the angular frequency and a time step, rad."""

_SHORTEST_S = 1e-3
"""Inverse of an angular frequency that is too high for the branches to relax, s."""

_SLOWEST_RAD_S = 1e-6
"""Angular frequency assigned to an overdamped swing, rad/s."""

NO_BRANCHES = np.empty((0, 2))
"""Empty array of branches, for a purely viscous material."""

_BRANCH_RATIOS = 10.0 ** np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
"""Relaxation times of the Maxwell branches as multiples of 1/ω."""

_SMALLEST_RELAXED_FRACTION = 0.02
"""Minimum fraction of the stiffness that remains after all branches have relaxed."""


class HangingSegment(NamedTuple):
    """Constants in the equation of motion of a hanging segment.

    Attributes:
        length: length l of the bending part, m.
        gap: rigid gap L_o, m.
        mass: mass m of the hanging body, kg.
        inertia: moment of inertia J of the body about its centre, kg·m².
        gain_plus: gain of the + chamber, rad/Pa.
        gain_minus: gain of the − chamber, rad/Pa.
        bend_law: parameters of the bend law φ.
        dead_volume: dead volume V₀ of a chamber, m³.
        displacement: derivative A of the chamber volume with respect to the bend,
            m³/rad.
        encloses_air: whether the chambers are closed and therefore enclose air.
    """

    length: float
    gap: float
    mass: float
    inertia: float
    gain_plus: float
    gain_minus: float
    bend_law: BendLaw
    dead_volume: float
    displacement: float
    encloses_air: bool


class Material(NamedTuple):
    """Material properties and leak rate of a segment.

    Attributes:
        stiffness: stiffness k without the Maxwell branches, N·m/rad.
        damping_time: damping time T, s.
        leak: leak rate λ, 1/s.
    """

    stiffness: float
    damping_time: float
    leak: float = 0.0


@kernel_only
def _acceleration(moment, bend, rate, segment):  # type: ignore[no-untyped-def]
    terms = _half_angle_terms(bend)
    chord, derivative, curvature = _chord(terms, segment.length, segment.gap)
    inertia = (
        segment.mass * (derivative * derivative + chord * chord / 4) + segment.inertia
    )
    change = segment.mass * derivative * (2 * curvature + chord / 2)
    weight = segment.mass * GRAVITY * (derivative * terms[0] - chord * terms[1] / 2)
    return (moment + weight - change * rate * rate / 2) / inertia


@kernel_only
def _derivatives(state, creep, creep_derivative, material, segment, branches, result):  # type: ignore[no-untyped-def]
    bend = state[0]
    rate = state[1]
    deviation = creep - bend
    deviation_rate = creep_derivative - rate
    result[2] = result[3] = 0.0
    if segment.encloses_air:
        x = x_rate = 0.0
        for side in range(2):
            size, growth = volume(segment.dead_volume, segment.displacement, bend, side)
            pressure = state[2 + side] / size
            result[2 + side] = material.leak * (AMBIENT_PA * size - state[2 + side])
            gain = segment.gain_minus if side else -segment.gain_plus
            x -= gain * (pressure - AMBIENT_PA)
            x_rate -= gain * (result[2 + side] - pressure * growth * rate) / size
        air, air_derivative, _ = apply_bend_law(x, segment.bend_law)
        deviation += air
        deviation_rate += air_derivative * x_rate
    moment = material.stiffness * (deviation + material.damping_time * deviation_rate)
    for i in range(len(branches)):
        moment += state[4 + i]
        result[4 + i] = branches[i, 0] * deviation_rate - state[4 + i] / branches[i, 1]
    result[0] = rate
    result[1] = _acceleration(moment, bend, rate, segment)


@allocating
def swing(time, start, rest, frequency, material, segment, branches):  # type: ignore[no-untyped-def]  # noqa: D417
    """Integrate the free swing with the fourth-order Runge-Kutta method.

    The state consists of the bend (rad), the bend rate (rad/s), the products P V of the
    air in the + and − chamber (J), and the moments of the branches (N·m).

    Args:
        time: times in ascending order, s, shape (samples,).
        start: initial state, shape (4 + branches,).
        rest: rest bend b without pressure at each time, rad, shape (samples,).
        frequency: approximate angular frequency, rad/s, which determines the time step.
        material: `Material` of the segment.
        segment: constants of the equation of motion.
        branches: stiffness g_i (N·m/rad) and relaxation time τ_i (s) of each branch,
            shape (branches, 2).

    Returns:
        Bend at each time, rad, shape (samples,), and the final state.
    """
    result = np.empty(len(time))
    state = start.copy()
    trial = start.copy()
    total = np.empty_like(start)
    derivatives = np.empty_like(start)
    result[0] = state[0]
    for k in range(len(time) - 1):
        interval = time[k + 1] - time[k]
        steps = int(interval * frequency / _MAX_ANGLE_STEP) + 1
        h = interval / steps
        rise = (rest[k + 1] - rest[k]) / interval
        for j in range(steps):
            total[:] = 0.0
            trial[:] = state
            for stage in range(4):
                since = (j + 0.5 * ((stage + 1) // 2)) * h
                _derivatives(
                    trial,
                    rest[k] + rise * since,
                    rise,
                    material,
                    segment,
                    branches,
                    derivatives,
                )
                total += derivatives * (2.0 if stage in (1, 2) else 1.0)
                trial[:] = state + derivatives * (h if stage == 2 else h / 2)
            state += total * (h / 6)
        result[k + 1] = state[0]
    return result, state


def weight_moment(segment: HangingSegment, bend: float) -> float:
    """Return the moment due to the weight of the body, N·m.

    A positive bend gives a negative moment.
    """
    chord, derivative, _ = chord_derivatives(bend, segment.length, segment.gap)
    change = derivative * math.cos(bend / 2) - chord * math.sin(bend / 2) / 2
    return segment.mass * GRAVITY * change


class Ringing(NamedTuple):
    """Small oscillation about the rest position.

    Attributes:
        frequency: damped frequency, Hz.
        loss_factor: loss factor of material and air at the damped frequency.
        air_stiffness: stiffness of the enclosed air, N·m/rad.
    """

    frequency: float
    loss_factor: float
    air_stiffness: float


def ringing(
    segment: HangingSegment,
    material: Material,
    rest: float,
    air: Array,
    branches: Array = NO_BRANCHES,
) -> Ringing:
    r"""Return the small oscillation about the bend at which the segment hangs at rest.

    The material and the air in a chamber with gain G, pressure P and volume V together
    have the complex stiffness

    $$ K(s) = k\,(1 + s T)\Bigl(1 + \frac{r s}{s + \lambda}\Bigr), \qquad
    r = \varphi'(x)\,G\,P\,\frac{A}{V}. $$

    The damped frequency follows from the complex root of M s² + K(s) + w = 0, where w
    is the stiffness due to the weight. The loss factor at the damped frequency is
    Im K/Re K. Each Maxwell branch adds g s τ/(1 + s τ) to the stiffness of the
    material.

    Args:
        segment: hanging segment.
        material: stiffness, damping time and leak rate.
        rest: rest bend b, rad.
        air: products P V of the air in the + and − chamber, J, shape (2,). These values
            are ignored if the chambers are open.
        branches: stiffness (N·m/rad) and relaxation time (s) of each Maxwell branch,
            shape (branches, 2).
    """
    k, damping_time, leak = material
    gains = (segment.gain_plus, -segment.gain_minus)

    def air_bend(bend: float) -> tuple[float, float]:
        x = x_derivative = 0.0
        for side, gain in enumerate(gains if segment.encloses_air else ()):
            size, growth = volume(segment.dead_volume, segment.displacement, bend, side)
            x += gain * (air[side] / size - AMBIENT_PA)
            x_derivative -= gain * air[side] / size * growth / size
        value, derivative, _ = apply_bend_law(x, segment.bend_law)
        return value, -derivative * x_derivative

    def moment(bend: float) -> float:
        return k * (rest + air_bend(bend)[0] - bend) + weight_moment(segment, bend)

    hang = brentq(moment, -_LARGEST_REST_RAD, _LARGEST_REST_RAD)
    chord, derivative, _ = chord_derivatives(hang, segment.length, segment.gap)
    inertia = segment.mass * (derivative**2 + chord**2 / 4) + segment.inertia
    step = _SMALL_BEND_RAD
    stiffening = -(
        weight_moment(segment, hang + step) - weight_moment(segment, hang - step)
    ) / (2 * step)
    fraction = air_bend(hang or step)[1]

    def stiffness(s: complex) -> complex:
        branched: complex = sum(
            strength * s * tau / (1 + s * tau) for strength, tau in branches
        )
        return (k * (1 + s * damping_time) + branched) * (1 + fraction * s / (s + leak))

    undamped = math.sqrt((stiffness(1j / _SHORTEST_S).real + stiffening) / inertia)
    guess = 1j * undamped
    guess -= stiffness(guess).imag / (2 * inertia * undamped)
    root = newton(
        lambda s: (inertia * s * s + stiffness(s) + stiffening) / inertia,
        guess,
        maxiter=100,
    )
    pulsation = max(abs(complex(root).imag), _SLOWEST_RAD_S)
    total = stiffness(1j * pulsation)
    return Ringing(pulsation / (2 * math.pi), total.imag / total.real, k * fraction)


class Branches(NamedTuple):
    """Material with Maxwell branches, and the moments of the branches at one time.

    Attributes:
        material: stiffness and viscous damping without the branches.
        branches: stiffness (N·m/rad) and relaxation time (s) of each branch, shape
            (branches, 2).
        moments: moments of the branches when the swing passes the rest position, N·m,
            shape (branches,).
    """

    material: Material
    branches: np.ndarray
    moments: np.ndarray


def constant_loss(material: Material, pulsation: float, rate: float) -> Branches:
    """Return a material with a nearly constant loss factor.

    At the angular frequency `pulsation` (rad/s), the material has the stiffness and
    loss factor of the given viscous material. The moments of the branches are those of
    a swing that passes the rest position with the bend rate `rate` (rad/s).
    """
    x = _BRANCH_RATIOS
    storage = x**2 / (1 + x**2)
    loss = x / (1 + x**2)
    wanted = material.stiffness * material.damping_time * pulsation
    strongest = material.stiffness * (1 - _SMALLEST_RELAXED_FRACTION) / storage.sum()
    strength = min(wanted / loss.sum(), strongest)
    viscous = (wanted - strength * loss.sum()) / pulsation
    relaxed = material.stiffness - strength * storage.sum()
    moments = -strength * rate / pulsation * loss * (1 + x * np.exp(-math.pi / (2 * x)))
    branches = np.stack([np.full(len(x), strength), x / pulsation], axis=1)
    return Branches(
        Material(relaxed, viscous / relaxed, material.leak), branches, moments
    )
