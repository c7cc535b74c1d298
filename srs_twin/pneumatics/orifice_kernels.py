"""Compiled equations of the orifice chambers and their integration (`orifice`).

The state y of a segment is (n⁺, n⁻, x): amounts of air (J) and linear bend (rad). The
`amounts` of the whole robot are (n_line, drawn, lost), J.

`motion` is the pair (coupled, actual). If coupled is true, the volumes follow the
actual bends, which are extrapolated from `actual`: the bends (rad) and their rates
(rad/s) at the start of the schedule, shape (2, segments). Otherwise the volumes follow
the free bends.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, compiled, kernel_only
from srs_twin.pneumatics.chambers import AMBIENT_PA, BendLaw, apply_bend_law, volume
from srs_twin.pneumatics.flow import flow

GAMMA = 1 - math.sqrt(0.5)
"""Diagonal γ of SDIRK2, 1; its stages are at γ h and h."""

_MAX_NEWTON = 40  # iterations of a stage
_NEWTON_TOLERANCE = (
    1e-12  # largest correction at which Newton's method stops, J and rad
)


class Plumbing(NamedTuple):
    """Parameters of the equations.

    Attributes:
        dead: dead volume V₀, m³.
        displacement: A, m³/rad.
        gain: gain of each chamber, shape (segments, 2), rad/Pa.
        bias: rest bends b, shape (segments,), rad.
        law: a `BendLaw`.
        tau: mode time constant τ₂, s.
        critical: critical pressure ratio b of the valves, 1.
        fill: P₀ C of each inlet, shape (segments, 2), m³/s.
        vent: P₀ C of each outlet, shape (segments, 2), m³/s.
        leak: leak conductance Λ of each chamber, shape (segments, 2), J/(s Pa).
        supply: absolute supply pressure, Pa.
        max_flow: largest flow of the supply, J/s.
        band: pressure range over which its regulator closes, Pa.
        line_volume: m³.
        limited: whether the flow is limited; otherwise the line has the pressure of the
            supply.
    """

    dead: float
    displacement: float
    gain: np.ndarray
    bias: np.ndarray
    law: BendLaw
    tau: float
    critical: float
    fill: np.ndarray
    vent: np.ndarray
    leak: np.ndarray
    supply: float
    max_flow: float
    band: float
    line_volume: float
    limited: bool


@compiled
def chamber(n, bend, j, side, state, line, air):  # type: ignore[no-untyped-def]
    """Return pressure and flows of one chamber, with their derivatives.

    Args:
        n: amount of air, J.
        bend: bend that determines the volume, rad.
        j: segment.
        side: 0 for the + chamber, 1 for the − chamber.
        state: valve state.
        line: absolute pressure before the inlets, Pa.
        air: the plumbing.

    Returns:
        Absolute pressure P (Pa); 1/V; −∂P/∂q; inflow from the line (J/s) and its
        derivatives by P and by the line's pressure; outflow (J/s) and its derivative by
        P.
    """
    size, growth = volume(air.dead, air.displacement, bend, side)
    pressure = n / size
    inflow = 0.0
    inflow_by_p = 0.0
    inflow_by_line = 0.0
    outflow = air.leak[j, side] * (pressure - AMBIENT_PA)
    outflow_by_p = air.leak[j, side]
    if state != 0:
        value, by_source, by_here = flow(
            line if state == 1 else AMBIENT_PA, pressure, air.critical
        )
        if state == 1:
            conductance = air.fill[j, side]
            inflow = conductance * value
            inflow_by_line = conductance * by_source
            inflow_by_p = conductance * by_here
        else:
            outflow = outflow - air.vent[j, side] * value
            outflow_by_p = outflow_by_p - air.vent[j, side] * by_here
    return (
        pressure,
        1.0 / size,
        pressure * growth / size,
        inflow,
        inflow_by_p,
        inflow_by_line,
        outflow,
        outflow_by_p,
    )


@kernel_only
def supply_flow(line, air):  # type: ignore[no-untyped-def]
    """Return the supply's flow into a line at a pressure (J/s), and its derivative by that pressure."""
    opening = (air.supply - line) / air.band
    if opening <= 0.0:
        return 0.0, 0.0
    if opening >= 1.0:
        return air.max_flow, 0.0
    return air.max_flow * opening, -air.max_flow / air.band


