r"""What a change of offset does to the path, against the instant change that the dissertation assumes.

At the time t_s of the change the path is at the pose P, found from the steady arc before it. An instant
change would go on with the steady arc of the new offset, P ∘ A(v (t − t_s)). The path that is settled again
goes

.. math:: P ∘ D ∘ A(v (t − t_s))

with one displacement D for ever: as if the snake had jumped by D at the change and followed the new arc from
there. It is settled when each period from then on turns the body as the new offset does, but for 10 % of what
the two offsets differ, or for twice as much as periods still differ at the end of the run: learning never
rests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.centre_line import body_sides
from srs_twin.comparison.gait_window import GaitWindow
from srs_twin.comparison.sampling import interpolant
from srs_twin.errors import InputError
from srs_twin.identification.path_frame import Frames, averaged_path
from srs_twin.identification.steady import SteadyPath
from srs_twin.planning.footprint import Transient
from srs_twin.spec import Geometry
from srs_twin.trajectory import Trajectory

STEADY_PERIODS = 4
"""Over how many periods the path is looked at before a change and once it is settled."""
SETTLED = 0.1
"""Share of the change of the turn of a period that may be missing when a change is over."""
RESTLESS = 0.1
"""Larger shares at the end of a run are no unrest of learning any more: the path has not settled."""


@dataclass(frozen=True)
class Change:
    """One run in which the offset changed.

    Attributes:
        time: of the change, s.
        before: offset before it.
        after: offset after it.
    """

    time: float
    before: float
    after: float


def transient(
    trajectory: Trajectory, geometry: Geometry, period: float, change: Change,
    before: SteadyPath, after: SteadyPath,
) -> Transient:  # fmt: skip
    """Measure one change of offset.

    Body that is still on the arc before the change does not count: a planner sweeps that with the old arc.

    Args:
        trajectory: a run with some periods before the change and, once it is over, some after it.
        geometry: of its robot.
        period: of the gait, s.
        change: when and what.
        before: the steady path of the old offset.
        after: that of the new one.

    Raises:
        InputError: the run is too short.
    """
    old = GaitWindow.last(trajectory, period, change.time, STEADY_PERIODS)
    if old is None:
        raise InputError(f"a change of offset needs {STEADY_PERIODS} gait periods before it")
    settled = _settled(trajectory, period, change.time, before, after)
    end = min(settled + STEADY_PERIODS * period, float(trajectory.time[-1]))
    new = GaitWindow.last(trajectory, period, end, STEADY_PERIODS)
    assert new is not None, "it begins after the change"
    begin = _back(trajectory, old, change.time, before).mean()
    jumped = begin.inverse().then(_back(trajectory, new, change.time, after)).mean()

    seen = (trajectory.time >= change.time - 1e-9) & (trajectory.time <= settled + 1e-9)
    body, way = body_sides(trajectory, geometry)[seen], after.speed * (trajectory.time[seen] - change.time)
    _, left = begin.then(Frames.arc(after.curvature, way)).coordinates(body, after.curvature)
    counted = ~_still_before(begin, body, before)
    beyond = [np.where(counted, out, 0.0).max() for out in (left - after.left, -left - after.right)]
    return Transient(
        change.before, change.after, max(float(beyond[0]), 0.0), max(float(beyond[1]), 0.0),
        after.speed * (settled - change.time), dx=float(jumped.place.real), dy=float(jumped.place.imag),
        dheading=float(np.angle(np.exp(1j * jumped.heading))),
    )  # fmt: skip


def _settled(
    trajectory: Trajectory, period: float, time: float, before: SteadyPath, after: SteadyPath
) -> float:
    """Return from when on (s) each period turns as the new offset does.

    Raises:
        InputError: the run ends before it is seen.
    """
    heading = interpolant(trajectory, trajectory["heading"])
    begins = trajectory.time[trajectory.time >= time - 1e-9]
    begins = begins[begins <= trajectory.time[-1] - period + 1e-9]
    old, new = (path.curvature * path.speed * period for path in (before, after))
    missing = abs(heading(begins + period) - heading(begins) - new) / abs(new - old)
    unrest = missing[begins >= trajectory.time[-1] - STEADY_PERIODS * period - 1e-9].max(initial=0.0)
    off = np.flatnonzero(missing > max(SETTLED, 2 * unrest))
    first = int(off[-1]) + 1 if len(off) else 0
    if unrest > RESTLESS or first >= len(begins):
        raise InputError(
            f"the path is not settled {(trajectory.time[-1] - time) / period:.3g} gait periods after it"
        )
    return float(begins[first])


def widest(repeats: Sequence[Transient]) -> Transient:
    """Return one transient for the same change at several phases of the gait: widest, longest, mean jump."""
    first = repeats[0]
    left, right, length = (max(getattr(t, name) for t in repeats) for name in ("left", "right", "length"))
    dx, dy = (float(np.mean([getattr(t, name) for t in repeats])) for name in ("dx", "dy"))
    turned = float(np.angle(np.mean([np.exp(1j * t.dheading) for t in repeats])))
    return Transient(first.before, first.after, left, right, length, dx, dy, turned)


def _back(trajectory: Trajectory, window: GaitWindow, time: float, path: SteadyPath) -> Frames:
    """Return where a steady path was, or will be, at a time (s), from each pose in a window."""
    times, poses = averaged_path(trajectory, window)
    return poses.then(Frames.arc(path.curvature, path.speed * (time - times)))


def _still_before(begin: Frames, body: np.ndarray, path: SteadyPath) -> np.ndarray:
    """Say which points are in what the steady path sweeps up to the change, a body before it at most."""
    along, left = begin.coordinates(body, path.curvature)
    inside = (left <= path.left) & (left >= -path.right)
    near: np.ndarray = (along <= path.ahead) & (along >= -path.ahead - path.behind)
    return inside & near
