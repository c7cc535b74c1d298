"""Design space: conversion between fractions of the variables' ranges, values, and changes of a scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from srs_twin.studies.optimization.file import SEGMENTS, VariableFile
from srs_twin.studies.sweep.points import Changes, Value

ON_BOUND = 0.01
"""Distance from an end of a range, as a fraction of the range, below which a design is on that bound."""


@dataclass(frozen=True)
class DesignSpace:
    """Variables of a study with their ranges.

    Attributes:
        variables: dotted field → range.
        robot: robot of the scenario as plain data, for the quantities that `hold` keeps constant.
    """

    variables: Mapping[str, VariableFile]
    robot: Mapping[str, Any]

    @property
    def size(self) -> int:
        """Number of variables."""
        return len(self.variables)

    def values(self, shares: np.ndarray) -> tuple[float | int, ...]:
        """Return the values of a design, shape (d,), given as fractions from 0 to 1."""
        values: list[float | int] = []
        for share, variable in zip(np.clip(shares, 0.0, 1.0), self.variables.values(), strict=True):
            low, high = variable.low, variable.high
            value = low * (high / low) ** share if variable.scale == "log" else low + (high - low) * share
            # Six digits, so that designs that differ only by rounding share a run.
            values.append(round(value) if variable.whole else float(f"{value:.6g}"))
        return tuple(values)

    def shares(self, values: Mapping[str, float]) -> np.ndarray:
        """Return a design as fractions of the ranges, shape (d,)."""
        shares = []
        for name, variable in self.variables.items():
            low, high, value = variable.low, variable.high, values[name]
            if variable.scale == "log":
                shares.append(np.log(value / low) / np.log(high / low))
            else:
                shares.append((value - low) / (high - low))
        return np.array(shares)

    def bounds(self, shares: np.ndarray) -> dict[str, str]:
        """Return the variables of a design, shape (d,), that are on a bound → "low" or "high"."""
        shares_by_name = zip(self.variables, self.snapped(shares[None])[0], strict=True)
        return {
            name: "low" if share < ON_BOUND else "high"
            for name, share in shares_by_name
            if not ON_BOUND <= share <= 1 - ON_BOUND
        }

    def snapped(self, shares: np.ndarray) -> np.ndarray:
        """Round the values of designs, given and returned as fractions of the ranges, shape (designs, d)."""
        names = list(self.variables)
        return np.array([self.shares(dict(zip(names, self.values(share), strict=True))) for share in shares])

    def changes(self, shares: np.ndarray) -> Changes:
        """Return the fields that a design changes in the scenario."""
        changes: dict[str, Value] = {}
        for (name, variable), value in zip(self.variables.items(), self.values(shares), strict=True):
            if name == SEGMENTS:
                changes |= self._segment_changes(int(value), variable.hold or [])
            else:
                changes[name] = value
        return changes

    def _segment_changes(self, count: int, hold: Sequence[str]) -> Changes:
        """Return the changes that give the robot another number of segments."""
        geometry, mass = self.robot["geometry"], self.robot["mass"]
        before = geometry["connectors"]["value"]
        changes: dict[str, Value] = {"robot.geometry.connectors": count + 1}
        if "total_length" in hold:
            length, gap = geometry["segment_length_m"]["value"], geometry["rigid_gap_m"]["value"]
            changes["robot.geometry.segment_length_m"] = (before - 1) * (length + gap) / count - gap
        if "total_mass" in hold:
            changes["robot.mass.connectors_kg"] = before * mass["connectors_kg"]["value"] / (count + 1)
        return changes
