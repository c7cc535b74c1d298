r"""Contact of the `compliant` model with obstacles: unilateral normal forces with Coulomb friction.

**Shapes.** The body at each point of the chain (`cells`) is a straight stretch along
the heading, which reaches half way to the neighbouring points, with round ends and the
half width w. Obstacles are line segments with a radius: circles and the sides of
polygons. The contact is at the closest points of the two. Its force acts on the
stretch, and thus changes force and moment at one point only.

**Law.** With the overlap δ and the normal velocity v_n of the body at the contact,
positive when it leaves,

$$ N = k\,δ_+\,(1 - χ v_n)_+, \qquad
   f_t = -μ N \frac{v_t}{\sqrt{v_t^2 + ε^2}}. $$

N never pulls. The factor with χ dissipates energy (Hunt and Crossley, 1975). The
stiffness is k = m/T², on which the robot with its mass m would oscillate with the time
constant T = `CONTACT_TIME_S`; T → 0 is rigid contact. Both are evaluated at the end of
each implicit stage, where δ moves by −a v_n with a = γ h, so that

$$ \frac{∂N}{∂v_n} = -k\,\bigl(a\,(1 - χ v_n) + χ δ\bigr) $$

enters Newton's matrix, and stiff contacts do not limit the time step. Changes of the
normal during a step are neglected in the matrix, not in the force. Friction with a
constant N has a convex potential, on which Newton's method relies. A stage is therefore
solved a few times, each with the normal forces of the previous solution in the
friction.

The twin shares none of this: it has rods between hinges, other shapes, and MuJoCo's
constraint forces.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled_if, is_given, kernel_only
from srs_twin.plants.analytical.cells import Undivided
from srs_twin.plants.analytical.kernels import ENERGY_LOSS
from srs_twin.plants.analytical.kinematics import COS, SIN, SPIN, VX, VY, X, Y
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import WALL_M, World

CONTACT_TIME_S = 0.001
"""T, time constant of a contact at a time unit of 1 (`robot.scale`), s; a numerical setting."""

_LOSS_S_PER_M = (
    20.0  # χ at a speed unit of 1, s/m: bodies leave an obstacle slower than 1/χ
)


class Obstacles(NamedTuple):
    """Obstacles and the work arrays of their contacts, for the kernels.

    Attributes:
        shape: ends x, y, x, y of a line segment and its radius, shape (obstacles, 5),
            m; the ends of a circle are equal.
        stretch: reach of the body ahead of and behind each point, shape (points, 2), m.
        half_width: w, m.
        stiffness: k, N/m.
        loss: χ, s/m.
        friction: μ, 1.
        slip: ε, m/s.
        pose: work array: centre of mass x, y (m), cosine and sine of the mean heading.
        near: work array: number of obstacles within reach of the body, and their
            indices.
        force: force of the obstacles on each point at the latest evaluation, world
            frame, shape (points, 2), N.
        normal: normal forces at the latest evaluation, shape (obstacles, points), N.
        load: normal forces that friction is proportional to, same shape, N.
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
    world: World, spec: RobotSpec, cells: Undivided, slip: float
) -> Obstacles:
    """Return the obstacles of a world.

    Args:
        world: circles, polygons, and the coefficient of friction.
        spec: the robot.
        cells: division of its segments.
        slip: slip speed, m/s.
    """
    shapes = np.array(list(_shapes(world)), dtype=float).reshape(-1, 5)
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
    """List the obstacles within `reach` (m) of the centre of mass, before a step."""
    shape = obstacles.shape
    near = obstacles.near
    near[0] = 0
    for k in range(shape.shape[0]):
        ax = shape[k, 0] - state[0]
        ay = shape[k, 1] - state[1]
        bx = shape[k, 2] - shape[k, 0]
        by = shape[k, 3] - shape[k, 1]
        size = bx * bx + by * by
        if size > 0.0:
            along = min(max(-(ax * bx + ay * by) / size, 0.0), 1.0)
        else:
            along = 0.0
        x = ax + along * bx
        y = ay + along * by
        limit = reach + shape[k, 4] + obstacles.half_width
        if x * x + y * y < limit * limit:
            near[0] += 1
            near[near[0]] = k