@compiled
def _newton(y, amounts, line_base, weight, state, coupled, air, work):  # type: ignore[no-untyped-def]
    """Make one Newton iteration of y = base + weight · ẏ for y and the line; return its size.

    Chambers depend on each other only through the bend of their segment and through the
    line. Each segment is therefore eliminated separately, as a linear function of the
    change of the line's pressure.

    Args:
        y: state, shape (segments, 3).
        amounts: amounts of air of the whole robot, shape (3,).
        line_base: known part of the amount of air in the line, J.
        weight: γ h, s.
        state: valve states, shape (segments, 2).
        coupled: see module docstring.
        air: the plumbing.
        work: the known part `base` of y; ẏ; actual bends, shape (segments,), rad;
            corrections without a change of the line and their slopes by its pressure,
            shape (segments, 3, 2); and quantities of the chambers for the back
            substitution, shape (segments, 2, 5).
    """
    base, _, bend, linear, terms = work
    if air.limited:
        line = amounts[0] / air.line_volume
    else:
        line = air.supply
    supply, closing = supply_flow(line, air)
    line_residual = amounts[0] - line_base - weight * supply
    line_slope = air.line_volume - weight * closing
    for j in range(y.shape[0]):
        # Derivative of the bend with respect to x: 0 if the plant prescribes the bend.
        q, bend_rate, _ = apply_bend_law(y[j, 2], air.law)
        q, bend_rate = (bend[j], 0.0) if coupled else (air.bias[j] + q, bend_rate)
        bend_slope = 1.0 + weight / air.tau
        bend_by_line = 0.0
        bend_residual = y[j, 2] * bend_slope - base[j, 2]
        for side in range(2):
            (
                p,
                inverse,
                squeeze,
                inflow,
                inflow_by_p,
                inflow_by_line,
                outflow,
                outflow_by_p,
            ) = chamber(y[j, side], q, j, side, state[j, side], line, air)
            # Eliminate the amount of air n of the chamber: Newton's row is linear in x
            # and the line.
            squeeze *= bend_rate
            rate_by_p = weight * (inflow_by_p - outflow_by_p)
            pivot = 1.0 - rate_by_p * inverse
            coupling = rate_by_p * squeeze / pivot
            signed = weight * air.gain[j, side] / air.tau * (1.0 - 2.0 * side)
            linear[j, side, 0] = (
                base[j, side] + weight * (inflow - outflow) - y[j, side]
            ) / pivot
            linear[j, side, 1] = weight * inflow_by_line / pivot
            bend_residual -= signed * (p - AMBIENT_PA + inverse * linear[j, side, 0])
            bend_slope += signed * (squeeze + inverse * coupling)
            bend_by_line += signed * inverse * linear[j, side, 1]
            terms[j, side, 0] = coupling
            terms[j, side, 1] = inflow
            terms[j, side, 2] = inflow_by_line
            terms[j, side, 3] = inflow_by_p * inverse
            terms[j, side, 4] = inflow_by_p * squeeze
        # With both chambers eliminated, the row of x depends on the line only.
        linear[j, 2, 0] = -bend_residual / bend_slope
        linear[j, 2, 1] = bend_by_line / bend_slope
        for side in range(2):
            coupling = terms[j, side, 0]
            inflow = terms[j, side, 1]
            inflow_by_line = terms[j, side, 2]
            by_amount = terms[j, side, 3]
            by_bend = terms[j, side, 4]
            for k in range(2):
                linear[j, side, k] -= coupling * linear[j, 2, k]
            line_residual += weight * (
                inflow + by_amount * linear[j, side, 0] - by_bend * linear[j, 2, 0]
            )
            line_slope += weight * (
                inflow_by_line
                + by_amount * linear[j, side, 1]
                - by_bend * linear[j, 2, 1]
            )
    return _apply_correction(
        y, amounts, linear, -line_residual / line_slope if air.limited else 0.0, air
    )


@kernel_only
def _apply_correction(y, amounts, linear, change, air):  # type: ignore[no-untyped-def]
    """Add the corrections for a change of the line's pressure (Pa) in place; return the largest one."""
    amounts[0] += change * air.line_volume
    largest = abs(change * air.line_volume)
    for j in range(y.shape[0]):
        for k in range(3):
            step = linear[j, k, 0] + linear[j, k, 1] * change
            # Amounts of air remain positive, so limit their decrease.
            if k == 2:
                y[j, k] = y[j, k] + step
            else:
                y[j, k] = max(y[j, k] + step, 0.1 * y[j, k])
            largest = max(largest, abs(step))
    return largest


