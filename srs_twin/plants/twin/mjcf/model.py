"""RobotSpec → MuJoCo model: the chain of connectors and segments on a floor.

The robot is a free-floating chain in three dimensions, built in both directions from
its middle connector. A connector is a body with two feet on the floor (`wheels`), or
the whole body lies on the floor (`belly`). A segment is a chain of n equal bending
hinges with the stiffness n k and the damping n c each, in series k and c, with one
pitch and one roll hinge in its middle, which distribute the load of the floor. The
chamber pressures are the controls, in Pa: the actuators ``plus_j`` and ``minus_j``
exert the moment k G (p⁺ − p⁻) on the tendon ``bend_j``, whose length is the bend q_j of
the segment.

A spatial robot has a tilt hinge at each bending hinge, which turns the head end
upwards, and no pitch hinge. The two hinges of a place are in the opposite order at
every second place, so that the twist which a pair of rotations about two axes contains
cancels. The actuators ``air_left_j`` and ``air_up_j`` exert k times the free bend,
which is their control, on the tendons ``bend_j`` and ``tilt_j``. With
`Actuator.extension` the link in the middle of a segment has a slide joint ``stretch_j``
with the axial stiffness of a solid round section, and the actuator ``air_along_j``
exerts this stiffness times the free extension.

With a clamped base (`ModelSettings.base`) the head is fixed to the world. There is no
floor, so the model has no wheels and no preload. It has no pitch and roll hinges
either: the chain bends in the horizontal plane, in which gravity does no work.
"""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco import MjsBody, MjsJoint, MjSpec

from srs_twin.errors import InputError
from srs_twin.plants.twin.mjcf.belly import add_belly, root_connector
from srs_twin.plants.twin.mjcf.classes import add_classes, drawn_height
from srs_twin.plants.twin.mjcf.numerics import (
    MAX_STEP_RATIO,
    LoadedContact,
    ModelSettings,
    PreloadedContact,
    hinge_stations,
)
from srs_twin.plants.twin.mjcf.surroundings import (
    add_hull_class,
    add_objects,
    add_obstacles,
    add_steps,
    add_surroundings,
)
from srs_twin.plants.twin.mjcf.wheels import (
    add_contacts,
    add_drag,
    add_feet,
    add_preload,
    add_wheels,
    fixed_inertia,
)
from srs_twin.robot.spec import GRAVITY, RobotSpec
from srs_twin.robot.world import World


def robot_mjcf(
    spec: RobotSpec,
    settings: ModelSettings,
    *,
    supply_pa: float | None = None,
    obstacle_friction: float | None = None,
) -> MjSpec:
    """Build the robot without floor: bodies, joints, tendons and actuators.

    Args:
        spec: the robot.
        settings: time step, discretisation, contact.
        supply_pa: upper limit of the controls, Pa; at least the limits of the robot are
            used.
        obstacle_friction: friction coefficient of hulls that touch obstacles
            (`surroundings`), 1; None for a body without hulls.

    Raises:
        InputError: the time step is too long for the damping time of the segments, or
            the contact is preloaded and the robot has a skin or a tail on two axles.
    """
    if spec.tail is not None and not isinstance(settings.contact, LoadedContact):
        raise InputError(
            "a tail on two axles needs contact 'loaded', because a preload would keep"
            " it down"
        )
    if spec.skin is not None and not isinstance(settings.contact, LoadedContact):
        raise InputError(
            "a robot with skin needs contact 'loaded'; a preload presses on wheels or"
            " skids"
        )
    if settings.numerics.constant_curvature:
        spec.require_planar("numerics 'constant_curvature'")
    if spec.actuator.extension and settings.hinges_per_segment < 2:
        raise InputError(
            "hinges_per_segment: 1 is not allowed for segments that lengthen; use 2 or"
            " more"
        )
    shortest = min(spec.bending.damping_time, spec.bending.out_of_plane_damping_time)
    if not settings.timestep < MAX_STEP_RATIO * shortest:
        raise InputError(
            f"time step {settings.timestep:g} s is too long for segments with a damping"
            f" time c/k of {shortest:g} s; it must be below {MAX_STEP_RATIO:g} times"
            " that"
        )
    _check_inertia(spec, settings)
    settings = settings.for_robot(spec)
    mj = MjSpec()
    mj.modelname = spec.name
    mj.compiler.degree = False
    mj.compiler.autolimits = True
    _set_options(mj, settings)
    limit = max(
        spec.supply.continuous_limit, spec.supply.pulsed_limit, supply_pa or 0.0
    )
    add_classes(mj, spec, settings, limit_pa=limit)
    if obstacle_friction is not None:
        add_hull_class(mj, spec, settings, obstacle_friction)
    free = settings.base == "free"
    middle = root_connector(spec) if free else 1
    x = spec.geometry.body_length / 2 - (middle - 1) * spec.geometry.pitch
    root = mj.worldbody.add_body(
        name=f"connector_{middle}", pos=[x, 0, spec.geometry.com_height]
    )
    if free:
        root.add_freejoint(name="root")
    _add_connector(mj, root, spec, middle, settings)
    for step, end in ((1, spec.geometry.connectors), (-1, 1)):
        body = root
        for i in range(middle, end, step):
            body = _add_segment(mj, body, spec, i, i + step, settings)
            _add_connector(mj, body, spec, i + step, settings)
    if spec.skin is not None:
        add_belly(mj, spec, settings)
    for j in range(1, spec.segments + 1):
        _add_actuators(mj, spec, j, settings)
        if settings.numerics.constant_curvature:
            _constrain_curvature(mj, j, settings)
    if free:
        if isinstance(settings.contact, PreloadedContact):
            add_preload(mj, spec, settings.contact)
        if spec.friction.drag > 0.0:
            add_drag(mj, spec)
        if spec.skin is None:
            add_feet(mj, spec)
    _add_home_keyframe(mj)
    return mj


