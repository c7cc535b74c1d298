r"""Motion primitives: the arcs that a node's children are reached by, and the floor that one arc sweeps.

Section 5.2.1: N turns α from -α_max to α_max, each held for one step of length v Δt. With θ' = θ + α and
r = vΔt/α (Eq. 33 with its signs put right, E7),

.. math:: x' = x + r(\sin θ' - \sin θ), \qquad y' = y - r(\cos θ' - \cos θ)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.errors import InputError
from srs_twin.planning.swept import along
from srs_twin.world import Pose

if TYPE_CHECKING:
    from shapely import Polygon


@dataclass(frozen=True)
class Primitives:
    """Arcs of one length.

    Attributes:
        count: N, odd, so that the middle one is straight; 3 or more.
        turn: α_max, rad; below π.
        length: of each, v Δt, m.
    """

    count: int
    turn: float
    length: float

    def __post_init__(self) -> None:
        if self.count < 3 or self.count % 2 == 0:
            raise InputError(
                f"{self.count} primitives: the number must be odd, 3 or more (the middle one is straight)"
            )
        if not (0 < self.turn < math.pi and 0 < self.length < math.inf):
            raise InputError(
                f"primitives of {self.length:g} m that turn by {self.turn:g} rad: lengths are above 0, "
                "turns above 0 and below pi"
            )

    @cached_property
    def curvatures(self) -> np.ndarray:
        """From the tightest right turn to the tightest left turn, 1/m, shape (count,)."""
        return np.linspace(-self.turn, self.turn, self.count) / self.length

    def children(self, pose: Pose) -> list[Pose]:
        """Return where each arc ends, in the order of `curvatures`."""
        ends = (along(pose.x, pose.y, pose.heading, float(k), self.length) for k in self.curvatures)
        return [Pose(float(x), float(y), float(heading)) for x, y, heading in ends]


def swept_polygon(
    start: Pose, curvature: float, length: float, *,
    left: float, right: float, ahead: float = 0.0, behind: float = 0.0, excess: float = 1e-3,
) -> Polygon:  # fmt: skip
    """Return a polygon that contains what one arc sweeps, and nothing farther from it than the excess.

    The outer arc is replaced by a polygon about it, the inner one by its chords; turns below a full one.

    Args:
        start: of the centre of mass.
        curvature: 1/m.
        length: m.
        left: edge, m.
        right: edge, m.
        ahead: of the centre of mass along the arc, m.
        behind: of the centre of mass along the arc, m.
        excess: largest distance between the polygon and the region, m.

    Raises:
        InputError: an edge reaches the centre of the turn, or the turn is a full one.
    """
    from shapely import Polygon

    whole = length + ahead + behind
    if max(curvature * left, -curvature * right) >= 1 or abs(curvature) * whole >= 2 * math.pi:
        raise InputError(
            f"an arc of {whole:g} m and curvature {curvature:g} 1/m with edges {left:g} and {right:g} m "
            "has no simple outline"
        )
    outer = abs(1 / curvature) + (right if curvature > 0 else left) if curvature else 0.0
    # A polygon about a circle stands off by R (1/cos(φ/2) - 1), its chords by R (1 - cos(φ/2)).
    most = 4 * math.atan(math.sqrt(excess / (2 * outer + excess)))
    # An arc so flat that its radius is no number is a line.
    pieces = max(1, math.ceil(abs(curvature) * whole / most)) if most > 0 else 1
    half = abs(curvature) * whole / pieces / 2
    stretch = 2 * math.sin(half / 2) ** 2 / math.cos(half)
    edges: list[list[tuple[float, float]]] = [[], []]
    for side, edge, convex in ((0, left, curvature < 0), (1, -right, curvature > 0)):
        radius = 1 - curvature * edge
        # Corners of the outer polygon lie between its points of contact; chords have theirs on the arc.
        places = (np.arange(pieces) + 0.5) / pieces if convex else np.arange(pieces + 1) / pieces
        places = np.concatenate([[0.0], places, [1.0]]) if convex else places
        for k, place in enumerate(places):
            x, y, heading = along(start.x, start.y, start.heading, curvature, place * whole - behind)
            n = edge
            if convex and 0 < k < len(places) - 1:
                n -= radius * stretch / curvature
            edges[side].append((x - n * math.sin(heading), y + n * math.cos(heading)))
    return Polygon(edges[0] + edges[1][::-1])
