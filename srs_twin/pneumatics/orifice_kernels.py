"""Compiled equations of the orifice chambers and their integration (`orifice`).

The state y of a segment is (n⁺, n⁻, x): two amounts of air (J) and the linear bend
(rad). The volumes depend either on the free bends or on the actual bends of a plant.
Actual bends are extrapolated from the start of a schedule (`ActualBends`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, compiled, inlined, kernel_only
from srs_twin.pneumatics.chambers import AMBIENT_PA, BendLaw, apply_bend_law, volume
from srs_twin.pneumatics.flow import flow

GAMMA = 1 - math.sqrt(0.5)
"""Diagonal γ of SDIRK2, dimensionless. The stages lie at γ h and h."""

_MAX_NEWTON = 40  # Maximum number of Newton iterations per stage.
_NEWTON_TOLERANCE = 1e-12
"""Maximum absolute update for which Newton's method stops, J and rad."""

_X = 2  # Column of y that contains the linear bend.

# Indices of amounts of air (J) and flows (J/s) of the whole robot.
LINE = 0  # Air in the line.
DRAWN = 1  # Air delivered by the supply.
LOST = 2  # Air vented and leaked.
AMOUNTS = 3
_SUPPLY_FLOW = 3
_INFLOW = 4

# Indices of the last axis of the corrections in a Newton iteration.
_ALONE = 0  # Correction at a fixed pressure of the line.
_BY_LINE = 1  # Derivative with respect to the pressure of the line.

