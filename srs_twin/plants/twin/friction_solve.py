r"""The friction solve of one step: what `loaded` derives, for numba and for other compilers.

Everything here is written in what numba and Warp both compile: records of arrays, numbers, loops; constants
have a point, and what changes in a loop is made by `float`.

Newton's method. Its matrix has the pattern of M and is factored like M, because a wheel moves with the
ancestors of its connector alone: as in the composite-rigid-body algorithm, what wheels add is summed from the
ends of the chain to its root. Spatial vectors are rotation first, about the centre of mass, as in `cdof`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import types

from srs_twin.compute.compiled import kernel_only
from srs_twin.plants.twin.friction_held import held, rolling
from srs_twin.plants.twin.mjcf import surroundings
from srs_twin.plants.twin.mjcf.numerics import LAWS_ON_LOADS, LOADS

_MOMENTARY, _ACROSS_ONLY = LOADS.index("momentary"), LOADS.index("across")
_WHEEL, _ELLIPSE = LAWS_ON_LOADS.index("wheel"), LAWS_ON_LOADS.index("ellipse")
_MOST_ITERATIONS, _MOST_TRIALS = 30, 12
_SMALL = 1e-14  # of the square of friction's impulse: friction is then right to 1e-7
_ROUNDING = 1e-24  # of the largest first residual's square
_OVERSHOOT = 0.5  # slope at which a line search ends, as a share of its slope at the start
_LEAST = 0.0  # of a residual's square, (kg·m/s)²
_ALONG, _ACROSS, _UP, _HUB = range(4)
_RUBS = surroundings.FRICTION


def c_function(name: str, *more: Any) -> Any:
    """Return a C function of MuJoCo's that takes a model, data, and more; kernels call it by its name."""
    return types.ExternalFunction(name, types.void(types.intp, types.intp, *more))


mj_factorM, mj_solveM = c_function("mj_factorM"), c_function("mj_solveM", types.intp, types.intp, types.int32)


class Engine(NamedTuple):
    """What the friction solve reads and writes of the engine, views named as in MjData; one world's.

    Attributes:
        model: its address, and
        data: that of its data; other compilers than numba do without.
    """

    model: int
    data: int
    qpos: np.ndarray
    qvel: np.ndarray
    qfrc_applied: np.ndarray
    qacc: np.ndarray
    qfrc_bias: np.ndarray
    M: np.ndarray
    xpos: np.ndarray
    xmat: np.ndarray
    cdof: np.ndarray
    subtree_com: np.ndarray
    sensordata: np.ndarray


class Pattern(NamedTuple):
    """Lower triangle of M, row by row: the ancestors of a degree of freedom, itself last.

    Attributes:
        entries: of each row, their number.
        first: where a row begins.
        column: of each entry.
        parent: the ancestor before, −1 where there is none.
        damping: what A has besides M, entry by entry.
        less: by how much the engine's has more, entry by entry.
    """

    entries: np.ndarray
    first: np.ndarray
    column: np.ndarray
    parent: np.ndarray
    damping: np.ndarray
    less: np.ndarray


class Contacts(NamedTuple):
    """What may touch something: wheels first, then what of the body may touch an obstacle; C in all.

    Attributes:
        wheels: how many of them are wheels.
        body: of each, shape (C,).
        place: of a wheel's centre in the body's frame, shape (wheels, 3), m.
        last: last of the degrees of freedom that move it, shape (C,).
        softness: R of a wheel's normal, shape (C,), 1/kg; infinite elsewhere.
        ease: how fast an impulse across a wheel, or along the body, makes it, shape (C,), 1/kg.
        rest: its share of the weight, shape (C,), N.
        load: which one friction takes, a place in `numerics.LOADS`.
        sensor: where a wheel's load stands in `sensordata`, or force and place of an obstacle's, shape (C,).
        radius: of a wheel, m.
        kind: of the law.
        law: μ_t, μ_n, slip speed ε (m/s), mass that the spin adds (kg).
    """

    wheels: int
    body: np.ndarray
    place: np.ndarray
    last: np.ndarray
    softness: np.ndarray
    ease: np.ndarray
    rest: np.ndarray
    load: int
    sensor: np.ndarray
    radius: float
    kind: int
    law: tuple[float, float, float, float]


