r"""AirBalance: what a chamber that fills should have taken in, and what of it is missing.

From the opening of a chamber's valve on, by told pressures and its segment's bend,

$$ \Delta (P\,V(q)) = c \int \dot n_{in}\,dt - (\lambda_0 + \lambda)\,K \int (P - P_a)\,dt, $$

with the flow of an orifice (`pneumatics/flow.py`) and the capacity K of a nominal chamber. What nobody knows
of a chamber, c and what seems to be missing of its air though it is sound, λ₀, is learnt from stroke to
stroke (linear regression that forgets), and so is how well strokes repeat themselves; a leak λ then shows
within one. Pressures that just lag keep such a balance as well, with a c and a λ₀ of their own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import compiled
from srs_twin.io.saved_state import Stateful
from srs_twin.pneumatics.chambers import AMBIENT_PA, volume
from srs_twin.pneumatics.flow import REFERENCE_PA, conductances, flow
from srs_twin.pneumatics.orifice import CRITICAL_RATIO
from srs_twin.robot.spec import RobotSpec

FLOW_SD, MISSING_SD = 0.15, 0.3
"""Of c and of λ₀ (1/s) before anything was seen."""
FORGETS, MOST_SEEN = 0.95, 40
"""What a stroke weighs after the next one, and from how many at most scatter is learnt."""
SCATTER, BEFORE, LEAST = 0.05, 3, 0.02
"""By what share of what flows in strokes differ at first, for how many that counts, and at the least."""
ALIKE = 16
"""So many messages of one stroke say as much as one that is independent."""
AMOUNT_SD = 0.013
"""By what an amount is off that is known at the moment of a message, as a share of K times the supply."""
SEVERITY, WEAKNESS = 0.3, 0.7
"""To within which share of it the rate of a leak, and what a weak supply lets in, is known."""
SHORTEST, LONGEST_GAP_S = 0.1, 0.1
"""From which inflow on a stroke tells something; a longer silence (s) ends it."""
SOUND = 0.9
"""Probability that nothing is wrong from which a chamber is learnt from."""
TAILS = 12.0
"""Degrees of freedom of Student's t: strokes are now and then far off, seldom by seven deviations."""


class Books(NamedTuple):
    """What is known of each chamber, shape (segments, 2, …); amounts over K times the supply's pressure.

    Attributes:
        fit: c and λ₀ (1/s).
        sure: the inverse of their covariance: of c, of both, of λ₀.
        noted: what the stroke adds to that and, weighted by it, to c and λ₀; its scatter above the usual.
        scatter: variance of what a stroke is off by, over the square of what flows in.
        seen: strokes that were learnt from.
        time: of the last pressure of a stroke, s; NaN: there is none.
        begun: amount at its beginning, and by what that may be off.
        reached: the same by now.
        rates: pressure over the supply's, and inflow by each variant (1/s).
        sums: their integrals since the beginning.
        told: logarithm of each variant's likelihood.
    """

    fit: np.ndarray
    sure: np.ndarray
    noted: np.ndarray
    scatter: np.ndarray
    seen: np.ndarray
    time: np.ndarray
    begun: np.ndarray
    reached: np.ndarray
    rates: np.ndarray
    sums: np.ndarray
    told: np.ndarray


class Chambers(NamedTuple):
    """What is taken for granted.

    Attributes:
        dead: volume without bend, m³.
        displacement: by what that grows with the bend, m³/rad.
        wide: of the inlets, J/(s Pa).
        unit: K times the supply's pressure, J.
        supply: its pressure, gauge, Pa.
        leaks: of each variant, 1/s.
        shares: of the supply's pressure.
    """

    dead: float
    displacement: float
    wide: float
    unit: float
    supply: float
    leaks: np.ndarray
    shares: np.ndarray


