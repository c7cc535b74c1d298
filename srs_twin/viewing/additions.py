"""What extensions add to the pictures of runs."""

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
    """A line on the floor.

    Attributes:
        name: of the entity in a recording.
        strips: polylines of shape (n, 2), m.
        color: #rrggbb.
        radius: half the width, m.
    """

    name: str
    strips: tuple[np.ndarray, ...]
    color: str
    radius: float


class FollowedSignal(NamedTuple):
    """A recorded signal with a plot of its own.

    Attributes:
        column: of the trajectory.
        entity: in a recording.
        factor: shown value over SI value.
        title: of the plot.
    """

    column: str
    entity: str
    factor: float
    title: str


class RunPictures:
    """Additions to the pictures of runs of one kind. Each hook adds nothing by default.

    Attributes:
        kind: of the experiment.
        legend: line on the floor → colour, #rrggbb.
        signals: plotted in recordings.
    """

    kind: ClassVar[str] = ""
    legend: ClassVar[Mapping[str, str]] = {}
    signals: ClassVar[tuple[FollowedSignal, ...]] = ()

    def applies(self, run: Trajectory) -> bool:
        """Return whether a run is of this kind."""
        return False

    def figures(self, runs: Mapping[str, Trajectory], spec: RobotSpec) -> dict[str, Figure]:
        """Return caption → figure for the report; runs: plant → trajectory."""
        return {}

    def floor_lines(self, run: Trajectory) -> list[FloorLine]:
        """Return lines that lie on the floor of a run."""
        return []


@cache
def additions() -> tuple[RunPictures, ...]:
    """Return the additions of the installed extensions."""
    return tuple(pictures for _, pictures in objects(PICTURES))


def added_to(run: Trajectory) -> RunPictures | None:
    """Return the additions to the pictures of a run."""
    return next((pictures for pictures in additions() if pictures.applies(run)), None)
