"""Model of the sweep file, which validates it strictly."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from srs_twin.scenario.fields import Line, PathOrName, Section, quantity
from srs_twin.studies.sweep.table import MAX_FIELDS, FieldName, FieldValues, Plain, Plot, Published

MAX_POINTS = 1_000_000
"""Largest number of points of a sweep."""


class RangeFile(Section):
    """Range of values, both ends included."""

    start: float = Field(alias="from", ge=-1e12, le=1e12, title="From", description="First value.")
    stop: float = Field(alias="to", ge=-1e12, le=1e12, title="To", description="Last value.")
    count: int | None = quantity(2, 10_000, None)
    """Number of values (grid, list)."""
    scale: Literal["linear", "log"] = "linear"
    """Spacing of the values; log: equal ratios."""

    @model_validator(mode="after")
    def _ascending(self) -> RangeFile:
        if not self.start < self.stop:
            raise ValueError(f"from must be below to, but {self.start:g} is not below {self.stop:g}")
        if self.scale == "log" and self.start <= 0:
            raise ValueError(f"scale: log needs values above 0, but from is {self.start:g}")
        return self


def _values_or_range(value: Any) -> str:
    return "range" if isinstance(value, dict | RangeFile) else "values"


_OneOf = Annotated[FieldValues, Tag("values")] | Annotated[RangeFile, Tag("range")]
Varied = Annotated[_OneOf, Discriminator(_values_or_range)]


class SamplingFile(Section):
    """Method that combines the values of several fields."""

    kind: Literal["grid", "list", "latin_hypercube", "sobol"] = "grid"
    """grid: all combinations; list: first with first, second with second; latin_hypercube and sobol:
    space-filling points over the ranges."""
    count: int | None = quantity(1, MAX_POINTS, None)
    """Number of points (latin_hypercube; sobol: a power of 2)."""
    seed: int | None = quantity(0, 2**32 - 1, None)
    """Random seed of the points (latin_hypercube, sobol; default 0)."""

    @model_validator(mode="after")
    def _check_combinations(self) -> SamplingFile:
        is_random = self.kind in ("latin_hypercube", "sobol")
        if is_random and self.count is None:
            raise ValueError(f"{self.kind} needs a count")
        for name in ("count", "seed"):
            if not is_random and getattr(self, name) is not None:
                raise ValueError(f"{name} is only for latin_hypercube and sobol, not for {self.kind}")
        if self.kind == "sobol" and self.count is not None and self.count & (self.count - 1):
            below = 1 << (self.count.bit_length() - 1)
            raise ValueError(
                f"sobol points are balanced in powers of 2 only: {below} or {2 * below}, not {self.count}"
            )
        return self


class SweepFile(Section):
    """Runs of one scenario over many values of its fields."""

    title: Line | None = None
    """Title, one line (default: the name)."""
    scenario: PathOrName
    """Scenario, a shipped name or the path of a file."""
    plants: Annotated[list[Literal["analytical", "twin"]], Field(max_length=2)] | None = None
    """Plants that run (default: those of the scenario); []: none, the scenario is only planned."""
    periods: float | None = quantity(3.0, 1000.0, None)
    """Simulated time in periods of the gait or the reference, instead of duration_s, in whole ticks."""
    fixed: Annotated[dict[FieldName, Plain], Field(max_length=64)] = {}
    """Fields with a different value than in the scenario."""
    vary: Annotated[dict[FieldName, Varied], Field(min_length=1, max_length=MAX_FIELDS)]
    """Varied fields of the scenario, dotted (supply.pressure_kpa); each a list, or from, to, count."""
    sampling: SamplingFile = SamplingFile()
    """Combination of the values."""
    metrics: Annotated[list[FieldName], Field(min_length=1, max_length=64)] | None = None
    """Metrics that become columns (default: all)."""
    trajectories: bool = False
    """Whether trajectories are stored as well."""
    plots: Annotated[list[Plot], Field(max_length=32)] = []
    """Plots of the results."""
    beside: Published | None = None
    """Published values to compare with."""


def sweep_json_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of sweep files."""
    schema = SweepFile.model_json_schema(by_alias=True)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema
