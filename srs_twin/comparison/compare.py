"""Differences between two runs, or between a run and a recording.

An `Attribution` divides the difference between the two plants into contributions of
their modelling assumptions.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import ClassVar

import numpy as np

from srs_twin.comparison.gait import spatial_differences
from srs_twin.comparison.metrics import MEASURED_UNITS, plant_metrics
from srs_twin.comparison.sampling import (
    body_length,
    check_columns,
    interpolant,
    is_near_zero,
    label,
    rms,
    segment_lengths,
)
from srs_twin.errors import InputError
from srs_twin.trajectory import HtmlResult, Trajectory

_TIME_ROUNDING_S = 1e-9
"""Maximum difference between two times that are considered equal, s."""


@dataclass(frozen=True)
class Comparison(HtmlResult):
    """Difference between a candidate (the twin) and a reference (the analytical model).

    Attributes:
        metrics: metrics listed in `COMPARISON_UNITS`. A metric is None if a run has no
            gait metrics or a denominator is close to zero. ``com_speed_rel`` is
            (candidate − reference) / reference, where the reference speed has been
            multiplied by ``gap_factor`` (by default 1). ``shape_rms_m`` compares the
            bodies in their centre-of-mass frames (`in_body_frame`). Spatial snakes also
            have the metrics from `gait.spatial_differences`.
        time: sample times of the reference at which the runs are compared, shape (T,),
            s.
        shape_error: RMS distance between corresponding connectors in the
            centre-of-mass frames, shape (T,), m.
        path_error: distance between the centres of mass, shape (T,), m.
        bend_error: candidate bends − reference bends, shape (T, segments), rad.
        heading_error: candidate heading − reference heading, shape (T,), rad. Whole
            turns between the initial headings are removed.
    """

    page: ClassVar[str] = "comparison"

    metrics: dict[str, float | None]
    time: np.ndarray
    shape_error: np.ndarray
    path_error: np.ndarray
    bend_error: np.ndarray
    heading_error: np.ndarray


def compare(
    reference: Trajectory, candidate: Trajectory, *, gap_factor: bool = False
) -> Comparison:
    """Compare two runs at the same times.

    If the sample times differ, the candidate is interpolated at the reference's sample
    times within the common interval.

    Args:
        reference: run of the analytical model.
        candidate: run of the twin.
        gap_factor: whether to multiply the reference speed by (l + L_o)/l, with the
            segment length l and the rigid gap L_o of the candidate. This factor
            accounts for the rigid gaps that the dissertation's model lacks (Section
            3.4.2).

    Raises:
        InputError: the runs cannot be compared, or a gap factor is requested for a
            reference that has rigid gaps.
    """
    for trajectory in (reference, candidate):
        check_columns(trajectory, "com_x", "com_y", "heading", "x", "y", "bend")
    _check_connectors(reference, candidate)
    time = _common_times(reference, candidate)
    (
        (reference_com, reference_heading, reference_position, reference_bend),
        (com, heading, position, bend),
    ) = (_sampled(run, time) for run in (reference, candidate))

    # The unwrapped headings of parallel snakes may differ by whole turns.
    heading_error = heading - reference_heading
    heading_error -= 2 * np.pi * np.round(heading_error[0] / (2 * np.pi))
    shape = in_body_frame(position, com, heading)
    offset = shape - in_body_frame(reference_position, reference_com, reference_heading)
    distance = np.linalg.norm(offset, axis=-1)
    path_error = np.linalg.norm(com - reference_com, axis=-1)
    bend_error = bend - reference_bend
    factor = _gap_factor(reference, candidate) if gap_factor else 1.0
    metrics = {
        **_gait_differences(reference, candidate, factor),
        "shape_rms_m": rms(distance),
        "shape_rms_body": rms(distance) / body_length(reference),
        "path_rms_m": rms(path_error),
        "bend_rms_rad": rms(bend_error),
        "bend_rms_rel": _ratio(rms(bend_error), rms(reference_bend)),
        "heading_rms_rad": rms(heading_error),
        **spatial_differences(reference, candidate, time),
    }
    shape_error = np.sqrt((distance**2).mean(axis=-1))
    return Comparison(metrics, time, shape_error, path_error, bend_error, heading_error)


def in_body_frame(
    position: np.ndarray, com: np.ndarray, heading: np.ndarray
) -> np.ndarray:
    """Transform connector positions to centre-of-mass frames (Section 3.4.1, Fig. 27).

    In such a frame, the mean heading is zero, x points forward and y to the left.

    Args:
        position: positions of the connectors, shape (…, N, 2), m.
        com: centres of mass, shape (…, 2), m.
        heading: mean headings, shape (…), rad.
    """
    x, y = np.moveaxis(position - com[..., None, :], -1, 0)
    cos = np.cos(heading)[..., None]
    sin = np.sin(heading)[..., None]
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)


def _sampled(run: Trajectory, time: np.ndarray) -> list[np.ndarray]:
    signals = [run.com, run["heading"], run.position, run.stack("bend")]
    if len(run) == len(time) and np.allclose(
        run.time, time, rtol=0, atol=_TIME_ROUNDING_S
    ):
        return signals
    return [interpolant(run, values)(time) for values in signals]


def _check_connectors(reference: Trajectory, candidate: Trajectory) -> None:
    counts = []
    for run in (reference, candidate):
        x, y, bend = (run.stack(name).shape[-1] for name in ("x", "y", "bend"))
        if not x == y == bend + 1:
            raise InputError(
                f"{label(run)} has {x} columns x_1…, {y} columns y_1… and {bend}"
                " columns bend_1…; a snake with N connectors must have N columns x, N"
                " columns y and N − 1 columns bend"
            )
        counts.append(x)
    if counts[0] != counts[1]:
        raise InputError(
            f"{label(reference)} has {counts[0]} connectors, but {label(candidate)}"
            f" has {counts[1]}; only runs of robots with the same number of connectors"
            " can be compared"
        )


def _common_times(reference: Trajectory, candidate: Trajectory) -> np.ndarray:
    common = reference.between(candidate.time[0], candidate.time[-1]).time
    # A run that has only one sample is compared at this sample.
    if len(common) < min(2, len(reference), len(candidate)):
        spans = [
            f"{label(t)} covers {t.time[0]:g} to {t.time[-1]:g} s"
            for t in (reference, candidate)
        ]
        raise InputError(
            "the runs cannot be compared, because they have fewer than two times"
            f" in common ({spans[0]}, {spans[1]})"
        )
    return common


def _gap_factor(reference: Trajectory, candidate: Trajectory) -> float:
    if reference.metadata.get("rigid_gap_m"):
        raise InputError(
            f"the gap factor (l + L_o)/l is not allowed for {label(reference)},"
            " because this run already has rigid gaps in its geometry; run it without"
            " gaps"
        )
    length, gap = segment_lengths(candidate)
    return (length + gap) / length


def _gait_differences(
    reference: Trajectory, candidate: Trajectory, factor: float
) -> dict[str, float | None]:
    after = plant_metrics(candidate)
    before = plant_metrics(reference)
    differences: dict[str, float | None] = {
        "com_speed_rel": None,
        "gap_factor": factor,
        "yaw_rate_abs": None,
    }
    own = after["com_speed_m_s"]
    if own is not None and before["com_speed_m_s"] is not None:
        speed = factor * before["com_speed_m_s"]
        if not is_near_zero(speed, own, "m/s"):
            differences["com_speed_rel"] = (own - speed) / speed
        turn = after["yaw_rate_rad_s"] - before["yaw_rate_rad_s"]
        differences["yaw_rate_abs"] = abs(turn)
    return differences


def _ratio(numerator: float, denominator: float) -> float | None:
    if denominator:
        return numerator / denominator
    return None


_MAX_INTERVALS = 50
"""Maximum number of time intervals in `MeasuredDifference.document`."""


@dataclass(frozen=True)
class MeasuredDifference:
    """Difference between a simulated run and a measured motion.

    Attributes:
        comparison: comparison with the measured motion as reference.
        only_bends: whether only bends were measured. In this case, the positions in the
            measured trajectory were computed from the bends.
        clamped: whether the head of the snake was clamped.
    """

    comparison: Comparison
    only_bends: bool = False
    clamped: bool = False

    @classmethod
    def between(cls, measured: Trajectory, run: Trajectory) -> MeasuredDifference:
        """Compare a run with a measured trajectory.

        Raises:
            InputError: the runs cannot be compared.
        """
        only_bends = bool(measured.metadata.get("bends_only"))
        return cls(
            compare(measured, run), only_bends, run.metadata.get("base") == "clamped"
        )

    @property
    def metrics(self) -> dict[str, float | None]:
        """Metrics listed in `MEASURED_UNITS`, with None for quantities not measured."""
        measured = set(MEASURED_UNITS)
        if self.only_bends:
            measured = {"measured_bend_rms_rad"}
        elif self.clamped:
            measured -= {"measured_com_speed_rel", "measured_yaw_rate_abs"}
        metrics: dict[str, float | None] = dict.fromkeys(MEASURED_UNITS)
        for name in measured:
            metrics[name] = self.comparison.metrics[name.removeprefix("measured_")]
        return metrics

    def signals(self) -> dict[str, np.ndarray]:
        """Return differences of shape, path, heading and bends over time, m or rad."""
        bends = {
            f"bend_{j}_rad": error
            for j, error in enumerate(self.comparison.bend_error.T, start=1)
        }
        if self.only_bends:
            return bends
        return {
            "shape_m": self.comparison.shape_error,
            "path_m": self.comparison.path_error,
            "heading_rad": self.comparison.heading_error,
            **bends,
        }

    @property
    def bend_rms(self) -> np.ndarray:
        """RMS of the bend differences over all segments, shape (T,), rad."""
        return np.asarray(np.sqrt((self.comparison.bend_error**2).mean(axis=1)))

    def document(self) -> dict[str, object]:
        """Return the RMS differences over the whole run and in equal time intervals."""
        time = self.comparison.time
        count = min(_MAX_INTERVALS, len(time))
        edges = np.linspace(0, len(time), count + 1).round().astype(int)
        intervals = list(pairwise(edges))
        signals = self.signals()
        return {
            "rms": {name: rms(values) for name, values in signals.items()},
            "over_time": {
                "time_s": [round(float(time[a:b].mean()), 6) for a, b in intervals],
                **{
                    name: [rms(values[a:b]) for a, b in intervals]
                    for name, values in signals.items()
                },
            },
        }


MEASURES = {
    "com_speed_m_s": ("CoM speed", "m/s"),
    "yaw_rate_rad_s": ("yaw rate", "rad/s"),
    "mean_bend_amplitude_rad": ("bend amplitude", "rad"),
    "shape_rms_m": ("body shape, RMS", "m"),
}
"""Measures of the difference between the plants, with title and unit.

