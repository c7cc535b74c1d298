r"""RobotSpec → MuJoCo model: the only place that builds MJCF.

A free-floating chain in three dimensions. Connector i is a body with two real hinge wheels; a segment is
a chain of n equal bending hinges (stiffness n·k and damping n·c each, in series k and c) with one pitch
and one roll hinge in its middle, so that the floor's load is shared. Chamber pressures are the controls,
in Pa: actuators ``plus_j`` and ``minus_j`` put the moment k·G·(p⁺ − p⁻) on tendon ``bend_j``, whose
length is the segment's bend q_j.

Where the hinges stand: with n hinges that share a bend q equally, n ≥ 2, the chord agrees with the arc's
l·sin(q/2)/(q/2) through order q² when the first and last lie 1/(2(n+1)) of the length from the ends and
the others evenly between them.

Friction: wheels touch the floor as spheres, one contact each straight below the axle, isotropic with μ_n;
the axle's `frictionloss` is μ_t × load × radius. Contacts are explicit pairs, which name the floor, so
they belong to the scene and not to the robot.

Preload: MuJoCo's contact is convex, which lifts a sliding wheel off the floor; left alone, a snake's wheels
are in the air more than half the time and it goes up to a tenth too fast. Actuators ``press_i``, which
take no control, push every axle down with κ times its static load, and the pairs' coefficient is
μ_n/(1 + κ): the friction of the static load, as in the analytical models, from a contact that stays closed.
Floor forces less the preload are the true loads, at rest within 6 %. docs/models.md says what it costs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from srs_twin.errors import InputError
from srs_twin.mjcf_classes import ROOT, add_classes, drawn_height
from srs_twin.mjcf_surroundings import add_surroundings
from srs_twin.spec import GRAVITY, RobotSpec

_NET_FORCE = 3  # contact sensor: sum over the contacts found
_LINK_SHARE = 0.02  # of a segment's share of mass; the text lumps all of it at the connectors
_GYRATION = 0.005  # m, of a connector about its own centre: near the text's point mass


@dataclass(frozen=True)
class Numerics:
    """What belongs to the simulation and not to the robot.

    Attributes:
        timestep: s.
        hinges_per_segment: bending hinges a segment, 1 or more.
        contact_time: time constant of the normal contact, s.
        slip_time: time constant with which contact friction stops a slip (`solreffriction`), s.
        axle_time: the same for the axles' friction, s.
        preload: κ, by how many times its static load each wheel is pressed down besides; 0: none.
    """

    timestep: float = 0.001
    hinges_per_segment: int = 4
    contact_time: float = 0.0014
    slip_time: float = 0.0003
    axle_time: float = 0.002
    preload: float = 19.0


def hinge_places(hinges: int) -> np.ndarray:
    """Return where the bending hinges stand, as fractions of the segment length, shape (hinges,)."""
    if hinges < 1:
        raise InputError(f"hinges_per_segment: {hinges} is not allowed; a segment needs 1 or more")
    if hinges == 1:
        return np.array([0.5])
    edge = 1 / (2 * (hinges + 1))
    return np.linspace(edge, 1 - edge, hinges)


def robot_mjcf(spec: RobotSpec, numerics: Numerics, *, supply_pa: float | None = None) -> mujoco.MjSpec:
    """Build the robot: bodies, joints, tendons and actuators, no floor.

    Args:
        spec: the robot.
        numerics: time step, discretisation, contact.
        supply_pa: upper end of the controls' range, Pa; no less than what a chamber may hold.

    Raises:
        InputError: the time step is too long for the robot's damping time.
    """
    shortest = min(spec.bending.damping_time, spec.bending.out_of_plane_damping_time)
    if not numerics.timestep < shortest:
        raise InputError(
            f"time step {numerics.timestep:g} s is too long for segments with a damping time c/k of "
            f"{shortest:g} s; it must be shorter"
        )
    mj = mujoco.MjSpec()
    mj.modelname = spec.name
    mj.compiler.degree = False
    mj.compiler.autolimits = True
    _set_options(mj, numerics)
    limit = max(spec.supply.continuous_limit, supply_pa or 0.0)
    add_classes(
        mj, spec, hinges=numerics.hinges_per_segment, timestep=numerics.timestep,
        axle_time=numerics.axle_time, limit_pa=limit,
    )  # fmt: skip
    body = mj.worldbody.add_body(
        name="connector_1", pos=[spec.geometry.body_length / 2, 0, spec.geometry.com_height]
    )
    body.add_freejoint(name="root")
    _add_connector(mj, body, spec, 1, numerics)
    for j in range(1, spec.segments + 1):
        body = _add_segment(mj, body, spec, j, numerics)
        _add_connector(mj, body, spec, j + 1, numerics)
    for j in range(1, spec.segments + 1):
        _add_muscles(mj, j, numerics)
    _add_preload(mj, spec, numerics)
    _add_home(mj)
    return mj


def preload_force(spec: RobotSpec, numerics: Numerics) -> np.ndarray:
    """Return the force that presses each wheel down besides its load, head first, shape (N, 2), N."""
    return np.repeat(numerics.preload * spec.mass.array()[:, None] * GRAVITY / 2, 2, axis=1)


def scene_mjcf(spec: RobotSpec, numerics: Numerics, *, supply_pa: float | None = None) -> mujoco.MjSpec:
    """Build the robot on a floor, with its contact pairs and floor-force sensors (world frame, N).

    Arguments as in `robot_mjcf`.
    """
    mj = robot_mjcf(spec, numerics, supply_pa=supply_pa)
    add_surroundings(mj, spec.geometry.body_length)
    pair = mj.add_default("wheel_on_floor", mj.default)
    for name, value in contact(spec, numerics).items():
        setattr(pair.pair, name, value)
    force = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
    for tread in treads(spec):
        mj.add_pair(pair, name=tread, geomname1="floor", geomname2=tread)
        mj.add_sensor(
            name=f"floor_force_{tread}", type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM, objname="floor",
            reftype=mujoco.mjtObj.mjOBJ_GEOM, refname=tread, intprm=[force, _NET_FORCE, 1],
        )  # fmt: skip
    return mj


def treads(spec: RobotSpec) -> list[str]:
    """Return the names of the wheels' contact geoms: head first, left before right."""
    return [f"tread_{side}_{i}" for i in range(1, spec.geometry.connectors + 1) for side in ("left", "right")]


