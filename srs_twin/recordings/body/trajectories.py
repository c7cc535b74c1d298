r"""Conversion of a tracked body to a trajectory with metadata and a summary.

The velocity v_k is the slope of a least-squares line through the samples y_m at the
times t_m of the frames around frame k (Section 3.4.1). The default is n = 5, as in the
dissertation:

$$ v_k = \frac{\sum_m (t_m - \bar t)(y_m - \bar y)}{\sum_m (t_m - \bar t)^2}, \qquad m = k-n \ldots k+n. $$

The velocity v_k has no phase lag. For an oscillation with an angular frequency of ω,
the amplitude of v_k is multiplied by the factor

$$ \frac{3 \sum_{m=1}^{n} m \sin(m \omega \Delta t)}{n (n + 1)(n + \tfrac12)\, \omega \Delta t}. $$

At 120 frames per second, the factor is 0.97 for an oscillation at 2 Hz. At 15 frames
per second, as in the dissertation, the factor is 0 at 2 Hz and 0.82 at 0.6 Hz.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from srs_twin.recordings.body.markers import CapturedMarkers, TrackedBody
from srs_twin.recordings.formats.base import MarkerTable
from srs_twin.recordings.recorded_file import RecordedFile
from srs_twin.recordings.signals.gaps import FrameGrid
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory


@dataclass(frozen=True)
class MarkerCounts:
    """Marker statistics of a recording.

    Attributes:
        header_frames: number of frames stated in the header, or None if the header
            states none.
        frames_missing: number of frames that are missing in the file and were inserted.
        samples_other: number of positions that do not belong to the robot, such as
            reflections, other markers and short tracks.
        spacing_m: 98 % quantile of each distance between adjacent connectors, m, in
            order from the head.
        residual_m: RMS distance of the markers from the fitted body, m.
        bend_error_rad: RMS standard error of the bends, rad.
    """

    header_frames: int | None
    frames_missing: int
    columns: int
    layout: str
    head: str
    up: str
    samples_seen: int
    samples_other: int
    samples_rejected: int
    longest_filled_s: float
    moves: int
    spacing_m: tuple[float, ...]
    residual_m: float
    noise_m: float
    bend_error_rad: float


@dataclass(frozen=True)
class LogSummary:
    """Summary of a measurement file with the numbers of used and unused samples.

    Attributes:
        kind: file format, for example "Motive CSV 1.21", "plain CSV" or "bend log".
        frames_read: number of rows of the file that were used.
        samples_filled: number of interpolated positions or bends in the trajectory.
        markers: marker statistics, or None for a bend log.
    """

    source: str
    sha256: str
    kind: str
    frames_read: int
    rate_hz: float
    samples_filled: int
    frames_kept: int
    start: float
    end: float
    corrections: tuple[str, ...]
    markers: MarkerCounts | None = None

    @classmethod
    def from_file(
        cls,
        source: MarkerTable | RecordedFile,
        kind: str,
        frames: FrameGrid,
        time: np.ndarray,
        filled: int,
        corrections: Iterable[str],
        markers: MarkerCounts | None = None,
    ) -> LogSummary:
        """Return the summary of a file.

        `time` contains the times (s) of the frames in the trajectory, and `filled` is
        the number of interpolated samples.
        """
        return cls(
            source.name,
            source.sha256,
            kind,
            int((frames.rows >= 0).sum()),
            1 / frames.period,
            filled,
            len(time),
            float(time[0]),
            float(time[-1]),
            tuple(corrections),
            markers,
        )

    def text(self) -> str:
        """Return the summary as text, one fact per line."""
        lines = [f"{self.source}: {self.kind}, SHA-256 {self.sha256[:16]}…"]
        span = f"{self.start:.4g} s to {self.end:.4g} s"
        if (counts := self.markers) is None:
            lines += [
                f"read: {self.frames_read} rows, {self.rate_hz:.4g} Hz",
                f"filled: {self.samples_filled} bends",
                (
                    f"kept: {self.frames_kept} rows, {span},"
                    f" {self.frames_read - self.frames_kept} left out"
                ),
            ]
        else:
            announced = ""
            if counts.header_frames not in (None, self.frames_read):
                announced = f" ({counts.header_frames} according to the header)"
            spacing = ", ".join(
                f"{1e3 * distance:.1f}" for distance in counts.spacing_m
            )
            cut = self.frames_read + counts.frames_missing - self.frames_kept
            lines += [
                (
                    f"read: {self.frames_read} frames{announced}, {counts.columns}"
                    f" columns of positions, {self.rate_hz:.4g} Hz,"
                    f" {counts.samples_seen} positions"
                ),
                (
                    f"markers: layout {counts.layout}; head: {counts.head}; up:"
                    f" {counts.up}"
                ),
                f"column changes: {counts.moves}",
                (
                    f"rejected: {counts.samples_rejected} outliers,"
                    f" {counts.samples_other} positions that do not belong to the robot"
                ),
                (
                    f"filled: {self.samples_filled} positions, longest gap"
                    f" {counts.longest_filled_s:.3g} s"
                ),
                f"kept: {self.frames_kept} frames, {span}, {cut} left out at the ends",
                (
                    f"distances of adjacent connectors (98 % quantile): {spacing} mm;"
                    " distance of the markers from the body"
                    f" {1e3 * counts.residual_m:.2g} mm RMS, noise"
                    f" {1e3 * counts.noise_m:.2g} mm"
                ),
                f"standard error of a bend: {counts.bend_error_rad:.2g} rad",
            ]
        return "\n".join([*lines, *(f"corrected: {text}" for text in self.corrections)])


HALF_WIDTH = 5
"""Number n of frames on each side of a sample in the line fit."""


def moving_derivative(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return time derivatives as the slopes of fitted lines.

    Each line is fitted to a sample and its `HALF_WIDTH` neighbours on each side, or to
    fewer neighbours near the ends of the signal.
    """
    frames = len(time)
    flat = np.asarray(values, dtype=float).reshape(frames, -1)
    # Times and values are relative to the middle sample, so that large times cause no
    # rounding errors.
    sums = np.zeros((frames, 3 + 2 * flat.shape[1]))
    for shift in range(-HALF_WIDTH, HALF_WIDTH + 1):
        middle = slice(max(0, -shift), frames - max(0, shift))
        shifted = slice(max(0, shift), frames + min(0, shift))
        t = (time[shifted] - time[middle])[:, None]
        y = flat[shifted] - flat[middle]
        sums[middle] += np.concatenate([np.ones_like(t), t, t * t, y, t * y], axis=1)
    count = sums[:, :1]
    t = sums[:, 1:2]
    tt = sums[:, 2:3]
    y, ty = np.split(sums[:, 3:], 2, axis=1)
    return np.asarray((ty - t * y / count) / (tt - t * t / count)).reshape(
        np.shape(values)
    )