class AirBalance(Stateful):
    """Balances of all chambers, from message to message.

    Attributes:
        books: of what was seen.
    """

    state_attributes = ("books",)

    def __init__(self, spec: RobotSpec, *, supply_pa: float, variants: Sequence[tuple[float, float]]) -> None:
        """Know of each chamber what its robot's file says.

        Args:
            spec: the robot.
            supply_pa: gauge, Pa.
            variants: what may be so of a chamber: leak (1/s) and share of the supply's pressure, 0 if nothing
                comes in; sound first.
        """
        wide, _, capacity = conductances(spec, CRITICAL_RATIO)
        leaks, shares = np.array(variants, dtype=float).T
        self._chambers = Chambers(
            spec.chamber.dead_volume, spec.chamber.displacement, wide * REFERENCE_PA, capacity * supply_pa,
            supply_pa, leaks.copy(), shares.copy(),
        )  # fmt: skip
        each = (spec.segments, 2)
        self.books = Books(
            fit=np.tile([1.0, 0.0], (*each, 1)),
            sure=np.tile([1 / FLOW_SD**2, 0.0, 1 / MISSING_SD**2], (*each, 1)),
            noted=np.zeros((*each, 6)),
            scatter=np.full(each, SCATTER**2),
            seen=np.zeros(each),
            time=np.full(each, np.nan),
            begun=np.zeros((*each, 2)),
            reached=np.zeros((*each, 2)),
            rates=np.zeros((*each, 1 + len(variants))),
            sums=np.zeros((*each, 1 + len(variants))),
            told=np.zeros((*each, len(variants))),
        )

    def drop(self, chambers: np.ndarray) -> None:
        """Give up the strokes of some chambers (shape (segments, 2)), whose valves may have closed before."""
        self.books.time[chambers] = np.nan
        for each in (self.books.noted, self.books.sums, self.books.told):
            each[chambers] = 0.0

    def read(
        self,
        time: float,
        pressure: np.ndarray,
        bend: np.ndarray,
        bend_sd: np.ndarray,
        filled: np.ndarray,
        sound: np.ndarray,
    ) -> np.ndarray:
        """Take pressures.

        Args:
            time: s.
            pressure: gauge, shape (segments, 2), Pa, NaN where none came.
            bend: of each segment now, rad.
            bend_sd: by what that may be off, rad.
            filled: for how long each chamber's valve has let air in, shape (segments, 2), s; 0: it does not.
            sound: how probable it is that nothing is wrong with a segment.

        Returns:
            What this adds to the logarithms of the variants' likelihoods, shape (segments, 2, variants).
        """
        added = np.zeros_like(self.books.told)
        _read(time, pressure, bend, bend_sd, filled, sound, self.books, self._chambers, added)
        return added


@compiled
def _read(time, pressure, bend, bend_sd, filled, sound, books, chambers, added):  # type: ignore[no-untyped-def]
    """See `AirBalance.read`."""
    for j in range(pressure.shape[0]):
        for side in range(2):
            gauge, since = pressure[j, side], time - books.time[j, side]
            if math.isnan(gauge):
                continue
            goes_on = since < LONGEST_GAP_S and filled[j, side] > since - 1e-6
            noted, sums = books.noted[j, side], books.sums[j, side]
            if goes_on:
                # Where commands are lost a valve may have closed before what was last told: that counts once
                # the next message finds it open.
                if sums[1] > SHORTEST:
                    _note(j, side, books)
                    for k in range(len(added[j, side])):
                        told = _likelihood(j, side, k, chambers, books)
                        added[j, side, k] = told - books.told[j, side, k]
                        books.told[j, side, k] = told
            else:
                if noted[0] > 0.0 and sound[j] > SOUND:
                    _learn(j, side, books)
                books.time[j, side] = math.nan
                noted[:] = 0.0
                sums[:] = 0.0
                books.told[j, side, :] = 0.0
            if filled[j, side] <= 0.0:
                continue
            size, growth = volume(chambers.dead, chambers.displacement, bend[j], side)
            held = (gauge + AMBIENT_PA) / chambers.unit
            reached, rates = books.reached[j, side], books.rates[j, side]
            reached[0], reached[1] = held * size, held * abs(growth) * bend_sd[j]
            if not goes_on:
                books.begun[j, side, 0], books.begun[j, side, 1] = reached[0], reached[1]
            for k in range(len(rates)):
                if k == 0:
                    now = gauge / chambers.supply
                else:
                    now, line = 0.0, chambers.shares[k - 1] * chambers.supply
                    if line > 0.0:
                        passed, _, _ = flow(line + AMBIENT_PA, gauge + AMBIENT_PA, CRITICAL_RATIO)
                        now = chambers.wide * passed / chambers.unit
                if goes_on:
                    sums[k] += since * (rates[k] + now) / 2
                rates[k] = now
            books.time[j, side] = time


