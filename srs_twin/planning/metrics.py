"""Metrics of following a plan: how near the path, how much of the body in its footprint, how it ended."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.comparison.centre_line import hull_lines, on_both_sides
from srs_twin.comparison.contacts import TOUCH_N, obstacle_force, touches
from srs_twin.comparison.group import MetricGroup
from srs_twin.comparison.sampling import positive_number, rms, units_of
from srs_twin.plants.twin.mjcf.numerics import WALL_M
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from srs_twin.planning.footprint import Footprint
    from srs_twin.planning.problem import Segment

PLAN_UNITS = units_of("plan_found plan_length_m plan_nodes plan_kink_rad")
"""Metrics of a plan alone."""

PLANNING_UNITS = PLAN_UNITS | units_of("plan_s")
"""Metrics of planning where nothing moves: those of the plan, and the wall time that it took."""

FOLLOWING_UNITS = PLAN_UNITS | units_of("""
    goal_reached arrival_error_m arrival_heading_error_rad
    cross_track_rms_m cross_track_max_m inside_share inside_50mm_share
    contacts contact_time_s clearance_m following_time_s replans
""")

TEXT_HALF_WIDTH, TEXT_SHIFT, TEXT_TIGHTEST = 0.025, 0.01, math.pi / 3 / 0.2
"""The box of Section 5.2: 50 mm, shifted by 10 mm at 60 degrees in 0.2 m; m and 1/m."""


OVERLAP = 1e-3
"""Deeper in an obstacle than contacts ever are, m."""


def following(trajectory: Trajectory) -> Mapping[str, Any] | None:
    """Return what the metadata say of the plan that a run followed; None where it followed none."""
    control = trajectory.metadata.get("control")
    found = control.get("following") if isinstance(control, Mapping) else None
    return found if isinstance(found, Mapping) else None


@dataclass(frozen=True)
class Leg:
    """A part of a run under one plan.

    Attributes:
        samples: of the trajectory.
        segments: of the plan.
    """

    samples: slice
    segments: tuple[Segment, ...]


def legs(trajectory: Trajectory) -> Iterator[Leg]:
    """Yield the parts of a run under each of its plans; plans without a path have none."""
    about = following(trajectory)
    plans = about["plans"] if about else []
    begins = [*(int(np.searchsorted(trajectory.time, p["time"] - 1e-9)) for p in plans), len(trajectory)]
    for plan, begin, end in zip(plans, begins, begins[1:], strict=False):
        if plan["segments"] and end > begin:
            yield Leg(slice(begin, end), segments_of(plan))


def segments_of(plan: Mapping[str, Any]) -> tuple[Segment, ...]:
    """Return the path of a recorded plan."""
    from srs_twin.planning.problem import Segment
    from srs_twin.robot.world import Pose

    return tuple(
        Segment(Pose(x, y, heading), curvature, length, offset, speed)
        for x, y, heading, curvature, length, offset, speed in plan["segments"]
    )


def footprint_of(about: Mapping[str, Any]) -> Footprint:
    """Return the recorded footprint that the plans were made with."""
    from srs_twin.planning.footprint import Footprint

    given = about["footprint"]
    columns = {k: tuple(given[k]) for k in ("offsets", "curvatures", "speeds", "left", "right")}
    return Footprint(given["name"], given["title"], **columns, ahead=given["ahead"], behind=given["behind"])


def following_metrics(trajectory: Trajectory) -> dict[str, Any]:
    """Measure one run that followed a plan; all None of one that did not.

    Against the plan in force at each moment:

    - ``cross_track_rms_m``, ``cross_track_max_m``: distance of the centre of mass from the path.
    - ``inside_share``: share of time at which the whole body, connectors and the middles of segments with
      half the width to both sides, is between the edges of the planned footprint. Before the start and
      beyond the end, where head or tail may be, the path goes on straight with the edges of going straight.
    - ``inside_50mm_share``: the same of the text's box of 50 mm.

    At its end: ``goal_reached`` (1 or 0: the centre of mass within the goal's radius, and the body never in
    an obstacle, as only the analytical plants can be), ``arrival_error_m``, ``arrival_heading_error_rad``
    (period mean, carried on to the end; None without a heading to arrive with).

    ``contacts`` and ``contact_time_s`` count forces of obstacles (None where there is nothing to touch),
    ``clearance_m`` is the least distance of the hull that the twin collides from obstacles, at the samples; 0
    or less where it touched one, also between two samples (None without obstacles).
    ``following_time_s`` is the length of the run, ``replans`` the number of new plans. ``plan_…`` tell of
    the first plan.
    """
    about = following(trajectory)
    if about is None:
        return dict.fromkeys(FOLLOWING_UNITS)
    first = about["plans"][0]
    clearance = _clearance(trajectory, about["world"])
    return {
        **plan_metrics(first["outcome"] == "found", segments_of(first), first["nodes"]),
        **_arrival(trajectory, about, overlapped=clearance is not None and clearance < -OVERLAP),
        **_deviation(trajectory, about),
        **_contacts(trajectory),
        "clearance_m": clearance,
        "following_time_s": float(trajectory.time[-1] - trajectory.time[0]),
        "replans": len(about["plans"]) - 1,
    }


def plan_metrics(found: bool, segments: tuple[Segment, ...], nodes: int) -> dict[str, Any]:
    """Return the metrics of a plan alone."""
    from srs_twin.planning.plan import Plan
    from srs_twin.planning.problem import Outcome

    plan = Plan(Outcome.FOUND if found else Outcome.STUCK, "", segments)
    return {
        "plan_found": int(found),
        "plan_length_m": plan.length if found else None,
        "plan_nodes": nodes,
        "plan_kink_rad": plan.kink if found else None,
    }


def _arrival(trajectory: Trajectory, about: Mapping[str, Any], *, overlapped: bool) -> dict[str, Any]:
    goal = about["goal"]
    error = float(np.hypot(*(trajectory.com[-1] - (goal["x"], goal["y"]))))
    heading = None
    if goal["heading"] is not None:
        heading = abs(math.remainder(_mean_heading(trajectory) - goal["heading"], 2 * math.pi))
    return {
        "goal_reached": int(error <= goal["radius"] and not overlapped),
        "arrival_error_m": error,
        "arrival_heading_error_rad": heading,
    }


def _mean_heading(trajectory: Trajectory) -> float:
    """Return the heading at the end without the gait's swing: the last period's mean, carried on by half."""
    frequency = positive_number(trajectory, "gait_frequency_hz")
    time, heading = trajectory.time, trajectory["heading"]
    period = min(1 / frequency if frequency else 0.0, time[-1] - time[0])
    if period <= 0:
        return float(heading[-1])
    at = np.linspace(time[-1] - period, time[-1], 201)
    seen = np.interp(at, time, heading)
    return float(np.trapezoid(seen, at) / period + (seen[-1] - seen[0]) / 2)


def _deviation(trajectory: Trajectory, about: Mapping[str, Any]) -> dict[str, Any]:
    parts = list(_about_paths(trajectory))
    if not parts:
        return dict.fromkeys(("cross_track_rms_m", "cross_track_max_m", "inside_share", "inside_50mm_share"))
    deviation, outline, curvature = (np.concatenate(each) for each in zip(*parts, strict=True))
    shift = TEXT_SHIFT * np.clip(-curvature / TEXT_TIGHTEST, -1, 1)
    return {
        "cross_track_rms_m": rms(deviation),
        "cross_track_max_m": float(np.abs(deviation).max()),
        "inside_share": float((beyond(trajectory) <= 0).mean()),
        "inside_50mm_share": float((np.abs(outline - shift) <= TEXT_HALF_WIDTH).all(axis=1).mean()),
    }


def beyond(trajectory: Trajectory) -> np.ndarray:
    """Return how far the body reaches beyond the planned footprint's edges, shape (samples,), m.

    Below 0: what is left to them. They are those of the recorded footprint, as of `inside_share`.
    """
    about = following(trajectory)
    assert about is not None, "a run that followed a plan"
    footprint = footprint_of(about)
    found = [np.empty(0)]
    for _, n, curvature in _about_paths(trajectory):
        left, right = (
            np.interp(curvature, footprint.curvatures, edge) for edge in (footprint.left, footprint.right)
        )
        found.append(np.maximum(n - left, -n - right).max(axis=1))
    return np.concatenate(found)


def _about_paths(trajectory: Trajectory) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield, for each plan, how far left of its path centre of mass and body are, and its curvature there."""
    from srs_twin.planning.route import Route

    outline = body_points(trajectory)
    for leg in legs(trajectory):
        route = Route(leg.segments)
        points = outline[leg.samples]
        s, n = (each.reshape(points.shape[:2]) for each in route.places(points.reshape(-1, 2)))
        curvature = np.array([a.curvature for a in leg.segments])
        ends = np.cumsum([a.length for a in leg.segments])
        here = np.append(curvature, 0.0)[np.searchsorted(ends, s)]
        yield route.places(trajectory.com[leg.samples])[1], n, np.where(s < 0, 0.0, here)


