r"""Flow through a valve, ISO 6358: sonic conductance C and critical pressure ratio b.

From absolute pressure P₁ down to P₂, r = P₂/P₁, at one temperature, as amount of air (P V) a time:

$$ \dot n = P_0\,C\,P_1\,\psi(r),\qquad
\psi = \begin{cases} 1 & r \le b \\ \sqrt{1 - \bigl(\tfrac{r-b}{1-b}\bigr)^2} & b < r \le r_l \end{cases} $$

with P₀ = 100 kPa, the standard's reference. At equal pressures ψ has no finite slope; above r_l = 0.999
the flow is linear in P₁ − P₂, as usual in simulation (laminar flow).
"""

from __future__ import annotations

import math
from collections.abc import Callable

from srs_twin.compute.compiled import compiled
from srs_twin.pneumatics.chambers import AMBIENT_PA
from srs_twin.robot.spec import RobotSpec

REFERENCE_PA = 100_000.0
"""Absolute pressure of the reference state of ISO 6358, Pa."""

LAMINAR = 0.999
"""r_l, pressure ratio above which the flow is linear."""

REMAINING = math.exp(-2)
"""Share of its swing that a chamber still has before it at the working point, after two time constants."""


@compiled
def flow(first, second, critical):  # type: ignore[no-untyped-def]
    """Return P₁ ψ from the first to the second side (Pa), below 0 backward, and its two partial derivatives.

    Args:
        first: absolute pressure on the first side, Pa.
        second: on the second, Pa.
        critical: b.
    """
    backward = second > first
    high, low = (second, first) if backward else (first, second)
    ratio = low / high
    value, by_high, by_low = high, 1.0, 0.0
    if ratio > critical:
        part = (min(ratio, LAMINAR) - critical) / (1.0 - critical)
        psi = math.sqrt(1.0 - part * part)
        if ratio > LAMINAR:
            by_high = psi / (1.0 - LAMINAR)
            value, by_low = by_high * (high - low), -by_high
        else:
            by_low = -part / (psi * (1.0 - critical))
            value, by_high = high * psi, psi - ratio * by_low
    if backward:
        return -value, -by_low, -by_high
    return value, by_high, by_low


def conductances(spec: RobotSpec, critical: float) -> tuple[float, float, float]:
    """Return the conductances of inlet and outlet (m³/(s Pa)) that give a robot's τ₁ at small signals.

    A single chamber fills or vents, the opposite one is vented, and the bend follows, q ≈ G (p − τ₂ ṗ). To
    raise the gauge pressure p by dp takes the air K dp with K(p) = V + (p + P_a) A G; so ṗ = ṅ/K, and terms
    of first order in τ₂ are put right. In `lag`, dṗ/dp = −1/τ₁ everywhere; here C is such that it is so at
    the working point: where a chamber between ambient and the nominal supply has done 1 − e⁻² of its way.

    Returns:
        C of the inlet, C of the outlet, and K at the working point of filling, J/Pa.
    """
    actuator, supply = spec.actuator, spec.supply.nominal

    def filling(p: float) -> float:
        return float(flow(supply + AMBIENT_PA, p + AMBIENT_PA, critical)[0])

    def venting(p: float) -> float:
        return -float(flow(p + AMBIENT_PA, AMBIENT_PA, critical)[0])

    full, empty = (1 - REMAINING) * supply, REMAINING * supply
    capacity = spec.chamber.dead_volume + spec.chamber.displacement * actuator.gain * (2 * full + AMBIENT_PA)
    fill = _conductance(filling, full, actuator.tau_fill, spec)
    return fill, _conductance(venting, empty, actuator.tau_vent, spec), capacity


def _conductance(passed: Callable[[float], float], p: float, tau: float, spec: RobotSpec) -> float:
    """Return C for which dṗ/dp = −1/τ at p, where a valve passes P₀ C `passed(p)` into the chamber."""
    dead, growth = spec.chamber.dead_volume, spec.chamber.displacement * spec.actuator.gain
    late, step = min(spec.actuator.tau_mode, 0.1 * tau), 1e-3 * p

    def slope(of: Callable[[float], float], at: float) -> float:
        return (of(at + step) - of(at - step)) / (2 * step)

    def prompt(at: float) -> float:
        return REFERENCE_PA * c * passed(at) / (dead + growth * (2 * at + AMBIENT_PA))

    def lagging(at: float) -> float:
        space = dead + growth * (at - late * prompt(at))
        grown = growth * (at + AMBIENT_PA) * (1 - late * slope(prompt, at))
        return REFERENCE_PA * c * passed(at) / (space + grown)

    c = 1.0
    c = -1 / (tau * slope(prompt, p))
    for _ in range(8):
        c /= -tau * slope(lagging, p)
    return c
