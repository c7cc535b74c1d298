"""Footprint: area that the body covers along the path of its centre of mass, and the footprint file.

Section 5.2.1 (Fig. 52 and 58): at a constant offset the centre of mass follows an arc of curvature κ. Two
concentric arcs bound the body: at every point of the path it stays within

$$ -r(κ) ≤ n ≤ l(κ) $$

where n is the distance to the left of the path, l the left and r the right edge. Along the arc, the footprint
extends from `behind` the centre of mass (the tail) to `ahead` of it (the head).

Offset, speed and edges are tabulated by curvature, with linear interpolation between the rows. A footprint
file contains such a table in the form of Table 8; each column has a unit, a status and a source. The
published footprints are in calibration/footprints; `srs-twin calibrate footprint` measures new ones.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from srs_twin.errors import InputError
from srs_twin.io.documents import Document, dump_yaml, load_yaml
from srs_twin.io.files import atomic_write, find_file
from srs_twin.io.validation import StrictModel, validate
from srs_twin.planning.margins import ExcursionsFile
from srs_twin.plants.twin.mjcf.numerics import UNSTATED_CONTACT, ContactName
from srs_twin.robot.sourced import Record, Status, bounded

MEASURED_ON_TWIN = "measured on the twin"
"""First words of the source of curvatures that were measured on a twin."""

CURVATURE_TOLERANCE = 1e-9
"""Tolerance for curvatures beyond the ends of the table, 1/m."""


@dataclass(frozen=True)
class FootprintRow:
    """Row of a footprint table.

    Attributes:
        offset: gait offset, positive to the left.
        speed: speed of the centre of mass, m/s.
        left: distance of the left edge from the path, m.
        right: distance of the right edge from the path, m.
    """

    offset: float
    speed: float
    left: float
    right: float


@dataclass(frozen=True)
class Transient:
    """Deviation from the steady footprint after a change of offset.

    In the long term, the path is that of a snake that jumps at the change by (dx, dy) relative to its
    heading, turns by dheading, and follows the new arc from there.

    Attributes:
        before: offset before the change.
        after: offset after the change.
        left: extra width of the left edge, m.
        right: extra width of the right edge, m.
        length: length of the path after the change on which the edges are wider, m.
        dx: jump ahead, m.
        dy: jump to the left, m.
        dheading: turn to the left, rad.
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
    """Footprint of a robot for one gait and pressure; columns have shape (rows,), ordered by offset.

    Attributes:
        name: short name.
        title: title of one line.
        offsets: gait offsets, rising.
        curvatures: curvatures of the path of the centre of mass, rising, positive to the left, 1/m.
        speeds: speeds of the centre of mass, m/s.
        left: distances of the left edge from the path, m.
        right: distances of the right edge from the path, m.
        ahead: distance from the centre of mass to the head along the path, m.
        behind: distance from the centre of mass to the tail along the path, m.
        transients: measured changes of offset; empty: none, as the dissertation assumes.
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
        offset: float = 0.3,
        ahead: float = 0.0,
        behind: float = 0.0,
    ) -> Footprint:
        """Return the box of the dissertation: constant width, shifted outward in turns (Fig. 54, Table 9).

        The shift is outward because in Table 8 the inner edge approaches the path in a turn, while the outer
        edge hardly moves.

        Args:
            width: distance between the edges, m.
            shift: shift of both edges in the tightest turn, m.
            speed: speed of the centre of mass, m/s.
            curvature: curvature of the tightest turn, 1/m.
            offset: offset of the tightest turn.
            ahead: see the class, m; the box of the dissertation has no length.
            behind: see the class, m.
        """
        half = width / 2
        wide, narrow = half + shift, half - shift
        title = f"box {1000 * width:g} mm, shift {1000 * shift:g} mm"
        turns = (-offset, 0.0, offset), (-curvature, 0.0, curvature), (speed,) * 3
        return cls("box", title, *turns, (wide, half, narrow), (narrow, half, wide), ahead, behind)

    @property
    def tightest(self) -> tuple[float, float]:
        """Largest curvatures to the right and to the left, both positive, 1/m."""
        return -self.curvatures[0], self.curvatures[-1]

    @property
    def narrowest(self) -> float:
        """Smallest distance of an edge from the path at any curvature, m."""
        return min(*self.left, *self.right)

    def reduced(self, turn_share: float = 1.0, margin: float = 0.0) -> Footprint:
        """Return the footprint with a smaller range of curvatures and wider edges.

        On a plan with a reduced footprint, a follower can correct errors by tighter turns, and the margin
        allows for the remaining errors.

        Args:
            turn_share: fraction of the tightest curvatures, at most 1.
            margin: width added to both edges, m.
        """
        low, high = turn_share * self.curvatures[0], turn_share * self.curvatures[-1]
        # Rows almost at the limits would give intervals of almost no width.
        inner = [k for k in self.curvatures if low + CURVATURE_TOLERANCE < k < high - CURVATURE_TOLERANCE]
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
        """Return the row of a curvature (1/m), interpolated.

        Raises:
            InputError: the curvature is outside the table.
        """
        low, high = self.curvatures[0], self.curvatures[-1]
        if not low - CURVATURE_TOLERANCE <= curvature <= high + CURVATURE_TOLERANCE:
            raise InputError(
                f"curvature {curvature:g} 1/m is outside the footprint's range {low:g} to {high:g} 1/m"
            )
        columns = (self.offsets, self.speeds, self.left, self.right)
        return FootprintRow(*(float(np.interp(curvature, self.curvatures, column)) for column in columns))

    def transient(self, before: float, after: float) -> tuple[float, float, float]:
        """Return extra left and right width and length (m) of the transient after a change of offset.

        The widths are interpolated by the size of the change. A change larger than all measured ones in its
        direction has the widths of the largest measured change. Of several measured changes of equal size the
        widest one is used.
        """
        change = after - before
        same = [t for t in self.transients if (t.after - t.before) * change > 0]
        if not same:
            return 0.0, 0.0, 0.0
        widest: dict[float, tuple[float, float]] = {0.0: (0.0, 0.0)}
        for t in same:
            # Compare rounded sizes, because 0.3 − 0.2 is not exactly 0.1.
            size = round(abs(t.after - t.before), 9)
            old = widest.get(size, (0.0, 0.0))
            widest[size] = max(old[0], t.left), max(old[1], t.right)
        sizes = sorted(widest)
        edges = zip(*(widest[size] for size in sizes), strict=True)
        left, right = (float(np.interp(abs(change), sizes, edge)) for edge in edges)
        # The length does not depend on the size of the change, because the response is that of a linear
        # system.
        return left, right, max(t.length for t in same)

    @property
    def settle(self) -> float | None:
        """Response length ℓ of the curvature to a change of offset, m; None without transients.

        After a change Δκ of the curvature, a first-order response lags in heading by Δκ ℓ = −dheading. ℓ is
        the least-squares estimate over all measured changes.
        """
        changes = np.array([self._curvature(t.after) - self._curvature(t.before) for t in self.transients])
        lags = -np.array([t.dheading for t in self.transients])
        return float(changes @ lags / (changes @ changes)) if changes.any() else None

    def lag(self, before: float, after: float) -> tuple[float, float]:
        """Return delay δ and length T (m) of the transition arc after a change of offset (see `planner`).

        Both are interpolated by the size of the change, constant beyond the measured sizes; (0, 0) without
        measured changes in that direction.
        """
        change = after - before
        known: dict[float, list[tuple[float, float]]] = {}
        for t in self.transients:
            step = self._curvature(t.after) - self._curvature(t.before)
            if (t.after - t.before) * change > 0 and t.dheading * step < 0:
                delay, moment = -t.dheading / step, 2 * t.dy / step
                # The arc cannot be shorter than its delay, see the curvature κ_t.
                lag = delay, max(moment / delay, delay)
                known.setdefault(round(abs(t.after - t.before), 9), []).append(lag)
        if not known:
            return 0.0, 0.0
        sizes = sorted(known)
        means = zip(*(np.mean(known[size], axis=0) for size in sizes), strict=True)
        delay, length = (float(np.interp(abs(change), sizes, mean)) for mean in means)
        return delay, length

    def _curvature(self, offset: float) -> float:
        return float(np.interp(offset, self.offsets, self.curvatures))


def find_problems(footprint: Footprint) -> list[tuple[str, str]]:
    """Return the errors of a footprint as pairs of field and message."""
    problems = []
    rows = len(footprint.offsets)
    for name in ("curvatures", "speeds", "left", "right"):
        if len(getattr(footprint, name)) != rows:
            problems.append((name, f"{len(getattr(footprint, name))} values for {rows} offsets"))
    for name in ("offsets", "curvatures"):
        values = getattr(footprint, name)
        # Interpolation over a column needs increasing values.
        if any(b <= a for a, b in zip(values, values[1:], strict=False)):
            problems.append((name, "must increase from row to row: a larger offset turns more to the left"))
    if problems:
        return problems
    low, high = footprint.curvatures[0], footprint.curvatures[-1]
    if not low < 0 < high:
        problems.append(("curvatures", f"from {low:g} to {high:g} 1/m; a planner needs turns to both sides"))
    for side, name in enumerate(("left", "right")):
        # An edge on the inner side must not reach the centre of curvature, where κ n = 1.
        turn = (1 if name == "left" else -1) * np.array(footprint.curvatures)
        # Include the largest transient after any change to this offset.
        extra = [
            max(footprint.transient(before, after)[side] for before in footprint.offsets)
            for after in footprint.offsets
        ]
        edges = np.add(getattr(footprint, name), extra)
        row = int(np.argmax(turn * edges))
        if turn[row] * edges[row] >= 1:
            tightest, offset = turn[row] == turn.max(), footprint.offsets[row]
            which = "tightest turn" if tightest else f"turn of offset {offset:g}"
            where = f"the centre of the {which}, radius {1 / turn[row]:g} m"
            problems.append((name, f"{edges[row]:g} m reaches {where}"))
    return problems


def validate_footprint(footprint: Footprint) -> Footprint:
    """Return a footprint unchanged if it is valid.

    Raises:
        InputError: the footprint is inconsistent, or a number is not finite.
    """
    columns = (getattr(footprint, name) for name in _KEYS)
    numbers = [*chain.from_iterable(columns), footprint.ahead, footprint.behind]
    if not np.isfinite(numbers).all():
        raise InputError(f"footprint {footprint.name}: a number is not finite")
    if min(footprint.speeds) <= 0 or footprint.narrowest <= 0 or min(footprint.ahead, footprint.behind) < 0:
        raise InputError(
            f"footprint {footprint.name}: speeds and edges must be above 0, ahead and behind not negative"
        )
    for field, message in find_problems(footprint):
        raise InputError(f"footprint {footprint.name}: {field}: {message}")
    return footprint


Rows = Field(min_length=3, max_length=101)
Offsets = Record[Annotated[list[Annotated[float, bounded(-1.0, 1.0)]], Rows], Literal["1"]]
Curvatures = Record[Annotated[list[Annotated[float, bounded(-100.0, 100.0)]], Rows], Literal["1/m"]]
Speeds = Record[Annotated[list[Annotated[float, bounded(1e-3, 10.0)]], Rows], Literal["m/s"]]
Edges = Record[Annotated[list[Annotated[float, bounded(1e-3, 10.0)]], Rows], Literal["m"]]
Reach = Record[Annotated[float, bounded(0.0, 10.0)], Literal["m"]]

Offset = Annotated[float, bounded(-1.0, 1.0)]
Metres = Annotated[float, bounded(0.0, 10.0)]
Shift = Annotated[float, bounded(-10.0, 10.0)]
Spreads = Annotated[list[Annotated[float, bounded(0.0, 100.0)]], Rows]


class TransientFile(StrictModel):
    """Deviation from the steady footprint after one change of offset."""

    from_offset: Offset = Field(description="Offset before, -1 to 1.")
    to_offset: Offset = Field(description="Offset after, -1 to 1.")
    left_m: Metres = Field(description="Extra width of the left edge, m, 0 to 10.")
    right_m: Metres = Field(description="Extra width of the right edge, m, 0 to 10.")
    length_m: Metres = Field(description="Length of the path with wider edges, m, 0 to 10.")
    dx_m: Shift = Field(0.0, description="Jump of the path along itself, m, -10 to 10 (default 0).")
    dy_m: Shift = Field(0.0, description="Jump of the path to its left, m, -10 to 10 (default 0).")
    dheading_rad: Annotated[float, bounded(-3.15, 3.15)] = Field(
        0.0, description="Turn of the path to the left, rad, -3.15 to 3.15 (default 0)."
    )

    def transient(self) -> Transient:
        """Return the change as a `Transient`."""
        return Transient(*self.model_dump().values())


class TransientsFile(StrictModel):
    """Measured changes of offset."""

    status: Status = Field(description="Status of the numbers.")
    source: str = Field(min_length=1, max_length=1000, description="Source of the measurements.")
    changes: Annotated[list[TransientFile], Field(min_length=1, max_length=200)] = Field(
        description="List of changes of offset."
    )


class SpreadFile(StrictModel):
    """Standard deviations of repeated measurements of the columns, one per offset."""

    source: str = Field(
        min_length=1, max_length=1000, description="Repeated measurement and definition of the spread."
    )
    curvature_per_m: Spreads = Field(description="Spread of the curvature, 1/m, 0 to 100.")
    speed_m_s: Spreads = Field(description="Spread of the speed, m/s, 0 to 100.")
    left_m: Spreads = Field(description="Spread of the left edge, m, 0 to 100.")
    right_m: Spreads = Field(description="Spread of the right edge, m, 0 to 100.")


class FootprintFile(StrictModel):
    """Footprint file; its columns have one value per offset."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$", min_length=1, max_length=60, description="Short name.")
    title: str = Field(min_length=1, max_length=200, description="Title of one line.")
    robot: str = Field(min_length=1, max_length=200, description="Robot of this footprint.")
    contact: ContactName | None = Field(
        None, description="Contact of the twin of the measurement (default: none, not measured on a twin)."
    )
    offset: Offsets = Field(description="Gait offsets, rising, -1 to 1; positive turns left.")
    curvature_per_m: Curvatures = Field(
        description="Curvature of the path, 1/m, positive to the left, -100 to 100."
    )
    speed_m_s: Speeds = Field(description="Speed of the centre of mass, m/s, 0.001 to 10.")
    left_m: Edges = Field(description="Distance of the left edge from the path, m, 0.001 to 10.")
    right_m: Edges = Field(description="Distance of the right edge from the path, m, 0.001 to 10.")
    ahead_m: Reach = Field(
        description="Distance from the centre of mass to the head along the path, m, 0 to 10."
    )
    behind_m: Reach = Field(
        description="Distance from the centre of mass to the tail along the path, m, 0 to 10."
    )
    spread: SpreadFile | None = Field(None, description="Repeatability, if measured.")
    transients: TransientsFile | None = Field(None, description="Changes of offset, if measured.")
    excursions: Annotated[list[ExcursionsFile], Field(max_length=100)] | None = Field(
        None, description="Excursions of followers, if measured, for margins with a probability."
    )

    @property
    def twin_contact(self) -> ContactName | None:
        """Contact of the twin of the measurement; None: not measured on a twin."""
        measured = self.curvature_per_m.source.startswith(MEASURED_ON_TWIN)
        return self.contact or (UNSTATED_CONTACT if measured else None)

    def mismatch(self, contact: ContactName) -> str | None:
        """Return a warning if the contact of a twin differs from that of the measurement, or None."""
        own = self.twin_contact
        if own in (None, contact):
            return None
        return (
            f"{self.name} was measured on a twin with contact {own}, but this twin has contact "
            f"{contact}; `srs-twin calibrate footprint {self.robot} --contact {contact}` measures one"
        )

    def footprint(self) -> Footprint:
        """Return the footprint without sources."""
        columns = [tuple(getattr(self, key).value) for key in _KEYS.values()]
        values: list[Any] = [self.name, self.title, *columns, self.ahead_m.value, self.behind_m.value]
        changes = self.transients.changes if self.transients else []
        values.append(tuple(change.transient() for change in changes))
        return Footprint(*values)