def scene_mjcf(
    spec: RobotSpec,
    settings: ModelSettings,
    *,
    supply_pa: float | None = None,
    world: World | None = None,
) -> MjSpec:
    """Build the robot on a floor with obstacles and objects, contact pairs and sensors (world frame, N).

    Args:
        spec: the robot.
        settings: time step, discretisation, contact.
        supply_pa: as in `robot_mjcf`.
        world: floor and obstacles; None for a level floor without obstacles.
    """
    world = world or World()
    friction = world.friction if world.is_solid else None
    mj = robot_mjcf(spec, settings, supply_pa=supply_pa, obstacle_friction=friction)
    mj.option.gravity = [GRAVITY * share for share in world.floor.down]
    add_surroundings(mj, spec.geometry.body_length)
    if world.is_solid:
        add_obstacles(mj, spec, world)
    add_objects(mj, spec, settings, world)
    levels = add_steps(mj, world.steps, spec)
    if settings.base == "free":
        add_contacts(mj, spec, settings, levels)
    mj.add_sensor(name="kinetic_energy", type=mujoco.mjtSensor.mjSENS_E_KINETIC)
    return mj


def _set_options(mj: MjSpec, settings: ModelSettings) -> None:
    option = mj.option
    option.timestep = settings.timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # A dense Jacobian is slow with friction rows. Normal forces alone are few: the
    # engine selects by size.
    loaded = settings.loaded
    if loaded:
        option.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
    else:
        option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    option.impratio = 1
    option.iterations = 50
    # Under loaded contact, errors of 1e-7 in the loads push stopping wheels sideways,
    # in a direction that depends on the processor. With the engine's own friction, a
    # tolerance of 1e-7 changes gait speeds by 2e-7 and leaves less than 1e-5 m/s at
    # rest.
    option.tolerance = 1e-12 if loaded else 1e-7
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def _set_link_inertia(
    body: MjsBody,
    spec: RobotSpec,
    mass: float,
    extra: tuple[float, object] = (0.0, 0.0),
    x: float = 0.0,
) -> None:
    """Set mass and inertia of a body with the gyration of a connector.

    Args:
        body: in place.
        spec: the robot.
        mass: kg.
        extra: mass (kg) and moments of inertia (kg·m²) of parts that are fixed to the
            body.
        x: centre of mass along the body's x axis, m.
    """
    body.mass = mass + extra[0]
    body.ipos = [x, 0, 0]  # the default of MjSpec would be the body's `pos`
    body.inertia = np.full(3, mass * spec.connector_gyration**2) + extra[1]
    body.explicitinertial = True


