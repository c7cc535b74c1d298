r"""DirectSMC: sliding mode control by valve states, with separate inlet and outlet valves (Eq. 31).

$$ \sigma > \varepsilon: \text{fill +, vent −}; \qquad \sigma < -\varepsilon: \text{vent +, fill −};
\qquad |\sigma| \le \varepsilon: \text{hold both}. $$

At rest σ = D e, so that errors below ε/D stay. The bend and its rate both come from one `VelocityFilter`:
with the same lag in both, σ is the true one a little later, and the noise of D e is filtered as well.
The printed D = 0.5 1/s would slide with a time constant of 2 s, and the printed ε = 2°/s is less than the
noise of any rate that is fast enough (E6).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.control.reference import Reference
from srs_twin.control.sliding import Gain, SlidingMode
from srs_twin.control.velocity import VelocityFilter
from srs_twin.spec import RobotSpec

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState

# Found for generation 4 at 7 psi by benchmarks/gains.py, one set for all experiments of Chapter 4.
D_PER_S = 58.0
EPSILON_RAD_PER_S = math.radians(84.0)
CUTOFF_HZ = 16.0


class DirectSMC(SlidingMode):
    """Fills one chamber and vents the other, or holds both, anew every tick (module docstring)."""

    kind = "direct_smc"
    layouts = ("in_out",)

    def __init__(
        self,
        reference: Reference,
        *,
        D: Gain = D_PER_S,
        epsilon: Gain = EPSILON_RAD_PER_S,
        cutoff_hz: Gain = CUTOFF_HZ,
    ) -> None:
        """Make the controller.

        Args:
            reference: the bend to follow.
            D: slope of the sliding manifold, 1/s.
            epsilon: ε, half the width of the dead zone of σ, rad/s.
            cutoff_hz: of the velocity filter, Hz.

        Raises:
            InputError: a gain that is not finite and above 0.
        """
        super().__init__(reference, D=D, epsilon=epsilon, cutoff_hz=cutoff_hz)
        self._slope, self._dead, self._cutoff = D, epsilon, cutoff_hz

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`."""
        super().reset(spec, tick, seed=seed)
        self._filter = VelocityFilter(self._cutoff, tick)
        self._rate: np.ndarray = np.zeros(spec.segments)

    def step(self, state: SnakeState) -> np.ndarray:
        """Return the valves of the coming tick, shape (segments, 2)."""
        time = self._look(state)
        self._filter.step(self._reading)
        self._rate = self._filter.rate
        self._error = self.reference.value(time) - self._filter.value
        self._sigma = self.reference.rate(time) - self._rate + self._slope * self._error
        drive = np.where(np.abs(self._sigma) > self._dead, np.sign(self._sigma), 0.0).astype(np.int8)
        return np.stack([drive, -drive], axis=-1)

    def signals(self) -> dict[str, Any]:
        """Return those of `SlidingMode`, and the filtered rate of the bend, rad/s."""
        return super().signals() | {"rate": self._rate}
