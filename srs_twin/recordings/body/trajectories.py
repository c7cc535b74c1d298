r"""Columns, metadata and summary of a measured trajectory; columns have the names a plant's have.

Velocity is the slope of a moving line (Section 3.4.1), the least-squares line through a sample and n before
and after it, n = 5 in the text,

$$ v_k = \frac{\sum_m (t_m - \bar t)(y_m - \bar y)}{\sum_m (t_m - \bar t)^2}, \qquad m = k-n \ldots k+n. $$

It does not lag. Of an oscillation with angular frequency ω it keeps

$$ \frac{3 \sum_{m=1}^{n} m \sin(m \omega \Delta t)}{n (n + 1)(n + \tfrac12)\, \omega \Delta t}, $$

at 120 Hz 97 % of 2 Hz; at the text's 15 frames a second nothing of it, and 82 % of 0.6 Hz.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from srs_twin.recordings.body.markers import CapturedMarkers, TrackedBody
from srs_twin.recordings.csv_table import RecordedFile
from srs_twin.recordings.marker_table import MarkerTable
from srs_twin.recordings.signals.gaps import FrameGrid
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Trajectory


@dataclass(frozen=True)
class MarkerCounts:
    """What became of the markers of a captured motion.

    Attributes:
        header_frames: how many frames the header announces; None where it does not.
        frames_missing: frames put in because the file skips them.
        columns: of positions in the file.
        layout: "single", "head" or "pair".
        head: how the head was found.
        up: axis of the file that points up.
        samples_seen: positions in the file.
        samples_other: of these, off the robot: reflections, other markers, pieces that fit nowhere.
        samples_rejected: of these, outliers.
        longest_filled_s: the longest gap that was filled, s; from the sample before it to the one after.
        moves: how often a marker went on in another column.
        spacing_m: largest distance of neighbouring connectors, head first, m.
        residual_m: root mean square of the markers' distances from the body that explains them, m.
        noise_m: standard deviation of a marker's coordinate, m.
        bend_error_rad: root mean square of the bends' standard errors, rad.
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
    """Nothing is silently dropped: each sample that was read is kept or counted here.

    Attributes:
        source: name of the file.
        sha256: of the file.
        kind: "Motive CSV 1.21", "plain CSV" or "bend log".
        frames_read: rows of the file that were used.
        rate_hz: frames a second.
        samples_filled: positions, or bends, filled in, in the frames that are kept.
        frames_kept: frames of the trajectory.
        start, end: their times, s.
        corrections: all else that was changed or assumed, in words.
        markers: None of a bend log.
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
    def of(
        cls, source: MarkerTable | RecordedFile, kind: str, frames: FrameGrid, kept: slice, filled: int,
        corrections: Iterable[str], markers: MarkerCounts | None = None,
    ) -> LogSummary:  # fmt: skip
        """Return the summary of a file of which some frames are kept."""
        used, time, start = int((frames.rows >= 0).sum()), frames.time[kept], float(frames.time[kept][0])
        about = source.name, source.sha256, kind, used, 1 / frames.period, filled
        return cls(*about, len(time), start, float(time[-1]), tuple(corrections), markers)

    def text(self) -> str:
        """Return it for people, one fact a line."""
        lines = [f"{self.source}: {self.kind}, SHA-256 {self.sha256[:16]}…"]
        span = f"{self.start:.4g} s to {self.end:.4g} s"
        if (found := self.markers) is None:
            lines += [
                f"read: {self.frames_read} rows, {self.rate_hz:.4g} Hz",
                f"filled: {self.samples_filled} bends",
                f"kept: {self.frames_kept} rows, {span}, {self.frames_read - self.frames_kept} left out",
            ]
        else:
            announced = ""
            if found.header_frames not in (None, self.frames_read):
                announced = f", where the header says {found.header_frames}"
            spacing = ", ".join(f"{1e3 * each:.1f}" for each in found.spacing_m)
            cut = self.frames_read + found.frames_missing - self.frames_kept
            lines += [
                f"read: {self.frames_read} frames{announced}, {found.columns} columns of positions, "
                f"{self.rate_hz:.4g} Hz, {found.samples_seen} positions",
                f"markers: layout {found.layout}; head: {found.head}; up: {found.up}",
                f"went on in another column: {found.moves} times",
                f"rejected: {found.samples_rejected} outliers, {found.samples_other} positions of nothing on "
                "the robot",
                f"filled: {self.samples_filled} positions, the longest gap {found.longest_filled_s:.3g} s",
                f"kept: {self.frames_kept} frames, {span}, {cut} left out at the ends",
                f"neighbouring connectors come as far as {spacing} mm apart; markers lie within "
                f"{1e3 * found.residual_m:.2g} mm of the body, their noise is {1e3 * found.noise_m:.2g} mm",
                f"standard error of a bend: {found.bend_error_rad:.2g} rad",
            ]
        return "\n".join([*lines, *(f"corrected: {each}" for each in self.corrections)])


HALF_WIDTH = 5
"""n, frames before and after."""


def moving_slope(time: np.ndarray, values: np.ndarray, half_width: int = HALF_WIDTH) -> np.ndarray:
    """Return the rate of change of signals.

    Args:
        time: ascending, shape (frames,), s.
        values: finite, shape (frames, …).
        half_width: n. Near the ends the line goes through the samples there are.

    Returns:
        Shape of `values`, per second.
    """
    n, frames = half_width, len(time)
    flat = np.asarray(values, dtype=float).reshape(frames, -1)
    # Sums over windows, about the time and the value in their middle: large times cost no digits.
    sums = np.zeros((frames, 3 + 2 * flat.shape[1]))
    for shift in range(-n, n + 1):
        here = slice(max(0, -shift), frames - max(0, shift))
        there = slice(max(0, shift), frames + min(0, shift))
        t = (time[there] - time[here])[:, None]
        y = flat[there] - flat[here]
        sums[here] += np.concatenate([np.ones_like(t), t, t * t, y, t * y], axis=1)
    count, t, tt = sums[:, :1], sums[:, 1:2], sums[:, 2:3]
    y, ty = np.split(sums[:, 3:], 2, axis=1)
    return np.asarray((ty - t * y / count) / (tt - t * t / count)).reshape(np.shape(values))


_UNITS = {"com_velocity_": "m/s", "yaw_rate": "rad/s", "residual": "m", "bend_rate_": "rad/s"}
_UNITS |= {"bend_error_": "rad", "length_": "m"}
"""Beginnings of names of columns that no plant has → unit."""

MEASURED = "measured"
"""Stands for the plant in the metadata."""


def body_trajectory(
    body: TrackedBody,
    markers: CapturedMarkers,
    spec: RobotSpec,
    summary: LogSummary,
    gait_frequency_hz: float | None,
) -> Trajectory:
    """Return a captured body over time as a trajectory; its masses give the centre of mass."""
    share = spec.mass.array() / spec.mass.total
    com = np.einsum("i,fij->fj", share, body.position)
    heading = body.theta.mean(axis=1)
    rates = moving_slope(markers.time, np.column_stack([com, heading, body.bend]))
    columns = {
        "time": markers.time,
        **pose_columns(com @ [1, 1j], heading, body.position @ [1, 1j], body.theta),
        **numbered("bend", body.bend),
        "com_velocity_x": rates[:, 0],
        "com_velocity_y": rates[:, 1],
        "yaw_rate": rates[:, 2],
        **numbered("bend_rate", rates[:, 3:]),
        **numbered("bend_error", body.shape.bend_error),
        **numbered("length", body.shape.length),
        **numbered("filled", body.missing.astype(float)),
        "residual": body.shape.residual,
    }
    return measured(columns, spec, summary, gait_frequency_hz)


def pose_columns(
    com: np.ndarray, heading: np.ndarray, place: np.ndarray, theta: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the columns that say where a body is.

    Args:
        com: x + i y of the centre of mass, shape (frames,), m.
        heading: of the body, same shape, rad.
        place: x + i y of the connectors, shape (frames, N), m.
        theta: their headings, same shape, rad.
    """
    centre = {"com_x": com.real, "com_y": com.imag, "heading": heading}
    return centre | numbered("x", place.real) | numbered("y", place.imag) | numbered("theta", theta)


def numbered(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of a (frames, n) array as name_1…name_n."""
    return {f"{name}_{i}": np.ascontiguousarray(column) for i, column in enumerate(values.T, start=1)}


def measured(
    columns: Mapping[str, np.ndarray], spec: RobotSpec, summary: LogSummary, gait_frequency_hz: float | None
) -> Trajectory:
    """Return measured columns as a trajectory.

    Args:
        columns: by name.
        spec: the robot.
        summary: of what was read.
        gait_frequency_hz: None where it is not known.
    """
    units = {each: unit for each in columns for name, unit in _UNITS.items() if each.startswith(name)}
    source: dict[str, object] = {
        "file": summary.source.replace("\\", "/").rpartition("/")[2],
        "sha256": summary.sha256,
        "kind": summary.kind,
        "samples_filled": summary.samples_filled,
        "corrections": list(summary.corrections),
    }
    if (found := summary.markers) is not None:
        source |= {"layout": found.layout, "up": found.up, "samples_rejected": found.samples_rejected}
    geometry = spec.geometry
    about = {
        **({"bends_only": True} if found is None else {}),
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
    return Trajectory(columns, units, metadata=about)
