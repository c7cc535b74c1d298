"""Differences between runs: of two plants, of a plant from what was measured, and what explains them.

`compare` says how far two runs under the same valve commands lie apart. `MeasuredDifference` is that of a
plant from what was measured of the robot, by signal, over time. `Attribution` splits the gap between the
plants into the shares of the assumptions in which they differ.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np

from srs_twin.comparison.metrics import MEASURED_UNITS, plant_metrics
from srs_twin.comparison.sampling import body_length, interpolant, label, require, rms, segment_lengths
from srs_twin.errors import InputError
from srs_twin.trajectory import Shown, Trajectory

# Times closer than this are the same.
_ROUNDING_S = 1e-9


@dataclass(frozen=True)
class Comparison(Shown):
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

    page: ClassVar[str] = "comparison"

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
    (our_com, our_heading, ours, our_bend), (com, heading, theirs, bend) = (
        _sampled(each, time) for each in (reference, candidate)
    )

    # Whole turns between two unwrapped headings say where counting began, not where the snakes point.
    heading_error = heading - our_heading
    heading_error -= 2 * np.pi * np.round(heading_error[0] / (2 * np.pi))
    apart = in_body_frame(theirs, com, heading) - in_body_frame(ours, our_com, our_heading)
    distance = np.linalg.norm(apart, axis=-1)
    path_error = np.linalg.norm(com - our_com, axis=-1)
    bend_error = bend - our_bend
    metrics = {
        **_gait_differences(reference, candidate, _gap_factor(reference, candidate) if gap_factor else 1.0),
        "shape_rms_m": rms(distance),
        "shape_rms_body": rms(distance) / body_length(reference),
        "path_rms_m": rms(path_error),
        "bend_rms_rad": rms(bend_error),
        "bend_rms_rel": _ratio(rms(bend_error), rms(our_bend)),
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


def _sampled(run: Trajectory, time: np.ndarray) -> list[np.ndarray]:
    """Return centre of mass (T, 2), heading (T,), positions (T, N, 2) and bends of a run at given times."""
    signals = [run.com, run["heading"], run.position, run.stack("bend")]
    if len(run) == len(time) and np.allclose(run.time, time, rtol=0, atol=_ROUNDING_S):
        return signals
    return [interpolant(run, values)(time) for values in signals]


def _same_connectors(reference: Trajectory, candidate: Trajectory) -> None:
    counts = []
    for run in (reference, candidate):
        x, y, bend = (run.stack(name).shape[-1] for name in ("x", "y", "bend"))
        if not x == y == bend + 1:
            raise InputError(
                f"{label(run)}: {x} columns x_1…, {y} y_1… and {bend} bend_1…; "
                "a snake of N connectors has N, N and N − 1"
            )
        counts.append(x)
    if counts[0] != counts[1]:
        raise InputError(
            f"{label(reference)} has {counts[0]} connectors and {label(candidate)} {counts[1]}; "
            "only bodies with equally many can be compared"
        )


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


_PREFIX = "measured_"
_BEND_METRICS = {"measured_bend_rms_rad"}
_TRAVEL_METRICS = {"measured_com_speed_rel", "measured_yaw_rate_abs"}
_MOST_ROWS = 50


@dataclass(frozen=True)
class MeasuredDifference:
    """A plant's difference from a measured motion.

    Attributes:
        comparison: plant less measured, see `compare`.
        only_bends: whether nothing but bends was measured; where the body is follows from them then.
        held: whether both were held at the head, so that nothing went anywhere.
    """

    comparison: Comparison
    only_bends: bool = False
    held: bool = False

    @classmethod
    def of(cls, measured: Trajectory, run: Trajectory) -> MeasuredDifference:
        """Compare a plant with what was measured, at the times of the latter.

        Raises:
            InputError: as `compare`.
        """
        only_bends = bool(measured.metadata.get("bends_only"))
        return cls(compare(measured, run), only_bends, run.metadata.get("base") == "clamped")

    @property
    def metrics(self) -> dict[str, float | None]:
        """Metrics of the plant, by the names in `MEASURED_UNITS`; None what was not measured."""
        known = MEASURED_UNITS.keys() - (_TRAVEL_METRICS if self.held else set())
        known = _BEND_METRICS if self.only_bends else known
        found = self.comparison.metrics
        return {name: found[name.removeprefix(_PREFIX)] if name in known else None for name in MEASURED_UNITS}

    def signals(self) -> dict[str, np.ndarray]:
        """Return the differences over time: shape and path as distances (m), heading, bends (rad)."""
        bends = {f"bend_{j}_rad": each for j, each in enumerate(self.comparison.bend_error.T, start=1)}
        if self.only_bends:
            return bends
        distances = {"shape_m": self.comparison.shape_error, "path_m": self.comparison.path_error}
        return distances | {"heading_rad": self.comparison.heading_error} | bends

    @property
    def bend_rms(self) -> np.ndarray:
        """Root mean square over the segments of the bends' difference at each instant, (T,), rad."""
        return np.asarray(np.sqrt((self.comparison.bend_error**2).mean(axis=1)))

    def document(self) -> dict[str, Any]:
        """Return what metrics.json says: of each signal the RMS as a whole and in equal parts of the time."""
        time = self.comparison.time
        edges = np.linspace(0, len(time), min(_MOST_ROWS, len(time)) + 1).round().astype(int)
        parts = list(zip(edges[:-1], edges[1:], strict=True))
        signals = self.signals()
        return {
            "rms": {name: rms(values) for name, values in signals.items()},
            "over_time": {
                "time_s": [round(float(time[a:b].mean()), 6) for a, b in parts],
                **{name: [rms(values[a:b]) for a, b in parts] for name, values in signals.items()},
            },
        }


