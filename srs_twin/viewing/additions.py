"""Plots and recording elements added by extensions."""

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
        """Return whether a run belongs to the kind that this class handles."""
        return False

    def figures(
        self, runs: Mapping[str, Trajectory], spec: RobotSpec
    ) -> dict[str, Figure]:
        """Return additional figures for the report, keyed by caption."""
        return {}

    def floor_lines(self, run: Trajectory, *, latest: bool = False) -> list[FloorLine]:
        """Return floor lines at the start of a run, or at the end if `latest` is true."""
        return []


@cache
def additions() -> tuple[RunPictures, ...]:
    """Return the additions of all installed extensions."""
    return tuple(pictures for _, pictures in objects(PICTURES))


def added_to(run: Trajectory) -> RunPictures | None:
    """Return the first additions that apply to a run, or None."""
    return next((pictures for pictures in additions() if pictures.applies(run)), None)
