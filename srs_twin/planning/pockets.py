r"""Pockets: proofs that no path of the snake's turns leads out of the surroundings of a pose.

All poses that paths of curvature K at most lead to, from some poses on, are covered by cells of x, y and
heading. From a cell a path of length L ends at a turn Δ with its position between those of the two paths that
turn first one way as tightly as they can and then the other,

$$ θ_{lo}(s) = \max(-Ks,\ Δ - K(L - s)) \le θ(s) \le \min(Ks,\ Δ + K(L - s)) = θ_{hi}(s), $$

and no farther from the chord between its ends than K L²/8. Every cell that this overlaps is taken, unless a
place between is nearer to something than the clearance w whatever was rounded. If the cells run out before
they come near the other end of the way, there is none.

An obstacle nearer than w to a path lies straight across from it, within the edges, or beyond the end of
head (or tail) at the path's last pose: nearer than w to that end E. So a place p counts as blocked by what is
nearer than w' = min(w, |p - E|/2).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
from srs_twin.planning.footprint import Footprint
from srs_twin.robot.world import Goal, Pose

if TYPE_CHECKING:
    from srs_twin.planning.collision import Surroundings

_TURN = 0.5
"""Largest turn of a step, rad."""
Finely = tuple[int, int, float, int]
"""Sectors of a step's turn, cells of its length, radii from which on a way leads out, cells at most."""
COARSE: Finely = (6, 8, 1.5, 30_000)
FINE: Finely = (10, 16, 4.0, 40_000)
_SAMPLES = 64
_THOROUGH = 4
"""Places looked at along a step."""


def shut_in(pose: Pose, goal: Goal, body: Footprint, around: Surroundings, how: Finely) -> str:
    """Return which end of a way is proven to be shut in, "start" or "goal", or neither: an empty string.

    Args:
        pose: of the start.
        goal: where the way ends.
        body: whose it is.
        around: the world.
        how: finely; what is not proven coarsely may still be true.
    """
    parts, cells, reach, most = how
    tight, clearance = max(body.tightest), body.narrowest
    step = min(_TURN / tight, 2 * clearance)
    sectors = math.ceil(2 * math.pi / (tight * step / parts))
    moves, cell = _moves(tight, step, 2 * math.pi / sectors), step / cells
    start = np.array([pose.x, pose.y, pose.heading, 0.0, 0.0, body.behind])
    # From the goal the way is gone backwards.
    facing, fan = (0.0, math.pi) if goal.heading is None else (goal.heading + math.pi, goal.heading_tolerance)
    end = np.array([goal.x, goal.y, facing, goal.radius, fan, body.ahead])
    for name, one, other in (("goal", end, start), ("start", start, end)):
        side = math.ceil((reach / tight + one[3] + one[5]) / cell)
        # Hardly any of it is ever touched, and what is not costs nothing.
        seen = np.zeros((2 * side + 1, 2 * side + 1, sectors), dtype=np.bool_)
        if _runs_out(one, other, tight, clearance, step, cell, seen, moves, most, around):
            return name
    return ""


def _moves(tight: float, step: float, sector: float) -> np.ndarray:
    """Return what a step leads to: sectors turned, and least and largest x and y, m, shape (n, 5)."""
    s = (np.arange(_SAMPLES) + 0.5) / _SAMPLES * step
    most, rows = tight * step, []
    for turned in range(-math.ceil(most / sector), math.ceil(most / sector) + 1):
        # Between poses anywhere in their sectors.
        low, high = max((turned - 1) * sector, -most), min((turned + 1) * sector, most)
        if low > high:
            continue
        least = np.maximum(-tight * s, low - tight * (step - s))
        largest = np.minimum(tight * s, high + tight * (step - s))
        nearest = np.where((least <= 0) & (largest >= 0), 0.0, np.minimum(abs(least), abs(largest)))
        x = np.cos(np.maximum(abs(least), abs(largest))).mean(), np.cos(nearest).mean()
        y = np.sin(least).mean(), np.sin(largest).mean()
        rounding = step / _SAMPLES**2
        rows.append((turned, step * x[0] - rounding, step * x[1] + rounding,
                     step * y[0] - rounding, step * y[1] + rounding))  # fmt: skip
    return np.array(rows)


