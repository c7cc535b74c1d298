r"""Lateral undulation: a square wave of valve states that travels from head to tail (Eq. 13).

$$ S_j = \operatorname{sign}\bigl(\sin(2\pi f t - \beta (j-1) + \psi) + \varphi\bigr) $$

S_j = +1 fills the + chamber of segment j and vents the − chamber, −1 the reverse; sign(0) = +1. The wave
runs head to tail and drives the snake forward (E12: Eq. 13 as printed runs the other way). φ > 0 turns
left. The mirror image of a gait is −φ together with ψ shifted by π.

Other waves than the dissertation's: each segment may lag by α_j more, and both chambers may vent for a share
r of the time, about the wave's changes of sign,

$$ S_j = 0 \quad \text{where} \quad
   |\sin(2\pi f t - \beta (j-1) + \psi - \alpha_j) + \varphi| < \sin(\pi r/2). $$
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from srs_twin.compute.arrays import check_positive
from srs_twin.control.base import Controller
from srs_twin.errors import InputError, count_steps
from srs_twin.plants.base import SnakeState
from srs_twin.pneumatics.valves import SLOT_S, Schedule
from srs_twin.robot.spec import RobotSpec


class Gait(Controller):
    """Open-loop gait of Eq. 13.

    Attributes:
        frequency: f, Hz; `change_frequency` changes it while it runs.
        offset: φ, between −1 and 1; may be changed while it runs.
        phase: ψ, rad.
        lag: β (j − 1) − ψ of each segment, shape (segments,), rad; known from `reset` on.
    """

    kind = "gait"
    state_attributes = ("frequency", "_offset", "lag")
    frequency: float
    lag: np.ndarray
    layouts = ("3/2", "in_out")

    def __init__(
        self, frequency: float, offset: float = 0.0, *, phase: float = 0.0, phase_step: float | None = None,
        phases: Sequence[float] | None = None, rest_share: float | None = None,
    ) -> None:  # fmt: skip
        """Make the gait.

        Args:
            frequency: f, Hz.
            offset: φ, between −1 and 1, positive to the left.
            phase: ψ at the start, rad.
            phase_step: β, rad; None takes the robot's.
            phases: α, rad, one a segment; None: none.
            rest_share: r, at least 0 and below 1; None: 0.

        Raises:
            InputError: a frequency that is not above 0, or an offset or a rest out of range (also when set
                later).
        """
        rest_share = rest_share or 0.0
        if not 0 <= rest_share < 1:
            raise InputError(f"gait rest {rest_share!r} is not allowed; it must be at least 0 and below 1")
        self.frequency = _checked_frequency(frequency)
        self.offset = offset
        self.phase = phase
        self._phase_step, self._phases = phase_step, phases or ()
        self.rest = math.sin(math.pi / 2 * rest_share)

    @property
    def offset(self) -> float:
        """φ, the steering offset."""
        return self._offset

    @offset.setter
    def offset(self, value: float) -> None:
        if not abs(value) < 1:
            raise InputError(f"gait offset {value!r} is not allowed; it must lie between -1 and 1")
        self._offset = float(value)

    def change_frequency(self, frequency: float, time: float) -> None:
        """Go on with another frequency, without a jump of the wave.

        Args:
            frequency: f, Hz.
            time: from when on, s.

        Raises:
            InputError: a frequency that is not above 0.
        """
        turned = 2 * math.pi * (_checked_frequency(frequency) - self.frequency) * time
        self.lag = self.lag + turned
        self.frequency = frequency

    def angle(self, time: float) -> float:
        """Return the argument of the first segment's sine at a time (s), rad."""
        return 2 * math.pi * self.frequency * time - float(self.lag[0])

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """Take β from the robot unless one was given, and the slots from the tick.

        Raises:
            InputError: phases of another robot.
        """
        if len(self._phases) not in (0, spec.segments):
            raise InputError(f"{len(self._phases)} phases, but {spec.name} has {spec.segments} segments")
        slots = count_steps("tick", tick, "valve slot", SLOT_S) if tick > SLOT_S else 1
        step = spec.phase_step if self._phase_step is None else self._phase_step
        self.lag = step * np.arange(spec.segments) - self.phase
        if self._phases:
            self.lag = self.lag + np.asarray(self._phases)
        self._middle = (np.arange(slots) + 0.5) / slots
        self._tick = tick

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valves of the coming tick; with slots only when an edge falls inside it."""
        return self.valves_at(float(state.time))

    def valves_at(self, time: float) -> np.ndarray:
        """Return the valves of the tick that begins at `time` (s)."""
        first, last = self._wave(time + self._tick * self._middle[[0, -1]])
        # A tick shorter than the shorter half wave holds one edge at most: equal ends, no edge.
        if self._tick < self._shorter_half_wave() and (first == last).all():
            return _antagonistic(first)
        wave = self._wave(time + self._tick * self._middle)
        return _antagonistic(wave[0] if (wave == wave[0]).all() else wave)

    def script(self, duration: float) -> Schedule:
        """Return the valves of a whole run."""
        slot = self._tick / len(self._middle)
        count = round(duration / slot)
        if self._shorter_half_wave() < 2 * slot:
            return Schedule.from_slots(_antagonistic(self._wave(slot * (np.arange(count) + 0.5))), duration)
        # Where S changes, and the slots beside it: rounding may place an edge one slot off.
        period, (up, down) = 1 / self.frequency, self._crossings()
        turns = [-up, math.pi + up, -down, math.pi + down] if self.rest else [-up, math.pi + up]
        phases = np.add.outer(self.lag, turns).ravel() / (2 * math.pi) * period
        numbers = np.arange(math.floor(-phases.max() / period), math.ceil(duration / period) + 1)
        edges = np.ceil(np.add.outer(phases, period * numbers).ravel() / slot - 0.5)
        near = np.add.outer(edges, [-1, 0, 1]).ravel()
        begins = np.unique(np.append(near[(near > 0) & (near < count)], 0)).astype(int)
        wave = self._wave(slot * (begins + 0.5))
        keep = np.append(True, (wave[1:] != wave[:-1]).any(axis=1))
        return Schedule(duration, slot * begins[keep], _antagonistic(wave[keep]))

    def signals(self) -> dict[str, float]:
        """Return the offset."""
        return {"offset": self._offset}

    def _shorter_half_wave(self) -> float:
        """Return how long S is at least what it is, s."""
        up, down = self._crossings()
        lasts = [math.pi + 2 * up, math.pi - 2 * down, *([down - up] if self.rest else [])]
        return min(each for each in lasts if each > 0) / (2 * math.pi * self.frequency)

    def _crossings(self) -> tuple[float, float]:
        """Return the angles, with their signs changed, at which S begins to be 1 and ends to be −1, rad."""
        levels = self._offset - self.rest, self._offset + self.rest
        up, down = (math.asin(min(max(each, -1.0), 1.0)) for each in levels)
        return up, down

    def _wave(self, time: np.ndarray) -> np.ndarray:
        """Return S, shape (times, segments), int8."""
        value = np.sin(2 * math.pi * self.frequency * time[:, None] - self.lag) + self._offset
        # Rounding must not decide the sign of an exact zero.
        low, high = -self.rest - 1e-12, self.rest - 1e-12
        return np.where(value >= high, 1, np.where(value >= low, 0, -1) if self.rest else -1).astype(np.int8)


def _checked_frequency(frequency: float) -> float:
    check_positive("gait frequency", frequency, "Hz")
    return frequency


def _antagonistic(wave: np.ndarray) -> np.ndarray:
    """Return valves (…, segments, 2) from the signs S (…, segments); at 0 both chambers vent."""
    return np.stack([2 * (wave > 0) - 1, 2 * (wave < 0) - 1], axis=-1).astype(np.int8)