class Feet(NamedTuple):
    """What each contact keeps from step to step.

    Attributes:
        push: friction along and across the heading, and what of it spins the wheel, shape (C, 3), N.
        rim: speed of the rim, shape (C,), m/s.
        load: that friction takes, shape (C,), N.
        slip: speed at which it slides, shape (C,), m/s.
    """

    push: np.ndarray
    rim: np.ndarray
    load: np.ndarray
    slip: np.ndarray


class Work(NamedTuple):
    """Memory of the loop.

    Attributes:
        rows: what gives a contact's velocity along, across, up, and its hub's along, shape (C, 4, 6).
            Along an obstacle's face is along; across is up.
        heading: cosine and sine, shape (C, 2).
        found: friction, slopes (along by along, along by across, across by across), rim's speed where
            friction is taken, by how much less the floor presses, what spins the wheel, shape (C, 8).
        press: loads under v̂, shape (C,), N.
        theta: where in the step friction is taken, 1/2 to 1, same shape.
        gain: what v̂ − v₋ adds to the spatial velocity beyond each degree of freedom, shape (nv, 6).
        start: that velocity at mid-step, without the change, same shape.
        motion: what the change adds, or the forces on it, same shape.
        pushed: forces that the change makes, same shape.
        yielding: spatial slopes of the forces beyond each degree of freedom, shape (nv, 6, 6).
        metric: A, as M.
        matrix: Newton's, as M; numba's is where the engine keeps M.
        before: v₋, shape (nv,).
        predicted: v̂, same shape.
        bias: momentum that the last two terms of the equation give, same shape.
        change: v − v̂, same shape.
        residual: same shape.
        other: same shape.
        direction: same shape.
    """

    rows: np.ndarray
    heading: np.ndarray
    found: np.ndarray
    press: np.ndarray
    theta: np.ndarray
    gain: np.ndarray
    start: np.ndarray
    motion: np.ndarray
    pushed: np.ndarray
    yielding: np.ndarray
    metric: np.ndarray
    matrix: np.ndarray
    before: np.ndarray
    predicted: np.ndarray
    bias: np.ndarray
    change: np.ndarray
    residual: np.ndarray
    other: np.ndarray
    direction: np.ndarray


@kernel_only
def approach(engine, contacts, pattern, feet, work):  # type: ignore[no-untyped-def]
    """See where the wheels are, and push with the friction of the step before."""
    _look(engine, contacts, work)
    _forces(engine.cdof, contacts, pattern, feet.push, work, engine.qfrc_applied)


@kernel_only
def expect(engine, work):  # type: ignore[no-untyped-def]
    """Go on with the velocities at mid-step, v̄ without the change; v̂ is known."""
    for i in range(work.before.shape[0]):
        engine.qvel[i] = 0.5 * (work.before[i] + work.predicted[i])


@kernel_only
def settle(engine, contacts, pattern, feet, work, h):  # type: ignore[no-untyped-def]
    """Find friction and the velocities that it leaves.

    Needs v₋ and v̂ in `before` and `predicted`, c(v₋) in the engine's `qfrc_bias`, c(v̄) in `residual`.
    """
    for i in range(work.before.shape[0]):
        work.bias[i] = h * (engine.qfrc_bias[i] - work.residual[i])
        work.other[i] = work.predicted[i] - work.before[i]
    _multiply(pattern, pattern.less, work.other, work.bias)
    for k in range(work.metric.shape[0]):
        work.metric[k] = engine.M[k] + pattern.damping[k]
    _carry(engine.cdof, pattern, engine.qvel, work.start)
    _carry(engine.cdof, pattern, work.other, work.gain)
    _feel(engine, contacts, work)
    for w in range(contacts.body.shape[0]):
        mu = contacts.law[1] if w < contacts.wheels else _RUBS
        grip = mu * work.press[w] / max(feet.slip[w], contacts.law[2])
        work.theta[w] = _theta(h * grip * contacts.ease[w])
    _solve(engine, contacts, pattern, feet, work, h)
    for i in range(work.before.shape[0]):
        engine.qvel[i] = work.predicted[i] + work.change[i]