def _check_inertia(spec: RobotSpec, settings: ModelSettings) -> None:
    """Refuse a robot whose lightest body MuJoCo would take as massless."""
    if settings.hinges_per_segment > 1:
        lightest = _link_mass(spec, settings)
    else:
        lightest = min(spec.mass.connectors)
    moments = [spec.connector_gyration**2 * lightest]
    if isinstance(settings.contact, PreloadedContact) and settings.contact.rolling:
        moments.append(spec.mass.wheel * spec.geometry.wheel_radius**2 / 4)
    if not (smallest := min(moments)) > mujoco.mjMINVAL:
        raise InputError(
            f"a body of {spec.name} has a moment of inertia of {smallest:.2g} kg·m²;"
            f" MuJoCo needs more than {mujoco.mjMINVAL:g} kg·m², so the robot is too"
            " small for the twin"
        )


def _link_mass(spec: RobotSpec, settings: ModelSettings) -> float:
    """Return the mass of one link between two hinges, kg; it is subtracted from the connectors."""
    links = settings.hinges_per_segment - 1
    share = settings.numerics.link_share * min(spec.mass.connectors)
    if links:
        return share / links
    return 0.0


def _add_connector(
    mj: MjSpec, body: MjsBody, spec: RobotSpec, i: int, settings: ModelSettings
) -> None:
    g = spec.geometry
    mass = spec.mass.connectors[i - 1]
    body.add_geom(
        mj.find_default("plate"), name=f"plate_{i}", pos=[0, 0, drawn_height(spec)]
    )
    if spec.skin is not None:
        return  # see `belly`
    neighbours = (i > 1) + (i < g.connectors)
    links = (
        neighbours / 2 * (settings.hinges_per_segment - 1) * _link_mass(spec, settings)
    )
    if spec.tail is not None and i == g.connectors:
        body.mass = mass - links
        body.inertia = np.full(3, mass * spec.tail.gyration**2)
        body.ipos = [-spec.tail.com, 0, spec.tail.com_height - g.com_height]
        body.explicitinertial = True
    else:
        _set_link_inertia(
            body,
            spec,
            mass - 2 * spec.mass.wheel - links,
            fixed_inertia(spec, settings),
        )
    if settings.base == "free":
        add_wheels(mj, body, spec, i, settings)


def _add_segment(
    mj: MjSpec,
    body: MjsBody,
    spec: RobotSpec,
    near: int,
    far: int,
    settings: ModelSettings,
) -> MjsBody:
    """Add the segment between two neighbouring connectors; return the body of the far connector.

    Each hinge carries the body beyond it; the last hinge carries the far connector.
    Stations are distances from the near connector along the straight segment. Names
    count from the head in both directions.

    Args:
        mj: model, in place.
        body: body of the near connector.
        spec: the robot.
        near: number of the near connector.
        far: number of the far connector.
        settings: discretisation.
    """
    g = spec.geometry
    n = settings.hinges_per_segment
    j = min(near, far)
    ahead = near - far  # direction along x, ±1
    names = [f"{j}_{k}" for k in range(n + 1)][
        ::-ahead
    ]  # of the links between the hinges
    hinges = hinge_stations(n, g.segment_length, g.rigid_gap)
    origins = np.append(hinges[:-1], g.pitch)
    _add_skin(mj, body, spec, f"skin_{names[0]}", 0.0, ahead * hinges[0])
    parent_origin = 0.0
    for k in range(n):
        last = k == n - 1
        name = f"connector_{far}" if last else f"link_{names[k + 1]}"
        body = body.add_body(
            name=name, pos=[ahead * (origins[k] - parent_origin), 0, 0]
        )
        parent_origin = origins[k]
        anchor = ahead * (hinges[k] - origins[k])
        if (
            k == n // 2 and spec.actuator.extension
        ):  # first, along the link in front of it
            _add_joint(mj, body, "stretch", f"stretch_{j}", anchor, ahead)
        number = k + 1 if ahead < 0 else n - k
        if spec.is_spatial:
            kinds = ["hinge", "tilt"][:: 1 if k % 2 == 0 else -1]
        else:
            kinds = ["hinge"]
        for kind in kinds:
            hinge = _add_joint(mj, body, kind, f"{kind}_{j}_{number}", anchor, ahead)
            if kind == "hinge":
                hinge.springref = spec.modules.bias[j - 1] / n
        if k == n // 2 and (settings.base == "free" or spec.is_spatial):
            for kind in ("roll",) if spec.is_spatial else ("pitch", "roll"):
                _add_joint(
                    mj,
                    body,
                    kind,
                    f"{kind}_{j}",
                    ahead * (g.pitch / 2 - origins[k]),
                    ahead,
                )
        if last:
            _add_skin(mj, body, spec, f"skin_{names[k + 1]}", anchor, 0.0)
        else:
            end = ahead * (hinges[k + 1] - hinges[k])
            if spec.skin is None:
                _set_link_inertia(body, spec, _link_mass(spec, settings), x=end / 2)
            _add_skin(mj, body, spec, f"skin_{names[k + 1]}", 0.0, end)
    return body