_UNITS = {
    "com_velocity_": "m/s",
    "yaw_rate": "rad/s",
    "residual": "m",
    "bend_rate_": "rad/s",
    "bend_error_": "rad",
    "length_": "m",
}
"""Units of columns that exist only in measured trajectories, keyed by name prefix."""

MEASURED = "measured"
"""Value of the key `plant` in the metadata of a measured trajectory."""


def body_trajectory(
    body: TrackedBody,
    markers: CapturedMarkers,
    spec: RobotSpec,
    summary: LogSummary,
    gait_frequency_hz: float | None,
) -> Trajectory:
    """Return the trajectory of a tracked body.

    The centre of mass is computed from the masses in `spec`.
    """
    shape = body.shape
    mass_fraction = spec.mass.array() / spec.mass.total
    position = np.stack([shape.connector.real, shape.connector.imag], axis=-1)
    com = np.einsum("i,fij->fj", mass_fraction, position)
    heading = shape.theta.mean(axis=1)
    rates = moving_derivative(markers.time, np.column_stack([com, heading, shape.bend]))
    columns = {
        "time": markers.time,
        **pose_columns(com @ [1, 1j], heading, shape.connector, shape.theta),
        **numbered_columns("bend", shape.bend),
        "com_velocity_x": rates[:, 0],
        "com_velocity_y": rates[:, 1],
        "yaw_rate": rates[:, 2],
        **numbered_columns("bend_rate", rates[:, 3:]),
        **numbered_columns("bend_error", shape.bend_error),
        **numbered_columns("length", shape.length),
        **numbered_columns("filled", body.missing.astype(float)),
        "residual": shape.residual,
    }
    return measured_trajectory(columns, spec, summary, gait_frequency_hz)


def pose_columns(
    com: np.ndarray, heading: np.ndarray, connector: np.ndarray, theta: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the pose columns of a trajectory.

    The positions `com` and `connector` are complex numbers x + iy in m. The headings
    are in rad.
    """
    return {
        "com_x": com.real,
        "com_y": com.imag,
        "heading": heading,
        **numbered_columns("x", connector.real),
        **numbered_columns("y", connector.imag),
        **numbered_columns("connector_heading", theta),
    }


def name_of(path: str) -> str:
    """Return the file name of a Windows or POSIX path."""
    return path.replace("\\", "/").rpartition("/")[2]


def numbered_columns(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of an array, shape (frames, n), as name_1 to name_n."""
    return {
        f"{name}_{i}": np.ascontiguousarray(column)
        for i, column in enumerate(values.T, start=1)
    }


def measured_trajectory(
    columns: Mapping[str, np.ndarray],
    spec: RobotSpec,
    summary: LogSummary,
    gait_frequency_hz: float | None,
) -> Trajectory:
    """Return measured columns as a trajectory with metadata."""
    units = {
        name: unit
        for name in columns
        for prefix, unit in _UNITS.items()
        if name.startswith(prefix)
    }
    source: dict[str, object] = {
        "file": name_of(summary.source),
        "sha256": summary.sha256,
        "kind": summary.kind,
        "samples_filled": summary.samples_filled,
        "corrections": list(summary.corrections),
    }
    if (counts := summary.markers) is not None:
        source |= {
            "layout": counts.layout,
            "up": counts.up,
            "samples_rejected": counts.samples_rejected,
        }
    geometry = spec.geometry
    metadata = {
        "plant": MEASURED,
        "robot": spec.name,
        "record_hz": summary.rate_hz,
        "duration_s": summary.end - summary.start,
        "body_length_m": geometry.body_length,
        "segment_length_m": geometry.segment_length,
        "rigid_gap_m": geometry.rigid_gap,
        "mass_kg": spec.mass.total,
        "gait_frequency_hz": gait_frequency_hz,
        "velocity_half_width": HALF_WIDTH,
        "source": source,
    }
    if counts is None:
        metadata["bends_only"] = True
    return Trajectory(columns, units, metadata=metadata)
