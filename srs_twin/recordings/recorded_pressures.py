r"""Chamber model that drives a plant with recorded pressures.

The pressures are interpolated linearly between the samples of the log, and are constant
before the first and after the last sample. The bend x before the nonlinear bend law
follows the drive u = G (g⁺p⁺ − g⁻p⁻) with a first-order lag of time constant τ₂ (see
`lag`). For a drive u₀ + m t, the solution is

$$ x(t) = u_0 + m (t - \tau_2) + (x_0 - u_0 + m \tau_2)\, e^{-t/\tau_2}. $$

Valve commands have no effect. The pneumatic energy is unknown and is reported as 0.
"""

from __future__ import annotations

import numpy as np

from srs_twin.compute.compiled import compiled
from srs_twin.errors import InputError
from srs_twin.pneumatics.base import OptionalArray, Pneumatics, Trace
from srs_twin.pneumatics.chambers import apply_bend_law, bend_law_of, chamber_gains
from srs_twin.pneumatics.valves import Schedule
from srs_twin.recordings.recording import interpolated_values
from srs_twin.robot.spec import RobotSpec


class RecordedPressures(Pneumatics):
    """Pneumatic model that replays recorded pressures."""

    kind = "recorded"
    measures_air = False

    def __init__(
        self,
        spec: RobotSpec,
        time: np.ndarray,
        pressure: np.ndarray,
        *,
        supply_pa: float,
        layout: str = "3/2",
    ) -> None:
        """Construct the chambers.

        Args:
            spec: specification of the recorded robot.
            time: sample times relative to the start of the run, s, in ascending order.
                Samples before the start have negative times.
            pressure: gauge pressures, Pa, shape (samples, segments, 2).
            supply_pa: gauge supply pressure, Pa, used only for `max_pressure_ratio`.
            layout: valve layout of the controller commands.
        """
        if pressure.shape != (len(time), spec.segments, 2):
            raise InputError(
                f"the recorded pressures have the shape {pressure.shape}, but"
                f" {spec.name} needs the shape ({len(time)}, {spec.segments}, 2)"
            )
        if not (np.diff(time) > 0).all():
            raise InputError("the times of the recorded pressures must increase")
        finite = np.isfinite(pressure).all(axis=(1, 2))
        if not finite.all():
            raise InputError(
                "the recorded pressures must be finite, but row"
                f" {finite.argmin() + 1} lacks a finite pressure"
            )
        self._time = np.asarray(time, float)
        self._measured = np.asarray(pressure, float)
        self._tau = spec.actuator.tau_mode
        self._bend_law = bend_law_of(spec)
        self._drive = (self._measured * chamber_gains(spec) * [1.0, -1.0]).sum(axis=-1)
        slopes = np.diff(self._drive, axis=0) / np.diff(self._time)[:, None]
        self._derivative = np.pad(slopes, ((0, 1), (0, 0)))
        self._linear = _linear_bend_at_samples(
            self._time, self._drive, self._derivative, self._tau
        )
        self.max_pressure_ratio = max(1.0, float(np.abs(pressure).max()) / supply_pa)
        super().__init__(spec, layout=layout)

    def reset(self) -> None:
        """Reset the pressures and bends to the start of the run."""
        super().reset()
        trace = self._at(np.zeros(1))
        self.pressure = trace.pressure[0]
        self.bend = trace.bend[0]

    def describe(self) -> dict[str, object]:
        """See `Pneumatics.describe`."""
        return super().describe() | {
            "samples": len(self._time),
            "from_s": float(self._time[0]),
        }

    def _simulate(
        self,
        schedule: Schedule,
        times: np.ndarray,
        bend: OptionalArray,
        bend_rate: OptionalArray,
    ) -> Trace:
        trace = self._at(self._elapsed + times)
        end = self._at(np.array([self._elapsed + schedule.span]))
        self.pressure = end.pressure[0]
        self.bend = end.bend[0]
        return trace

    def _at(self, time: np.ndarray) -> Trace:
        trace = self._empty_trace(len(time))
        row = np.maximum(np.searchsorted(self._time, time, side="right") - 1, 0)
        since = np.maximum(time - self._time[row], 0.0)[:, None]
        drive = self._drive[row]
        derivative = self._derivative[row] * (time >= self._time[0])[:, None]
        fade = (self._linear[row] - drive + derivative * self._tau) * np.exp(
            -since / self._tau
        )
        linear = drive + derivative * (since - self._tau) + fade
        speed = derivative - fade / self._tau
        acceleration = fade / self._tau**2
        _fill_bends(
            (linear, speed, acceleration), self.rest_bend, self._bend_law, trace
        )
        trace.pressure[:] = interpolated_values(time, self._time, self._measured)
        trace.valves[:] = -1
        trace.pneumatic_energy[:] = 0.0
        return trace


def _linear_bend_at_samples(
    time: np.ndarray, drive: np.ndarray, derivative: np.ndarray, tau: float
) -> np.ndarray:
    """Return the bends x at the samples of a log that starts in equilibrium."""
    linear = np.empty_like(drive)
    linear[0] = drive[0]
    decay = np.exp(-np.diff(time) / tau)
    for k, factor in enumerate(decay):
        lag = derivative[k] * tau
        linear[k + 1] = drive[k + 1] - lag + (linear[k] - drive[k] + lag) * factor
    return linear


@compiled
def _fill_bends(motion, bias, bend_law, trace):  # type: ignore[no-untyped-def]
    linear, speed, acceleration = motion
    for k in range(linear.shape[0]):
        for j in range(linear.shape[1]):
            bend, derivative, curve = apply_bend_law(linear[k, j], bend_law)
            trace.bend[k, j] = bias[j] + bend
            trace.bend_rate[k, j] = derivative * speed[k, j]
            trace.bend_acceleration[k, j] = (
                derivative * acceleration[k, j] + curve * speed[k, j] * speed[k, j]
            )
