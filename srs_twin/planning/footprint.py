"""Footprint: the floor that the snake sweeps about the path of its centre of mass, and its file.

Section 5.2.1 (Fig. 52 and 58): under a constant offset the centre of mass follows an arc of curvature κ. Two
arcs about the same centre bound the body: on a point of the path, the body stays within

$$ -r(κ) ≤ n ≤ l(κ) $$

where n is the distance to the left of the path, l the left and r the right edge. Across the path the
footprint ends where head and tail are: `ahead` before and `behind` after the centre of mass, along the arc.

Offset, speed and edges are read from a table by curvature, linear between its rows. A footprint file holds
such a table as Table 8 has it, every column with unit, status and source. The published ones are in
calibration/footprints; `srs-twin calibrate footprint` writes others.
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
from srs_twin.io.files import atomic_write, find
from srs_twin.io.validation import Strict, validate
from srs_twin.planning.margins import ExcursionsFile
from srs_twin.plants.twin.mjcf.numerics import UNSTATED_CONTACT, ContactName
from srs_twin.robot.sourced import Record, Status, between

MEASURED_ON_TWIN = "measured on the twin"
"""Beginning of the source of curvatures that were measured on a twin."""

SMALL_TURN = 1e-9
"""Curvatures beyond the table by less are rounding, 1/m."""


@dataclass(frozen=True)
class FootprintRow:
    """What one curvature means for the snake.

    Attributes:
        offset: phase offset of the gait, positive to the left.
        speed: of the centre of mass, m/s.
        left: distance of the left edge from the path, m.
        right: distance of the right edge from the path, m.
    """

    offset: float
    speed: float
    left: float
    right: float


@dataclass(frozen=True)
class Transient:
    """How far the snake leaves the new arc after a change of offset, beyond the steady edges.

    Attributes:
        before: offset before the change.
        after: offset after it.
        left: how much wider the left edge has to be, m.
        right: how much wider the right edge has to be, m.
        length: path after the change over which that holds, m.
        dx: how far ahead the path is, m, once it is settled: as if at the change the snake had jumped by
            (dx, dy), in the direction of its path and to the left of it, turned by dheading, and followed the
            new arc from there.
        dy: … to the left, m.
        dheading: … turned to the left, rad.
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
    """A robot's footprint in one gait at one pressure; rows by rising offset, (rows,) each.

    Attributes:
        name: short name.
        title: one line for people.
        offsets: phase offsets, rising.
        curvatures: of the path of the centre of mass, 1/m, rising, left positive.
        speeds: m/s.
        left: distances of the left edge from the path, m.
        right: distances of the right edge from the path, m.
        ahead: from the centre of mass to the head, along the path, m.
        behind: from the centre of mass to the tail, along the path, m.
        transients: measured changes of offset; empty where the dissertation's assumption holds, that there is
            no transient.
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
        """Return the text's box: constant width, shifted outward as it turns (Fig. 54, Table 9).

        Outward, since Table 8's inner edges draw nearer and the outer ones hardly do.

        Args:
            width: from edge to edge, m.
            shift: of both edges at the tightest turn, m.
            speed: m/s.
            curvature: of the tightest turn, 1/m.
            offset: of the tightest turn.
            ahead: see the class, m; the text's box has no length of its own.
            behind: see the class, m.
        """
        half = width / 2
        wide, narrow = half + shift, half - shift
        title = f"box {1000 * width:g} mm, shift {1000 * shift:g} mm"
        turns = (-offset, 0.0, offset), (-curvature, 0.0, curvature), (speed,) * 3
        return cls("box", title, *turns, (wide, half, narrow), (narrow, half, wide), ahead, behind)

    @property
    def tightest(self) -> tuple[float, float]:
        """Largest curvatures to the right and to the left, both above 0, 1/m."""
        return -self.curvatures[0], self.curvatures[-1]

    @property
    def narrowest(self) -> float:
        """Distance that every point of the path keeps from everything, whatever the curvature, m."""
        return min(*self.left, *self.right)

    def reduced(self, turn_share: float = 1.0, margin: float = 0.0) -> Footprint:
        """Return the same with a part of its turns and wider edges.

        Planned with that, a follower has turns left to correct with, and room for what remains.

        Args:
            turn_share: of the tightest curvatures, 1 at most.
            margin: added to both edges, m.
        """
        low, high = turn_share * self.curvatures[0], turn_share * self.curvatures[-1]
        inner = [k for k in self.curvatures if low + SMALL_TURN < k < high - SMALL_TURN]
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
        """Return what a curvature (1/m) means.

        Raises:
            InputError: the snake cannot turn so tightly.
        """
        low, high = self.curvatures[0], self.curvatures[-1]
        if not low - SMALL_TURN <= curvature <= high + SMALL_TURN:
            raise InputError(f"curvature {curvature:g} 1/m is not in the footprint's {low:g} to {high:g} 1/m")
        columns = (self.offsets, self.speeds, self.left, self.right)
        return FootprintRow(*(float(np.interp(curvature, self.curvatures, column)) for column in columns))

    def transient(self, before: float, after: float) -> tuple[float, float, float]:
        """Return (left, right, length), m, of a change of offset, linear in how large the change is.

        Changes larger than any measured one in that direction count as the largest; of changes that are
        equally large the widest counts.
        """
        change = after - before
        same = [t for t in self.transients if (t.after - t.before) * change > 0]
        if not same:
            return 0.0, 0.0, 0.0
        widest: dict[float, tuple[float, float]] = {0.0: (0.0, 0.0)}
        for t in same:
            # Rounded, for 0.2 − 0.1 is not 0.1.
            size = round(abs(t.after - t.before), 9)
            old = widest.get(size, (0.0, 0.0))
            widest[size] = max(old[0], t.left), max(old[1], t.right)
        sizes = sorted(widest)
        edges = zip(*(widest[size] for size in sizes), strict=True)
        left, right = (float(np.interp(abs(change), sizes, edge)) for edge in edges)
        return left, right, max(t.length for t in same)

    @property
    def settle(self) -> float | None:
        """Path over which a new offset takes hold like a first-order lag, m; None without transients.

        What a change Δκ of the curvature has turned by when it has settled is late by Δκ ℓ: `dheading`.
        """
        turned = np.array([self._curvature(t.after) - self._curvature(t.before) for t in self.transients])
        late = -np.array([t.dheading for t in self.transients])
        return float(turned @ late / (turned @ turned)) if turned.any() else None

    def lag(self, before: float, after: float) -> tuple[float, float]:
        """Return how late (m) the path turns after a change of offset, and how long (m) the arc between is.

        Of the measured jumps, linear in how large the change is, that of the nearest size beyond them;
        (0, 0) where none is known. `planner` has the law.
        """
        change = after - before
        known: dict[float, list[tuple[float, float]]] = {}
        for t in self.transients:
            turned = self._curvature(t.after) - self._curvature(t.before)
            if (t.after - t.before) * change > 0 and t.dheading * turned < 0:
                late, square = -t.dheading / turned, 2 * t.dy / turned
                # Shorter than it is late cannot be: then all of it is lateness.
                lag = late, max(square / late, late)
                known.setdefault(round(abs(t.after - t.before), 9), []).append(lag)
        if not known:
            return 0.0, 0.0
        sizes = sorted(known)
        means = zip(*(np.mean(known[size], axis=0) for size in sizes), strict=True)
        late, long = (float(np.interp(abs(change), sizes, mean)) for mean in means)
        return late, long

    def _curvature(self, offset: float) -> float:
        return float(np.interp(offset, self.offsets, self.curvatures))


def problems(footprint: Footprint) -> list[tuple[str, str]]:
    """Return (field, message) of all that a footprint cannot be."""
    found = []
    rows = len(footprint.offsets)
    for name in ("curvatures", "speeds", "left", "right"):
        if len(getattr(footprint, name)) != rows:
            found.append((name, f"{len(getattr(footprint, name))} values for {rows} offsets"))
    for name in ("offsets", "curvatures"):
        values = getattr(footprint, name)
        if any(b <= a for a, b in zip(values, values[1:], strict=False)):
            found.append((name, "must rise from row to row: a larger offset turns more to the left"))
    if found:
        return found
    low, high = footprint.curvatures[0], footprint.curvatures[-1]
    if not low < 0 < high:
        found.append(("curvatures", f"from {low:g} to {high:g} 1/m; a planner needs turns to both sides"))
    for side, name in enumerate(("left", "right")):
        turn = (1 if name == "left" else -1) * np.array(footprint.curvatures)
        # By as much wider as after any change to their offset.
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
            found.append((name, f"{edges[row]:g} m reaches {where}"))
    return found


def checked(footprint: Footprint) -> Footprint:
    """Return the footprint.

    Raises:
        InputError: it cannot be one, or a number is not finite.
    """
    columns = (getattr(footprint, name) for name in _KEYS)
    numbers = [*chain.from_iterable(columns), footprint.ahead, footprint.behind]
    if not np.isfinite(numbers).all():
        raise InputError(f"footprint {footprint.name}: a number is not finite")
    if min(footprint.speeds) <= 0 or footprint.narrowest <= 0 or min(footprint.ahead, footprint.behind) < 0:
        raise InputError(
            f"footprint {footprint.name}: speeds and edges must be above 0, ahead and behind not below"
        )
    for field, message in problems(footprint):
        raise InputError(f"footprint {footprint.name}: {field}: {message}")
    return footprint


Rows = Field(min_length=3, max_length=101)
Offsets = Record[Annotated[list[Annotated[float, between(-1.0, 1.0)]], Rows], Literal["1"]]
Curvatures = Record[Annotated[list[Annotated[float, between(-100.0, 100.0)]], Rows], Literal["1/m"]]
Speeds = Record[Annotated[list[Annotated[float, between(1e-3, 10.0)]], Rows], Literal["m/s"]]
Edges = Record[Annotated[list[Annotated[float, between(1e-3, 10.0)]], Rows], Literal["m"]]
Reach = Record[Annotated[float, between(0.0, 10.0)], Literal["m"]]

Offset = Annotated[float, between(-1.0, 1.0)]
Metres = Annotated[float, between(0.0, 10.0)]
Shift = Annotated[float, between(-10.0, 10.0)]
Spreads = Annotated[list[Annotated[float, between(0.0, 100.0)]], Rows]


class TransientFile(Strict):
    """How far the snake leaves the new arc after one change of offset."""

    from_offset: Offset = Field(description="Offset before, -1 to 1.")
    to_offset: Offset = Field(description="Offset after, -1 to 1.")
    left_m: Metres = Field(description="How much wider the left edge has to be, m, 0 to 10.")
    right_m: Metres = Field(description="How much wider the right edge has to be, m, 0 to 10.")
    length_m: Metres = Field(description="Path over which that holds, m, 0 to 10.")
    dx_m: Shift = Field(0.0, description="Jump of the path along itself, m, -10 to 10 (default 0).")
    dy_m: Shift = Field(0.0, description="Jump of the path to its left, m, -10 to 10 (default 0).")
    dheading_rad: Annotated[float, between(-3.15, 3.15)] = Field(
        0.0, description="Turn of the path to the left, rad, -3.15 to 3.15 (default 0)."
    )

    def transient(self) -> Transient:
        """Return it as the planner takes it."""
        return Transient(*self.model_dump().values())


class TransientsFile(Strict):
    """Changes of offset."""

    status: Status = Field(description="As of any number.")
    source: str = Field(min_length=1, max_length=1000, description="How they were measured.")
    changes: Annotated[list[TransientFile], Field(min_length=1, max_length=200)] = Field(
        description="One change of offset each."
    )


class SpreadFile(Strict):
    """By how much repeated measurements of the columns differ, one number an offset."""

    source: str = Field(min_length=1, max_length=1000, description="What was repeated, and what is given.")
    curvature_per_m: Spreads = Field(description="Of the curvature, 1/m, 0 to 100.")
    speed_m_s: Spreads = Field(description="Of the speed, m/s, 0 to 100.")
    left_m: Spreads = Field(description="Of the left edge, m, 0 to 100.")
    right_m: Spreads = Field(description="Of the right edge, m, 0 to 100.")


class FootprintFile(Strict):
    """A footprint file; the columns have one value an offset."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$", min_length=1, max_length=60, description="Short name.")
    title: str = Field(min_length=1, max_length=200, description="One line for people.")
    robot: str = Field(min_length=1, max_length=200, description="Robot whose footprint this is.")
    contact: ContactName | None = Field(
        None, description="Contact of the twin that it was measured on; none where it was not (default)."
    )
    offset: Offsets = Field(description="Phase offsets, rising, -1 to 1; positive turns left.")
    curvature_per_m: Curvatures = Field(description="1/radius of the path, 1/m, left positive, -100 to 100.")
    speed_m_s: Speeds = Field(description="Speed of the centre of mass, m/s, 0.001 to 10.")
    left_m: Edges = Field(description="Distance of the left edge from the path, m, 0.001 to 10.")
    right_m: Edges = Field(description="Distance of the right edge from the path, m, 0.001 to 10.")
    ahead_m: Reach = Field(description="From the centre of mass to the head along the path, m, 0 to 10.")
    behind_m: Reach = Field(description="From the centre of mass to the tail along the path, m, 0 to 10.")
    spread: SpreadFile | None = Field(None, description="Repeatability, where measured.")
    transients: TransientsFile | None = Field(None, description="Changes of offset, where measured.")
    excursions: Annotated[list[ExcursionsFile], Field(max_length=100)] | None = Field(
        None, description="How far followers left it, where measured, for margins with a probability."
    )

    @property
    def twin_contact(self) -> ContactName | None:
        """Contact of the twin that it was measured on; None: not measured on a twin."""
        measured = self.curvature_per_m.source.startswith(MEASURED_ON_TWIN)
        return self.contact or (UNSTATED_CONTACT if measured else None)

    def mismatch(self, contact: ContactName) -> str | None:
        """Return a warning about a twin whose contact is another one than that of the measurement."""
        own = self.twin_contact
        if own in (None, contact):
            return None
        return (
            f"{self.name} was measured on a twin with contact {own}, but the twin here has contact "
            f"{contact}; `srs-twin calibrate footprint {self.robot} --contact {contact}` measures one for it"
        )

    def footprint(self) -> Footprint:
        """Return the table without its sources."""
        columns = [tuple(getattr(self, key).value) for key in _KEYS.values()]
        values: list[Any] = [self.name, self.title, *columns, self.ahead_m.value, self.behind_m.value]
        changes = self.transients.changes if self.transients else []
        values.append(tuple(each.transient() for each in changes))
        return Footprint(*values)