def body_points(trajectory: Trajectory) -> np.ndarray:
    """Return points on both sides of connectors and of the middles of segments, shape (samples, k, 2), m."""
    half = (positive_number(trajectory, "body_width_m") or 0.0) / 2
    centres, heading = centre_points(trajectory)
    return on_both_sides(centres, heading, half)


def centre_points(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return connectors and middles of segments, shape (samples, 2N − 1, 2), m, and the headings there."""
    position, theta = trajectory.position, trajectory.stack("theta")
    chord = position[:, :-1] - position[:, 1:]
    bend = np.diff(-theta, axis=1)
    # The middle of an arc stands off its chord by chord · tan(bend/4)/2, to the outside of the bend.
    off = np.tan(np.clip(bend, -3.0, 3.0) / 4)[..., None] / 2
    middle = (position[:, :-1] + position[:, 1:]) / 2 + off * np.stack([chord[..., 1], -chord[..., 0]], -1)
    return (
        np.concatenate([position, middle], axis=1),
        np.concatenate([theta, (theta[:, :-1] + theta[:, 1:]) / 2], axis=1),
    )


def _contacts(trajectory: Trajectory) -> dict[str, Any]:
    force = obstacle_force(trajectory)
    if force is None:
        return {"contacts": None, "contact_time_s": None}
    steps = np.diff(trajectory.time, prepend=trajectory.time[0])
    return {
        "contacts": len(touches(trajectory)),
        "contact_time_s": float(steps[force.max(axis=1) > TOUCH_N].sum()),
    }


def clearances(trajectory: Trajectory, world: Mapping[str, Any]) -> np.ndarray | None:
    """Return how far the hull that the twin collides is from the nearest obstacle, shape (samples,), m.

    Args:
        trajectory: of either plant.
        world: obstacles and polygons as the metadata of a follower hold them.

    Returns:
        Below 0 inside an obstacle; None where there is none.
    """
    import shapely

    obstacles = [(shapely.Point(c["x"], c["y"]), c["radius"]) for c in world["obstacles"]]
    obstacles += [(shapely.Polygon(each["corners"]), WALL_M) for each in world["polygons"]]
    if not obstacles:
        return None
    hull = shapely.linestrings(hull_lines(trajectory))
    half = trajectory.metadata["body_width_m"] / 2
    apart = [shapely.distance(each, hull) - size - half for each, size in obstacles]
    return np.asarray(np.min(apart, axis=0))


def _clearance(trajectory: Trajectory, world: Mapping[str, Any]) -> float | None:
    apart = clearances(trajectory, world)
    if apart is None:
        return None
    least = float(apart.min())
    # Between two samples nothing but a force tells of a touch.
    return min(least, 0.0) if touches(trajectory) else least


def _why_undefined(metric: str, trajectory: Trajectory) -> str:
    """Return the reason why a run leaves a metric of following undefined, empty where None is its outcome."""
    if following(trajectory) is None:
        return "the run follows no plan"
    if metric == "arrival_heading_error_rad":
        return "the goal has no heading"
    obstacles = metric in ("contacts", "contact_time_s", "clearance_m")
    return "the world has no obstacles" if obstacles else ""


METRICS = MetricGroup(
    units=FOLLOWING_UNITS,
    measure=following_metrics,
    why_undefined=_why_undefined,
    relative=frozenset({"cross_track_rms_m", "cross_track_max_m", "following_time_s"}),
    main="plan_found",
    short_table=(
        *("plan_found", "plan_length_m", "goal_reached", "arrival_error_m", "arrival_heading_error_rad"),
        *("cross_track_rms_m", "cross_track_max_m", "inside_share", "inside_50mm_share"),
        *("contacts", "clearance_m", "following_time_s", "replans", "com_speed_m_s", "realtime_factor"),
    ),
)
"""Metrics of runs that follow a plan."""
