"""Metrics of plans and of runs that follow a plan."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypedDict, cast

import numpy as np

from srs_twin.comparison.centre_line import offset_to_sides
from srs_twin.comparison.contacts import contact_metrics
from srs_twin.comparison.sampling import MetricGroup, positive_number, rms, units_of
from srs_twin.plants.clearance import PENETRATION_M
from srs_twin.trajectory import Trajectory

if TYPE_CHECKING:
    from srs_twin.planning.footprint import Footprint
    from srs_twin.planning.path import Segment

PLAN_UNITS = units_of(
    ("plan_found", "plan_length_m", "plan_nodes", "plan_max_heading_jump_rad")
)
"""Units of the metrics that describe a plan."""

PLANNING_UNITS = PLAN_UNITS | units_of(["plan_s"])
"""Units of the plan metrics and of the wall time of planning."""

_MEANINGS = {
    "plan_found": "1 if a path was found, else 0",
    "plan_length_m": "length of the planned path",
    "plan_nodes": "number of nodes that the search expanded",
    "plan_max_heading_jump_rad": "largest change of direction between two arcs of the path",
    "goal_reached": (
        "1 if the snake reached its goal without passing through an obstacle, else 0"
    ),
    "arrival_error_m": "distance from the goal at the end",
    "arrival_heading_error_rad": (
        "angle between the heading and the goal heading at the end"
    ),
    "cross_track_rms_m": "RMS distance of the centre of mass from the planned path",
    "cross_track_max_m": "largest distance of the centre of mass from the planned path",
    "inside_fraction": (
        "fraction of the time in which the whole body is inside the planned footprint"
    ),
    "inside_50mm_fraction": (
        "fraction of the time in which the whole body is inside the 50 mm box of the"
        " dissertation"
    ),
    "following_time_s": "time from start to end of the path",
    "replans": "number of plans after the first",
}

FOLLOWING_UNITS = units_of(_MEANINGS)
"""Units of the metrics for runs that follow a plan."""

DISSERTATION_HALF_WIDTH_M = 0.025
"""Half the width of the footprint in the dissertation (Section 5.2), m."""
DISSERTATION_SHIFT_M = 0.01
"""Shift of the dissertation's footprint in the tightest turn, m."""
DISSERTATION_TIGHTEST = math.pi / 3 / 0.2
"""Curvature of the tightest turn in Section 5.2 (60 degrees over 0.2 m), 1/m."""


class GoalRecord(TypedDict):
    """Goal of a run that follows a plan, as in `Goal`."""

    x: float
    y: float
    heading: float | None
    radius: float


class PlanRecord(TypedDict):
    """Recorded plan.

    Attributes:
        segments: x, y, heading, curvature, length, offset and speed of each segment.
    """

    time: float
    outcome: str
    reason: str
    nodes: int
    segments: Sequence[Sequence[float]]


class FootprintRecord(TypedDict):
    """Recorded footprint, as in `Footprint`."""

    name: str
    title: str
    offsets: Sequence[float]
    curvatures: Sequence[float]
    speeds: Sequence[float]
    left: Sequence[float]
    right: Sequence[float]
    ahead: float
    behind: float


class FollowingRecord(TypedDict):
    """Metadata of a follower."""

    plans: Sequence[PlanRecord]
    footprint: FootprintRecord
    world: Mapping[str, object]
    goal: GoalRecord
    ending: str | None


def following(trajectory: Trajectory) -> FollowingRecord | None:
    """Return the metadata of the follower, or None if the run has no follower."""
    control = trajectory.metadata.get("control")
    if isinstance(control, Mapping):
        metadata = control.get("following")
        if isinstance(metadata, Mapping):
            return cast(FollowingRecord, metadata)
    return None


@dataclass(frozen=True)
class Leg:
    """Part of a run that follows one plan."""

    samples: slice
    segments: tuple[Segment, ...]


def legs(trajectory: Trajectory) -> Iterator[Leg]:
    """Yield the parts of a run, one for each plan that contains a path."""
    metadata = following(trajectory)
    plans = metadata["plans"] if metadata else []
    begins = [
        *(int(np.searchsorted(trajectory.time, p["time"] - 1e-9)) for p in plans),
        len(trajectory),
    ]
    for plan, begin, end in zip(plans, begins, begins[1:], strict=False):
        if plan["segments"] and end > begin:
            yield Leg(slice(begin, end), segments_of(plan))


def segments_of(plan: PlanRecord) -> tuple[Segment, ...]:
    """Return the path segments of a recorded plan."""
    from srs_twin.planning.path import Segment
    from srs_twin.robot.world import Pose

    return tuple(
        Segment(Pose(x, y, heading), curvature, length, offset, speed)
        for x, y, heading, curvature, length, offset, speed in plan["segments"]
    )


def footprint_of(metadata: FollowingRecord) -> Footprint:
    """Return the footprint that is recorded in the metadata of a follower."""
    from srs_twin.planning.footprint import Footprint

    data = metadata["footprint"]
    return Footprint(
        data["name"],
        data["title"],
        offsets=tuple(data["offsets"]),
        curvatures=tuple(data["curvatures"]),
        speeds=tuple(data["speeds"]),
        left=tuple(data["left"]),
        right=tuple(data["right"]),
        ahead=data["ahead"],
        behind=data["behind"],
    )


def following_metrics(trajectory: Trajectory) -> dict[str, float | None]:
    """Return the path-following metrics, which are None if the run follows no plan.

    The following metrics refer to the plan that is active at each sample:

    - ``cross_track_rms_m`` and ``cross_track_max_m``: distance of the centre of mass
      from the path.
    - ``inside_fraction``: fraction of samples at which the whole body is between the
      edges of the planned footprint. The body is represented by points at half the body
      width to the left and right of each connector and each segment midpoint.
    - ``inside_50mm_fraction``: fraction of samples at which the body is inside the
      footprint of the dissertation, which is 50 mm wide.

    The following metrics refer to the end of the run:

    - ``goal_reached``: 1 if the centre of mass is within the goal's radius and the body
      never overlapped an obstacle, otherwise 0. Overlaps occur only in the analytical
      model.
    - ``arrival_error_m``: distance of the centre of mass from the goal.
    - ``arrival_heading_error_rad``: heading error, averaged over a gait period and
      extrapolated to the end, or None if the goal has no heading.

    The metric ``following_time_s`` is the duration of the run, ``replans`` is the
    number of new plans, and the metrics ``plan_…`` describe the first plan.
    """
    metadata = following(trajectory)
    undefined: dict[str, float | None] = dict.fromkeys(FOLLOWING_UNITS)
    if metadata is None:
        return undefined
    first = metadata["plans"][0]
    clearance = contact_metrics(trajectory)["clearance_m"] or 0.0
    return {
        **undefined,
        **plan_metrics(first["outcome"] == "found", segments_of(first), first["nodes"]),
        **_arrival(trajectory, metadata, overlapped=clearance < -PENETRATION_M),
        **_deviation(trajectory, metadata),
        "following_time_s": float(trajectory.time[-1] - trajectory.time[0]),
        "replans": len(metadata["plans"]) - 1,
    }


def plan_metrics(
    found: bool, segments: tuple[Segment, ...], nodes: int
) -> dict[str, float | None]:
    """Return the metrics that describe a plan."""
    from srs_twin.planning.problem import Plan, PlanOutcome

    plan = Plan(PlanOutcome.FOUND, "", segments)
    return {
        "plan_found": int(found),
        "plan_length_m": plan.length if found else None,
        "plan_nodes": nodes,
        "plan_max_heading_jump_rad": plan.max_heading_jump if found else None,
    }


def _arrival(
    trajectory: Trajectory, metadata: FollowingRecord, *, overlapped: bool
) -> dict[str, float | None]:
    goal = metadata["goal"]
    error = float(np.hypot(*(trajectory.com[-1] - (goal["x"], goal["y"]))))
    heading = None
    if goal["heading"] is not None:
        heading = abs(
            math.remainder(_mean_heading(trajectory) - goal["heading"], 2 * math.pi)
        )
    return {
        "goal_reached": int(error <= goal["radius"] and not overlapped),
        "arrival_error_m": error,
        "arrival_heading_error_rad": heading,
    }


def _mean_heading(trajectory: Trajectory) -> float:
    frequency = positive_number(trajectory, "gait_frequency_hz")
    time = trajectory.time
    heading = trajectory["heading"]
    period = min(1 / frequency if frequency else 0.0, time[-1] - time[0])
    if period <= 0:
        return float(heading[-1])
    at = np.linspace(time[-1] - period, time[-1], 201)
    # The heading oscillates with the gait, but its mean over a whole period does not.
    values = np.interp(at, time, heading)
    return float(np.trapezoid(values, at) / period + (values[-1] - values[0]) / 2)


