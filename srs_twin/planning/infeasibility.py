r"""Proofs of infeasibility, and a lower bound on the length of any path.

Proof by connectivity, independent of curvature. Consider a point o of an obstacle whose
distance from a smooth path is below the clearance w, the smallest distance of an edge
from the path. If the nearest point of the path is not an end of it, o is straight
across from that point and within the edges: a collision. So the nearest point is an
end, at most w from o, and all other points of the path within w of o are within 2 w of
that end. Hence a collision-free path is contained in the free space. This is the
complement of the obstacles grown by w, within the bounds reduced by w, together with
discs of radius 2 w around both ends. If start and goal are in different connected
components, no path exists; otherwise the shortest line in the component is a lower
bound on the path length.

Proof by curvature. All poses reachable from a start or goal by paths of curvature at
most K are covered by cells in x, y and heading. From a cell, a path of length L with
turn Δ has headings between those of the two paths that turn first to one side and then
to the other at curvature K,

$$ θ_{lo}(s) = \max(-Ks,\ Δ - K(L - s)) \le θ(s) \le \min(Ks,\ Δ + K(L - s)) = θ_{hi}(s), $$

and stays within K L²/8 of the chord between its ends. All cells that this set overlaps
are marked, unless a point on the way is closer to an obstacle than the clearance w by
more than the rounding of cells. If no more cells can be marked before they come near
the other end, no path exists.

An obstacle closer than w to a path is straight across from it, within the edges, or
beyond the end E of the head (or tail) at the last pose, closer than w to E. Therefore a
point p counts as blocked if an obstacle is closer than w' = min(w, |p - E|/2).
"""

from __future__ import annotations

import heapq
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, kernel_only
from srs_twin.planning.collision import ObstacleGrid, obstacle_shapes
from srs_twin.planning.footprint import Footprint
from srs_twin.robot.world import Goal, Pose, World

if TYPE_CHECKING:
    import shapely

_FINE_CHORDS = 32
"""Chords per quarter circle of the connectivity proof.

Chords lie inside the circle, which only widens gaps."""
_COARSE_CHORDS = 4
"""Chords per quarter circle of the length bound: fewer corners, a faster search."""
_ROUNDING_M = 1e-9
"""Tolerance for lines along the boundary of the free space, m."""

_MAX_TURN = 0.5
"""Largest turn of a step, rad."""
_INTEGRATION_POINTS = 64
"""Points of the midpoint rule along a step."""
_CHECKED_POINTS = 4
"""Points of a step that are checked for obstacles."""


class Resolution(NamedTuple):
    """Resolution of the proof by curvature.

    Attributes:
        sectors: heading cells per turn of a step.
        cells: position cells per length of a step.
        exit_radii: distance from the end at which a path has left its surroundings, in
            turning radii.
        max_cells: largest number of cells.
    """

    sectors: int
    cells: int
    exit_radii: float
    max_cells: int


COARSE = Resolution(6, 8, 1.5, 30_000)
"""Fast resolution, tried first."""
FINE = Resolution(10, 16, 4.0, 40_000)
"""Slow resolution for dead ends that `COARSE` does not prove."""


class _Reach(NamedTuple):
    """Steps and cells of the proof by curvature.

    Attributes:
        curvature: largest curvature K, 1/m.
        clearance: clearance w, m.
        step: length L of a step, m.
        cell: side of a cell, m.
    """

    curvature: float
    clearance: float
    step: float
    cell: float


def is_disconnected(start: Pose, goal: Goal, world: World, clearance: float) -> bool:
    """Return whether start and goal are in different components of the free space.

    Args:
        start: start of the path.
        goal: goal; the path may end anywhere within its radius.
        world: obstacles and bounds.
        clearance: `Footprint.narrowest`, m.
    """
    return _free_component(start, goal, world, clearance, _FINE_CHORDS) is None


def min_path_length(start: Pose, goal: Goal, world: World, clearance: float) -> float:
    """Return a lower bound on the length of any path from start to goal, m; infinite if there is none.

    Args:
        start: start of the path.
        goal: goal; the path may end anywhere within its radius.
        world: obstacles and bounds.
        clearance: `Footprint.narrowest`, m.
    """
    import shapely

    component = _free_component(start, goal, world, clearance, _COARSE_CHORDS)
    if component is None:
        return math.inf
    # A* on the visibility graph: shortest lines bend at corners of the free space only.
    # Visibility is tested late, when a line reaches the front of the queue.
    free = component.buffer(_ROUNDING_M, join_style="mitre")
    shapely.prepare(free)
    corners = np.array(
        [(start.x, start.y), (goal.x, goal.y), *_reflex_corners(component)]
    )
    straight = np.hypot(*(corners - corners[1]).T)
    done = np.zeros(len(corners), dtype=bool)
    queue = [(float(straight[0]), 0.0, 0, 0)]
    while queue:
        _, length, before, here = heapq.heappop(queue)
        if done[here] or not free.covers(
            shapely.linestrings([corners[before], corners[here]])
        ):
            continue
        if here == 1:
            return max(length - goal.radius, 0.0)
        done[here] = True
        lengths = length + np.hypot(*(corners - corners[here]).T)
        for there in np.flatnonzero(~done).tolist():
            heapq.heappush(
                queue,
                (
                    float(lengths[there] + straight[there]),
                    float(lengths[there]),
                    here,
                    there,
                ),
            )
    return math.inf


