"""Surroundings of a snake: floor, sky, light, obstacles and movable objects.

**Obstacles** consist of capsules. A circle is represented by an upright capsule with
the radius of the circle. A polygon has a capsule with a radius of 1 mm along each side,
which enlarges the polygon by 1 mm. Obstacles touch only the collision geoms of the
body. A collision geom is a horizontal capsule with the width of the robot, at the
height of the centres of mass. MuJoCo can therefore compute these contacts in closed
form and in the horizontal plane. The body has collision geoms only in worlds with
obstacles or objects.

**An object** is a cylinder or a box that slides and rotates on the floor but does not
tip over. The MuJoCo body of an object has two slide joints and a hinge about the z
axis. Four support points transmit the weight and the friction of the object to the
floor (`MovableObject.supports`).

The module `object_contacts` computes the friction of objects on the floor and on the
body. MuJoCo computes the normal forces, and the friction of objects on other objects
and on obstacles. In worlds with objects, the collision geoms of the body can also touch
each other. Without these contacts, a tail wrapped around an object could pass through
the rest of the body.
"""

from __future__ import annotations

import math
from itertools import combinations

import mujoco
import numpy as np
from mujoco import mjtGeom, mjtObj

from srs_twin.plants.twin.mjcf.classes import ROOT
from srs_twin.plants.twin.mjcf.numerics import ModelSettings
from srs_twin.plants.twin.mjcf.wheels import add_force_sensor, add_velocity_sensor
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import WALL_M, FloorStep, MovableObject, World

# Bit in the `contype` of obstacles and the `conaffinity` of collision geoms.
CONTACT_BIT = 2
HEIGHT_RATIO = 2.0  # Half height of a round obstacle divided by the body width.
_MIN_CONTACT_STEPS = 2.0  # Minimum ratio of contact time constant to time step.
# Minimum length of the floor beyond the outer steps at a length unit of 1, m.
_LEVEL_EXTENT = 100.0
# MuJoCo's impedance of an obstacle contact at zero depth and at full depth,
# dimensionless. With values of 0.95 and 0.99, obstacles would sink into the light links
# of a segment by a quarter of a millimetre per newton.
_IMPEDANCE = 0.99, 0.999
# Depth at which a contact reaches its full stiffness, at a length unit of 1, m.
_TRANSITION_DEPTH = 0.0005
_GREY = [0.45, 0.47, 0.5, 1]  # RGBA.
_COLLISION_GROUP = 4  # Geom group, which viewers do not show.
_GRADIENT = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
_CHECKER = mujoco.mjtBuiltin.mjBUILTIN_CHECKER


def add_collision_class(
    mj: mujoco.MjSpec, spec: RobotSpec, settings: ModelSettings, friction: float
) -> None:
    """Add the default class ``collision`` for geoms that touch obstacles."""
    depth = _TRANSITION_DEPTH * spec.scale.length
    collision_geom = mj.add_default("collision", mj.find_default(ROOT)).geom
    collision_geom.type = mjtGeom.mjGEOM_CAPSULE
    collision_geom.size = [spec.geometry.width / 2, 0, 0]
    collision_geom.conaffinity = CONTACT_BIT
    collision_geom.group = _COLLISION_GROUP
    collision_geom.priority = 1
    # With loaded contact, MuJoCo computes only the normal forces.
    collision_geom.condim = 1 if settings.loaded else 3
    collision_geom.friction = [friction, 0.005, 0.0001]
    collision_geom.solref = [_MIN_CONTACT_STEPS * settings.timestep, 1]
    collision_geom.solimp = [*_IMPEDANCE, depth, 0.5, 2]


def add_obstacles(mj: mujoco.MjSpec, spec: RobotSpec, world: World) -> None:
    """Add the obstacles of a world, and sensors on each collision geom.

    The sensors measure the total obstacle force (N), its point of application (m) and
    the velocity of the geom's centre (m/s) in the world frame.
    """
    solid = mj.add_default("obstacle", mj.default).geom
    solid.type = mjtGeom.mjGEOM_CAPSULE
    solid.contype = CONTACT_BIT
    solid.conaffinity = 0
    solid.condim = 3
    solid.friction = [world.friction, 0.005, 0.0001]
    solid.rgba = _GREY
    height = HEIGHT_RATIO * spec.geometry.width
    for k, circle in enumerate(world.obstacles, start=1):
        foot = [circle.x, circle.y, -height]
        top = [circle.x, circle.y, height]
        _add_capsule(mj, f"obstacle_{k}", circle.radius, foot, top)
    z = spec.geometry.com_height
    for k, polygon in enumerate(world.polygons, start=1):
        corners = np.array(polygon.corners)
        for side, (begin, end) in enumerate(
            zip(corners, np.roll(corners, -1, axis=0), strict=True), start=1
        ):
            _add_capsule(mj, f"polygon_{k}_side_{side}", WALL_M, [*begin, z], [*end, z])
    for collision_geom in collision_geoms(mj):
        add_force_sensor(
            mj,
            f"obstacle_force_{collision_geom}",
            mjtObj.mjOBJ_BODY,
            "world",
            on=collision_geom,
            position=True,
        )
        add_velocity_sensor(
            mj, f"velocity_{collision_geom}", mjtObj.mjOBJ_GEOM, collision_geom
        )


