"""Compiled kernels of the best-first search over arcs (hybrid A*).

A node is a pose that a sequence of arcs reaches from the start. Nodes are expanded in
the order of g + w h, where g is the length of the path to the node and w is a weight.
The heuristic h is the length of the Dubins path to the goal with the minimum turning
radius, which is a lower bound on the remaining length. Along an arc, h decreases by at
most the arc length, so the values g + h never decrease for w = 1. Without guidance, the
path is at most w times as long as the shortest path on the same arcs and cells.

If the Dubins path from an expanded node to the goal is collision-free, a plan is found.
The open list is a binary heap. The closed set is a hash table with one node per cell of
poses, and a node is replaced only by a node with a shorter path. The search is
therefore finite but incomplete, because a dropped pose might have a collision-free
continuation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled, kernel_only
from srs_twin.planning.arcs import arc_end
from srs_twin.planning.collision import ObstacleGrid
from srs_twin.planning.dubins import dubins_path
from srs_twin.planning.guidance import GridHeuristic, grid_distance
from srs_twin.planning.primitives import (
    ArcState,
    MotionPrimitives,
    follow_arc,
    follow_dubins_path,
)

# Indices in `Frontier.counts` for the numbers of created, open and expanded nodes.
NODES = 0
OPEN = 1
EXPANDED = 2

CONNECTED = 0
"""Result of `expand` if a Dubins path from a node to the goal is collision-free."""
ARRIVED = 1
"""Result of `expand` if a node is within the tolerances of the goal."""
PAUSED = 2
"""Result of `expand` if the requested number of nodes has been expanded."""
EXHAUSTED = 3
"""Result of `expand` if no open node is left."""
FULL = 4
"""Result of `expand` if the arrays are full."""

_INDEX_BITS = 26
"""Number of bits that a cell key contains for each of the row and column numbers."""
_INDEX_OFFSET = 1 << (_INDEX_BITS - 1)
"""Offset added to row and column numbers to make them positive."""

_COST_TOLERANCE = 1e-9
"""Minimum reduction of the path length for which a node is replaced, m."""
_PASSAGE_INTERVAL = 4
"""Number of expanded nodes between two attempts to use narrow passages.

Testing a passage takes far more time than testing an arc.
"""
_PASSAGE_REACH = 6.0
"""Distance beyond which a narrow passage is not tried, in turning radii.

