"""Units of recorded quantities: name → factor to SI."""

from __future__ import annotations

LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048}
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
ANGLES = {"rad": 1.0, "deg": 0.017453292519943295}
PRESSURES = {"pa": 1.0, "kpa": 1e3, "bar": 1e5, "psi": 6894.757}