def _deviation(
    trajectory: Trajectory, metadata: FollowingRecord
) -> dict[str, float | None]:
    deviations = list(_path_deviations(trajectory))
    if not deviations:
        return {}
    deviation, outline, curvature = (
        np.concatenate(arrays) for arrays in zip(*deviations, strict=True)
    )
    # In the dissertation, the edges shift towards the outside of a turn in proportion
    # to the curvature.
    shift = DISSERTATION_SHIFT_M * np.clip(-curvature / DISSERTATION_TIGHTEST, -1, 1)
    return {
        "cross_track_rms_m": rms(deviation),
        "cross_track_max_m": float(np.abs(deviation).max()),
        "inside_fraction": float((beyond(trajectory) <= 0).mean()),
        "inside_50mm_fraction": float(
            (np.abs(outline - shift) <= DISSERTATION_HALF_WIDTH_M).all(axis=1).mean()
        ),
    }


def beyond(trajectory: Trajectory) -> np.ndarray:
    """Return how far the body extends beyond the footprint, m, shape (samples,).

    Values are negative if the body is inside the footprint.
    """
    metadata = following(trajectory)
    assert metadata is not None, "a run that followed a plan"
    footprint = footprint_of(metadata)
    excursions = [np.empty(0)]
    for _, n, curvature in _path_deviations(trajectory):
        left, right = (
            np.interp(curvature, footprint.curvatures, edge)
            for edge in (footprint.left, footprint.right)
        )
        excursions.append(np.maximum(n - left, -n - right).max(axis=1))
    return np.concatenate(excursions)


def _path_deviations(
    trajectory: Trajectory,
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield the deviations from the path for each plan of a run.

    Yields:
        Cross-track errors of the centre of mass (m), cross-track errors of the body
        points (m), and path curvatures at the body points (1/m).
    """
    from srs_twin.planning.path import ReferencePath

    outline = body_points(trajectory)
    for leg in legs(trajectory):
        path = ReferencePath(leg.segments)
        points = outline[leg.samples]
        s, n = (
            values.reshape(points.shape[:2])
            for values in path.coordinates(points.reshape(-1, 2))
        )
        curvature = np.array([a.curvature for a in leg.segments])
        ends = np.cumsum([a.length for a in leg.segments])
        # The extensions at both ends of the path are straight.
        here = np.append(curvature, 0.0)[np.searchsorted(ends, s)]
        yield (
            path.coordinates(trajectory.com[leg.samples])[1],
            n,
            np.where(s < 0, 0.0, here),
        )


def body_points(trajectory: Trajectory) -> np.ndarray:
    """Return points on both sides of the body, m, shape (samples, k, 2)."""
    half = (positive_number(trajectory, "body_width_m") or 0.0) / 2
    centres, heading = centre_points(trajectory)
    return offset_to_sides(centres, heading, half)


def centre_points(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (m) and headings (rad) of connectors and segment midpoints."""
    position = trajectory.position
    theta = trajectory.stack("connector_heading")
    chord = position[:, :-1] - position[:, 1:]
    bend = np.diff(-theta, axis=1)
    # The midpoint of a bent segment is on the outside of the bend, at a distance of
    # chord · tan(bend/4)/2 from the chord.
    sagitta = np.tan(np.clip(bend, -3.0, 3.0) / 4)[..., None] / 2
    middle = (position[:, :-1] + position[:, 1:]) / 2 + sagitta * np.stack(
        [chord[..., 1], -chord[..., 0]], -1
    )
    return (
        np.concatenate([position, middle], axis=1),
        np.concatenate([theta, (theta[:, :-1] + theta[:, 1:]) / 2], axis=1),
    )


def _why_undefined(metric: str, trajectory: Trajectory) -> str:
    if following(trajectory) is None:
        return "the run follows no plan"
    if metric == "arrival_heading_error_rad":
        return "the goal has no heading"
    return ""


METRICS = MetricGroup(
    meanings=_MEANINGS,
    measure=following_metrics,
    why_undefined=_why_undefined,
    relative=frozenset({"cross_track_rms_m", "cross_track_max_m", "following_time_s"}),
    yes_no=frozenset({"plan_found", "goal_reached"}),
    main="plan_found",
    short_table=(
        "plan_found",
        "plan_length_m",
        "goal_reached",
        "arrival_error_m",
        "arrival_heading_error_rad",
        "cross_track_rms_m",
        "cross_track_max_m",
        "inside_fraction",
        "inside_50mm_fraction",
        "contacts",
        "clearance_m",
        "following_time_s",
        "replans",
        "com_speed_m_s",
        "realtime_factor",
    ),
)
