r"""Lateral undulation driven by a square wave of valve states (Eq. 13).

$$ S_j = \operatorname{sign}\bigl(\sin(2\pi f t - \beta (j-1) + \psi) + \varphi\bigr) $$

In this equation, f is the gait frequency, β the phase lag per segment, ψ the phase and
φ the steering offset. If S_j = +1, the + chamber of segment j fills and the − chamber
vents. If S_j = −1, the + chamber vents and the − chamber fills. The sign of 0 is +1.
The wave travels from head to tail and propels the snake forward. As printed in the
dissertation, Eq. 13 describes a wave in the opposite direction (E12). A positive φ
turns the snake to the left. A gait with offset −φ and phase ψ + π is the mirror image
of the original gait.

Two extensions of the wave are not part of the dissertation. Each segment may have an
additional phase lag α_j. Both chambers of a segment may vent for a fraction r of the
period, around the sign changes of the wave:

$$ S_j = 0 \quad \text{where} \quad
   |\sin(2\pi f t - \beta (j-1) + \psi - \alpha_j) + \varphi| < \sin(\pi r/2). $$

**Spatial robots.** A second wave, called the pitch wave, bends the segments upwards and
downwards. The frequency of the pitch wave is ρ times the gait frequency, and its phase
lag is λ:

$$ P_j = \operatorname{sign}
   \sin\bigl(\rho\,(2\pi f t - \beta (j-1) + \psi - \alpha_j) - \lambda\bigr) . $$

Because a valve cannot open partially, the amplitude of a wave is reduced by a rest, in
which the wave is 0. If the wave rests for a fraction r of each period, its fundamental
component is multiplied by cos(π r/2).

The pitch fraction s, from 0 to 1, is the amplitude of the pitch wave divided by the sum
of both wave amplitudes. For s < 1/2, the lateral wave has amplitude 1, and the pitch
wave has amplitude s/(1 − s). For s > 1/2, the pitch wave has amplitude 1, and the
lateral wave has amplitude (1 − s)/s. Chamber c, which bends the segment in the
direction d_c, fills while d_c · (S_j, P_j) > 0 and vents otherwise.

| gait | pitch wave |
|---|---|
| sidewinding | λ = π/2 for motion to the right of the heading, −π/2 to the left |
| rectilinear crawling | s = 1, so that the wave is vertical |
| sinus-lifting | ρ = 2, so that the body lifts where its curvature is largest |
| rolling | β = 0, s = 1/2 and λ = ± π/2, so that the body rolls about its own axis |
| lifted head | any pitch wave with lifted segments, which always bend upwards |
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from srs_twin.compute.arrays import check_positive
from srs_twin.control.base import Controller
from srs_twin.errors import InputError
from srs_twin.io.arguments import checked
from srs_twin.plants.base import SnakeState
from srs_twin.pneumatics.valves import Schedule, count_slots
from srs_twin.robot.spec import RobotSpec

_BLOCK = 20_000
"""Approximate number of time slots that are evaluated at once to limit memory use."""


@dataclass(frozen=True)
class PitchWave:
    """Wave that bends the segments of a spatial robot upwards and downwards.

    Attributes:
        fraction: pitch fraction s, from 0 for a lateral wave to 1 for a vertical wave,
            dimensionless.
        lag_rad: phase lag λ of the pitch wave behind the lateral wave, rad.
        frequency_ratio: frequency of the pitch wave divided by the gait frequency (ρ),
            above 0, dimensionless.
        lifted_segments: number of segments at the head that always bend upwards.
    """

    fraction: float = 0.5
    lag_rad: float = math.pi / 2
    frequency_ratio: float = 1.0
    lifted_segments: int = 0

    def __post_init__(self) -> None:
        if not 0 <= self.fraction <= 1:
            raise InputError(
                f"pitch fraction {self.fraction!r} is not allowed; it must be between"
                " 0 and 1"
            )
        if not math.isfinite(self.lag_rad):
            raise InputError(
                f"pitch lag {self.lag_rad!r} is not allowed; it must be finite"
            )
        check_positive("pitch frequency ratio", self.frequency_ratio, "1")
        if self.lifted_segments < 0:
            raise InputError(
                f"{self.lifted_segments} lifted segments are not allowed; use 0 or more"
            )

    def check(self, spec: RobotSpec) -> None:
        """Check that a robot can perform the pitch wave.

        Raises:
            InputError: the robot is not spatial, or has fewer segments than
                `lifted_segments`.
        """
        if not spec.is_spatial:
            raise InputError(
                f"a gait with pitch needs a spatial robot, but '{spec.name}' bends"
                " in one plane; use a spatial robot, or a gait without pitch"
            )
        if self.lifted_segments > spec.segments:
            raise InputError(
                f"{self.lifted_segments} lifted segments are not allowed;"
                f" {spec.name} has only {spec.segments} segments"
            )

    @property
    def rest_levels(self) -> tuple[float, float]:
        """Rest levels sin(π r/2) of the lateral wave and the pitch wave."""
        ratio = self.fraction / (1 - self.fraction) if self.fraction < 1 else math.inf
        left = 1 / max(ratio, 1.0)
        up = min(ratio, 1.0)
        return _rest_level(left), _rest_level(up)


def _rest_level(amplitude: float) -> float:
    return math.sqrt(1 - amplitude**2)


class Gait(Controller):
    """Open-loop gait with a square wave of valve states (Eq. 13).

    Attributes:
        frequency: gait frequency f, which `change_frequency` changes during a run, Hz.
        offset: steering offset φ, between −1 and 1, which may be changed during a run.
        phase: phase ψ at time 0, rad.
        phase_lag: phase lag β (j − 1) − ψ + α_j of each segment after `reset`, shape
            (segments,), rad.
    """

    kind = "gait"
    state_attributes: ClassVar[tuple[str, ...]] = ("frequency", "_offset", "phase_lag")
    frequency: float
    phase_lag: np.ndarray
    layouts: tuple[str, ...] = ("3/2", "in_out")
    spatial = True

    @checked
    def __init__(
        self,
        frequency: float,
        offset: float = 0.0,
        *,
        phase: float = 0.0,
        phase_step: float | None = None,
        phases: Sequence[float] | None = None,
        rest_fraction: float | None = None,
        pitch: PitchWave | None = None,
    ) -> None:
        """Create the gait.

        Args:
            frequency: gait frequency f, Hz.
            offset: steering offset φ, between −1 and 1, positive to the left.
            phase: phase ψ at time 0, rad.
            phase_step: phase lag β per segment, by default `RobotSpec.phase_step`, rad.
            phases: additional phase lag α_j of each segment, by default 0, rad.
            rest_fraction: fraction r of the period in which both chambers of a segment
                vent, at least 0 and below 1, by default 0.
            pitch: pitch wave of a spatial robot, or None for a gait without pitch.

        Raises:
            InputError: an argument is out of range, or a rest fraction above 0 is given
                together with a pitch wave.
        """
        rest_fraction = rest_fraction or 0.0
        if not 0 <= rest_fraction < 1:
            raise InputError(
                f"gait `rest_fraction` {rest_fraction!r} is not allowed; it must be at"
                " least 0 and below 1"
            )
        self.frequency = _checked_frequency(frequency)
        self.offset = offset
        self.phase = phase
        self._phase_step = phase_step
        self._phases = phases or ()
        self.rest_level = math.sin(math.pi / 2 * rest_fraction)
        if pitch is not None and rest_fraction:
            raise InputError(
                "`rest_fraction` is not allowed for a gait with a pitch wave, because"
                " the pitch fraction sets how long the gait rests; remove"
                " `rest_fraction`"
            )
        self.pitch = pitch

    @property
    def offset(self) -> float:
        """Steering offset φ, positive to the left."""
        return self._offset

    @offset.setter
    def offset(self, value: float) -> None:
        if not abs(value) < 1:
            raise InputError(
                f"gait offset {value!r} is not allowed; it must be between -1 and 1"
            )
        self._offset = float(value)

    def change_frequency(self, frequency: float, time: float) -> None:
        """Change the frequency without a jump in the phase of the wave.

        Args:
            frequency: new gait frequency f, Hz.
            time: time at which the frequency changes, s.

        Raises:
            InputError: the frequency is not above 0.
        """
        change = 2 * math.pi * (_checked_frequency(frequency) - self.frequency) * time
        self.phase_lag = self.phase_lag + change
        self.frequency = frequency

    def set_phase_step(self, step: float) -> None:
        """Set the phase lag β (rad) between adjacent segments."""
        self.phase_lag = step * np.arange(self._segments) - self.phase
        if self._phases:
            self.phase_lag = self.phase_lag + np.asarray(self._phases)

    def angle(self, time: float) -> float:
        """Return the phase angle (rad) of the first segment's wave at a time (s)."""
        return 2 * math.pi * self.frequency * time - float(self.phase_lag[0])

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: the number of additional phase lags differs from the number of
                segments, or the robot cannot perform the pitch wave.
        """
        if len(self._phases) not in (0, spec.segments):
            raise InputError(
                f"{len(self._phases)} phases are given, but {spec.name} has"
                f" {spec.segments} segments; give one phase for each segment"
            )
        if self.pitch is not None:
            self.pitch.check(spec)
        self._axes = spec.chamber.axes if spec.is_spatial else None
        slots = count_slots(tick, spec.scale)
        self._segments = spec.segments
        step = spec.phase_step if self._phase_step is None else self._phase_step
        self.set_phase_step(step)
        self._slot_centres = (np.arange(slots) + 0.5) / slots
        self._tick = tick

    def step(self, state: SnakeState) -> np.ndarray:
        """See `Controller.step`."""
        return self.valves_at(float(state.time))

    def valves_at(self, time: float) -> np.ndarray:
        """Return the valve states for the control tick that begins at `time` (s)."""
        times = time + self._tick * self._slot_centres
        if self._axes is not None:
            return self._spatial_valves(times)
        first, last = self._wave(times[[0, -1]])
        # A tick that is shorter than the shortest constant section of the wave contains
        # at most one change. If the states at both ends of such a tick are equal, they
        # do not change within the tick.
        if self._tick < self._shortest_level() and (first == last).all():
            return _antagonistic(first)
        wave = self._wave(times)
        if (wave == wave[0]).all():
            wave = wave[0]
        return _antagonistic(wave)

    def script(self, duration: float) -> Schedule:
        """See `Controller.script`."""
        slot = self._tick / len(self._slot_centres)
        count = round(duration / slot)
        if self._axes is not None:
            blocks = np.array_split(
                slot * (np.arange(count) + 0.5), max(1, count // _BLOCK)
            )
            return Schedule.from_slots(
                np.concatenate([self._spatial_valves(b) for b in blocks]), duration
            )
        if self._shortest_level() < 2 * slot:
            return Schedule.from_slots(
                _antagonistic(self._wave(slot * (np.arange(count) + 0.5))), duration
            )
        # Evaluate the wave only in the three slots around each change, because rounding
        # may shift the change by one slot.
        period = 1 / self.frequency
        up, down = self._crossings()
        angles = [-up, math.pi + up]
        if self.rest_level:
            angles += [-down, math.pi + down]
        phases = np.add.outer(self.phase_lag, angles).ravel() / (2 * math.pi) * period
        numbers = np.arange(
            math.floor(-phases.max() / period), math.ceil(duration / period) + 1
        )
        edges = np.ceil(np.add.outer(phases, period * numbers).ravel() / slot - 0.5)
        near = np.add.outer(edges, [-1, 0, 1]).ravel()
        begins = np.unique(np.append(near[(near > 0) & (near < count)], 0)).astype(int)
        wave = self._wave(slot * (begins + 0.5))
        keep = np.append(True, (wave[1:] != wave[:-1]).any(axis=1))
        return Schedule(duration, slot * begins[keep], _antagonistic(wave[keep]))

    def _spatial_valves(self, time: np.ndarray) -> np.ndarray:
        assert self._axes is not None
        angle = 2 * math.pi * self.frequency * time[:, None] - self.phase_lag
        if self.pitch is None:
            pitch = PitchWave(fraction=0.0)
            rest_left = self.rest_level
            rest_up = 1.0
        else:
            pitch = self.pitch
            rest_left, rest_up = pitch.rest_levels
        left = _three_levels(np.sin(angle) + self._offset, rest_left)
        up = _three_levels(
            np.sin(pitch.frequency_ratio * angle - pitch.lag_rad), rest_up
        )
        left[:, : pitch.lifted_segments] = 0
        up[:, : pitch.lifted_segments] = 1
        push = left[..., None] * self._axes[:, 0] + up[..., None] * self._axes[:, 1]
        return np.where(push > 1e-9, 1, -1).astype(np.int8)

    def signals(self) -> dict[str, float]:
        """Return the steering offset φ."""
        return {"offset": self._offset}

    def _shortest_level(self) -> float:
        up, down = self._crossings()
        angles = [math.pi + 2 * up, math.pi - 2 * down, down - up]
        shortest = min(angle for angle in angles if angle > 0)
        return shortest / (2 * math.pi * self.frequency)

    def _crossings(self) -> tuple[float, float]:
        """Return the negated phase angles (rad) at which S reaches 1 and leaves −1."""
        up = math.asin(max(self._offset - self.rest_level, -1.0))
        down = math.asin(min(self._offset + self.rest_level, 1.0))
        return up, down

    def _wave(self, time: np.ndarray) -> np.ndarray:
        value = (
            np.sin(2 * math.pi * self.frequency * time[:, None] - self.phase_lag)
            + self._offset
        )
        return _three_levels(value, self.rest_level).astype(np.int8)


def _three_levels(value: np.ndarray, rest: float) -> np.ndarray:
    """Return the sign of each value, or 0 if its magnitude is below the rest level."""
    # The tolerance makes the sign of a value of 0 independent of rounding errors.
    low = -rest - 1e-12
    high = rest - 1e-12
    if rest >= 1:
        high = rest + 1e-12  # A wave that only touches this level rests.
    below_high = np.where(value >= low, 0, -1) if rest else -1
    return np.where(value >= high, 1, below_high)


def _checked_frequency(frequency: float) -> float:
    check_positive("gait frequency", frequency, "Hz")
    return frequency


def _antagonistic(wave: np.ndarray) -> np.ndarray:
    return np.stack([2 * (wave > 0) - 1, 2 * (wave < 0) - 1], axis=-1).astype(np.int8)