# Columns of `Footprint`, in its order → what they are called in the file.
_KEYS = {
    "offsets": "offset",
    "curvatures": "curvature_per_m",
    "speeds": "speed_m_s",
    "left": "left_m",
    "right": "right_m",
}


def load_footprint_file(name_or_path: str | os.PathLike[str]) -> FootprintFile:
    """Load and check a footprint file: a shipped name (gen4_table8) or a path.

    Raises:
        InputError: not found or not readable.
        InputFileError: everything that is wrong with it.
    """
    document = load_yaml(find("footprint", name_or_path))
    file = validate(FootprintFile, document, document.data)
    if file:
        _report(file, document)
    document.finish()
    assert file is not None, "no problem was reported"
    return file


def load_footprint(name_or_path: str | os.PathLike[str]) -> Footprint:
    """Load a footprint: a shipped name (gen4_table8) or a path.

    Raises:
        InputError, InputFileError: as `load_footprint_file`.
    """
    return load_footprint_file(name_or_path).footprint()


def save_footprint(file: FootprintFile, path: str | os.PathLike[str], *, header: Sequence[str] = ()) -> None:
    """Write a footprint file whole or not at all.

    Args:
        file: what to write.
        path: where.
        header: lines of a comment at its top.

    Raises:
        InputFileError: the table cannot be a footprint.
        InputError: the place cannot be written.
    """
    document = Document(os.fspath(path))
    _report(file, document)
    document.finish()
    with atomic_write(path) as part:
        comment = "".join(f"# {line}\n" for line in header)
        text = dump_yaml(file.model_dump(mode="json", exclude_none=True), compact=True)
        part.write_text(comment + text, "utf-8")


def _report(file: FootprintFile, document: Document) -> None:
    for name in ("curvature_per_m", "speed_m_s", "left_m", "right_m") if file.spread else ():
        values = getattr(file.spread, name)
        if len(values) != len(file.offset.value):
            document.report(("spread", name), f"{len(values)} values for {len(file.offset.value)} offsets")
    for name, message in problems(file.footprint()):
        document.report((_KEYS[name], "value"), message)
