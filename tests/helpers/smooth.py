"""Pneumatics with a smooth prescribed bend wave that ignores the valves."""

from __future__ import annotations

import numpy as np

from srs_twin import RobotSpec
from srs_twin.pneumatics import Pneumatics, Schedule, Trace


class Wave(Pneumatics):
    """Free bends q_j = s(t) [a sin(2π f t − β (j − 1)) + b] with s = 1 − exp(−(t/rise)⁴).

    The pressures follow from the mode time constant, p⁺ − p⁻ = (q + τ₂ q̇)/G, around
    half the supply.
    """

    kind = "wave"

    def __init__(
        self,
        spec: RobotSpec,
        *,
        amplitude: float = 0.6,
        bias: float = 0.0,
        frequency: float = 2.0,
        rise: float = 0.2,
    ) -> None:
        self._actuator = spec.actuator
        self._lag = spec.phase_step * np.arange(spec.segments)
        self._middle = spec.supply.nominal / 2
        self._amplitude = amplitude
        self._bias = bias
        self._omega = 2 * np.pi * frequency
        self._rise = rise
        super().__init__(spec, layout="3/2")

    def reset(self) -> None:
        super().reset()
        self._now = 0.0

    def free(self, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the free bends (rad), their rates and accelerations, shape (times, segments)."""
        t = np.asarray(time)[:, None]
        w = self._omega
        r = self._rise
        gone = np.exp(-((t / r) ** 4))
        swell = (
            1 - gone,
            4 * t**3 / r**4 * gone,
            (12 * t**2 / r**4 - (4 * t**3 / r**4) ** 2) * gone,
        )
        phase = w * t - self._lag
        wave = (
            self._amplitude * np.sin(phase) + self._bias,
            self._amplitude * w * np.cos(phase),
            -self._amplitude * w * w * np.sin(phase),
        )
        return (
            swell[0] * wave[0],
            swell[1] * wave[0] + swell[0] * wave[1],
            swell[2] * wave[0] + 2 * swell[1] * wave[1] + swell[0] * wave[2],
        )

    def _simulate(
        self,
        schedule: Schedule,
        times: np.ndarray,
        bend: np.ndarray | None,
        bend_rate: np.ndarray | None,
    ) -> Trace:
        q, dq, ddq = self.free(self._now + times)
        half = (q + self._actuator.tau_mode * dq) / self._actuator.gain / 2
        self._now += schedule.span
        valves = np.repeat(schedule.states[-1:], len(times), axis=0)
        pressure = np.stack([self._middle + half, self._middle - half], axis=-1)
        self.pressure = pressure[-1]
        self.bend = q[-1]
        return Trace(pressure, q, dq, ddq, valves, np.zeros(len(times)))
