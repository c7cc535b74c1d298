"""Fields of files: bounded numbers with their unit, sections with a description."""

from __future__ import annotations

from typing import Any

from pydantic import Field


def quantity(title: str, unit: str, low: float, high: float, default: Any = ...) -> Any:
    """Return the field of a bounded number, its description made of title, unit and range.

    Args:
        title: what it is.
        unit: "" for a pure number; the schema says "1", as robot files do.
        low: the lowest allowed.
        high: the highest allowed.
        default: what a file gets that leaves it out; the key is required without one.
    """
    text = f"{title}{f' in {unit}' if unit else ''}, {low:.10g} to {high:.10g}."
    extra: dict[str, Any] = {"unit": unit or "1"}
    return Field(default, title=title, description=text, ge=low, le=high, json_schema_extra=extra)


def section(text: str, default: Any = ...) -> Any:
    """Return a field with a description."""
    return Field(default, title=text.partition(";")[0].rstrip("."), description=text)