Twice the length of the passage is added to this distance.
"""


class Node(NamedTuple):
    """Pose reached by the search, with its path length and transient.

    Attributes:
        x, y, heading: pose, m and rad.
        cost: length of the path from the start to the node, m.
        bound: lower bound on the remaining length, m.
        left, right: outward shifts of the left and right edges due to transients, m.
        lasting: remaining path length over which the edges are shifted, m.
    """

    x: float
    y: float
    heading: float
    cost: float
    bound: float
    left: float
    right: float
    lasting: float


_COST = Node._fields.index("cost")


class Frontier(NamedTuple):
    """State of a search, with its nodes, open list and closed set.

    Attributes:
        nodes: fields of each `Node`, shape (capacity, 8).
        links: index of the parent node (-1 for a root) and index of the arc from the
            parent, shape (capacity, 2).
        keys, heap: values g + w h (m) and node indices in heap order, shape
            (capacity,).
        cells: cell key in each slot of the hash table, shape (slots,), where the number
            of slots is a power of 2.
        owners: 1 + index of the node that represents the cell, or 0 for an empty slot,
            shape (slots,).
        counts: numbers of created, open and expanded nodes, shape (3,).
    """

    nodes: np.ndarray
    links: np.ndarray
    keys: np.ndarray
    heap: np.ndarray
    cells: np.ndarray
    owners: np.ndarray
    counts: np.ndarray


def empty_frontier(capacity: int) -> Frontier:
    """Return the state of a new search with space for `capacity` nodes."""
    # With at least two slots per node, hash collisions are rare.
    slots = 1 << (2 * capacity - 1).bit_length()
    nodes = np.empty((capacity, len(Node._fields)))
    links = np.empty((capacity, 2), dtype=np.int32)
    keys = np.empty(capacity)
    heap = np.empty(capacity, dtype=np.int32)
    cells = np.empty(slots, dtype=np.int64)
    owners = np.zeros(slots, dtype=np.int32)
    return Frontier(
        nodes, links, keys, heap, cells, owners, np.zeros(3, dtype=np.int64)
    )


def enlarged(frontier: Frontier) -> Frontier:
    """Return a copy of a search with eight times the capacity."""
    larger = empty_frontier(8 * len(frontier.nodes))
    count = int(frontier.counts[NODES])
    for old, new in zip(frontier[:4], larger[:4], strict=True):
        new[:count] = old[:count]
    larger.counts[:] = frontier.counts
    _copy_cells(frontier, larger)
    return larger


@compiled
def push(frontier, node, key):  # type: ignore[no-untyped-def]
    """Add a node to the heap."""
    keys = frontier.keys
    heap = frontier.heap
    place = frontier.counts[OPEN]
    frontier.counts[OPEN] += 1
    while place > 0:
        parent = (place - 1) >> 1
        if keys[parent] <= key:
            break
        keys[place] = keys[parent]
        heap[place] = heap[parent]
        place = parent
    keys[place] = key
    heap[place] = node


@compiled
def pop(frontier):  # type: ignore[no-untyped-def]
    """Remove and return the node with the minimum key."""
    keys = frontier.keys
    heap = frontier.heap
    frontier.counts[OPEN] -= 1
    size = frontier.counts[OPEN]
    first = heap[0]
    key = keys[size]
    node = heap[size]
    place = 0
    while True:
        child = 2 * place + 1
        if child >= size:
            break
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[place] = keys[child]
        heap[place] = heap[child]
        place = child
    keys[place] = key
    heap[place] = node
    return first


@compiled
def cell_slot(frontier, x, y, heading, cell, sector):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the hash table slot for the cell of a pose, and add the cell if it is new.

    The cell size `cell` is in m, and the heading range `sector` (rad) must divide 2π.
    """
    row = np.int64(np.floor(x / cell)) + _INDEX_OFFSET
    column = np.int64(np.floor(y / cell)) + _INDEX_OFFSET
    turns = heading / (2 * np.pi)
    layer = np.int64(np.floor((turns - np.floor(turns)) * 2 * np.pi / sector))
    return _key_slot(
        frontier, (layer << (2 * _INDEX_BITS)) | (row << _INDEX_BITS) | column
    )


@kernel_only
def _key_slot(frontier, key):  # type: ignore[no-untyped-def]
    # Fibonacci hashing multiplies the key by 2⁶⁴ divided by the golden ratio, modulo
    # 2⁶⁴.
    last = frontier.cells.shape[0] - 1
    slot = ((key * np.int64(-7046029254386353131)) >> 20) & last
    while frontier.owners[slot] != 0 and frontier.cells[slot] != key:
        slot = (slot + 1) & last
    frontier.cells[slot] = key
    return slot


@compiled
def _copy_cells(frontier, larger):  # type: ignore[no-untyped-def]
    for old in range(frontier.cells.shape[0]):
        if frontier.owners[old] != 0:
            larger.owners[_key_slot(larger, frontier.cells[old])] = frontier.owners[old]


class Target(NamedTuple):
    """Goal of a search.

    Attributes:
        x, y: position, m.
        heading: heading, which is ignored if `any_heading` is true, rad.
        radius: position tolerance, m.
        heading_tolerance: heading tolerance, rad.
        bound_radius: smaller of the minimum left and right turning radii, used for the
            lower bound, m.
        dubins_radius: larger of the minimum left and right turning radii, used for
            Dubins paths that the snake can follow, m.
    """

    x: float
    y: float
    heading: float
    any_heading: bool
    radius: float
    heading_tolerance: float
    bound_radius: float
    dubins_radius: float


class SearchSpec(NamedTuple):
    """Parameters of a search.

    Attributes:
        cell: cell size in x and y, m.
        sector: heading range of a cell, which must divide 2π, rad.
        weight: weight w of the lower bound.
        heuristic: grid distances, which affect only the order of expansion.
        passages: entry poses and lengths of narrow passages, as returned by
            `guidance.find_passages`.
    """

    primitives: MotionPrimitives
    target: Target
    grid: ObstacleGrid
    cell: float
    sector: float
    weight: float
    heuristic: GridHeuristic
    passages: np.ndarray


