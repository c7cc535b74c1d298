"""Margins with a probability: quantiles of how far the body left its planned footprint, over whole runs.

A footprint file keeps, for each setting in which a follower was tried on random ways, the largest excursion
of every run beyond the footprint's edges. Of n such runs and one to come that is drawn as they were, the new
one stays within their k-th smallest with a probability of k/(n + 1) at least, whatever the distribution is
(split conformal prediction: Vovk et al. 2005; Lei et al. 2018). A margin of probability p is the one with
k = ⌈(n + 1) p⌉.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from srs_twin.errors import InputError
from srs_twin.io.validation import Strict
from srs_twin.plants.twin.mjcf.numerics import UNSTATED_CONTACT, ContactName
from srs_twin.robot.sourced import between

Share = Annotated[float, between(0.0, 1.0)]
Excursion = Annotated[float, between(-10.0, 1e3)]
Runs = Annotated[list[Excursion], Field(min_length=1, max_length=10_000)]
LOST_M = 1e3
"""Stands for the excursion of a run that never arrived, m."""


class ConditionsFile(Strict):
    """Under which a follower was tried."""

    plant: Literal["analytical", "twin"] = Field(description="What was run.")
    contact: ContactName | None = Field(
        None, description="Contact of the twin (default preloaded); the analytical model has none."
    )
    chambers: Literal["lag", "orifice"] = Field("lag", description="How its chambers fill.")
    follower: Literal["bearing", "path"] = Field(description="Which follower.")
    gain_spread: Share = Field(0.0, description="Of the modules' gains, 0 to 1.")
    tau_spread: Share = Field(0.0, description="Of their lags, 0 to 1.")
    bias_spread_rad: Share = Field(0.0, description="Of their bends without pressure, rad, 0 to 1.")
    turn_share: Share = Field(description="Of the tightest turns, planned with, 0 to 1.")
    delay_s: Annotated[float, between(0.0, 10.0)] = Field(description="Of commands, s, 0 to 10.")
    position_noise_m: Share = Field(description="Of the camera, m, 0 to 1.")
    heading_noise_rad: Annotated[float, between(0.0, 3.0)] = Field(description="Of the camera, rad, 0 to 3.")
    run_up_m: Annotated[float, between(0.0, 100.0)] = Field(description="Straight beginning, m, 0 to 100.")

    @model_validator(mode="before")
    @classmethod
    def _state_contact(cls, given: Any) -> Any:
        if isinstance(given, dict) and given.get("plant") == "twin" and given.get("contact") is None:
            return {**given, "contact": UNSTATED_CONTACT}
        return given

    @model_validator(mode="after")
    def _only_of_a_twin(self) -> ConditionsFile:
        if self.plant != "twin" and self.contact is not None:
            raise ValueError(f"contact {self.contact} belongs to plant twin; the {self.plant} model has none")
        return self

    def covers(self, other: ConditionsFile) -> bool:
        """Say whether what was tried under these holds under others too: theirs are no harder."""
        same = ("plant", "contact", "chambers", "follower", "run_up_m")
        return all(getattr(self, each) == getattr(other, each) for each in same) and all(
            getattr(self, each) >= getattr(other, each) - 1e-12 for each in _HARDER
        )

    def harder(self, other: ConditionsFile) -> float:
        """Return by how much these are harder than others that they cover, as a sum of shares."""
        pairs = ((getattr(self, each), getattr(other, each)) for each in _HARDER)
        return sum((own - its) / own for own, its in pairs if own > its)


SPREADS = ("gain_spread", "tau_spread", "bias_spread_rad")
_HARDER = (*SPREADS, "turn_share", "delay_s", "position_noise_m", "heading_noise_rad")


class ExcursionsFile(Strict):
    """How far the body left its planned footprint, the largest of each run, m; 1000: it never arrived."""

    conditions: ConditionsFile = Field(description="Under which.")
    source: str = Field(min_length=1, max_length=1000, description="How they were measured.")
    path_m: Runs = Field(description="Of each run beyond the edges of its footprint, rising, m.")
    run_up_m: Runs | None = Field(None, description="The same over the straight beginning, rising, m.")


@dataclass(frozen=True)
class Margin:
    """What edges are widened by.

    Attributes:
        path: along the path, m.
        run_up: over the straight beginning, m.
    """

    path: float = 0.0
    run_up: float = 0.0


def quantile(excursions: Sequence[float], probability: float) -> float:
    """Return what a new run stays within with a probability (module docstring), m.

    Raises:
        InputError: too few runs, or too many of them never arrived.
    """
    count = len(excursions)
    rank = math.ceil((count + 1) * probability - 1e-9)
    if rank > count:
        least = math.ceil(probability / (1 - probability) - 1e-9)
        raise InputError(f"a margin of probability {probability:g} takes {least} runs or more, not {count}")
    found = sorted(excursions)[rank - 1]
    if found >= LOST_M:
        raise InputError(f"there is no margin of probability {probability:g}: too many runs did not arrive")
    return max(found, 0.0)


def margin(
    measured: Sequence[ExcursionsFile], probability: float, wanted: Sequence[ConditionsFile]
) -> Margin:
    """Return the margin that holds under all of some conditions.

    Args:
        measured: what a footprint file keeps.
        probability: that a whole run stays within it.
        wanted: the conditions, one for each plant.

    Raises:
        InputError: none was measured under conditions as hard, or with too few runs.
    """
    paths, run_ups = [0.0], [0.0]
    for each in wanted:
        fit = [block for block in measured if block.conditions.covers(each)]
        if not fit:
            told = ", ".join(f"{key} {value}" for key, value in each.model_dump(exclude_none=True).items())
            raise InputError(f"no excursions were measured for {told}; `srs-twin calibrate margin` does")
        # The least of several would be below the quantile more often than it may.
        block = min(fit, key=lambda block: block.conditions.harder(each))
        paths.append(quantile(block.path_m, probability))
        run_ups.append(quantile(block.run_up_m or [0.0] * len(block.path_m), probability))
    return Margin(max(paths), max(run_ups))
