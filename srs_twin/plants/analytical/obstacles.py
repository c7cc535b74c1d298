r"""Contact of the `compliant` model with obstacles.

**Shapes.** The body is a chain of straight stretches, one for each point of the module
`cells`. A stretch has the heading of its point, a half width w and round ends, and it
extends halfway to the neighbouring points. Each circle and each side of a polygon is
represented by a line segment with a radius. The contact force acts where the stretch is
closest to the obstacle, and it loads only the point of this stretch.

**Contact law.** The normal force N and the friction f_t of a contact depend on the
overlap δ and on the normal and tangential velocities v_n and v_t of the body at the
contact. If v_n is positive, the body moves away from the obstacle:

$$ N = k\,δ_+\,(1 - χ v_n)_+, \qquad
   f_t = -μ N \frac{v_t}{\sqrt{v_t^2 + ε^2}}. $$

Here ( )₊ denotes the positive part, so N is never negative. The dissipation coefficient
χ describes the energy loss in an impact (Hunt and Crossley, 1975), μ is the friction
coefficient, and ε is the slip speed. The contact stiffness is k = m/T², where m is the
mass of the robot and T = `CONTACT_TIME_S` is a time constant. Forces are evaluated at
the end of each implicit stage of length a = γ h, in which δ changes by −a v_n. Stiff
contacts therefore do not limit the time step. The contribution of the force to the
Newton matrix is the derivative

$$ \frac{∂N}{∂v_n} = -k\,\bigl(a\,(1 - χ v_n) + χ δ\bigr) . $$

The matrix neglects that the direction of the normal changes during a step.

The Newton method relies on a convex potential, which friction has only if the normal
forces are constant. Each stage is therefore solved repeatedly, with friction computed
from the normal forces of the previous solution.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled_if, inlined, is_given, kernel_only
from srs_twin.plants.analytical.cells import LumpedSegments
from srs_twin.plants.analytical.floor import Twist
from srs_twin.plants.analytical.kernels import ENERGY_LOSS, HEADING, STATE_X, STATE_Y
from srs_twin.plants.analytical.kinematics import (
    COS,
    FORCE_X,
    FORCE_Y,
    FORCE_YAW,
    MASS_MM,
    MASS_MX,
    MASS_MY,
    MASS_XM,
    MASS_XX,
    MASS_XY,
    MASS_YM,
    MASS_YX,
    MASS_YY,
    SIN,
    SPIN,
    VX,
    VY,
    X,
    Y,
)
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import WALL_M, World

CONTACT_TIME_S = 0.001
"""Time constant T of a contact at a time unit of 1 (`robot.scale`), s."""

_LOSS_S_PER_M = 20.0
"""Dissipation coefficient χ at a speed unit of 1, s/m.

