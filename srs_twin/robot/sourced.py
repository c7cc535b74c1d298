"""Record: one number of a file with its unit, its status and where it comes from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Generic, Literal, TypeVar

from pydantic import Field

from srs_twin.io.validation import Strict

Status = Literal["measured", "calibrated", "estimated"]
Value = TypeVar("Value")
Unit = TypeVar("Unit")


class Record(Strict, Generic[Value, Unit]):
    """One number and where it comes from."""

    value: Value = Field(description="The number, in the unit that the key names.")
    unit: Unit = Field(description="The unit, the same as in the key; '1' for a pure number.")
    status: Status = Field(
        description="measured: stated in the source as measured or set; "
        "calibrated: found by a fit to measurements; estimated: our assumption."
    )
    source: str = Field(min_length=1, max_length=1000, description="Section, table, or how it was estimated.")

    @classmethod
    def model_parametrized_name(cls, params: tuple[Any, ...]) -> str:
        """Give the models of all records one readable name in JSON schemas."""
        return "Record"


def between(low: float, high: float) -> Any:
    """Return the bounds of a number."""
    return Field(ge=low, le=high)


def restated(before: Mapping[str, Any] | None, value: Any, unit: str | None, source: str) -> dict[str, Any]:
    """Return plain data of a record whose number somebody sets: an estimate, whatever it was before.

    Args:
        before: plain data of the record so far, whose unit stays; None or empty: there is none yet.
        value: the number.
        unit: of the key, for a record that is new.
        source: who set it.
    """
    return {**(before or {"unit": unit}), "value": value, "status": "estimated", "source": source}
