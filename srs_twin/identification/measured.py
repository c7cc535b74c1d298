"""Measured: a footprint as it was measured, with what the repeats differ."""

from __future__ import annotations

from dataclasses import dataclass

from srs_twin.identification.drive import Drive
from srs_twin.identification.steady import SteadyPath
from srs_twin.planning.footprint import Footprint, Transient


@dataclass(frozen=True)
class Measured:
    """A measured footprint.

    Attributes:
        drive: robot, controller, plant.
        offsets: rising.
        steady: the path at each.
        spread: half the range of the repeats, of each number of `steady`.
        transients: the changes of offset that were measured.
        repeats: runs an offset, and a change.
        periods: of each that were measured.
    """

    drive: Drive
    offsets: tuple[float, ...]
    steady: tuple[SteadyPath, ...]
    spread: tuple[SteadyPath, ...]
    transients: tuple[Transient, ...]
    repeats: int
    periods: int

    def footprint(self, name: str = "measured", title: str = "measured") -> Footprint:
        """Return it as the planner takes it; `planning.footprint.problems` says if it can be one."""
        speeds, curvatures, left, right, ahead, behind = (
            tuple(getattr(path, key) for path in self.steady)
            for key in ("speed", "curvature", "left", "right", "ahead", "behind")
        )
        return Footprint(
            name,
            title,
            self.offsets,
            curvatures,
            speeds,
            left,
            right,
            max(ahead),
            max(behind),
            self.transients,
        )