@kernel_only
def note(contacts, feet, work, force):  # type: ignore[no-untyped-def]
    """Keep what friction was; fill the forces on all contacts, (C, 3), N; return the power it takes, W."""
    power = float(0.0)
    for w in range(contacts.body.shape[0]):
        f_t, f_n, rim = work.found[w, 0], work.found[w, 1], work.found[w, 5]
        along, across = _slip(contacts, work, w, 0.5)
        power -= f_t * along + f_n * across
        gap = along - rim if contacts.kind == _WHEEL else along
        feet.slip[w] = np.sqrt(gap * gap + across * across)
        feet.push[w, 0] = f_t
        feet.push[w, 1] = f_n
        feet.push[w, 2] = work.found[w, 7]
        feet.rim[w] += (rim - feet.rim[w]) / work.theta[w]
        c, s = work.heading[w, 0], work.heading[w, 1]
        if w < contacts.wheels:
            force[w, 0] = c * f_t - s * f_n
            force[w, 1] = s * f_t + c * f_n
            force[w, 2] = max(work.press[w] - work.found[w, 6], 0.0)
        else:
            force[w, 0] = c * f_t
            force[w, 1] = s * f_t
            force[w, 2] = f_n
    return power


@kernel_only
def _clear(array):  # type: ignore[no-untyped-def]
    for i in range(array.shape[0]):
        for k in range(array.shape[1]):
            array[i, k] = 0.0


@kernel_only
def _multiply(pattern, matrix, x, out):  # type: ignore[no-untyped-def]
    """Add the product of a symmetric matrix of a pattern."""
    for i in range(x.shape[0]):
        row, last = pattern.first[i], pattern.first[i] + pattern.entries[i] - 1
        for k in range(row, last):
            out[i] += matrix[k] * x[pattern.column[k]]
            out[pattern.column[k]] += matrix[k] * x[i]
        out[i] += matrix[last] * x[i]


@kernel_only
def dot(a, b):  # type: ignore[no-untyped-def]
    """Return the product of two spatial vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4] + a[5] * b[5]


@kernel_only
def _look(engine, contacts, work):  # type: ignore[no-untyped-def]
    """Fill the rows of each wheel's contact, which lies below its centre, and the headings."""
    com = engine.subtree_com[1]
    for w in range(contacts.wheels):
        body, place = contacts.body[w], contacts.place[w]
        m = engine.xmat[body]
        norm = 1.0 / np.sqrt(m[0] * m[0] + m[3] * m[3])
        c, s = m[0] * norm, m[3] * norm
        work.heading[w, 0] = c
        work.heading[w, 1] = s
        x = engine.xpos[body, 0] + m[0] * place[0] + m[1] * place[1] + m[2] * place[2] - com[0]
        y = engine.xpos[body, 1] + m[3] * place[0] + m[4] * place[1] + m[5] * place[2] - com[1]
        z = engine.xpos[body, 2] + m[6] * place[0] + m[7] * place[1] + m[8] * place[2] - com[2]
        z -= contacts.radius
        point(work.rows[w, _ALONG], x, y, z, c, s, 0.0)
        point(work.rows[w, _ACROSS], x, y, z, -s, c, 0.0)
        point(work.rows[w, _UP], x, y, z, 0.0, 0.0, 1.0)
        row, ahead = work.rows[w, _HUB], work.rows[w, _ALONG]
        for k in range(6):
            row[k] = ahead[k]
        row[0] = row[0] - contacts.radius * s
        row[1] = row[1] + contacts.radius * c


@kernel_only
def point(row, x, y, z, ex, ey, ez):  # type: ignore[no-untyped-def]
    """Fill what gives the velocity of a place along an axis."""
    row[0] = y * ez - z * ey
    row[1] = z * ex - x * ez
    row[2] = x * ey - y * ex
    row[3] = ex
    row[4] = ey
    row[5] = ez


@kernel_only
def _feel(engine, contacts, work):  # type: ignore[no-untyped-def]
    """Fill what presses on each contact, and the rows of those with obstacles, whose faces are upright."""
    com, sensed = engine.subtree_com[1], engine.sensordata
    for w in range(contacts.body.shape[0]):
        k = contacts.sensor[w]
        if w < contacts.wheels:
            work.press[w] = max(sensed[k], 0.0)
            continue
        fx, fy = sensed[k], sensed[k + 1]
        pressed = np.sqrt(fx * fx + fy * fy)
        work.press[w] = pressed
        if pressed > 0.0:
            c, s = -fy / pressed, fx / pressed
            x, y, z = sensed[k + 3] - com[0], sensed[k + 4] - com[1], sensed[k + 5] - com[2]
            work.heading[w, 0] = c
            work.heading[w, 1] = s
            point(work.rows[w, _ALONG], x, y, z, c, s, 0.0)
            point(work.rows[w, _ACROSS], x, y, z, 0.0, 0.0, 1.0)


