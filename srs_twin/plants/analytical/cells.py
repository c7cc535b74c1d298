"""Division of segments into cells, for robots with skin and for contact with obstacles.

A segment of constant curvature with bend q is divided into a chain of arcs, which are
called cells. The bend of cell c is s_c q, where s_c is the fraction of q assigned to
the cell. The contact points of the body are at the ends of the cells, and the mass is
distributed over these points by the trapezoidal rule. The kernels treat each cell as a
segment. The mean heading of all points differs from the mean heading of the connectors
by a linear function of the bends.

For prescribed bends, the moment of a segment is T_j = Σ s_c T_c, where T_c is the
moment of cell c. In the model `compliant`, the bends of the cells are degrees of
freedom. A cell has the stiffness k/s_c and the damping c/s_c, so that the cells in
series have the stiffness k and the damping c of the segment.

The segments of a wheeled robot are divided if the robot can touch obstacles, because a
load between two connectors bends a segment unevenly. In this case, all masses and
wheels remain at the connectors.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from srs_twin.compute.arrays import Array
from srs_twin.robot.spec import Geometry, RobotSpec

_RIGID_RATIO = 1e6
"""Stiffness of a cell in the rigid gap, relative to the stiffness of the segment.

With this ratio, such a cell bends by less than a microradian.
"""


class Discretisation(NamedTuple):
    """Division of a segment into cells, which are arcs between contact points.

    Attributes:
        length: lengths of the cells, head first, shape (cells,), m.
        fraction: fraction s_c of the segment's bend in each cell, 0 in the rigid gap,
            shape (cells,), dimensionless.
    """

    length: Array
    fraction: Array

    @classmethod
    def of(cls, geometry: Geometry, points: int) -> Discretisation:
        """Divide a segment into about `points` cells of similar length."""
        half_gap = geometry.rigid_gap / 2
        lengths = np.array([half_gap, geometry.segment_length, half_gap])
        fractions = np.array([0.0, 1.0, 0.0])[lengths > 0.0]
        lengths = lengths[lengths > 0.0]
        counts = np.round(points * lengths / geometry.pitch).astype(int).clip(1)
        return cls(
            np.repeat(lengths / counts, counts), np.repeat(fractions / counts, counts)
        )


class LumpedSegments:
    """Undivided segments of a robot with masses and contacts at the connectors.

    Attributes:
        spec: robot to which the segments belong.
        mass: mass at each point, shape (points,), kg. The points are the connectors or,
            in the subclass `Cells`, the ends of the cells.
        length: arc length of all segments, or of each cell with shape (cells,), m.
        gap: length of the straight part of each segment, m.
        inverse_fraction: inverse fraction 1/s_c of each cell, or `_RIGID_RATIO` in the
            rigid gap, shape (segments, cells per segment), or 1 without cells.
    """

    inverse_fraction: float | Array = 1.0

    def __init__(self, spec: RobotSpec) -> None:
        self.spec = spec
        self.mass = spec.mass.array()
        self.length: float | Array = spec.geometry.segment_length
        self.gap = spec.geometry.rigid_gap

    @property
    def com_behind_head(self) -> float:
        """Distance from the head connector to the straight body's centre of mass, m."""
        pitch = self.spec.geometry.pitch
        return (
            pitch
            * float(np.arange(len(self.mass)) @ self.mass)
            / float(self.mass.sum())
        )

    def split(self, bend: Array) -> Array:
        """Convert segment bends to cell bends, shape (…, cells)."""
        return bend

    def total(self, bend: Array) -> Array:
        """Convert cell bends to segment bends, shape (…, segments)."""
        return bend

    def moments(self, torque: Array) -> Array:
        """Convert cell moments T_c to segment moments T_j, N·m."""
        return torque

    def lead(self, bend: Array) -> float:
        """Return the mean heading of all points minus that of the connectors, rad."""
        return 0.0

    def at_connectors(self, values: Array) -> Array:
        """Select the values at the connectors, shape (samples, N, …)."""
        return values

    def on_connectors(self, force: Array) -> Array:
        """Distribute point forces to adjacent connectors, shape (samples, N, 2), N."""
        return force