@compiled
def lower_bound(x, y, heading, target):  # type: ignore[no-untyped-def]
    """Return the lower bound h on the path length from a pose to the goal, m."""
    return _path_to_goal(x, y, heading, target, target.bound_radius).length


@kernel_only
def _path_to_goal(x, y, heading, target, radius):  # type: ignore[no-untyped-def]
    return dubins_path(
        x,
        y,
        heading,
        target.x,
        target.y,
        target.heading,
        target.any_heading,
        radius,
    )


@compiled
def add_root(frontier, x, y, heading, spec):  # type: ignore[no-untyped-def]
    """Add a start pose, unless the cell of the pose already contains a node."""
    slot = cell_slot(frontier, x, y, heading, spec.cell, spec.sector)
    bound = lower_bound(x, y, heading, spec.target)
    if frontier.owners[slot] == 0:
        node = Node(x, y, heading, 0.0, bound, 0.0, 0.0, 0.0)
        root = _add_node(frontier, slot, -1, len(spec.primitives.curvatures), node)
        push(frontier, root, bound)


@compiled
def expand(frontier, spec, best, count):  # type: ignore[no-untyped-def]
    """Expand nodes until an event, such as `CONNECTED`, occurs.

    Args:
        frontier: state of the search, which is modified.
        spec: search parameters.
        best: length of the best plan so far, m. Nodes that cannot lead to a shorter
            plan are dropped.
        count: maximum number of nodes to expand.

    Returns:
        Event and index of the node at which it occurred, or -1.
    """
    primitives = spec.primitives
    until = frontier.counts[EXPANDED] + count
    while frontier.counts[OPEN] > 0:
        if frontier.counts[EXPANDED] >= until:
            return PAUSED, -1
        # A node may be removed from the heap only if the arrays have space for all its
        # children.
        children = (
            primitives.children.shape[0]
            + primitives.dubins_moves.shape[0] * spec.passages.shape[0]
        )
        if frontier.counts[NODES] + children > frontier.nodes.shape[0]:
            return FULL, -1
        node = pop(frontier)
        at = _node(frontier, node)
        slot = cell_slot(frontier, at.x, at.y, at.heading, spec.cell, spec.sector)
        # A node is skipped if a node with a shorter path has replaced it in its cell.
        if frontier.owners[slot] != node + 1 or at.cost + at.bound >= best:
            continue
        frontier.counts[EXPANDED] += 1
        if _in_goal(at, spec.target):
            return ARRIVED, node
        if _connects_to_goal(frontier, node, spec, best):
            return CONNECTED, node
        for move in primitives.children:
            _try_arc(frontier, node, move, spec, best)
        if frontier.counts[EXPANDED] % _PASSAGE_INTERVAL == 1:
            _try_passages(frontier, node, spec, best)
    return EXHAUSTED, -1


@kernel_only
def _try_arc(frontier, node, move, spec, best):  # type: ignore[no-untyped-def]
    primitives = spec.primitives
    state, cost = _arc_state(frontier, node, primitives)
    curvature = primitives.curvatures[move]
    x, y, heading = arc_end(
        state.x, state.y, state.heading, curvature, primitives.length
    )
    slot = cell_slot(frontier, x, y, heading, spec.cell, spec.sector)
    cost += primitives.length
    if _is_taken(frontier, slot, cost):
        return
    free, state = follow_arc(state, move, primitives.length, primitives, spec.grid)
    if not free:
        return
    bound = lower_bound(x, y, heading, spec.target)
    if cost + bound >= best:
        return
    child = Node(x, y, heading, cost, bound, state.left, state.right, state.lasting)
    _open_node(frontier, slot, node, move, child, spec)


@kernel_only
def _try_passages(frontier, node, spec, best):  # type: ignore[no-untyped-def]
    for passage in range(len(spec.passages)):
        for factor in range(len(spec.primitives.radius_factors)):
            _try_passage(frontier, node, passage, factor, spec, best)


