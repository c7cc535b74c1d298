"""How a change of offset takes hold: curvature of the path over time after it, and its lag as a length.

    uv run python benchmarks/transient.py

The lag ℓ is that of the first-order law of `control.prediction` that turns the snake as far: the heading
that it is behind a snake which changes its curvature at once, over the change of curvature.
"""

from __future__ import annotations

import copy

import numpy as np
from grid import table

from srs_twin.control.base import Controller
from srs_twin.rollout import rollout
from srs_twin.scenario import load_scenario, parse_scenario

RATE = 200
CASES = (("gen2_straight", -0.2, 0.2, 16.0), ("ilc_curve", -0.3, 0.3, 24.0))
SHOWN = np.arange(-0.5, 5.1, 0.5)  # periods
FREQUENCY = {"ilc_curve": 1.5}


class Step(Controller):
    """A gait whose offset changes once."""

    kind = "step"

    def __init__(self, gait: Controller, offset: float, at: float) -> None:
        self._gait, self._offset, self._at = gait, offset, at
        self.frequency, self.layouts = gait.frequency, gait.layouts

    def reset(self, spec, tick, *, seed=0):  # type: ignore[no-untyped-def]
        """See `Controller.reset`."""
        self._gait.reset(spec, tick, seed=seed)

    def step(self, state):  # type: ignore[no-untyped-def]
        """See `Controller.step`."""
        if state.time >= self._at and self._gait.offset != self._offset:
            self._gait.offset = self._offset
        return self._gait.step(state)


def measured(name: str, plant: str, before: float, after: float, duration: float) -> list[str]:
    """Return a row: ℓ and the curvature over time, of one change."""
    document = copy.deepcopy(dict(load_scenario(name).document)) | {"expect": [], "duration_s": duration}
    document["controller"]["offset"] = before
    document["controller"]["frequency_hz"] = FREQUENCY.get(name, document["controller"]["frequency_hz"])
    scenario = parse_scenario(document)
    gait, at = scenario.build_controller(), duration / 2
    assert gait.frequency is not None
    run = rollout(scenario.build_plant(plant), Step(gait, after, at), duration, record_hz=RATE)
    period = 1 / gait.frequency
    count = round(period * RATE)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = np.cumsum(values, axis=0)
        return (sums[count:] - sums[:-count]) / count

    heading, com, time = mean(run["heading"]), mean(run.com), run.time[count:] - period / 2
    turned, way = heading[count:] - heading[:-count], np.hypot(*(com[count:] - com[:-count]).T)
    curvature, middle = turned / way, time[count:] - period / 2
    first = curvature[(middle > 6 * period) & (middle < at - 2 * period)].mean()
    last = curvature[middle > at + 6 * period].mean()
    speed = float(way.mean() / period)
    early = np.interp(at - 2 * period, time, heading) + first * speed * 2 * period
    late = heading[-1] - last * speed * (time[-1] - at)
    lag = (early - late) / (last - first)
    seen = np.interp(at + SHOWN * period, middle, curvature)
    return [f"{name}, {plant}", f"{before:g} to {after:g}", f"{1e3 * lag:.0f}", f"{lag / speed:.2f}",
            *(f"{each:.2f}" for each in seen)]  # fmt: skip


def main() -> None:
    rows = [
        measured(name, plant, before, after, duration)
        for name, before, after, duration in CASES
        for plant in ("analytical", "twin")
    ]
    print(table(["run", "offset", "lag, mm", "lag, s", *(f"{each:g} T" for each in SHOWN)], rows))


if __name__ == "__main__":
    main()
