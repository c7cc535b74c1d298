r"""Sliding mode control of one module (Chapter 4): by valve states, or by the duty of a carrier.

Both controllers bring the sensed bend q of each segment to a reference r by way of the sliding variable

$$ \sigma = \dot e + D e, \qquad e = r - q \qquad (\text{Eq. 24, 31}): $$

on σ = 0 the error fades as e^{−Dt}. How they find ė from noisy readings, and how σ becomes valve states, is
each controller's own.

`VelocityFilter` gives the rate of a noisy reading without the noise of its differences: a second-order
low-pass (Butterworth) with its rate read beside its value,

$$ \ddot{\hat x} = \omega_c^2 (x - \hat x) - \sqrt2\,\omega_c \dot{\hat x}, \qquad \hat v = \dot{\hat x}, $$

solved exactly from reading to reading, with the reading taken to go straight from one to the next. Both
outputs lag by √2/ω_c at frequencies well below the cutoff (9 ms at 25 Hz, 0.34 rad of a 6 Hz sine). White
noise of deviation s, read every T, leaves about s √(ω_c³ T / √8) in the rate (a little less), where plain
differences would leave s √2 / T: of 0.2° read every ms at 25 Hz, 7°/s instead of 283°/s.

`DirectSMC` sets valve states, of separate inlet and outlet valves (Eq. 31):

$$ \sigma > \varepsilon: \text{fill +, vent −}; \qquad \sigma < -\varepsilon: \text{vent +, fill −};
\qquad |\sigma| \le \varepsilon: \text{hold both}. $$

At rest σ = D e, so that errors below ε/D stay. The bend and its rate both come from one `VelocityFilter`:
with the same lag in both, σ is the true one a little later, and the noise of D e is filtered as well.
The printed D = 0.5 1/s would slide with a time constant of 2 s, and the printed ε = 2°/s is less than the
noise of any rate that is fast enough (E6).

`IterativeSMC` sets the duty of pulse-width modulated 3/2 valves (Eq. 30). Once a carrier period T

$$ \mu \leftarrow \operatorname{clip}\bigl(\mu + K (\dot e + D e),\, -1,\, 1\bigr), $$

and the chambers get the duties (1 + μ)/2 and (1 − μ)/2. This is a proportional-integral law,
μ = (K/T) e + (K D/T) ∫e dt, clipped without wind-up: μ leaves its bound with the first σ of the other sign.

Both e and ė are means over the last period, ė that is the difference of e at its ends over T. A whole
period leaves nothing of the ripple that the valves themselves cause; readings taken once a period would
see it always at the same phase and keep an offset of degrees. A jump of the reference counts in ė.

Eq. 29 and 30 disagree on whether K multiplies D e (E6); either form can be asked for. The second with
D K for its D is the first.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from srs_twin.compute.arrays import check_positive
from srs_twin.control.base import Controller, Readings
from srs_twin.control.pwm import PulseWidth
from srs_twin.control.reference import Reference
from srs_twin.errors import InputError, UnknownNameError
from srs_twin.io.saved_state import Stateful
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState


class VelocityFilter(Stateful):
    """Second-order differentiating low-pass (module docstring).

    Attributes:
        value: x̂, shape (segments,), unit of the readings.
        rate: v̂, shape (segments,), that unit per s.
        lag: √2/ω_c, s, by which both come late.
    """

    state_attributes = ("_last", "value", "rate")

    def __init__(self, cutoff_hz: float | np.ndarray, tick: float) -> None:
        """Make a filter that has seen nothing yet.

        Args:
            cutoff_hz: ω_c/2π, one for all segments or one each, Hz.
            tick: T, s.

        Raises:
            InputError: a cutoff that is not finite and above 0.
        """
        cutoff = np.asarray(cutoff_hz, dtype=float)
        check_positive("cutoff_hz", cutoff_hz)
        # The poles of a Butterworth filter are w (−1 ± i).
        self._w = math.sqrt(2) * math.pi * cutoff
        self._tick = tick
        self.lag = 1 / self._w
        decay, angle = np.exp(-self._w * tick), self._w * tick
        self._cos, self._sin = decay * np.cos(angle), decay * np.sin(angle)
        self._last: np.ndarray | None = None
        self.value: np.ndarray = np.zeros(cutoff.shape)
        self.rate: np.ndarray = np.zeros(cutoff.shape)

    def step(self, reading: np.ndarray) -> None:
        """Take the reading of a tick, shape (segments,); the first one is taken to be at rest."""
        if self._last is None:
            self.value, self.rate = np.array(reading, dtype=float), np.zeros(np.shape(reading))
        else:
            # A straight line is followed by one that lags; what is off that one fades.
            slope = (reading - self._last) / self._tick
            off, drift = self.value - (self._last - slope * self.lag), self.rate - slope
            w, c, s = self._w, self._cos, self._sin
            self.value = reading - slope * self.lag + (c + s) * off + s / w * drift
            self.rate = slope - 2 * w * s * off + (c - s) * drift
        self._last = np.array(reading, dtype=float)


Gain = float | np.ndarray
"""One number for all segments, or one for each, shape (segments,)."""


@dataclass(eq=False)
class SlidingMode(Controller):
    """Follows a reference with every segment, each by itself, from its sensed bend alone.

    Lost readings are dealt with by `Readings`.

    Attributes:
        gains: names of the attributes that may differ from segment to segment.
        reference: the bend to follow.

    Raises:
        InputError: a gain that is not finite and above 0.
    """

    gains: ClassVar[tuple[str, ...]]
    state_attributes: ClassVar[tuple[str, ...]] = (
        "_readings",
        "_reading",
        "_cut",
        "_wanted",
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
            InputError: gains of another shape than one number or one a segment.
        """
        for name in self.gains:
            shape = np.shape(getattr(self, name))
            if shape not in ((), (spec.segments,)):
                raise InputError(
                    f"{self.kind}: {name} has shape {shape}; give one number, or one for each of "
                    f"the {spec.segments} segments"
                )
        self._tick = tick
        self._readings = Readings(spec.segments)
        self._reading = self._readings.value
        self._cut = False
        self._wanted = np.full(spec.segments, float(self.reference.value(0.0)))
        self._error = np.zeros(spec.segments)
        self._sigma = np.zeros(spec.segments)
        self._events: list[Event] = []

    def signals(self) -> dict[str, Any]:
        """Return the reference at the end of the tick, where a sample is taken, and e and σ at its begin."""
        return {"reference": self._wanted, "error": self._error, "sigma": self._sigma}

    def events(self) -> list[Event]:
        """Return where the reference began to be cut, and readings lost and found again."""
        events, self._events = self._events, []
        return events

    def _look(self, state: SnakeState) -> float:
        """Take the readings of a tick into `_reading` and the reference after it; return the time (s)."""
        time = float(state.time)
        self._events += self._readings.take(time, state.sensed)
        self._reading = self._readings.value
        self._wanted = np.full(self._reading.shape, float(self.reference.value(time + self._tick)))
        cut = bool(self.reference.beyond(time))
        if cut and not self._cut:
            text = f"the reference goes beyond the module's range and is cut at {self.reference.peak:.4g} rad"
            self._events.append(Event(time, "saturation", text))
        self._cut = self._cut or cut
        return time


