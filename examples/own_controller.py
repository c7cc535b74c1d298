"""Write a controller outside the package, and run it on both plants.

    python examples/own_controller.py

The segments of this robot have a rest bend of 0.15 rad to the left, so that a plain
gait turns. The controller reads the bend sensors and steers against the mean bend.
"""

import numpy as np

import srs_twin as srs


class StraightAhead(srs.Controller):
    """Gait that changes its offset after each period in proportion to the mean bend."""

    kind = "straight_ahead"
    layouts = ("3/2", "in_out")

    def __init__(self, frequency: float, gain: float = 0.3) -> None:
        """Take the gait frequency, Hz, and the change of the offset per bend, 1/rad."""
        self.frequency = frequency
        self.gain = gain

    def reset(self, spec: srs.RobotSpec, tick: float, *, seed: int = 0) -> None:
        """Start a run on a robot with a control tick, s."""
        self._gait = srs.Gait(self.frequency)
        self._gait.reset(spec, tick, seed=seed)
        self._ticks_per_period = round(1 / (self.frequency * tick))
        self._sensed: list[float] = []

    def step(self, state: srs.SnakeState) -> np.ndarray:
        """Return the valve states of the next tick, shape (segments, 2)."""
        self._sensed.append(float(np.mean(state.measured_bend)))
        if len(self._sensed) == self._ticks_per_period:
            offset = self._gait.offset - self.gain * np.mean(self._sensed)
            self._gait.offset = float(np.clip(offset, -0.5, 0.5))
            self._sensed.clear()
        return self._gait.step(state)


def main() -> None:
    """Print how far each plant turns with each controller."""
    curled = {"robot.modules.bias_rad": [0.15] * 4}
    scenario = srs.load_scenario("gen2_straight", set=curled)
    for plant in ("analytical", "twin"):
        for controller in (srs.Gait(2.0), StraightAhead(2.0)):
            run = srs.rollout(scenario.build_plant(plant), controller, 6.0)
            print(
                f"{plant}, {controller.kind}: turned by {run['heading'][-1]:+.2f} rad"
            )


if __name__ == "__main__":
    main()
