"""Open list and closed set of a search: a binary heap and a hash table of pose cells, in arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from srs_twin.compiled import compiled

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
    return Frontier(
        np.empty((room, 8)), np.empty((room, 2), dtype=np.int32),
        np.empty(room), np.empty(room, dtype=np.int32),
        np.empty(slots, dtype=np.int64), np.zeros(slots, dtype=np.int32), np.zeros(3, dtype=np.int64),
    )  # fmt: skip


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
