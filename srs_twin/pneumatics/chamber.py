r"""Chambers: how much air is where.

A chamber grows as the segment bends its own way, by the volume that bending displaces, and is never
smaller than its dead volume:

$$ V^\pm(q) = V_0 + A\,\max(0, \pm q). $$

A is the air volume that the dissertation gives for 90° (Sections 2.1.1–2.1.3: 15, 45, 70 ml) over π/2. Air is
an ideal gas at one temperature, so its amount is told by n = P V in J, with P the absolute pressure.
"""

from __future__ import annotations

from srs_twin.compiled import compiled

AMBIENT_PA = 101_325.0
"""Absolute pressure of the surrounding air, Pa."""


@compiled
def volume(dead, displacement, bend, side):  # type: ignore[no-untyped-def]  # noqa: D417
    """Return a chamber's volume (m³) and its slope over the bend (m³/rad).

    Args:
        dead: V₀, m³.
        displacement: A, m³/rad.
        bend: q, rad.
        side: 0 for the + chamber, 1 for the − chamber.
    """
    way = 1.0 - 2.0 * side
    if way * bend > 0.0:
        return dead + displacement * way * bend, displacement * way
    return dead, 0.0
