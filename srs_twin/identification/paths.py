r"""Period-averaged path of a crawling snake: speed, curvature, edges and transients.

A pose consists of a point on the path and the direction of the path at this point. The
motion along an arc of curvature κ and length L is

$$ A_κ(L) = \Bigl(L\,\mathrm{sinc}\tfrac{κL}{2},\; \text{at the angle}\; \tfrac{κL}{2};\;\; κL\Bigr), $$

where P ∘ A is the pose at the end of an arc that starts at the pose P.

`SteadyPath` describes crawling at a constant offset (Fig. 58, Table 8).
`measure_transient` measures the effect of a change of offset at time t_s. The pose P at
t_s is extrapolated from the steady arc before the change. If the curvature changed
instantly, as assumed in the dissertation, the snake would then follow the steady arc
P ∘ A(v (t − t_s)) of the new offset with the speed v. In fact, the path after the
transient is

$$ P ∘ D ∘ A(v (t − t_s)), $$

where D is a constant displacement due to the transient. The path has settled when the
turning angle per gait period differs from its value at the new offset by at most 10 %
of the total change. If iterative learning still varies the turning angle at the end of
the run, the tolerance is at least twice this variation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields, replace

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

_STRAIGHT_PER_M = 1e-9
"""Curvature below which an arc is treated as a straight line, 1/m."""

_SMALL_TURN_RAD = 1e-4
"""Turning angle below which a series expansion replaces a quotient, rad."""


@dataclass(frozen=True)
class Poses:
    """Array of poses, or of motions from one pose to another.

    Attributes:
        place: positions as complex numbers x + i y, m, shape (n,) or ().
        heading: headings, rad, with the shape of `place`.
    """

    place: np.ndarray
    heading: np.ndarray

    @classmethod
    def arc(cls, curvature: float, length: np.ndarray | float) -> Poses:
        """Return the motions A_κ(L) along arcs.

        A negative length (m) is a backward motion.
        """
        half = curvature * np.asarray(length, dtype=float) / 2
        return cls(length * np.sinc(half / np.pi) * np.exp(1j * half), 2 * half)

    def compose(self, other: Poses) -> Poses:
        """Return the pose that is reached from this pose by the motion `other`."""
        return Poses(
            self.place + np.exp(1j * self.heading) * other.place,
            self.heading + other.heading,
        )

    def inverse(self) -> Poses:
        """Return the inverse motion."""
        return Poses(-np.exp(-1j * self.heading) * self.place, -self.heading)

    def mean(self) -> Poses:
        """Return the mean of poses that are close to each other."""
        return Poses(np.asarray(self.place.mean()), np.asarray(self.heading.mean()))

    def coordinates(
        self, points: np.ndarray, curvature: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the coordinates of points relative to arcs that start at these poses.

        Args:
            points: points in the plane, m, shape (n, points, 2). If there is a single
                pose, n is arbitrary.
            curvature: curvature of the arcs, 1/m.

        Returns:
            Position along the arc and distance to the left of the arc, m, each of shape
            (n, points).
        """
        relative = points[..., 0] + 1j * points[..., 1] - self.place[..., None]
        relative = relative * np.exp(-1j * self.heading)[..., None]
        u = relative.real
        w = relative.imag
        across = curvature * u
        down = 1 - curvature * w
        left = (2 * w - curvature * (u**2 + w**2)) / (1 + np.hypot(across, down))
        if abs(curvature) > _STRAIGHT_PER_M:
            along = np.arctan2(across, down) / curvature
        else:
            along = u
        return along, left


def period_averaged_path(
    trajectory: Trajectory, window: GaitWindow
) -> tuple[np.ndarray, Poses]:
    """Return the period-averaged path of the centre of mass in a window.

    The result contains the times (s) and the poses over K − 1 of the K periods of the
    window. Each pose belongs to the middle of a gait period and points along the chord
    of the path over this period. If the path turns by φ per period, the mean position
    over a period lies inside the arc by (1 − sinc(φ/2))/κ. The returned path is
    corrected for this distance.
    """
    mean, velocity = window.running_mean(trajectory, trajectory.com)
    _, turn_rate = window.running_mean(trajectory, trajectory["heading"])
    chord = (velocity[:, 0] + 1j * velocity[:, 1]) * window.period
    half = float(turn_rate.mean()) * window.period / 2
    inside = half / 12
    if abs(half) >= _SMALL_TURN_RAD:
        inside = (1 - np.sinc(half / np.pi)) / (2 * np.sin(half))
    place = mean[:, 0] + 1j * mean[:, 1] - 1j * inside * chord
    times = window.times(window.periods - 1) + window.period / 2
    return times, Poses(place, np.unwrap(np.angle(chord)))


