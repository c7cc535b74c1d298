"""Shared functions of the benchmarks: runs of plants and gaits on all processors, and Markdown tables."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

from srs_twin import (
    AnalyticalSnake,
    Gait,
    Plant,
    RobotSpec,
    Trajectory,
    TwinSnake,
    load_robot,
    rollout,
)

PLANTS: dict[str, Callable[..., Any]] = {
    "analytical": AnalyticalSnake,
    "twin": TwinSnake,
}


@dataclass(frozen=True)
class Run:
    """One rollout: a plant with its options and a gait."""

    plant: str
    robot: str = "gen2"
    frequency: float = 2.0
    supply_pa: float = 48e3
    offset: float = 0.0
    duration: float = 10.0
    stiffness: float | None = None
    gaps: bool = True
    options: dict[str, Any] = field(default_factory=dict)

    def spec(self) -> RobotSpec:
        """Return the robot with the changes of this run."""
        spec = load_robot(self.robot)
        if self.stiffness is not None:
            spec = replace(
                spec, bending=replace(spec.bending, stiffness=self.stiffness)
            )
        if not self.gaps:
            spec = replace(spec, geometry=replace(spec.geometry, rigid_gap=0.0))
        return spec

    def build(self) -> Plant:
        """Return the plant."""
        plant: Plant = PLANTS[self.plant](
            self.spec(), supply_pa=self.supply_pa, **self.options
        )
        return plant

    def trajectory(self, plant: Plant | None = None) -> Trajectory:
        """Simulate, on a new plant unless one is given."""
        return rollout(
            plant or self.build(), Gait(self.frequency, self.offset), self.duration
        )


def run_all(runs: Sequence[Run]) -> list[Trajectory]:
    """Return the trajectories of all runs, computed on all processors."""
    with ProcessPoolExecutor(max_workers=os.cpu_count()) as pool:
        return list(pool.map(Run.trajectory, runs, chunksize=1))


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [
        " | ".join(head),
        " | ".join("---" for _ in head),
        *(" | ".join(row) for row in rows),
    ]
    return "\n".join(f"| {line} |" for line in lines)
