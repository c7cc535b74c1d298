"""What a snake crawls on and runs into: floor, sky, light, obstacles.

Obstacles as what a snake can run into, and the body that touches them.

An obstacle is made of capsules: a round one is an upright capsule of its radius, a polygon has one along
each side, a millimetre thick, so that it is a millimetre larger all round. The body is the capsules of its
skin once more, at the height of the centres of mass and as wide as the robot is: between two capsules MuJoCo
finds the contact in closed form, in the plane.

Hulls touch obstacles and nothing else, and they are there only where obstacles are: a snake in the open costs
what it cost before.

What a snake crawls on and is seen in: floor, sky and light.
"""

from __future__ import annotations

import mujoco
import numpy as np

from srs_twin.mjcf.classes import ROOT
from srs_twin.mjcf.numerics import WALL_M, Numerics
from srs_twin.mjcf.wheels import add_force_sensor
from srs_twin.robot.spec import RobotSpec
from srs_twin.world import World

FRICTION = 0.5
"""Of silicone on a smooth obstacle, isotropic; an estimate, the text gives none."""

_BIT = 2  # contype of obstacles and conaffinity of hulls; floor and wheels have explicit pairs
_HEIGHT = 2.0  # of a round obstacle over the body's width
_SHARPEST = 2.0  # contact time over the time step: what MuJoCo takes at least
_GREY = [0.45, 0.47, 0.5, 1]
_UNSEEN = 4  # geom group


def add_hull_class(mj: mujoco.MjSpec, spec: RobotSpec, numerics: Numerics) -> None:
    """Add class ``hull``, the body that touches obstacles."""
    hull = mj.add_default("hull", mj.find_default(ROOT)).geom
    hull.type, hull.size = mujoco.mjtGeom.mjGEOM_CAPSULE, [spec.geometry.width / 2, 0, 0]
    hull.conaffinity, hull.group, hull.priority = _BIT, _UNSEEN, 1
    hull.condim, hull.friction = 3, [FRICTION, 0.005, 0.0001]
    hull.solref, hull.solimp = [_SHARPEST * numerics.timestep, 1], [0.95, 0.99, 0.0005, 0.5, 2]


def add_obstacles(mj: mujoco.MjSpec, spec: RobotSpec, world: World) -> None:
    """Add the obstacles of a world, and sensors of what each hull feels of them.

    Sensors, of each hull: the force of all obstacles on it (world frame, N) and the velocity of its middle
    (world, m/s).
    """
    solid = mj.add_default("obstacle", mj.default).geom
    solid.type, solid.contype, solid.conaffinity = mujoco.mjtGeom.mjGEOM_CAPSULE, _BIT, 0
    solid.condim, solid.friction, solid.rgba = 3, [FRICTION, 0.005, 0.0001], _GREY
    default = mj.find_default("obstacle")
    height = _HEIGHT * spec.geometry.width
    for k, circle in enumerate(world.obstacles, start=1):
        mj.worldbody.add_geom(
            default, name=f"obstacle_{k}", size=[circle.radius, 0, 0],
            fromto=[circle.x, circle.y, -height, circle.x, circle.y, height],
        )  # fmt: skip
    z = spec.geometry.com_height
    for k, polygon in enumerate(world.polygons, start=1):
        corners = np.array(polygon.corners)
        for side, (begin, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True), start=1):
            mj.worldbody.add_geom(
                default, name=f"polygon_{k}_side_{side}", size=[WALL_M, 0, 0], fromto=[*begin, z, *end, z]
            )
    _add_sensors(mj)


def hulls(mj: mujoco.MjSpec) -> list[str]:
    """Return the names of the body's parts that touch obstacles."""
    return [geom.name for geom in mj.geoms if geom.name.startswith("hull_")]


def _add_sensors(mj: mujoco.MjSpec) -> None:
    for hull in hulls(mj):
        add_force_sensor(mj, f"obstacle_force_{hull}", mujoco.mjtObj.mjOBJ_BODY, "world", on=hull)
        mj.add_sensor(
            name=f"velocity_{hull}", type=mujoco.mjtSensor.mjSENS_FRAMELINVEL,
            objtype=mujoco.mjtObj.mjOBJ_GEOM, objname=hull,
        )  # fmt: skip


def add_surroundings(mj: mujoco.MjSpec, body_length: float) -> None:
    """Add floor ``floor``, sky, light ``sun`` and camera ``track`` to a model; the last two follow the snake.

    The floor collides with nothing by itself: wheels touch it through explicit pairs.

    Args:
        mj: the model.
        body_length: of the snake, m; the camera's distance goes with it.
    """
    visual = mj.visual
    visual.headlight.ambient = [0.3, 0.3, 0.3]
    visual.headlight.diffuse = [0.45, 0.45, 0.45]
    visual.headlight.specular = [0, 0, 0]
    visual.rgba.haze = [0.62, 0.7, 0.78, 1]
    visual.global_.azimuth, visual.global_.elevation = 120, -25
    mj.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.72, 0.82, 0.92], rgb2=[0.3, 0.42, 0.55], width=256, height=1536,
    )  # fmt: skip
    mj.add_texture(
        name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        mark=mujoco.mjtMark.mjMARK_EDGE, rgb1=[0.58, 0.62, 0.67], rgb2=[0.52, 0.56, 0.62],
        markrgb=[0.7, 0.73, 0.77], width=300, height=300,
    )  # fmt: skip
    material = mj.add_material(name="floor", texuniform=True, texrepeat=[10, 10], reflectance=0.05)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    mj.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], contype=0, conaffinity=0,
        material="floor",
    )  # fmt: skip
    follow = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
    # Straight from above: a slanted directional light leaves specks of shadow on an endless floor.
    mj.worldbody.add_light(
        name="sun", pos=[0, 0, 1], dir=[0, 0, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, mode=follow
    )
    mj.worldbody.add_camera(
        name="track",
        pos=[0, -1.5 * body_length, 1.2 * body_length],
        xyaxes=[1, 0, 0, 0, 0.62, 0.78],
        mode=follow,
    )
