r"""Paths of a crawling snake, averaged over periods: speed, curvature, edges, transients.

A pose is a point of the path and the direction of the path there, as a planner has it. With arcs of curvature
κ and length L as motions

$$ A_κ(L) = \Bigl(L\,\mathrm{sinc}\tfrac{κL}{2},\; \text{at the angle}\; \tfrac{κL}{2};\;\; κL\Bigr), $$

poses are put after each other: P ∘ A is where the arc leads from P. Arrays of poses have one leading axis.

`SteadyPath` is how a snake crawls under one offset (Fig. 58, Table 8). `transient` measures what a change of
offset does to the path, against the instant change that the dissertation assumes: at the time t_s of the
change the path is at the pose P, found from the steady arc before it. An instant change would go on with the
steady arc of the new offset, P ∘ A(v (t − t_s)). The path that is settled again goes

$$ P ∘ D ∘ A(v (t − t_s)) $$

with one displacement D for ever: as if the snake had jumped by D at the change and followed the new arc from
there. It is settled when each period from then on turns the body as the new offset does, but for 10 % of what
the two offsets differ, or for twice as much as periods still differ at the end of the run: learning never
rests.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np

from srs_twin.comparison.centre_line import body_sides
from srs_twin.comparison.gait import (
    MIN_TRAVEL_BODY_LENGTHS,
    GaitWindow,
    displacement_per_period,
    path_curvature,
)
from srs_twin.comparison.sampling import body_length, interpolant
from srs_twin.errors import InputError
from srs_twin.planning.footprint import Transient
from srs_twin.robot.spec import Geometry
from srs_twin.trajectory import Trajectory

_STRAIGHT = 1e-9  # 1/m: an arc of less curvature is a line to rounding
_SMALL_TURN = 1e-4  # rad: below it a series is better than a quotient of two small numbers


@dataclass(frozen=True)
class Poses:
    """Poses, or motions from one pose to another.

    Attributes:
        place: x + i y, shape (n,) or (), m.
        heading: same shape, rad.
    """

    place: np.ndarray
    heading: np.ndarray

    @classmethod
    def arc(cls, curvature: float, length: np.ndarray | float) -> Poses:
        """Return the motions A_κ(L); negative lengths (m) lead back."""
        half = curvature * np.asarray(length, dtype=float) / 2
        return cls(length * np.sinc(half / np.pi) * np.exp(1j * half), 2 * half)

    def then(self, other: Poses) -> Poses:
        """Return self ∘ other: the other motion begun at this pose."""
        return Poses(self.place + np.exp(1j * self.heading) * other.place, self.heading + other.heading)

    def inverse(self) -> Poses:
        """Return the motion that undoes this one."""
        return Poses(-np.exp(-1j * self.heading) * self.place, -self.heading)

    def mean(self) -> Poses:
        """Return the mean of poses that lie close to each other."""
        return Poses(np.asarray(self.place.mean()), np.asarray(self.heading.mean()))

    def coordinates(self, points: np.ndarray, curvature: float) -> tuple[np.ndarray, np.ndarray]:
        """Return path coordinates of points about arcs through these poses, as `planning.swept` has them.

        Args:
            points: shape (n, points, 2), m; with a single pose any first axis.
            curvature: of the arcs, 1/m.

        Returns:
            Place along the arc from the pose, and distance to its left, each (n, points), m.
        """
        away = points[..., 0] + 1j * points[..., 1] - self.place[..., None]
        away = away * np.exp(-1j * self.heading)[..., None]
        u, w = away.real, away.imag
        across, down = curvature * u, 1 - curvature * w
        left = (2 * w - curvature * (u**2 + w**2)) / (1 + np.hypot(across, down))
        along = np.arctan2(across, down) / curvature if abs(curvature) > _STRAIGHT else u
        return along, left


def averaged_path(trajectory: Trajectory, window: GaitWindow) -> tuple[np.ndarray, Poses]:
    """Return times (s) and poses of the period-averaged path of the centre of mass in a window.

    Each pose is in the middle of a period, its direction that of the period's chord. The mean of an arc lies
    inside of it, by (1 − sinc(φ/2))/κ where a period turns by φ; that is put back. What the body sways in a
    period is in single poses still; means over whole periods of them are free of it.

    Args:
        trajectory: one run.
        window: K periods, in which the snake is taken to turn at one rate.

    Returns:
        (instants,) each, over K − 1 periods.
    """
    mean, velocity = window.running_mean(trajectory, trajectory.com)
    turn = float(window.running_mean(trajectory, trajectory["heading"])[1].mean()) * window.period
    chord = (velocity[:, 0] + 1j * velocity[:, 1]) * window.period
    half = turn / 2
    inside = half / 12 if abs(half) < _SMALL_TURN else (1 - np.sinc(half / np.pi)) / (2 * np.sin(half))
    place = mean[:, 0] + 1j * mean[:, 1] - 1j * inside * chord
    times = window.times(window.periods - 1) + window.period / 2
    return times, Poses(place, np.unwrap(np.angle(chord)))


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
        them it bulges; it is round at both ends.

        Args:
            trajectory: one run.
            geometry: of its robot.
            window: three periods or more.

        Raises:
            InputError: the snake gets nowhere, or backward.
        """
        chords, turns = displacement_per_period(trajectory, window)
        chord, turn = float(chords.mean()), float(turns.mean())
        if not chord >= MIN_TRAVEL_BODY_LENGTHS * body_length(trajectory):
            raise InputError(
                f"the snake goes {1000 * chord:.3g} mm ahead in a gait period, so that it has no footprint; "
                "another pressure or frequency may help"
            )
        speed = chord / window.period / float(np.sinc(turn / (2 * np.pi)))
        curvature = path_curvature(chord, turn)
        times, poses = averaged_path(trajectory, window)
        begin = poses.then(Poses.arc(curvature, speed * (window.start - times))).mean()
        seen = (trajectory.time >= window.start - 1e-9) & (trajectory.time <= window.end + 1e-9)
        on_the_arc = begin.then(Poses.arc(curvature, speed * (trajectory.time[seen] - window.start)))
        along, left = on_the_arc.coordinates(body_sides(trajectory, geometry)[seen], curvature)
        # Head and tail are round; the twin collides them so.
        ends, aside = on_the_arc.coordinates(trajectory.position[seen][:, [0, -1]], curvature)
        reach = geometry.width / 2 / (1 - curvature * aside)  # of their discs, as angles seen from the centre
        reach = np.arcsin(curvature * reach) / curvature if abs(curvature) > _STRAIGHT else reach
        ahead = max(along.max(), (ends + reach).max())
        behind = max(-along.min(), (reach - ends).max())
        return cls(speed, curvature, *map(float, (left.max(), -left.min(), ahead, behind)))


