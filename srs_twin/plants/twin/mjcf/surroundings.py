"""What a snake crawls on, is seen in and runs into: floor, sky, light, obstacles.

An obstacle is made of capsules: a round one is an upright capsule of its radius, a polygon has one along
each side, a millimetre thick, so that it is a millimetre larger all round. The body is the capsules of its
skin once more (hulls), at the height of the centres of mass and as wide as the robot is: between two capsules
MuJoCo finds the contact in closed form, in the plane. Hulls touch obstacles and nothing else, and exist only
where obstacles are, so that a snake in the open costs nothing more.
"""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco import mjtGeom, mjtObj

from srs_twin.plants.twin.mjcf.classes import ROOT
from srs_twin.plants.twin.mjcf.numerics import WALL_M, ModelSettings
from srs_twin.plants.twin.mjcf.wheels import add_force_sensor, add_velocity_sensor
from srs_twin.robot.spec import RobotSpec
from srs_twin.robot.world import Step, World

FRICTION = 0.5
"""Of silicone on a smooth obstacle, isotropic; an estimate, the text gives none."""

_BIT = 2  # contype of obstacles and conaffinity of hulls; floor and wheels have explicit pairs
_HEIGHT = 2.0  # of a round obstacle over the body's width
_SHARPEST = 2.0  # contact time over the time step: what MuJoCo takes at least
_FAR = 100.0  # m, beyond the last step, of a level's end
_GREY = [0.45, 0.47, 0.5, 1]
_UNSEEN = 4  # geom group
_GRADIENT, _CHECKER = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, mujoco.mjtBuiltin.mjBUILTIN_CHECKER


def add_hull_class(mj: mujoco.MjSpec, spec: RobotSpec, settings: ModelSettings) -> None:
    """Add class ``hull``, the body that touches obstacles."""
    hull = mj.add_default("hull", mj.find_default(ROOT)).geom
    hull.type, hull.size = mjtGeom.mjGEOM_CAPSULE, [spec.geometry.width / 2, 0, 0]
    hull.conaffinity, hull.group, hull.priority = _BIT, _UNSEEN, 1
    # Under `loaded` MuJoCo only finds what presses.
    hull.condim, hull.friction = 1 if settings.loaded else 3, [FRICTION, 0.005, 0.0001]
    hull.solref, hull.solimp = [_SHARPEST * settings.timestep, 1], [0.95, 0.99, 0.0005, 0.5, 2]


def add_obstacles(mj: mujoco.MjSpec, spec: RobotSpec, world: World) -> None:
    """Add the obstacles of a world, and sensors of what each hull feels of them.

    Sensors, of each hull: the force of all obstacles on it (world frame, N) and where it acts (m), and the
    velocity of its middle (world, m/s).
    """
    solid = mj.add_default("obstacle", mj.default).geom
    solid.type, solid.contype, solid.conaffinity = mjtGeom.mjGEOM_CAPSULE, _BIT, 0
    solid.condim, solid.friction, solid.rgba = 3, [FRICTION, 0.005, 0.0001], _GREY
    height = _HEIGHT * spec.geometry.width
    for k, circle in enumerate(world.obstacles, start=1):
        foot, top = [circle.x, circle.y, -height], [circle.x, circle.y, height]
        _add_capsule(mj, f"obstacle_{k}", circle.radius, foot, top)
    z = spec.geometry.com_height
    for k, polygon in enumerate(world.polygons, start=1):
        corners = np.array(polygon.corners)
        for side, (begin, end) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True), start=1):
            _add_capsule(mj, f"polygon_{k}_side_{side}", WALL_M, [*begin, z], [*end, z])
    for hull in hulls(mj):
        add_force_sensor(mj, f"obstacle_force_{hull}", mjtObj.mjOBJ_BODY, "world", on=hull, place=True)
        add_velocity_sensor(mj, f"velocity_{hull}", mjtObj.mjOBJ_GEOM, hull)


def add_steps(mj: mujoco.MjSpec, steps: tuple[Step, ...], body_length: float) -> list[str]:
    """Put boxes on the floor, which is lowered to the lowest level; return their names.

    Where no step has been, at the least x, the floor's height is 0.

    Args:
        mj: the model.
        steps: of the floor.
        body_length: of the snake, m, which cameras go by: else they would by that of the boxes.
    """
    if not steps:
        return []
    mj.stat.extent, mj.stat.center = body_length, [0, 0, 0]
    ordered = sorted(steps, key=lambda step: step.x)
    far = _FAR + max(abs(step.x) for step in ordered)
    edges = [-far, *(step.x for step in ordered), far]
    heights = np.cumsum([0.0, *(step.height for step in ordered)])
    lowest = float(heights.min())
    mj.geom("floor").pos = [0, 0, lowest]
    names = []
    for k, (begin, end, height) in enumerate(zip(edges[:-1], edges[1:], heights, strict=True)):
        if height > lowest and end > begin:
            names.append(f"level_{k}")
            size = [(end - begin) / 2, far, (height - lowest) / 2]
            place = [(begin + end) / 2, 0, (height + lowest) / 2]
            box = mj.worldbody.add_geom(name=names[-1], type=mjtGeom.mjGEOM_BOX, size=size, pos=place)
            box.contype, box.conaffinity, box.material = 0, 0, "floor"
    return names


def _add_capsule(mj: mujoco.MjSpec, name: str, radius: float, begin: list[float], end: list[float]) -> None:
    default = mj.find_default("obstacle")
    mj.worldbody.add_geom(default, name=name, size=[radius, 0, 0], fromto=[*begin, *end])


def hulls(mj: mujoco.MjSpec | mujoco.MjModel) -> list[str]:
    """Return the names of the body's parts that touch obstacles."""
    geoms = mj.geoms if isinstance(mj, mujoco.MjSpec) else [mj.geom(k) for k in range(mj.ngeom)]
    return [geom.name for geom in geoms if geom.name.startswith("hull_")]


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
    sky = mj.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=256, height=1536)
    sky.builtin, sky.rgb1, sky.rgb2 = _GRADIENT, [0.72, 0.82, 0.92], [0.3, 0.42, 0.55]
    tiles = mj.add_texture(name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, width=300, height=300)
    tiles.builtin, tiles.rgb1, tiles.rgb2 = _CHECKER, [0.58, 0.62, 0.67], [0.52, 0.56, 0.62]
    tiles.mark, tiles.markrgb = mujoco.mjtMark.mjMARK_EDGE, [0.7, 0.73, 0.77]
    material = mj.add_material(name="floor", texuniform=True, texrepeat=[10, 10], reflectance=0.05)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    floor = mj.worldbody.add_geom(name="floor", type=mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05])
    floor.contype, floor.conaffinity, floor.material = 0, 0, "floor"
    follow = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
    # Straight from above: a slanted directional light leaves specks of shadow on an endless floor.
    sun = mj.worldbody.add_light(name="sun", pos=[0, 0, 1], dir=[0, 0, -1], mode=follow)
    sun.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    camera = mj.worldbody.add_camera(name="track", xyaxes=[1, 0, 0, 0, 0.62, 0.78], mode=follow)
    camera.pos = [0, -1.5 * body_length, 1.2 * body_length]
