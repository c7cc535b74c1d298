"""LogSummary: what was read from a recording, filled, rejected, swapped and corrected."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class LogSummary:
    """Nothing is silently dropped: each sample that was read is kept or counted here.

    Attributes:
        source: name of the file.
        sha256: of the file.
        kind: "Motive CSV 1.21" or "plain CSV".
        frames_read: rows of the file that were used.
        header_frames: how many the header announces; None where it does not.
        frames_missing: frames put in because the file skips them.
        rate_hz: frames a second.
        columns: of positions in the file.
        layout: "single", "head" or "pair".
        head: how the head was found.
        up: axis of the file that points up.
        samples_seen: positions in the file.
        samples_other: of these, off the robot: reflections, other markers, pieces that fit nowhere.
        samples_rejected: of these, outliers.
        samples_filled: positions filled in, in the frames that are kept.
        longest_filled_s: the longest gap that was filled, s; from the sample before it to the one after.
        moves: how often a marker went on in another column.
        frames_kept: frames of the trajectory.
        start, end: their times, s.
        spacing_m: largest distance of neighbouring connectors, head first, m.
        residual_m: root mean square of what segments were longer than their bends allow, m.
        corrections: all else that was changed or assumed, in words.
    """

    source: str
    sha256: str
    kind: str
    frames_read: int
    header_frames: int | None
    frames_missing: int
    rate_hz: float
    columns: int
    layout: str
    head: str
    up: str
    samples_seen: int
    samples_other: int
    samples_rejected: int
    samples_filled: int
    longest_filled_s: float
    moves: int
    frames_kept: int
    start: float
    end: float
    spacing_m: tuple[float, ...]
    residual_m: float
    corrections: tuple[str, ...]

    def text(self) -> str:
        """Return it for people, one fact a line."""
        announced = ""
        if self.header_frames is not None and self.header_frames != self.frames_read:
            announced = f", where the header says {self.header_frames}"
        spacing = ", ".join(f"{1e3 * each:.1f}" for each in self.spacing_m)
        cut = self.frames_read + self.frames_missing - self.frames_kept
        lines = [
            f"{self.source}: {self.kind}, SHA-256 {self.sha256[:16]}…",
            f"read: {self.frames_read} frames{announced}, {self.columns} columns of positions, "
            f"{self.rate_hz:.4g} Hz, {self.samples_seen} positions",
            f"markers: layout {self.layout}; head: {self.head}; up: {self.up}",
            f"went on in another column: {self.moves} times",
            f"rejected: {self.samples_rejected} outliers, {self.samples_other} positions of nothing on the "
            "robot",
            f"filled: {self.samples_filled} positions, the longest gap {self.longest_filled_s:.3g} s",
            f"kept: {self.frames_kept} frames, {self.start:.4g} s to {self.end:.4g} s, {cut} left out at the "
            "ends",
            f"neighbouring connectors come as far as {spacing} mm apart; chords fit the bends within "
            f"{1e3 * self.residual_m:.2g} mm",
        ]
        return "\n".join([*lines, *(f"corrected: {each}" for each in self.corrections)])


@dataclass(frozen=True)
class BendSummary:
    """What was read of a bend log, filled and corrected.

    Attributes:
        source: name of the file.
        sha256: of the file.
        rows_read: rows of the file.
        rate_hz: rows a second.
        samples_filled: bends filled in, in the rows that are kept.
        frames_kept: rows of the trajectory.
        start, end: their times, s.
        corrections: all else that was changed or assumed, in words.
    """

    source: str
    sha256: str
    rows_read: int
    rate_hz: float
    samples_filled: int
    frames_kept: int
    start: float
    end: float
    corrections: tuple[str, ...]

    def text(self) -> str:
        """Return it for people, one fact a line."""
        cut = self.rows_read - self.frames_kept
        lines = [
            f"{self.source}: bend log, SHA-256 {self.sha256[:16]}…",
            f"read: {self.rows_read} rows, {self.rate_hz:.4g} Hz",
            f"filled: {self.samples_filled} bends",
            f"kept: {self.frames_kept} rows, {self.start:.4g} s to {self.end:.4g} s, {cut} left out",
        ]
        return "\n".join([*lines, *(f"corrected: {each}" for each in self.corrections)])
