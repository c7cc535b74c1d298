"""Checks of a plan by sampled points of the body, without code of the planner."""

from __future__ import annotations

import math

import numpy as np

from srs_twin.planning.footprint import Footprint
from srs_twin.planning.problem import Plan, Problem
from srs_twin.robot.world import World

TOUCH = 1e-6
"""Smallest depth that counts as a collision, m."""


def deepest(plan: Plan, problem: Problem, spacing: float = 0.004) -> float:
    """Return the largest depth of the body inside an obstacle, m; negative: the smallest distance.

    A point inside a polygon counts as 1 m deep.
    """
    depth = -math.inf
    body = problem.footprint
    last = None
    wider = (0.0, 0.0)
    lasting = 0.0
    for segment in plan.segments:
        if last is not None:
            left, right, length = body.transient(last, segment.offset)
            old = wider if lasting > 0 else (0.0, 0.0)
            wider = (max(left, old[0]), max(right, old[1]))
            lasting = max(lasting, length)
        start = (segment.start.x, segment.start.y, segment.start.heading)
        points = [swept_points(start, segment.curvature, segment.length, body, spacing)]
        if lasting > 0:
            points.append(
                swept_points(
                    start,
                    segment.curvature,
                    min(lasting, segment.length),
                    body,
                    spacing,
                    wider,
                )
            )
        depth = max(depth, depth_in(np.vstack(points), problem.world))
        last = segment.offset
        lasting = lasting - segment.length
    return depth


def swept_points(
    start: tuple[float, float, float],
    curvature: float,
    length: float,
    body: Footprint,
    spacing: float,
    wider: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """Return points of the floor that the body covers along an arc, m, shape (n, 2)."""
    x, y, heading = start
    edges = [
        np.interp(curvature, body.curvatures, c) + w
        for c, w in zip((body.left, body.right), wider, strict=True)
    ]
    s = np.linspace(
        -body.behind,
        length + body.ahead,
        2 + int((length + body.ahead + body.behind) / spacing),
    )
    n = np.linspace(-edges[1], edges[0], 2 + int(sum(edges) / spacing))
    s, n = (grid.ravel() for grid in np.meshgrid(s, n))
    if abs(curvature) < 1e-9:
        along = s
        across = n
    else:
        # Rotate about the centre of the turn, at 1/curvature to the left.
        radius = 1 / curvature
        along = (radius - n) * np.sin(s / radius)
        across = radius - (radius - n) * np.cos(s / radius)
    c = math.cos(heading)
    sn = math.sin(heading)
    return np.column_stack([x + c * along - sn * across, y + sn * along + c * across])


def depth_in(points: np.ndarray, world: World) -> float:
    """Return the largest depth of the points inside an obstacle, m."""
    x, y = points.T
    depth = [-math.inf]
    depth += [
        float(np.max(c.radius - np.hypot(x - c.x, y - c.y))) for c in world.obstacles
    ]
    if world.bounds:
        (west, east), (south, north) = world.bounds.x, world.bounds.y
        depth += [
            float(v)
            for v in (west - x.min(), x.max() - east, south - y.min(), y.max() - north)
        ]
    depth += [1.0 for p in world.polygons if np.any(_in_polygon(x, y, p.corners))]
    return max(depth)


def _in_polygon(
    x: np.ndarray, y: np.ndarray, corners: tuple[tuple[float, float], ...]
) -> np.ndarray:
    """Return for each point whether a ray from it crosses an odd number of sides."""
    odd = np.zeros(len(x), dtype=bool)
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        spans = (ay > y) != (by > y)
        with np.errstate(divide="ignore", invalid="ignore"):
            odd ^= spans & (x < ax + (y - ay) / (by - ay) * (bx - ax))
    return odd


def joints(plan: Plan, problem: Problem) -> float:
    """Return the largest gap between segments and at the start, m; a radian counts as a metre."""
    ends = [problem.start, *(s.end for s in plan.segments)]
    gaps = [
        math.hypot(a.x - s.start.x, a.y - s.start.y)
        + abs(math.remainder(a.heading - s.start.heading, 2 * math.pi))
        for a, s in zip(ends, plan.segments, strict=False)
    ]
    return max(gaps, default=0.0)


def misses(plan: Plan, problem: Problem) -> bool:
    """Return whether a plan ends outside the tolerance of the goal."""
    end = plan.end or problem.start
    goal = problem.goal
    far = math.hypot(end.x - goal.x, end.y - goal.y) > goal.radius + 1e-6
    turned = goal.heading is not None and (
        abs(math.remainder(end.heading - goal.heading, 2 * math.pi))
        > goal.heading_tolerance + 1e-6
    )
    return far or turned


def is_faulty(plan: Plan, problem: Problem) -> bool:
    """Return whether a plan collides, has gaps between its segments or misses the goal."""
    return (
        deepest(plan, problem) > TOUCH
        or joints(plan, problem) > 1e-6
        or misses(plan, problem)
    )