def add_steps(
    mj: mujoco.MjSpec, steps: tuple[FloorStep, ...], spec: RobotSpec
) -> list[str]:
    """Lower the floor, add boxes for raised levels, and return the box names.

    Up to the step with the smallest x, the floor is at height 0. The extent of the
    model is set to the length of the robot, because the large boxes would otherwise
    move the cameras away.
    """
    if not steps:
        return []
    mj.stat.extent = spec.geometry.body_length
    mj.stat.center = [0, 0, 0]
    ordered = sorted(steps, key=lambda step: step.x)
    far = _LEVEL_EXTENT * spec.scale.length + max(abs(step.x) for step in ordered)
    edges = [-far, *(step.x for step in ordered), far]
    heights = np.cumsum([0.0, *(step.height for step in ordered)])
    lowest = float(heights.min())
    mj.geom("floor").pos = [0, 0, lowest]
    names = []
    for k, (begin, end, height) in enumerate(
        zip(edges[:-1], edges[1:], heights, strict=True)
    ):
        if height > lowest and end > begin:
            names.append(f"level_{k}")
            size = [(end - begin) / 2, far, (height - lowest) / 2]
            centre = [(begin + end) / 2, 0, (height + lowest) / 2]
            box = mj.worldbody.add_geom(
                name=names[-1], type=mjtGeom.mjGEOM_BOX, size=size, pos=centre
            )
            box.contype = 0
            box.conaffinity = 0
            box.material = "floor"
    return names


def _add_capsule(
    mj: mujoco.MjSpec, name: str, radius: float, begin: list[float], end: list[float]
) -> None:
    default = mj.find_default("obstacle")
    mj.worldbody.add_geom(
        default, name=name, size=[radius, 0, 0], fromto=[*begin, *end]
    )


def collision_geoms(mj: mujoco.MjSpec | mujoco.MjModel) -> list[str]:
    """Return the names of the collision geoms, which can touch obstacles."""
    if isinstance(mj, mujoco.MjSpec):
        geoms = mj.geoms
    else:
        geoms = [mj.geom(k) for k in range(mj.ngeom)]
    return [geom.name for geom in geoms if geom.name.startswith("collision_")]


def friction_of(model: mujoco.MjModel) -> float:
    """Return the friction coefficient between collision geoms and obstacles."""
    names = collision_geoms(model)
    if names:
        return float(model.geom(names[0]).friction[0])
    return 0.0


def add_surroundings(mj: mujoco.MjSpec, body_length: float) -> None:
    """Add the floor ``floor``, the sky, the light ``sun`` and the camera ``track``.

    The light and the camera follow the snake, and the distance of the camera depends on
    the body length (m). The general collisions of the floor are disabled, because feet
    and floor have explicit contact pairs.
    """
    visual = mj.visual
    visual.headlight.ambient = [0.3, 0.3, 0.3]
    visual.headlight.diffuse = [0.45, 0.45, 0.45]
    visual.headlight.specular = [0, 0, 0]
    visual.rgba.haze = [0.62, 0.7, 0.78, 1]
    visual.global_.azimuth = 120
    visual.global_.elevation = -25
    sky = mj.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=256, height=1536
    )
    sky.builtin = _GRADIENT
    sky.rgb1 = [0.72, 0.82, 0.92]
    sky.rgb2 = [0.3, 0.42, 0.55]
    tiles = mj.add_texture(
        name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, width=300, height=300
    )
    tiles.builtin = _CHECKER
    tiles.rgb1 = [0.58, 0.62, 0.67]
    tiles.rgb2 = [0.52, 0.56, 0.62]
    tiles.mark = mujoco.mjtMark.mjMARK_EDGE
    tiles.markrgb = [0.7, 0.73, 0.77]
    material = mj.add_material(
        name="floor", texuniform=True, texrepeat=[10, 10], reflectance=0.05
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    floor = mj.worldbody.add_geom(
        name="floor", type=mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05]
    )
    floor.contype = 0
    floor.conaffinity = 0
    floor.material = "floor"
    follow = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
    # The light comes from directly above, because an oblique directional light causes
    # shadow artefacts on an infinite floor.
    sun = mj.worldbody.add_light(name="sun", pos=[0, 0, 1], dir=[0, 0, -1], mode=follow)
    sun.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    camera = mj.worldbody.add_camera(
        name="track", xyaxes=[1, 0, 0, 0, 0.62, 0.78], mode=follow
    )
    camera.pos = [0, -1.5 * body_length, 1.2 * body_length]


