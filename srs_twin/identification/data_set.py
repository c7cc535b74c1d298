"""DataSet: what a fit was made from, or held against; no data are both."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from srs_twin.errors import InputError
from srs_twin.identification.estimate import Role
from srs_twin.trajectory import Trajectory


@dataclass(frozen=True)
class DataSet:
    """One set of data.

    Attributes:
        name: of its file, or what it is called.
        sha256: of the file, or of the numbers where there is none, hexadecimal.
        role: "fit", or "validation": looked at when the fit is done.
        samples: how many.
        start: where the part that was used begins, s; None: all of it was.
        end: where it ends, s.
    """

    name: str
    sha256: str
    role: Role
    samples: int
    start: float | None = None
    end: float | None = None

    def overlaps(self, other: DataSet) -> bool:
        """Say whether both hold the same samples."""
        if self.sha256 != other.sha256:
            return False
        if None in (self.start, self.end, other.start, other.end):
            return True
        assert self.start is not None and self.end is not None
        assert other.start is not None and other.end is not None
        return self.start < other.end and other.start < self.end


class Data(Protocol):
    """What was measured, in any form."""

    def data_set(self, role: Role) -> DataSet:
        """Return what a fit says of these data."""


def data_sets(fitted: Iterable[Data], validation: Iterable[Data]) -> list[DataSet]:
    """Return all data of a fit with their roles."""
    return [
        *(each.data_set("fit") for each in fitted), *(each.data_set("validation") for each in validation)
    ]  # fmt: skip


def keep_apart(sets: Iterable[DataSet]) -> None:
    """Refuse data that a fit would be validated with although it has seen them.

    Raises:
        InputError: a set of each role have samples in common.
    """
    everything = list(sets)
    for seen in (each for each in everything if each.role == "fit"):
        for kept in (each for each in everything if each.role == "validation"):
            if seen.overlaps(kept):
                raise InputError(
                    f"{kept.name}: the same data as {seen.name}, which the fit is made from; what validates "
                    "a fit must be new to it"
                )


def fingerprint(*arrays: np.ndarray) -> str:
    """Return the SHA-256 of numbers and their shapes, hexadecimal."""
    total = hashlib.sha256()
    for array in arrays:
        values = np.ascontiguousarray(array, dtype=float)
        total.update(repr(values.shape).encode() + values.tobytes())
    return total.hexdigest()


def trajectory_hash(trajectory: Trajectory) -> str:
    """Return the SHA-256 of the recorded file, or of the columns where there is none."""
    source = trajectory.metadata.get("source")
    if isinstance(source, dict) and isinstance(source.get("sha256"), str):
        return str(source["sha256"])
    return fingerprint(*(trajectory[name] for name in sorted(trajectory.columns)))