The coefficient limits rebound speeds to 1/χ.
"""

# Columns of `Obstacles.shape`, m.
_BEGIN_X = 0
_BEGIN_Y = 1
_END_X = 2
_END_Y = 3
_RADIUS = 4
_SHAPE_COLUMNS = 5

# Entries of `Obstacles.pose`.
_COM_X = 0  # Centre of mass, m.
_COM_Y = 1
_COS = 2  # Cosine of the mean heading.
_SIN = 3


class Obstacles(NamedTuple):
    """Obstacles and the work arrays of their contacts, for the kernels.

    Attributes:
        shape: start point (x, y), end point (x, y) and radius of each line segment,
            shape (obstacles, _SHAPE_COLUMNS), m. For a circle, both
            points are its centre.
        stretch: lengths of the stretch ahead of and behind each point, shape (points,
            2), m.
        half_width: half width w of the body, m.
        stiffness, loss: contact stiffness k (N/m) and dissipation coefficient χ (s/m).
        friction, slip: friction coefficient μ (dimensionless) and slip speed ε (m/s).
        pose: centre of mass (m), and cosine and sine of the mean heading, at the end of
            a stage, shape (4,).
        near: number of obstacles within reach of the body, followed by the indices of
            these obstacles.
        force: latest force exerted by the obstacles on each point, in the world frame,
            shape (points, 2), N.
        normal: latest normal forces, shape (obstacles, points), N.
        load: normal forces in the friction law, shape (obstacles, points), N.
    """

    shape: np.ndarray
    stretch: np.ndarray
    half_width: float
    stiffness: float
    loss: float
    friction: float
    slip: float
    pose: np.ndarray
    near: np.ndarray
    force: np.ndarray
    normal: np.ndarray
    load: np.ndarray


def make_obstacles(
    world: World, spec: RobotSpec, cells: LumpedSegments, slip: float
) -> Obstacles:
    """Create the `Obstacles` of a world, with a slip speed ε of `slip` (m/s)."""
    shapes = np.array(list(_shapes(world)), dtype=float).reshape(-1, _SHAPE_COLUMNS)
    half = np.broadcast_to(
        (np.asarray(cells.length) + cells.gap) / 2, len(cells.mass) - 1
    )
    stretch = np.stack([np.append(0.0, half), np.append(half, 0.0)], axis=1)
    scale = spec.scale
    return Obstacles(
        shape=shapes,
        stretch=stretch,
        half_width=spec.geometry.width / 2,
        stiffness=spec.mass.total / (CONTACT_TIME_S * scale.time) ** 2,
        loss=_LOSS_S_PER_M * scale.time / scale.length,
        friction=world.friction,
        slip=slip,
        pose=np.zeros(4),
        near=np.zeros(len(shapes) + 1, dtype=np.int64),
        force=np.zeros((len(cells.mass), 2)),
        normal=np.zeros((len(shapes), len(cells.mass))),
        load=np.zeros((len(shapes), len(cells.mass))),
    )


def _shapes(world: World) -> Iterator[tuple[float, ...]]:
    for circle in world.obstacles:
        yield circle.x, circle.y, circle.x, circle.y, circle.radius
    for polygon in world.polygons:
        corners = polygon.corners
        for begin, end in zip(corners, (*corners[1:], corners[0]), strict=True):
            yield *begin, *end, WALL_M


@compiled_if(is_given)
def find_near(obstacles, state, reach):  # type: ignore[no-untyped-def]
    """List the obstacles that the body can touch.

    `reach` is an upper bound on the distance of the body's axis from the centre of mass
    (m).
    """
    near = obstacles.near
    near[0] = 0
    for k in range(obstacles.shape.shape[0]):
        shape = obstacles.shape[k]
        ax = shape[_BEGIN_X] - state[STATE_X]
        ay = shape[_BEGIN_Y] - state[STATE_Y]
        bx = shape[_END_X] - shape[_BEGIN_X]
        by = shape[_END_Y] - shape[_BEGIN_Y]
        size = bx * bx + by * by
        along = 0.0
        if size > 0.0:
            along = min(max(-(ax * bx + ay * by) / size, 0.0), 1.0)
        x = ax + along * bx
        y = ay + along * by
        limit = reach + shape[_RADIUS] + obstacles.half_width
        if x * x + y * y < limit * limit:
            near[0] += 1
            near[near[0]] = k


@compiled_if(is_given)
def set_pose(obstacles, known, a, u):  # type: ignore[no-untyped-def]
    """Store the pose of the body at the end of an implicit stage.

    Args:
        obstacles: `Obstacles` in which the pose is stored.
        known: known part of the state Y in the stage equation Y = known + a f(Y).
        a: implicit step γ h, s.
        u: velocity in the frame of the mean heading (m/s) and yaw rate (rad/s).
    """
    heading = known[HEADING] + a * u[2]
    c = math.cos(heading)
    s = math.sin(heading)
    pose = obstacles.pose
    pose[_COM_X] = known[STATE_X] + a * (u[0] * c - u[1] * s)
    pose[_COM_Y] = known[STATE_Y] + a * (u[0] * s + u[1] * c)
    pose[_COS] = c
    pose[_SIN] = s


class _Line(NamedTuple):
    x: float
    y: float
    to_x: float
    to_y: float


@inlined
def _axis(shape, pose):  # type: ignore[no-untyped-def]
    cos = pose[_COS]
    sin = pose[_SIN]
    x = shape[_BEGIN_X] - pose[_COM_X]
    y = shape[_BEGIN_Y] - pose[_COM_Y]
    to_x = shape[_END_X] - shape[_BEGIN_X]
    to_y = shape[_END_Y] - shape[_BEGIN_Y]
    return _Line(
        x * cos + y * sin,
        y * cos - x * sin,
        to_x * cos + to_y * sin,
        to_y * cos - to_x * sin,
    )


class _Stretch(NamedTuple):
    x: float
    y: float
    cos: float
    sin: float
    ahead: float
    behind: float


class _Gap(NamedTuple):
    # `place` is the distance (m) along the heading from the chain point to the place
    # where the stretch is closest to the obstacle. (x, y) is the vector (m) from the
    # line segment of the obstacle to this place.

    place: float
    x: float
    y: float


@inlined
def _gap(stretch, line):  # type: ignore[no-untyped-def]
    place, along = _closest(stretch, line)
    return _Gap(
        place,
        stretch.x + place * stretch.cos - line.x - along * line.to_x,
        stretch.y + place * stretch.sin - line.y - along * line.to_y,
    )


@kernel_only
def _closest(stretch, line):  # type: ignore[no-untyped-def]
    # The function returns the position of the closest points as a distance along the
    # stretch (m) and a fraction of the line segment. The unit vector u is parallel to
    # the stretch, the vector b is parallel to the line segment, and the vector d points
    # from the chain point to the start of the line segment.
    px = stretch.x
    py = stretch.y
    ux = stretch.cos
    uy = stretch.sin
    lowest = stretch.behind
    highest = stretch.ahead
    bx = line.to_x
    by = line.to_y
    size = bx * bx + by * by
    mixed = ux * bx + uy * by
    dx = line.x - px
    dy = line.y - py
    if size == 0.0:
        return min(max(dx * ux + dy * uy, lowest), highest), 0.0
    # The determinant `angle` is 0 if the stretch is parallel to the line segment.
    angle = size - mixed * mixed
    place = 0.5 * (lowest + highest)
    if angle > 1e-12 * size:
        place = (size * (dx * ux + dy * uy) - mixed * (dx * bx + dy * by)) / angle
    place = min(max(place, lowest), highest)
    along = ((px + place * ux - line.x) * bx + (py + place * uy - line.y) * by) / size
    along = min(max(along, 0.0), 1.0)
    place = (line.x + along * bx - px) * ux + (line.y + along * by - py) * uy
    return min(max(place, lowest), highest), along


class _Contact(NamedTuple):
    # Vectors are in the frame of the mean heading. The unit normal (n_x, n_y) points
    # away from the obstacle. The lever arm (m) points from the chain point to the
    # contact on the surface of the body. The derivatives are dN/dv_n and df_t/dv_t
    # (N·s/m). `power` is the power dissipated by the contact (W).

    n_x: float
    n_y: float
    arm_x: float
    arm_y: float
    normal: float
    tangential: float
    normal_derivative: float
    tangential_derivative: float
    power: float


@inlined
def _contact(o, a, load, reach, stretch, gap, velocity):  # type: ignore[no-untyped-def]
    # `load` is the normal force in the friction law (N). `reach` is the distance from
    # the axis of the body to the line segment of the obstacle at first contact (m).
    distance = math.sqrt(gap.x * gap.x + gap.y * gap.y)
    n_x = gap.x / distance
    n_y = gap.y / distance
    overlap = max(reach - distance, 0.0)
    arm_x = gap.place * stretch.cos - o.half_width * n_x
    arm_y = gap.place * stretch.sin - o.half_width * n_y
    v_x = velocity.x - velocity.yaw * arm_y
    v_y = velocity.y + velocity.yaw * arm_x
    v_n = v_x * n_x + v_y * n_y
    v_t = v_y * n_x - v_x * n_y
    soft = max(1 - o.loss * v_n, 0.0)
    normal = o.stiffness * overlap * soft
    normal_derivative = 0.0
    if normal > 0.0:
        normal_derivative = -o.stiffness * (a * soft + o.loss * overlap)
    r = 1 / math.sqrt(v_t * v_t + o.slip * o.slip)
    grip = o.friction * load
    tangential = -grip * v_t * r
    return _Contact(
        n_x,
        n_y,
        arm_x,
        arm_y,
        normal,
        tangential,
        normal_derivative,
        tangential_derivative=-grip * r * (o.slip * r) ** 2,
        power=-(normal * v_n + tangential * v_t),
    )


@compiled_if(is_given, otherwise=(0.0, 0.0, 0.0, 0.0))
def add_contacts(obstacles, body, u, a, loads):  # type: ignore[no-untyped-def]
    """Add the forces of nearby obstacles and their derivatives to `loads`.

    Args:
        obstacles: `Obstacles` that contain the pose of the body and receive the forces.
        body: poses and velocities of the points, shape (ROWS, points).
        u: velocities as in `compliant_kernels.balance`, shape (3 + cells,).
        a: implicit step γ h, s.
        loads: loads on the points, changed in place, shape (points, LOAD_COLUMNS).

    Returns:
        Force components x and y (N) in the frame of the mean heading, moment about the
        centre of mass (N·m), and power dissipated by the contacts (W).
    """
    o = obstacles
    cos = o.pose[_COS]
    sin = o.pose[_SIN]
    fx = fy = moment = power = 0.0
    for i in range(o.force.shape[0]):
        o.force[i, 0] = o.force[i, 1] = 0.0
    for index in range(1, o.near[0] + 1):
        k = o.near[index]
        line = _axis(o.shape[k], o.pose)
        reach = o.shape[k, _RADIUS] + o.half_width
        for i in range(o.force.shape[0]):
            x = body[X, i]
            y = body[Y, i]
            ahead = o.stretch[i, 0]
            behind = -o.stretch[i, 1]
            stretch = _Stretch(x, y, body[COS, i], body[SIN, i], ahead, behind)
            gap = _gap(stretch, line)
            square = gap.x * gap.x + gap.y * gap.y
            o.normal[k, i] = 0.0
            load = o.load[k, i]
            if square == 0.0 or (square >= reach * reach and load == 0.0):
                continue
            velocity = Twist(
                u[0] + body[VX, i] - u[2] * y,
                u[1] + body[VY, i] + u[2] * x,
                u[2] + body[SPIN, i],
            )
            contact = _contact(o, a, load, reach, stretch, gap, velocity)
            o.normal[k, i] = contact.normal
            _add_load(loads[i], contact, a)
            force_x = contact.normal * contact.n_x - contact.tangential * contact.n_y
            force_y = contact.normal * contact.n_y + contact.tangential * contact.n_x
            o.force[i, 0] += force_x * cos - force_y * sin
            o.force[i, 1] += force_x * sin + force_y * cos
            fx = fx + force_x
            fy = fy + force_y
            moment += (x + contact.arm_x) * force_y - (y + contact.arm_y) * force_x
            power += contact.power
    return fx, fy, moment, power


@kernel_only
def _add_load(load, contact, a):  # type: ignore[no-untyped-def]
    nx = contact.n_x
    ny = contact.n_y
    n_m = contact.arm_x * ny - contact.arm_y * nx
    t_m = contact.arm_x * nx + contact.arm_y * ny
    load[FORCE_X] += contact.normal * nx - contact.tangential * ny
    load[FORCE_Y] += contact.normal * ny + contact.tangential * nx
    load[FORCE_YAW] += contact.normal * n_m + contact.tangential * t_m
    # n_x, n_y and n_s are the derivatives of the normal force with respect to the
    # velocities along x and y and to the spin. t_x, t_y and t_s are the corresponding
    # derivatives of friction.
    n_x = contact.normal_derivative * nx
    n_y = contact.normal_derivative * ny
    n_s = contact.normal_derivative * n_m
    t_x = -contact.tangential_derivative * ny
    t_y = contact.tangential_derivative * nx
    t_s = contact.tangential_derivative * t_m
    xy = a * (n_y * nx - t_y * ny)
    xm = a * (n_s * nx - t_s * ny)
    ym = a * (n_s * ny + t_s * nx)
    load[MASS_XX] -= a * (n_x * nx - t_x * ny)
    load[MASS_YY] -= a * (n_y * ny + t_y * nx)
    load[MASS_MM] -= a * (n_s * n_m + t_s * t_m)
    load[MASS_XY] -= xy
    load[MASS_YX] -= xy
    load[MASS_XM] -= xm
    load[MASS_MX] -= xm
    load[MASS_YM] -= ym
    load[MASS_MY] -= ym


@compiled_if(is_given, otherwise=False)
def update_loads(obstacles, scale):  # type: ignore[no-untyped-def]
    """Copy the latest normal forces to the friction law.

    Returns:
        Whether a normal force has changed by more than `scale` (N).
    """
    o = obstacles
    changed = False
    for index in range(1, o.near[0] + 1):
        for i in range(o.force.shape[0]):
            k = o.near[index]
            changed |= abs(o.normal[k, i] - o.load[k, i]) > scale
            o.load[k, i] = o.normal[k, i]
    return changed


@compiled_if(is_given)
def fill_rates(obstacles, model, free, free_rates, rates, workspace):  # type: ignore[no-untyped-def]
    """Compute the time derivatives of the impulses, the time and `ENERGY_LOSS`.

    With obstacles, `ENERGY_LOSS` is not the dissipated energy, but the work of the
    compressed air, whose rate Σ T_j q̇_f,j is smooth. Here T = k (q_f − q) + c (q̇_f −
    q̇) is the torque of a whole segment with bend q, free bend q_f, stiffness k and
    damping c. An integral of the dissipated power would miss the energy that is lost in
    impacts, because the normal forces are evaluated when an impact is almost over.

    Args:
        obstacles: `Obstacles` with the forces at the stage.
        model: constants, a `compliant_kernels.CompliantModel`.
        free: free bends of the cells, shape (cells,), rad.
        free_rates: rates of the free bends, shape (cells,), rad/s.
        rates: bend rates of the cells, shape (cells,), rad/s.
        workspace: work arrays, a `WorkArrays`, whose field `rate` receives the time
            derivatives.
    """
    k = workspace.rate
    q = workspace.bend
    count = obstacles.force.shape[0]
    first = k.shape[0] - 1 - 2 * count
    for i in range(count):
        k[first + 2 * i] = obstacles.force[i, 0]
        k[first + 2 * i + 1] = obstacles.force[i, 1]
    k[k.shape[0] - 1] = 1.0
    cells = q.shape[0] // model.segments
    power = 0.0
    for j in range(model.segments):
        bend = rate = free_rate = flexibility = fluidity = 0.0
        for c in range(j * cells, (j + 1) * cells):
            bend += free[c] - q[c]
            rate += free_rates[c] - rates[c]
            free_rate += free_rates[c]
            flexibility += 1 / model.stiffness[c]
            fluidity += 1 / model.damping[c]
        power += (bend / flexibility + rate / fluidity) * free_rate
    k[ENERGY_LOSS] = power
