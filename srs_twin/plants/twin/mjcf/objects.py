"""Movable objects of a scene: cylinders and boxes that slide and turn on the floor.

An object is a body with two slide joints and a hinge about z, so that its position in `qpos` is x, y and
heading in the world. It does not tip. Its weight and its friction on the floor are those of four points
(`MovableObject.supports`). `friction_solve` computes the friction of these points, and that between object
and body. MuJoCo computes the normal forces, and the friction of an object on obstacles and on other objects.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from mujoco import mjtGeom, mjtObj

from srs_twin.errors import InputError
from srs_twin.plants.twin.mjcf.numerics import ModelSettings
from srs_twin.plants.twin.mjcf.surroundings import CONTACT_BIT, HEIGHT_RATIO, hulls
from srs_twin.plants.twin.mjcf.wheels import add_force_sensor
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import MovableObject, World

_COLOR = [0.86, 0.56, 0.22, 1]  # RGBA


def add_objects(mj: mujoco.MjSpec, spec: RobotSpec, settings: ModelSettings, world: World) -> None:
    """Add the objects of a world after the robot, with their initial poses in the keyframe ``home``.

    Sensors measure the force of each object on each hull with its point of application, and the velocity and
    the angular velocity of each object (world frame).

    Raises:
        InputError: the contact with the floor is not loaded, or the floor has steps.
    """
    if not world.objects:
        return
    if not settings.loaded:
        raise InputError("objects need contact 'loaded' and a free snake")
    if world.steps:
        raise InputError("objects need a plane floor; remove the steps of the floor or the objects")
    default = mj.add_default("object", mj.default)
    hull, solid = mj.find_default("hull").geom, default.geom
    # Hulls have a higher priority, so that their contacts with objects have normal forces only.
    solid.contype = solid.conaffinity = CONTACT_BIT
    solid.condim, solid.friction, solid.rgba = 3, [world.friction, 0.005, 0.0001], _COLOR
    solid.solref, solid.solimp = hull.solref, hull.solimp
    poses: list[float] = []
    for name, item in zip(_names(len(world.objects)), world.objects, strict=True):
        _add_object(mj, default, spec, name, item)
        poses += [item.x, item.y, item.heading]
        for part in hulls(mj):
            sensor = object_force_sensor(name, part)
            add_force_sensor(mj, sensor, mjtObj.mjOBJ_BODY, name, on=part, position=True)
    mj.keys[0].qpos = [*mj.keys[0].qpos, *poses]


def _add_object(
    mj: mujoco.MjSpec, default: mujoco.MjsDefault, spec: RobotSpec, name: str, item: MovableObject
) -> None:
    height = HEIGHT_RATIO * spec.geometry.width
    body = mj.worldbody.add_body(name=name, pos=[item.x, item.y, 0], mass=item.mass, explicitinertial=True)
    body.ipos, body.inertia = [0, 0, 0], np.full(3, item.mass * item.gyration**2)
    for axis, start in zip("xy", (item.x, item.y), strict=True):
        slide = body.add_joint(name=f"{name}_{axis}", type=mujoco.mjtJoint.mjJNT_SLIDE, ref=start)
        slide.axis = [float(axis == "x"), float(axis == "y"), 0]
    body.add_joint(name=f"{name}_heading", axis=[0, 0, 1], ref=item.heading)
    if item.is_box:
        turn = [math.cos(item.heading / 2), 0, 0, math.sin(item.heading / 2)]
        size = [item.size[0] / 2, item.size[1] / 2, height]
        body.add_geom(default, name=f"{name}_solid", type=mjtGeom.mjGEOM_BOX, size=size, quat=turn)
    else:
        # A capsule, so that the contact with a hull is computed in closed form, in the plane.
        ends = [0, 0, -height, 0, 0, height]
        geom = body.add_geom(default, name=f"{name}_solid", type=mjtGeom.mjGEOM_CAPSULE, fromto=ends)
        geom.size = [item.size[0], 0, 0]


def _names(count: int) -> list[str]:
    return [f"object_{k}" for k in range(1, count + 1)]


def object_names(model: mujoco.MjModel) -> list[str]:
    """Return the names of the bodies of all objects, in the order of the objects."""
    return _names(sum(model.body(k).name.startswith("object_") for k in range(model.nbody)))


def object_force_sensor(name: str, hull: str) -> str:
    """Return the name of the sensor of the force of an object on a hull."""
    return f"force_{name}_{hull}"
