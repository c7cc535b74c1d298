r"""Module: one module on the bench bends as a reference asks, by the duties of its two chambers.

The reference holds an angle for a second, then jumps to the next, drawn within what the supply can hold. A
step gives the absolute error that is left at its end, over its time:

$$ r = -\frac{|q_{ref} - q|}{1\,\text{rad}}\,\frac{\Delta t}{1\,\text{s}}. $$

It is a cost of tracking, not of arriving, so there is no potential in it; q is the bend itself, not what the
sensor says.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from srs_twin.control.base import MAX_READING_RAD, SensorReadings
from srs_twin.control.pwm import PulseWidthModulator
from srs_twin.control.smc import CARRIER_HZ
from srs_twin.envs.task import Episode, Signal, Task
from srs_twin.errors import InputError
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.pneumatics.chambers import largest_bend

STEP_S = 0.05
"""Three periods of the carrier."""
HOLD_S = 1.0
REACH_SHARE = 0.8
"""Of what the supply bends a free module by."""
TIMESTEP_S = 0.00025
"""The carrier's ripple asks for it, as in the scenarios module_…"""


class ModuleTask(Task):
    """Track a reference (module docstring).

    Attributes:
        reach: largest angle of a reference, rad.
    """

    name, step_s = "Module", STEP_S

    def __init__(self, *, robot: str = "gen4_module", limit_s: float = 5.0, **settings: Any) -> None:
        """Make the task.

        Args:
            robot: name or path of a robot of one segment.
            limit_s: time limit, s.
            **settings: `fit`, `ranges` and the twin's, as `Task` takes them; a Hall sensor unless given.

        Raises:
            UnknownNameError: a setting that the twin does not take.
            InputError: a robot of more segments, a fit, range or time limit that cannot be.
        """
        super().__init__(robot, limit_s, **{"sensor": "hall", "timestep": TIMESTEP_S, **settings})
        spec = self.robot
        if spec.segments != 1:
            raise InputError(f"robot '{spec.name}' has {spec.segments} segments; this task is for one module")
        self.reach = REACH_SHARE * largest_bend(spec, spec.supply.nominal)
        fills = f"duty of the + chamber, carrier {CARRIER_HZ:g} Hz; bends to the left"
        same = "duty of the − chamber; bends to the right"
        self.actions = (
            Signal("duty_plus", "1", 0.0, 1.0, fills),
            Signal("duty_minus", "1", 0.0, 1.0, same),
        )
        largest = MAX_READING_RAD
        self.observations = (
            Signal("bend_rad", "rad", -largest, largest, "sensor reading"),
            Signal("bend_before_rad", "rad", -largest, largest, "sensor reading of the previous step"),
            Signal("reference_rad", "rad", -self.reach, self.reach, "reference angle of the next step"),
            Signal("duty_plus", "1", 0.0, 1.0, "last command"),
            Signal("duty_minus", "1", 0.0, 1.0, "last command"),
        )

    def begin(self, rng: np.random.Generator, last: Episode | None = None) -> ModuleEpisode:
        """See `Task.begin`."""
        spec = self._variation.draw(rng)
        levels = rng.uniform(-self.reach, self.reach, max(1, round(self.limit_s / HOLD_S)))
        seed = int(rng.integers(2**32))
        return ModuleEpisode(self, self._twin(spec, last, base="clamped"), levels, seed)


class ModuleEpisode(Episode):
    """One try to track."""

    state_attributes = ("_carrier", "_readings", "_duties", "_levels")

    def __init__(self, task: ModuleTask, twin: TwinSnake, levels: np.ndarray, seed: int) -> None:
        """Begin with a straight module and empty chambers."""
        state = twin.reset(seed=seed)
        self._levels = levels
        self._carrier = PulseWidthModulator(CARRIER_HZ, twin.tick, 1, allow_long_ticks=True)
        self._readings = SensorReadings(1)
        self._duties = [0.0, 0.0]
        super().__init__(task, twin, state)

    def _valves(self, action: list[float]) -> np.ndarray:
        self._asked = self._reference()
        self._duties = action
        return self._carrier.step(np.array([action]))

    def _reference(self) -> float:
        """Return the angle asked for in the step that begins now, rad."""
        number = int(float(self.state.time) / HOLD_S + 1e-9)
        return float(self._levels[min(number, len(self._levels) - 1)])

    def _observed(self) -> list[float]:
        before = float(self._readings.value[0])
        self._readings.update(float(self.state.time), self.state.sensed)
        return [float(self._readings.value[0]), before, self._reference(), *self._duties]

    def _judge(self) -> float:
        return -abs(self._asked - float(self.state.bend[0])) * self._task.step_s

    def _info(self) -> dict[str, Any]:
        plus, minus = map(float, self.state.pressure[0])
        return super()._info() | {
            "bend_rad": float(self.state.bend[0]),
            "reference_rad": self._reference(),
            "pressure_plus_pa": plus,
            "pressure_minus_pa": minus,
        }
