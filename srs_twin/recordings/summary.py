"""LogSummary: what was read from a recording, filled, rejected, swapped and corrected."""

from __future__ import annotations

from dataclasses import dataclass


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
