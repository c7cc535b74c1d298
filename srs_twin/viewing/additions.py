"""Plots and recording elements that extensions add."""

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
        strips: polylines, each of shape (n, 2), m.
        color: colour, #rrggbb.
        radius: half the line width, m.
    """

    name: str
    strips: tuple[np.ndarray, ...]
    color: str
    radius: float


class FollowedSignal(NamedTuple):
    """Recorded signal that is plotted separately.

    Attributes:
        factor: factor that converts the SI value to the plotted unit.
    """

    column: str
    entity: str
    factor: float
    title: str


class RunPictures:
    """Elements that an extension adds to the plots and recordings of one kind of run.

    The base class adds nothing.

    Attributes:
        legend: colour (#rrggbb) of each line on the floor, by label.
    """

    kind: ClassVar[str] = ""
    legend: ClassVar[Mapping[str, str]] = {}
    signals: ClassVar[tuple[FollowedSignal, ...]] = ()

    def applies(self, run: Trajectory) -> bool:
        """Return whether a run is of this kind."""
        return False

    def figures(
        self, runs: Mapping[str, Trajectory], spec: RobotSpec
    ) -> dict[str, Figure]:
        """Return additional figures for the report, keyed by their captions."""
        return {}

    def floor_lines(self, run: Trajectory, *, latest: bool = False) -> list[FloorLine]:
        """Return lines to draw on the floor at the start or end (`latest`) of a run."""
        return []


@cache
def additions() -> tuple[RunPictures, ...]:
    """Return the additions of all installed extensions."""
    return tuple(pictures for _, pictures in objects(PICTURES))


def added_to(run: Trajectory) -> RunPictures | None:
    """Return the additions to a run, or None if no extension adds anything."""
    return next((pictures for pictures in additions() if pictures.applies(run)), None)