@kernel_only
def _try_passage(frontier, node, passage, factor, spec, best):  # type: ignore[no-untyped-def]
    """Add a node at the exit of a narrow passage if a Dubins path leads to the passage.

    The arc index of the new node is −1 − passage · n − factor, where n is the number of
    radius factors.
    """
    primitives = spec.primitives
    target = spec.target
    state, cost = _arc_state(frontier, node, primitives)
    entry_x, entry_y, entry_heading, through = spec.passages[passage]
    dx = entry_x - state.x
    dy = entry_y - state.y
    reach = _PASSAGE_REACH * target.dubins_radius + 2 * through
    if dx * dx + dy * dy > reach * reach:
        return
    x, y, heading = arc_end(entry_x, entry_y, entry_heading, 0.0, through)
    slot = cell_slot(frontier, x, y, heading, spec.cell, spec.sector)
    radius = target.dubins_radius * primitives.radius_factors[factor]
    path = dubins_path(
        state.x,
        state.y,
        state.heading,
        entry_x,
        entry_y,
        entry_heading,
        False,
        radius,
    )
    cost += path.length + through
    bound = lower_bound(x, y, heading, target)
    if _is_taken(frontier, slot, cost) or cost + bound >= best:
        return
    free, state = follow_dubins_path(state, path, factor, primitives, spec.grid)
    if free:
        straight = primitives.dubins_moves[factor, 1]
        free, state = follow_arc(state, straight, through, primitives, spec.grid)
    if not free:
        return
    move = -1 - passage * len(primitives.radius_factors) - factor
    child = Node(x, y, heading, cost, bound, state.left, state.right, state.lasting)
    _open_node(frontier, slot, node, move, child, spec)


@kernel_only
def _is_taken(frontier, slot, cost):  # type: ignore[no-untyped-def]
    owner = frontier.owners[slot] - 1
    return owner >= 0 and frontier.nodes[owner, _COST] <= cost + _COST_TOLERANCE


@kernel_only
def _open_node(frontier, slot, parent, move, node, spec):  # type: ignore[no-untyped-def]
    child = _add_node(frontier, slot, parent, move, node)
    # The grid distance may exceed the remaining length, so `rest` is not a lower bound.
    rest = max(node.bound, grid_distance(spec.heuristic, node.x, node.y))
    push(frontier, child, node.cost + spec.weight * rest)


@kernel_only
def _add_node(frontier, slot, parent, move, node):  # type: ignore[no-untyped-def]
    # The new node replaces the previous node of the cell, which is skipped when it is
    # popped from the heap.
    child = frontier.counts[NODES]
    frontier.counts[NODES] += 1
    frontier.owners[slot] = child + 1
    frontier.links[child, 0] = parent
    frontier.links[child, 1] = move
    for column in range(len(node)):
        frontier.nodes[child, column] = node[column]
    return child


@kernel_only
def _node(frontier, node):  # type: ignore[no-untyped-def]
    x, y, heading, cost, bound, left, right, lasting = frontier.nodes[node]
    return Node(x, y, heading, cost, bound, left, right, lasting)


@kernel_only
def _arc_state(frontier, node, primitives):  # type: ignore[no-untyped-def]
    at = _node(frontier, node)
    move = np.int64(frontier.links[node, 1])
    if move < 0:
        # A passage ends with a straight line.
        move = np.int64(primitives.dubins_moves[0, 1])
    return (
        ArcState(at.x, at.y, at.heading, move, at.left, at.right, at.lasting),
        at.cost,
    )


@kernel_only
def _in_goal(node, target):  # type: ignore[no-untyped-def]
    dx = target.x - node.x
    dy = target.y - node.y
    if dx * dx + dy * dy > target.radius * target.radius:
        return False
    turn = target.heading - node.heading
    turn -= 2 * np.pi * np.round(turn / (2 * np.pi))
    return target.any_heading or abs(turn) <= target.heading_tolerance


@kernel_only
def _connects_to_goal(frontier, node, spec, best):  # type: ignore[no-untyped-def]
    state, cost = _arc_state(frontier, node, spec.primitives)
    target = spec.target
    path = _path_to_goal(state.x, state.y, state.heading, target, target.dubins_radius)
    if cost + path.length >= best:
        return False
    return follow_dubins_path(state, path, 0, spec.primitives, spec.grid)[0]