@kernel_only
def _carry(cdof, pattern, velocity, motion):  # type: ignore[no-untyped-def]
    """Fill the spatial velocity beyond each degree of freedom."""
    for i in range(velocity.shape[0]):
        p = pattern.parent[i]
        for k in range(6):
            motion[i, k] = cdof[i, k] * velocity[i]
            if p >= 0:
                motion[i, k] += motion[p, k]


@kernel_only
def _project(cdof, pattern, motion, out):  # type: ignore[no-untyped-def]
    """Sum spatial forces toward the root and fill what they do on each degree of freedom."""
    for i in range(out.shape[0] - 1, -1, -1):
        out[i] = dot(cdof[i], motion[i])
        p = pattern.parent[i]
        if p >= 0:
            for k in range(6):
                motion[p, k] += motion[i, k]


@kernel_only
def _forces(cdof, contacts, pattern, push, work, out):  # type: ignore[no-untyped-def]
    """Fill the generalised forces of friction."""
    _clear(work.motion)
    for w in range(contacts.body.shape[0]):
        for k in range(6):
            part = push[w, 0] * work.rows[w, _ALONG, k] + push[w, 1] * work.rows[w, _ACROSS, k]
            part += push[w, 2] * (work.rows[w, _HUB, k] - work.rows[w, _ALONG, k])
            work.motion[contacts.last[w], k] += part
    _project(cdof, pattern, work.motion, out)


@kernel_only
def _slip(contacts, work, w, theta):  # type: ignore[no-untyped-def]
    """Return a contact's velocity along and across at mid-step, m/s; the change's `motion` is known."""
    last = contacts.last[w]
    start, gain, change = work.start[last], work.gain[last], work.motion[last]
    ahead, aside, more = work.rows[w, _ALONG], work.rows[w, _ACROSS], theta - 0.5
    return (
        dot(ahead, start) + more * dot(ahead, gain) + theta * dot(ahead, change),
        dot(aside, start) + more * dot(aside, gain) + theta * dot(aside, change),
    )


@kernel_only
def _load(contacts, work, w):  # type: ignore[no-untyped-def]
    """Return the load that friction takes, N."""
    pressed, rest = max(work.press[w] - work.found[w, 6], 0.0), contacts.rest[w]
    if contacts.load == _MOMENTARY or w >= contacts.wheels:
        return pressed
    other = max(work.press[w ^ 1] - work.found[w ^ 1, 6], 0.0)
    if contacts.load == _ACROSS_ONLY and pressed > 0.0:
        return 2.0 * rest * pressed / (pressed + other)
    return rest


@kernel_only
def _theta(x):  # type: ignore[no-untyped-def]
    """Return where in a step friction is taken that lets slip decay by x: its middle, or its end if fast."""
    if x > 0.1:
        return 1.0 / (1.0 - np.exp(-x)) - 1.0 / x
    return 0.5 + x / 12.0 - x * x * x / 720.0


@kernel_only
def _law(contacts, w, along, across, load, push, rim, h):  # type: ignore[no-untyped-def]
    """Return force, slopes (along by along, along by across, across by across), rim's speed at mid-step."""
    law = contacts.law
    mu_t, mu_n, slip, mass = law[0], law[1], law[2], law[3]
    if w >= contacts.wheels:
        f_t, f_n, tt, tn, nn = held(along, across, load, _RUBS, _RUBS, slip, push[0], push[1])
        return f_t, f_n, tt, tn, nn, 0.0
    lag, drag = mass / h, push[0] - push[2]
    if contacts.kind == _WHEEL:
        return rolling(along, across, load, mu_t, mu_n, slip, push[0], push[1], rim, lag)
    if contacts.kind == _ELLIPSE:
        f_t, f_n, tt, tn, nn = held(along, across, load, mu_t, mu_n, slip, drag, push[1])
        return f_t, f_n, tt, tn, nn, along
    f_t, _, tt, _, _ = held(along, 0.0, load, mu_t, mu_t, slip, drag, 0.0)
    _, f_n, _, _, nn = held(0.0, across, load, mu_n, mu_n, slip, 0.0, push[1])
    return f_t - lag * (along - rim), f_n, tt - lag, 0.0, nn, along


