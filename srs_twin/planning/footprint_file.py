"""Footprint files: a table as Table 8, every column with unit, status and source.

The published ones are in calibration/footprints; `srs-twin calibrate footprint` writes others.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field

from srs_twin.documents import Document, dump_yaml, load_yaml
from srs_twin.files import atomic_write, find
from srs_twin.planning.footprint import Footprint, Transient, problems
from srs_twin.sourced import Record, Status, between
from srs_twin.validation import Strict, validate

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
        return Transient(
            self.from_offset, self.to_offset, self.left_m, self.right_m, self.length_m,
            self.dx_m, self.dy_m, self.dheading_rad,
        )  # fmt: skip


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
    offset: Offsets = Field(description="Phase offsets, rising, -1 to 1; positive turns left.")
    curvature_per_m: Curvatures = Field(description="1/radius of the path, 1/m, left positive, -100 to 100.")
    speed_m_s: Speeds = Field(description="Speed of the centre of mass, m/s, 0.001 to 10.")
    left_m: Edges = Field(description="Distance of the left edge from the path, m, 0.001 to 10.")
    right_m: Edges = Field(description="Distance of the right edge from the path, m, 0.001 to 10.")
    ahead_m: Reach = Field(description="From the centre of mass to the head along the path, m, 0 to 10.")
    behind_m: Reach = Field(description="From the centre of mass to the tail along the path, m, 0 to 10.")
    spread: SpreadFile | None = Field(None, description="Repeatability, where measured.")
    transients: TransientsFile | None = Field(None, description="Changes of offset, where measured.")

    def footprint(self) -> Footprint:
        """Return the table without its sources."""
        changes = self.transients.changes if self.transients else []
        return Footprint(
            self.name, self.title, tuple(self.offset.value), tuple(self.curvature_per_m.value),
            tuple(self.speed_m_s.value), tuple(self.left_m.value), tuple(self.right_m.value),
            self.ahead_m.value, self.behind_m.value,
            tuple(change.transient() for change in changes),
        )  # fmt: skip


# What a problem of the table is called in the file.
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