class Cells(LumpedSegments):
    """Segments, each of which is divided into `points_per_segment` cells."""

    def __init__(self, spec: RobotSpec, cells: Discretisation, mass: Array) -> None:
        """Divide all segments of a robot.

        Args:
            spec: robot whose body is divided.
            cells: division of each segment into cells.
            mass: masses at the ends of the cells, shape (points,), kg.
        """
        super().__init__(spec)
        self._segments = spec.segments
        self.points_per_segment = len(cells.fraction)
        self.mass = mass
        self.gap = 0.0
        self.length = np.tile(cells.length, spec.segments)
        self._fraction = cells.fraction
        self._behind_head = np.append(0.0, np.cumsum(self.length))
        rigid = cells.fraction == 0.0
        inverse = np.where(
            rigid, _RIGID_RATIO, 1.0 / np.where(rigid, 1.0, cells.fraction)
        )
        self.inverse_fraction = np.tile(inverse, (spec.segments, 1))

    @property
    def com_behind_head(self) -> float:
        """See `LumpedSegments.com_behind_head`."""
        return float(self._behind_head @ self.mass) / float(self.mass.sum())

    def split(self, bend: Array) -> Array:
        """See `LumpedSegments.split`."""
        cells = bend[..., None] * self._fraction
        return cells.reshape(*bend.shape[:-1], bend.shape[-1] * len(self._fraction))

    def total(self, bend: Array) -> Array:
        """See `LumpedSegments.total`."""
        total: Array = bend.reshape(
            *bend.shape[:-1], self._segments, len(self._fraction)
        ).sum(axis=-1)
        return total

    def moments(self, torque: Array) -> Array:
        """See `LumpedSegments.moments`."""
        return (
            torque.reshape(*torque.shape[:-1], self._segments, len(self._fraction))
            @ self._fraction
        )

    def lead(self, bend: Array) -> float:
        """See `LumpedSegments.lead`."""
        heading = np.append(0.0, -np.cumsum(bend))
        return float(heading.mean() - heading[:: len(self._fraction)].mean())

    def at_connectors(self, values: Array) -> Array:
        """See `LumpedSegments.at_connectors`."""
        return values[:, :: len(self._fraction)]

    def on_connectors(self, force: Array) -> Array:
        """See `LumpedSegments.on_connectors`."""
        fractions = self.spec.connector_weights(self._behind_head)
        shared: Array = np.einsum("ik,skc->sic", fractions, force)
        return shared

    def obstacle_force(self, force: Array) -> Array:
        """Assign point forces to the nearest connector, shape (samples, N, 2), N."""
        stations = self._behind_head / self.spec.geometry.pitch
        distance = np.abs(np.arange(self.spec.geometry.connectors)[:, None] - stations)
        weights = np.clip(0.5 + (0.5 - distance) / _MIDDLE, 0.0, 1.0)
        shared: Array = np.einsum("ik,skc->sic", weights, force)
        return shared


_MIDDLE = 1e-6
"""Width of the transition zone in the middle of a segment, relative to the pitch.

A force in this zone is divided between the two halves of the segment.
"""


def cells_of_skin(spec: RobotSpec) -> Cells:
    """Divide a robot with skin into cells, and distribute the mass to their ends."""
    assert spec.skin is not None and spec.mass.segments is not None, "a robot with skin"
    discretisation = Discretisation.of(spec.geometry, spec.skin.points)
    cells = np.outer(
        spec.mass.segments, discretisation.length / spec.geometry.pitch
    ).ravel()
    return Cells(
        spec, discretisation, (np.append(0.0, cells) + np.append(cells, 0.0)) / 2
    )


def cells_of_wheels(spec: RobotSpec, count: int) -> Cells:
    """Divide each segment of a wheeled robot into about `count` cells."""
    discretisation = Discretisation.of(spec.geometry, count)
    mass = np.zeros(spec.segments * len(discretisation.fraction) + 1)
    mass[:: len(discretisation.fraction)] = spec.mass.array()
    return Cells(spec, discretisation, mass)
