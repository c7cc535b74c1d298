"""Response to a change of offset: curvature of the path over time, and its lag as a path length.

    uv run python benchmarks/transient.py

The lag ℓ is that of the first-order law of `control.prediction` with the same final
heading: the heading deficit relative to a snake that changes its curvature at once,
divided by the change of curvature.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
from grid import table

from srs_twin.control.base import Controller
from srs_twin.planning.arcs import arc_end
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import load_scenario, parse_scenario

RATE = 200
CASES = (("gen2_straight", -0.2, 0.2, 16.0), ("ilc_curve", -0.3, 0.3, 24.0))
SHOWN = np.arange(-0.5, 5.1, 0.5)  # periods
FREQUENCY = {"ilc_curve": 1.5}


class Step(Controller):
    """Gait whose offset changes once."""

    kind = "step"

    def __init__(self, gait: Controller, offset: float, at: float) -> None:
        self._gait = gait
        self._offset = offset
        self._at = at
        self.frequency = gait.frequency
        self.layouts = gait.layouts

    def reset(self, spec, tick, *, seed=0):  # type: ignore[no-untyped-def]
        """See `Controller.reset`."""
        self._gait.reset(spec, tick, seed=seed)

    def step(self, state):  # type: ignore[no-untyped-def]
        """See `Controller.step`."""
        if state.time >= self._at and self._gait.offset != self._offset:
            self._gait.offset = self._offset
        return self._gait.step(state)


@dataclass(frozen=True)
class Turned:
    """Run with one change of offset, as means over a gait period.

    Attributes:
        periods: time after the change, in periods, shape (n,).
        curvature: mean over one period about each time, 1/m, shape (n,).
        lag: response length, m.
        speed: speed along the path, m/s.
        com: x and y of the period mean at `com_periods`, m, shape (m, 2).
        com_periods: times of `com`, in periods, shape (m,).
    """

    periods: np.ndarray
    curvature: np.ndarray
    lag: float
    speed: float
    com: np.ndarray
    com_periods: np.ndarray

    def path(self, length: float) -> np.ndarray:
        """Return a length (m) of the path after the change, in the frame of the path there, shape (k, 2)."""
        at, still = (int(np.argmin(abs(self.com_periods - k))) for k in (0.0, -1.0))
        steps = np.diff(self.com, axis=0)
        distance = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
        distance -= distance[at]
        # Period means at the change already include it, so the steady arc is extended
        # to there. The frame has the direction of the path, because the body of a
        # turning snake slides.
        x, y = self.com[still + 1] - self.com[still - 1]
        old = self.curvature[(self.periods > -4) & (self.periods < -1)].mean()
        place = arc_end(*self.com[still], np.arctan2(y, x), old, -distance[still])
        c = np.cos(place[2])
        s = np.sin(place[2])
        return ((self.com[at:] - place[:2]) @ np.array([[c, -s], [s, c]]))[
            distance[at:] <= length
        ]


def turned(
    name: str, plant: str, before: float, after: float, duration: float
) -> Turned:
    """Run a scenario whose offset changes at half time."""
    document = copy.deepcopy(dict(load_scenario(name).document)) | {
        "expect": [],
        "duration_s": duration,
    }
    document["controller"]["offset"] = before
    document["controller"]["frequency_hz"] = FREQUENCY.get(
        name, document["controller"]["frequency_hz"]
    )
    scenario = parse_scenario(document)
    gait = scenario.build_controller()
    at = duration / 2
    assert gait.frequency is not None
    run = rollout(
        scenario.build_plant(plant), Step(gait, after, at), duration, record_hz=RATE
    )
    period = 1 / gait.frequency
    count = round(period * RATE)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = np.cumsum(values, axis=0)
        return (sums[count:] - sums[:-count]) / count

    heading = mean(run["heading"])
    com = mean(run.com)
    time = run.time[count:] - period / 2
    turn = heading[count:] - heading[:-count]
    distance = np.hypot(*(com[count:] - com[:-count]).T)
    curvature = turn / distance
    middle = time[count:] - period / 2
    first = curvature[(middle > 6 * period) & (middle < at - 2 * period)].mean()
    last = curvature[middle > at + 6 * period].mean()
    speed = float(distance.mean() / period)
    early = np.interp(at - 2 * period, time, heading) + first * speed * 2 * period
    late = heading[-1] - last * speed * (time[-1] - at)
    lag = float((early - late) / (last - first))
    return Turned(
        (middle - at) / period, curvature, lag, speed, com, (time - at) / period
    )


def measured(
    name: str, plant: str, before: float, after: float, duration: float
) -> list[str]:
    """Return a row with the lag and the curvature over time for one change."""
    run = turned(name, plant, before, after, duration)
    seen = np.interp(SHOWN, run.periods, run.curvature)
    return [
        f"{name}, {plant}",
        f"{before:g} to {after:g}",
        f"{1e3 * run.lag:.0f}",
        f"{run.lag / run.speed:.2f}",
        *(f"{item:.2f}" for item in seen),
    ]


def main() -> None:
    rows = [
        measured(name, plant, before, after, duration)
        for name, before, after, duration in CASES
        for plant in ("analytical", "twin")
    ]
    print(
        table(
            ["run", "offset", "lag, mm", "lag, s", *(f"{item:g} T" for item in SHOWN)],
            rows,
        )
    )


if __name__ == "__main__":
    main()