The first three measures are differences (twin − analytical) of plant metrics. The last
measure is the RMS distance between the body shapes.
"""


@dataclass(frozen=True)
class AssumptionShare:
    """Contribution of one assumption to the difference between the plants.

    Attributes:
        name: short name of the assumption.
        title: one-line description of the assumption.
        value: contribution to each measure, in the order of `MEASURES`.
        low: minimum contribution over all orders of switching the assumptions.
        high: maximum contribution over all orders of switching the assumptions.
        how: "averaged" if the contribution is the mean over all orders, "first" if the
            assumption is switched first, or "refined" if only one plant makes the
            assumption.
    """

    name: str
    title: str
    value: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    how: str


@dataclass(frozen=True)
class Attribution:
    """Contributions of assumptions to the difference between twin and analytical model.

    The contributions and the remainder add up to the difference.

    Attributes:
        reference: value of each measure for the analytical model, whose shape distance
            is 0.
        gap: difference between the plants (twin − analytical) for each measure.
        remainder: unexplained part of the difference.
        matched: difference that remains if both plants have stiff bends and equal
            friction at the same points.
        same: assumptions that both plants share.
        shares: contributions of the assumptions.
        window_s: duration of the attributed part from the start of the runs, s, or None
            if the whole runs are attributed.
        damping: change of `gap` if the damping time of the twin is at a bound of the
            95 % interval, keyed by bound.
    """

    reference: tuple[float, ...]
    gap: tuple[float, ...]
    remainder: tuple[float, ...]
    matched: tuple[float, ...]
    same: tuple[str, ...]
    shares: tuple[AssumptionShare, ...]
    window_s: float | None = None
    damping: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    @property
    def extent(self) -> str:
        """Description of the attributed part, or an empty string for whole runs."""
        if self.window_s is None:
            return ""
        return f"first {self.window_s:g} s of the runs"

    def document(self) -> dict[str, object]:
        """Return the attribution as it is stored in metrics.json."""
        return {"measures": tuple(MEASURES), **asdict(self)}


def gap_between(reference: Trajectory, candidate: Trajectory) -> np.ndarray:
    """Return candidate − reference for each of `MEASURES`, shape (4,).

    Raises:
        InputError: the runs cannot be compared.
        ValueError: one of the runs has no gait metrics.
    """
    before = plant_metrics(reference)
    after = plant_metrics(candidate)
    names = list(MEASURES)[:-1]
    if any(metrics[name] is None for metrics in (before, after) for name in names):
        raise ValueError(
            "the difference cannot be attributed, because the run has no whole gait"
            " period"
        )
    shape = compare(reference, candidate).metrics["shape_rms_m"]
    return np.array([*(after[name] - before[name] for name in names), shape])