@compiled
def _doubt(sure):  # type: ignore[no-untyped-def]
    """Return the covariance of c and λ₀: of c, of both, of λ₀."""
    size = sure[0] * sure[2] - sure[1] ** 2
    return sure[2] / size, -sure[1] / size, sure[0] / size


@compiled
def _off(j, side, came, leak, books):  # type: ignore[no-untyped-def]
    """Return by what an amount is off, the variance of that, and how much of it is for want of c and λ₀."""
    held, fit = books.sums[j, side, 0], books.fit[j, side]
    flow_sd2, both, missing_sd2 = _doubt(books.sure[j, side])
    off = books.reached[j, side, 0] - books.begun[j, side, 0] - fit[0] * came + (fit[1] + leak) * held
    learnt = flow_sd2 * came**2 - 2 * both * came * held + missing_sd2 * held**2
    read = books.reached[j, side, 1] ** 2 + books.begun[j, side, 1] ** 2 + AMOUNT_SD**2
    return off, learnt + read + books.scatter[j, side] * came**2, learnt


@compiled
def _likelihood(j, side, variant, chambers, books):  # type: ignore[no-untyped-def]
    """Return the logarithm of a variant's likelihood."""
    came, leak = books.sums[j, side, 1 + variant], chambers.leaks[variant]
    off, variance, _ = _off(j, side, came, leak, books)
    variance += (SEVERITY * leak * books.sums[j, side, 0]) ** 2
    if chambers.shares[variant] < 1.0:
        variance += (WEAKNESS * came) ** 2
    return -math.log1p(off * off / variance / TAILS) * (TAILS + 1) / 2 - math.log(variance) / 2


@compiled
def _note(j, side, books):  # type: ignore[no-untyped-def]
    """Note what a stroke that may turn out to be sound says by now of c, λ₀ and its scatter."""
    came, held, noted = books.sums[j, side, 1], -books.sums[j, side, 0], books.noted[j, side]
    off, variance, learnt = _off(j, side, came, 0.0, books)
    weight = 1 / (ALIKE * (variance - learnt))
    noted[0] += weight * came * came
    noted[1] += weight * came * held
    noted[2] += weight * held * held
    noted[3] += weight * came * off
    noted[4] += weight * held * off
    noted[5] = (off**2 - variance) / came**2


@compiled
def _learn(j, side, books):  # type: ignore[no-untyped-def]
    """Learn c, λ₀ and how well strokes repeat themselves from one that was sound."""
    noted, sure, fit = books.noted[j, side], books.sure[j, side], books.fit[j, side]
    books.seen[j, side] = min(books.seen[j, side] + 1, MOST_SEEN)
    share = 1 / (books.seen[j, side] + BEFORE)
    scatter = books.scatter[j, side] + share * noted[5]
    books.scatter[j, side] = max(scatter, LEAST**2)
    sure[0] = FORGETS * sure[0] + (1 - FORGETS) / FLOW_SD**2 + noted[0]
    sure[1] = FORGETS * sure[1] + noted[1]
    sure[2] = FORGETS * sure[2] + (1 - FORGETS) / MISSING_SD**2 + noted[2]
    flow_sd2, both, missing_sd2 = _doubt(sure)
    fit[0] += flow_sd2 * noted[3] + both * noted[4]
    fit[1] += both * noted[3] + missing_sd2 * noted[4]
