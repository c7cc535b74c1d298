"""What a snake crawls on and is seen in: floor, sky and light."""

from __future__ import annotations

import mujoco


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