@dataclass(frozen=True)
class SteadyPath:
    """Steady crawling along an arc.

    Attributes:
        speed: speed of the centre of mass along the arc, m/s.
        curvature: curvature of the arc, 1/m, positive for a left turn.
        left: maximum extent of the body to the left of the arc, m.
        right: maximum extent of the body to the right of the arc, m.
        ahead: maximum extent of the body in front of the centre of mass, along the arc,
            m.
        behind: maximum extent of the body behind the centre of mass, along the arc, m.
    """

    speed: float
    curvature: float
    left: float
    right: float
    ahead: float
    behind: float

    @classmethod
    def measure(
        cls, trajectory: Trajectory, geometry: Geometry, window: GaitWindow
    ) -> SteadyPath:
        """Measure the steady path over at least three whole gait periods of a run.

        The body is modelled as a band with round ends and the width of the robot. The
        centre line of the band includes the arcs between connectors.
        """
        chords, turns = displacement_per_period(trajectory, window)
        chord = float(chords.mean())
        turn = float(turns.mean())
        if not chord >= MIN_TRAVEL_BODY_LENGTHS * body_length(trajectory):
            raise InputError(
                f"the snake moves forward by only {1000 * chord:.3g} mm per gait"
                " period, which is too little for a footprint; try another pressure"
                " or frequency"
            )
        speed = chord / window.period / float(np.sinc(turn / (2 * np.pi)))
        curvature = path_curvature(chord, turn)
        times, poses = period_averaged_path(trajectory, window)
        begin = poses.compose(
            Poses.arc(curvature, speed * (window.start - times))
        ).mean()
        run = trajectory.between(window.start, window.end)
        on_arc = begin.compose(Poses.arc(curvature, speed * (run.time - window.start)))
        along, left = on_arc.coordinates(body_sides(run, geometry), curvature)
        # Head and tail are modelled as discs, as in the collision geometry of the twin.
        ends, offset = on_arc.coordinates(run.position[:, [0, -1]], curvature)
        # The radius of a disc is projected onto the arc.
        extent = geometry.width / 2 / (1 - curvature * offset)
        if abs(curvature) > _STRAIGHT_PER_M:
            extent = np.arcsin(curvature * extent) / curvature
        ahead = max(along.max(), (ends + extent).max())
        behind = max(-along.min(), (extent - ends).max())
        return cls(
            speed, curvature, *map(float, (left.max(), -left.min(), ahead, behind))
        )


def average_repeats(repeats: Sequence[SteadyPath]) -> tuple[SteadyPath, SteadyPath]:
    """Combine repeated measurements and compute half the range of each value.

    Speed and curvature are averaged. The extents of the body are the maxima over all
    measurements.
    """
    values = np.array([astuple(repeat) for repeat in repeats])
    is_mean = [field.name in ("speed", "curvature") for field in fields(SteadyPath)]
    combined = np.where(is_mean, values.mean(axis=0), values.max(axis=0))
    spread = np.ptp(values, axis=0) / 2
    return SteadyPath(*combined.tolist()), SteadyPath(*spread.tolist())


BothPaths = tuple[SteadyPath, SteadyPath]
STEADY_PERIODS = 4
"""Number of gait periods averaged before a change and after the transient."""

SETTLED = 0.1
"""Maximum relative error of the turning angle per period on a settled path."""

MAX_UNREST = 0.1
"""Maximum relative error of the turning angle at the end of a run."""


@dataclass(frozen=True)
class OffsetChange:
    """Change of offset at a given time (s) of a run."""

    time: float
    before: float
    after: float


