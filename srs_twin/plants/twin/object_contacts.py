r"""Friction between movable objects and the floor, and between objects and the body.

The module `friction_solve` lists the symbols and includes this friction in its
equation. An object rests on the floor at four support points (`MovableObject.supports`)
and can touch the collision geoms of the body. All these contacts use the friction law
of `stick_slip`, which is implicit in the velocities.

At a collision geom, the friction law uses the velocity relative to the object, and an
equal and opposite friction force acts on the object. The loads on the support points
are constant and do not depend on the vertical friction at collision geoms. The normal
forces between objects and collision geoms are those of the engine's prediction v̂.

Each object is a separate kinematic tree. The contact forces between objects and
collision geoms couple the motions of the objects and the snake. Their derivatives form
a block B of the Newton matrix, which lies outside the sparsity pattern of the inertia
matrix M. The diagonal blocks of the Newton matrix are P for the snake and Q for the
objects. Block elimination first yields the motion y of the objects and then the motion
x of the snake:

$$ (Q - B P^{-1} B^T)\,y = r_o - B P^{-1} r_s, \qquad x = P^{-1} (r_s - B^T y). $$

Here r_s and r_o are the right-hand sides for the snake and the objects.

The functions of this module are compiled only for worlds with objects.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numba import types

from srs_twin.compute.compiled import compiled_if, kernel_only
from srs_twin.plants.twin.engine import mj_solveM
from srs_twin.plants.twin.mjcf import surroundings
from srs_twin.plants.twin.mjcf.surroundings import object_force_sensor, object_names
from srs_twin.plants.twin.spatial_algebra import clear, dot, point_jacobian
from srs_twin.plants.twin.stick_slip import stick_slip_friction
from srs_twin.robot.world import MovableObject

# Columns of `ObjectContacts.dof`, and indices of the two bodies in `jacobian`.
_COLLISION = 0
_OBJECT = 1

# Rows of `ObjectContacts.jacobian`.
_ALONG = 0
_ACROSS = 1
_AWAY = 2

# Columns of `ObjectContacts.response`, in the order of `stick_slip.Traction`.
_FORCE_ALONG = 0
_FORCE_ACROSS = 1
_DERIVATIVE_ALONG = 2
_OFF_DIAGONAL = 3
_DERIVATIVE_ACROSS = 4


class ObjectState(NamedTuple):
    """State of the object contacts that one time step passes to the next.

    Attributes:
        force: friction in the two tangential directions of each contact, shape (C, 2),
            N.
        slip_speed: slip speed of each contact, shape (C,), m/s.
        jacobian: contact Jacobians of the previous step, with the layout of
            `ObjectContacts.jacobian`.
    """

    force: np.ndarray
    slip_speed: np.ndarray
    jacobian: np.ndarray


class ObjectContacts(NamedTuple):
    """Constants, state and work arrays of the C contacts of all objects.

    Contacts between objects and collision geoms (pairs) precede the support points.

    Attributes:
        first: index of the first degree of freedom that belongs to an object.
        slip: slip speed ε, m/s.
        dof: indices of the last degrees of freedom that move the collision geom and the
            object, shape (C, 2). For a support point, the first index is −1.
        object_body: MuJoCo id of the object's body, shape (C,).
        place: position of each support point in the frame of the object, shape (C, 2),
            m.
        sensor: index in `sensordata` of the force on the collision geom, shape (C,).
            The force is followed by its point of application.
        load: normal force, which is constant at support points, shape (C,), N.
        friction: friction coefficient, shape (C,), dimensionless.
        inverse_effective_mass: inverse effective mass, shape (C,), 1/kg.
        force, slip_speed: friction (N) and slip speed (m/s) as in `ObjectState`.
        jacobian: Jacobians of the contact velocity in the two tangential directions and
            away from the object, as spatial vectors, shape (C, 2, 3, 6). The second
            axis refers to the collision geom and the object. In a pair, the vectors of
            the object have a negative sign.
        theta: fraction θ of the step at which friction is evaluated, shape (C,).
        response: friction forces (N) and their derivatives (N·s/m) in the order of
            `stick_slip.Traction`, shape (C, 5).
        coupling, solved: matrices B and B P⁻¹, shape (m, nv), where m is the number of
            degrees of freedom of all objects.
        matrix: matrix of the linear system for y, with the right-hand side as its last
            column, shape (m, m + 1).
    """

    pairs: int
    first: int
    slip: float
    dof: np.ndarray
    object_body: np.ndarray
    place: np.ndarray
    sensor: np.ndarray
    load: np.ndarray
    friction: np.ndarray
    inverse_effective_mass: np.ndarray
    force: np.ndarray
    slip_speed: np.ndarray
    jacobian: np.ndarray
    theta: np.ndarray
    response: np.ndarray
    coupling: np.ndarray
    solved: np.ndarray
    matrix: np.ndarray


def object_contacts(
    model: mujoco.MjModel,
    objects: tuple[MovableObject, ...],
    slip: float,
    collision_inverse_effective_mass: np.ndarray,
) -> ObjectContacts:
    """Return the object contacts of a compiled scene at rest.

    The argument `slip` is the slip speed (m/s). The array
    `collision_inverse_effective_mass` has one value per collision geom (1/kg).
    """
    collision_geoms = surroundings.collision_geoms(model)
    names = object_names(model)
    pairs = len(collision_geoms) * len(names)
    free = 3 * len(names)
    ids = np.array([model.body(name).id for name in names], dtype=int)
    collision_body = np.array(
        [model.geom(name).bodyid[0] for name in collision_geoms], dtype=int
    )
    no_collision = np.full(4 * len(names), -1)
    collision_dof = np.append(
        np.tile(_last_dof(model, collision_body), len(names)), no_collision
    )
    body = np.concatenate([np.repeat(ids, len(collision_geoms)), np.repeat(ids, 4)])
    mass = model.body_mass[body]
    count = len(body)
    sensors = [
        model.sensor(object_force_sensor(name, collision_geom)).adr[0]
        for name in names
        for collision_geom in collision_geoms
    ]
    place = np.zeros((count, 2))
    place[pairs:] = np.array([item.supports for item in objects]).reshape(-1, 2)
    load = np.zeros(count)
    load[pairs:] = -model.opt.gravity[2] / 4 * mass[pairs:]
    friction = np.full(count, surroundings.friction_of(model))
    friction[pairs:] = np.repeat([item.friction for item in objects], 4)
    inverse_effective_mass = 1 / mass
    inverse_effective_mass[:pairs] += np.tile(
        collision_inverse_effective_mass, len(names)
    )
    return ObjectContacts(
        pairs=pairs,
        first=model.nv - free,
        slip=slip,
        dof=np.stack([collision_dof, _last_dof(model, body)], axis=1),
        object_body=body,
        place=place,
        sensor=np.array(sensors + [0] * len(no_collision), dtype=int),
        load=load,
        friction=friction,
        inverse_effective_mass=inverse_effective_mass,
        force=np.zeros((count, 2)),
        slip_speed=np.zeros(count),
        jacobian=np.zeros((count, 2, 3, 6)),
        theta=np.ones(count),
        response=np.zeros((count, 5)),
        coupling=np.zeros((free, model.nv)),
        solved=np.zeros((free, model.nv)),
        matrix=np.zeros((free, free + 1)),
    )


def has_objects(engine: types.NamedTuple) -> bool:
    """Return whether a numba type of `EngineData` includes object contacts."""
    return not isinstance(engine[engine.fields.index("objects")], types.NoneType)


def _last_dof(model: mujoco.MjModel, body: np.ndarray) -> np.ndarray:
    last: np.ndarray = model.body_dofadr[body] + model.body_dofnum[body] - 1
    return last


@compiled_if(has_objects)
def apply_object_friction(engine, sparsity, workspace, h):  # type: ignore[no-untyped-def]
    """Add the friction of objects in the previous step to `qfrc_applied`."""
    o = engine.objects
    for w in range(o.force.shape[0]):
        for side in range(2):
            i = o.dof[w, side]
            along = o.jacobian[w, side, _ALONG]
            across = o.jacobian[w, side, _ACROSS]
            while i >= 0:
                moment = o.force[w, _FORCE_ALONG] * dot(along, engine.cdof[i])
                engine.qfrc_applied[i] += moment + o.force[w, _FORCE_ACROSS] * dot(
                    across, engine.cdof[i]
                )
                i = sparsity.parent[i]


@kernel_only
def _locate(jacobian, x, y, z, c, s, sign):  # type: ignore[no-untyped-def]
    c = sign * c
    s = sign * s
    point_jacobian(jacobian[_ALONG], x, y, z, c, s, 0.0)
    point_jacobian(jacobian[_ACROSS], x, y, z, 0.0, 0.0, sign)
    point_jacobian(jacobian[_AWAY], x, y, z, s, -c, 0.0)


@compiled_if(has_objects)
def locate_objects(engine, sparsity, workspace, h):  # type: ignore[no-untyped-def]
    """Compute the contact Jacobians and read the normal forces from the sensors."""
    o = engine.objects
    com = engine.subtree_com[1]
    sensors = engine.sensordata
    for w in range(o.force.shape[0]):
        body = o.object_body[w]
        own = engine.subtree_com[body]
        collision_geom = o.jacobian[w, _COLLISION]
        item = o.jacobian[w, _OBJECT]
        if w >= o.pairs:
            m = engine.xmat[body]
            place = o.place[w]
            x = engine.xpos[body, 0] + m[0] * place[0] + m[1] * place[1] - own[0]
            y = engine.xpos[body, 1] + m[3] * place[0] + m[4] * place[1] - own[1]
            point_jacobian(item[_ALONG], x, y, 0.0, 1.0, 0.0, 0.0)
            point_jacobian(item[_ACROSS], x, y, 0.0, 0.0, 1.0, 0.0)
        else:
            k = o.sensor[w]
            fx = sensors[k]
            fy = sensors[k + 1]
            normal = np.sqrt(fx * fx + fy * fy)
            o.load[w] = normal
            if normal > 0.0:
                c = -fy / normal
                s = fx / normal
                x = sensors[k + 3]
                y = sensors[k + 4]
                z = sensors[k + 5]
                _locate(collision_geom, x - com[0], y - com[1], z - com[2], c, s, 1.0)
                _locate(item, x - own[0], y - own[1], z - own[2], c, s, -1.0)
        grip = o.friction[w] * o.load[w] / max(o.slip_speed[w], o.slip)
        decay = h * grip * o.inverse_effective_mass[w]
        # `friction_solve._evaluation_fraction` explains θ.
        if decay > 0.1:
            o.theta[w] = 1.0 / (1.0 - np.exp(-decay)) - 1.0 / decay
        else:
            o.theta[w] = 0.5 + decay / 12.0


@kernel_only
def _velocity(o, workspace, w, theta):  # type: ignore[no-untyped-def]
    u_t = 0.0
    u_n = 0.0
    for side in range(2):
        i = o.dof[w, side]
        if i >= 0:
            middle = workspace.mid_motion[i]
            step = workspace.step_motion[i]
            change = workspace.motion[i]
            along = o.jacobian[w, side, _ALONG]
            across = o.jacobian[w, side, _ACROSS]
            shift = theta - 0.5
            u_t += (
                dot(along, middle)
                + shift * dot(along, step)
                + theta * dot(along, change)
            )
            u_n += (
                dot(across, middle)
                + shift * dot(across, step)
                + theta * dot(across, change)
            )
    return u_t, u_n


@compiled_if(has_objects)
def add_object_impulses(engine, sparsity, workspace, h):  # type: ignore[no-untyped-def]
    """Compute the friction for `motion` and subtract its impulses from `impulse`."""
    o = engine.objects
    for w in range(o.force.shape[0]):
        u_t, u_n = _velocity(o, workspace, w, o.theta[w])
        mu = o.friction[w]
        force = o.force[w]
        out = o.response[w]
        traction = stick_slip_friction(
            u_t,
            u_n,
            o.load[w],
            mu,
            mu,
            o.slip,
            force[_FORCE_ALONG],
            force[_FORCE_ACROSS],
        )
        out[_FORCE_ALONG] = traction.along
        out[_FORCE_ACROSS] = traction.across
        out[_DERIVATIVE_ALONG] = traction.derivative_along
        out[_OFF_DIAGONAL] = traction.off_diagonal
        out[_DERIVATIVE_ACROSS] = traction.derivative_across
        along = h * (traction.along - force[_FORCE_ALONG])
        across = h * (traction.across - force[_FORCE_ACROSS])
        for side in range(2):
            i = o.dof[w, side]
            if i >= 0:
                for k in range(6):
                    change = (
                        along * o.jacobian[w, side, _ALONG, k]
                        + across * o.jacobian[w, side, _ACROSS, k]
                    )
                    workspace.impulse[i, k] -= change


@compiled_if(has_objects)
def add_object_jacobian(engine, sparsity, workspace, h):  # type: ignore[no-untyped-def]
    """Add the derivatives of friction to `derivative` and compute the block B."""
    o = engine.objects
    clear(o.coupling)
    for w in range(o.force.shape[0]):
        if o.load[w] == 0.0:
            continue
        weight = -o.theta[w] * h
        tt = weight * o.response[w, _DERIVATIVE_ALONG]
        tn = weight * o.response[w, _OFF_DIAGONAL]
        nn = weight * o.response[w, _DERIVATIVE_ACROSS]
        for side in range(2):
            i = o.dof[w, side]
            if i >= 0:
                along = o.jacobian[w, side, _ALONG]
                across = o.jacobian[w, side, _ACROSS]
                for a in range(6):
                    t = tt * along[a] + tn * across[a]
                    n = tn * along[a] + nn * across[a]
                    for b in range(6):
                        workspace.derivative[i, a, b] += t * along[b] + n * across[b]
        collision_geom = o.jacobian[w, _COLLISION]
        own = o.jacobian[w, _OBJECT]
        last = o.dof[w, _OBJECT]
        for dof in range(last - 2, last + 1):
            s_t = dot(own[_ALONG], engine.cdof[dof])
            s_n = dot(own[_ACROSS], engine.cdof[dof])
            t = tt * s_t + tn * s_n
            n = tn * s_t + nn * s_n
            i = o.dof[w, _COLLISION]
            while i >= 0:
                cdof = engine.cdof[i]
                on_collision_geom = t * dot(collision_geom[_ALONG], cdof) + n * dot(
                    collision_geom[_ACROSS], cdof
                )
                o.coupling[dof - o.first, i] += on_collision_geom
                i = sparsity.parent[i]


@kernel_only
def _eliminate(matrix, x):  # type: ignore[no-untyped-def]
    count = matrix.shape[0]
    for i in range(count):
        for j in range(i + 1, count):
            factor = matrix[j, i] / matrix[i, i]
            for k in range(i, count + 1):
                matrix[j, k] -= factor * matrix[i, k]
    for i in range(count - 1, -1, -1):
        value = matrix[i, count]
        for k in range(i + 1, count):
            value -= matrix[i, k] * x[k]
        x[i] = value / matrix[i, i]


@compiled_if(has_objects)
def couple_objects(engine, sparsity, workspace, h):  # type: ignore[no-untyped-def]
    """Correct the Newton step, which was solved without the block B."""
    o = engine.objects
    first = engine.objects.first
    direction = workspace.direction
    count = o.coupling.shape[0]
    if count == 0:
        return
    coupling = o.coupling.ctypes.data
    solved = o.solved.ctypes.data
    mj_solveM(engine.model, engine.data, solved, coupling, np.int32(count))
    clear(o.matrix)
    for i in range(count):
        row = sparsity.row_start[first + i]
        for k in range(row, row + sparsity.row_length[first + i]):
            o.matrix[i, sparsity.column[k] - first] = workspace.newton_matrix[k]
    for i in range(count):
        for k in range(i + 1):
            for j in range(first):
                o.matrix[i, k] -= o.coupling[i, j] * o.solved[k, j]
            o.matrix[k, i] = o.matrix[i, k]
        o.matrix[i, count] = workspace.residual[first + i]
        for j in range(first):
            o.matrix[i, count] -= o.coupling[i, j] * direction[j]
    _eliminate(o.matrix, direction[first:])
    for i in range(count):
        for j in range(first):
            direction[j] -= direction[first + i] * o.solved[i, j]


@compiled_if(has_objects, otherwise=0.0)
def store_object_friction(engine, sparsity, workspace, force):  # type: ignore[no-untyped-def]
    """Store the friction for the next step, and return the dissipated power, W.

    The power includes that of the normal forces between collision geoms and objects.
    The function writes the friction on the collision geom of each pair in the world
    frame to `force`, shape (pairs, 3), N.
    """
    o = engine.objects
    power = 0.0
    for w in range(o.force.shape[0]):
        f_t = o.response[w, _FORCE_ALONG]
        f_lat = o.response[w, _FORCE_ACROSS]
        u_t, u_n = _velocity(o, workspace, w, 0.5)
        power -= f_t * u_t + f_lat * u_n
        o.slip_speed[w] = np.sqrt(u_t * u_t + u_n * u_n)
        o.force[w, _FORCE_ALONG] = f_t
        o.force[w, _FORCE_ACROSS] = f_lat
        if w < o.pairs:
            along = o.jacobian[w, _COLLISION, _ALONG]
            force[w, 0] = f_t * along[3]
            force[w, 1] = f_t * along[4]
            force[w, 2] = f_lat
            for side in range(2):
                i = o.dof[w, side]
                away = o.jacobian[w, side, _AWAY]
                power -= o.load[w] * (
                    dot(away, workspace.mid_motion[i])
                    + 0.5 * dot(away, workspace.motion[i])
                )
    return power
