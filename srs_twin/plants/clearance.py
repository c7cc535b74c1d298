r"""Distance from the body to obstacles and objects, and overlaps at the start of a run.

For every plant, the body is represented by the collision geoms of the twin. These are
capsules between adjacent hinges, with the width of the body as their diameter. The axes
of the capsules are computed from the recorded connector poses, under the assumption
that all hinges of a segment have equal angles. Plants without hinges are assumed to
have the default number of hinges.

The axis of a capsule is straight. In a segment with two hinges, length l and bend q,
the middle of the axis therefore lies inside an arc of constant curvature, at a distance
of

$$ l\,|q|/24 . $$
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from srs_twin.errors import InputError
from srs_twin.plants.base import Plant, SnakeState
from srs_twin.plants.twin.mjcf.numerics import ModelSettings, hinge_stations
from srs_twin.robot.spec import Geometry
from srs_twin.robot.world import WALL_M, World

if TYPE_CHECKING:
    import shapely

TOUCHING_M = 1e-6
"""Maximum overlap that counts as touching without a contact force, m.

The value allows for the horizontal displacement of a few nanometres while the twin
settles on the floor.
"""
PENETRATION_M = 1e-3
"""Maximum overlap due to soft contacts, for a robot with a length unit of 1, m."""

_POINTS_PER_WIDTH = 40
"""Number of points per body width at which overlap depths in a polygon are computed.

