"""Fields of files: bounded numbers with their unit, sections with a description."""

from __future__ import annotations

from typing import Any

from pydantic import Field


def quantity(title: str, unit: str, low: float, high: float, default: Any = ...) -> Any:
    """Return the field of a bounded number, its description made of title, unit and range."""
    text = f"{title}{f' in {unit}' if unit else ''}, {low:.10g} to {high:.10g}."
    return Field(default, title=title, description=text, ge=low, le=high)


def section(text: str, default: Any = ...) -> Any:
    """Return a field with a description."""
    return Field(default, title=text.partition(";")[0].rstrip("."), description=text)
