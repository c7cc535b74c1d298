r"""Contact forces of long snakes: a start for MuJoCo's solver, at a cost linear in the number of segments.

MuJoCo finds accelerations a that minimise

$$ \tfrac12 a^T A\,a - b^T a + s(J a - a_r), \qquad A = M + h D + h^2 K, $$

with s convex: friction cones of the contacts, friction of the axles. Its Newton's method updates a factored
matrix three times a cone, each time at a cost that grows with the square of the chain's length; conjugate
gradients take the more steps the longer the chain is.

Here Newton's matrix is never made. Contacts hold bodies at the floor, not at each other, so that A + Jᵀ s″ J
is that of an articulated body whose links have the inertia of their contacts besides; it is solved from the
tips to the root and back. Spatial vectors are rotation first, about the centre of mass, as in `cdof`. The
slope along a step tells whether the step was too long.

What is found is a start only. The engine's conjugate gradients begin there and end at once where its own
tolerance is met, otherwise they go on.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from srs_twin.compiled import allocating, inside
from srs_twin.plants.friction_solve import dot, point

_MOST, _ENGINES_MOST = 60, 500  # iterations
_OVERSHOT = 0.1  # rise after a Newton step, over the fall before it, from which it was too long
_VELOCITIES_KNOWN = mujoco.mjtStage.mjSTAGE_VEL
_SHARE = 0.1  # of the engine's tolerance


class Chain(NamedTuple):
    """What stays of a model.

    Attributes:
        parent: the degree of freedom before each, −1 where there is none, shape (nv,).
        last: last of the degrees of freedom that move a body, −1 if none does, shape (nbody,).
        damping: diagonal of h D + h² K, shape (nv,).
        spring: of h K, same shape.
        limit: norm of the gradient at which to end.
    """

    parent: np.ndarray
    last: np.ndarray
    damping: np.ndarray
    spring: np.ndarray
    limit: float


class Touching(NamedTuple):
    """The contacts of a step and the constraints' rows, named as in MjContact and MjData.

    Attributes:
        body: the two that touch, shape (C, 2).
    """

    pos: np.ndarray
    frame: np.ndarray
    mu: np.ndarray
    friction: np.ndarray
    dim: np.ndarray
    efc_address: np.ndarray
    body: np.ndarray
    efc_D: np.ndarray
    efc_aref: np.ndarray
    efc_frictionloss: np.ndarray
    efc_id: np.ndarray


class Work(NamedTuple):
    """Memory of the kernel, for C contacts.

    Attributes:
        rows: which velocities the contacts resist, shape (C, 3, 6).
        bent: second derivatives of s by them, shape (C, 3, 3).
        place: last degree of freedom that moves each, shape (C,).
        stiff: second derivatives of s by each degree of freedom alone, shape (nv,).
        motion: spatial accelerations, then forces, beyond each degree of freedom, shape (nv, 6).
        inertia: beyond each degree of freedom, shape (nv, 6, 6).
        drag: forces on what is beyond each degree of freedom; then, while solving, what of the inertia pulls
            along with it, over its own, shape (nv, 6).
    """

    rows: np.ndarray
    bent: np.ndarray
    place: np.ndarray
    stiff: np.ndarray
    motion: np.ndarray
    inertia: np.ndarray
    drag: np.ndarray


class WarmStart:
    """Steps of one model that begin its solver with the solution."""

    def __init__(self, model: mujoco.MjModel) -> None:
        """Look up what the kernel needs; let the engine go on by conjugate gradients."""
        model.opt.solver, model.opt.iterations = mujoco.mjtSolver.mjSOL_CG, _ENGINES_MOST
        last = np.full(model.nbody, -1)
        for body in range(1, model.nbody):
            count = model.body_dofnum[body]
            last[body] = model.body_dofadr[body] + count - 1 if count else last[model.body_parentid[body]]
        h, hinges = model.opt.timestep, model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
        spring = np.zeros(model.nv)
        spring[model.jnt_dofadr[hinges]] = h * model.jnt_stiffness.reshape(model.njnt, -1)[hinges, 0]
        limit = _SHARE * model.opt.tolerance * model.stat.meaninertia * model.nv
        self._model, self._body = model, model.geom_bodyid.astype(int)
        parent = model.dof_parentid.astype(int)
        self._chain = Chain(parent, last, h * model.dof_damping + h * spring, spring, limit)

    def step(self, data: mujoco.MjData) -> None:
        """Make a step as `mj_step` does."""
        mujoco.mj_step1(self._model, data)
        self.begin(data)
        mujoco.mj_step2(self._model, data)

    def begin(self, data: mujoco.MjData) -> None:
        """Solve what `mj_step1` has prepared and let the engine begin there."""
        model = self._model
        model.opt.iterations = 0  # the constraints as the integrator softens them, unsolved
        mujoco.mj_forwardSkip(model, data, _VELOCITIES_KNOWN, True)
        model.opt.iterations = _ENGINES_MOST
        contact, force = data.contact, data.qfrc_smooth - self._chain.spring * data.qvel
        touching = Touching(
            *(contact.pos, contact.frame, contact.mu, contact.friction, contact.dim, contact.efc_address),
            self._body[contact.geom],
            *(data.efc_D, data.efc_aref, data.efc_frictionloss, data.efc_id),
        )
        body, start = (data.cdof, data.cinert, data.subtree_com[1]), data.qacc_warmstart.copy()
        _newton(self._chain, touching, (data.ne, data.nf), body, force, start)
        if np.isfinite(start).all():
            data.qacc_warmstart[:] = start


@allocating
def _newton(chain, touching, rubbing, body, force, x):  # type: ignore[no-untyped-def]
    """Find the accelerations by Newton's method.

    Args:
        chain: of the model.
        touching: of the step.
        rubbing: number of equality constraints, whose rows come first, and of the axles' friction.
        body: `cdof`, `cinert` and the centre of mass.
        force: b, shape (nv,).
        x: in place, the guess to begin with, shape (nv,).
    """
    nv, count = x.shape[0], touching.mu.shape[0]
    cdof, cinert, com = body
    work = Work(
        np.zeros((count, 3, 6)),
        np.zeros((count, 3, 3)),
        np.zeros(count, dtype=np.int64),
        np.zeros(nv),
        np.zeros((nv, 6)),
        np.zeros((nv, 6, 6)),
        np.zeros((nv, 6)),
    )
    for c in range(count):
        a, b = chain.last[touching.body[c, 0]], chain.last[touching.body[c, 1]]
        sign = 1.0 if b >= 0 else -1.0
        work.place[c] = b if b >= 0 else a
        px, py, pz = touching.pos[c, 0] - com[0], touching.pos[c, 1] - com[1], touching.pos[c, 2] - com[2]
        for k in range(min(touching.dim[c], 3)):
            axis = touching.frame[c, 3 * k : 3 * k + 3]
            point(work.rows[c, k], px, py, pz, sign * axis[0], sign * axis[1], sign * axis[2])
    gradient, direction = np.zeros(nv), np.zeros(nv)
    share, fall = 0.0, 0.0
    for _ in range(_MOST):
        _slope(chain, touching, rubbing, (cdof, cinert), force, x, work, gradient)
        falls = norm = 0.0
        for i in range(nv):
            falls += gradient[i] * direction[i]
            norm += gradient[i] * gradient[i]
        if norm < chain.limit * chain.limit:
            break
        if falls < -_OVERSHOT * fall:
            # Past the lowest point along the step: some way back.
            back = share * min(max(fall / (fall - falls), 0.1), 0.7)
            for i in range(nv):
                x[i] += (share - back) * direction[i]
            share = back
            continue
        _solve(chain, cdof, cinert, work, gradient, direction)
        share, fall = 1.0, 0.0
        for i in range(nv):
            x[i] -= direction[i]
            fall += gradient[i] * direction[i]


@inside
def _slope(chain, touching, rubbing, body, force, x, work, gradient):  # type: ignore[no-untyped-def]
    """Fill the gradient at x and the second derivatives of s."""
    nv, motion, pushed, (cdof, cinert) = x.shape[0], work.motion, work.drag, body
    for i in range(nv):
        p = chain.parent[i]
        gradient[i] = chain.damping[i] * x[i] - force[i]
        work.stiff[i] = chain.damping[i]
        for k in range(6):
            motion[i, k] = cdof[i, k] * x[i] + (motion[p, k] if p >= 0 else 0.0)
            pushed[i, k] = 0.0
    for body in range(1, cinert.shape[0]):
        i = chain.last[body]
        if i >= 0:
            m, v, f = cinert[body], motion[i], pushed[i]
            f[0] += m[0] * v[0] + m[3] * v[1] + m[4] * v[2] - m[8] * v[4] + m[7] * v[5]
            f[1] += m[3] * v[0] + m[1] * v[1] + m[5] * v[2] + m[8] * v[3] - m[6] * v[5]
            f[2] += m[4] * v[0] + m[5] * v[1] + m[2] * v[2] - m[7] * v[3] + m[6] * v[4]
            f[3] += m[8] * v[1] - m[7] * v[2] + m[9] * v[3]
            f[4] += m[6] * v[2] - m[8] * v[0] + m[9] * v[4]
            f[5] += m[7] * v[0] - m[6] * v[1] + m[9] * v[5]
    for k in range(rubbing[0], rubbing[0] + rubbing[1]):
        i, stiff, most = touching.efc_id[k], touching.efc_D[k], touching.efc_frictionloss[k]
        pull = stiff * (x[i] - touching.efc_aref[k])
        if abs(pull) < most:
            work.stiff[i] += stiff
        gradient[i] += min(max(pull, -most), most)
    for c in range(touching.mu.shape[0]):
        k, rows, bent, i = touching.efc_address[c], work.rows[c], work.bent[c], work.place[c]
        bent[:] = 0.0
        if k < 0 or i < 0:
            continue
        n = dot(rows[0], motion[i]) - touching.efc_aref[k]
        if touching.dim[c] == 1:
            if n < 0.0:
                bent[0, 0] = touching.efc_D[k]
                _push(pushed[i], rows, bent[0, 0] * n, 0.0, 0.0)
            continue
        s = dot(rows[1], motion[i]) - touching.efc_aref[k + 1]
        t = dot(rows[2], motion[i]) - touching.efc_aref[k + 2]
        mu, by_s, by_t = touching.mu[c], touching.friction[c, 0], touching.friction[c, 1]
        slip = np.sqrt((by_s * s) ** 2 + (by_t * t) ** 2)
        if mu * n >= mu * slip:
            continue
        if mu * mu * n + slip <= 0.0:
            bent[0, 0], bent[1, 1], bent[2, 2] = (
                touching.efc_D[k],
                touching.efc_D[k + 1],
                touching.efc_D[k + 2],
            )
            _push(pushed[i], rows, bent[0, 0] * n, bent[1, 1] * s, bent[2, 2] * t)
            continue
        stiff = touching.efc_D[k] / (1 + mu * mu)
        short, us, ut = n - slip, by_s * by_s * s / slip, by_t * by_t * t / slip
        _push(pushed[i], rows, stiff * short, -stiff * short * us, -stiff * short * ut)
        held = -short / slip
        bent[0, 0], bent[0, 1], bent[0, 2] = stiff, -stiff * us, -stiff * ut
        bent[1, 0], bent[2, 0] = bent[0, 1], bent[0, 2]
        bent[1, 1] = stiff * (us * us + held * (by_s * by_s - us * us))
        bent[2, 2] = stiff * (ut * ut + held * (by_t * by_t - ut * ut))
        bent[1, 2] = stiff * us * ut * (1 - held)
        bent[2, 1] = bent[1, 2]
    for i in range(nv - 1, -1, -1):
        gradient[i] += dot(cdof[i], pushed[i])
        p = chain.parent[i]
        if p >= 0:
            for k in range(6):
                pushed[p, k] += pushed[i, k]


@inside
def _push(force, rows, n, s, t):  # type: ignore[no-untyped-def]
    for k in range(6):
        force[k] += n * rows[0, k] + s * rows[1, k] + t * rows[2, k]


@inside
def _solve(chain, cdof, cinert, work, gradient, x):  # type: ignore[no-untyped-def]
    """Fill x by which Newton's matrix gives the gradient."""
    nv, inertia, motion, drag = x.shape[0], work.inertia, work.motion, work.drag
    for i in range(nv):
        for a in range(6):
            motion[i, a] = 0.0
            for b in range(6):
                inertia[i, a, b] = 0.0
    for body in range(1, cinert.shape[0]):
        if chain.last[body] >= 0:
            m, y = cinert[body], inertia[chain.last[body]]
            y[0, 0], y[1, 1], y[2, 2] = y[0, 0] + m[0], y[1, 1] + m[1], y[2, 2] + m[2]
            for a, b, value in (
                (0, 1, m[3]), (0, 2, m[4]), (1, 2, m[5]), (0, 4, -m[8]), (0, 5, m[7]),
                (1, 3, m[8]), (1, 5, -m[6]), (2, 3, -m[7]), (2, 4, m[6]),
            ):  # fmt: skip
                y[a, b] += value
                y[b, a] += value
            y[3, 3], y[4, 4], y[5, 5] = y[3, 3] + m[9], y[4, 4] + m[9], y[5, 5] + m[9]
    for c in range(work.place.shape[0]):
        rows, bent = work.rows[c], work.bent[c]
        if bent[0, 0] == 0.0:
            continue
        y = inertia[work.place[c]]
        for a in range(6):
            n = bent[0, 0] * rows[0, a] + bent[0, 1] * rows[1, a] + bent[0, 2] * rows[2, a]
            s = bent[1, 0] * rows[0, a] + bent[1, 1] * rows[1, a] + bent[1, 2] * rows[2, a]
            t = bent[2, 0] * rows[0, a] + bent[2, 1] * rows[1, a] + bent[2, 2] * rows[2, a]
            for b in range(6):
                y[a, b] += n * rows[0, b] + s * rows[1, b] + t * rows[2, b]
    for i in range(nv - 1, -1, -1):
        d, y, f, p = cdof[i], inertia[i], motion[i], chain.parent[i]
        for a in range(6):
            drag[i, a] = dot(y[a], d)
        own = dot(drag[i], d) + work.stiff[i]
        x[i] = (gradient[i] - dot(d, f)) / own
        if p >= 0:
            for a in range(6):
                by = drag[i, a] / own
                motion[p, a] += f[a] + drag[i, a] * x[i]
                for b in range(6):
                    inertia[p, a, b] += y[a, b] - by * drag[i, b]
        for a in range(6):
            drag[i, a] /= own
    for i in range(nv):
        p = chain.parent[i]
        if p >= 0:
            x[i] -= dot(drag[i], motion[p])
        for a in range(6):
            motion[i, a] = cdof[i, a] * x[i] + (motion[p, a] if p >= 0 else 0.0)