def mean_path(repeats: Sequence[SteadyPath]) -> tuple[SteadyPath, SteadyPath]:
    """Return one path for repeated measurements, and by how much they differ: half their range.

    Speed and curvature are means, edges and ends the farthest reached.
    """
    values = np.array([astuple(each) for each in repeats])
    names = [each.name for each in fields(SteadyPath)]
    mean = [name in ("speed", "curvature") for name in names]
    found = np.where(mean, values.mean(axis=0), values.max(axis=0))
    return SteadyPath(*found.tolist()), SteadyPath(*(np.ptp(values, axis=0) / 2).tolist())


BothPaths = tuple[SteadyPath, SteadyPath]
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
    trajectory: Trajectory, geometry: Geometry, period: float, change: Change, paths: BothPaths
) -> Transient:
    """Measure one change of offset.

    Body that is still on the arc before the change does not count: a planner sweeps that with the old arc.

    Args:
        trajectory: a run with some periods before the change and, once it is over, some after it.
        geometry: of its robot.
        period: of the gait, s.
        change: when and what.
        paths: the steady path of the old offset, and that of the new one.

    Raises:
        InputError: the run is too short.
    """
    old = GaitWindow.ending_at(trajectory, period, change.time, STEADY_PERIODS)
    if old is None:
        raise InputError(f"a change of offset needs {STEADY_PERIODS} gait periods before it")
    settled, (before, after) = _settled(trajectory, period, change.time, paths), paths
    end = min(settled + STEADY_PERIODS * period, float(trajectory.time[-1]))
    new = GaitWindow.ending_at(trajectory, period, end, STEADY_PERIODS)
    assert new is not None, "it begins after the change"
    begin = _back(trajectory, old, change.time, before).mean()
    jumped = begin.inverse().then(_back(trajectory, new, change.time, after)).mean()

    seen = (trajectory.time >= change.time - 1e-9) & (trajectory.time <= settled + 1e-9)
    body, way = body_sides(trajectory, geometry)[seen], after.speed * (trajectory.time[seen] - change.time)
    _, left = begin.then(Poses.arc(after.curvature, way)).coordinates(body, after.curvature)
    # Not what the old arc sweeps up to the change, a body before it at most.
    at, aside = begin.coordinates(body, before.curvature)
    swept = (aside <= before.left) & (aside >= -before.right)
    swept &= (at <= before.ahead) & (at >= -before.ahead - before.behind)
    beyond = [np.where(swept, 0.0, out).max() for out in (left - after.left, -left - after.right)]
    left_by, right_by = (max(float(each), 0.0) for each in beyond)
    length, place = after.speed * (settled - change.time), jumped.place
    turned = float(np.angle(np.exp(1j * jumped.heading)))
    return Transient(
        change.before, change.after, left_by, right_by, length, float(place.real), float(place.imag), turned
    )


def _settled(trajectory: Trajectory, period: float, time: float, paths: BothPaths) -> float:
    """Return from when on (s) each period turns as the new offset does.

    Raises:
        InputError: the run ends before it is seen.
    """
    heading = interpolant(trajectory, trajectory["heading"])
    begins = trajectory.time[trajectory.time >= time - 1e-9]
    begins = begins[begins <= trajectory.time[-1] - period + 1e-9]
    old, new = (path.curvature * path.speed * period for path in paths)
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


def _back(trajectory: Trajectory, window: GaitWindow, time: float, path: SteadyPath) -> Poses:
    """Return where a steady path was, or will be, at a time (s), from each pose in a window."""
    times, poses = averaged_path(trajectory, window)
    return poses.then(Poses.arc(path.curvature, path.speed * (time - times)))
