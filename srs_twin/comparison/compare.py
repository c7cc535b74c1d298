"""compare(): how far two runs under the same valve commands lie apart."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from srs_twin.comparison.metrics import plant_metrics
from srs_twin.comparison.sampling import body_length, interpolant, label, require, rms, segment_lengths
from srs_twin.errors import InputError
from srs_twin.trajectory import Trajectory

# Times closer than this are the same.
_ROUNDING_S = 1e-9


@dataclass(frozen=True)
class Comparison:
    """The difference of a candidate (the twin) from a reference (the analytical model).

    Attributes:
        metrics: by the names of `COMPARISON_UNITS`. ``com_speed_rel`` = (candidate − reference)/reference,
            the reference's speed times ``gap_factor``, which is 1 unless it was asked for;
            ``yaw_rate_abs`` the size of the difference of the yaw rates; ``shape_rms_m`` the distance of
            like connectors with both bodies in their centre-of-mass frame at zero mean heading (section
            3.4.1), root mean square over connectors and time, ``shape_rms_body`` the same over the
            reference's body length; ``path_rms_m`` the distance of the centres of mass at equal times;
            ``bend_rms_rad`` and ``bend_rms_rel`` (over the root mean square bend of the reference);
            ``heading_rms_rad``. None where a plant has no gait metrics or a denominator is zero.
        time: instants compared, those of the reference, shape (T,), s.
        shape_error: root mean square over the connectors at each instant, (T,), m.
        path_error: distance of the centres of mass, (T,), m.
        bend_error: candidate − reference, (T, segments), rad.
        heading_error: candidate − reference, without the whole turns between where the two began, (T,), rad.
    """

    metrics: dict[str, float | None]
    time: np.ndarray
    shape_error: np.ndarray
    path_error: np.ndarray
    bend_error: np.ndarray
    heading_error: np.ndarray


def compare(reference: Trajectory, candidate: Trajectory, *, gap_factor: bool = False) -> Comparison:
    """Compare two runs at equal times.

    Where the sample times differ the candidate is interpolated to the reference's, over the span that both
    cover.

    Args:
        reference: the analytical model's run.
        candidate: the twin's run.
        gap_factor: compare speeds as the dissertation does, whose model has no rigid gaps: multiply the
            reference's by (l + L_o)/l of the candidate (Section 3.4.2).

    Raises:
        InputError: unequal connectors, no time in common, columns or metadata that are missing or
            unusable, or a gap factor for a reference that has gaps of its own.
    """
    for trajectory in (reference, candidate):
        require(trajectory, "com_x", "com_y", "heading", "x", "y", "bend")
    _same_connectors(reference, candidate)
    time = _common_times(reference, candidate)
    ours, theirs = _Sampled.at(reference, time), _Sampled.at(candidate, time)

    # Whole turns between two unwrapped headings say where counting began, not where the snakes point.
    heading_error = theirs.heading - ours.heading
    heading_error -= 2 * np.pi * np.round(heading_error[0] / (2 * np.pi))
    distance = np.linalg.norm(theirs.in_body_frame() - ours.in_body_frame(), axis=-1)
    path_error = np.linalg.norm(theirs.com - ours.com, axis=-1)
    bend_error = theirs.bend - ours.bend
    metrics = {
        **_gait_differences(reference, candidate, _gap_factor(reference, candidate) if gap_factor else 1.0),
        "shape_rms_m": rms(distance),
        "shape_rms_body": rms(distance) / body_length(reference),
        "path_rms_m": rms(path_error),
        "bend_rms_rad": rms(bend_error),
        "bend_rms_rel": _ratio(rms(bend_error), rms(ours.bend)),
        "heading_rms_rad": rms(heading_error),
    }
    shape_error = np.sqrt((distance**2).mean(axis=-1))
    return Comparison(metrics, time, shape_error, path_error, bend_error, heading_error)


def in_body_frame(position: np.ndarray, com: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Move bodies into their centre-of-mass frame at zero mean heading (section 3.4.1, Fig. 27).

    Args:
        position: connectors in the world, shape (…, N, 2), m.
        com: centre of mass, (…, 2), m.
        heading: mean heading, (…), rad.

    Returns:
        Shape (…, N, 2), m; x ahead, y to the left.
    """
    x, y = np.moveaxis(position - com[..., None, :], -1, 0)
    cos, sin = np.cos(heading)[..., None], np.sin(heading)[..., None]
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


@dataclass(frozen=True)
class _Sampled:
    """What is compared of one run, at given times: com (T, 2), heading (T,), position (T, N, 2), bend."""

    com: np.ndarray
    heading: np.ndarray
    position: np.ndarray
    bend: np.ndarray

    @classmethod
    def at(cls, run: Trajectory, time: np.ndarray) -> _Sampled:
        signals = (run.com, run["heading"], run.position, run.stack("bend"))
        if len(run) == len(time) and np.allclose(run.time, time, rtol=0, atol=_ROUNDING_S):
            return cls(*signals)
        return cls(*(interpolant(run, values)(time) for values in signals))

    def in_body_frame(self) -> np.ndarray:
        return in_body_frame(self.position, self.com, self.heading)


def _same_connectors(reference: Trajectory, candidate: Trajectory) -> None:
    counts = [_connectors(trajectory) for trajectory in (reference, candidate)]
    if counts[0] != counts[1]:
        raise InputError(
            f"{label(reference)} has {counts[0]} connectors and {label(candidate)} {counts[1]}; "
            "only bodies with equally many can be compared"
        )


def _connectors(trajectory: Trajectory) -> int:
    x, y, bend = (trajectory.stack(name).shape[-1] for name in ("x", "y", "bend"))
    if not x == y == bend + 1:
        raise InputError(
            f"{label(trajectory)}: {x} columns x_1…, {y} y_1… and {bend} bend_1…; "
            "a snake of N connectors has N, N and N − 1"
        )
    return x


def _common_times(reference: Trajectory, candidate: Trajectory) -> np.ndarray:
    """Return the reference's times that the candidate covers."""
    first, last = candidate.time[0] - _ROUNDING_S, candidate.time[-1] + _ROUNDING_S
    common = reference.time[(reference.time >= first) & (reference.time <= last)]
    if len(common) == 0:
        spans = [f"{label(t)} covers {t.time[0]:g} to {t.time[-1]:g} s" for t in (reference, candidate)]
        raise InputError(f"{spans[0]}, {spans[1]}: no time in common, nothing to compare")
    return common


def _gap_factor(reference: Trajectory, candidate: Trajectory) -> float:
    if reference.metadata.get("rigid_gap_m"):
        raise InputError(
            f"{label(reference)} has rigid gaps in its geometry, so the factor (l + L_o)/l would count them "
            "twice; run it without gaps"
        )
    length, gap = segment_lengths(candidate)
    return (length + gap) / length


def _gait_differences(reference: Trajectory, candidate: Trajectory, factor: float) -> dict[str, float | None]:
    ours, theirs = plant_metrics(reference), plant_metrics(candidate)
    if ours["com_speed_m_s"] is None or theirs["com_speed_m_s"] is None:
        return {"com_speed_rel": None, "gap_factor": factor, "yaw_rate_abs": None}
    speed = factor * ours["com_speed_m_s"]
    return {
        "com_speed_rel": _ratio(theirs["com_speed_m_s"] - speed, speed),
        "gap_factor": factor,
        "yaw_rate_abs": abs(theirs["yaw_rate_rad_s"] - ours["yaw_rate_rad_s"]),
    }


def _ratio(part: float, whole: float) -> float | None:
    return part / whole if whole else None
