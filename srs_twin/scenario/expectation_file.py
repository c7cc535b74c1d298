"""What a scenario file expects of a metric."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from srs_twin.comparison.metrics import METRICS_LISTED
from srs_twin.errors import UnknownNameError
from srs_twin.io.validation import Strict
from srs_twin.scenario.expectation import COMPARISON, known_metrics
from srs_twin.scenario.fields import quantity, section

_BOUND = 1e9


class ExpectationFile(Strict):
    """What a metric must come out as: near a value (rel or abs), below or above one."""

    metric: str = Field(
        title="Metric", description="Name of the metric.", json_schema_extra={"enum": list(known_metrics())}
    )
    plant: Literal["analytical", "twin"] | None = section("Which plant's metric.", None)
    of: Literal["comparison"] | None = section("A metric of the comparison instead of a plant's.", None)
    near: float | None = quantity("The expected value", "the metric's unit", -_BOUND, _BOUND, None)
    rel: float | None = quantity("Relative tolerance of near", "", 1e-9, 100.0, None)
    abs: float | None = quantity("Absolute tolerance of near", "the metric's unit", 0.0, _BOUND, None)
    below: float | None = quantity("Highest allowed value", "the metric's unit", -_BOUND, _BOUND, None)
    above: float | None = quantity("Lowest allowed value", "the metric's unit", -_BOUND, _BOUND, None)
    source: str | None = Field(
        None,
        title="Source",
        min_length=1,
        max_length=1000,
        description="Where the value is published; none for our own.",
    )
    known: str | None = Field(
        None,
        title="Known",
        min_length=1,
        max_length=1000,
        description="Why it is missed, where that is known: `--check` lets it pass, `--strict` does not.",
    )

    @field_validator("metric")
    @classmethod
    def _is_a_metric(cls, metric: str) -> str:
        if metric not in known_metrics():
            raise ValueError(str(UnknownNameError("metric", metric, known_metrics(), METRICS_LISTED)))
        return metric

    @model_validator(mode="after")
    def _one_of_each(self) -> ExpectationFile:
        if (self.plant is None) == (self.of is None):
            raise ValueError("give either plant (analytical or twin) or of: comparison")
        if self.metric not in known_metrics(self.of or self.plant):
            right = "plant: analytical or plant: twin" if self.of else f"of: {COMPARISON}"
            raise ValueError(f"{self.metric} needs {right}")
        if sum(value is not None for value in (self.near, self.below, self.above)) != 1:
            raise ValueError("give exactly one of near, below and above")
        tolerances = sum(value is not None for value in (self.rel, self.abs))
        if tolerances != (self.near is not None):
            raise ValueError("near needs either rel or abs; below and above take neither")
        if self.near == 0 and self.rel is not None:
            raise ValueError("a relative tolerance of 0 allows nothing else; use abs")
        return self


class ExpectationsFile(Strict):
    """Expectations alone, for `srs-twin replay --expect`."""

    expect: Annotated[list[ExpectationFile], Field(min_length=1, max_length=200)] = section(
        "What must come out."
    )