# Found for generation 4 at 7 psi by benchmarks/gains.py, one set for all experiments of Chapter 4.
DIRECT_D_PER_S = 58.0
EPSILON_RAD_PER_S = math.radians(84.0)
CUTOFF_HZ = 16.0


@dataclass(eq=False)
class DirectSMC(SlidingMode):
    """Fills one chamber and vents the other, or holds both, anew every tick (module docstring).

    Attributes:
        D: slope of the sliding manifold, 1/s.
        epsilon: ε, half the width of the dead zone of σ, rad/s.
        cutoff_hz: of the velocity filter, Hz.
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
        """Return the valves of the coming tick, shape (segments, 2)."""
        time = self._look(state)
        self._filter.step(self._reading)
        self._rate = self._filter.rate
        self._error = self.reference.value(time) - self._filter.value
        self._sigma = self.reference.rate(time) - self._rate + self.D * self._error
        drive = np.where(np.abs(self._sigma) > self.epsilon, np.sign(self._sigma), 0.0).astype(np.int8)
        return np.stack([drive, -drive], axis=-1)

    def signals(self) -> dict[str, Any]:
        """Return those of `SlidingMode`, and the filtered rate of the bend, rad/s."""
        return super().signals() | {"rate": self._rate}


# Found for generation 4 at 7 psi by benchmarks/gains.py, one set for all experiments of Chapter 4.
K_S_PER_RAD = 0.042
ITERATIVE_D_PER_S = 16.0

CARRIER_HZ = 60.0
"""Fixed beforehand (Section 5.3)."""

EQ_29 = "K(de + D e)"
EQ_30 = "K de + D e"
FORMS = (EQ_29, EQ_30)
"""As Eq. 29 has it, with D in 1/s, and as Eq. 30 is printed, where D is in 1/rad."""


@dataclass(eq=False)
class IterativeSMC(SlidingMode):
    """Adjusts the duty of both chambers once a carrier period (module docstring).

    Attributes:
        K: gain, s/rad.
        D: slope of the sliding manifold, 1/s; 1/rad in the form that K does not multiply.
        carrier_hz: of the pulse-width modulation, Hz.
        form: one of `FORMS`.

    Raises:
        InputError: an unknown form.
    """

    kind = "iterative_smc"
    state_attributes = ("_pulses", "_mu", "_before", "_sum", "_count")
    layouts = ("3/2",)
    gains = ("K", "D")

    _: KW_ONLY
    K: Gain = K_S_PER_RAD
    D: Gain = ITERATIVE_D_PER_S
    carrier_hz: float = CARRIER_HZ
    form: str = EQ_29

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.form not in FORMS:
            raise UnknownNameError("form of Eq. 30", self.form, FORMS)
        self._slope = self.D if self.form == EQ_29 else np.asarray(self.D) / self.K

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: a tick that is no multiple of 0.1 ms or longer than a carrier period.
        """
        super().reset(spec, tick, seed=seed)
        self._pulses = PulseWidth(self.carrier_hz, tick, spec.segments)
        self._mu = np.zeros(spec.segments)
        self._before = np.zeros(spec.segments)
        self._sum = np.zeros(spec.segments)
        self._count = 0

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valves of the coming tick, shape (slots, segments, 2)."""
        self._error = self.reference.value(self._look(state)) - self._reading
        if self._pulses.due():
            self._update()
        self._sum, self._count = self._sum + self._error, self._count + 1
        return self._pulses.step(np.stack([(1 + self._mu) / 2, (1 - self._mu) / 2], axis=-1))

    def signals(self) -> dict[str, Any]:
        """Return those of `SlidingMode`, μ, and the duties of the period that runs."""
        plus, minus = self._pulses.duty.T
        return super().signals() | {"mu": self._mu, "duty_plus": plus, "duty_minus": minus}

    def _update(self) -> None:
        """Take the means since the last update; before the first one the error was 0."""
        elapsed = self._count * self._tick if self._count else self._pulses.period
        mean = self._sum / max(self._count, 1)
        self._sigma = (self._error - self._before) / elapsed + self._slope * mean
        self._mu = np.clip(self._mu + self.K * self._sigma, -1.0, 1.0)
        self._before, self._sum, self._count = self._error, np.zeros_like(self._sum), 0