def _reflex_corners(polygon: shapely.Polygon) -> list[tuple[float, float]]:
    """Return the corners with an interior angle above π, at which shortest lines may bend."""
    import shapely

    corners: list[tuple[float, float]] = []
    oriented = shapely.geometry.polygon.orient(polygon)
    for ring in (oriented.exterior, *oriented.interiors):
        at = np.asarray(ring.coords)[:-1]
        before = at - np.roll(at, 1, axis=0)
        after = np.roll(at, -1, axis=0) - at
        corners += at[before[:, 0] * after[:, 1] < before[:, 1] * after[:, 0]].tolist()
    return corners


def _free_component(
    start: Pose, goal: Goal, world: World, clearance: float, chords: int
) -> shapely.Polygon | None:
    """Return the connected component of the free space with start and goal; None if they differ."""
    import shapely

    here = shapely.Point(start.x, start.y)
    there = shapely.Point(goal.x, goal.y)
    # Discs are drawn as polygons around the circle: the free space must not be too
    # small.
    around = 1 / math.cos(math.pi / (4 * chords))
    ends = [
        here.buffer(2 * clearance * around, quad_segs=chords),
        there.buffer((2 * clearance + goal.radius) * around, quad_segs=chords),
    ]
    grown = [
        core.buffer(radius + clearance, quad_segs=chords)
        for _, core, radius in obstacle_shapes(world)
    ]
    blocked = shapely.union_all(grown)
    box = _reduced_bounds(world, shapely.union_all([blocked, *ends]).bounds, clearance)
    free = shapely.union_all([box.difference(blocked), *ends])
    if free.geom_type == "MultiPolygon":
        components = list(free.geoms)
    else:
        components = [free]
    return next(
        (
            part
            for part in components
            if part.intersects(here) and part.intersects(there)
        ),
        None,
    )


def _reduced_bounds(
    world: World, extent: tuple[float, float, float, float], clearance: float
) -> shapely.Polygon:
    """Return the bounds reduced by the clearance; without bounds a box with room around all obstacles."""
    import shapely

    if world.bounds is None:
        west, south, east, north = extent
        return shapely.box(
            west - clearance, south - clearance, east + clearance, north + clearance
        )
    (west, east), (south, north) = world.bounds.x, world.bounds.y
    west = west + clearance
    east = east - clearance
    south = south + clearance
    north = north - clearance
    if west < east and south < north:
        return shapely.box(west, south, east, north)
    return shapely.Polygon()


def prove_unreachable(
    start: Pose, goal: Goal, body: Footprint, grid: ObstacleGrid, resolution: Resolution
) -> str:
    """Return "start" or "goal" if no path with the body's turns leaves that end; "" without a proof.

    Args:
        start: start of the path.
        goal: goal.
        body: footprint.
        grid: obstacles and bounds.
        resolution: size of cells; a finer one may find a proof where a coarse one does
            not.
    """
    curvature = max(body.tightest)
    clearance = body.narrowest
    # Limit the step: longer ones could pass obstacles between the checked points.
    step = min(_MAX_TURN / curvature, 2 * clearance)
    sectors = math.ceil(2 * math.pi / (curvature * step / resolution.sectors))
    boxes = _step_boxes(curvature, step, 2 * math.pi / sectors)
    cell = step / resolution.cells
    reach = _Reach(curvature, clearance, step, cell)
    # An end: x, y, heading away from it, position and heading tolerance, reach of the
    # body behind it.
    first = np.array([start.x, start.y, start.heading, 0.0, 0.0, body.behind])
    # From the goal the path is followed backwards.
    if goal.heading is None:
        heading = 0.0
        tolerance = math.pi
    else:
        heading = goal.heading + math.pi
        tolerance = goal.heading_tolerance
    last = np.array([goal.x, goal.y, heading, goal.radius, tolerance, body.ahead])
    for name, end, other in (("goal", last, first), ("start", first, last)):
        side = math.ceil((resolution.exit_radii / curvature + end[3] + end[5]) / cell)
        # A large array, of which the operating system allocates only the few pages that
        # are used.
        marked = np.zeros((2 * side + 1, 2 * side + 1, sectors), dtype=np.bool_)
        if _exhausts_cells(
            end, other, reach, boxes, marked, resolution.max_cells, grid
        ):
            return name
    return ""


