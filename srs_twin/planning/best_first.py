"""Best-first search over arcs of constant curvature, compiled (hybrid A*).

A node is a pose that arcs lead to from the start; its key is g + w h, with g the length of the path so far
and h the Dubins length of the rest at the tightest curvature the footprint has. No path of the snake to the
goal is shorter than h, and h falls along no arc by more than the arc's length, so with w = 1 keys never fall;
with w > 1 a path is at most w times as long as the best that the same arcs and cells admit.

When a node is taken from the open list, the Dubins path from it to the goal is tried. If it is free, the two
together are a plan. The open list is a binary heap, the closed set a hash
table that holds one node a cell of poses: a later one is kept only if it is nearer
to the start. That is what makes the search finite, and what makes it incomplete: a pose in the same cell
might have got through where the one that stands for it does not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled
from srs_twin.planning.arcs import along, blocked
from srs_twin.planning.collision import Surroundings
from srs_twin.planning.dubins import word
from srs_twin.planning.guide import Guide, way_from

NODES, OPEN, EXPANDED = range(3)
"""Places in `Frontier.counts`."""

# Of a row and a column in a cell's number; the rest, 2048, is for sectors of the heading.
_BITS = 26
_HALF = 1 << (_BITS - 1)


class Frontier(NamedTuple):
    """State of a search with room for so many nodes.

    Attributes:
    nodes: x, y, heading, cost so far (m), bound on the rest (m), wider left, wider right (m), how much
        longer they are wider (m); shape (room, 8).
    links: parent (-1 at the root) and move that led here, shape (room, 2).
    keys: what the heap is ordered by, m, shape (room,).
    heap: nodes in heap order, shape (room,).
    cells: cell of each slot of the hash table, shape (slots,), slots a power of 2.
    owners: 1 + the node that stands for the cell, 0 where the slot is empty, shape (slots,).
    counts: nodes made, nodes open, nodes expanded.
    """

    nodes: np.ndarray
    links: np.ndarray
    keys: np.ndarray
    heap: np.ndarray
    cells: np.ndarray
    owners: np.ndarray
    counts: np.ndarray


def empty_frontier(room: int) -> Frontier:
    """Return a search that has not begun, with room for so many nodes."""
    slots = 1 << (2 * room - 1).bit_length()
    nodes, links = np.empty((room, 8)), np.empty((room, 2), dtype=np.int32)
    keys, heap = np.empty(room), np.empty(room, dtype=np.int32)
    cells, owners = np.empty(slots, dtype=np.int64), np.zeros(slots, dtype=np.int32)
    return Frontier(nodes, links, keys, heap, cells, owners, np.zeros(3, dtype=np.int64))


def grown(frontier: Frontier) -> Frontier:
    """Return the same search with eight times the room."""
    larger = empty_frontier(8 * len(frontier.nodes))
    made = int(frontier.counts[NODES])
    for old, new in zip(frontier[:4], larger[:4], strict=True):
        new[:made] = old[:made]
    larger.counts[:] = frontier.counts
    _move_cells(frontier, larger)
    return larger


@compiled
def push(frontier, node, key):  # type: ignore[no-untyped-def]
    """Put a node on the heap."""
    keys, heap, place = frontier.keys, frontier.heap, frontier.counts[OPEN]
    frontier.counts[OPEN] += 1
    while place > 0:
        above = (place - 1) >> 1
        if keys[above] <= key:
            break
        keys[place], heap[place] = keys[above], heap[above]
        place = above
    keys[place], heap[place] = key, node


@compiled
def pop(frontier):  # type: ignore[no-untyped-def]
    """Take the node with the least key off the heap, which is not empty."""
    keys, heap = frontier.keys, frontier.heap
    frontier.counts[OPEN] -= 1
    size, first = frontier.counts[OPEN], heap[0]
    key, node, place = keys[size], heap[size], 0
    while True:
        below = 2 * place + 1
        if below >= size:
            break
        if below + 1 < size and keys[below + 1] < keys[below]:
            below += 1
        if keys[below] >= key:
            break
        keys[place], heap[place] = keys[below], heap[below]
        place = below
    keys[place], heap[place] = key, node
    return first


@compiled
def slot_of(frontier, x, y, heading, cell, sector):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return the slot of the hash table that belongs to a pose's cell; a new cell is entered, without owner.

    Args:
        cell: side of a cell, m.
        sector: width of a cell in heading, rad; a whole number of them is a full turn.
    """
    row, column = np.int64(np.floor(x / cell)) + _HALF, np.int64(np.floor(y / cell)) + _HALF
    turns = heading / (2 * np.pi)
    layer = np.int64(np.floor((turns - np.floor(turns)) * 2 * np.pi / sector))
    return _slot(frontier, (layer << (2 * _BITS)) | (row << _BITS) | column)


