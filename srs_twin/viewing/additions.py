"""Additions of extensions to the plots and recordings of runs."""

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
    """Line on the floor.

    Attributes:
        name: name of its entity in a recording.
        strips: polylines, each of shape (n, 2), m.
        color: colour, #rrggbb.
        radius: half of the line width, m.
    """

    name: str
    strips: tuple[np.ndarray, ...]
    color: str
    radius: float


class FollowedSignal(NamedTuple):
    """Recorded signal that gets its own plot.

    Attributes:
        column: column of the trajectory.
        entity: name of its entity in a recording.
        factor: plotted value per SI value.
        title: title of the plot.
    """

    column: str
    entity: str
    factor: float
    title: str


class RunPictures:
    """Additions to the plots and recordings of one kind of run.

    By default, all methods add nothing.

    Attributes:
        kind: kind of experiment.
        legend: name of a line on the floor → colour, #rrggbb.
        signals: signals that recordings plot.
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
        """Return caption → figure for the report, given plant → trajectory."""
        return {}

    def floor_lines(self, run: Trajectory, *, latest: bool = False) -> list[FloorLine]:
        """Return the lines on the floor at the start of a run, or the latest ones."""
        return []


@cache
def additions() -> tuple[RunPictures, ...]:
    """Return the additions of the installed extensions."""
    return tuple(pictures for _, pictures in objects(PICTURES))


def added_to(run: Trajectory) -> RunPictures | None:
    """Return the additions to a run; None if no extension adds anything."""
    return next((pictures for pictures in additions() if pictures.applies(run)), None)
