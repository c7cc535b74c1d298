"""Random problems for the planner: narrow and wide bodies, round and polygonal obstacles."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from srs_twin.errors import InputError
from srs_twin.planning.arcs import Primitives
from srs_twin.planning.footprint import Footprint, Transient
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.problem import Problem
from srs_twin.robot.world import (
    FIG54_GOAL,
    FIG54_START,
    Bounds,
    Circle,
    Goal,
    Polygon,
    Pose,
    World,
    fig54_world,
    random_circles,
)

BODIES = ("gen2_section52", "gen4_table8", "gen4_table9")


def drawn_problem(seed: int) -> Problem:
    """Return the problem of a seed, with random body, field, start, goal and tolerance."""
    rng = np.random.default_rng(seed)
    body = load_footprint(BODIES[seed % 3])
    if seed % 5 == 4:
        body = _with_transients(body)
    scale = 1.0 if seed % 3 == 0 else 2.5
    bounds = Bounds((0.0, 2.4 * scale), (0.0, 1.6 * scale))
    width = max(a + b for a, b in zip(body.left, body.right, strict=True))
    start = Pose(
        0.3 * scale, float(rng.uniform(0.3, 1.3)) * scale, float(rng.uniform(-0.8, 0.8))
    )
    heading = None if seed % 4 == 3 else float(rng.uniform(-1.0, 1.0))
    goal = Goal(
        2.1 * scale, float(rng.uniform(0.3, 1.3)) * scale, heading, 0.02 * scale, 0.1
    )
    clear = ((start.x, start.y, 0.22 * scale), (goal.x, goal.y, 0.15 * scale))
    gap = float(rng.uniform(0.3, 2.5)) * width
    count = int(rng.integers(1, 41))
    circles: tuple[Circle, ...] = ()
    while count and not circles:
        try:
            circles = random_circles(
                count,
                bounds,
                seed,
                radius=(0.03 * scale, 0.12 * scale),
                gap=gap,
                clear=clear,
            )
        except InputError:
            count -= 1
    if seed % 2:
        world = World(
            circles[::2],
            bounds if seed % 7 else None,
            None,
            tuple(_cornered(c, rng) for c in circles[1::2]),
        )
    else:
        world = World(circles, bounds)
    return Problem(start, goal, world, body)


def _cornered(circle: Circle, rng: np.random.Generator) -> Polygon:
    """Return a star-shaped, usually non-convex polygon inside a circle."""
    angles = (np.arange(7) + rng.uniform(0, 0.9, 7)) * 2 * math.pi / 7
    radii = circle.radius * rng.uniform(0.4, 1.0, 7)
    corners = zip(
        circle.x + radii * np.cos(angles),
        circle.y + radii * np.sin(angles),
        strict=True,
    )
    return Polygon(tuple((float(x), float(y)) for x, y in corners))


def _with_transients(body: Footprint) -> Footprint:
    """Return a body that deviates to the outside of the old turn after a change of offset."""
    wide = 0.3 * body.narrowest
    tight = 1 / max(body.tightest)
    changes = (
        Transient(body.offsets[0], body.offsets[-1], 0.0, wide, tight / 3),
        Transient(body.offsets[-1], body.offsets[0], wide, 0.0, tight / 3),
    )
    return replace(body, transients=changes)


SPEED = 0.2
STEP_S = 1.0
ARCS = Primitives(21, math.pi / 3, SPEED * STEP_S)


def fig54_problem(count: int, seed: int, *, arcs: bool) -> Problem:
    """Return a world of Fig. 54; `arcs` adds the motion primitives of the dissertation's planner."""
    body = load_footprint("gen2_section52")
    return Problem(
        FIG54_START, FIG54_GOAL, fig54_world(count, seed), body, ARCS if arcs else None
    )