@compiled
def _slot(frontier, key):  # type: ignore[no-untyped-def]
    # Fibonacci hashing; the product may wrap.
    last = frontier.cells.shape[0] - 1
    slot = ((key * np.int64(-7046029254386353131)) >> 20) & last
    while frontier.owners[slot] != 0 and frontier.cells[slot] != key:
        slot = (slot + 1) & last
    frontier.cells[slot] = key
    return slot


@compiled
def _move_cells(frontier, larger):  # type: ignore[no-untyped-def]
    for old in range(frontier.cells.shape[0]):
        if frontier.owners[old] != 0:
            larger.owners[_slot(larger, frontier.cells[old])] = frontier.owners[old]


CONNECTED, ARRIVED, PAUSED, EXHAUSTED, FULL = range(5)
"""How `expand` ends: a free Dubins path to the goal, within tolerance, share done, no node open, no room."""

_BETTER = 1e-9
_RARELY = 4
"""Nodes to each one that gates are tried from."""
_REACH = 6.0
"""Radii of turns from which on a gate is too far to be tried."""


class Moves(NamedTuple):
    """What the snake can do.

    Attributes:
        curvatures: rising, 1/m, shape (n,).
        left: edges, m, shape (n,).
        right: edges, m, shape (n,).
        changes: wider left, wider right, length (m) after a change from one to another; row n: from rest;
            shape (n + 1, n, 3).
        arcs: which of them lead to a node's children, shape (m,).
        eases: how many times wider than the tightest turns those of Dubins paths are, 1 first, shape (k,).
        turns: moves of such paths to the right, straight, to the left, shape (k, 3).
        length: of an arc, m.
        ahead: of the centre of mass, m.
        behind: of the centre of mass, m.
    """

    curvatures: np.ndarray
    left: np.ndarray
    right: np.ndarray
    changes: np.ndarray
    arcs: np.ndarray
    eases: np.ndarray
    turns: np.ndarray
    length: float
    ahead: float
    behind: float


class Target(NamedTuple):
    """Where to arrive.

    Attributes:
        x: m.
        y: m.
        heading: rad; counts unless `free`.
        free: any heading will do.
        radius: tolerance, m.
        tolerance: of the heading, rad.
        least: radius of the tightest turn to either side, for the bound, m.
        turning: radius of the Dubins paths, which both sides can follow, m.
    """

    x: float
    y: float
    heading: float
    free: bool
    radius: float
    tolerance: float
    least: float
    turning: float


class Search(NamedTuple):
    """What a search goes by.

    Attributes:
        moves: what the snake can do.
        target: where to arrive.
        around: the world.
        cell: side of a cell of poses, m.
        sector: its width in heading, rad; a whole number of them is a full turn.
        weight: w.
        guide: `guide.NO_GUIDE`, or what may lengthen the bound in the key; not where nodes are dropped.
        gates: poses to connect to as well, and how far straight on from there, as `gates.gates_of` has them.
    """

    moves: Moves
    target: Target
    around: Surroundings
    cell: float
    sector: float
    weight: float
    guide: Guide
    gates: np.ndarray


@compiled
def rest(x, y, heading, target):  # type: ignore[no-untyped-def]
    """Return the bound h on the length from a pose to the goal, m."""
    path = word(x, y, heading, target.x, target.y, target.heading, target.free, target.least)
    return path[3] + path[4] + path[5]


@compiled
def add_root(frontier, x, y, heading, search):  # type: ignore[no-untyped-def]
    """Put a pose to begin at into a frontier; the first in a cell counts."""
    slot = slot_of(frontier, x, y, heading, search.cell, search.sector)
    bound = rest(x, y, heading, search.target)
    if frontier.owners[slot] == 0:
        root = _enter(frontier, slot, x, y, heading, 0.0, bound, 0.0, 0.0, 0.0)
        frontier.links[root, 0], frontier.links[root, 1] = -1, search.moves.curvatures.shape[0]
        push(frontier, root, bound)


