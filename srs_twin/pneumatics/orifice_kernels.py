"""Compiled kernels that integrate the equations of the orifice chambers (`orifice`).

The state y of a segment consists of the amounts of air n⁺ and n⁻ in the two chambers
(J) and the linear bend x (rad). The chamber volumes depend either on the free bends or
on the actual bends of a plant. Actual bends are extrapolated linearly from the start of
a schedule (`ActualBends`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, compiled, inlined, kernel_only
from srs_twin.pneumatics.chambers import AMBIENT_PA, BendLaw, apply_bend_law, volume
from srs_twin.pneumatics.flow import flow

GAMMA = 1 - math.sqrt(0.5)
"""Diagonal coefficient γ of SDIRK2, dimensionless.

In a step of length h, the two stages are at the times γ h and h.
"""

_MAX_NEWTON = 40  # Maximum number of Newton iterations per stage.
_NEWTON_TOLERANCE = 1e-12
"""Absolute update below which Newton's method stops, J or rad."""

_X = 2  # Column of y that contains the linear bend.

# Indices of the amounts of air (J) and the flows (J/s) of the whole robot.
LINE = 0  # Air in the line.
DRAWN = 1  # Air delivered by the supply.
LOST = 2  # Air vented and leaked.
AMOUNTS = 3
_SUPPLY_FLOW = 3
_INFLOW = 4

# Indices along the last axis of `_Workspace.linear`.
_ALONE = 0  # Correction at constant line pressure.
_BY_LINE = 1  # Derivative of the correction with respect to the line pressure.

# Indices along the last axis of `_Workspace.terms`.
_COUPLING = 0
_FLOW = 1
_FLOW_BY_LINE = 2
_FLOW_BY_AMOUNT = 3
_FLOW_BY_BEND = 4
_TERMS = 5


class OrificeParameters(NamedTuple):
    """Parameters of the orifice chambers.

    Attributes:
        dead, displacement: dead volume V₀ (m³) and displacement A (m³/rad).
        gain: gain of each chamber, shape (segments, 2), rad/Pa.
        bias: rest bends b, shape (segments,), rad.
        bend_law: parameters of the bend law.
        tau: mode time constant τ₂, s.
        critical: critical pressure ratio b of the valves, dimensionless.
        fill, vent: reference pressure times conductance, P₀ C, of the inlets and of
            the outlets, shape (segments, 2) each, m³/s.
        leak: leak conductance Λ of each chamber, shape (segments, 2), J/(s Pa).
        supply, max_flow: absolute pressure (Pa) and maximum flow (J/s) of the supply.
        band: pressure range over which the regulator closes, Pa.
        line_volume: volume of the line, m³.
        limited: whether the supply flow is limited. Without a limit, the line is always
            at the supply pressure.
    """

    dead: float
    displacement: float
    gain: np.ndarray
    bias: np.ndarray
    bend_law: BendLaw
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


class ActualBends(NamedTuple):
    """Actual bends of a plant.

    Attributes:
        coupled: whether the chamber volumes depend on the actual bends instead of the
            free bends.
        bend: actual bends at the start of the schedule, shape (segments,), rad.
        rate: constant rates of the actual bends, shape (segments,), rad/s.
    """

    coupled: bool
    bend: np.ndarray
    rate: np.ndarray


class OrificeState(NamedTuple):
    """State of the chambers.

    Attributes:
        y: state of each segment, shape (segments, 3).
        amounts: amounts of air in the line, delivered by the supply and lost, shape
            (AMOUNTS,), J.
        pressure: gauge pressures, shape (segments, 2), Pa.
        bend: free bends, shape (segments,), rad.
    """

    y: np.ndarray
    amounts: np.ndarray
    pressure: np.ndarray
    bend: np.ndarray


class _Workspace(NamedTuple):
    """Work arrays for an integration step.

    Attributes:
        base, rates: constant terms of the stage equations, and time derivatives ẏ,
            shape (segments, 3) each.
        bend: actual bends at the time of a stage, shape (segments,), rad.
        linear: corrections of y as linear functions of the line pressure change, shape
            (segments, 3, 2). The indices along the last axis are `_ALONE` and
            `_BY_LINE`.
        terms: chamber terms for the back substitution, shape (segments, 2, _TERMS).
    """

    base: np.ndarray
    rates: np.ndarray
    bend: np.ndarray
    linear: np.ndarray
    terms: np.ndarray