The maximum error of a depth is half the distance between adjacent points.
"""


class Solid(NamedTuple):
    """Obstacle or object, defined as all points within the distance `radius` of `core`.

    Attributes:
        name: name used in messages, such as "obstacle 2 at (0.5, 0.1) m".
        core: point or polygon in the frame of the obstacle or object, m.
        radius: distance of the surface from the core, m.
        pose: x and y coordinates (m) and heading (rad) of the frame.
    """

    name: str
    core: shapely.Geometry
    radius: float
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)


def solids(world: World) -> list[Solid]:
    """Return the circles, polygons and objects of a world at their initial poses."""
    import shapely

    found = []
    for k, circle in enumerate(world.obstacles, start=1):
        name = f"obstacle {k} at ({circle.x:.4g}, {circle.y:.4g}) m"
        found.append(Solid(name, shapely.Point(circle.x, circle.y), circle.radius))
    for k, polygon in enumerate(world.polygons, start=1):
        found.append(Solid(f"polygon {k}", shapely.Polygon(polygon.corners), WALL_M))
    for k, item in enumerate(world.objects, start=1):
        core = shapely.Point(0, 0)
        radius = item.size[0]
        if item.is_box:
            half = np.array(item.size) / 2
            core = shapely.box(*-half, *half)
            radius = 0.0
        found.append(Solid(f"object {k}", core, radius, (item.x, item.y, item.heading)))
    return found


def collision_lines(
    position: np.ndarray, connector_heading: np.ndarray, geometry: Geometry, hinges: int
) -> np.ndarray:
    """Return the axes of the capsules as polylines, shape (samples, points, 2), m.

    Args:
        position: positions of the connectors, shape (samples, N, 2), m.
        connector_heading: headings of the connectors, shape (samples, N), rad.
        geometry: dimensions of the robot.
        hinges: number of hinges per segment.
    """
    length = geometry.segment_length
    gap = geometry.rigid_gap
    capsules = np.diff(
        hinge_stations(hinges, length, gap), prepend=0.0, append=length + gap
    )
    fraction = np.linspace(0.0, 1.0, hinges + 1)
    headings = (
        connector_heading[:, :-1, None]
        + np.diff(connector_heading, axis=1)[..., None] * fraction
    )
    directions = np.stack([np.cos(headings), np.sin(headings)], axis=-1)
    line = position[:, :-1, None] - np.cumsum(capsules[:, None] * directions, axis=2)
    # The polyline of a segment must end at the rear connector. Its closing error is
    # therefore distributed linearly over its points.
    weight = np.append(np.linspace(0.0, 1.0, hinges), 1.0)[:, None]
    line += weight * (position[:, 1:, None] - line[:, :, -1:])
    return np.concatenate([position[:, :1], line.reshape(len(line), -1, 2)], axis=1)


def clearance(plant: Plant, states: SnakeState) -> np.ndarray:
    """Return the distance (m) to the nearest obstacle or object at each sample.

    The distance is measured from the surface of the body and is negative for an
    overlap. If the axis of the body enters a box, the distance is minus half the width
    of the body. In a polygon, the distance is smaller by `WALL_M`.
    """
    import shapely

    assert plant.world is not None, "the caller checks that the world is solid"
    found = solids(plant.world)
    count = len(plant.world.objects)
    fixed = found[: len(found) - count]
    lines = _collision_geom(plant, states)
    collision_geom = shapely.linestrings(lines)
    least = np.full(len(lines), np.inf)
    for radius in {solid.radius for solid in fixed}:
        tree = shapely.STRtree(
            [solid.core for solid in fixed if solid.radius == radius]
        )
        _, distance = tree.query_nearest(
            collision_geom, all_matches=False, return_distance=True
        )
        least = np.minimum(least, distance - radius)
    for k, solid in enumerate(found[len(fixed) :]):
        first = states.qpos.shape[1] + 3 * (k - count)
        moved = _in_frame(lines, states.qpos[:, first : first + 3])
        least = np.minimum(least, shapely.distance(solid.core, moved) - solid.radius)
    return np.asarray(least - plant.spec.geometry.width / 2)


class Overlap(NamedTuple):
    """Overlap of an obstacle or object with the body or another solid at the start.

    Attributes:
        number: index of the obstacle or object in the result of `solids`.
        text: problem and remedy, which follow the name in a message.
    """

    number: int
    name: str
    text: str


def start_overlaps(
    world: World, lines: np.ndarray, half_width: float, *, allowed: float = TOUCHING_M
) -> list[Overlap]:
    """Return overlaps of solids with a body, then those of objects with other solids.

    Args:
        world: obstacles, and objects at their initial poses.
        lines: axes of the capsules, as returned by `collision_lines`, shape (1, points,
            2), m.
        half_width: half the width of the body, m.
        allowed: maximum overlap that is not reported, m.
    """
    import shapely

    found = []
    all_solids = solids(world)
    for k, solid in enumerate(all_solids):
        line = _in_frame(lines, np.array([solid.pose]))[0]
        distance = shapely.distance(solid.core, line)
        depth = half_width + solid.radius - distance
        if distance == 0 and shapely.area(solid.core):
            inside = shapely.intersection(solid.core, line)
            points = shapely.get_coordinates(
                shapely.segmentize(inside, 2 * half_width / _POINTS_PER_WIDTH)
            )
            depth += shapely.distance(shapely.points(points), solid.core.boundary).max()
        if depth > allowed:
            text = f"overlaps the body at the start by {1e3 * depth:.3g} mm; move it"
            found.append(Overlap(k, solid.name, f"{text} or start elsewhere"))
    # Only objects are compared with other solids.
    shapes = [_shape(solid) for solid in all_solids if world.objects]
    fixed = len(all_solids) - len(world.objects)
    for k, solid in enumerate(all_solids[fixed:], fixed):
        hits = shapely.intersects(shapes[k].buffer(-allowed), shapes[:k])
        for j in np.flatnonzero(hits):
            text = f"overlaps {all_solids[j].name} at the start; move one of them"
            found.append(Overlap(k, solid.name, text))
    return found


def _shape(solid: Solid) -> shapely.Geometry:
    from shapely import affinity

    x, y, heading = solid.pose
    shape = solid.core.buffer(solid.radius, quad_segs=64)
    return affinity.translate(affinity.rotate(shape, heading, "center", True), x, y)


def check_start(plant: Plant, state: SnakeState, allowed: float = TOUCHING_M) -> None:
    """Check that the pose is finite and that no solids overlap at the start of a run.

    Overlaps of at most `allowed` (m) are accepted.

    Raises:
        InputError: the pose is not finite, or the body, obstacles and objects overlap
            by more than `allowed`.
    """
    if not np.isfinite(state.com.sum() + state.heading):
        raise InputError("the pose at the start is not allowed; it must be finite")
    if plant.world is not None and plant.world.is_solid:
        lines = _collision_geom(plant, state.as_history())
        half_width = plant.spec.geometry.width / 2
        for overlap in start_overlaps(plant.world, lines, half_width, allowed=allowed):
            raise InputError(f"{overlap.name} {overlap.text}")


def _collision_geom(plant: Plant, states: SnakeState) -> np.ndarray:
    hinges: Any = plant.describe().get(
        "hinges_per_segment", ModelSettings.hinges_per_segment
    )
    return collision_lines(
        states.position, states.connector_heading, plant.spec.geometry, hinges
    )


def _in_frame(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    import shapely

    x, y = np.moveaxis(points - pose[:, None, :2], -1, 0)
    cos = np.cos(pose[:, 2:])
    sin = np.sin(pose[:, 2:])
    turned = np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)
    return np.asarray(shapely.linestrings(turned))
