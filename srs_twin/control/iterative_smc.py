r"""IterativeSMC: sliding mode control through the duty of pulse-width modulated 3/2 valves (Eq. 30).

Once a carrier period T

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

from typing import TYPE_CHECKING, Any

import numpy as np

from srs_twin.control.pwm import PulseWidth
from srs_twin.control.reference import Reference
from srs_twin.control.sliding import Gain, SlidingMode
from srs_twin.errors import UnknownNameError
from srs_twin.spec import RobotSpec

if TYPE_CHECKING:
    from srs_twin.plants.base import SnakeState

# Found for generation 4 at 7 psi by benchmarks/gains.py, one set for all experiments of Chapter 4.
K_S_PER_RAD = 0.042
D_PER_S = 16.0

CARRIER_HZ = 60.0
"""Fixed beforehand (Section 5.3)."""

EQ_29 = "K(de + D e)"
EQ_30 = "K de + D e"
FORMS = (EQ_29, EQ_30)
"""As Eq. 29 has it, with D in 1/s, and as Eq. 30 is printed, where D is in 1/rad."""


class IterativeSMC(SlidingMode):
    """Adjusts the duty of both chambers once a carrier period (module docstring)."""

    kind = "iterative_smc"
    layouts = ("3/2",)

    def __init__(
        self,
        reference: Reference,
        *,
        K: Gain = K_S_PER_RAD,
        D: Gain = D_PER_S,
        carrier_hz: float = CARRIER_HZ,
        form: str = EQ_29,
    ) -> None:
        """Make the controller.

        Args:
            reference: the bend to follow.
            K: gain, s/rad.
            D: slope of the sliding manifold, 1/s; 1/rad in the form that K does not multiply.
            carrier_hz: of the pulse-width modulation, Hz.
            form: one of `FORMS`.

        Raises:
            InputError: a gain that is not finite and above 0, or an unknown form.
        """
        super().__init__(reference, K=K, D=D)
        if form not in FORMS:
            raise UnknownNameError("form of Eq. 30", form, FORMS)
        self._gain, self._carrier = K, carrier_hz
        self._slope = D if form == EQ_29 else np.asarray(D) / K

    def reset(self, spec: RobotSpec, tick: float, *, seed: int = 0) -> None:
        """See `Controller.reset`.

        Raises:
            InputError: a tick that is no multiple of 0.1 ms or longer than a carrier period.
        """
        super().reset(spec, tick, seed=seed)
        self._pulses = PulseWidth(self._carrier, tick, spec.segments)
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
        self._mu = np.clip(self._mu + self._gain * self._sigma, -1.0, 1.0)
        self._before, self._sum, self._count = self._error, np.zeros_like(self._sum), 0
