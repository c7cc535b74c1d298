"""Default classes of the MJCF: what all hinges, wheels or muscles of a robot have in common, said once.

Elements name their class and state only what is their own: a name, a place, and what depends on the mass of
their connector (axle friction, preload).
"""

from __future__ import annotations

import math

import mujoco

from srs_twin.plants.twin.mjcf.numerics import Contact, ModelSettings, PreloadedContact
from srs_twin.robot.spec import RobotSpec

ROOT = "snake"
_SOFT, _HARD, _RUBBER = [0.93, 0.66, 0.42, 1], [0.2, 0.23, 0.28, 1], [0.07, 0.07, 0.08, 1]
_DRAWN, _TOUCHING, _HIDDEN = 2, 3, 5  # geom and site groups; viewers show 0 to 2
_FLANGE = 1.08  # radius of a connector's disc over that of the body
_RUNNER = 0.25  # radius of a skid's runner over that of a wheel
_CLEARANCE = 0.001  # m, of the drawn body above the floor


def add_classes(mj: mujoco.MjSpec, spec: RobotSpec, settings: ModelSettings, *, limit_pa: float) -> None:
    """Add the classes of a robot.

    Args:
        mj: the model to add them to.
        spec: the robot.
        settings: time step, discretisation, wheels.
        limit_pa: upper end of the chambers' controls, Pa.
    """
    root = mj.add_default(ROOT, mj.default)
    root.geom.contype = root.geom.conaffinity = 0
    root.geom.mass = 0
    root.site.group = _HIDDEN
    _add_joints(mj, root, spec, settings)
    _add_geoms(mj, root, spec, settings)
    muscle = mj.add_default("muscle", root).actuator
    muscle.ctrllimited, muscle.ctrlrange = True, [0, limit_pa]
    muscle.gainprm[0] = spec.bending.stiffness * spec.actuator.gain
    press = mj.add_default("press", root).actuator
    press.gear = [0, 0, 1, 0, 0, 0]
    press.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    press.gainprm[0] = 0.0
    press.ctrllimited, press.ctrlrange = True, [0, 1]
    if spec.friction.drag > 0.0:
        most = spec.friction.drag / spec.geometry.connectors
        drag = mj.add_default("drag", root).actuator
        drag.gear = [1, 0, 0, 0, 0, 0]
        drag.biastype, drag.gainprm[0] = mujoco.mjtBias.mjBIAS_AFFINE, 0.0
        # In step with its speed below the slip speed: the integrator takes that much implicitly.
        drag.biasprm[2] = -most / settings.contact.slip_speed
        drag.forcelimited, drag.forcerange = True, [-most, most]
        drag.ctrllimited, drag.ctrlrange = True, [0, 1]


def foot_radius(spec: RobotSpec, contact: Contact) -> float:
    """Return the radius of the spheres that touch the floor: wheels or the lower ends of runners, m."""
    return spec.geometry.wheel_radius * (1.0 if contact.rolling else _RUNNER)


def drawn_radius(spec: RobotSpec) -> float:
    """Return the radius of the drawn body, m."""
    return spec.geometry.width / 2.5


def drawn_height(spec: RobotSpec) -> float:
    """Return how far above the centres of mass the body is drawn, m: a thick one must not sink in."""
    return max(0.0, round(drawn_radius(spec) * _FLANGE + _CLEARANCE - spec.geometry.com_height, 6))


def _add_joints(mj: mujoco.MjSpec, root: mujoco.MjsDefault, spec: RobotSpec, settings: ModelSettings) -> None:
    """Add the joints' classes.

    The integrator takes a spring at the end of its step, which damps like h·k besides; that much is taken
    off the dampers, so that spring and damper act together as stated.
    """
    bending = spec.bending
    for name, axis, stiffness, time in (
        ("hinge", [0, 0, -1], settings.hinges_per_segment * bending.stiffness, bending.damping_time),
        ("pitch", [0, 1, 0], bending.pitch_stiffness, bending.out_of_plane_damping_time),
        ("roll", [1, 0, 0], bending.roll_stiffness, bending.out_of_plane_damping_time),
    ):
        joint = mj.add_default(name, root).joint
        joint.axis = axis
        joint.stiffness[0] = stiffness
        joint.damping[0] = stiffness * (time - settings.timestep)
    contact = settings.contact
    if isinstance(contact, PreloadedContact) and contact.rolling:
        axle = mj.add_default("axle", root).joint
        axle.axis = [0, 1, 0]
        axle.solref_friction = [contact.axle_time, 1]


def _add_geoms(mj: mujoco.MjSpec, root: mujoco.MjsDefault, spec: RobotSpec, settings: ModelSettings) -> None:
    _add_feet(mj, root, spec, settings)
    upright = [math.sqrt(0.5), 0, math.sqrt(0.5), 0]
    skin, plate = mj.add_default("skin", root).geom, mj.add_default("plate", root).geom
    skin.type, skin.size = mujoco.mjtGeom.mjGEOM_CAPSULE, [drawn_radius(spec), 0, 0]
    plate.type, plate.size = mujoco.mjtGeom.mjGEOM_CYLINDER, [_FLANGE * drawn_radius(spec), 0.003, 0]
    skin.rgba, plate.rgba, plate.quat = _SOFT, _HARD, upright
    skin.group = plate.group = _DRAWN


def _add_feet(mj: mujoco.MjSpec, root: mujoco.MjsDefault, spec: RobotSpec, settings: ModelSettings) -> None:
    """Add class ``tread``, what touches the floor: the runner of a skid, or a sphere drawn as a ``rim``."""
    tread = mj.add_default("tread", root).geom
    tread.size = [foot_radius(spec, settings.contact), 0, 0]
    if not settings.contact.rolling:
        tread.type, tread.group, tread.rgba = mujoco.mjtGeom.mjGEOM_CAPSULE, _DRAWN, _RUBBER
        return
    tread.type, tread.group = mujoco.mjtGeom.mjGEOM_SPHERE, _TOUCHING
    radius, across = spec.geometry.wheel_radius, [math.sqrt(0.5), math.sqrt(0.5), 0, 0]
    rim = mj.add_default("rim", root).geom
    rim.type, rim.size, rim.quat = mujoco.mjtGeom.mjGEOM_CYLINDER, [radius, 0.2 * radius, 0], across
    rim.rgba, rim.group = _RUBBER, _DRAWN
