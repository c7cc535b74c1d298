"""The sweep file as a strict model."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, model_validator

from srs_twin.scenario.fields import Line, PathOrName, Section, quantity
from srs_twin.studies.sweep.table import MAX_FIELDS, FieldName, FieldValues, Plain, Plot, Published

MAX_POINTS = 1_000_000


class RangeFile(Section):
    """Values from one end to the other, both included."""

    start: float = Field(alias="from", ge=-1e12, le=1e12, title="From", description="First value.")
    stop: float = Field(alias="to", ge=-1e12, le=1e12, title="To", description="Last value.")
    count: int | None = quantity(2, 10_000, None)
    """How many values (grid, list)."""
    scale: Literal["linear", "log"] = "linear"
    """How values are spaced; log: by equal ratios."""

    @model_validator(mode="after")
    def _ascending(self) -> RangeFile:
        if not self.start < self.stop:
            raise ValueError(
                f"from comes first and is the lower one, but {self.start:g} is not below {self.stop:g}"
            )
        if self.scale == "log" and self.start <= 0:
            raise ValueError(f"scale: log needs values above 0, but from is {self.start:g}")
        return self


def _values_or_range(value: Any) -> str:
    return "range" if isinstance(value, dict | RangeFile) else "values"


_OneOf = Annotated[FieldValues, Tag("values")] | Annotated[RangeFile, Tag("range")]
Varied = Annotated[_OneOf, Discriminator(_values_or_range)]


class SamplingFile(Section):
    """How the values of several fields are put together."""

    kind: Literal["grid", "list", "latin_hypercube", "sobol"] = "grid"
    """grid: every value with every other; list: first with first, second with second; latin_hypercube and
    sobol: so many points spread over the ranges."""
    count: int | None = quantity(1, MAX_POINTS, None)
    """Points (latin_hypercube; sobol: a power of 2)."""
    seed: int | None = quantity(0, 2**32 - 1, None)
    """Seed of the points (latin_hypercube, sobol; default 0)."""

    @model_validator(mode="after")
    def _what_belongs_together(self) -> SamplingFile:
        drawn = self.kind in ("latin_hypercube", "sobol")
        if drawn and self.count is None:
            raise ValueError(f"{self.kind} needs a count")
        for name in ("count", "seed"):
            if not drawn and getattr(self, name) is not None:
                raise ValueError(f"{name} belongs to latin_hypercube and sobol, not to {self.kind}")
        if self.kind == "sobol" and self.count is not None and self.count & (self.count - 1):
            below = 1 << (self.count.bit_length() - 1)
            raise ValueError(
                f"sobol points are balanced in powers of 2 only: {below} or {2 * below}, not {self.count}"
            )
        return self


class SweepFile(Section):
    """One scenario over many values of its fields."""

    title: Line | None = None
    """One line for people (default: the name)."""
    scenario: PathOrName
    """A shipped name or the path of a file."""
    plants: Annotated[list[Literal["analytical", "twin"]], Field(max_length=2)] | None = None
    """Which plants run (default: those that the scenario names); []: none, the scenario is only planned."""
    periods: float | None = quantity(3.0, 1000.0, None)
    """Simulated time in periods of the gait or the reference, instead of duration_s, in whole ticks."""
    fixed: Annotated[dict[FieldName, Plain], Field(max_length=64)] = {}
    """Fields of the scenario that are otherwise than in its file."""
    vary: Annotated[dict[FieldName, Varied], Field(min_length=1, max_length=MAX_FIELDS)]
    """Varied fields of the scenario, dotted (supply.pressure_kpa); each a list, or from, to, count."""
    sampling: SamplingFile = SamplingFile()
    """How the values are put together."""
    metrics: Annotated[list[FieldName], Field(min_length=1, max_length=64)] | None = None
    """Which metrics become columns (default: all)."""
    trajectories: bool = False
    """Whether every trajectory is kept as well."""
    plots: Annotated[list[Plot], Field(max_length=32)] = []
    """Pictures."""
    beside: Published | None = None
    """Published values that stand beside the results."""


def sweep_json_schema() -> dict[str, Any]:
    """Return a schema (draft 2020-12) that knows every key with its title, description, unit and range."""
    schema = SweepFile.model_json_schema(by_alias=True)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema
