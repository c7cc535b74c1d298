r"""Sliding mode control of segments by valve states or duty cycles (Chapter 4).

The controllers `DirectSMC` and `IterativeSMC` make the measured bend q of each segment
follow a reference bend r. Both controllers use the sliding variable σ:

$$ \sigma = \dot e + D e, \qquad e = r - q \qquad (\text{Eqs. 24, 31}). $$

On the sliding manifold σ = 0, the error decays as e^{−Dt}. The controllers differ in
how they estimate ė from noisy readings and in how they convert σ to valve states.

**Velocity filter.** Finite differences would amplify the noise of the readings. The
class `VelocityFilter` therefore applies a second-order Butterworth low-pass filter with
cutoff frequency ω_c to a reading x. The outputs of the filter are the filtered reading
x̂ and the rate v̂:

$$ \ddot{\hat x} = \omega_c^2 (x - \hat x) - \sqrt2\,\omega_c \dot{\hat x}, \qquad \hat v = \dot{\hat x}. $$

The solution is exact for a reading that varies linearly between ticks. At frequencies
far below the cutoff, x̂ and v̂ are delayed by √2/ω_c. For a cutoff of 25 Hz, the delay
is 9 ms, which is a phase lag of 0.34 rad at 6 Hz.

White noise with standard deviation s and sampling period T causes a standard deviation
of about s √(ω_c³ T / √8) in v̂. A rate from finite differences would have a standard
deviation of s √2 / T. For s = 0.2°, T = 1 ms and a cutoff of 25 Hz, the standard
deviation is 7°/s with the filter and 283°/s with finite differences.

**Direct control.** `DirectSMC` sets the states of separate inlet and outlet valves
(Eq. 31):

$$ \sigma > \varepsilon: \text{fill +, vent −}; \qquad \sigma < -\varepsilon: \text{vent +, fill −};
\qquad |\sigma| \le \varepsilon: \text{hold both}. $$

At rest, σ is equal to D e, so errors up to ε/D persist. The same `VelocityFilter`
provides the bend and the bend rate, so e and ė have equal delays. With the published
value D = 0.5 1/s, errors would decay with a time constant of 2 s. The published value
ε = 2°/s is below the noise of any sufficiently fast rate estimate (E6).

**Iterative control.** `IterativeSMC` sets the duty cycles of pulse-width modulated 3/2
valves (Eq. 30). The controller updates a variable μ once per carrier period T:

$$ \mu \leftarrow \operatorname{clip}\bigl(\mu + K (\dot e + D e),\, -1,\, 1\bigr). $$

The duty cycles of the + and − chambers are (1 + μ)/2 and (1 − μ)/2. This law is
equivalent to the proportional-integral law μ = (K/T) e + (K D/T) ∫e dt with clipping.
Clipping causes no integrator wind-up, because μ leaves its bound as soon as σ changes
sign.

The values of e and ė are averages over the last carrier period, which removes the
ripple caused by the valves. The average of ė is the change of e divided by T, and it
includes steps of the reference. A single reading per period would always sample the
ripple at the same phase, which would cause an offset of several degrees.

Eqs. 29 and 30 disagree on whether K multiplies D e (E6). As in Eq. 30, the implemented
law multiplies D e by K.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from srs_twin.compute.arrays import check_positive
from srs_twin.control.base import Controller, SensorReadings
from srs_twin.control.pwm import PulseWidthModulator
from srs_twin.control.reference import Reference
from srs_twin.errors import InputError
from srs_twin.io.saved_state import Stateful
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState


class VelocityFilter(Stateful):
    """Second-order low-pass filter that also estimates the rates of the readings.

    Attributes:
        value: filtered readings x̂ in the unit of the readings, shape (segments,).
        rate: estimated rates v̂ in the unit of the readings per second, shape
            (segments,).
        lag: delay √2/ω_c of the filtered readings and the rates, s.
    """

    state_attributes = ("_last", "value", "rate")

    def __init__(self, cutoff_hz: float | np.ndarray, tick: float) -> None:
        """Create a filter with an initial rate of 0.

        Args:
            cutoff_hz: cutoff frequency ω_c/2π, either one value for all segments or one
                value per segment, Hz.
            tick: control tick T, s.

        Raises:
            InputError: a cutoff frequency is not finite and positive.
        """
        cutoff = np.asarray(cutoff_hz, dtype=float)
        check_positive("cutoff_hz", cutoff_hz)
        # The poles are w (−1 ± i), so the homogeneous solution is a decaying
        # oscillation with angular frequency w.
        self._w = math.sqrt(2) * math.pi * cutoff
        self._tick = tick
        self.lag = 1 / self._w
        decay = np.exp(-self._w * tick)
        angle = self._w * tick
        self._cos = decay * np.cos(angle)
        self._sin = decay * np.sin(angle)
        self._last: np.ndarray | None = None
        # Restored arrays must have the same number of dimensions as saved ones.
        self.value: np.ndarray = np.zeros(np.atleast_1d(cutoff).shape)
        self.rate: np.ndarray = np.zeros(np.atleast_1d(cutoff).shape)

    def step(self, reading: np.ndarray) -> None:
        """Update the filter with the readings of one tick, shape (segments,)."""
        if self._last is None:
            self.value = np.array(reading, dtype=float)
            self.rate = np.zeros(np.shape(reading))
        else:
            # For a reading that varies linearly, the particular solution is the reading
            # delayed by the lag. The deviation from the particular solution is a
            # homogeneous solution.
            reading_rate = (reading - self._last) / self._tick
            deviation = self.value - (self._last - reading_rate * self.lag)
            rate_deviation = self.rate - reading_rate
            w = self._w
            c = self._cos
            s = self._sin
            self.value = (
                reading
                - reading_rate * self.lag
                + (c + s) * deviation
                + s / w * rate_deviation
            )
            self.rate = reading_rate - 2 * w * s * deviation + (c - s) * rate_deviation
        self._last = np.array(reading, dtype=float)


Gain = float | np.ndarray
"""Gain as one value for all segments, or as an array of shape (segments,)."""


@dataclass(eq=False)
class SlidingMode(Controller):
    """Base class of the sliding mode controllers.

    Each segment tracks the reference independently of the other segments.

    Attributes:
        gains: names of the attributes that may have different values for each segment.
        reference: reference bend for all segments.

    Raises:
        InputError: a gain is not finite and positive.
    """

    gains: ClassVar[tuple[str, ...]]
    state_attributes: ClassVar[tuple[str, ...]] = (
        "_readings",
        "_was_clipped",
        "_next_reference",
        "_error",
        "_sigma",
        "_events",
    )

    reference: Reference

    def __post_init__(self) -> None:
        for name in self.gains:
            check_positive(f"{self.kind}: {name}", getattr(self, name))

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: a gain is neither a number nor an array of shape (segments,).
        """
        for name in self.gains:
            shape = np.shape(getattr(self, name))
            if shape not in ((), (spec.segments,)):
                raise InputError(
                    f"{self.kind}: `{name}` has the shape {shape}; give one number, or"
                    f" one per segment ({spec.segments} numbers)"
                )
        self._tick = tick
        self._readings = SensorReadings(spec.segments)
        self._was_clipped = False
        self._next_reference = np.full(spec.segments, float(self.reference.value(0.0)))
        self._error = np.zeros(spec.segments)
        self._sigma = np.zeros(spec.segments)
        self._events: list[Event] = []

    def signals(self) -> dict[str, float | np.ndarray]:
        """Return the reference (rad), the error e (rad) and σ (rad/s).

        The reference refers to the end of the tick, at which signals are recorded. The
        values of e and σ refer to the start of the tick.
        """
        return {
            "reference": self._next_reference,
            "error": self._error,
            "sigma": self._sigma,
        }

    def _read_sensors(self, state: SnakeState) -> float:
        time = float(state.time)
        self._events += self._readings.update(time, state.measured_bend)
        next_reference = float(self.reference.value(time + self._tick))
        self._next_reference = np.full(self._readings.value.shape, next_reference)
        clipped = bool(self.reference.is_clipped(time))
        if clipped and not self._was_clipped:
            text = (
                "the reference exceeds the range of the module and is clipped at"
                f" {self.reference.peak:.4g} rad"
            )
            self._events.append(Event(time, "saturation", text))
        self._was_clipped = self._was_clipped or clipped
        return time


# The gains of both controllers were tuned with benchmarks/gains.py for generation 4 at
# a supply pressure of 7 psi. All experiments of Chapter 4 use these gains.
DIRECT_D_PER_S = 58.0
"""Slope D of the sliding manifold of `DirectSMC`, 1/s."""
EPSILON_RAD_PER_S = math.radians(84.0)
"""Half-width ε of the dead zone of `DirectSMC`, rad/s."""
CUTOFF_HZ = 16.0
"""Cutoff frequency of the velocity filter, Hz."""


@dataclass(eq=False)
class DirectSMC(SlidingMode):
    """Sliding mode controller that sets the valve states in every tick.

    Attributes:
        D: slope of the sliding manifold, 1/s.
        epsilon: half-width ε of the dead zone of σ, rad/s.
        cutoff_hz: cutoff frequency of the velocity filter, Hz.
    """

    kind = "direct_smc"
    state_attributes = ("_filter", "_rate")
    layouts = ("in_out",)
    gains = ("D", "epsilon", "cutoff_hz")

    _: KW_ONLY
    D: Gain = DIRECT_D_PER_S
    epsilon: Gain = EPSILON_RAD_PER_S
    cutoff_hz: Gain = CUTOFF_HZ

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""
        super().reset(spec, tick, seed=seed)
        self._filter = VelocityFilter(self.cutoff_hz, tick)
        self._rate: np.ndarray = np.zeros(spec.segments)

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valve states for the next tick, shape (segments, 2)."""
        time = self._read_sensors(state)
        self._filter.step(self._readings.value)
        self._rate = self._filter.rate
        self._error = self.reference.value(time) - self._filter.value
        self._sigma = self.reference.rate(time) - self._rate + self.D * self._error
        valves = np.where(
            np.abs(self._sigma) > self.epsilon, np.sign(self._sigma), 0.0
        ).astype(np.int8)
        return np.stack([valves, -valves], axis=-1)

    def signals(self) -> dict[str, float | np.ndarray]:
        """Return the signals of `SlidingMode`, and the filtered bend rate (rad/s)."""
        return super().signals() | {"rate": self._rate}


K_S_PER_RAD = 0.042
"""Gain K of `IterativeSMC`, s/rad."""
ITERATIVE_D_PER_S = 16.0
"""Slope D of the sliding manifold of `IterativeSMC`, 1/s."""

CARRIER_HZ = 60.0
"""Carrier frequency of the pulse-width modulation, Hz (Section 5.3)."""


@dataclass(eq=False)
class IterativeSMC(SlidingMode):
    """Sliding mode controller that updates the duty cycles once per carrier period.

    Attributes:
        K: gain, s/rad.
        D: slope of the sliding manifold, 1/s.
        carrier_hz: carrier frequency of the pulse-width modulation, Hz.
    """

    kind = "iterative_smc"
    state_attributes = ("_pulses", "_mu", "_last_error", "_error_sum", "_count")
    layouts = ("3/2",)
    gains = ("K", "D")

    _: KW_ONLY
    K: Gain = K_S_PER_RAD
    D: Gain = ITERATIVE_D_PER_S
    carrier_hz: float = CARRIER_HZ

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: a gain has the wrong shape, or the tick is longer than a carrier
                period.
        """
        super().reset(spec, tick, seed=seed)
        self._pulses = PulseWidthModulator(
            self.carrier_hz, tick, spec.segments, scale=spec.scale
        )
        self._mu = np.zeros(spec.segments)
        self._last_error = np.zeros(spec.segments)
        self._error_sum = np.zeros(spec.segments)
        self._count = 0

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valve states for the next tick, shape (slots, segments, 2)."""
        self._error = (
            self.reference.value(self._read_sensors(state)) - self._readings.value
        )
        if self._pulses.due():
            self._update()
        self._error_sum = self._error_sum + self._error
        self._count = self._count + 1
        return self._pulses.step(
            np.stack([(1 + self._mu) / 2, (1 - self._mu) / 2], axis=-1)
        )

    def signals(self) -> dict[str, float | np.ndarray]:
        """Return the signals of `SlidingMode`, the variable μ and the duty cycles."""
        plus, minus = self._pulses.duty.T
        return super().signals() | {
            "mu": self._mu,
            "duty_plus": plus,
            "duty_minus": minus,
        }

    def _update(self) -> None:
        elapsed = self._count * self._tick or self._pulses.period
        mean = self._error_sum / max(self._count, 1)
        self._sigma = (self._error - self._last_error) / elapsed + self.D * mean
        self._mu = np.clip(self._mu + self.K * self._sigma, -1.0, 1.0)
        self._last_error = self._error
        self._error_sum = np.zeros_like(self._error_sum)
        self._count = 0