@compiled
def expand(frontier, search, best, share):  # type: ignore[no-untyped-def]
    """Expand nodes until something happens; return what (see `CONNECTED`) and at which node.

    Args:
        frontier: changed in place.
        search: what it goes by.
        best: length of the best plan known, m; nodes that cannot beat it are dropped.
        share: how many nodes to expand at most.
    """
    moves, cell, sector = search.moves, search.cell, search.sector
    until = frontier.counts[EXPANDED] + share
    while frontier.counts[OPEN] > 0:
        if frontier.counts[EXPANDED] >= until:
            return PAUSED, -1
        children = moves.arcs.shape[0] + moves.turns.shape[0] * search.gates.shape[0]
        if frontier.counts[NODES] + children > frontier.nodes.shape[0]:
            return FULL, -1
        node = pop(frontier)
        x, y, heading, cost, bound = frontier.nodes[node, :5]
        owner = frontier.owners[slot_of(frontier, x, y, heading, cell, sector)]
        if owner != node + 1 or cost + bound >= best:
            continue
        frontier.counts[EXPANDED] += 1
        if _arrived(x, y, heading, search.target):
            return ARRIVED, node
        if _connects(frontier, node, search, best):
            return CONNECTED, node
        for move in moves.arcs:
            _try(frontier, node, move, search, best)
        # A gate is far more work than an arc.
        every = search.gates.shape[0] if frontier.counts[EXPANDED] % _RARELY == 1 else 0
        for gate in range(every):
            for ease in range(moves.turns.shape[0]):
                _try_gate(frontier, node, gate, ease, search, best)
    return EXHAUSTED, -1


@compiled
def _try(frontier, node, move, search, best):  # type: ignore[no-untyped-def]
    """Make a child if it is the first or nearest in its cell, may beat the best plan, and its arc is free."""
    way, cost = _way_from(frontier, node, search)
    length = search.moves.length
    to_x, to_y, to_heading = along(way[0], way[1], way[2], search.moves.curvatures[move], length)
    slot = slot_of(frontier, to_x, to_y, to_heading, search.cell, search.sector)
    cost += length
    owner = frontier.owners[slot] - 1
    if owner >= 0 and frontier.nodes[owner, 3] <= cost + _BETTER:
        return
    free, way = one_arc(way, move, length, search.moves, search.around)
    if not free:
        return
    bound = rest(to_x, to_y, to_heading, search.target)
    if cost + bound >= best:
        return
    child = _enter(frontier, slot, to_x, to_y, to_heading, cost, bound, way[4], way[5], way[6])
    frontier.links[child, 0], frontier.links[child, 1] = node, move
    push(frontier, child, cost + search.weight * max(bound, way_from(search.guide, to_x, to_y)))


@compiled
def _try_gate(frontier, node, gate, ease, search, best):  # type: ignore[no-untyped-def]
    """Make a child behind a gap, as `_try` does, if a Dubins path leads into it.

    Its move is −1 − gate n − ease, with n turns of different tightness.
    """
    moves, target, around = search.moves, search.target, search.around
    way, cost = _way_from(frontier, node, search)
    gate_x, gate_y, heading, through = search.gates[gate]
    dx, dy = gate_x - way[0], gate_y - way[1]
    reach = _REACH * target.turning + 2 * through
    if dx * dx + dy * dy > reach * reach:
        return
    to_x, to_y, to_heading = along(gate_x, gate_y, heading, 0.0, through)
    slot = slot_of(frontier, to_x, to_y, to_heading, search.cell, search.sector)
    owner = frontier.owners[slot] - 1
    path = word(*way[:3], gate_x, gate_y, heading, False, target.turning * moves.eases[ease])
    cost += path[3] + path[4] + path[5] + through
    bound = rest(to_x, to_y, to_heading, target)
    if (owner >= 0 and frontier.nodes[owner, 3] <= cost + _BETTER) or cost + bound >= best:
        return
    for piece in range(4):
        length = through if piece == 3 else path[3 + piece]
        turn = 0 if piece == 3 else int(path[piece])
        if length > 0:
            free, way = one_arc(way, moves.turns[ease, 1 + turn], length, moves, around)
            if not free:
                return
    child = _enter(frontier, slot, to_x, to_y, to_heading, cost, bound, way[4], way[5], way[6])
    frontier.links[child, 0] = node
    frontier.links[child, 1] = -1 - gate * moves.turns.shape[0] - ease
    push(frontier, child, cost + search.weight * max(bound, way_from(search.guide, to_x, to_y)))


