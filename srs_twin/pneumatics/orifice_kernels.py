"""The orifice chambers' equations and their integration, compiled; see `orifice.py`.

A segment's state y is (n⁺, n⁻, x): amounts of air (J) and linear bend (rad), see `bending`. The books are
(n_line, drawn, lost), J. `given` tells that the volumes follow actual bends, `actual` = (bend, bend rate) of
the stretch's start, and not the free ones.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
from srs_twin.pneumatics.chambers import AMBIENT_PA, BendLaw, bent, volume
from srs_twin.pneumatics.flow import flow

GAMMA = 1 - math.sqrt(0.5)
"""Of SDIRK2: stages at γ and 1."""

_NEWTON = 40
_CLOSE = 1e-12  # J and rad: where Newton's method stops


class Plumbing(NamedTuple):
    """What the equations need.

    Attributes:
        dead: V₀, m³.
        displacement: A, m³/rad.
        gain: of each chamber, shape (segments, 2), rad/Pa.
        bias: b, shape (segments,), rad.
        law: of the bend, see `chambers.bend_law`.
        tau: τ₂, s.
        critical: critical pressure ratio.
        fill: P₀ C of each chamber's inlet, shape (segments, 2), m³/s.
        vent: P₀ C of each chamber's outlet, same shape, m³/s.
        leak: Λ of each chamber, shape (segments, 2), J/(s Pa).
        supply: absolute, Pa.
        most: largest flow of the supply, J/s.
        band: pressure over which its regulator closes, Pa.
        line: volume of the line, m³.
        limited: whether supply and line are as above; else the line has the supply's pressure.
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
    most: float
    band: float
    line: float
    limited: bool


@compiled
def chamber(n, bend, j, side, state, line, air):  # type: ignore[no-untyped-def]
    """Return what one chamber does.

    Args:
        n: amount of air, J.
        bend: that its volume follows, rad.
        j: its segment.
        side: 0 for +, 1 for −.
        state: of its valve.
        line: absolute pressure before the inlets, Pa.
        air: the plumbing.

    Returns:
        Absolute pressure P (Pa), 1/V, −∂P/∂q, flow in from the line (J/s) with its derivatives by P and by
        the line's pressure, flow out (J/s) with its derivative by P.
    """
    size, growth = volume(air.dead, air.displacement, bend, side)
    pressure = n / size
    come, come_here, come_line = 0.0, 0.0, 0.0
    gone, gone_here = air.leak[j, side] * (pressure - AMBIENT_PA), air.leak[j, side]
    if state != 0:
        value, by_source, by_here = flow(line if state == 1 else AMBIENT_PA, pressure, air.critical)
        if state == 1:
            wide = air.fill[j, side]
            come, come_line, come_here = wide * value, wide * by_source, wide * by_here
        else:
            gone, gone_here = gone - air.vent[j, side] * value, gone_here - air.vent[j, side] * by_here
    return pressure, 1.0 / size, pressure * growth / size, come, come_here, come_line, gone, gone_here


@compiled
def supplied(line, air):  # type: ignore[no-untyped-def]
    """Return what the supply delivers into a line at a pressure (J/s) and the derivative by that."""
    open_by = (air.supply - line) / air.band
    if open_by <= 0.0:
        return 0.0, 0.0
    if open_by >= 1.0:
        return air.most, 0.0
    return air.most * open_by, -air.most / air.band


