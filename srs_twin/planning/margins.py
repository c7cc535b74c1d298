"""Margins with a probability: quantiles of the largest excursions of whole runs.

For each condition of following, a footprint file contains the largest excursions of n runs on random paths
beyond the edges of their footprint. With a probability of at least k/(n + 1), the excursion of a new run from
the same distribution is at most the k-th smallest of them, for any distribution (split conformal prediction:
Vovk et al. 2005; Lei et al. 2018). The margin of probability p has k = ⌈(n + 1) p⌉.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, model_validator

from srs_twin.errors import InputError
from srs_twin.io.validation import StrictModel
from srs_twin.plants.twin.mjcf.numerics import UNSTATED_CONTACT, ContactName
from srs_twin.robot.sourced import bounded

Share = Annotated[float, bounded(0.0, 1.0)]
Excursion = Annotated[float, bounded(-10.0, 1e3)]
Runs = Annotated[list[Excursion], Field(min_length=1, max_length=10_000)]
LOST_M = 1e3
"""Excursion that represents a run that did not arrive, m."""


class ConditionsFile(StrictModel):
    """Conditions of runs with a follower."""

    plant: Literal["analytical", "twin"] = Field(description="Plant of the runs.")
    contact: ContactName | None = Field(
        None, description="Contact of the twin (default preloaded); the analytical model has none."
    )
    chambers: Literal["lag", "orifice"] = Field("lag", description="Model of the chambers.")
    follower: Literal["bearing", "path"] = Field(description="Steering law.")
    gain_spread: Share = Field(0.0, description="Spread of the modules' gains, 0 to 1.")
    tau_spread: Share = Field(0.0, description="Spread of their time constants, 0 to 1.")
    bias_spread_rad: Share = Field(0.0, description="Spread of their rest bends, rad, 0 to 1.")
    turn_share: Share = Field(description="Share of the tightest turns in plans, 0 to 1.")
    delay_s: Annotated[float, bounded(0.0, 10.0)] = Field(description="Command delay, s, 0 to 10.")
    position_noise_m: Share = Field(description="Position noise of the camera, m, 0 to 1.")
    heading_noise_rad: Annotated[float, bounded(0.0, 3.0)] = Field(
        description="Heading noise of the camera, rad, 0 to 3."
    )
    run_up_m: Annotated[float, bounded(0.0, 100.0)] = Field(
        description="Length of the straight run-up, m, 0 to 100."
    )

    @model_validator(mode="before")
    @classmethod
    def _state_contact(cls, data: object) -> object:
        if isinstance(data, dict) and data.get("plant") == "twin" and data.get("contact") is None:
            return {**data, "contact": UNSTATED_CONTACT}
        return data

    @model_validator(mode="after")
    def _only_of_a_twin(self) -> ConditionsFile:
        if self.plant != "twin" and self.contact is not None:
            raise ValueError(f"contact {self.contact} belongs to plant twin; the {self.plant} model has none")
        return self

    def covers(self, other: ConditionsFile) -> bool:
        """Return whether results under these conditions are also bounds for other conditions.

        The other conditions must agree in plant, contact, chambers, follower and run-up, and must not be more
        difficult in any other number.
        """
        same = ("plant", "contact", "chambers", "follower", "run_up_m")
        return all(getattr(self, name) == getattr(other, name) for name in same) and all(
            getattr(self, name) >= getattr(other, name) - 1e-12 for name in _DIFFICULTIES
        )

    def excess_difficulty(self, other: ConditionsFile) -> float:
        """Return the sum of the relative differences to conditions that these cover."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in _DIFFICULTIES)
        return sum((own - covered) / own for own, covered in pairs if own > covered)


SPREADS = ("gain_spread", "tau_spread", "bias_spread_rad")
"""Keys of the standard deviations of module parameters, as in a robot file."""
_DIFFICULTIES = (*SPREADS, "turn_share", "delay_s", "position_noise_m", "heading_noise_rad")
"""Keys that make following more difficult as they increase."""


class ExcursionsFile(StrictModel):
    """Largest excursion of each run, m; 1000: the run did not arrive."""

    conditions: ConditionsFile = Field(description="Conditions of the runs.")
    source: str = Field(min_length=1, max_length=1000, description="Source of the measurements.")
    path_m: Runs = Field(description="Largest excursion of each run, rising, m.")
    run_up_m: Runs | None = Field(
        None, description="Largest excursion of each run on the straight run-up, rising, m."
    )


@dataclass(frozen=True)
class Margin:
    """Width added to the edges of a footprint.

    Attributes:
        path: margin along the path, m.
        run_up: margin on the straight run-up, m.
    """

    path: float = 0.0
    run_up: float = 0.0


def excursion_quantile(excursions: Sequence[float], probability: float) -> float:
    """Return the excursion of a new run that is not exceeded with a probability, m; at least 0.

    Raises:
        InputError: too few runs, or too many of them did not arrive.
    """
    count = len(excursions)
    # The tolerance absorbs rounding of products such as 20 · 0.95.
    rank = math.ceil((count + 1) * probability - 1e-9)
    if rank > count:
        least = math.ceil(probability / (1 - probability) - 1e-9)
        raise InputError(f"a margin of probability {probability:g} needs at least {least} runs, not {count}")
    excursion = sorted(excursions)[rank - 1]
    if excursion >= LOST_M:
        raise InputError(f"there is no margin of probability {probability:g}: too many runs did not arrive")
    return max(excursion, 0.0)


def margin_for(
    measured: Sequence[ExcursionsFile], probability: float, conditions: Sequence[ConditionsFile]
) -> Margin:
    """Return the margin for a run under each of several conditions.

    Args:
        measured: excursions of a footprint file.
        probability: probability that a whole run stays within the margin.
        conditions: conditions of the run, one per plant.

    Raises:
        InputError: no measurement covers the conditions, or it has too few runs.
    """
    paths, run_ups = [0.0], [0.0]
    for condition in conditions:
        covering = [block for block in measured if block.conditions.covers(condition)]
        if not covering:
            items = condition.model_dump(exclude_none=True).items()
            text = ", ".join(f"{key} {value}" for key, value in items)
            raise InputError(
                f"no excursions are measured for {text}; `srs-twin calibrate margin` measures them"
            )
        # Use one block only: the smallest quantile of several blocks would be exceeded more often than
        # stated.
        block = min(covering, key=lambda block: block.conditions.excess_difficulty(condition))
        paths.append(excursion_quantile(block.path_m, probability))
        run_ups.append(excursion_quantile(block.run_up_m or [0.0] * len(block.path_m), probability))
    return Margin(max(paths), max(run_ups))
