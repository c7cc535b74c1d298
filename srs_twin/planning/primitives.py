"""Motion primitives of the search, with transients, and shortening of paths."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, compiled, kernel_only
from srs_twin.planning.arcs import (
    ArcSequence,
    Extent,
    Primitives,
    arc_collides,
    arc_end,
)
from srs_twin.planning.collision import ObstacleGrid
from srs_twin.planning.dubins import dubins_path
from srs_twin.planning.footprint import Footprint
from srs_twin.robot.world import Pose

_RADIUS_FACTORS = (1.0, 2.0, 5.0)
"""Turning radii for the approach to narrow passages, relative to the minimum radius.

Turns with large radii cause small transients.
"""

_SHORTENING_ROUNDS = 4
_MIN_SAVING = 1e-4
"""Relative reduction of the path length in one round, below which shortening stops."""
_RETREAT = 0.97
"""Factor by which the bypassed part of the path shrinks after each failed short cut.
"""


class MotionPrimitives(NamedTuple):
    """Arcs that the snake can follow.

    Attributes:
        curvatures: curvatures in ascending order, 1/m, shape (n,).
        left, right: distances from the path to the left and right edges for each
            curvature, m, shape (n,).
        transients: left edge shift, right edge shift and length (m) of the transient
            for each pair of old and new curvature, shape (n + 1, n, 3). The last row
            applies at the start of the path.
        children: indices of the curvatures that are used to expand a node, shape (m,).
        radius_factors: turning radii of the tested Dubins paths, relative to the
            minimum radius and starting with 1, shape (k,).
        dubins_moves: curvature indices of the right turn, the straight line and the
            left turn for each radius factor, shape (k, 3).
        length: arc length, m.
        ahead, behind: distances from the centre of mass to the head and to the tail, m.
    """

    curvatures: np.ndarray
    left: np.ndarray
    right: np.ndarray
    transients: np.ndarray
    children: np.ndarray
    radius_factors: np.ndarray
    dubins_moves: np.ndarray
    length: float
    ahead: float
    behind: float


class ArcState(NamedTuple):
    """Pose at the end of an arc, with the transient that is still active.

    Attributes:
        x, y, heading: pose, m and rad.
        move: curvature index of the last arc, or the number of curvatures at the start
            of the path.
        left, right: outward shifts of the left and right edges, m.
        lasting: remaining path length over which the edges are shifted, m.
    """

    x: float
    y: float
    heading: float
    move: int | np.int64
    left: float
    right: float
    lasting: float


def make_motion_primitives(
    primitives: Primitives, footprint: Footprint
) -> MotionPrimitives:
    """Extend primitives by the tightest turns, wide turns and a straight line."""
    right, left = footprint.tightest
    both = min(right, left)
    # The method `at` raises an error if a turn is too tight for the footprint.
    for tightest in primitives.curvatures[[0, -1]]:
        footprint.at(float(tightest))
    own = [*primitives.curvatures, -right, -both, 0.0, both, left]
    wide = [side * both / factor for factor in _RADIUS_FACTORS for side in (-1, 1)]
    # Rounding merges almost equal curvatures, and clipping keeps the rounded values
    # within the range of the footprint.
    curvatures = np.unique(np.round([*own, *wide], 12))
    curvatures = np.clip(curvatures, -right, left)
    rows = [footprint.at(float(k)) for k in curvatures]
    offsets = [row.offset for row in rows]
    transients = [[footprint.transient(a, b) for b in offsets] for a in offsets]
    transients.append([(0.0, 0.0, 0.0)] * len(offsets))
    indices = np.unique([np.argmin(abs(curvatures - k)) for k in own])
    turns = [
        [np.argmin(abs(curvatures - side * both / factor)) for side in (-1, 0, 1)]
        for factor in _RADIUS_FACTORS
    ]
    return MotionPrimitives(
        curvatures,
        np.array([row.left for row in rows]),
        np.array([row.right for row in rows]),
        np.array(transients),
        indices,
        np.array(_RADIUS_FACTORS),
        np.array(turns),
        primitives.length,
        footprint.ahead,
        footprint.behind,
    )


@compiled
def initial_state(x, y, heading, primitives):  # type: ignore[no-untyped-def]
    """Return the arc state at the start of a path."""
    return ArcState(x, y, heading, len(primitives.curvatures), 0.0, 0.0, 0.0)


@compiled
def follow_dubins_path(state, path, factor, primitives, grid):  # type: ignore[no-untyped-def]
    """Return whether a Dubins path is collision-free, and the arc state at its end.

    `factor` is an index into `MotionPrimitives.radius_factors`.
    """
    free = True
    for piece in range(3):
        length = path.lengths[piece]
        if length > 0:
            move = primitives.dubins_moves[factor, 1 + int(path.turns[piece])]
            free, state = follow_arc(state, move, length, primitives, grid)
            if not free:
                break
    return free, state


@compiled
def follow_arc(state, move, length, primitives, grid):  # type: ignore[no-untyped-def]
    """Return whether an arc is collision-free, and the arc state at its end.

    `move` is the curvature index of the arc, and `length` is the arc length (m).
    """
    x = state.x
    y = state.y
    heading = state.heading
    change = primitives.transients[state.move, move]
    left = change[0]
    right = change[1]
    lasting = change[2]
    if state.lasting > 0:
        # If transients overlap, the larger shifts of the edges and the longer remaining
        # length apply.
        left = max(state.left, left)
        right = max(state.right, right)
        lasting = max(state.lasting, lasting)
    curvature = primitives.curvatures[move]
    steady = Extent(
        primitives.ahead,
        primitives.behind,
        primitives.left[move],
        primitives.right[move],
    )
    # The transient shifts the edges only on the first part of the arc.
    first = min(lasting, length)
    free = True
    if first > 0:
        wide = Extent(
            steady.ahead, steady.behind, steady.left + left, steady.right + right
        )
        free = not arc_collides((x, y, heading), curvature, first, wide, grid)
        x, y, heading = arc_end(x, y, heading, curvature, first)
    if free and first < length:
        rest = length - first
        free = not arc_collides((x, y, heading), curvature, rest, steady, grid)
    x, y, heading = arc_end(x, y, heading, curvature, length - first)
    return free, ArcState(x, y, heading, move, left, right, lasting - first)


def shorten_path(
    start: Pose,
    path: ArcSequence,
    primitives: MotionPrimitives,
    grid: ObstacleGrid,
    radius: float,
) -> ArcSequence:
    """Replace parts of a path by shorter collision-free Dubins paths.

    Args:
        start: start pose.
        path: collision-free path whose curvatures belong to the primitives.
        primitives: arcs that the snake can follow.
        grid: obstacles and bounds.
        radius: turning radius of the short cuts, m.
    """
    arcs = [(c, length) for c, length in path if length > 0]
    indices = np.array(
        [np.argmin(abs(primitives.curvatures - c)) for c, _ in arcs], dtype=np.int64
    )
    lengths = np.array([length for _, length in arcs])
    for turn in range(_SHORTENING_ROUNDS):
        before = math.fsum(lengths)
        # Each round divides the path into smaller pieces, so that short cuts can begin
        # and end at new poses.
        counts = np.ceil(lengths * (2 + turn) / radius).astype(np.int64)
        pieces = np.repeat(indices, counts), np.repeat(lengths / counts, counts)
        indices, lengths = _cut_corners(*start, *pieces, primitives, grid, radius)
        if math.fsum(lengths) > before * (1 - _MIN_SAVING):
            break
    return list(
        zip(primitives.curvatures[indices].tolist(), lengths.tolist(), strict=True)
    )


@allocating
def _cut_corners(x, y, heading, indices, lengths, primitives, grid, radius):  # type: ignore[no-untyped-def]  # noqa: D417
    """Replace parts of a path by the longest free short cut from each pose."""
    count = len(indices)
    state = initial_state(x, y, heading, primitives)
    distances = np.zeros(count + 1)
    # `states` contains the arc state at the end of each piece of the original path.
    states = [state]
    for k in range(count):
        _, state = follow_arc(state, indices[k], lengths[k], primitives, grid)
        states.append(state)
        distances[k + 1] = distances[k] + lengths[k]
    new_indices = np.empty(3 * count, dtype=np.int64)
    new_lengths = np.empty(3 * count)
    size = 0
    state = initial_state(x, y, heading, primitives)
    k = 0
    while k < count:
        last = count
        while last > k:
            pose = states[last]
            path = dubins_path(
                state.x,
                state.y,
                state.heading,
                pose.x,
                pose.y,
                pose.heading,
                False,
                radius,
            )
            if path.length < distances[last] - distances[k] - 1e-9:
                free, end = follow_dubins_path(state, path, 0, primitives, grid)
                # The last transient of the short cut may also affect the rest of the
                # path.
                if free and _stays_free(
                    end, last, indices, lengths, states, primitives, grid
                ):
                    break
            last = k + min(last - k - 1, int(_RETREAT * (last - k)))
        if last > k:
            for piece in range(3):
                length = path.lengths[piece]
                if length > 0:
                    move = primitives.dubins_moves[0, 1 + int(path.turns[piece])]
                    size = _append_arc(new_indices, new_lengths, size, move, length)
            state = end
            k = last
        else:
            size = _append_arc(new_indices, new_lengths, size, indices[k], lengths[k])
            _, state = follow_arc(state, indices[k], lengths[k], primitives, grid)
            k += 1
    return new_indices[:size], new_lengths[:size]


@kernel_only
def _append_arc(indices, lengths, size, move, length):  # type: ignore[no-untyped-def]
    if size > 0 and indices[size - 1] == move:
        lengths[size - 1] += length
        return size
    indices[size] = move
    lengths[size] = length
    return size + 1


@allocating
def _stays_free(state, k, indices, lengths, states, primitives, grid):  # type: ignore[no-untyped-def]
    """Return whether the path from piece k on is free with another initial state."""
    while k < len(indices):
        original = states[k]
        covered = (
            state.left <= original.left
            and state.right <= original.right
            and state.lasting <= original.lasting
        )
        if state.move == original.move and (state.lasting <= 0 or covered):
            return True
        free, state = follow_arc(state, indices[k], lengths[k], primitives, grid)
        if not free:
            return False
        k += 1
    return True