@compiled
def _newton(y, books, base, line_base, weight, state, given, bend, air, linear, met):  # type: ignore[no-untyped-def]
    """Improve y and the line in place by one Newton iteration of y = base + weight · ẏ; return its size.

    Chambers depend on each other through their segment's bend and through the line only, so each segment is
    eliminated for itself, as a linear function of the line's pressure: `linear` (segments, 3, 2) holds the
    corrections without it and their slopes over it, `met` (segments, 2, 5) what the chambers said.
    """
    line = books[0] / air.line if air.limited else air.supply
    delivered, closing = supplied(line, air)
    rest = books[0] - line_base - weight * delivered
    steep = air.line - weight * closing
    for j in range(y.shape[0]):
        turned, follows, _ = bent(y[j, 2], air.law)
        turned, follows = (bend[j], 0.0) if given else (air.bias[j] + turned, follows)
        matrix, by_line = 1.0 + weight / air.tau, 0.0
        missing = y[j, 2] * matrix - base[j, 2]
        for side in range(2):
            p, inverse, squeeze, come, come_here, come_line, gone, gone_here = chamber(
                y[j, side], turned, j, side, state[j, side], line, air
            )
            squeeze *= follows
            here = weight * (come_here - gone_here)
            own = 1.0 - here * inverse
            coupling = here * squeeze / own
            signed = weight * air.gain[j, side] / air.tau * (1.0 - 2.0 * side)
            linear[j, side, 0] = (base[j, side] + weight * (come - gone) - y[j, side]) / own
            linear[j, side, 1] = weight * come_line / own
            missing -= signed * (p - AMBIENT_PA + inverse * linear[j, side, 0])
            matrix += signed * (squeeze + inverse * coupling)
            by_line += signed * inverse * linear[j, side, 1]
            met[j, side, 0], met[j, side, 1], met[j, side, 2] = coupling, come, come_line
            met[j, side, 3], met[j, side, 4] = come_here * inverse, come_here * squeeze
        linear[j, 2, 0], linear[j, 2, 1] = -missing / matrix, by_line / matrix
        for side in range(2):
            coupling, come, come_line = met[j, side, 0], met[j, side, 1], met[j, side, 2]
            by_amount, by_bend = met[j, side, 3], met[j, side, 4]
            for k in range(2):
                linear[j, side, k] -= coupling * linear[j, 2, k]
            rest += weight * (come + by_amount * linear[j, side, 0] - by_bend * linear[j, 2, 0])
            steep += weight * (come_line + by_amount * linear[j, side, 1] - by_bend * linear[j, 2, 1])
    return _correct(y, books, linear, -rest / steep if air.limited else 0.0, air)


@compiled
def _correct(y, books, linear, change, air):  # type: ignore[no-untyped-def]
    """Add the corrections for a change of the line's pressure (Pa) in place; return the largest one."""
    books[0] += change * air.line
    largest = abs(change * air.line)
    for j in range(y.shape[0]):
        for k in range(3):
            step = linear[j, k, 0] + linear[j, k, 1] * change
            # No chamber is ever empty.
            y[j, k] = y[j, k] + step if k == 2 else max(y[j, k] + step, 0.1 * y[j, k])
            largest = max(largest, abs(step))
    return largest


@compiled
def _slopes(y, line_amount, state, given, bend, air, dy):  # type: ignore[no-untyped-def]
    """Fill dy with ẏ; return the flows from the supply, into all chambers, and out of them, J/s."""
    line = line_amount / air.line if air.limited else air.supply
    come_all, gone_all = 0.0, 0.0
    for j in range(y.shape[0]):
        pull = -y[j, 2]
        turned = bend[j] if given else air.bias[j] + bent(y[j, 2], air.law)[0]
        for side in range(2):
            p, _, _, come, _, _, gone, _ = chamber(y[j, side], turned, j, side, state[j, side], line, air)
            dy[j, side] = come - gone
            # Of gauge pressures: gains differ, so what both chambers have in common counts.
            pull += (1.0 - 2.0 * side) * air.gain[j, side] * (p - AMBIENT_PA)
            come_all, gone_all = come_all + come, gone_all + gone
        dy[j, 2] = pull / air.tau
    return supplied(line, air)[0] if air.limited else come_all, come_all, gone_all


@compiled
def _extrapolate(bend, actual, time):  # type: ignore[no-untyped-def]
    """Fill the bends at a time from those of the stretch's start and their rates."""
    for j in range(bend.shape[0]):
        bend[j] = actual[0, j] + actual[1, j] * time


@compiled
def _step(y, books, h, begun, state, given, actual, air, work):  # type: ignore[no-untyped-def]
    """Advance y and books in place by one step of SDIRK2 of length h that begins at `begun`.

    Returns:
        The flows from the supply and into all chambers at the end, J/s; the work space's dy holds ẏ there.
    """
    base, dy, bend, linear, met = work
    for j in range(y.shape[0]):
        for k in range(3):
            base[j, k] = y[j, k]
    line_base, drawn, come = books[0], 0.0, 0.0
    for stage in range(2):
        if stage == 1:
            for j in range(y.shape[0]):
                for k in range(3):
                    base[j, k] += (1 - GAMMA) * h * dy[j, k]
            line_base += (1 - GAMMA) * h * (drawn - come) if air.limited else 0.0
        _extrapolate(bend, actual, begun + (GAMMA if stage == 0 else 1.0) * h)
        for _ in range(_NEWTON):
            size = _newton(y, books, base, line_base, GAMMA * h, state, given, bend, air, linear, met)
            if size < _CLOSE:
                break
        drawn, come, gone = _slopes(y, books[0], state, given, bend, air, dy)
        share = h * (1 - GAMMA if stage == 0 else GAMMA)
        books[1] += share * drawn
        books[2] += share * gone
    return drawn, come


@allocating
def follow(y, books, schedule, times, substep, given, actual, air, end, trace):  # type: ignore[no-untyped-def]
    """Advance y and books in place over a schedule and fill `end` and a trace at `times`.

    Args:
        y: shape (segments, 3).
        books: shape (3,).
        schedule: of the valves.
        times: ascending, shape (times,), s.
        substep: longest step, s.
        given: whether `actual` holds.
        actual: bends (rad) and their rates (rad/s) at the start, shape (2, segments).
        air: the plumbing.
        end: out, at the end: pressures, gauge, shape (segments, 2), Pa, and free bends, (segments,), rad.
        trace: out; air as amount drawn, J.
    """
    span, starts, states = schedule
    segments = y.shape[0]
    pressure, free = end
    base, dy, bend = np.empty_like(y), np.empty_like(y), np.empty(segments)
    work = base, dy, bend, np.empty((segments, 3, 2)), np.empty((segments, 2, 5))
    begin, slope, at_begin = np.empty_like(y), np.empty_like(y), np.empty(5)
    at_end = np.empty(5)
    row, runs = 0, starts.shape[0]
    for run in range(runs):
        stop = starts[run + 1] if run + 1 < runs else span
        count = max(1, math.ceil((stop - starts[run]) / substep * (1 - 1e-12)))
        h = (stop - starts[run]) / count
        _extrapolate(bend, actual, starts[run])
        at_end[3], at_end[4], _ = _slopes(y, books[0], states[run], given, bend, air, dy)
        for k in range(count):
            begun = starts[run] + k * h
            finish = stop if k + 1 == count else begun + h
            for j in range(segments):
                for i in range(3):
                    begin[j, i], slope[j, i] = y[j, i], dy[j, i]
            for i in range(3):
                at_begin[i] = books[i]
            at_begin[3], at_begin[4] = at_end[3], at_end[4]
            at_end[3], at_end[4] = _step(y, books, h, begun, states[run], given, actual, air, work)
            for i in range(3):
                at_end[i] = books[i]
            until = row
            while until < times.shape[0] and (times[until] <= finish or (k + 1 == count and run + 1 == runs)):
                until += 1
            if until > row:
                ends = (begin, slope, at_begin), (y, dy, at_end)
                _look(times, row, until, begun, h, ends, states[run], given, actual, air, trace)
                row = until
    for j in range(segments):
        free[j] = air.bias[j] + bent(y[j, 2], air.law)[0]
        turned = actual[0, j] + actual[1, j] * span if given else free[j]
        for side in range(2):
            size = volume(air.dead, air.displacement, turned, side)[0]
            pressure[j, side] = y[j, side] / size - AMBIENT_PA


@allocating
def _look(times, first_row, until, begun, h, ends, state, given, actual, air, trace):  # type: ignore[no-untyped-def]
    """Fill rows of a trace inside a step from the cubics through values and slopes at its ends.

    Of either end: y, ẏ, and the books with the flows from the supply and into all chambers.
    """
    (y0, dy0, at0), (y1, dy1, at1) = ends
    segments = y0.shape[0]
    y, dy, bend = np.empty_like(y0), np.empty_like(y0), np.empty(segments)
    for row in range(first_row, until):
        x = min(1.0, max(0.0, (times[row] - begun) / h))
        first, second = x * (1 - x) ** 2 * h, -(x * x) * (1 - x) * h
        part = x * x * (3 - 2 * x)
        for j in range(segments):
            for k in range(3):
                y[j, k] = y0[j, k] + part * (y1[j, k] - y0[j, k]) + first * dy0[j, k] + second * dy1[j, k]
        line = at0[0] + part * (at1[0] - at0[0])
        line += first * (at0[3] - at0[4]) + second * (at1[3] - at1[4])
        trace.air[row] = at0[1] + part * (at1[1] - at0[1]) + first * at0[3] + second * at1[3]
        _extrapolate(bend, actual, begun + x * h)
        _slopes(y, line, state, given, bend, air, dy)
        for j in range(segments):
            shown, slope, curve = bent(y[j, 2], air.law)
            shown, speed = shown + air.bias[j], slope * dy[j, 2]
            turned, rate = (bend[j], actual[1, j]) if given else (shown, speed)
            rise = 0.0
            for side in range(2):
                size, growth = volume(air.dead, air.displacement, turned, side)
                inside = y[j, side] / size
                signed = (1.0 - 2.0 * side) * air.gain[j, side]
                rise += signed * (dy[j, side] - inside * growth * rate) / size
                trace.pressure[row, j, side], trace.valves[row, j, side] = inside - AMBIENT_PA, state[j, side]
            trace.bend[row, j], trace.bend_rate[row, j] = shown, speed
            trace.bend_acceleration[row, j] = (
                slope * (rise - dy[j, 2]) / air.tau + curve * dy[j, 2] * dy[j, 2]
            )