MEASURES = {
    "com_speed_m_s": ("CoM speed", "m/s"),
    "yaw_rate_rad_s": ("yaw rate", "rad/s"),
    "mean_bend_amplitude_rad": ("bend amplitude", "rad"),
    "shape_rms_m": ("body shape, RMS", "m"),
}
"""What is attributed: differences twin − analytical of three metrics, and the distance of the body shapes."""


@dataclass(frozen=True)
class Share:
    """What one assumption contributes to the gap.

    Attributes:
        name: short name.
        title: one line for people.
        value: contribution to each of `MEASURES`, in that order.
        low: least of it over the orders in which the assumptions may be switched.
        high: most of it.
        how: "averaged" over orders on the analytical side, "first" of all there, or "refined" on the plant
            that alone has it.
    """

    name: str
    title: str
    value: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    how: str


@dataclass(frozen=True)
class Attribution:
    """A gap between twin and analytical model, split.

    Attributes:
        reference: the analytical values of `MEASURES`; 0 for the distance.
        gap: twin − analytical.
        remainder: what is not explained by any of them.
        matched: gap that is left when both plants have stiff bends and the same friction at the same points.
        same: assumptions on which the two plants agree in this scenario, so that they explain nothing.
        shares: what is explained; their values and the remainder add up to the gap.
    """

    reference: tuple[float, ...]
    gap: tuple[float, ...]
    remainder: tuple[float, ...]
    matched: tuple[float, ...]
    same: tuple[str, ...]
    shares: tuple[Share, ...]

    def document(self) -> dict[str, Any]:
        """Return plain data for metrics.json, measures by name."""
        return {"measures": tuple(MEASURES), **asdict(self)}


def gap_between(reference: Trajectory, candidate: Trajectory) -> np.ndarray:
    """Return candidate − reference in `MEASURES`, shape (4,).

    Raises:
        InputError: as in `compare`.
        ValueError: one of the runs has no gait metrics.
    """
    ours, theirs = plant_metrics(reference), plant_metrics(candidate)
    names = list(MEASURES)[:-1]
    if any(run[name] is None for run in (ours, theirs) for name in names):
        raise ValueError("a run without whole gait periods has no gait to explain")
    differences = [theirs[name] - ours[name] for name in names]
    return np.array([*differences, compare(reference, candidate).metrics["shape_rms_m"]])