@compiled
def _enter(frontier, slot, x, y, heading, cost, bound, left, right, lasting):  # type: ignore[no-untyped-def]
    child = frontier.counts[NODES]
    frontier.counts[NODES] += 1
    frontier.owners[slot] = child + 1
    row = frontier.nodes[child]
    row[0], row[1], row[2], row[3], row[4] = x, y, heading, cost, bound
    row[5], row[6], row[7] = left, right, lasting
    return child


@compiled
def _way_from(frontier, node, search):  # type: ignore[no-untyped-def]
    """Return how the snake comes to a node, as `one_arc` takes it, and the cost of the way, m."""
    x, y, heading, cost, _, left, right, lasting = frontier.nodes[node]
    move = frontier.links[node, 1]  # behind a gate it is straight
    before = np.int64(move if move >= 0 else search.moves.turns[0, 1])
    return (x, y, heading, before, left, right, lasting), cost


@compiled
def _arrived(x, y, heading, target):  # type: ignore[no-untyped-def]
    dx, dy = target.x - x, target.y - y
    if dx * dx + dy * dy > target.radius * target.radius:
        return False
    turn = target.heading - heading
    return target.free or abs(turn - 2 * np.pi * np.round(turn / (2 * np.pi))) <= target.tolerance


@compiled
def _connects(frontier, node, search, best):  # type: ignore[no-untyped-def]
    """Say whether the Dubins path from a node to the goal is free and makes a better plan."""
    way, cost = _way_from(frontier, node, search)
    target = search.target
    path = word(*way[:3], target.x, target.y, target.heading, target.free, target.turning)
    if cost + path[3] + path[4] + path[5] >= best:
        return False
    return passes(way, path, search.moves, search.around)[0]


@compiled
def at_rest(x, y, heading, moves):  # type: ignore[no-untyped-def]
    """Return the beginning of a way, as `one_arc` takes it: a pose to which no move has led."""
    return x, y, heading, len(moves.curvatures), 0.0, 0.0, 0.0


@compiled
def passes(way, path, moves, around):  # type: ignore[no-untyped-def]
    """Return whether a Dubins path, as `dubins.word` returns it, is free, and the way on from its end."""
    free = True
    for piece in range(3):
        if path[3 + piece] > 0:
            free, way = one_arc(way, moves.turns[0, 1 + int(path[piece])], path[3 + piece], moves, around)
            if not free:
                break
    return free, way


@compiled
def one_arc(way, move, length, moves, around):  # type: ignore[no-untyped-def]
    """Return whether an arc is free, and the way on from its end.

    Args:
        way: x, y, heading of where the arc begins, the move that led there, and how much wider left and
            right (m) the edges are from earlier changes, for how long (m).
        move: of the arc.
        length: m.
        moves: what the snake can do.
        around: the world.
    """
    x, y, heading, before, left, right, lasting = way
    if lasting <= 0:
        left, right, lasting = 0.0, 0.0, 0.0
    change = moves.changes[before, move]
    left, right, lasting = max(left, change[0]), max(right, change[1]), max(lasting, change[2])
    curvature, ahead, behind = moves.curvatures[move], moves.ahead, moves.behind
    first = min(lasting, length)
    free = True
    if first > 0:
        wide = moves.left[move] + left, moves.right[move] + right
        free = not blocked(x, y, heading, curvature, first, ahead, behind, wide[0], wide[1], around)
        x, y, heading = along(x, y, heading, curvature, first)
    if free and first < length:
        edges = moves.left[move], moves.right[move]
        free = not blocked(x, y, heading, curvature, length - first, ahead, behind, *edges, around)
    x, y, heading = along(x, y, heading, curvature, length - first)
    return free, (x, y, heading, move, left, right, lasting - first)