_COLOR = [0.86, 0.56, 0.22, 1]  # RGBA


def add_objects(mj: mujoco.MjSpec, spec: RobotSpec, world: World) -> None:
    """Add the objects of a world, and add their poses to the keyframe ``home``.

    Sensors measure the force of each object on each collision geom (N) and its point of
    application (m) in the world frame.
    """
    default = mj.add_default("object", mj.default)
    collision_geom = mj.find_default("collision").geom
    solid = default.geom
    # Collision geoms have a higher priority than objects. The engine therefore computes
    # only normal forces between collision geoms and objects.
    solid.contype = solid.conaffinity = CONTACT_BIT
    solid.condim = 3
    solid.friction = [world.friction, 0.005, 0.0001]
    solid.rgba = _COLOR
    solid.solref = collision_geom.solref
    solid.solimp = collision_geom.solimp
    poses: list[float] = []
    for name, item in zip(_names(len(world.objects)), world.objects, strict=True):
        _add_object(mj, default, spec, name, item)
        poses += [item.x, item.y, item.heading]
        for part in collision_geoms(mj):
            sensor = object_force_sensor(name, part)
            add_force_sensor(
                mj, sensor, mjtObj.mjOBJ_BODY, name, on=part, position=True
            )
    mj.keys[0].qpos = [*mj.keys[0].qpos, *poses]
    _add_self_contacts(mj, spec)


def _add_self_contacts(mj: mujoco.MjSpec, spec: RobotSpec) -> None:
    collision_geom = mj.find_default("collision").geom
    default = mj.add_default("self_contact", mj.default)
    default.pair.condim = 1
    default.pair.solref = collision_geom.solref
    default.pair.solimp = collision_geom.solimp
    for first, second in combinations(collision_geoms(mj), 2):
        between = abs(place_of(first)[0] - place_of(second)[0]) - 1
        if between * spec.geometry.pitch > spec.geometry.width:
            mj.add_pair(
                default, name=f"{first}_{second}", geomname1=first, geomname2=second
            )


def place_of(collision_geom: str) -> tuple[int, int]:
    """Extract the segment and capsule numbers from the name of a collision geom."""
    _, segment, number = collision_geom.split("_")
    return int(segment), int(number)


def _add_object(
    mj: mujoco.MjSpec,
    default: mujoco.MjsDefault,
    spec: RobotSpec,
    name: str,
    item: MovableObject,
) -> None:
    height = HEIGHT_RATIO * spec.geometry.width
    body = mj.worldbody.add_body(
        name=name, pos=[item.x, item.y, 0], mass=item.mass, explicitinertial=True
    )
    body.ipos = [0, 0, 0]
    body.inertia = np.full(3, item.mass * item.gyration**2)
    for axis, start in zip("xy", (item.x, item.y), strict=True):
        slide = body.add_joint(
            name=f"{name}_{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, ref=start
        )
        slide.axis = [float(axis == "x"), float(axis == "y"), 0]
    body.add_joint(name=f"{name}_heading", axis=[0, 0, 1], ref=item.heading)
    if item.is_box:
        turn = [math.cos(item.heading / 2), 0, 0, math.sin(item.heading / 2)]
        size = [item.size[0] / 2, item.size[1] / 2, height]
        body.add_geom(
            default, name=f"{name}_solid", type=mjtGeom.mjGEOM_BOX, size=size, quat=turn
        )
    else:
        # The geom is a capsule, because MuJoCo computes contacts between capsules in
        # closed form.
        ends = [0, 0, -height, 0, 0, height]
        geom = body.add_geom(
            default, name=f"{name}_solid", type=mjtGeom.mjGEOM_CAPSULE, fromto=ends
        )
        geom.size = [item.size[0], 0, 0]


def _names(count: int) -> list[str]:
    return [f"object_{k}" for k in range(1, count + 1)]


def object_names(model: mujoco.MjModel) -> list[str]:
    """Return the body names of all objects in numerical order."""
    return _names(
        sum(model.body(k).name.startswith("object_") for k in range(model.nbody))
    )


def object_force_sensor(name: str, collision_geom: str) -> str:
    """Return the name of the sensor for the force of an object on a collision geom."""
    return f"force_{name}_{collision_geom}"
