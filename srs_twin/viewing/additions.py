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
        name: entity name.
        strips: polylines (n, 2), m.
        color: colour, #rrggbb.
        radius: half width, m.
    """

    name: str
    strips: tuple[np.ndarray, ...]
    color: str
    radius: float


class FollowedSignal(NamedTuple):
    """Recorded signal that gets its own plot.

    Attributes:
        column: trajectory column.
        entity: entity name.
        factor: factor that converts the SI value to the plotted unit.
        title: plot title.
    """

    column: str
    entity: str
    factor: float
    title: str


class RunPictures:
    """Elements that an extension adds to the plots and recordings of one kind of run.

    The base class adds nothing.

    Attributes:
        kind: kind of experiment.
        legend: colour (#rrggbb) of each line on the floor, keyed by its label.
        signals: additional plotted signals.
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
        """Return additional figures for the report, keyed by caption.

        Args:
            runs: trajectories, keyed by plant.
            spec: robot.
        """
        return {}

    def floor_lines(self, run: Trajectory, *, latest: bool = False) -> list[FloorLine]:
        """Return lines to draw on the floor.

        Args:
            run: trajectory.
            latest: whether to return the lines at the end of the run instead of the
                start.
        """
        return []


@cache
def additions() -> tuple[RunPictures, ...]:
    """Return all installed additions."""
    return tuple(pictures for _, pictures in objects(PICTURES))


def added_to(run: Trajectory) -> RunPictures | None:
    """Return the additions to a run, or None if no extension adds anything."""
    return next((pictures for pictures in additions() if pictures.applies(run)), None)