def _step_boxes(curvature: float, step: float, sector: float) -> np.ndarray:
    """Return the bounding boxes of all steps from the origin, by turn.

    Args:
        curvature: largest curvature K, 1/m.
        step: length L of a step, m.
        sector: width of a heading cell, rad.

    Returns:
        Turn in sectors, minimum and maximum x, minimum and maximum y (m), shape (n, 5).
    """
    s = (np.arange(_INTEGRATION_POINTS) + 0.5) / _INTEGRATION_POINTS * step
    max_turn = curvature * step
    rows = []
    for turn in range(-math.ceil(max_turn / sector), math.ceil(max_turn / sector) + 1):
        # Start and end may lie anywhere in their sectors.
        low = max((turn - 1) * sector, -max_turn)
        high = min((turn + 1) * sector, max_turn)
        if low > high:
            continue
        lowest = np.maximum(-curvature * s, low - curvature * (step - s))
        highest = np.minimum(curvature * s, high + curvature * (step - s))
        smallest = np.where(
            (lowest <= 0) & (highest >= 0), 0.0, np.minimum(abs(lowest), abs(highest))
        )
        # Bounds of the integrals of cos θ and sin θ over all admissible headings.
        x = (
            np.cos(np.maximum(abs(lowest), abs(highest))).mean(),
            np.cos(smallest).mean(),
        )
        y = np.sin(lowest).mean(), np.sin(highest).mean()
        error = step / _INTEGRATION_POINTS**2  # of the midpoint rule
        rows.append(
            (
                turn,
                step * x[0] - error,
                step * x[1] + error,
                step * y[0] - error,
                step * y[1] + error,
            )
        )
    return np.array(rows)


@allocating
def _exhausts_cells(end, other, reach, boxes, marked, max_cells, grid):  # type: ignore[no-untyped-def]
    """Return whether all cells reachable from an end stay in its surroundings, away from the other end.

    Args:
        end: end to start from, see `prove_unreachable`, shape (6,).
        other: the other end, shape (6,).
        reach: steps and cells.
        boxes: bounding boxes of the steps, as `_step_boxes`, shape (n, 5).
        marked: reached cells, initially False, shape (columns, rows, sectors).
        max_cells: largest number of cells; without a proof if it is reached.
        grid: obstacles and bounds.
    """
    sectors = marked.shape[2]
    side = marked.shape[0] // 2
    sector = 2 * np.pi / sectors
    cell = reach.cell
    west = end[0] - side * cell
    south = end[1] - side * cell
    distances = np.full((2 * side + 1, 2 * side + 1), np.nan)  # computed when needed
    stack = np.empty((max_cells, 3), dtype=np.int32)
    count = _mark_end(end, cell, marked, stack)
    if count < 0:
        return False
    # Point E of the module docstring, with its uncertainty, for both ends.
    body = _body_end(end, reach.curvature)
    far_x, far_y, far_loose = _body_end(other, reach.curvature)
    # Deviation from the chord, and rounding to cells.
    slack = reach.curvature * reach.step * reach.step / 8 + np.sqrt(2.0) * cell
    near = far_loose + 2 * reach.clearance + reach.step + slack
    arrival = other[3] + reach.step + slack
    extra = reach.step * sector / 2 + cell / 2  # rounding of heading and position
    total = count
    # Depth-first: the order does not matter, because all reachable cells are marked.
    while count > 0:
        count -= 1
        i, j, k = stack[count]
        x = west + i * cell
        y = south + j * cell
        if (
            np.hypot(x - far_x, y - far_y) < near
            or np.hypot(x - other[0], y - other[1]) < arrival
        ):
            return False
        c = np.cos((k + 0.5) * sector)
        s = np.sin((k + 0.5) * sector)
        for box in range(len(boxes)):
            turn, low_x, high_x, low_y, high_y = _turned_box(boxes[box], c, s, extra)
            first_i = _nearest(x + low_x - west, cell)
            last_i = _nearest(x + high_x - west, cell)
            first_j = _nearest(y + low_y - south, cell)
            last_j = _nearest(y + high_y - south, cell)
            to_k = (k + turn) % sectors
            # A cell beyond the grid has left the surroundings, so there is no proof.
            if first_i < 0 or first_j < 0 or last_i > 2 * side or last_j > 2 * side:
                return False
            for to_i in range(first_i, last_i + 1):
                for to_j in range(first_j, last_j + 1):
                    step = i, j, to_i, to_j
                    if marked[to_i, to_j, to_k] or _is_blocked(
                        step, (west, south), body, reach, slack, distances, grid
                    ):
                        continue
                    marked[to_i, to_j, to_k] = True
                    stack[count, 0] = to_i
                    stack[count, 1] = to_j
                    stack[count, 2] = to_k
                    count += 1
                    total += 1
                    if total + 1 >= max_cells:
                        return False
    return True