_KEYS = {
    "offsets": "offset",
    "curvatures": "curvature_per_m",
    "speeds": "speed_m_s",
    "left": "left_m",
    "right": "right_m",
}
"""Columns of `Footprint`, in its order → keys in the file."""


def load_footprint_file(name_or_path: str | os.PathLike[str]) -> FootprintFile:
    """Load and check a footprint file, given by a shipped name (gen4_table8) or a path.

    Raises:
        InputError: the file is not found or cannot be read.
        InputFileError: the file is not valid; lists all problems.
    """
    document = load_yaml(find_file("footprint", name_or_path))
    file = validate(FootprintFile, document, document.data)
    if file:
        _report(file, document)
    document.raise_problems()
    assert file is not None, "no problem was reported"
    return file


def load_footprint(name_or_path: str | os.PathLike[str]) -> Footprint:
    """Load a footprint, given by a shipped name (gen4_table8) or a path.

    Raises:
        InputError, InputFileError: as `load_footprint_file`.
    """
    return load_footprint_file(name_or_path).footprint()


def save_footprint(file: FootprintFile, path: str | os.PathLike[str], *, header: Sequence[str] = ()) -> None:
    """Write a footprint file atomically.

    Args:
        file: the footprint file.
        path: path of the file.
        header: lines of a comment at the top.

    Raises:
        InputFileError: the table is not a valid footprint.
        InputError: the file cannot be written.
    """
    document = Document(os.fspath(path))
    _report(file, document)
    document.raise_problems()
    with atomic_write(path) as part:
        comment = "".join(f"# {line}\n" for line in header)
        text = dump_yaml(file.model_dump(mode="json", exclude_none=True), compact=True)
        part.write_text(comment + text, "utf-8")


def _report(file: FootprintFile, document: Document) -> None:
    """Report all problems of a footprint file to its document."""
    for name in ("curvature_per_m", "speed_m_s", "left_m", "right_m") if file.spread else ():
        values = getattr(file.spread, name)
        if len(values) != len(file.offset.value):
            document.report(("spread", name), f"{len(values)} values for {len(file.offset.value)} offsets")
    for name, message in find_problems(file.footprint()):
        document.report((_KEYS[name], "value"), message)