def measure_transient(
    trajectory: Trajectory,
    geometry: Geometry,
    period: float,
    change: OffsetChange,
    paths: BothPaths,
) -> Transient:
    """Measure the transient after one change of offset.

    The part of the body that is still on the old arc is excluded, because a planner
    assigns this part to the area swept along the old arc. The argument `paths` contains
    the steady paths of the old and the new offset.
    """
    old = GaitWindow.ending_at(trajectory, period, change.time, STEADY_PERIODS)
    if old is None:
        raise InputError(
            "the offset changes too early; at least"
            f" {STEADY_PERIODS} gait periods must precede the change"
        )
    before, after = paths
    settled = _settling_time(trajectory, period, change.time, paths)
    end = min(settled + STEADY_PERIODS * period, float(trajectory.time[-1]))
    new = GaitWindow.ending_at(trajectory, period, end, STEADY_PERIODS)
    assert new is not None, "it begins after the change"
    begin = _extrapolate(trajectory, old, change.time, before).mean()
    end_of_jump = _extrapolate(trajectory, new, change.time, after)
    jump = begin.inverse().compose(end_of_jump).mean()
    left, right = _excess(trajectory, geometry, change.time, settled, begin, paths)
    return Transient(
        change.before,
        change.after,
        left,
        right,
        length=after.speed * (settled - change.time),
        dx=float(jump.place.real),
        dy=float(jump.place.imag),
        dheading=float(np.angle(np.exp(1j * jump.heading))),
    )


def _excess(
    trajectory: Trajectory,
    geometry: Geometry,
    time: float,
    settled: float,
    begin: Poses,
    paths: BothPaths,
) -> tuple[float, float]:
    """Return how far the body exceeds the left and right edges of the new path, m.

    Within one body length of the change, the area swept along the old arc is excluded.
    """
    before, after = paths
    run = trajectory.between(time, settled)
    body = body_sides(run, geometry)
    distance = after.speed * (run.time - time)
    _, left = begin.compose(Poses.arc(after.curvature, distance)).coordinates(
        body, after.curvature
    )
    along, offset = begin.coordinates(body, before.curvature)
    swept = (offset <= before.left) & (offset >= -before.right)
    swept &= (along <= before.ahead) & (along >= -before.ahead - before.behind)
    outside = ~swept
    return (
        float(np.max(left - after.left, initial=0.0, where=outside)),
        float(np.max(-left - after.right, initial=0.0, where=outside)),
    )


def _settling_time(
    trajectory: Trajectory, period: float, time: float, paths: BothPaths
) -> float:
    heading = interpolant(trajectory, trajectory["heading"])
    begins = trajectory.time[trajectory.time >= time - 1e-9]
    begins = begins[begins <= trajectory.time[-1] - period + 1e-9]
    old, new = (path.curvature * path.speed * period for path in paths)
    error = abs(heading(begins + period) - heading(begins) - new) / abs(new - old)
    unrest = error[begins >= trajectory.time[-1] - STEADY_PERIODS * period - 1e-9].max(
        initial=0.0
    )
    unsettled = np.flatnonzero(error > max(SETTLED, 2 * unrest))
    first = int(unsettled[-1]) + 1 if len(unsettled) else 0
    if unrest > MAX_UNREST or first >= len(begins):
        raise InputError(
            "the path does not become steady within"
            f" {(trajectory.time[-1] - time) / period:.3g} gait periods after the"
            " change of offset; simulate a longer run, or use smaller changes of the"
            " offset"
        )
    return float(begins[first])


def combine_transients(repeats: Sequence[Transient]) -> Transient:
    """Combine the transients of one offset change, measured at several gait phases.

    The displacements are averaged. The widths and the length are the maxima over all
    measurements.
    """
    turn = np.angle(np.mean([np.exp(1j * t.dheading) for t in repeats]))
    return replace(
        repeats[0],
        left=max(t.left for t in repeats),
        right=max(t.right for t in repeats),
        length=max(t.length for t in repeats),
        dx=float(np.mean([t.dx for t in repeats])),
        dy=float(np.mean([t.dy for t in repeats])),
        dheading=float(turn),
    )


def _extrapolate(
    trajectory: Trajectory, window: GaitWindow, time: float, path: SteadyPath
) -> Poses:
    times, poses = period_averaged_path(trajectory, window)
    return poses.compose(Poses.arc(path.curvature, path.speed * (time - times)))
