r"""RecordedPressures: chambers whose pressures were measured, on a plant that is driven by them.

Between the samples of the log pressures are straight lines, before and after it they stay as they are. The
linear bend x follows them with the lag τ₂ as in `lag`; over a stretch on which the drive u = G(g⁺p⁺ − g⁻p⁻)
rises at a rate m from u₀,

$$ x(t) = u_0 + m (t - \tau_2) + (x_0 - u_0 + m \tau_2)\, e^{-t/\tau_2}. $$

Valves do nothing here, and nobody knows what air was drawn: it stays 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from srs_twin.compute.compiled import compiled
from srs_twin.errors import InputError
from srs_twin.pneumatics.base import Known, Pneumatics, Trace
from srs_twin.pneumatics.chambers import bend_law, bent, gains
from srs_twin.pneumatics.valves import Schedule
from srs_twin.robot.spec import RobotSpec


class RecordedPressures(Pneumatics):
    """Chambers with the pressures of a log (module docstring).

    Attributes:
        overshoot: of the robot's nominal supply pressure, how many times the largest pressure in the log.
    """

    kind = "recorded"
    metered = False

    def __init__(
        self, spec: RobotSpec, time: np.ndarray, pressure: np.ndarray, *, supply_pa: float,
        layout: str = "3/2",
    ) -> None:  # fmt: skip
        """Make the chambers.

        Args:
            spec: the robot.
            time: of the samples, ascending, s from the start of the run; may begin before it.
            pressure: gauge, shape (samples, segments, 2), Pa.
            supply_pa: supply pressure, gauge, Pa; only says what `overshoot` is of.
            layout: of the valves that the plant's controller believes to drive.

        Raises:
            InputError: a log of another robot, or times that do not rise.
        """
        if pressure.shape != (len(time), spec.segments, 2):
            raise InputError(
                f"recorded pressures have shape {pressure.shape}; {spec.name} needs "
                f"({len(time)}, {spec.segments}, 2)"
            )
        if not ((np.diff(time) > 0).all() and np.isfinite(pressure).all()):
            raise InputError("recorded pressures must be finite and their times rise")
        self._time, self._measured = np.asarray(time, float), np.asarray(pressure, float)
        self._tau, self._law = spec.actuator.tau_mode, bend_law(spec)
        self._drive = (self._measured * gains(spec) * [1.0, -1.0]).sum(axis=-1)
        self._slope = np.zeros_like(self._drive)
        self._slope[:-1] = np.diff(self._drive, axis=0) / np.diff(self._time)[:, None]
        self._linear = _followed(self._time, self._drive, self._slope, self._tau)
        self.overshoot = max(1.0, float(np.abs(pressure).max()) / supply_pa)
        super().__init__(spec, layout=layout)

    def reset(self) -> None:
        """See `Pneumatics.reset`; chambers hold what the log says of the start."""
        super().reset()
        trace = self._at(np.zeros(1))
        self.pressure, self.bend = trace.pressure[0], trace.bend[0]

    def describe(self) -> dict[str, Any]:
        """See `Pneumatics.describe`."""
        return super().describe() | {"samples": len(self._time), "from_s": float(self._time[0])}

    def _follow(self, schedule: Schedule, times: np.ndarray, bend: Known, bend_rate: Known) -> Trace:
        trace = self._at(self._elapsed + times)
        end = self._at(np.array([self._elapsed + schedule.span]))
        self.pressure, self.bend = end.pressure[0], end.bend[0]
        return trace

    def _at(self, time: np.ndarray) -> Trace:
        """Return what the chambers do at some times, s from the start of the run."""
        trace = Trace.empty(len(time), self._drive.shape[1])
        row = np.clip(np.searchsorted(self._time, time, side="right") - 1, 0, len(self._time) - 1)
        since = np.maximum(time - self._time[row], 0.0)[:, None]
        drive, slope = self._drive[row], self._slope[row] * (time >= self._time[0])[:, None]
        fade = (self._linear[row] - drive + slope * self._tau) * np.exp(-since / self._tau)
        linear = drive + slope * (since - self._tau) + fade
        speed, acceleration = slope - fade / self._tau, fade / self._tau**2
        _bend((linear, speed, acceleration), self.rest_bend, self._law, trace)
        for j in range(trace.pressure.shape[1]):
            for side in range(2):
                trace.pressure[:, j, side] = np.interp(time, self._time, self._measured[:, j, side])
        trace.valves[:] = -1
        trace.air[:] = 0.0
        return trace


def _followed(time: np.ndarray, drive: np.ndarray, slope: np.ndarray, tau: float) -> np.ndarray:
    """Return the linear bend at the samples of a log, at rest as it begins, shape of `drive`."""
    linear = np.empty_like(drive)
    linear[0] = drive[0]
    kept = np.exp(-np.diff(time) / tau)
    for k, share in enumerate(kept):
        behind = slope[k] * tau
        linear[k + 1] = drive[k + 1] - behind + (linear[k] - drive[k] + behind) * share
    return linear


@compiled
def _bend(motion, bias, limit, trace):  # type: ignore[no-untyped-def]
    """Fill bends and their rates by the linear bend and its first two derivatives, (times, segments) each."""
    linear, speed, acceleration = motion
    for k in range(linear.shape[0]):
        for j in range(linear.shape[1]):
            turned, slope, curve = bent(linear[k, j], limit)
            trace.bend[k, j] = bias[j] + turned
            trace.bend_rate[k, j] = slope * speed[k, j]
            trace.bend_acceleration[k, j] = slope * acceleration[k, j] + curve * speed[k, j] * speed[k, j]