@kernel_only
def _rates(y, line_amount, state, coupled, bend, air, dy):  # type: ignore[no-untyped-def]
    """Fill dy with ẏ; return the flow from the supply, the total inflow and the total outflow, J/s."""
    if air.limited:
        line = line_amount / air.line_volume
    else:
        line = air.supply
    total_inflow = 0.0
    total_outflow = 0.0
    for j in range(y.shape[0]):
        deviation = -y[j, 2]
        if coupled:
            q = bend[j]
        else:
            q = air.bias[j] + apply_bend_law(y[j, 2], air.law)[0]
        for side in range(2):
            p, _, _, inflow, _, _, outflow, _ = chamber(
                y[j, side], q, j, side, state[j, side], line, air
            )
            dy[j, side] = inflow - outflow
            # Gauge pressures: the two gains differ, so ambient pressure does not
            # cancel.
            deviation += (1.0 - 2.0 * side) * air.gain[j, side] * (p - AMBIENT_PA)
            total_inflow = total_inflow + inflow
            total_outflow = total_outflow + outflow
        dy[j, 2] = deviation / air.tau
    return (
        supply_flow(line, air)[0] if air.limited else total_inflow,
        total_inflow,
        total_outflow,
    )


@kernel_only
def _extrapolate_bends(bend, actual, time):  # type: ignore[no-untyped-def]
    """Fill the actual bends at a time after the start of the schedule (s)."""
    for j in range(bend.shape[0]):
        bend[j] = actual[0, j] + actual[1, j] * time


@kernel_only
def _step(y, amounts, h, begun, state, motion, air, work):  # type: ignore[no-untyped-def]
    """Advance y and amounts in place by one step of SDIRK2.

    Args:
        y: state, shape (segments, 3).
        amounts: shape (3,).
        h: length of the step, s.
        begun: time at its beginning, s.
        state: valve states, shape (segments, 2).
        motion: see module docstring.
        air: the plumbing.
        work: arrays as in `_newton`; on return the second one holds ẏ at the end of the
            step.

    Returns:
        Flow from the supply and total inflow at the end, J/s.
    """
    base, dy, bend, _, _ = work
    coupled, actual = motion
    for j in range(y.shape[0]):
        for k in range(3):
            base[j, k] = y[j, k]
    line_base = amounts[0]
    drawn = 0.0
    inflow = 0.0
    for stage in range(2):
        if stage == 1:
            for j in range(y.shape[0]):
                for k in range(3):
                    base[j, k] += (1 - GAMMA) * h * dy[j, k]
            line_base += (1 - GAMMA) * h * (drawn - inflow) if air.limited else 0.0
        _extrapolate_bends(bend, actual, begun + (GAMMA if stage == 0 else 1.0) * h)
        for _ in range(_MAX_NEWTON):
            if (
                _newton(y, amounts, line_base, GAMMA * h, state, coupled, air, work)
                < _NEWTON_TOLERANCE
            ):
                break
        drawn, inflow, outflow = _rates(y, amounts[0], state, coupled, bend, air, dy)
        share = h * (1 - GAMMA if stage == 0 else GAMMA)
        amounts[1] += share * drawn
        amounts[2] += share * outflow
    return drawn, inflow


