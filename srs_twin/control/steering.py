r"""Steering laws: from the pose of a snake and a plan to the offset of its gait.

`BearingLaw`, Section 5.2.2: the nodes of the plan are gone to one after the other. The offset is
proportional to the bearing of the next node less the heading, saturated; when the snake is within a
threshold of a node, the next one is next.

`PathLaw`, ours: with the distance n to the left of the path and the heading error e, both predicted for the
moment at which the command takes effect, the curvature

.. math:: κ = \frac{κ_{plan}(s + ℓ)}{1 - κ_{plan} n}
    - \frac{2ζ}{L}\,\bigl(1 + ℓ\tfrac{d}{ds}\bigr)(e - e_n) - d,
    \qquad e_n = -\operatorname{clip}\Bigl(\frac{n}{2ζL}\Bigr)

makes n die out over the length L like a second-order system with damping ζ. A new offset takes hold over a
length ℓ like a first-order lag, the measured transient: the plan's curvature is looked up ahead by ℓ, and the
rate of the error, which the model knows without noise, undoes the lag in the feedback. d is the predictor's
disturbance, and the footprint gives the offset for κ.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from srs_twin.planning.footprint import Footprint
from srs_twin.planning.route import Place, Route
from srs_twin.world import Pose

DAMPING = 1.0
_STEEPEST = 0.7
"""Largest heading towards the path, rad."""


@dataclass(frozen=True)
class Seen:
    """What a law may look at.

    Attributes:
        pose: of the snake: the mean over a period for laws that do not predict.
        place: of that pose on the route.
        curvature: of its path then, as the model has it, 1/m.
        disturbance: see `Predictor`, 1/m.
    """

    pose: Pose
    place: Place
    curvature: float
    disturbance: float


class Steering(ABC):
    """A steering law; frozen settings make one for every run.

    Attributes:
        predicts: whether it wants the pose predicted.
        node: number of the node that the snake heads for, or of the nodes that it has passed.
    """

    predicts: bool
    node: int = 0

    @abstractmethod
    def begin(self, route: Route) -> None:
        """Take a new path."""

    @abstractmethod
    def offset(self, seen: Seen) -> float:
        """Return the offset, as yet unlimited."""


class BearingLaw(Steering):
    """The text's (module docstring)."""

    predicts = False

    def __init__(self, gain: float, spacing: float, near: float) -> None:
        """Make it.

        Args:
            gain: offset for an error of bearing, 1/rad.
            spacing: of the nodes along the path, m; the last one is the path's end.
            near: how close is close enough, m.
        """
        self._gain, self._spacing, self._near = gain, spacing, near

    def begin(self, route: Route) -> None:
        """See `Steering.begin`."""
        count = max(1, math.ceil(route.length / self._spacing - 1e-9))
        self._nodes = [route.pose(min(k * self._spacing, route.length)) for k in range(1, count + 1)]
        self.node = 0

    def offset(self, seen: Seen) -> float:
        """See `Steering.offset`."""
        x, y, heading = seen.pose.x, seen.pose.y, seen.pose.heading
        last = len(self._nodes) - 1
        while self.node < last and self._away(x, y) <= self._near:
            self.node += 1
        node = self._nodes[self.node]
        bearing = math.atan2(node.y - y, node.x - x)
        return self._gain * math.remainder(bearing - heading, 2 * math.pi)

    def _away(self, x: float, y: float) -> float:
        node = self._nodes[self.node]
        return math.hypot(node.x - x, node.y - y)


class PathLaw(Steering):
    """Ours (module docstring)."""

    predicts = True

    def __init__(self, footprint: Footprint, length: float, settle: float) -> None:
        """Make it.

        Args:
            footprint: curvature → offset.
            length: L, m.
            settle: ℓ, m.
        """
        self._offsets, self._curvatures = np.array(footprint.offsets), np.array(footprint.curvatures)
        self._length, self._settle = length, settle

    def begin(self, route: Route) -> None:
        """See `Steering.begin`."""
        self._route = route
        self.node = 0

    def offset(self, seen: Seen) -> float:
        """See `Steering.offset`."""
        s, n, heading, _ = seen.place
        while self.node < len(self._route.arcs) - 2 and s > self._route.arcs[self.node + 1, 4]:
            self.node += 1
        ahead = self._route.curvature(s + self._settle)
        error = math.remainder(seen.pose.heading - heading, 2 * math.pi)
        towards = -min(max(n / (2 * DAMPING * self._length), -_STEEPEST), _STEEPEST)
        rate = seen.curvature - seen.place.curvature + math.sin(error) / (2 * DAMPING * self._length)
        back = 2 * DAMPING / self._length * (error - towards + self._settle * rate)
        curvature = ahead / max(1 - ahead * n, 0.5) - back - seen.disturbance
        return float(np.interp(curvature, self._curvatures, self._offsets))
