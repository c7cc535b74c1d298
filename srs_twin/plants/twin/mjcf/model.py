"""MuJoCo model of a robot, which is a chain of connectors and segments.

The chain has a free joint and is built in both directions from its middle connector. A
connector is a body with two feet on the floor (`wheels`). A robot with skin lies on the
floor with its whole body (`belly`).

A segment with stiffness k and damping c is a chain of n equal bending hinges, each with
stiffness n k and damping n c. A pitch hinge and a roll hinge in the middle of the
segment distribute the floor load among the connectors. The controls are the chamber
pressures p⁺ and p⁻, in Pa. The actuators ``plus_j`` and ``minus_j`` act on the tendon
``bend_j``, whose length is the bend q_j of segment j. Together they exert the moment k
G (p⁺ − p⁻) with the gain G.

A spatial robot has tilt hinges instead of pitch hinges. Each bending hinge is paired
with a tilt hinge, which rotates the front of the segment upwards. The order of the two
hinges alternates along the segment, so that the twists due to successive rotations
about different axes cancel. The actuators ``air_left_j`` and ``air_up_j`` act on the
tendons ``bend_j`` and ``tilt_j``. Their controls are the free bends, and their moments
are the free bends times the bending stiffnesses. If the robot has an
`Actuator.extension`, the middle of each segment has a slide joint ``stretch_j`` with
the axial stiffness of a solid round section. The actuator ``air_along_j`` exerts this
stiffness times the free extension.

With a clamped base (`ModelSettings.base`), the head is fixed to the world. The model
then has no wheels, floor contacts or preload. A clamped planar robot has no pitch and
roll hinges either, because it bends in the horizontal plane, in which gravity does no
work.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import MjsActuator, MjsBody, MjsJoint, MjSpec, mjtTrn

from srs_twin.plants.twin.mjcf.belly import add_belly, root_connector
from srs_twin.plants.twin.mjcf.classes import add_classes, drawn_height
from srs_twin.plants.twin.mjcf.numerics import (
    ModelSettings,
    PreloadedContact,
    bend_joints,
    hinge_stations,
)
from srs_twin.plants.twin.mjcf.rules import check
from srs_twin.plants.twin.mjcf.surroundings import (
    add_collision_class,
    add_objects,
    add_obstacles,
    add_steps,
    add_surroundings,
)
from srs_twin.plants.twin.mjcf.wheels import (
    FixedInertia,
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
    """Build the bodies, joints, tendons and actuators of a robot, without the floor.

    Args:
        spec: robot to build.
        settings: time step, discretisation and contact.
        supply_pa: upper limit of the pressure controls, unless the robot has higher
            pressure limits, Pa.
        obstacle_friction: friction coefficient of the collision geoms that touch
            obstacles (`surroundings`), dimensionless. By default, the body has no
            collision geoms.

    Raises:
        InputError: the twin does not support the robot with these settings (`rules`).
    """
    check(spec, settings, World())
    settings = settings.for_robot(spec)
    mj = MjSpec()
    mj.modelname = spec.name
    mj.compiler.degree = False
    mj.compiler.autolimits = True
    _set_options(mj, settings)
    supply = spec.supply
    limit = max(supply.continuous_limit, supply.pulsed_limit, supply_pa or 0.0)
    add_classes(mj, spec, settings, limit_pa=limit)
    if obstacle_friction is not None:
        add_collision_class(mj, spec, settings, obstacle_friction)
    chain = _Chain(mj, spec, settings)
    chain.add_bodies()
    if spec.skin is not None:
        add_belly(mj, spec, settings)
    for j in range(1, spec.segments + 1):
        if spec.is_spatial:
            chain.add_spatial_actuators(j)
        else:
            chain.add_planar_actuators(j)
        if settings.numerics.constant_curvature:
            _constrain_curvature(mj, j, settings)
    if settings.base == "free":
        _add_forces_of_floor(mj, spec, settings)
    _add_home_keyframe(mj)
    return mj


def scene_mjcf(
    spec: RobotSpec,
    settings: ModelSettings,
    *,
    supply_pa: float | None = None,
    world: World | None = None,
) -> MjSpec:
    """Build a robot on a floor, with obstacles, objects, contact pairs and sensors.

    All force sensors report the force in the world frame, N.

    Args:
        spec: robot to build.
        settings: time step, discretisation and contact.
        supply_pa: upper limit of the pressure controls, as in `robot_mjcf`, Pa.
        world: floor, obstacles and objects. The default is a level floor without
            obstacles.

    Raises:
        InputError: the twin does not support the combination of arguments (`rules`).
    """
    world = world or World()
    check(spec, settings, world)
    friction = world.friction if world.is_solid else None
    mj = robot_mjcf(spec, settings, supply_pa=supply_pa, obstacle_friction=friction)
    mj.option.gravity = [GRAVITY * fraction for fraction in world.floor.down]
    add_surroundings(mj, spec.geometry.body_length)
    if world.is_solid:
        add_obstacles(mj, spec, world)
    if world.objects:
        add_objects(mj, spec, world)
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
    option.impratio = 1
    option.iterations = 50
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if settings.loaded:
        # The engine may choose between a dense and a sparse Jacobian, because the
        # number of constraints is small. The tolerance is strict, because errors of
        # 1e-7 in the normal forces would push stopping wheels sideways, in a direction
        # that depends on the CPU.
        option.jacobian = mujoco.mjtJacobian.mjJAC_AUTO
        option.tolerance = 1e-12
    else:
        # A dense Jacobian would be slow, because friction adds many constraints. A
        # tolerance of 1e-7 changes gait speeds by 2e-7 and leaves a residual speed of
        # less than 1e-5 m/s at rest.
        option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
        option.tolerance = 1e-7


@dataclass(frozen=True)
class _Chain:
    """Builder of the chain of connectors and segments in a model.

    The argument `ahead` is the building direction along the x axis, 1 in front of the
    root and −1 behind it. Connectors, segments and hinges are numbered from the head.
    """

    mj: MjSpec
    spec: RobotSpec
    settings: ModelSettings

    def add_bodies(self) -> None:
        g = self.spec.geometry
        free = self.settings.base == "free"
        middle = root_connector(self.spec) if free else 1
        x = g.body_length / 2 - (middle - 1) * g.pitch
        root = self.mj.worldbody.add_body(
            name=f"connector_{middle}", pos=[x, 0, g.com_height]
        )
        if free:
            root.add_freejoint(name="root")
        self._fill_connector(root, middle)
        for step, end in ((1, g.connectors), (-1, 1)):
            body = root
            for i in range(middle, end, step):
                body = self._add_segment(body, i, i + step)
                self._fill_connector(body, i + step)

    def _fill_connector(self, body: MjsBody, i: int) -> None:
        spec = self.spec
        self._add_geom(body, "plate", name=f"plate_{i}", pos=[0, 0, drawn_height(spec)])
        if spec.skin is not None:
            return  # `belly` sets the inertia and adds the contact points
        mass = spec.mass.connectors[i - 1]
        neighbours = (i > 1) + (i < spec.geometry.connectors)
        links = neighbours / 2 * (self.settings.hinges_per_segment - 1)
        link_mass = links * self.settings.link_mass(spec)
        if spec.tail is not None and i == spec.geometry.connectors:
            height = spec.tail.com_height - spec.geometry.com_height
            body.mass = mass - link_mass
            body.inertia = np.full(3, mass * spec.tail.gyration**2)
            body.ipos = [-spec.tail.com, 0, height]
            body.explicitinertial = True
        else:
            fixed = fixed_inertia(spec, self.settings)
            _set_inertia(body, spec, mass - 2 * spec.mass.wheel - link_mass, fixed)
        if self.settings.base == "free":
            add_wheels(self.mj, body, spec, i, self.settings)

    def _add_segment(self, body: MjsBody, near: int, far: int) -> MjsBody:
        """Add the segment between two connectors and return the far connector."""
        spec = self.spec
        g = spec.geometry
        n = self.settings.hinges_per_segment
        j = min(near, far)
        ahead = near - far
        links = [f"{j}_{k}" for k in range(n + 1)][::-ahead]
        hinges = hinge_stations(n, g.segment_length, g.rigid_gap)
        origins = np.append(hinges[:-1], g.pitch)
        self._add_skin(body, links[0], 0.0, ahead * hinges[0])
        parent_origin = 0.0
        for k in range(n):
            is_last = k == n - 1
            body = body.add_body(
                name=f"connector_{far}" if is_last else f"link_{links[k + 1]}",
                pos=[ahead * (origins[k] - parent_origin), 0, 0],
            )
            parent_origin = origins[k]
            anchor = ahead * (hinges[k] - origins[k])
            in_middle = k == n // 2
            if in_middle and spec.actuator.extension:
                # The slide joint precedes the hinges, so that it acts along the parent
                # link.
                self._add_joint(body, "stretch", f"stretch_{j}", anchor, ahead)
            self._add_hinges(body, j, k, anchor, ahead)
            if in_middle:
                middle = ahead * (g.pitch / 2 - origins[k])
                self._add_joints_out_of_plane(body, j, middle, ahead)
            if is_last:
                self._add_skin(body, links[k + 1], anchor, 0.0)
            else:
                end = ahead * (hinges[k + 1] - hinges[k])
                if spec.skin is None:
                    _set_inertia(body, spec, self.settings.link_mass(spec), x=end / 2)
                self._add_skin(body, links[k + 1], 0.0, end)
        return body

    def _add_hinges(self, body: MjsBody, j: int, k: int, x: float, ahead: int) -> None:
        n = self.settings.hinges_per_segment
        kinds = list(bend_joints(self.spec))
        if k % 2 == 1:
            kinds.reverse()
        number = k + 1 if ahead < 0 else n - k
        for kind in kinds:
            joint = self._add_joint(body, kind, f"{kind}_{j}_{number}", x, ahead)
            if kind == "hinge":
                joint.springref = self.spec.modules.bias[j - 1] / n

    def _add_joints_out_of_plane(
        self, body: MjsBody, j: int, x: float, ahead: int
    ) -> None:
        if self.spec.is_spatial:
            kinds: tuple[str, ...] = ("roll",)
        elif self.settings.base == "free":
            kinds = ("pitch", "roll")
        else:
            kinds = ()
        for kind in kinds:
            self._add_joint(body, kind, f"{kind}_{j}", x, ahead)

    def _add_joint(
        self, body: MjsBody, kind: str, name: str, x: float, ahead: int
    ) -> MjsJoint:
        """Add a joint at position x (m).

        In front of the root, the joint axis is reversed, so that the angle has the same
        sign in both building directions.
        """
        joint = body.add_joint(self.mj.find_default(kind), name=name, pos=[x, 0, 0])
        if ahead > 0:
            joint.axis = [-component for component in joint.axis]
        return joint

    def _add_skin(self, body: MjsBody, name: str, front: float, back: float) -> None:
        z = drawn_height(self.spec)
        self._add_geom(
            body, "skin", name=f"skin_{name}", fromto=[front, 0, z, back, 0, z]
        )
        if self.mj.find_default("collision"):
            self._add_geom(
                body,
                "collision",
                name=f"collision_{name}",
                fromto=[front, 0, 0, back, 0, 0],
            )

    def _add_geom(self, body: MjsBody, kind: str, **attributes: object) -> None:
        body.add_geom(self.mj.find_default(kind), **attributes)

    def add_planar_actuators(self, j: int) -> None:
        tendon = self._add_tendon("bend", "hinge", j)
        left, right = self.spec.modules.gain[j - 1]
        for name, gain in ((f"plus_{j}", left), (f"minus_{j}", -right)):
            self._add_muscle(name, tendon, mjtTrn.mjTRN_TENDON).gainprm[0] *= gain

    def add_spatial_actuators(self, j: int) -> None:
        spec = self.spec
        bend = self._add_tendon("bend", "hinge", j)
        left = self._add_muscle(f"air_left_{j}", bend, mjtTrn.mjTRN_TENDON)
        left.gainprm[0] = spec.bending.stiffness
        tilt = self._add_tendon("tilt", "tilt", j)
        up = self._add_muscle(f"air_up_{j}", tilt, mjtTrn.mjTRN_TENDON)
        up.gainprm[0] = spec.bending.pitch_stiffness
        if spec.actuator.extension:
            along = self._add_muscle(
                f"air_along_{j}", f"stretch_{j}", mjtTrn.mjTRN_JOINT
            )
            along.gainprm[0] = spec.axial_stiffness

    def _add_tendon(self, name: str, hinge: str, j: int) -> str:
        tendon = self.mj.add_tendon(name=f"{name}_{j}")
        for k in range(1, self.settings.hinges_per_segment + 1):
            tendon.wrap_joint(f"{hinge}_{j}_{k}", 1.0)
        return f"{name}_{j}"

    def _add_muscle(self, name: str, target: str, kind: mjtTrn) -> MjsActuator:
        actuator = self.mj.add_actuator(
            self.mj.find_default("muscle"), name=name, target=target
        )
        actuator.trntype = kind
        return actuator


def _set_inertia(
    body: MjsBody,
    spec: RobotSpec,
    mass: float,
    fixed: FixedInertia = FixedInertia(0.0, np.zeros(3)),  # noqa: B008
    x: float = 0.0,
) -> None:
    # The body has the radius of gyration of a connector. `mass` excludes the mass of
    # the parts in `fixed`. `x` is the position of the centre of mass along the x axis
    # (m).
    body.mass = mass + fixed.mass
    body.ipos = [x, 0, 0]  # the default of MjSpec is the body's `pos`
    body.inertia = np.full(3, mass * spec.connector_gyration**2) + fixed.moments
    body.explicitinertial = True


def _add_forces_of_floor(mj: MjSpec, spec: RobotSpec, settings: ModelSettings) -> None:
    if isinstance(settings.contact, PreloadedContact):
        add_preload(mj, spec, settings.contact)
    if spec.friction.drag > 0.0:
        add_drag(mj, spec)
    if spec.skin is None:
        add_feet(mj, spec)


def _constrain_curvature(mj: MjSpec, j: int, settings: ModelSettings) -> None:
    for k in range(2, settings.hinges_per_segment + 1):
        arc = mj.add_equality(name=f"arc_{j}_{k}", type=mujoco.mjtEq.mjEQ_JOINT)
        arc.name1 = f"hinge_{j}_{k}"
        arc.name2 = f"hinge_{j}_1"
        arc.solref = [2 * settings.timestep, 1]
        arc.solimp = [0.999, 0.999, 0.001, 0.5, 2]
        arc.data[:5] = [0, 1, 0, 0, 0]


def _add_home_keyframe(mj: MjSpec) -> None:
    root = mj.worldbody.first_body()
    qpos = [0.0] * len(mj.joints)
    if any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in mj.joints):
        qpos = [*root.pos, 1.0, 0.0, 0.0, 0.0, *qpos[1:]]
    mj.add_key(name="home", qpos=qpos, ctrl=[0.0] * len(mj.actuators))