@allocating
def simulate(start, schedule, times, substep, motion, air, end, trace):  # type: ignore[no-untyped-def]
    """Advance a state in place over a schedule; fill `end`, and a trace at `times`.

    Args:
        start: y, shape (segments, 3), and amounts, shape (3,).
        schedule: effective valve states.
        times: ascending, shape (times,), s.
        substep: longest step, s.
        motion: see module docstring.
        air: the plumbing.
        end: out, at the end: gauge pressures, shape (segments, 2), Pa, and free bends,
            shape (segments,), rad.
        trace: out; its air is the amount drawn, J.
    """
    (y, amounts), (span, starts, states) = start, schedule
    segments = y.shape[0]
    pressure, free = end
    coupled, actual = motion
    base = np.empty_like(y)
    dy = np.empty_like(y)
    bend = np.empty(segments)
    work = base, dy, bend, np.empty((segments, 3, 2)), np.empty((segments, 2, 5))
    begin = np.empty_like(y)
    slope = np.empty_like(y)
    at_begin = np.empty(5)
    at_end = np.empty(5)
    row = 0
    runs = starts.shape[0]
    for run in range(runs):
        stop = starts[run + 1] if run + 1 < runs else span
        count = max(1, math.ceil((stop - starts[run]) / substep * (1 - 1e-12)))
        h = (stop - starts[run]) / count
        _extrapolate_bends(bend, actual, starts[run])
        at_end[3], at_end[4], _ = _rates(
            y, amounts[0], states[run], coupled, bend, air, dy
        )
        for k in range(count):
            begun = starts[run] + k * h
            finish = stop if k + 1 == count else begun + h
            for j in range(segments):
                for i in range(3):
                    begin[j, i] = y[j, i]
                    slope[j, i] = dy[j, i]
            for i in range(3):
                at_begin[i] = amounts[i]
            at_begin[3] = at_end[3]
            at_begin[4] = at_end[4]
            at_end[3], at_end[4] = _step(
                y, amounts, h, begun, states[run], motion, air, work
            )
            for i in range(3):
                at_end[i] = amounts[i]
            until = row
            while until < times.shape[0] and (
                times[until] <= finish or (k + 1 == count and run + 1 == runs)
            ):
                until += 1
            if until > row:
                ends = (begin, slope, at_begin), (y, dy, at_end)
                _fill_rows(
                    times,
                    (row, until),
                    (begun, h),
                    ends,
                    states[run],
                    motion,
                    air,
                    trace,
                )
                row = until
    for j in range(segments):
        free[j] = air.bias[j] + apply_bend_law(y[j, 2], air.law)[0]
        q = actual[0, j] + actual[1, j] * span if coupled else free[j]
        for side in range(2):
            size = volume(air.dead, air.displacement, q, side)[0]
            pressure[j, side] = y[j, side] / size - AMBIENT_PA


@allocating
def _fill_rows(times, rows, step, ends, state, motion, air, trace):  # type: ignore[no-untyped-def]
    """Fill rows of a trace within a step from the cubic Hermite polynomials through both ends of the step.

    The step is its beginning and its length, s. Each of `ends` has y, ẏ, and an array
    (5,) of the amounts, the flow from the supply and the total inflow.
    """
    (begun, h), (coupled, actual), (y0, dy0, at0), (y1, dy1, at1) = (
        step,
        motion,
        ends[0],
        ends[1],
    )
    segments = y0.shape[0]
    y = np.empty_like(y0)
    dy = np.empty_like(y0)
    bend = np.empty(segments)
    for row in range(rows[0], rows[1]):
        x = min(1.0, max(0.0, (times[row] - begun) / h))
        first = x * (1 - x) ** 2 * h
        second = -(x * x) * (1 - x) * h
        blend = x * x * (3 - 2 * x)
        for j in range(segments):
            for k in range(3):
                y[j, k] = (
                    y0[j, k]
                    + blend * (y1[j, k] - y0[j, k])
                    + first * dy0[j, k]
                    + second * dy1[j, k]
                )
        line = at0[0] + blend * (at1[0] - at0[0])
        line += first * (at0[3] - at0[4]) + second * (at1[3] - at1[4])
        trace.air[row] = (
            at0[1] + blend * (at1[1] - at0[1]) + first * at0[3] + second * at1[3]
        )
        _extrapolate_bends(bend, actual, begun + x * h)
        _rates(y, line, state, coupled, bend, air, dy)
        for j in range(segments):
            free, slope, curve = apply_bend_law(y[j, 2], air.law)
            free = free + air.bias[j]
            speed = slope * dy[j, 2]
            q, rate = (bend[j], actual[1, j]) if coupled else (free, speed)
            rise = 0.0
            for side in range(2):
                size, growth = volume(air.dead, air.displacement, q, side)
                pressure = y[j, side] / size
                signed = (1.0 - 2.0 * side) * air.gain[j, side]
                rise += signed * (dy[j, side] - pressure * growth * rate) / size
                trace.pressure[row, j, side] = pressure - AMBIENT_PA
                trace.valves[row, j, side] = state[j, side]
            trace.bend[row, j] = free
            trace.bend_rate[row, j] = speed
            trace.bend_acceleration[row, j] = (
                slope * (rise - dy[j, 2]) / air.tau + curve * dy[j, 2] * dy[j, 2]
            )
