"""Solvable worlds by construction: a path is drawn first, then obstacles next to it.

The path consists of arcs that the body can follow. It is checked in the final world by
sampling (`deepest`), which fractions no code with the planner. `drawn` has six kinds,
`KINDS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from plan_sampling import deepest, depth_in, swept_points

from srs_twin.planning.footprint import Footprint
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.planning.path import path_from_arcs
from srs_twin.planning.problem import Plan, PlanOutcome, Problem
from srs_twin.robot.world import Bounds, Circle, Goal, Polygon, Pose, World

Pieces = list[tuple[float, float]]


def bodies() -> dict[str, Footprint]:
    """Return six footprints: the shipped ones, and that of generation 4 as its scenarios use it."""
    names = ("gen2_gait", "gen2_section52", "gen4_ilc", "gen4_table8", "gen4_table9")
    result = {name: load_footprint(name) for name in names}
    return result | {
        "gen4_ilc_half": result["gen4_ilc"].reduced(turn_fraction=0.5, margin=0.05)
    }


@dataclass(frozen=True)
class Witnessed:
    """Problem and a plan that solves it.

    Attributes:
        problem: start, goal and obstacles.
        witness: plan that is collision-free by sampling.
        width: width of the straight body, m.
        gap: width of the narrowest gap relative to `width`; infinite without a gap.
    """

    problem: Problem
    witness: Plan
    width: float
    gap: float = math.inf


def _response_length(body: Footprint) -> float:
    """Return the length after which the transient of a change of offset has ended, m."""
    return max((item.length for item in body.transients), default=0.0)


def walls(seed: int, body: Footprint, ratio: float, count: int) -> Witnessed:
    """Return walls across the bounds, each with one gap of the given width relative to the straight body."""
    return _first(seed, lambda rng: _walls(rng, body, ratio, count))


def drawn(
    kind: str, seed: int, body: Footprint, lead_in: float = 0.0, room: float = 0.0
) -> Witnessed:
    """Return a world of a kind.

    Args:
        kind: one of `KINDS`.
        seed: random seed.
        body: footprint, margin included.
        lead_in: length of the straight first part, m.
        room: free space next to the body there, m.
    """
    start = _Start(body, lead_in, room)
    return _first(seed, lambda rng: KINDS[kind](rng, start))


def _first(
    seed: int, make: Callable[[np.random.Generator], Witnessed | None]
) -> Witnessed:
    for attempt in range(400):
        if (result := make(np.random.default_rng([seed, attempt]))) is not None:
            return result
    raise RuntimeError("no world was drawn")


@dataclass(frozen=True)
class _Start:
    """Body and the straight first part of its path."""

    body: Footprint
    lead_in: float
    room: float

    def draw_path(self, rng: np.random.Generator, length: float) -> Pieces:
        """Return the straight first part, followed by arcs."""
        low = self.body.curvatures[0]
        high = self.body.curvatures[-1]
        pieces = [(0.0, self.lead_in + 0.05)]
        left = length
        while left > 0:
            piece = float(rng.uniform(0.3, 0.8))
            pieces.append(
                (
                    float(rng.uniform(0.9 * low, 0.9 * high)) * (rng.random() < 0.7),
                    piece,
                )
            )
            left -= piece
        return pieces

    def finished(
        self,
        pieces: Pieces,
        circles: list[Circle],
        polygons: list[Polygon],
        gap: float = math.inf,
    ) -> Witnessed | None:
        """Return the world with the given obstacles if the path and the run-up are free of them."""
        start = Pose(0.0, 0.0, 0.0)
        path = path_from_arcs(start, pieces, self.body)
        corners = [
            (c.x + sx * c.radius, c.y + sx * c.radius)
            for c in circles
            for sx in (-1, 1)
        ]
        corners += [corner for item in polygons for corner in item.corners]
        corners += [(item.start.x, item.start.y) for item in path] + [
            (path[-1].end.x, path[-1].end.y)
        ]
        far = (
            self.body.ahead
            + self.body.behind
            + 3 * (self.body.at(0.0).left + self.room)
        )
        x, y = zip(*corners, strict=True)
        bounds = Bounds((min(x) - far, max(x) + far), (min(y) - far, max(y) + far))
        world = World(tuple(circles), bounds, None, tuple(polygons))
        straight = self.body.at(0.0)
        beginning = swept_points(
            (0.0, 0.0, 0.0), 0.0, self.lead_in, self.body, 0.01, (self.room, self.room)
        )
        if depth_in(beginning, world) >= 0:
            return None
        width = straight.left + straight.right
        return _checked(start, pieces, path[-1].end, world, self.body, width, gap)

    def swept(self, pieces: Pieces) -> np.ndarray:
        """Return the points that the path covers, including the space of the run-up."""
        path = path_from_arcs(Pose(0.0, 0.0, 0.0), pieces, self.body)
        points = [
            swept_points(
                (0.0, 0.0, 0.0),
                0.0,
                self.lead_in,
                self.body,
                0.02,
                (self.room, self.room),
            ),
            *(
                swept_points(
                    (*item.start,), item.curvature, item.length, self.body, 0.02
                )
                for item in path
            ),
        ]
        return np.vstack(points)


def _circles(rng: np.random.Generator, start: _Start) -> Witnessed | None:
    pieces = start.draw_path(rng, float(rng.uniform(1.5, 3.0)))
    return start.finished(pieces, _strewn(rng, start, pieces), [])


def _polygons(rng: np.random.Generator, start: _Start) -> Witnessed | None:
    pieces = start.draw_path(rng, float(rng.uniform(1.5, 3.0)))
    result = []
    for circle in _strewn(rng, start, pieces):
        angles = (np.arange(6) + rng.uniform(0, 0.9, 6)) * math.pi / 3
        radii = circle.radius * rng.uniform(0.5, 1.0, 6)
        corners = zip(
            circle.x + radii * np.cos(angles),
            circle.y + radii * np.sin(angles),
            strict=True,
        )
        result.append(Polygon(tuple((float(x), float(y)) for x, y in corners)))
    return start.finished(pieces, [], result)


def _strewn(rng: np.random.Generator, start: _Start, pieces: Pieces) -> list[Circle]:
    """Return circles next to a path, many of them close to it."""
    swept = start.swept(pieces)
    low = swept.min(axis=0) - 0.3
    high = swept.max(axis=0) + 0.3
    result: list[Circle] = []
    for _ in range(600):
        x, y = rng.uniform(low, high)
        near = float(np.min(np.hypot(swept[:, 0] - x, swept[:, 1] - y))) - 0.012
        apart = min(
            (math.hypot(c.x - x, c.y - y) - c.radius for c in result), default=math.inf
        )
        radius = min(near, apart, float(rng.uniform(0.05, 0.25)))
        if radius > 0.03 and len(result) < 25:
            result.append(Circle(float(x), float(y), radius))
    return result


def _gaps(rng: np.random.Generator, start: _Start) -> Witnessed | None:
    ratio = float(rng.uniform(1.1, 1.8))
    count = int(rng.integers(1, 4))
    return _walls(rng, start.body, ratio, count, start.lead_in, start.room)


def _corridor(rng: np.random.Generator, start: _Start) -> Witnessed | None:
    pieces = start.draw_path(rng, float(rng.uniform(1.2, 2.5)))
    return start.finished(
        pieces, [], _sides(start, pieces[1:], pieces[:1], float(rng.uniform(1.1, 1.6)))
    )


def _sides(
    start: _Start, pieces: Pieces, before: Pieces, ratio: float
) -> list[Polygon]:
    """Return walls along both sides of a part of a path, at a multiple of the half width."""
    body = start.body
    thick = 0.03
    left = max(body.left)
    right = max(body.right)
    for item in body.transients:
        left = max(left, max(body.left) + item.left)
        right = max(right, max(body.right) + item.right)
    path = path_from_arcs(
        path_from_arcs(Pose(0.0, 0.0, 0.0), before, body)[-1].end, pieces, body
    )
    poses = [
        item.pose(s) for item in path for s in np.arange(0.0, item.length, 0.08)
    ] + [path[-1].end]
    result = []
    for near in (ratio * left, -ratio * right):
        far = near + math.copysign(thick, near)
        rows = [
            [
                (p.x - n * math.sin(p.heading), p.y + n * math.cos(p.heading))
                for n in (near, far)
            ]
            for p in poses
        ]
        result += [
            Polygon((*a, *reversed(b))) for a, b in zip(rows, rows[1:], strict=False)
        ]
    return [item for item in result if _convex(item)]


def _convex(polygon: Polygon) -> bool:
    """Return whether the corners of a strip do not cross, as they do inside a tight turn."""
    corners = np.array(polygon.corners)
    side = np.roll(corners, -1, axis=0) - corners
    after = np.roll(corners, -2, axis=0) - np.roll(corners, -1, axis=0)
    cross = side[:, 0] * after[:, 1] - side[:, 1] * after[:, 0]
    return bool((cross > 1e-9).all() or (cross < -1e-9).all())


def _pocket(rng: np.random.Generator, start: _Start) -> Witnessed | None:
    body = start.body
    ratio = float(rng.uniform(1.1, 1.5))
    depth = max(2 * (body.ahead + body.behind), 2 * body.at(0.0).left)
    pieces = [
        *start.draw_path(rng, float(rng.uniform(1.0, 2.0))),
        (0.0, _response_length(body) + body.behind + depth),
    ]
    walls = _sides(
        start, [(0.0, depth)], [*pieces[:-1], (0.0, pieces[-1][1] - depth)], ratio
    )
    end = path_from_arcs(Pose(0.0, 0.0, 0.0), pieces, body)[-1].end
    ahead = body.ahead + 0.03
    half = ratio * max(*body.left, *body.right)
    c = math.cos(end.heading)
    s = math.sin(end.heading)
    corners = [
        (ahead, half),
        (ahead + 0.03, half),
        (ahead + 0.03, -half),
        (ahead, -half),
    ]
    walls.append(
        Polygon(
            tuple((end.x + c * u - s * n, end.y + s * u + c * n) for u, n in corners)
        )
    )
    return start.finished(pieces, [], walls)


_Cell = tuple[int, int]
"""Column and row of a cell of the maze."""


def _random_spanning_tree(
    rng: np.random.Generator, columns: int, rows: int
) -> tuple[dict[_Cell, _Cell], set[frozenset[_Cell]]]:
    """Return the predecessor of each cell, and the pairs of cells without a wall."""
    at = (0, 0)
    seen = {(0, 0)}
    opened: set[frozenset[_Cell]] = set()
    trail = [at]
    before: dict[_Cell, _Cell] = {}
    while trail:
        at = trail[-1]
        near = [(at[0] + i, at[1] + j) for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1))]
        fresh = [
            n
            for n in near
            if 0 <= n[0] < columns and 0 <= n[1] < rows and n not in seen
        ]
        if not fresh:
            trail.pop()
            continue
        after = fresh[int(rng.integers(len(fresh)))]
        before[after] = at
        seen = seen | {after}
        opened.add(frozenset((at, after)))
        trail.append(after)
    return before, opened


def _maze_wall(near: tuple[float, float], far: tuple[float, float]) -> Polygon:
    """Return a wall 40 mm thick between two corners of the grid (m)."""
    thick = 0.02
    low = (near[0] - thick, near[1] - thick)
    high = (far[0] + thick, far[1] + thick)
    return Polygon((low, (high[0], low[1]), high, (low[0], high[1])))


def _maze(rng: np.random.Generator, start: _Start) -> Witnessed | None:
    body = start.body
    columns = 3
    rows = 2
    cell = 2.2 / min(body.tightest) + 2 * _response_length(body)
    entry = start.lead_in + _response_length(body) + body.ahead + start.room
    before, opened = _random_spanning_tree(rng, columns, rows)
    cells = [(columns - 1, int(rng.integers(rows)))]
    while cells[0] in before:
        cells.insert(0, before[cells[0]])
    moves = [
        (1, 0),
        *((b[0] - a[0], b[1] - a[1]) for a, b in zip(cells, cells[1:], strict=False)),
        (1, 0),
    ]
    if moves[-2] == (-1, 0):
        return None
    response_length = _response_length(body)
    pieces = [(0.0, entry)]
    for (ax, ay), (bx, by) in zip(moves, moves[1:], strict=False):
        turn = ax * by - ay * bx
        radius = cell / 2 - response_length
        bend = (
            [(turn / radius, radius * math.pi / 2)]
            if turn
            else [(0.0, cell - 2 * response_length)]
        )
        pieces += [(0.0, response_length), *bend, (0.0, response_length)]
    pieces.append((0.0, body.behind + 0.05))
    walls = []
    x0 = entry
    y0 = -cell / 2

    ends = {((-1, 0), (0, 0)), (cells[-1], (columns, cells[-1][1]))}
    for i in range(columns + 1):
        for j in range(rows):
            sides = (i - 1, j), (i, j)
            if frozenset(sides) not in opened and sides not in ends:
                near = (x0 + i * cell, y0 + j * cell)
                far = (x0 + i * cell, y0 + (j + 1) * cell)
                walls.append(_maze_wall(near, far))
    for i in range(columns):
        for j in range(rows + 1):
            if frozenset(((i, j - 1), (i, j))) not in opened:
                near = (x0 + i * cell, y0 + j * cell)
                far = (x0 + (i + 1) * cell, y0 + j * cell)
                walls.append(_maze_wall(near, far))
    return start.finished(pieces, [], walls)


KINDS = {
    "circles": _circles,
    "polygons": _polygons,
    "walls": _gaps,
    "corridors": _corridor,
    "pockets": _pocket,
    "mazes": _maze,
}
"""Functions that draw a world, by name of its kind."""


def _walls(
    rng: np.random.Generator,
    body: Footprint,
    ratio: float,
    count: int,
    first: float = 0.0,
    room: float = 0.0,
) -> Witnessed | None:
    straight = body.at(0.0)
    width = straight.left + straight.right
    thick = float(rng.uniform(0.02, 0.08))
    lead_in = _response_length(body) + body.ahead + 0.01
    run_out = body.behind + 0.01
    pieces = [(0.0, 0.5 * width + first)]
    heading = 0.0
    places = []
    for _ in range(count):
        pieces += _bend(rng, body, heading, float(rng.uniform(-0.5, 0.5)))
        heading = sum(k * length for k, length in pieces)
        pieces.append((0.0, lead_in + thick))
        places.append(len(pieces))
        pieces.append((0.0, thick + run_out + float(rng.uniform(0.0, width))))
    start = Pose(0.0, 0.0, 0.0)
    ends = [start]
    for k, length in pieces:
        ends.append(path_from_arcs(ends[-1], [(k, length)], body)[-1].end)
    x = [item.x for item in ends]
    y = [item.y for item in ends]
    room = 3 * width + body.ahead + body.behind
    bounds = Bounds(
        (min(x) - room, max(x) + room), (min(y) - 2 * room, max(y) + 2 * room)
    )
    polygons: list[Polygon] = []
    circles: list[Circle] = []
    for place in places:
        if rng.random() < 0.3:
            circles += _row(
                rng, ends[place], straight.left, straight.right, ratio, bounds
            )
        else:
            polygons += _wall(
                rng, ends[place], straight.left, straight.right, ratio, thick, bounds
            )
    world = World(tuple(circles), bounds, None, tuple(polygons))
    if (
        depth_in(
            swept_points((0.0, 0.0, 0.0), 0.0, first, body, 0.01, (room, room)), world
        )
        >= 0
    ):
        return None
    return _checked(start, pieces, ends[-1], world, body, width, ratio)


def _bend(
    rng: np.random.Generator, body: Footprint, heading: float, to: float
) -> Pieces:
    """Return arcs that end with another heading, some with a lateral offset."""
    low = body.curvatures[0]
    high = body.curvatures[-1]
    fraction = float(rng.uniform(0.4, 0.95))
    side = 1.0 if rng.random() < 0.5 else -1.0
    first = side * float(rng.uniform(0.1, 0.6))
    pieces = []
    for turn in (first, to - heading - first):
        tightest = high if turn > 0 else low
        pieces.append((fraction * tightest, abs(turn / (fraction * tightest))))
    return pieces


def _wall(
    rng: np.random.Generator,
    at: Pose,
    left: float,
    right: float,
    ratio: float,
    thick: float,
    bounds: Bounds,
) -> list[Polygon]:
    """Return both sides of a wall across a path, with its gap at the body and a small inclination."""
    tilt = float(rng.uniform(-0.1, 0.1))
    half = ratio * (left + right) / 2 / math.cos(tilt) + thick / 2 * math.tan(abs(tilt))
    along = at.heading + math.pi / 2 + tilt
    middle = (left - right) / 2
    x = at.x - middle * math.sin(at.heading)
    y = at.y + middle * math.cos(at.heading)
    (west, east), (south, north) = bounds.x, bounds.y
    far = math.hypot(east - west, north - south)
    c = math.cos(along)
    s = math.sin(along)
    across = (s * thick / 2, -c * thick / 2)
    made = []
    for sign in (1.0, -1.0):
        near = sign * half
        end = sign * far
        corners = [(near, 1.0), (end, 1.0), (end, -1.0), (near, -1.0)]
        made.append(
            Polygon(
                tuple(
                    (x + c * u + w * across[0], y + s * u + w * across[1])
                    for u, w in corners
                )
            )
        )
    return made


def _row(
    rng: np.random.Generator,
    at: Pose,
    left: float,
    right: float,
    ratio: float,
    bounds: Bounds,
) -> list[Circle]:
    """Return a row of circles across a path, as a wall with a gap."""
    half = ratio * (left + right) / 2
    along = at.heading + math.pi / 2 + float(rng.uniform(-0.1, 0.1))
    middle = (left - right) / 2
    x = at.x - middle * math.sin(at.heading)
    y = at.y + middle * math.cos(at.heading)
    made = []
    for sign in (1.0, -1.0):
        place = half
        while place < math.hypot(bounds.x[1] - bounds.x[0], bounds.y[1] - bounds.y[0]):
            radius = float(rng.uniform(0.2, 0.6)) * (left + right)
            place += radius
            made.append(
                Circle(
                    x + sign * place * math.cos(along),
                    y + sign * place * math.sin(along),
                    radius,
                )
            )
            place += radius
    return made


def _checked(
    start: Pose,
    pieces: Pieces,
    end: Pose,
    world: World,
    body: Footprint,
    width: float,
    gap: float = math.inf,
) -> Witnessed | None:
    """Return the world if the path is free."""
    goal = Goal(end.x, end.y, end.heading, 0.02 + 0.1 * width, 0.1)
    problem = Problem(start, goal, world, body)
    witness = Plan(
        PlanOutcome.FOUND, "drawn first", path_from_arcs(start, pieces, body)
    )
    return (
        Witnessed(problem, witness, width, gap)
        if deepest(witness, problem) < 0
        else None
    )
