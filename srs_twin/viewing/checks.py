"""What must hold before anything is drawn."""

from __future__ import annotations

from collections.abc import Mapping

from srs_twin.errors import InputError
from srs_twin.trajectory import Trajectory


def check_drawable(trajectories: Mapping[str, Trajectory]) -> None:
    """Refuse what no picture can be made of.

    Raises:
        InputError: there is no trajectory, or one of them is empty.
    """
    if not trajectories:
        raise InputError("nothing to show: no plant left a trajectory; run the scenario first")
    for plant, run in trajectories.items():
        if not len(run):
            raise InputError(f"nothing to show: the trajectory of '{plant}' has no samples")