@kernel_only
def _solve(engine, contacts, pattern, feet, work, h):  # type: ignore[no-untyped-def]
    """Find friction and the change of velocity that it makes, by Newton's method with a line search."""
    change, direction = work.change, work.direction
    for i in range(change.shape[0]):
        change[i] = 0.0
    _clear(work.found)
    first = float(0.0)
    # The second time on the loads that friction leaves; the first need not be exact.
    for turn in range(2):
        most = 1 if turn == 0 else _MOST_ITERATIONS
        impulse = float(0.0)
        for w in range(contacts.body.shape[0]):
            feet.load[w] = _load(contacts, work, w)
            impulse += h * contacts.law[1] * feet.load[w]
        best = _residual(engine, contacts, pattern, feet, work, h, work.residual)
        first = max(first, best)
        enough = _SMALL * impulse * impulse + _ROUNDING * first + _LEAST
        for _ in range(most):
            if not best > enough:
                break
            _assemble(engine, contacts, pattern, feet, work, h)
            _divide(engine, pattern, work)
            best = _search(engine, contacts, pattern, feet, work, h)
            for i in range(direction.shape[0]):
                work.residual[i] = work.other[i]


@kernel_only
def _search(engine, contacts, pattern, feet, work, h):  # type: ignore[no-untyped-def]
    """Move along Newton's direction until the residual is about normal to it; return the residual's square.

    Under given loads friction dissipates the most that it can, so the residual is the gradient of a convex
    function. That function falls at each such step. The residual's square may rise where a contact changes
    between sticking and sliding, so a search that demands its fall gives up near a stop.
    """
    change, direction = work.change, work.direction
    start = float(0.0)
    for i in range(direction.shape[0]):
        start += work.residual[i] * direction[i]
    low, high, scale, done = float(0.0), float(1.0), float(1.0), float(0.0)
    before, beyond, merit = start, float(0.0), float(0.0)
    for _ in range(_MOST_TRIALS):
        for i in range(direction.shape[0]):
            change[i] -= (scale - done) * direction[i]
        done = scale
        merit = _residual(engine, contacts, pattern, feet, work, h, work.other)
        slope = float(0.0)
        for i in range(direction.shape[0]):
            slope += work.other[i] * direction[i]
        if slope >= -_OVERSHOOT * start and (scale == 1.0 or slope <= _OVERSHOOT * start):
            break
        if slope < 0.0:
            high = scale
            beyond = slope
        else:
            low = scale
            before = slope
        # By the secant, kept off the ends.
        scale = low + min(max(before / (before - beyond), 0.1), 0.9) * (high - low)
    return merit


@kernel_only
def _residual(engine, contacts, pattern, feet, work, h, out):  # type: ignore[no-untyped-def]
    """Fill what the equation lacks, kg·m/s; return its square; note what the law says."""
    change, motion, rows, found = work.change, work.motion, work.rows, work.found
    _carry(engine.cdof, pattern, change, motion)
    for w in range(contacts.body.shape[0]):
        if w >= contacts.wheels and feet.load[w] == 0.0:
            continue  # touches nothing
        along, across = _slip(contacts, work, w, work.theta[w])
        f_t, f_n, tt, tn, nn, rim = _law(
            contacts, w, along, across, feet.load[w], feet.push[w], feet.rim[w], h * work.theta[w]
        )
        found[w, 0] = f_t
        found[w, 1] = f_n
        found[w, 5] = rim
        found[w, 2] = tt
        found[w, 3] = tn
        found[w, 4] = nn
        found[w, 7] = -contacts.law[3] / (h * work.theta[w]) * (rim - feet.rim[w])
        rise = dot(rows[w, _UP], motion[contacts.last[w]])
        found[w, 6] = rise / (h * contacts.softness[w]) if work.press[w] > 0.0 else 0.0
    pushed = work.pushed
    _clear(pushed)
    for w in range(contacts.body.shape[0]):
        f_t, f_n = h * (found[w, 0] - feet.push[w, 0]), h * (found[w, 1] - feet.push[w, 1])
        spun = h * (found[w, 7] - feet.push[w, 2])
        for k in range(6):
            less = h * found[w, 6] * rows[w, _UP, k]
            more = (f_t - spun) * rows[w, _ALONG, k] + spun * rows[w, _HUB, k] + f_n * rows[w, _ACROSS, k]
            pushed[contacts.last[w], k] += less - more
    _project(engine.cdof, pattern, pushed, out)
    for i in range(change.shape[0]):
        out[i] -= work.bias[i]
    _multiply(pattern, work.metric, change, out)
    total = float(0.0)
    for i in range(change.shape[0]):
        total += out[i] * out[i]
    return total


