r"""Task Module, in which one module tracks a reference bend.

The module is clamped at its head, and the agent sets the duties of its two chambers.
Every second, the reference bend q_ref jumps to a random angle that the module can reach
at the nominal supply pressure. The reward of a step depends on the bend error at the
end of the step and on the duration Δt of the step:

$$ r = -\frac{|q_{ref} - q|}{1\,\text{rad}}\,\frac{\Delta t}{1\,\text{s}}. $$

Here, q is the true bend, not the sensor reading. The reward measures tracking during
the whole episode, so no shaping term is needed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Unpack

import numpy as np

from srs_twin.control.base import MAX_READING_RAD, SensorReadings
from srs_twin.control.pwm import PulseWidthModulator
from srs_twin.control.smc import CARRIER_HZ
from srs_twin.envs.task import Episode, RewardTerm, Signal, Task, TaskKeywords
from srs_twin.errors import InputError
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.pneumatics.chambers import largest_bend

STEP_S = 0.05
"""Duration of a step, which equals three carrier periods of the PWM, s."""

HOLD_S = 1.0
"""Time for which each reference bend is held, s."""

REACH_FRACTION = 0.8
"""Ratio of the maximum reference bend to the free bend at the nominal supply pressure.
"""

TIMESTEP_S = 0.00025
"""Time step of the twin, which resolves the ripple of pulse-width modulation, s."""


class ModuleTask(Task):
    """Task in which a module tracks a reference bend.

    Attributes:
        reach: maximum reference bend, rad.
    """

    name = "Module"
    step_s = STEP_S
    reward_terms = (
        RewardTerm(
            "error_rad_s",
            -1.0,
            "absolute bend error at the end of the step, times the step duration",
        ),
    )

    def __init__(
        self,
        *,
        robot: str = "gen4_module",
        limit_s: float = 5.0,
        **settings: Unpack[TaskKeywords],
    ) -> None:
        """Create the task.

        Args:
            robot: name or path of a robot with one segment.
            limit_s: time limit, s.
            **settings: further arguments of `Task`. By default, `sensor` is "hall".

        Raises:
            UnknownNameError: a setting of the twin has an unknown name.
            InputError: the robot has several segments, or the fit, range or time limit
                is invalid.
        """
        defaults: TaskKeywords = {"sensor": "hall", "timestep": TIMESTEP_S}
        super().__init__(robot, limit_s, **(defaults | settings))
        spec = self.robot
        if spec.segments != 1:
            raise InputError(
                f"robot '{spec.name}' has {spec.segments} segments, but this task"
                " needs a robot with one segment; choose another robot"
            )
        self.reach = REACH_FRACTION * largest_bend(spec, spec.supply.nominal)
        plus = f"duty of the + chamber (bend to the left) at {CARRIER_HZ:g} Hz"
        minus = f"duty of the − chamber (bend to the right) at {CARRIER_HZ:g} Hz"
        self.actions = (
            Signal("duty_plus", "1", 0.0, 1.0, plus),
            Signal("duty_minus", "1", 0.0, 1.0, minus),
        )
        largest = MAX_READING_RAD
        bends = (
            Signal("bend_rad", "rad", -largest, largest, "sensor reading of the bend"),
            Signal(
                "bend_before_rad",
                "rad",
                -largest,
                largest,
                "sensor reading one step earlier",
            ),
            Signal(
                "reference_rad",
                "rad",
                -self.reach,
                self.reach,
                "reference bend of the next step",
            ),
        )
        command = tuple(
            replace(action, description="last command") for action in self.actions
        )
        self._set_observations({"bends": bends, "command": command})

    def begin(
        self, rng: np.random.Generator, last: Episode | None = None
    ) -> ModuleEpisode:
        """See `Task.begin`."""
        spec = self._variation.draw(rng)
        levels = rng.uniform(
            -self.reach, self.reach, max(1, round(self.limit_s / HOLD_S))
        )
        seed = int(rng.integers(2**32))
        return ModuleEpisode(self, self._twin(spec, last, base="clamped"), levels, seed)


class ModuleEpisode(Episode):
    """Episode of the task Module."""

    state_attributes = ("_carrier", "_readings", "_duties", "_levels")

    def __init__(
        self, task: ModuleTask, twin: TwinSnake, levels: np.ndarray, seed: int
    ) -> None:
        """Start the episode with a straight module and vented chambers."""
        state = twin.reset(seed=seed)
        self._levels = levels
        self._carrier = PulseWidthModulator(
            CARRIER_HZ, twin.tick, 1, allow_long_ticks=True, scale=twin.spec.scale
        )
        self._readings = SensorReadings(1)
        self._duties = [0.0, 0.0]
        super().__init__(task, twin, state)

    def _valves(self, action: list[float]) -> np.ndarray:
        self._target = self._reference()
        self._duties = action
        return self._carrier.step(np.array([action]))

    def _reference(self) -> float:
        number = int(float(self.state.time) / HOLD_S + 1e-9)
        return float(self._levels[min(number, len(self._levels) - 1)])

    def _measure(self) -> dict[str, list[float]]:
        before = float(self._readings.value[0])
        self._readings.update(float(self.state.time), self.state.measured_bend)
        bends = [float(self._readings.value[0]), before, self._reference()]
        return {"bends": bends, "command": self._duties}

    def _reward_values(self) -> dict[str, float]:
        return {
            "error_rad_s": (
                abs(self._target - float(self.state.bend[0])) * self._task.step_s
            )
        }

    def _info(self) -> dict[str, object]:
        plus, minus = map(float, self.state.pressure[0])
        return super()._info() | {
            "bend_rad": float(self.state.bend[0]),
            "reference_rad": self._reference(),
            "pressure_plus_pa": plus,
            "pressure_minus_pa": minus,
        }
