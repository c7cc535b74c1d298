"""Elements that extensions add to plots and recordings."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from srs_twin.extensions import PICTURES, objects
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class FloorLine(NamedTuple):
    """Line drawn on the floor.

    Attributes:
        strips: polylines that form the line, each of shape (n, 2), m.
        color: colour, #rrggbb.
        radius: half the line width, m.
    """

    name: str
    strips: tuple[np.ndarray, ...]
    color: str
    radius: float


class FollowedSignal(NamedTuple):
    """Recorded signal that has a separate plot.

    Attributes:
        factor: conversion factor from the SI unit to the plotted unit.
    """

    column: str
    entity: str
    factor: float
    title: str


class RunPictures:
    """Elements that an extension adds to the plots and recordings of one kind of run.

    Attributes:
        legend: colours (#rrggbb) of the floor lines, keyed by label.
    """

    kind: ClassVar[str] = ""
    legend: ClassVar[Mapping[str, str]] = {}
    signals: ClassVar[tuple[FollowedSignal, ...]] = ()

    def applies(self, run: Trajectory) -> bool:
        """Return whether this class adds elements to a run."""
        return False

    def figures(
        self, runs: Mapping[str, Trajectory], spec: RobotSpec
    ) -> dict[str, Figure]:
        """Return additional figures for the report of a run, keyed by caption."""
        return {}

    def floor_lines(self, run: Trajectory, *, latest: bool = False) -> list[FloorLine]:
        """Return the first floor lines of a run, or the last if `latest` is true."""
        return []


@cache
def additions() -> tuple[RunPictures, ...]:
    """Return the `RunPictures` objects of all installed extensions."""
    return tuple(pictures for _, pictures in objects(PICTURES))


def added_to(run: Trajectory) -> RunPictures | None:
    """Return the first `RunPictures` object that applies to a run, or None."""
    return next((pictures for pictures in additions() if pictures.applies(run)), None)
