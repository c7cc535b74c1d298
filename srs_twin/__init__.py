"""Digital twin of the WPI soft robotic snake: a MuJoCo twin and an analytical model under the same valves."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType

__version__ = "0.1.0"

# Public name → module that defines it. Names are imported on first use, so that importing the package is
# fast.
_HOME = {
    "AnalyticalSnake": "srs_twin.plants.analytical",
    "TwinSnake": "srs_twin.plants.twin.snake",
    "LoadedContact": "srs_twin.plants.twin.mjcf.numerics",
    "PreloadedContact": "srs_twin.plants.twin.mjcf.numerics",
    "Numerics": "srs_twin.plants.twin.mjcf.numerics",
    "TwinBatch": "srs_twin.plants.twin.batch",
    "Plant": "srs_twin.plants.base",
    "SnakeState": "srs_twin.plants.base",
    "SavedState": "srs_twin.io.saved_state",
    "Controller": "srs_twin.control.base",
    "Gait": "srs_twin.control.gait",
    "rollout": "srs_twin.rollout",
    "Job": "srs_twin.rollout",
    "run_many": "srs_twin.rollout",
    "run_batch": "srs_twin.rollout",
    "run_scripts": "srs_twin.rollout",
    "Trajectory": "srs_twin.trajectory",
    "Event": "srs_twin.trajectory",
    "compare": "srs_twin.experiment",
    "Comparison": "srs_twin.comparison.compare",
    "plan": "srs_twin.planning.planner",
    "Plan": "srs_twin.planning.problem",
    "Problem": "srs_twin.planning.problem",
    "RobotSpec": "srs_twin.robot.spec",
    "load_robot": "srs_twin.robot.file",
    "Scenario": "srs_twin.scenario.scenario",
    "load_scenario": "srs_twin.scenario.loading",
    "SrsError": "srs_twin.errors",
    "InputError": "srs_twin.errors",
    "DivergedError": "srs_twin.errors",
}

__all__ = ["__version__", *_HOME]


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'srs_twin' has no attribute '{name}'")
    return getattr(importlib.import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)


class _Package(ModuleType):
    """Module class that keeps public names from being shadowed: `rollout` is the function of rollout.py."""

    def __setattr__(self, name: str, value: object) -> None:
        if isinstance(value, ModuleType) and _HOME.get(name) == value.__name__:
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