def contact(spec: RobotSpec, numerics: Numerics) -> dict[str, Any]:
    """Return the attributes of a wheel-floor pair."""
    mu = spec.friction.mu_n / (1 + numerics.preload)
    return {
        "condim": 3,
        "friction": [mu, mu, 0.005, 0.0001, 0.0001],
        "solref": [numerics.contact_time, 1],
        "solreffriction": [numerics.slip_time, 1],
    }


def _set_options(mj: mujoco.MjSpec, numerics: Numerics) -> None:
    option = mj.option
    option.timestep = numerics.timestep
    option.gravity = [0, 0, -GRAVITY]
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    option.impratio = 1
    option.iterations = 50
    option.tolerance = 1e-10
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def _set_inertia(body: mujoco.MjsBody, mass: float) -> None:
    """Give a body a compact mass at its origin."""
    body.mass = mass
    body.ipos = [0, 0, 0]  # left out, MjSpec takes the body's own `pos` for it
    body.inertia = [mass * _GYRATION**2] * 3
    body.explicitinertial = True


def _link_mass(spec: RobotSpec, numerics: Numerics) -> float:
    """Return the mass of one link between two hinges, kg; taken off the connectors."""
    links = numerics.hinges_per_segment - 1
    share = _LINK_SHARE * min(spec.mass.connectors)
    return share / links if links else 0.0


def _add_connector(
    mj: mujoco.MjSpec, body: mujoco.MjsBody, spec: RobotSpec, i: int, numerics: Numerics
) -> None:
    g, mass = spec.geometry, spec.mass.connectors[i - 1]
    neighbours = (i > 1) + (i < g.connectors)
    links = neighbours / 2 * (numerics.hinges_per_segment - 1) * _link_mass(spec, numerics)
    _set_inertia(body, mass - 2 * spec.mass.wheel - links)
    body.add_geom(mj.find_default("plate"), name=f"plate_{i}", pos=[0, 0, drawn_height(spec)])
    spin = spec.mass.wheel * g.wheel_radius**2 / 2
    for side, sign in (("left", 1), ("right", -1)):
        wheel = body.add_body(
            name=f"wheel_{side}_{i}", pos=[0, sign * g.half_track, g.wheel_radius - g.com_height],
            mass=spec.mass.wheel, ipos=[0, 0, 0], inertia=[spin / 2, spin, spin / 2], explicitinertial=True,
        )  # fmt: skip
        wheel.add_joint(
            mj.find_default("axle"), name=f"axle_{side}_{i}",
            frictionloss=spec.friction.mu_t * mass * GRAVITY / 2 * g.wheel_radius,
        )  # fmt: skip
        wheel.add_geom(mj.find_default("tread"), name=f"tread_{side}_{i}")
        wheel.add_geom(mj.find_default("rim"), name=f"rim_{side}_{i}")


