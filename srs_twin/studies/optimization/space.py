"""Designs: values of a study's variables, as shares of their ranges and as changes of a scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin.studies.optimization.file import SEGMENTS, VariableFile
from srs_twin.studies.sweep.points import Changes, Value

ON_BOUND = 0.01
"""Distance from an end of a range, as a share of the range, below which a design lies on that bound."""


@dataclass(frozen=True)
class Space:
    """What may be chosen.

    Attributes:
        variables: dotted field → its range.
        robot: plain data of the scenario's robot, which `hold` refers to.
    """

    variables: Mapping[str, VariableFile]
    robot: Mapping[str, Any]

    @property
    def size(self) -> int:
        """How many variables there are."""
        return len(self.variables)

    def values(self, shares: np.ndarray) -> tuple[float | int, ...]:
        """Return the values of a design, shape (d,), each share in 0 to 1."""
        found: list[float | int] = []
        for share, each in zip(np.clip(shares, 0.0, 1.0), self.variables.values(), strict=True):
            low, high = each.low, each.high
            value = low * (high / low) ** share if each.scale == "log" else low + (high - low) * share
            # Digits beyond what anybody builds would only make every design another one.
            found.append(round(value) if each.whole else float(f"{value:.6g}"))
        return tuple(found)

    def shares(self, values: Mapping[str, float]) -> np.ndarray:
        """Return the shares of a design, shape (d,)."""
        found = []
        for name, each in self.variables.items():
            low, high, value = each.low, each.high, values[name]
            logarithmic = each.scale == "log"
            found.append(
                np.log(value / low) / np.log(high / low) if logarithmic else (value - low) / (high - low)
            )
        return np.array(found)

    def bounds(self, shares: np.ndarray) -> dict[str, str]:
        """Return the variables of a design, shape (d,), that lie on a bound → "low" or "high"."""
        places = zip(self.variables, self.settled(shares[None])[0], strict=True)
        return {
            name: "low" if place < ON_BOUND else "high"
            for name, place in places
            if not ON_BOUND <= place <= 1 - ON_BOUND
        }

    def settled(self, shares: np.ndarray) -> np.ndarray:
        """Return shares of the values that designs are rounded to, shape (designs, d)."""
        names = list(self.variables)
        return np.array([self.shares(dict(zip(names, self.values(each), strict=True))) for each in shares])

    def changes(self, shares: np.ndarray) -> Changes:
        """Return what a design changes in the scenario."""
        found: dict[str, Value] = {}
        for (name, each), value in zip(self.variables.items(), self.values(shares), strict=True):
            if name == SEGMENTS:
                found |= self._segments(int(value), each.hold or [])
            else:
                found[name] = value
        return found

    def _segments(self, count: int, hold: Sequence[str]) -> Changes:
        """Return the numbers of a robot with so many segments."""
        geometry, mass = self.robot["geometry"], self.robot["mass"]
        before = geometry["connectors"]["value"]
        found: dict[str, Value] = {"robot.geometry.connectors": count + 1}
        if "total_length" in hold:
            length, gap = geometry["segment_length_m"]["value"], geometry["rigid_gap_m"]["value"]
            found["robot.geometry.segment_length_m"] = (before - 1) * (length + gap) / count - gap
        if "total_mass" in hold:
            found["robot.mass.connectors_kg"] = before * mass["connectors_kg"]["value"] / (count + 1)
        return found