class ChamberFlow(NamedTuple):
    """Pressure of one chamber, flows through its valves, and their derivatives.

    Attributes:
        pressure: absolute pressure P, Pa.
        per_volume: inverse volume 1/V, 1/m³.
        squeeze: derivative −∂P/∂q at a constant amount of air, Pa/rad.
        inflow, outflow: flow from the supply line into the chamber, and flow from the
            chamber to the surroundings, J/s.
        inflow_by_p, outflow_by_p: derivatives of the flows with respect to P, J/(s Pa).
        inflow_by_line: derivative of the inflow with respect to the line pressure, J/(s
            Pa).
    """

    pressure: float
    per_volume: float
    squeeze: float
    inflow: float
    inflow_by_p: float
    inflow_by_line: float
    outflow: float
    outflow_by_p: float


@compiled
def chamber(n, bend, j, side, state, line, air):  # type: ignore[no-untyped-def]
    """Return the `ChamberFlow` of one chamber.

    Args:
        n: amount of air in the chamber, J.
        bend: bend that determines the chamber volume, rad.
        j: segment index, counted from 0.
        side: 0 for the + chamber, 1 for the − chamber.
        state: valve state.
        line: absolute pressure in the supply line, Pa.
        air: chamber parameters (`OrificeParameters`).
    """
    size, growth = volume(air.dead, air.displacement, bend, side)
    pressure = n / size
    inflow = 0.0
    inflow_by_p = 0.0
    inflow_by_line = 0.0
    outflow = air.leak[j, side] * (pressure - AMBIENT_PA)
    outflow_by_p = air.leak[j, side]
    if state != 0:
        # A positive value is a flow into the chamber.
        source = line if state == 1 else AMBIENT_PA
        value, by_source, by_here = flow(source, pressure, air.critical)
        if state == 1:
            conductance = air.fill[j, side]
            inflow = conductance * value
            inflow_by_line = conductance * by_source
            inflow_by_p = conductance * by_here
        else:
            outflow = outflow - air.vent[j, side] * value
            outflow_by_p = outflow_by_p - air.vent[j, side] * by_here
    return ChamberFlow(
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
    """Return the supply flow (J/s) and its derivative with respect to line pressure."""
    opening = (air.supply - line) / air.band
    if opening <= 0.0:
        return 0.0, 0.0
    if opening >= 1.0:
        return air.max_flow, 0.0
    return air.max_flow * opening, -air.max_flow / air.band


@compiled
def _newton(y, amounts, line_base, weight, state, coupled, air, workspace):  # type: ignore[no-untyped-def]
    """Perform one Newton iteration for the stage equation y = base + weight · ẏ.

    Chambers are coupled only by the bend of their segment and by the line. The unknowns
    of each segment are therefore eliminated separately, as linear functions of the line
    pressure change. The weight is γ h (s), and `line_base` is the constant term of the
    stage equation for the amount of air in the line (J). The function returns the
    maximum norm of the update.
    """
    base = workspace.base
    linear = workspace.linear
    terms = workspace.terms
    if air.limited:
        line = amounts[LINE] / air.line_volume
    else:
        line = air.supply
    supply, closing = supply_flow(line, air)
    line_residual = amounts[LINE] - line_base - weight * supply
    line_derivative = air.line_volume - weight * closing
    for j in range(y.shape[0]):
        # Actual bends do not depend on x.
        q, bend_rate, _ = apply_bend_law(y[j, _X], air.bend_law)
        q, bend_rate = (
            (workspace.bend[j], 0.0) if coupled else (air.bias[j] + q, bend_rate)
        )
        bend_derivative = 1.0 + weight / air.tau
        bend_by_line = 0.0
        bend_residual = y[j, _X] * bend_derivative - base[j, _X]
        for side in range(2):
            c = chamber(y[j, side], q, j, side, state[j, side], line, air)
            # The amount of air n in a chamber is eliminated by the linearised equation
            # Δn = alone − coupling · Δx + by_line · Δ(line pressure).
            squeeze = c.squeeze * bend_rate
            rate_by_p = weight * (c.inflow_by_p - c.outflow_by_p)
            pivot = 1.0 - rate_by_p * c.per_volume
            coupling = rate_by_p * squeeze / pivot
            signed = weight * air.gain[j, side] / air.tau * (1.0 - 2.0 * side)
            rest = base[j, side] + weight * (c.inflow - c.outflow) - y[j, side]
            alone = rest / pivot
            by_line = weight * c.inflow_by_line / pivot
            bend_residual -= signed * (c.pressure - AMBIENT_PA + c.per_volume * alone)
            bend_derivative += signed * (squeeze + c.per_volume * coupling)
            bend_by_line += signed * c.per_volume * by_line
            linear[j, side, _ALONE] = alone
            linear[j, side, _BY_LINE] = by_line
            terms[j, side, _COUPLING] = coupling
            terms[j, side, _FLOW] = c.inflow
            terms[j, side, _FLOW_BY_LINE] = c.inflow_by_line
            terms[j, side, _FLOW_BY_AMOUNT] = c.inflow_by_p * c.per_volume
            terms[j, side, _FLOW_BY_BEND] = c.inflow_by_p * squeeze
        # After the elimination of n, Δx depends only on the line pressure.
        linear[j, _X, _ALONE] = -bend_residual / bend_derivative
        linear[j, _X, _BY_LINE] = bend_by_line / bend_derivative
        line_residual, line_derivative = _add_segment_to_line(
            j, line_residual, line_derivative, weight, linear, terms
        )
    line_change = -line_residual / line_derivative if air.limited else 0.0
    return _apply_correction(y, amounts, linear, line_change, air)


@inlined
def _add_segment_to_line(j, residual, derivative, weight, linear, terms):  # type: ignore[no-untyped-def]
    """Substitute Δx into Δn, and add the inflow of a segment to the line equation.

    The function returns the new residual and derivative of the line equation.
    """
    for side in range(2):
        coupling = terms[j, side, _COUPLING]
        inflow = terms[j, side, _FLOW]
        inflow_by_line = terms[j, side, _FLOW_BY_LINE]
        by_amount = terms[j, side, _FLOW_BY_AMOUNT]
        by_bend = terms[j, side, _FLOW_BY_BEND]
        for k in range(2):
            linear[j, side, k] -= coupling * linear[j, _X, k]
        residual += weight * (
            inflow
            + by_amount * linear[j, side, _ALONE]
            - by_bend * linear[j, _X, _ALONE]
        )
        derivative += weight * (
            inflow_by_line
            + by_amount * linear[j, side, _BY_LINE]
            - by_bend * linear[j, _X, _BY_LINE]
        )
    return residual, derivative


@kernel_only
def _apply_correction(y, amounts, linear, change, air):  # type: ignore[no-untyped-def]
    """Apply all corrections in place, and return the maximum norm of the update.

    The argument `change` is the change of the line pressure, Pa.
    """
    amounts[LINE] += change * air.line_volume
    largest = abs(change * air.line_volume)
    for j in range(y.shape[0]):
        for k in range(3):
            step = linear[j, k, _ALONE] + linear[j, k, _BY_LINE] * change
            # An amount of air decreases by at most 90 % per iteration, so that it
            # remains positive.
            if k == _X:
                y[j, k] = y[j, k] + step
            else:
                y[j, k] = max(y[j, k] + step, 0.1 * y[j, k])
            largest = max(largest, abs(step))
    return largest


class _Flows(NamedTuple):
    supply: float
    inflow: float
    outflow: float


@kernel_only
def _rates(y, line_amount, state, coupled, bend, air, dy):  # type: ignore[no-untyped-def]
    if air.limited:
        line = line_amount / air.line_volume
    else:
        line = air.supply
    total_inflow = 0.0
    total_outflow = 0.0
    for j in range(y.shape[0]):
        deviation = -y[j, _X]
        if coupled:
            q = bend[j]
        else:
            q = air.bias[j] + apply_bend_law(y[j, _X], air.bend_law)[0]
        for side in range(2):
            c = chamber(y[j, side], q, j, side, state[j, side], line, air)
            dy[j, side] = c.inflow - c.outflow
            # Gauge pressures are used, because the ambient pressure does not cancel if
            # the two gains differ.
            gauge = c.pressure - AMBIENT_PA
            deviation += (1.0 - 2.0 * side) * air.gain[j, side] * gauge
            total_inflow = total_inflow + c.inflow
            total_outflow = total_outflow + c.outflow
        dy[j, _X] = deviation / air.tau
    supply = supply_flow(line, air)[0] if air.limited else total_inflow
    return _Flows(supply, total_inflow, total_outflow)


@kernel_only
def _extrapolate_bends(bend, actual, time):  # type: ignore[no-untyped-def]
    for j in range(bend.shape[0]):
        bend[j] = actual.bend[j] + actual.rate[j] * time


@kernel_only
def _step(now, h, begun, state, actual, air, workspace):  # type: ignore[no-untyped-def]
    """Advance the state by one SDIRK2 step of length h (s) from the time `begun` (s).

    The state `now` is updated in place. The array `workspace.rates` contains ẏ at the
    start of the step, and is overwritten with ẏ at the end of the step. The function
    returns the supply flow and the total inflow of all chambers at the end of the step,
    J/s.
    """
    y = now.y
    amounts = now.amounts
    base = workspace.base
    dy = workspace.rates
    coupled = actual.coupled
    for j in range(y.shape[0]):
        for k in range(3):
            base[j, k] = y[j, k]
    line_base = amounts[LINE]
    drawn = 0.0
    inflow = 0.0
    for stage in range(2):
        if stage == 1:
            for j in range(y.shape[0]):
                for k in range(3):
                    base[j, k] += (1 - GAMMA) * h * dy[j, k]
            # The line gains the supply flow and loses the inflow of the chambers.
            line_base += (1 - GAMMA) * h * (drawn - inflow) if air.limited else 0.0
        at = GAMMA if stage == 0 else 1.0
        _extrapolate_bends(workspace.bend, actual, begun + at * h)
        for _ in range(_MAX_NEWTON):
            largest = _newton(
                y, amounts, line_base, GAMMA * h, state, coupled, air, workspace
            )
            if largest < _NEWTON_TOLERANCE:
                break
        flows = _rates(y, amounts[LINE], state, coupled, workspace.bend, air, dy)
        drawn = flows.supply
        inflow = flows.inflow
        # The weights of the two stages are 1 − γ and γ.
        fraction = h * (1 - GAMMA if stage == 0 else GAMMA)
        amounts[DRAWN] += fraction * drawn
        amounts[LOST] += fraction * flows.outflow
    return drawn, inflow


class _End(NamedTuple):
    y: np.ndarray
    rates: np.ndarray
    air: np.ndarray


class _StepRows(NamedTuple):
    """Trace rows `first` to `until` − 1, and the step (s) that contains them."""

    first: int
    until: int
    begun: float
    length: float
    begin: _End
    end: _End


@kernel_only
def _copy_end(end, out):  # type: ignore[no-untyped-def]
    for j in range(end.y.shape[0]):
        for i in range(3):
            out.y[j, i] = end.y[j, i]
            out.rates[j, i] = end.rates[j, i]
    for i in range(5):
        out.air[i] = end.air[i]


@kernel_only
def _copy_amounts(now, out):  # type: ignore[no-untyped-def]
    for i in range(AMOUNTS):
        out[i] = now.amounts[i]


@kernel_only
def _rows_until(times, row, finish, is_last):  # type: ignore[no-untyped-def]
    while row < times.shape[0] and (times[row] <= finish or is_last):
        row += 1
    return row


@allocating
def simulate(now, schedule, times, substep, actual, air, trace):  # type: ignore[no-untyped-def]
    """Simulate a schedule, update the state in place, and fill a trace.

    Args:
        now: `OrificeState` at the start of the schedule, updated in place.
        schedule: valve states that include the valve delay and faults.
        times: ascending times of the trace rows, s.
        substep: maximum integration step, s.
        actual: `ActualBends` of the plant.
        air: chamber parameters (`OrificeParameters`).
        trace: `Trace` to fill. The field `pneumatic_energy` receives the amount of air
            delivered by the supply, J.
    """
    y = now.y
    starts = schedule.starts
    segments = y.shape[0]
    workspace = _Workspace(
        np.empty_like(y),
        np.empty_like(y),
        np.empty(segments),
        np.empty((segments, 3, 2)),
        np.empty((segments, 2, _TERMS)),
    )
    begin = _End(np.empty_like(y), np.empty_like(y), np.empty(5))
    end = _End(y, workspace.rates, np.empty(5))
    at_end = end.air
    _copy_amounts(now, at_end)
    row = 0
    runs = starts.shape[0]
    for run in range(runs):
        state = schedule.states[run]
        stop = starts[run + 1] if run + 1 < runs else schedule.span
        count = max(1, math.ceil((stop - starts[run]) / substep * (1 - 1e-12)))
        h = (stop - starts[run]) / count
        _extrapolate_bends(workspace.bend, actual, starts[run])
        flows = _rates(
            y,
            now.amounts[LINE],
            state,
            actual.coupled,
            workspace.bend,
            air,
            workspace.rates,
        )
        at_end[_SUPPLY_FLOW] = flows.supply
        at_end[_INFLOW] = flows.inflow
        for k in range(count):
            begun = starts[run] + k * h
            is_last = k + 1 == count
            finish = stop if is_last else begun + h
            _copy_end(end, begin)
            at_end[_SUPPLY_FLOW], at_end[_INFLOW] = _step(
                now, h, begun, state, actual, air, workspace
            )
            _copy_amounts(now, at_end)
            until = _rows_until(times, row, finish, is_last and run + 1 == runs)
            if until > row:
                step = _StepRows(row, until, begun, h, begin, end)
                _fill_rows(times, step, state, actual, air, trace)
                row = until
    _fill_end(now, schedule.span, actual, air)


@kernel_only
def _fill_end(now, span, actual, air):  # type: ignore[no-untyped-def]
    for j in range(now.y.shape[0]):
        now.bend[j] = air.bias[j] + apply_bend_law(now.y[j, _X], air.bend_law)[0]
        q = now.bend[j]
        if actual.coupled:
            q = actual.bend[j] + actual.rate[j] * span
        for side in range(2):
            size = volume(air.dead, air.displacement, q, side)[0]
            now.pressure[j, side] = now.y[j, side] / size - AMBIENT_PA


class _Sample(NamedTuple):
    y: np.ndarray
    rates: np.ndarray
    bend: np.ndarray


@allocating
def _fill_rows(times, step, state, actual, air, trace):  # type: ignore[no-untyped-def]
    h = step.length
    y0 = step.begin.y
    y1 = step.end.y
    dy0 = step.begin.rates
    dy1 = step.end.rates
    at0 = step.begin.air
    at1 = step.end.air
    segments = y0.shape[0]
    sample = _Sample(np.empty_like(y0), np.empty_like(y0), np.empty(segments))
    y = sample.y
    for row in range(step.first, step.until):
        x = min(1.0, max(0.0, (times[row] - step.begun) / h))
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
        line = at0[LINE] + blend * (at1[LINE] - at0[LINE])
        flow_begin = at0[_SUPPLY_FLOW] - at0[_INFLOW]
        flow_end = at1[_SUPPLY_FLOW] - at1[_INFLOW]
        line += first * flow_begin + second * flow_end
        trace.pneumatic_energy[row] = (
            at0[DRAWN]
            + blend * (at1[DRAWN] - at0[DRAWN])
            + first * at0[_SUPPLY_FLOW]
            + second * at1[_SUPPLY_FLOW]
        )
        _extrapolate_bends(sample.bend, actual, step.begun + x * h)
        _rates(y, line, state, actual.coupled, sample.bend, air, sample.rates)
        for j in range(segments):
            _fill_segment(trace, row, j, sample, state, actual, air)


@kernel_only
def _fill_segment(trace, row, j, at, state, actual, air):  # type: ignore[no-untyped-def]
    y = at.y
    dy = at.rates
    free, derivative, curve = apply_bend_law(y[j, _X], air.bend_law)
    free = free + air.bias[j]
    speed = derivative * dy[j, _X]
    q = free
    rate = speed
    if actual.coupled:
        q = at.bend[j]
        rate = actual.rate[j]
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
        derivative * (rise - dy[j, _X]) / air.tau + curve * dy[j, _X] * dy[j, _X]
    )
