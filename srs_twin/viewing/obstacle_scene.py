"""Obstacles in a recording, and their forces on a snake: an arrow a connector, while it is touched."""

from __future__ import annotations

import numpy as np
import rerun as rr

from srs_twin.comparison.following import TOUCH_N
from srs_twin.trajectory import Trajectory
from srs_twin.viewing.blueprint import TIMELINE
from srs_twin.world import World

METRES_PER_NEWTON = 0.05
"""Length of the arrows, the same in every recording; the lightest robot weighs about 2 N."""
_FORCE, _FORCE_RADIUS = (208, 32, 32), 0.002
_OBSTACLE, _HEIGHT = (90, 90, 90), 0.06


def send_obstacles(log: rr.RecordingStream, world: World) -> None:
    """Log what stands on the floor: `world/obstacles/round` and `world/obstacles/straight`."""
    if circles := world.obstacles:
        upright = rr.Cylinders3D(
            centers=[(c.x, c.y, _HEIGHT / 2) for c in circles],
            lengths=[_HEIGHT] * len(circles),
            radii=[c.radius for c in circles],
            colors=[_OBSTACLE],
        )
        log.log("world/obstacles/round", upright, static=True)
    if world.polygons:
        sides = [
            [(x, y, z) for x, y in (*each.corners, each.corners[0])]
            for each in world.polygons
            for z in (0.0, _HEIGHT)
        ]
        lines = rr.LineStrips3D(sides, colors=[_OBSTACLE], radii=[0.003])
        log.log("world/obstacles/straight", lines, static=True)


def send_contacts(log: rr.RecordingStream, path: str, run: Trajectory, height: float) -> None:
    """Log the forces of one run; nothing where nothing was touched.

    An arrow begins at a connector's centre and is the force on it and on the halves of its segments. Every
    recorded sample counts, for a touch may be shorter than what shapes are thinned to.

    Args:
        log: where they are sent.
        path: of the entity, `world/<plant>/contact`.
        run: with ``obstacle_force_x_1…`` and ``obstacle_force_y_1…`` where there were obstacles.
        height: of the arrows above the floor, m.
    """
    if not run.has("obstacle_force_x"):
        return
    force = np.stack([run.stack("obstacle_force_x"), run.stack("obstacle_force_y")], axis=-1)
    touched = np.hypot(force[..., 0], force[..., 1]) > TOUCH_N
    some = touched.any(axis=1)
    if not some.any():
        return
    # A viewer shows the last row until the next: the first sample without a touch takes the arrows away.
    ended = np.append(False, some[:-1]) & ~some
    rows = np.flatnonzero(some | ended)
    origins = _raised(run.position[rows][touched[rows]], height)
    vectors = _raised(METRES_PER_NEWTON * force[rows][touched[rows]], 0.0)
    log.log(path, rr.Arrows3D.from_fields(colors=[_FORCE], radii=[_FORCE_RADIUS]), static=True)
    arrows = rr.Arrows3D.columns(origins=origins, vectors=vectors).partition(touched[rows].sum(axis=1))
    log.send_columns(path, [rr.TimeColumn(TIMELINE, duration=run.time[rows])], arrows)


def _raised(flat: np.ndarray, height: float) -> np.ndarray:
    """Return (n, 2) as (n, 3) with one third coordinate, float32."""
    return np.column_stack([flat, np.full(len(flat), height)]).astype(np.float32)