def _add_joint(
    mj: MjSpec, body: MjsBody, kind: str, name: str, x: float, ahead: int
) -> MjsJoint:
    """Add a joint at x (m); ahead of the root its axis is reversed, so that its sign stays the same."""
    joint = body.add_joint(mj.find_default(kind), name=name, pos=[x, 0, 0])
    if ahead > 0:
        joint.axis = [-component for component in joint.axis]
    return joint


def _add_skin(
    mj: MjSpec, body: MjsBody, spec: RobotSpec, name: str, front: float, back: float
) -> None:
    """Add the drawn body, and its hull if there is one, between two stations of a body's x axis (m)."""
    z = drawn_height(spec)
    body.add_geom(mj.find_default("skin"), name=name, fromto=[front, 0, z, back, 0, z])
    if hull := mj.find_default("hull"):
        body.add_geom(
            hull, name=name.replace("skin", "hull"), fromto=[front, 0, 0, back, 0, 0]
        )


def _add_actuators(
    mj: MjSpec, spec: RobotSpec, j: int, settings: ModelSettings
) -> None:
    """Add the tendon ``bend_j`` and the actuators of its two chambers, or those of a spatial robot."""
    if spec.is_spatial:
        for name, hinge, axis in (("bend", "hinge", "left"), ("tilt", "tilt", "up")):
            tendon = mj.add_tendon(name=f"{name}_{j}")
            for k in range(1, settings.hinges_per_segment + 1):
                tendon.wrap_joint(f"{hinge}_{j}_{k}", 1.0)
            actuator = mj.add_actuator(
                mj.find_default("muscle"), name=f"air_{axis}_{j}", target=tendon.name
            )
            actuator.trntype = mujoco.mjtTrn.mjTRN_TENDON
            if name == "bend":
                stiffness = spec.bending.stiffness
            else:
                stiffness = spec.bending.pitch_stiffness
            actuator.gainprm[0] = stiffness
        if spec.actuator.extension:
            actuator = mj.add_actuator(
                mj.find_default("muscle"), name=f"air_along_{j}", target=f"stretch_{j}"
            )
            actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
            actuator.gainprm[0] = spec.axial_stiffness
        return
    tendon = mj.add_tendon(name=f"bend_{j}")
    for k in range(1, settings.hinges_per_segment + 1):
        tendon.wrap_joint(f"hinge_{j}_{k}", 1.0)
    for name, sign, gain in zip(
        ("plus", "minus"), (1, -1), spec.modules.gain[j - 1], strict=True
    ):
        actuator = mj.add_actuator(
            mj.find_default("muscle"), name=f"{name}_{j}", target=tendon.name
        )
        actuator.trntype = mujoco.mjtTrn.mjTRN_TENDON
        actuator.gainprm[0] *= sign * gain


def _constrain_curvature(mj: MjSpec, j: int, settings: ModelSettings) -> None:
    """Constrain all hinges of segment j to the angle of the first one."""
    for k in range(2, settings.hinges_per_segment + 1):
        arc = mj.add_equality(name=f"arc_{j}_{k}", type=mujoco.mjtEq.mjEQ_JOINT)
        arc.name1 = f"hinge_{j}_{k}"
        arc.name2 = f"hinge_{j}_1"
        arc.solref = [2 * settings.timestep, 1]
        arc.solimp = [0.999, 0.999, 0.001, 0.5, 2]
        arc.data[:5] = [0, 1, 0, 0, 0]


def _add_home_keyframe(mj: MjSpec) -> None:
    """Add the keyframe ``home``: straight, at rest, wheels on the floor, chambers empty."""
    root = mj.worldbody.first_body()
    free = any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in mj.joints)
    pose, hinges = (
        ([*root.pos, 1, 0, 0, 0], len(mj.joints) - 1) if free else ([], len(mj.joints))
    )
    mj.add_key(
        name="home", qpos=[*pose, *[0.0] * hinges], ctrl=[0.0] * len(mj.actuators)
    )