@kernel_only
def _nearest(position, cell):  # type: ignore[no-untyped-def]
    """Return the nearest cell of a position."""
    return int(np.round(position / cell))


@kernel_only
def _turned_box(box, c, s, extra):  # type: ignore[no-untyped-def]
    """Return turn and bounds of a box of `_step_boxes` after a rotation and a widening (m)."""
    turn, low_x, high_x, low_y, high_y = box
    x = (low_x + high_x) / 2
    y = (low_y + high_y) / 2
    half_x = (high_x - low_x) / 2
    half_y = (high_y - low_y) / 2
    to_x = c * x - s * y
    to_y = s * x + c * y
    wide_x = abs(c) * half_x + abs(s) * half_y + extra
    wide_y = abs(s) * half_x + abs(c) * half_y + extra
    return int(turn), to_x - wide_x, to_x + wide_x, to_y - wide_y, to_y + wide_y


@kernel_only
def _is_blocked(step, origin, body, reach, slack, distances, grid):  # type: ignore[no-untyped-def]
    """Return whether a point along a step between two cells is closer to an obstacle than w'.

    Args:
        step: column and row of both cells.
        origin: x and y of the first cell, m.
        body: point E and its uncertainty, as `_body_end`.
        reach: steps and cells.
        slack: deviation from the chord and rounding to cells, m.
        distances: distance of each cell from the obstacles, m; NaN: not computed yet.
        grid: obstacles and bounds.
    """
    i, j, to_i, to_j = step
    for point in range(1, _CHECKED_POINTS + 1):
        share = point / _CHECKED_POINTS
        at_i = int(np.round(i + share * (to_i - i)))
        at_j = int(np.round(j + share * (to_j - j)))
        x = origin[0] + at_i * reach.cell
        y = origin[1] + at_j * reach.cell
        if np.isnan(distances[at_i, at_j]):
            distances[at_i, at_j] = _obstacle_distance(x, y, grid)
        from_end = np.hypot(x - body[0], y - body[1])
        required = min(reach.clearance, (from_end - body[2] - slack) / 2)
        if distances[at_i, at_j] + slack < required:
            return True
    return False


@kernel_only
def _mark_end(end, cell, marked, stack):  # type: ignore[no-untyped-def]
    """Mark and stack the cells of all poses within the tolerances of an end.

    Returns:
        Number of cells; -1 if the stack is full.
    """
    sectors = marked.shape[2]
    side = marked.shape[0] // 2
    rim = int(np.ceil(end[3] / cell)) + 1
    sector = 2 * np.pi / sectors
    fan = min(int(np.ceil(end[4] / sector)) + 1, sectors // 2)
    middle = int(
        np.floor((end[2] / (2 * np.pi) - np.floor(end[2] / (2 * np.pi))) * sectors)
    )
    count = 0
    for i in range(side - rim, side + rim + 1):
        for j in range(side - rim, side + rim + 1):
            if np.hypot(i - side, j - side) * cell <= end[3] + cell:
                for k in range(middle - fan, middle + fan + 1):
                    if not marked[i, j, k % sectors]:
                        marked[i, j, k % sectors] = True
                        stack[count, 0] = i
                        stack[count, 1] = j
                        stack[count, 2] = k % sectors
                        count += 1
                        if count + 1 >= len(stack):
                            return -1
    return count


@kernel_only
def _body_end(end, curvature):  # type: ignore[no-untyped-def]
    """Return x and y of the body's end at an end of the path, and their uncertainty, m."""
    reach = end[5]
    loose = end[3] + reach * min(2.0, end[4] + curvature * reach / 2)
    return end[0] - reach * np.cos(end[2]), end[1] - reach * np.sin(end[2]), loose


@kernel_only
def _obstacle_distance(x, y, grid):  # type: ignore[no-untyped-def]
    """Return the distance of a point from the nearest obstacle or bound, m.

    Negative in a circle and outside the bounds.
    """
    bounds = grid.bounds
    least = min(min(x - bounds[0], bounds[1] - x), min(y - bounds[2], bounds[3] - y))
    for k in range(len(grid.circles)):
        least = min(
            least,
            np.hypot(x - grid.circles[k, 0], y - grid.circles[k, 1])
            - grid.circles[k, 2],
        )
    for k in range(len(grid.sides)):
        ax, ay, bx, by = grid.sides[k]
        dx = bx - ax
        dy = by - ay
        share = ((x - ax) * dx + (y - ay) * dy) / max(dx * dx + dy * dy, 1e-300)
        share = min(max(share, 0.0), 1.0)
        least = min(least, np.hypot(x - ax - share * dx, y - ay - share * dy))
    return least