# Indices of the chamber terms that the back substitution uses.
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
        bend_law: bend law.
        tau: mode time constant τ₂, s.
        critical: critical pressure ratio b of the valves, dimensionless.
        fill, vent: P₀ C of each inlet and outlet, shape (segments, 2), m³/s.
        leak: leak conductance Λ of each chamber, shape (segments, 2), J/(s Pa).
        supply, max_flow: absolute pressure (Pa) and maximum flow (J/s) of the supply.
        band: pressure range over which the regulator closes, Pa.
        line_volume: volume of the line, m³.
        limited: whether the flow is limited. Without a limit, the line is at the supply
            pressure.
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
        coupled: whether the volumes depend on the actual bends instead of the free
            bends.
        bend: actual bends at the start of the schedule, shape (segments,), rad.
        rate: rates of the actual bends, shape (segments,), rad/s.
    """

    coupled: bool
    bend: np.ndarray
    rate: np.ndarray


class OrificeState(NamedTuple):
    """State of the chambers.

    Attributes:
        y: state of each segment, shape (segments, 3).
        amounts: amounts of air of the whole robot, shape (AMOUNTS,), J.
        pressure: gauge pressures, shape (segments, 2), Pa.
        bend: free bends, shape (segments,), rad.
    """

    y: np.ndarray
    amounts: np.ndarray
    pressure: np.ndarray
    bend: np.ndarray


class _Workspace(NamedTuple):
    """Work arrays of a step.

    Attributes:
        base, rates: constant terms of the stage equation, and ẏ, shape (segments, 3).
        bend: actual bends at the time of a stage, rad.
        linear: corrections of y as linear functions of the change of the line pressure,
            shape (segments, 3, 2). The last axis has the indices `_ALONE` and
            `_BY_LINE`.
        terms: terms of the chambers, shape (segments, 2, _TERMS).
    """

    base: np.ndarray
    rates: np.ndarray
    bend: np.ndarray
    linear: np.ndarray
    terms: np.ndarray


class ChamberFlow(NamedTuple):
    """Pressure and flows of one chamber, with their derivatives.

    Attributes:
        pressure: absolute pressure P, Pa.
        per_volume: inverse volume 1/V, 1/m³.
        squeeze: derivative −∂P/∂q, Pa/rad.
        inflow, outflow: flow from the line, and flow to the surroundings, J/s.
        inflow_by_p, outflow_by_p: derivatives of the flows with respect to P, J/(s Pa).
        inflow_by_line: derivative of the inflow with respect to the pressure of the
            line, J/(s Pa).
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
        n: amount of air, J.
        bend: bend that determines the volume, rad.
        j: segment index.
        side: 0 for the + chamber, 1 for the − chamber.
        state: valve state.
        line: absolute pressure in the line upstream of the inlets, Pa.
        air: `OrificeParameters`.
    """
    size, growth = volume(air.dead, air.displacement, bend, side)
    pressure = n / size
    inflow = 0.0
    inflow_by_p = 0.0
    inflow_by_line = 0.0
    outflow = air.leak[j, side] * (pressure - AMBIENT_PA)
    outflow_by_p = air.leak[j, side]
    if state != 0:
        # Flow into the chamber is positive.
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
    """Return the supply flow into the line (J/s) and its pressure derivative."""
    opening = (air.supply - line) / air.band
    if opening <= 0.0:
        return 0.0, 0.0
    if opening >= 1.0:
        return air.max_flow, 0.0
    return air.max_flow * opening, -air.max_flow / air.band


@compiled
def _newton(y, amounts, line_base, weight, state, coupled, air, workspace):  # type: ignore[no-untyped-def]
    """Perform one Newton iteration for the stage equation y = base + weight · ẏ.

    The function returns the maximum norm of the update. Chambers depend on each other
    only through the bend of their segment and through the line. The unknowns of each
    segment are therefore eliminated separately, as linear functions of the change of
    the line pressure. The weight is γ h (s), and `line_base` contains the terms of the
    amount of air in the line that do not depend on the unknowns.
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
        # A prescribed bend does not depend on x.
        q, bend_rate, _ = apply_bend_law(y[j, _X], air.bend_law)
        q, bend_rate = (
            (workspace.bend[j], 0.0) if coupled else (air.bias[j] + q, bend_rate)
        )
        bend_derivative = 1.0 + weight / air.tau
        bend_by_line = 0.0
        bend_residual = y[j, _X] * bend_derivative - base[j, _X]
        for side in range(2):
            c = chamber(y[j, side], q, j, side, state[j, side], line, air)
            # The amount of air n of the chamber is eliminated by the linearised equation
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
        # After n is eliminated, the equation for x depends only on the line pressure.
        linear[j, _X, _ALONE] = -bend_residual / bend_derivative
        linear[j, _X, _BY_LINE] = bend_by_line / bend_derivative
        line_residual, line_derivative = _add_segment_to_line(
            j, line_residual, line_derivative, weight, linear, terms
        )
    line_change = -line_residual / line_derivative if air.limited else 0.0
    return _apply_correction(y, amounts, linear, line_change, air)


@inlined
def _add_segment_to_line(j, residual, derivative, weight, linear, terms):  # type: ignore[no-untyped-def]
    """Correct the amounts of air of a segment, and add its inflow to the line."""
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
    """Apply the corrections for a change of the line pressure (Pa) in place."""
    amounts[LINE] += change * air.line_volume
    largest = abs(change * air.line_volume)
    for j in range(y.shape[0]):
        for k in range(3):
            step = linear[j, k, _ALONE] + linear[j, k, _BY_LINE] * change
            # The decrease is limited so that the amount of air remains positive.
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
            # The ambient pressure does not cancel if the two gains differ, so gauge
            # pressures are needed.
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
    """Advance y and amounts in place by one step of SDIRK2 from the time `begun` (s).

    The array `workspace.rates` contains ẏ at the start of the step, and is overwritten
    with ẏ at the end of the step. The function returns the flow from the supply and the
    total inflow at the end of the step, J/s.
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
    """Rows `first` to `until` − 1 of a trace, which lie within one step (s)."""

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
    """Simulate a schedule in place and write a trace at the given times.

    Args:
        now: `OrificeState`, updated in place.
        schedule: valve states with delay and faults.
        times: ascending times, s.
        substep: maximum step, s.
        actual: actual bends.
        air: `OrificeParameters`.
        trace: output. The field `pneumatic_energy` receives the consumed air, J.
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
