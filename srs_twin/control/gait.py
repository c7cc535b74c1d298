r"""Lateral undulation driven by a square wave of valve states (Eq. 13).

$$ S_j = \operatorname{sign}\bigl(\sin(2\pi f t - \beta (j-1) + \psi) + \varphi\bigr) $$

Here f is the gait frequency, β the phase lag per segment, ψ the phase and φ the
steering offset. S_j = +1 fills the + chamber of segment j and vents the − chamber. S_j
= −1 vents the + chamber and fills the − chamber. The sign of 0 is +1. The wave travels
from head to tail and propels the snake forward. As printed, the wave of Eq. 13 travels
in the opposite direction (E12). A positive φ turns the snake to the left. The mirror
image of a gait has offset −φ and phase ψ + π.

The wave has two extensions that are not part of the dissertation. Each segment may have
an additional phase lag α_j. Both chambers may vent for a fraction r of the period,
centred at the sign changes of the wave:

$$ S_j = 0 \quad \text{where} \quad
   |\sin(2\pi f t - \beta (j-1) + \psi - \alpha_j) + \varphi| < \sin(\pi r/2). $$

**Spatial robots** have a second wave, the pitch wave, which bends the segments upwards
and downwards. The pitch wave has ρ times the frequency of the lateral wave and the
phase lag λ:

$$ P_j = \operatorname{sign}
   \sin\bigl(\rho\,(2\pi f t - \beta (j-1) + \psi - \alpha_j) - \lambda\bigr) . $$

Valves can only open and close. To reduce its amplitude, a wave therefore rests at 0 for
a fraction r of each period. The rest multiplies the amplitude of the fundamental by
cos(π r/2). The pitch fraction s, from 0 to 1, is the amplitude of the pitch wave
divided by the sum of both amplitudes. For s < 1/2, the pitch wave has amplitude s/(1 −
s). For s > 1/2, the lateral wave has amplitude (1 − s)/s. Chamber c with direction d_c
fills where d_c · (S_j, P_j) > 0.

| gait | pitch wave |
|---|---|
| sidewinding | λ = π/2: to the right of the heading; λ = −π/2: to the left |
| rectilinear crawling | s = 1: the wave is vertical |
| sinus-lifting | ρ = 2: the body lifts where its curvature is largest |
| rolling | β = 0, s = 1/2, λ = ± π/2: the whole body turns about its axis |
| lifted head | any pitch wave; the lifted segments bend upwards and follow neither wave |
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
"""Maximum number of slots evaluated in one batch, which limits the memory use."""


@dataclass(frozen=True)
class PitchWave:
    """Wave that bends a spatial robot upwards and downwards.

    Attributes:
        fraction: pitch fraction s, from 0 (lateral wave only) to 1 (pitch wave only).
        lag_rad: phase lag λ behind the lateral wave, rad.
        frequency_ratio: ratio ρ of the pitch wave's frequency to the gait frequency,
            above 0.
        lifted_segments: number of segments, counted from the head, that always bend
            upwards.
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
            InputError: the robot bends in one plane, or has fewer segments than
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
        """Levels sin(π r/2) below which the lateral wave and the pitch wave rest."""
        ratio = self.fraction / (1 - self.fraction) if self.fraction < 1 else math.inf
        left = 1 / max(ratio, 1.0)
        up = min(ratio, 1.0)
        return _rest_level(left), _rest_level(up)


def _rest_level(amplitude: float) -> float:
    return math.sqrt(1 - amplitude**2)


class Gait(Controller):
    """Open-loop gait of Eq. 13.

    Attributes:
        frequency: gait frequency f, Hz. Call `change_frequency` to change it during a
            run.
        offset: steering offset φ, between −1 and 1. The offset may be changed during a
            run.
        phase: phase ψ, rad.
        phase_lag: phase lag β (j − 1) − ψ of each segment, set by `reset`, shape
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
            phase_step: phase lag β per segment, rad. If None, the phase lag of the
                robot is used.
            phases: additional phase lags α, rad, with one value per segment. If None,
                all additional phase lags are 0.
            rest_fraction: fraction r of the period in which both chambers vent, at
                least 0 and below 1. If None, the fraction is 0.
            pitch: pitch wave of a spatial robot, or None.

        Raises:
            InputError: a rest fraction is given together with a pitch wave, the
                frequency is not above 0, or the offset or the rest fraction is out of
                range.
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
        """Steering offset φ."""
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
            time: time of the change, s.

        Raises:
            InputError: the frequency is not above 0.
        """
        change = 2 * math.pi * (_checked_frequency(frequency) - self.frequency) * time
        self.phase_lag = self.phase_lag + change
        self.frequency = frequency

    def angle(self, time: float) -> float:
        """Return the phase angle of the first segment's wave at a time (s), rad."""
        return 2 * math.pi * self.frequency * time - float(self.phase_lag[0])

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: the number of additional phase lags differs from the number of
                segments.
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
        step = spec.phase_step if self._phase_step is None else self._phase_step
        self.phase_lag = step * np.arange(spec.segments) - self.phase
        if self._phases:
            self.phase_lag = self.phase_lag + np.asarray(self._phases)
        self._slot_centres = (np.arange(slots) + 0.5) / slots
        self._tick = tick

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valve states of the next tick."""
        return self.valves_at(float(state.time))

    def valves_at(self, time: float) -> np.ndarray:
        """Return the valve states of the tick that begins at `time` (s)."""
        if self._axes is not None:
            return self._spatial_valves(time + self._tick * self._slot_centres)
        first, last = self._wave(time + self._tick * self._slot_centres[[0, -1]])
        # A tick that is shorter than the shortest constant section of the wave contains
        # at most one change. Equal states at both ends of a short tick therefore rule
        # out a change within the tick.
        if self._tick < self._shortest_level() and (first == last).all():
            return _antagonistic(first)
        wave = self._wave(time + self._tick * self._slot_centres)
        if (wave == wave[0]).all():
            wave = wave[0]
        return _antagonistic(wave)

    def script(self, duration: float) -> Schedule:
        """Return the valve states of the whole run."""
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
        # Evaluate the wave only in the slot of each change and in the two adjacent
        # slots, because rounding may move a change by one slot.
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
        """Return the offset."""
        return {"offset": self._offset}

    def _shortest_level(self) -> float:
        up, down = self._crossings()
        angles = [math.pi + 2 * up, math.pi - 2 * down, down - up]
        shortest = min(angle for angle in angles if angle > 0)
        return shortest / (2 * math.pi * self.frequency)

    def _crossings(self) -> tuple[float, float]:
        """Return the negated phase angles at which S becomes 1 and −1, rad."""
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
    """Return 1 above the rest level, −1 below the negated rest level, and 0 in between.

    With a rest level of 0, the result for `value` = 0 is 1, so 0 is never returned.
    """
    # The tolerance makes the sign of an exact zero independent of rounding.
    low = -rest - 1e-12
    high = rest - 1e-12
    if rest >= 1:
        high = rest + 1e-12  # The wave only touches the rest level.
    below_high = np.where(value >= low, 0, -1) if rest else -1
    return np.where(value >= high, 1, below_high)


def _checked_frequency(frequency: float) -> float:
    check_positive("gait frequency", frequency, "Hz")
    return frequency


def _antagonistic(wave: np.ndarray) -> np.ndarray:
    return np.stack([2 * (wave > 0) - 1, 2 * (wave < 0) - 1], axis=-1).astype(np.int8)
