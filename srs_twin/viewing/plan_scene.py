"""The first plan of a run on the floor of a recording: path, edges of the footprint, goal."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import rerun as rr

from srs_twin.comparison.following import following, footprint_of, segments_of
from srs_twin.trajectory import Trajectory

_PATH, _EDGE, _GOAL = (60, 60, 60), (120, 165, 205), (176, 48, 48)
_LOW = 0.001
_CORNERS = 48


def send_plan(log: rr.RecordingStream, trajectories: Mapping[str, Trajectory]) -> None:
    """Log what the first snake that followed a plan was to do; nothing where none did."""
    about = next((told for run in trajectories.values() if (told := following(run)) is not None), None)
    if about is None:
        return
    segments, footprint = segments_of(about["plans"][0]), footprint_of(about)
    path, edges = [], []
    for segment in segments:
        poses = [segment.pose(s) for s in np.linspace(0, segment.length, max(2, int(segment.length / 0.01)))]
        motion = footprint.at(segment.curvature)
        path.append([(p.x, p.y, _LOW) for p in poses])
        edges += [
            [(p.x - n * np.sin(p.heading), p.y + n * np.cos(p.heading), _LOW) for p in poses]
            for n in (motion.left, -motion.right)
        ]
    if segments:
        log.log("world/plan/path", rr.LineStrips3D(path, colors=[_PATH], radii=[0.002]), static=True)
        log.log("world/plan/edges", rr.LineStrips3D(edges, colors=[_EDGE], radii=[0.0015]), static=True)
    goal = about["goal"]
    ring = _ring(goal["x"], goal["y"], goal["radius"], _LOW)
    log.log("world/plan/goal", rr.LineStrips3D([ring], colors=[_GOAL], radii=[0.002]), static=True)


def _ring(x: float, y: float, radius: float, height: float) -> list[tuple[float, float, float]]:
    angle = np.linspace(0, 2 * np.pi, _CORNERS + 1)
    return [(x + radius * np.cos(a), y + radius * np.sin(a), height) for a in angle]
