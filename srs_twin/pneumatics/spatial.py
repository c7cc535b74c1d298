r"""Chambers that bend the segments of a spatial robot in several directions.

Each chamber c fills and vents with a first-order lag, as in `lag`. A second lag with
the time constant τ₂ yields the lagged pressure p̂_c. Chamber c bends the segment in the
direction of the unit vector d_c (`Chamber.directions`), and φ is the bend law from
`chambers`. The free bend q is a vector with components to the left and upwards:

$$ x = G \sum_c g_c\, \hat p_c\, d_c, \qquad q = b + \varphi(|x|)\, x / |x| . $$

The bend limit therefore applies to the magnitude of the bend. A chamber has the volume
V = V₀ + A max(0, q · d_c), which grows with the bend in the direction d_c.
"""

from __future__ import annotations

import numpy as np

from srs_twin.pneumatics.base import OptionalArray, Trace, check_supply
from srs_twin.pneumatics.chambers import AMBIENT_PA, chamber_gains, vector_bends
from srs_twin.pneumatics.lag import LagChambers, lag_response, relax, relaxation_of
from srs_twin.pneumatics.valves import Schedule
from srs_twin.robot.spec import RobotSpec


class SpatialLagPneumatics(LagChambers):
    """Chambers of a spatial robot with a first-order lag.

    All arrays of bends, including those in a `Trace`, have shape (…, segments, 2), with
    components to the left and upwards. Arrays of pressures and valve states have shape
    (…, segments, chambers).
    """

    state_attributes = ("_lagged", "_supply")

    def _prepare(
        self, spec: RobotSpec, tau_fill: np.ndarray, tau_vent: np.ndarray
    ) -> None:
        self._spec = spec
        self._fill = 1 / tau_fill
        self._vent = 1 / tau_vent

    def reset(self) -> None:
        """Vent all chambers to ambient pressure and close all inlets."""
        if self.rest_bend.ndim == 1:  # Rest bends have no upward component.
            self.rest_bend = np.stack(
                [self.rest_bend, np.zeros_like(self.rest_bend)], axis=-1
            )
        super().reset()
        self._lagged = np.zeros_like(self.pressure)

    def set_supply_pressure(self, supply_pa: float) -> None:
        """Set the gauge supply pressure (Pa), which takes effect immediately."""
        check_supply(supply_pa, self._max_supply)
        self._supply = supply_pa

    def _simulate(
        self,
        schedule: Schedule,
        times: np.ndarray,
        bend: OptionalArray,
        bend_rate: OptionalArray,
    ) -> Trace:
        trace = self._empty_trace(len(times))
        drawn = self.pneumatic_energy
        ends = np.append(schedule.starts[1:], schedule.span)
        rows = np.searchsorted(times, ends[:-1], side="right")
        bounds = [0, *rows, len(times)]
        for run, (start, end) in enumerate(zip(schedule.starts, ends, strict=True)):
            state = schedule.states[run]
            part = slice(bounds[run], bounds[run + 1])
            after = np.append(times[part] - start, end - start)
            pressure, lagged, free = self._propagate(state, after)
            air = drawn + self._drawn(state, after, pressure, free)
            trace.pressure[part] = pressure[:-1]
            trace.bend[part] = free[:-1]
            trace.pneumatic_energy[part] = air[:-1]
            trace.valves[part] = state
            trace.bend_rate[part], trace.bend_acceleration[part] = self._rates(
                state, pressure[:-1], lagged[:-1], free[:-1]
            )
            self.pressure = pressure[-1]
            self._lagged = lagged[-1]
            self.bend = free[-1]
            drawn = float(air[-1])
        self.pneumatic_energy = drawn
        return trace

    def _relaxation(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return relaxation_of(
            np.where(state == 1, self._fill, 0.0),
            np.where(state == -1, self._vent, 0.0),
            self._supply,
            self._leak,
        )

    def _propagate(
        self, state: np.ndarray, times: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        relaxation = self._relaxation(state)
        tau = self._spec.actuator.tau_mode
        after = times[:, None, None]
        pressure = relax(self.pressure, *relaxation, after)
        lagged = lag_response(self._lagged, self.pressure, relaxation, tau, after)
        return pressure, lagged, self.rest_bend + vector_bends(self._spec, lagged)

    def _rates(
        self,
        state: np.ndarray,
        pressure: np.ndarray,
        lagged: np.ndarray,
        free: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return rates (rad/s) and accelerations (rad/s²) of the free bends.

        The bend law is approximated by a line with the secant slope φ(|x|)/|x|.
        """
        rate, end = self._relaxation(state)
        tau = self._spec.actuator.tau_mode
        gains = chamber_gains(self._spec)
        speed = (pressure - lagged) / tau
        rise = (rate * (end - pressure) - speed) / tau
        axes = self._spec.chamber.axes
        linear = (gains * lagged) @ axes
        size = np.maximum(np.linalg.norm(linear, axis=-1, keepdims=True), 1e-9)
        derivative = np.where(
            size > 1e-9,
            np.linalg.norm(free - self.rest_bend, axis=-1, keepdims=True) / size,
            1,
        )
        return derivative * ((gains * speed) @ axes), derivative * (
            (gains * rise) @ axes
        )

    def _drawn(
        self,
        state: np.ndarray,
        times: np.ndarray,
        pressure: np.ndarray,
        free: np.ndarray,
    ) -> np.ndarray:
        chamber = self._spec.chamber

        def content(
            pressure: np.ndarray, bend: np.ndarray, ambient: float
        ) -> np.ndarray:
            volume = chamber.dead_volume + chamber.displacement * np.maximum(
                0.0, bend @ chamber.axes.T
            )
            amount: np.ndarray = ((pressure + ambient) * volume * (state == 1)).sum(
                axis=(-2, -1)
            )
            return amount

        amount = content(pressure, free, AMBIENT_PA) - content(
            self.pressure, self.bend, AMBIENT_PA
        )
        if self._leak:
            held = content(pressure, free, 0.0)
            before = np.append(content(self.pressure, self.bend, 0.0), held[:-1])
            amount = amount + self._leak * np.cumsum(
                (held + before) / 2 * np.diff(times, prepend=0.0)
            )
        worth = self._supply / (self._supply + AMBIENT_PA)
        return np.asarray(worth * amount)
