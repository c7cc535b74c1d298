"""Footprint, the area that the body covers along the path of its centre of mass.

At a constant gait offset, the centre of mass follows an arc of curvature κ. The body
stays between two concentric arcs (Section 5.2.1, Figs. 52 and 58), which limit its
distance n to the left of the path:

$$ -r(κ) ≤ n ≤ l(κ), $$

where l and r are the distances from the path to the left and right edges of the
footprint. Along the arc, the head is at the distance `ahead` and the tail is at the
distance `behind` from the centre of mass. A table contains the offset, the speed and
the edges for several curvatures, between which all quantities are interpolated
linearly.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, pairwise

import numpy as np

from srs_twin.errors import InputError

COLUMNS = ("offsets", "curvatures", "speeds", "left", "right")
"""Columns of a footprint table, with one value per offset in each column."""

CURVATURE_TOLERANCE = 1e-9
"""Amount by which a curvature may exceed the range of a table, 1/m."""


@dataclass(frozen=True)
class FootprintRow:
    """Row of a footprint table, with quantities as defined in `Footprint`."""

    offset: float
    speed: float
    left: float
    right: float


@dataclass(frozen=True)
class Transient:
    """Deviation from the steady footprint after a change of offset.

    Attributes:
        before, after: offset before and after the change.
        left, right: outward shifts of the left and right edges, m.
        length: path length after the change over which the edges are shifted, m.
        dx, dy: final forward and leftward displacements compared with an instantaneous
            change, m.
        dheading: final heading deviation compared with an instantaneous change,
            positive to the left, rad.
    """

    before: float
    after: float
    left: float
    right: float
    length: float
    dx: float = 0.0
    dy: float = 0.0
    dheading: float = 0.0


@dataclass(frozen=True)
class Footprint:
    """Footprint of a robot for one gait and supply pressure.

    Attributes:
        name: short name.
        title: one-line title.
        offsets: gait offsets in ascending order, shape (rows,).
        curvatures: path curvatures in ascending order, positive to the left, 1/m, shape
            (rows,).
        speeds: speeds of the centre of mass, m/s, shape (rows,).
        left, right: distances from the path to the left and right edges, m, shape
            (rows,).
        ahead, behind: distances from the centre of mass to the head and to the tail
            along the path, m.
        transients: measured responses to changes of offset. Without measurements, the
            path is assumed to respond instantly, as in the dissertation.
    """

    name: str
    title: str
    offsets: tuple[float, ...]
    curvatures: tuple[float, ...]
    speeds: tuple[float, ...]
    left: tuple[float, ...]
    right: tuple[float, ...]
    ahead: float
    behind: float
    transients: tuple[Transient, ...] = ()

    @classmethod
    def box(
        cls,
        width: float,
        shift: float,
        *,
        speed: float,
        curvature: float,
        ahead: float = 0.0,
    ) -> Footprint:
        """Return a footprint of constant width, as in Fig. 54 and Table 9.

        In a turn, both edges are shifted towards the outside in proportion to the
        curvature, because the inner edge approaches the path in Table 8.

        Args:
            width: distance between the edges, m.
            shift: shift of both edges in the tightest turn, m.
            speed: speed of the centre of mass, m/s.
            curvature: curvature of the tightest turn, 1/m.
            ahead: distance from the centre of mass to the head (0 in the dissertation),
                m.
        """
        half = width / 2
        wide = half + shift
        narrow = half - shift
        title = f"box {1000 * width:g} mm, shift {1000 * shift:g} mm"
        return cls(
            "box",
            title,
            offsets=(-0.3, 0.0, 0.3),
            curvatures=(-curvature, 0.0, curvature),
            speeds=(speed,) * 3,
            left=(wide, half, narrow),
            right=(narrow, half, wide),
            ahead=ahead,
            behind=0.0,
        )

    @property
    def tightest(self) -> tuple[float, float]:
        """Maximum curvatures of right and left turns as positive numbers, 1/m."""
        return -self.curvatures[0], self.curvatures[-1]

    @property
    def narrowest(self) -> float:
        """Minimum distance between the path and an edge over all curvatures, m."""
        return min(*self.left, *self.right)

    @property
    def backward(self) -> Footprint:
        """Footprint for backward travel, without transients."""
        return replace(
            self,
            offsets=tuple(-value for value in reversed(self.offsets)),
            curvatures=tuple(-value for value in reversed(self.curvatures)),
            speeds=self.speeds[::-1],
            left=self.right[::-1],
            right=self.left[::-1],
            ahead=self.behind,
            behind=self.ahead,
            transients=(),
        )

    def reduced(self, turn_fraction: float = 1.0, margin: float = 0.0) -> Footprint:
        """Return the footprint with a smaller range of curvatures and an added margin.

        The follower needs the excluded tight turns to correct errors, and the margin
        covers the remaining errors.

        Args:
            turn_fraction: ratio of the new to the old maximum curvature, at most 1.
            margin: outward shift of each edge, m.
        """
        low = turn_fraction * self.curvatures[0]
        high = turn_fraction * self.curvatures[-1]
        # Rows very close to the new limits are dropped to avoid table intervals of
        # almost zero width.
        inner = [
            k
            for k in self.curvatures
            if low + CURVATURE_TOLERANCE < k < high - CURVATURE_TOLERANCE
        ]
        curvatures = (low, *inner, high)
        rows = [self.at(k) for k in curvatures]
        return replace(
            self,
            offsets=tuple(row.offset for row in rows),
            curvatures=curvatures,
            speeds=tuple(row.speed for row in rows),
            left=tuple(row.left + margin for row in rows),
            right=tuple(row.right + margin for row in rows),
        )

    def at(self, curvature: float) -> FootprintRow:
        """Interpolate the table at a curvature (1/m).

        Raises:
            InputError: the curvature is outside the table.
        """
        low = self.curvatures[0]
        high = self.curvatures[-1]
        if not low - CURVATURE_TOLERANCE <= curvature <= high + CURVATURE_TOLERANCE:
            raise InputError(
                f"the curvature {curvature:g} 1/m is not allowed; the footprint covers"
                f" curvatures between {low:g} and {high:g} 1/m"
            )
        columns = (self.offsets, self.speeds, self.left, self.right)
        return FootprintRow(
            *(
                float(np.interp(curvature, self.curvatures, column))
                for column in columns
            )
        )

    def transient(self, before: float, after: float) -> tuple[float, float, float]:
        """Return the left edge shift, right edge shift and length of a transient, m.

        The outward shifts are interpolated between the measured changes of offset in
        the same direction. A change that exceeds all measured changes has the shifts of
        the largest measured change. If several measured changes have equal size, their
        largest shifts are used.
        """
        measured = self._measured(after - before)
        if not measured:
            return 0.0, 0.0, 0.0
        widest = {0.0: (0.0, 0.0)}
        for size, t in measured:
            left, right = widest.get(size, (0.0, 0.0))
            widest[size] = max(left, t.left), max(right, t.right)
        return *_interpolated(abs(after - before), widest), max(
            t.length for _, t in measured
        )

    @property
    def response_length(self) -> float | None:
        """Path length ℓ over which the curvature responds to a change of offset, m.

        In a first-order response to a curvature change Δκ, the heading lags by
        Δκ ℓ = −dheading. The response length is a least-squares estimate over all
        transients, or None if the footprint has no transients.
        """
        changes = np.array(
            [
                self._curvature(t.after) - self._curvature(t.before)
                for t in self.transients
            ]
        )
        lags = -np.array([t.dheading for t in self.transients])
        if changes.any():
            return float(changes @ lags / (changes @ changes))
        return None

    def lag(self, before: float, after: float) -> tuple[float, float]:
        """Return the delay δ and the length T of a transition arc (see `planner`), m.

        Both values are interpolated between the measured changes of offset in the same
        direction, and are 0 if there are none.
        """
        known: dict[float, list[tuple[float, float]]] = {}
        for size, t in self._measured(after - before):
            step = self._curvature(t.after) - self._curvature(t.before)
            if t.dheading * step < 0:
                delay = -t.dheading / step
                moment = 2 * t.dy / step
                # If T were shorter than δ, the curvature of the transition arc would
                # change in the wrong direction.
                known.setdefault(size, []).append((delay, max(moment / delay, delay)))
        if not known:
            return 0.0, 0.0
        means = {size: np.mean(lags, axis=0) for size, lags in known.items()}
        return _interpolated(abs(after - before), means)

    def _measured(self, change: float) -> list[tuple[float, Transient]]:
        # Rounding ensures that 0.3 − 0.2 equals 0.1.
        return [
            (round(abs(t.after - t.before), 9), t)
            for t in self.transients
            if (t.after - t.before) * change > 0
        ]

    def _curvature(self, offset: float) -> float:
        return float(np.interp(offset, self.offsets, self.curvatures))


def _interpolated(
    size: float, values: Mapping[float, Sequence[float] | np.ndarray]
) -> tuple[float, float]:
    sizes = sorted(values)
    columns = zip(*(values[known] for known in sizes), strict=True)
    first, second = (float(np.interp(size, sizes, column)) for column in columns)
    return first, second


def find_problems(footprint: Footprint) -> list[tuple[str, str]]:
    """Return the errors in a footprint as pairs of field name and message."""
    problems = []
    rows = len(footprint.offsets)
    for name in COLUMNS[1:]:
        if len(values := getattr(footprint, name)) != rows:
            problems.append(
                (
                    name,
                    f"{len(values)} values are given for {rows} offsets; give one"
                    " value for each offset",
                )
            )
    for name in ("offsets", "curvatures"):
        values = getattr(footprint, name)
        if any(b <= a for a, b in pairwise(values)):
            problems.append(
                (
                    name,
                    "the values must increase from row to row, because a larger"
                    " offset turns the robot more to the left",
                )
            )
    if problems:
        return problems
    low = footprint.curvatures[0]
    high = footprint.curvatures[-1]
    if not low < 0 < high:
        problems.append(
            (
                "curvatures",
                f"the values range from {low:g} to {high:g} 1/m, but a planner needs"
                " turns to both sides; measure offsets below and above 0",
            )
        )
    for side, name in enumerate(("left", "right")):
        # The inner edge must not reach the centre of curvature, where κ n = 1.
        turn = (1 if name == "left" else -1) * np.array(footprint.curvatures)
        # The largest shift after any change to an offset is added to the edge.
        extra = [
            max(
                footprint.transient(before, after)[side] for before in footprint.offsets
            )
            for after in footprint.offsets
        ]
        edges = np.add(getattr(footprint, name), extra)
        row = int(np.argmax(turn * edges))
        if turn[row] * edges[row] >= 1:
            which = f"turn at offset {footprint.offsets[row]:g}"
            if turn[row] == turn.max():
                which = "tightest turn"
            where = f"the centre of the {which}, radius {1 / turn[row]:g} m"
            problems.append((name, f"{edges[row]:g} m reaches {where}"))
    return problems


def validate_footprint(footprint: Footprint) -> Footprint:
    """Return a footprint unchanged after checking its values.

    Raises:
        InputError: the footprint is not valid.
    """
    columns = (getattr(footprint, name) for name in COLUMNS)
    numbers = [*chain.from_iterable(columns), footprint.ahead, footprint.behind]
    if not np.isfinite(numbers).all():
        raise InputError(
            f"footprint {footprint.name}: at least one value is not finite; all"
            " values must be finite"
        )
    if (
        min(footprint.speeds) <= 0
        or footprint.narrowest <= 0
        or min(footprint.ahead, footprint.behind) < 0
    ):
        raise InputError(
            f"footprint {footprint.name}: a value is too small; speeds and the edges"
            " `left` and `right` must be above 0, and the edges `ahead` and `behind`"
            " at least 0"
        )
    for field, message in find_problems(footprint):
        raise InputError(f"footprint {footprint.name}: {field}: {message}")
    return footprint
