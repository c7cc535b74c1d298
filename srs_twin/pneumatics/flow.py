r"""Flow through a valve according to ISO 6358.

A valve is described by the sonic conductance C and the critical pressure ratio b. Air
flows through the valve from the absolute pressure P₁ to the absolute pressure P₂. At
constant temperature, the flow of the amount n = P V depends on the pressure ratio r =
P₂/P₁:

$$ \dot n = P_0\,C\,P_1\,\psi(r),\qquad
\psi = \begin{cases} 1 & r \le b \\ \sqrt{1 - \bigl(\tfrac{r-b}{1-b}\bigr)^2} & b < r \le r_l \end{cases} $$

The standard defines the reference pressure P₀ as 100 kPa. The derivative of ψ is
infinite at r = 1. Above r_l = 0.999, the flow is therefore assumed to be laminar, which
means that it is proportional to P₁ − P₂.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from srs_twin.compute.compiled import compiled
from srs_twin.pneumatics.chambers import AMBIENT_PA
from srs_twin.robot.spec import RobotSpec

REFERENCE_PA = 100_000.0
"""Absolute reference pressure P₀ of ISO 6358, Pa."""

LAMINAR = 0.999
"""Pressure ratio r_l above which the flow is linear, dimensionless."""

REMAINING = math.exp(-2)
"""Remaining fraction e⁻² of a pressure change at the working point, dimensionless."""


@compiled
def flow(first, second, critical):  # type: ignore[no-untyped-def]
    """Return P₁ ψ (Pa) and its derivatives with respect to both pressures.

    The returned flow P₁ ψ is negative if the second pressure is higher.

    Args:
        first: absolute pressure on one side of the valve, Pa.
        second: absolute pressure on the other side of the valve, Pa.
        critical: critical pressure ratio b, dimensionless.
    """
    backward = second > first
    high, low = (second, first) if backward else (first, second)
    ratio = low / high
    value = high
    by_high = 1.0
    by_low = 0.0
    if ratio > critical:
        fraction = (min(ratio, LAMINAR) - critical) / (1.0 - critical)
        psi = math.sqrt(1.0 - fraction * fraction)
        if ratio > LAMINAR:
            by_high = psi / (1.0 - LAMINAR)
            value = by_high * (high - low)
            by_low = -by_high
        else:
            by_low = -fraction / (psi * (1.0 - critical))
            value = high * psi
            by_high = psi - ratio * by_low
    if backward:
        return -value, -by_low, -by_high
    return value, by_high, by_low


class Conductances(NamedTuple):
    """Valve conductances and capacity of a chamber.

    Attributes:
        fill: sonic conductance C of the inlet, m³/(s Pa).
        vent: sonic conductance C of the outlet, m³/(s Pa).
        capacity: capacity K of the chamber at the working point of filling, J/Pa.
    """

    fill: float
    vent: float
    capacity: float


def conductances(spec: RobotSpec, critical: float) -> Conductances:
    """Return the valve conductances that reproduce the fill and vent time constants.

    It is assumed that a chamber fills or vents while the opposite chamber is empty. To
    first order in τ₂, the bend is then q ≈ G (p − τ₂ ṗ). To increase the gauge pressure
    p by dp, the amount of air in the chamber must increase by K dp, where K(p) = V + (p
    + P_a) A G is the capacity of the chamber. The pressure therefore changes at the
    rate ṗ = ṅ/K.

    A first-order lag with the fill or vent time constant τ₁ has dṗ/dp = −1/τ₁ at all
    pressures. The conductance C of a valve is chosen so that dṗ/dp = −1/τ₁ at one
    working point. At this point, the pressure has completed the fraction 1 − e⁻² of a
    change between ambient and nominal supply pressure.

    Args:
        spec: robot specification.
        critical: critical pressure ratio b, dimensionless.
    """
    actuator = spec.actuator
    supply = spec.supply.nominal

    def filling(p: float) -> float:
        return float(flow(supply + AMBIENT_PA, p + AMBIENT_PA, critical)[0])

    def venting(p: float) -> float:
        return -float(flow(p + AMBIENT_PA, AMBIENT_PA, critical)[0])

    full = (1 - REMAINING) * supply
    empty = REMAINING * supply
    capacity = spec.chamber.dead_volume + spec.chamber.displacement * actuator.gain * (
        2 * full + AMBIENT_PA
    )
    fill = _conductance(filling, full, actuator.tau_fill, spec)
    vent = _conductance(venting, empty, actuator.tau_vent, spec)
    return Conductances(fill, vent, capacity)


def _conductance(
    passed: Callable[[float], float], p: float, tau: float, spec: RobotSpec
) -> float:
    """Return the conductance C for which dṗ/dp = −1/τ at the gauge pressure p.

    The function `passed` returns P₁ ψ (Pa) for a given gauge pressure in the chamber.
    """
    dead = spec.chamber.dead_volume
    growth = spec.chamber.displacement * spec.actuator.gain
    lag = min(spec.actuator.tau_mode, 0.1 * tau)
    step = 1e-3 * p

    def derivative(function: Callable[[float], float], at: float) -> float:
        return (function(at + step) - function(at - step)) / (2 * step)

    def rate_without_lag(at: float) -> float:
        return REFERENCE_PA * c * passed(at) / (dead + growth * (2 * at + AMBIENT_PA))

    def rate(at: float) -> float:
        # The volume V is evaluated at the bend G (p − τ₂ ṗ). The expansion of the
        # chamber contributes (p + P_a) dV/dp to the capacity.
        chamber_volume = dead + growth * (at - lag * rate_without_lag(at))
        expansion = (
            growth * (at + AMBIENT_PA) * (1 - lag * derivative(rate_without_lag, at))
        )
        return REFERENCE_PA * c * passed(at) / (chamber_volume + expansion)

    # The rate is nearly proportional to C, so a few fixed-point iterations suffice.
    c = 1.0
    c = -1 / (tau * derivative(rate_without_lag, p))
    for _ in range(8):
        c /= -tau * derivative(rate, p)
    return c