@compiled_if(is_given)
def set_pose(obstacles, known, a, u):  # type: ignore[no-untyped-def]
    """Store the pose at the end of a stage with the known part `known` and the velocities u."""
    heading = known[2] + a * u[2]
    c = math.cos(heading)
    s = math.sin(heading)
    pose = obstacles.pose
    pose[0] = known[0] + a * (u[0] * c - u[1] * s)
    pose[1] = known[1] + a * (u[0] * s + u[1] * c)
    pose[2] = c
    pose[3] = s


@kernel_only
def _closest(px, py, ux, uy, lowest, highest, ax, ay, bx, by):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the places of the closest points of two line segments.

    Args:
        px, py: point of the body, m.
        ux, uy: its heading, 1.
        lowest, highest: ends of its stretch along the heading, m.
        ax, ay, bx, by: one end of the obstacle, and the vector to the other, m.

    Returns:
        Place along the heading (m), and along the obstacle from 0 to 1.
    """
    size = bx * bx + by * by
    mixed = ux * bx + uy * by
    dx = ax - px
    dy = ay - py
    if size == 0.0:
        return min(max(dx * ux + dy * uy, lowest), highest), 0.0
    # Perpendicular distance between the lines squared, which is 0 for parallel ones.
    angle = size - mixed * mixed
    place = 0.5 * (lowest + highest)
    if angle > 1e-12 * size:
        place = (size * (dx * ux + dy * uy) - mixed * (dx * bx + dy * by)) / angle
    place = min(max(place, lowest), highest)
    along = ((px + place * ux - ax) * bx + (py + place * uy - ay) * by) / size
    along = min(max(along, 0.0), 1.0)
    place = (ax + along * bx - px) * ux + (ay + along * by - py) * uy
    return min(max(place, lowest), highest), along


@compiled_if(is_given, otherwise=(0.0, 0.0, 0.0, 0.0))
def add_contacts(obstacles, body, u, a, loads):  # type: ignore[no-untyped-def]
    """Add the forces of near obstacles and their slopes to the loads of the points.

    Args:
        obstacles: an `Obstacles` with the pose of the body; its forces are filled.
        body: posed body, shape (ROWS, points).
        u: velocities, shape (3 + cells,).
        a: γ h, s.
        loads: in place, see `compliant_kernels._fill_loads`.

    Returns:
        Force (x, y) and moment about the centre of mass in the frame of the mean
        heading, and the power that the contacts take from the body, W.
    """
    o = obstacles
    cos = o.pose[2]
    sin = o.pose[3]
    fx = fy = moment = power = 0.0
    for i in range(o.force.shape[0]):
        o.force[i, 0] = o.force[i, 1] = 0.0
    for index in range(1, o.near[0] + 1):
        shape = o.shape[o.near[index]]
        ax = shape[0] - o.pose[0]
        ay = shape[1] - o.pose[1]
        bx = shape[2] - shape[0]
        by = shape[3] - shape[1]
        ax, ay, bx, by = (
            ax * cos + ay * sin,
            ay * cos - ax * sin,
            bx * cos + by * sin,
            by * cos - bx * sin,
        )
        contact_distance = shape[4] + o.half_width
        for i in range(o.force.shape[0]):
            o.normal[o.near[index], i] = 0.0
            x = body[X, i]
            y = body[Y, i]
            c = body[COS, i]
            s = body[SIN, i]
            place, along = _closest(
                x, y, c, s, -o.stretch[i, 1], o.stretch[i, 0], ax, ay, bx, by
            )
            nx = x + place * c - ax - along * bx
            ny = y + place * s - ay - along * by
            square = nx * nx + ny * ny
            load = o.load[o.near[index], i]
            if square == 0.0 or (
                square >= contact_distance * contact_distance and load == 0.0
            ):
                continue
            distance = math.sqrt(square)
            nx = nx / distance
            ny = ny / distance
            overlap = max(contact_distance - distance, 0.0)
            # Lever arm of the contact on the surface of the body about the point.
            lx = place * c - o.half_width * nx
            ly = place * s - o.half_width * ny
            spin = u[2] + body[SPIN, i]
            vx = u[0] + body[VX, i] - u[2] * y - spin * ly
            vy = u[1] + body[VY, i] + u[2] * x + spin * lx
            v_n = vx * nx + vy * ny
            v_t = vy * nx - vx * ny
            soft = max(1 - o.loss * v_n, 0.0)
            normal = o.stiffness * overlap * soft
            n_n = 0.0
            if normal > 0.0:
                n_n = -o.stiffness * (a * soft + o.loss * overlap)
            r = 1 / math.sqrt(v_t * v_t + o.slip * o.slip)
            grip = o.friction * load
            tangential = -grip * v_t * r
            t_t = -grip * r * (o.slip * r) ** 2
            o.normal[o.near[index], i] = normal
            _add_load(loads[i], nx, ny, lx, ly, a, normal, tangential, n_n, t_t)
            force_x = normal * nx - tangential * ny
            force_y = normal * ny + tangential * nx
            o.force[i, 0] += force_x * cos - force_y * sin
            o.force[i, 1] += force_x * sin + force_y * cos
            fx = fx + force_x
            fy = fy + force_y
            moment += (x + lx) * force_y - (y + ly) * force_x
            power -= normal * v_n + tangential * v_t
    return fx, fy, moment, power


@kernel_only
def _add_load(load, nx, ny, lx, ly, a, normal, tangential, n_n, t_t):  # type: ignore[no-untyped-def]
    """Add a contact with the normal (nx, ny) and the lever arm (lx, ly) to the load of a point."""
    n_m = lx * ny - ly * nx
    t_m = lx * nx + ly * ny
    load[3] += normal * nx - tangential * ny
    load[4] += normal * ny + tangential * nx
    load[5] += normal * n_m + tangential * t_m
    # Derivatives of normal and tangential force by the velocity (x, y) and the spin.
    n_x = n_n * nx
    n_y = n_n * ny
    n_s = n_n * n_m
    t_x = -t_t * ny
    t_y = t_t * nx
    t_s = t_t * t_m
    xy = a * (n_y * nx - t_y * ny)
    xm = a * (n_s * nx - t_s * ny)
    ym = a * (n_s * ny + t_s * nx)
    load[6] -= a * (n_x * nx - t_x * ny)
    load[9] -= a * (n_y * ny + t_y * nx)
    load[11] -= a * (n_s * n_m + t_s * t_m)
    load[7], load[12] = load[7] - xy, load[12] - xy
    load[8], load[13] = load[8] - xm, load[13] - xm
    load[10], load[14] = load[10] - ym, load[14] - ym


@compiled_if(is_given, otherwise=False)
def update_loads(obstacles, scale):  # type: ignore[no-untyped-def]
    """Set the loads of friction to the latest normal forces; return whether one changed by `scale` (N)."""
    o = obstacles
    changed = False
    for index in range(1, o.near[0] + 1):
        for i in range(o.force.shape[0]):
            k = o.near[index]
            changed |= abs(o.normal[k, i] - o.load[k, i]) > scale
            o.load[k, i] = o.normal[k, i]
    return changed


@compiled_if(is_given)
def fill_rates(obstacles, model, free, q, rates, k):  # type: ignore[no-untyped-def]
    r"""Fill the rates of the impulses on each point and of the time, and replace that of the energy column.

    The work of the torques is the energy of the body plus the integral of the losses.
    During impacts, this integral misses what the implicit method dissipates: it
    evaluates the stiff normal forces at the end of a stage, when the body has almost
    stopped. The torques are smooth, so the power of the air, Σ T_j q̇_f,j with T = k
    (q_f − q) + c (q̇_f − q̇) of a whole segment, is integrated instead.

    Args:
        obstacles: with the forces of the stage.
        model: a `compliant_kernels.CompliantModel`.
        free: free bends of the cells (rad) and their rates (rad/s), shapes (cells,).
        q: bends of the cells, shape (cells,), rad.
        rates: their rates, shape (cells,), rad/s.
        k: out, rates of the state.
    """
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
            bend += free[0][c] - q[c]
            rate += free[1][c] - rates[c]
            free_rate += free[1][c]
            flexibility += 1 / model.stiffness[c]
            fluidity += 1 / model.damping[c]
        power += (bend / flexibility + rate / fluidity) * free_rate
    k[ENERGY_LOSS] = power