def _add_segment(
    mj: mujoco.MjSpec, body: mujoco.MjsBody, spec: RobotSpec, j: int, numerics: Numerics
) -> mujoco.MjsBody:
    """Grow segment j tailwards from connector j; return the body of connector j + 1.

    Each hinge carries the body behind it; the last one carries the next connector. Stations are distances
    behind connector j of a straight segment.
    """
    g, n = spec.geometry, numerics.hinges_per_segment
    hinges = g.rigid_gap / 2 + g.segment_length * hinge_places(n)
    origins = np.append(hinges[:-1], g.pitch)
    middle = n // 2
    _add_skin(mj, body, spec, f"skin_{j}_0", 0.0, -hinges[0])
    parent_origin = 0.0
    for k in range(n):
        last = k == n - 1
        name = f"connector_{j + 1}" if last else f"link_{j}_{k + 1}"
        body = body.add_body(name=name, pos=[parent_origin - origins[k], 0, 0])
        parent_origin = origins[k]
        anchor = origins[k] - hinges[k]
        body.add_joint(mj.find_default("hinge"), name=f"hinge_{j}_{k + 1}", pos=[anchor, 0, 0])
        if k == middle:
            for kind in ("pitch", "roll"):
                centre = origins[k] - g.pitch / 2
                body.add_joint(mj.find_default(kind), name=f"{kind}_{j}", pos=[centre, 0, 0])
        if last:
            _add_skin(mj, body, spec, f"skin_{j}_{k + 1}", anchor, 0.0)
        else:
            _set_inertia(body, _link_mass(spec, numerics))
            _add_skin(mj, body, spec, f"skin_{j}_{k + 1}", 0.0, hinges[k] - hinges[k + 1])
    return body


def _add_skin(
    mj: mujoco.MjSpec, body: mujoco.MjsBody, spec: RobotSpec, name: str, front: float, back: float
) -> None:
    """Draw the soft body between two stations of a body's x axis."""
    z = drawn_height(spec)
    body.add_geom(mj.find_default("skin"), name=name, fromto=[front, 0, z, back, 0, z])


def _add_muscles(mj: mujoco.MjSpec, j: int, numerics: Numerics) -> None:
    """Add tendon ``bend_j`` and its two chambers."""
    tendon = mj.add_tendon(name=f"bend_{j}")
    for k in range(1, numerics.hinges_per_segment + 1):
        tendon.wrap_joint(f"hinge_{j}_{k}", 1.0)
    for name, sign in (("plus", 1), ("minus", -1)):
        actuator = mj.add_actuator(
            mj.find_default("muscle"), name=f"{name}_{j}", target=tendon.name,
            trntype=mujoco.mjtTrn.mjTRN_TENDON,
        )  # fmt: skip
        actuator.gainprm[0] *= sign


def _add_preload(mj: mujoco.MjSpec, spec: RobotSpec, numerics: Numerics) -> None:
    """Press each axle down with a constant force along the world's z."""
    mj.worldbody.add_site(mj.find_default(ROOT), name="origin")
    for i, force in enumerate(preload_force(spec, numerics).sum(axis=1), start=1):
        g = spec.geometry
        mj.body(f"connector_{i}").add_site(
            mj.find_default(ROOT), name=f"axle_{i}", pos=[0, 0, g.wheel_radius - g.com_height]
        )
        actuator = mj.add_actuator(
            mj.find_default("press"), name=f"press_{i}", target=f"axle_{i}",
            trntype=mujoco.mjtTrn.mjTRN_SITE, refsite="origin",
        )  # fmt: skip
        actuator.biasprm[0] = -force


def _add_home(mj: mujoco.MjSpec) -> None:
    """Add keyframe ``home``: straight, at rest, wheels on the floor, chambers empty."""
    root = mj.body("connector_1")
    others = [0.0] * (len(mj.joints) - 1)  # each of them a hinge
    mj.add_key(name="home", qpos=[*root.pos, 1, 0, 0, 0, *others], ctrl=[0.0] * len(mj.actuators))
