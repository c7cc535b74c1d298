r"""Gait that yields to contact: shape-based compliance, or blocked segments that hold or vent.

All estimates come from sensors. The pressures give the free bend f_j of each segment
(`pneumatics.chambers`); the deviation of the reading q_j is the moment of the load M_j
over the stiffness k,

$$ e_j = q_j - f_j = M_j / k . $$

**Shape-based compliance** (Travers, Whitman and Choset, 2018): an inverse_effective_mass lets the
moments of the load change a parameter of the wave, here the amplitude a, relative to
that of full pressure, or the lag β per segment. Its first-order form is

$$ T \dot a + a - a_0 = g\,F_a, \qquad T \dot\beta + \beta - \beta_0 = g\,F_\beta, $$

where F is the change of the parameter that explains the deviations best. With the free
bend q_m at full pressure, the place s_j of a segment relative to the middle of the
body, and the cosine c_j of its phase, delayed by the chambers, this is for n segments

$$ F_a = \frac{2}{n q_m^2} \sum_j f_j\,e_j, \qquad
   F_\beta = -\frac{24}{n (n^2 - 1)\,q_m} \sum_j s_j\,c_j\,e_j . $$

A load that flattens the wave has F_a < 0. With g > 0 the wave yields to it, with g < 0
it pushes harder. Valves only open and close, so both chambers vent around the sign
changes of the wave; the fundamental of the wave then has the amplitude a (`gait`).

**Blocked segments.** A segment is blocked from the moment when its reading lags behind
its free bend by more than a threshold, until the lag falls below half of it or the wave
changes its sign. Its valves then hold the air, or both of its chambers vent.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from srs_twin.compute.arrays import check_positive
from srs_twin.control.base import SensorReadings
from srs_twin.control.gait import Gait
from srs_twin.errors import InputError, check_choice
from srs_twin.pneumatics.chambers import air_bend, largest_bend
from srs_twin.robot.spec import RobotSpec
from srs_twin.trajectory import Event

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState

RESPONSES = ("amplitude", "wave_number", "hold", "vent")
SMALLEST_AMPLITUDE = 0.2
"""Smallest amplitude of the wave relative to that of full pressure, 1."""
_LARGEST_CHANGE = 0.5  # of the lag per segment, relative to its nominal value


def layouts_of(response: str) -> tuple[str, ...]:
    """Return the valve layouts that a response needs: only separate inlets and outlets can hold."""
    if response == "hold":
        return ("in_out",)
    return Gait.layouts


def check_robot(spec: RobotSpec) -> None:
    """Check that a robot has two or more segments that bend in one plane.

    Raises:
        InputError: it has not.
    """
    spec.require_planar("a yielding gait")
    if spec.segments < 2:
        raise InputError(
            f"a yielding gait needs two or more segments; {spec.name} has one"
        )


class YieldingGait(Gait):
    """Gait of Eq. 13 that yields to contact (module docstring).

    Attributes:
        response: one of `RESPONSES`.
        amplitude: a, 1.
        lag: β, rad.
        blocked: whether a segment is blocked, shape (segments,).
    """

    kind = "yielding_gait:YieldingGait"
    state_attributes = (
        "rest_level",
        "amplitude",
        "lag",
        "blocked",
        "_readings",
        "_events",
    )
    layouts: tuple[str, ...] = Gait.layouts
    spatial = False

    def __init__(
        self,
        frequency: float,
        offset: float = 0.0,
        *,
        response: str = "amplitude",
        gain: float = 0.5,
        time: float = 0.3,
        amplitude: float = 0.8,
        threshold: float = 0.25,
        phase: float = 0.0,
        phase_step: float | None = None,
    ) -> None:
        """Create the gait.

        Args:
            frequency: f, Hz.
            offset: φ, between −1 and 1, positive to the left.
            response: reaction to contact, one of `RESPONSES`.
            gain: g of the inverse_effective_mass, 1.
            time: T of the inverse_effective_mass, s.
            amplitude: a₀, from `SMALLEST_AMPLITUDE` to 1; "hold" and "vent" keep it.
            threshold: lag of the bend above which a segment is blocked, rad; "hold" and
                "vent" only.
            phase: ψ at time 0, rad.
            phase_step: β₀, rad; None uses that of the robot.

        Raises:
            InputError: an argument is out of range.
        """
        super().__init__(frequency, offset, phase=phase, phase_step=phase_step)
        check_choice("response", response, RESPONSES)
        check_positive("time of the inverse_effective_mass", time, "s")
        check_positive("threshold", threshold, "rad")
        if not SMALLEST_AMPLITUDE <= amplitude <= 1:
            raise InputError(
                f"amplitude {amplitude!r} is not allowed; it must be"
                f" {SMALLEST_AMPLITUDE} to 1"
            )
        self.response = response
        self.gain = gain
        self.time = time
        self.threshold = threshold
        self.amplitude = self._nominal_amplitude = amplitude
        self.layouts = layouts_of(response)

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: the robot is spatial or has a single segment.
        """
        check_robot(spec)
        super().reset(spec, tick)
        n = spec.segments
        self._spec = spec
        self._place = np.arange(n) - (n - 1) / 2
        self._full_bend = largest_bend(spec, spec.supply.nominal)
        self._delay = math.atan(2 * math.pi * self.frequency * spec.actuator.tau_fill)
        self._nominal_lag = self.lag = (
            spec.phase_step if self._phase_step is None else self._phase_step
        )
        self.amplitude = self._nominal_amplitude
        self.blocked = np.zeros(n, dtype=bool)
        self.rest_level = math.sqrt(1 - self.amplitude**2)
        self._readings = SensorReadings(n)
        self._events = list[Event]()

    def script(self, duration: float) -> None:  # type: ignore[override]
        """Return None: the valve states depend on the sensors."""

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valve states of the next tick."""
        time = float(state.time)
        self._events += self._readings.update(time, state.measured_bend)
        free = air_bend(self._spec, np.asarray(state.pressure, dtype=float))
        load = np.nan_to_num(self._readings.value - free)
        if self.response == "amplitude":
            self._adapt_amplitude(np.nan_to_num(free), load)
        elif self.response == "wave_number":
            self._adapt_lag(time, load)
        valves = self.valves_at(time)
        if self.response in RESPONSES[:2]:
            return valves
        return self._relieve(valves, np.sign(free), load)

    def _adapt_amplitude(self, free: np.ndarray, load: np.ndarray) -> None:
        force = 2 / (len(load) * self._full_bend**2) * float(free @ load)
        change = self._nominal_amplitude - self.amplitude + self.gain * force
        self.amplitude += min(self._tick / self.time, 1.0) * change
        self.amplitude = min(max(self.amplitude, SMALLEST_AMPLITUDE), 1.0)
        self.rest_level = math.sqrt(1 - self.amplitude**2)

    def _adapt_lag(self, time: float, load: np.ndarray) -> None:
        n = len(load)
        nominal = self._nominal_lag
        before = self.lag
        phase = 2 * math.pi * self.frequency * time - self.phase_lag - self._delay
        force = (
            -24
            / (n * (n**2 - 1) * self._full_bend)
            * float((self._place * np.cos(phase)) @ load)
        )
        self.lag += min(self._tick / self.time, 1.0) * (
            nominal - self.lag + self.gain * force
        )
        span = _LARGEST_CHANGE * abs(nominal)
        self.lag = min(max(self.lag, nominal - span), nominal + span)
        self.phase_lag = self.phase_lag + (self.lag - before) * self._place

    def _relieve(
        self, valves: np.ndarray, side: np.ndarray, load: np.ndarray
    ) -> np.ndarray:
        """Return the valve states with those of blocked segments held or vented.

        Args:
            valves: states of the wave, shape (segments, 2) or (slots, segments, 2).
            side: side to which the air bends each segment, ±1, shape (segments,).
            load: e, same shape, rad.
        """
        first = valves.reshape(-1, *valves.shape[-2:])[0, :, 0]
        limit = np.where(self.blocked, self.threshold / 2, self.threshold)
        self.blocked = (-side * load > limit) & (side == first)
        valves = valves.copy()
        if self.response == "hold":
            valves[..., self.blocked, :] = 0
        else:
            valves[..., self.blocked, :] = -1
        return valves

    def signals(self) -> dict[str, float]:
        """Return offset, amplitude, lag per segment, and number of blocked segments."""
        shape = {"wave_amplitude": self.amplitude, "phase_step": self.lag}
        return super().signals() | shape | {"blocked": float(self.blocked.sum())}
