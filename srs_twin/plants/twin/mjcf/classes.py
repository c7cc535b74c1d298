"""MJCF default classes with common properties of joints, geoms and actuators."""

from __future__ import annotations

import math

import mujoco

from srs_twin.plants.twin.mjcf.numerics import (
    Contact,
    ModelSettings,
    PreloadedContact,
    stated,
)
from srs_twin.robot.spec import RobotSpec

ROOT = "snake"
"""Name of the default class from which all other classes of a robot inherit."""

# Colours, RGBA.
_SILICONE = [0.93, 0.66, 0.42, 1]
_PLASTIC = [0.2, 0.23, 0.28, 1]
_RUBBER = [0.07, 0.07, 0.08, 1]

# Groups of geoms and sites. By default, viewers show groups 0 to 2.
_VISUAL_GROUP = 2
_COLLISION_GROUP = 3
_HIDDEN_GROUP = 5

# Limit of the free bend of a spatial robot, far above any real bend, rad.
_MAX_FREE_BEND = 100.0
_FLANGE_RATIO = 1.08  # Radius of a connector's disc, relative to the body's radius.
_RUNNER_RATIO = 0.25  # Radius of a skid's runner, relative to the radius of a wheel.
# Half height of a connector's disc at a length unit of 1, m.
_PLATE_HALF_HEIGHT = 0.003
# Height of the drawn body above the floor at a length unit of 1, m.
_DRAWN_CLEARANCE = 0.001


def add_classes(
    mj: mujoco.MjSpec, spec: RobotSpec, settings: ModelSettings, *, limit_pa: float
) -> None:
    """Add the default classes of a robot to a model."""
    root = mj.add_default(ROOT, mj.default)
    root.geom.contype = root.geom.conaffinity = 0
    root.geom.mass = 0
    root.site.group = _HIDDEN_GROUP
    _add_joints(mj, root, spec, settings)
    _add_geoms(mj, root, spec, settings)
    muscle = mj.add_default("muscle", root).actuator
    muscle.ctrllimited = True
    muscle.ctrlrange = [0, limit_pa]
    if spec.is_spatial:  # the controls are free bends, which the chambers limit
        muscle.ctrlrange = [-_MAX_FREE_BEND, _MAX_FREE_BEND]
    muscle.gainprm[0] = spec.bending.stiffness * spec.actuator.gain
    press = mj.add_default("press", root).actuator
    press.gear = [0, 0, 1, 0, 0, 0]
    press.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    press.gainprm[0] = 0.0
    press.ctrllimited = True
    press.ctrlrange = [0, 1]
    if spec.friction.drag > 0.0:
        limit = spec.friction.drag / spec.geometry.connectors
        drag = mj.add_default("drag", root).actuator
        drag.gear = [1, 0, 0, 0, 0, 0]
        drag.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        drag.gainprm[0] = 0.0
        # Up to the slip speed, the drag is proportional to the speed and is integrated
        # implicitly. Above the slip speed, the drag is constant.
        drag.biasprm[2] = -limit / stated(settings.contact.slip_speed)
        drag.forcelimited = True
        drag.forcerange = [-limit, limit]
        drag.ctrllimited = True
        drag.ctrlrange = [0, 1]


def foot_radius(spec: RobotSpec, contact: Contact) -> float:
    """Return the radius of the spheres or runner ends that touch the floor, m."""
    return spec.geometry.wheel_radius * (1.0 if contact.rolling else _RUNNER_RATIO)


def drawn_radius(spec: RobotSpec) -> float:
    """Return the radius with which viewers draw the body, m."""
    return spec.geometry.width / 2.5


def drawn_height(spec: RobotSpec) -> float:
    """Return the height at which viewers draw the body above the centres of mass, m."""
    unit = spec.scale.length
    height = (
        drawn_radius(spec) * _FLANGE_RATIO
        + _DRAWN_CLEARANCE * unit
        - spec.geometry.com_height
    )
    return max(0.0, round(height / unit, 6) * unit)


def _add_joints(
    mj: mujoco.MjSpec, root: mujoco.MjsDefault, spec: RobotSpec, settings: ModelSettings
) -> None:
    # The integrator evaluates a spring with stiffness k at the end of a step of length
    # h, which acts as additional damping h k. The damping coefficients are therefore
    # reduced by h k.
    bending = spec.bending
    n = settings.hinges_per_segment
    joints: list[tuple[str, list[float], float, float]] = [
        ("hinge", [0, 0, -1], n * bending.stiffness, bending.damping_time),
        (
            "pitch",
            [0, 1, 0],
            bending.pitch_stiffness,
            bending.out_of_plane_damping_time,
        ),
        ("roll", [1, 0, 0], bending.roll_stiffness, bending.out_of_plane_damping_time),
    ]
    if spec.is_spatial:
        joints[1] = (
            "tilt",
            [0, 1, 0],
            n * bending.pitch_stiffness,
            bending.damping_time,
        )
        if spec.actuator.extension:
            joints.append(
                ("stretch", [-1, 0, 0], spec.axial_stiffness, bending.damping_time)
            )
    for name, axis, stiffness, time in joints:
        joint = mj.add_default(name, root).joint
        joint.axis = axis
        if name == "stretch":
            joint.type = mujoco.mjtJoint.mjJNT_SLIDE
        joint.stiffness[0] = stiffness
        joint.damping[0] = stiffness * (time - settings.timestep)
    contact = settings.contact
    if isinstance(contact, PreloadedContact) and contact.rolling:
        axle = mj.add_default("axle", root).joint
        axle.axis = [0, 1, 0]
        axle.solref_friction = [stated(contact.axle_time), 1]


def _add_geoms(
    mj: mujoco.MjSpec, root: mujoco.MjsDefault, spec: RobotSpec, settings: ModelSettings
) -> None:
    _add_feet(mj, root, spec, settings)
    upright = [math.sqrt(0.5), 0, math.sqrt(0.5), 0]
    skin = mj.add_default("skin", root).geom
    plate = mj.add_default("plate", root).geom
    skin.type = mujoco.mjtGeom.mjGEOM_CAPSULE
    skin.size = [drawn_radius(spec), 0, 0]
    plate.type = mujoco.mjtGeom.mjGEOM_CYLINDER
    plate.size = [
        _FLANGE_RATIO * drawn_radius(spec),
        _PLATE_HALF_HEIGHT * spec.scale.length,
        0,
    ]
    skin.rgba = _SILICONE
    plate.rgba = _PLASTIC
    plate.quat = upright
    skin.group = plate.group = _VISUAL_GROUP


def _add_feet(
    mj: mujoco.MjSpec, root: mujoco.MjsDefault, spec: RobotSpec, settings: ModelSettings
) -> None:
    tread = mj.add_default("tread", root).geom
    tread.size = [foot_radius(spec, settings.contact), 0, 0]
    if not settings.contact.rolling:
        tread.type = mujoco.mjtGeom.mjGEOM_CAPSULE
        tread.group = _VISUAL_GROUP
        tread.rgba = _RUBBER
        return
    tread.type = mujoco.mjtGeom.mjGEOM_SPHERE
    tread.group = _COLLISION_GROUP
    radius = spec.geometry.wheel_radius
    across = [math.sqrt(0.5), math.sqrt(0.5), 0, 0]
    rim = mj.add_default("rim", root).geom
    rim.type = mujoco.mjtGeom.mjGEOM_CYLINDER
    rim.size = [radius, 0.2 * radius, 0]
    rim.quat = across
    rim.rgba = _RUBBER
    rim.group = _VISUAL_GROUP