@allocating
def _runs_out(one, other, tight, clearance, step, cell, seen, moves, most, around):  # type: ignore[no-untyped-def]
    """Say whether the cells reached from one end run out before they lead far away or near the other."""
    sectors, side = seen.shape[2], seen.shape[0] // 2
    sector = 2 * np.pi / sectors
    west, south = one[0] - side * cell, one[1] - side * cell
    distances = np.full((2 * side + 1, 2 * side + 1), np.nan)
    stack = np.empty((most, 3), dtype=np.int32)
    count = 0
    # Poses to begin at.
    rim, fan = int(np.ceil(one[3] / cell)) + 1, min(int(np.ceil(one[4] / sector)) + 1, sectors // 2)
    middle = int(np.floor((one[2] / (2 * np.pi) - np.floor(one[2] / (2 * np.pi))) * sectors))
    for i in range(side - rim, side + rim + 1):
        for j in range(side - rim, side + rim + 1):
            if np.hypot(i - side, j - side) * cell <= one[3] + cell:
                for k in range(middle - fan, middle + fan + 1):
                    if not seen[i, j, k % sectors]:
                        seen[i, j, k % sectors] = True
                        stack[count, 0], stack[count, 1], stack[count, 2] = i, j, k % sectors
                        count += 1
                        if count + 1 >= most:
                            return False
    # Beyond its head (tail) nothing is known; the end of that is here, give or take `loose`.
    end_x, end_y, loose = _beyond(one, tight)
    far_x, far_y, spare = _beyond(other, tight)
    slack = tight * step * step / 8 + np.sqrt(2.0) * cell
    near = spare + 2 * clearance + step + slack
    arrives = other[3] + step + slack
    taken = count
    while count > 0:
        count -= 1
        i, j, k = stack[count]
        x, y = west + i * cell, south + j * cell
        if np.hypot(x - far_x, y - far_y) < near or np.hypot(x - other[0], y - other[1]) < arrives:
            return False
        c, s = np.cos((k + 0.5) * sector), np.sin((k + 0.5) * sector)
        for move in range(len(moves)):
            turned, low_x, high_x, low_y, high_y = moves[move]
            middle_x, middle_y = (low_x + high_x) / 2, (low_y + high_y) / 2
            half_x, half_y = (high_x - low_x) / 2, (high_y - low_y) / 2
            more = step * sector / 2 + cell / 2
            to_x, to_y = x + c * middle_x - s * middle_y, y + s * middle_x + c * middle_y
            wide_x, wide_y = (
                abs(c) * half_x + abs(s) * half_y + more,
                abs(s) * half_x + abs(c) * half_y + more,
            )
            to_k = (k + int(turned)) % sectors
            low_i, high_i = np.round((to_x - wide_x - west) / cell), np.round((to_x + wide_x - west) / cell)
            low_j, high_j = np.round((to_y - wide_y - south) / cell), np.round((to_y + wide_y - south) / cell)
            for to_i in range(int(low_i), int(high_i) + 1):
                for to_j in range(int(low_j), int(high_j) + 1):
                    if not (0 <= to_i <= 2 * side and 0 <= to_j <= 2 * side):
                        return False
                    if seen[to_i, to_j, to_k]:
                        continue
                    shut = False
                    for place in range(1, _THOROUGH + 1):
                        share = place / _THOROUGH
                        at_i = int(np.round(i + share * (to_i - i)))
                        at_j = int(np.round(j + share * (to_j - j)))
                        if np.isnan(distances[at_i, at_j]):
                            distances[at_i, at_j] = _distance(west + at_i * cell, south + at_j * cell, around)
                        off = np.hypot(west + at_i * cell - end_x, south + at_j * cell - end_y)
                        least = min(clearance, (off - loose - slack) / 2)
                        if distances[at_i, at_j] + slack < least:
                            shut = True
                            break
                    if shut:
                        continue
                    seen[to_i, to_j, to_k] = True
                    stack[count, 0], stack[count, 1], stack[count, 2] = to_i, to_j, to_k
                    count += 1
                    taken += 1
                    if taken + 1 >= most:
                        return False
    return True


@compiled
def _beyond(end, tight):  # type: ignore[no-untyped-def]
    """Return where the body ends beyond an end of the way, which is gone away from, and how loosely, m."""
    reach = end[5]
    loose = end[3] + reach * min(2.0, end[4] + tight * reach / 2)
    return end[0] - reach * np.cos(end[2]), end[1] - reach * np.sin(end[2]), loose


@compiled
def _distance(x, y, around):  # type: ignore[no-untyped-def]
    """Return how far a place is from the nearest thing's edge, m; below 0 in a circle or out of bounds."""
    bounds = around.bounds
    least = min(min(x - bounds[0], bounds[1] - x), min(y - bounds[2], bounds[3] - y))
    for k in range(len(around.circles)):
        least = min(
            least, np.hypot(x - around.circles[k, 0], y - around.circles[k, 1]) - around.circles[k, 2]
        )
    for k in range(len(around.sides)):
        ax, ay, bx, by = around.sides[k]
        dx, dy = bx - ax, by - ay
        share = ((x - ax) * dx + (y - ay) * dy) / max(dx * dx + dy * dy, 1e-300)
        share = min(max(share, 0.0), 1.0)
        least = min(least, np.hypot(x - ax - share * dx, y - ay - share * dy))
    return least
