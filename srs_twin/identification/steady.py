"""SteadyPath: speed, curvature, edges and ends of a snake that crawls under one offset (Fig. 58, Table 8)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np

from srs_twin.comparison.centre_line import body_sides
from srs_twin.comparison.gait_window import GaitWindow
from srs_twin.comparison.period_path import LEAST_WAY, carried
from srs_twin.comparison.sampling import body_length
from srs_twin.comparison.turning import path_curvature
from srs_twin.errors import InputError
from srs_twin.identification.path_frame import Frames, averaged_path
from srs_twin.spec import Geometry
from srs_twin.trajectory import Trajectory


@dataclass(frozen=True)
class SteadyPath:
    """How a snake goes its arc.

    Attributes:
        speed: of the centre of mass along the arc, m/s.
        curvature: 1/m, positive to the left.
        left: how far the body reaches to the left of the arc, m.
        right: … to the right, m.
        ahead: … before the centre of mass along the arc, m.
        behind: … after it, m.
    """

    speed: float
    curvature: float
    left: float
    right: float
    ahead: float
    behind: float

    @classmethod
    def of(cls, trajectory: Trajectory, geometry: Geometry, window: GaitWindow) -> SteadyPath:
        """Measure whole periods of a run.

        The body is the band of its width about its centre line, not its connectors alone: between two of
        them it bulges.

        Args:
            trajectory: one run.
            geometry: of its robot.
            window: three periods or more.

        Raises:
            InputError: the snake gets nowhere, or backward.
        """
        chords, turns = carried(trajectory, window)
        chord, turn = float(chords.mean()), float(turns.mean())
        if not chord >= LEAST_WAY * body_length(trajectory):
            raise InputError(
                f"the snake goes {1000 * chord:.3g} mm ahead in a gait period, so that it has no footprint; "
                "another pressure or frequency may help"
            )
        speed = chord / window.period / float(np.sinc(turn / (2 * np.pi)))
        curvature = path_curvature(chord, turn)
        times, poses = averaged_path(trajectory, window)
        begin = poses.then(Frames.arc(curvature, speed * (window.start - times))).mean()
        seen = (trajectory.time >= window.start - 1e-9) & (trajectory.time <= window.end + 1e-9)
        on_the_arc = begin.then(Frames.arc(curvature, speed * (trajectory.time[seen] - window.start)))
        along, left = on_the_arc.coordinates(body_sides(trajectory, geometry)[seen], curvature)
        reach = [float(each) for each in (left.max(), -left.min(), along.max(), -along.min())]
        return cls(speed, curvature, *reach)


def together(repeats: Sequence[SteadyPath]) -> tuple[SteadyPath, SteadyPath]:
    """Return one path for repeated measurements, and by how much they differ: half their range.

    Speed and curvature are means, edges and ends the farthest reached.
    """
    values = np.array([astuple(each) for each in repeats])
    names = [each.name for each in fields(SteadyPath)]
    mean = [name in ("speed", "curvature") for name in names]
    found = np.where(mean, values.mean(axis=0), values.max(axis=0))
    return SteadyPath(*found.tolist()), SteadyPath(*(np.ptp(values, axis=0) / 2).tolist())