@kernel_only
def _assemble(engine, contacts, pattern, feet, work, h):  # type: ignore[no-untyped-def]
    """Fill Newton's matrix: A, the normals that press, friction's slopes."""
    matrix, rows, found, yielding = work.matrix, work.rows, work.found, work.yielding
    for i in range(yielding.shape[0]):
        _clear(yielding[i])
    for w in range(contacts.body.shape[0]):
        part = -work.theta[w] * h
        tt, tn, nn = part * found[w, 2], part * found[w, 3], part * found[w, 4]
        up = 1.0 / contacts.softness[w] if work.press[w] > 0.0 else 0.0
        ahead = rows[w, _HUB if found[w, 5] != 0.0 else _ALONG]
        aside, above, own = rows[w, _ACROSS], rows[w, _UP], yielding[contacts.last[w]]
        for a in range(6):
            t, n, z = tt * ahead[a] + tn * aside[a], tn * ahead[a] + nn * aside[a], up * above[a]
            for b in range(6):
                own[a, b] += t * ahead[b] + n * aside[b] + z * above[b]
    for k in range(matrix.shape[0]):
        matrix[k] = work.metric[k]
    for i in range(pattern.entries.shape[0] - 1, -1, -1):
        d, own, p, row = engine.cdof[i], yielding[i], pattern.parent[i], pattern.first[i]
        on = work.pushed[i]
        for a in range(6):
            on[a] = dot(own[a], d)
        for k in range(row, row + pattern.entries[i]):
            matrix[k] += dot(on, engine.cdof[pattern.column[k]])
        if p >= 0:
            for a in range(6):
                for b in range(6):
                    yielding[p, a, b] += own[a, b]


@kernel_only
def _divide(engine, pattern, work):  # type: ignore[no-untyped-def]
    """Fill the direction that Newton's matrix gives the residual, by the engine's own routines."""
    mj_factorM(engine.model, engine.data)
    mj_solveM(engine.model, engine.data, work.direction.ctypes.data, work.residual.ctypes.data, np.int32(1))


@kernel_only
def divide_alone(engine, pattern, work):  # type: ignore[no-untyped-def]
    """Do the same without the engine's routines."""
    for i in range(work.direction.shape[0]):
        work.direction[i] = work.residual[i]
    _factor(work.matrix, pattern)
    _substitute(work.matrix, pattern, work.direction)


@kernel_only
def _factor(matrix, pattern):  # type: ignore[no-untyped-def]
    """Factor a matrix of M's pattern into LᵀDL, in place: no entry appears that M does not have."""
    for k in range(pattern.entries.shape[0] - 1, -1, -1):
        row, last = pattern.first[k], pattern.entries[k] - 1
        over = 1.0 / matrix[row + last]
        for a in range(last - 1, -1, -1):
            part, to = matrix[row + a] * over, pattern.first[pattern.column[row + a]]
            for b in range(a + 1):
                matrix[to + b] -= part * matrix[row + b]
            matrix[row + a] = part


@kernel_only
def _substitute(matrix, pattern, x):  # type: ignore[no-untyped-def]
    """Solve LᵀDL x = b in place."""
    for i in range(x.shape[0] - 1, -1, -1):
        for k in range(pattern.first[i], pattern.first[i] + pattern.entries[i] - 1):
            x[pattern.column[k]] -= matrix[k] * x[i]
    for i in range(x.shape[0]):
        last = pattern.first[i] + pattern.entries[i] - 1
        value = x[i] / matrix[last]
        for k in range(pattern.first[i], last):
            value -= matrix[k] * x[pattern.column[k]]
        x[i] = value
