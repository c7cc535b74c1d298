"""Response to a change of offset: curvature of the path over time, and its lag as a path length.

    uv run python benchmarks/transient.py [--plot docs/images/transient.png]

The lag ℓ is that of the first-order law of `control.prediction` with the same final
heading: the heading deficit relative to a snake that changes its curvature at once,
divided by the change of curvature.

`--plot` draws generation 4 with learning, offset −0.3 to 0.3, on both plants. The path
begins at the change. It is compared with the arc of an instantaneous change (the
assumption of the dissertation), and with the measured jump of the footprint followed by
the new arc.
"""

from __future__ import annotations

import argparse
import copy
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common.grid import table
from matplotlib.axes import Axes

from srs_twin.control.base import Controller
from srs_twin.io.files import atomic_write
from srs_twin.planning.arcs import arc_end
from srs_twin.planning.footprint import Footprint
from srs_twin.planning.footprint_file import load_footprint
from srs_twin.rollout import rollout
from srs_twin.scenario.loading import load_scenario, parse_scenario
from srs_twin.viewing.plots.style import finish, style_of

RATE = 200
CASES = (("gen2_straight", -0.2, 0.2, 16.0), ("ilc_curve", -0.3, 0.3, 24.0))
SHOWN = np.arange(-0.5, 5.1, 0.5)  # periods
FREQUENCY = {"ilc_curve": 1.5}

DRAWN_CASE = ("ilc_curve", -0.3, 0.3, 24.0)
FOOTPRINT = "gen4_ilc"
DRAWN_PERIODS = (-1.5, 6.0)
DRAWN_M = 0.7
_ASSUMED = "0.55"
_JUMPED = "0.15"


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


def draw(runs: dict[str, Turned], footprint: Footprint, path: Path) -> None:
    """Draw both panels.

    Args:
        runs: runs by plant.
        footprint: footprint of the same change of offset.
        path: output file (PNG).
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for plant, run in runs.items():
        style = style_of(plant)
        look = {"color": style.color, "linestyle": style.dash, "linewidth": style.width}
        shown = (run.periods >= DRAWN_PERIODS[0]) & (run.periods <= DRAWN_PERIODS[1])
        left.plot(run.periods[shown], run.curvature[shown], label=style.label, **look)
        right.plot(*run.path(DRAWN_M).T, **look)
    _assumptions(left, right, footprint)
    finish(left, "curvature over one period (1/m)")
    left.set_xlabel("periods after the change of offset, −0.3 to 0.3")
    left.legend(fontsize=8, frameon=False)
    finish(right, "y (m)")
    right.set_xlabel("x (m), the path at the change along x")
    right.set_aspect("equal", adjustable="datalim")
    right.legend(fontsize=8, frameon=False)
    with atomic_write(path) as part:
        figure.savefig(part, format="png", dpi=130, metadata={"Software": None})


def _assumptions(left: Axes, right: Axes, footprint: Footprint) -> None:
    """Draw the instantaneous change, and the measured jump with the new arc."""
    before, after = DRAWN_CASE[1:3]
    old, new = (
        float(np.interp(o, footprint.offsets, footprint.curvatures))
        for o in (before, after)
    )
    times = (DRAWN_PERIODS[0], 0.0, DRAWN_PERIODS[1])
    look = {"color": _ASSUMED, "zorder": 0}
    left.step(times, (old, new, new), where="post", label="instant change", **look)
    jump = next(
        t for t in footprint.transients if (t.before, t.after) == (before, after)
    )
    # The steady arc is the path after the transient.
    for start, begin, color, words in (
        ((0.0, 0.0, 0.0), 0.0, _ASSUMED, "instant change"),
        (
            (jump.dx, jump.dy, jump.dheading),
            jump.length,
            _JUMPED,
            "measured jump, steady arc",
        ),
    ):
        arc = np.array(
            [arc_end(*start, new, s)[:2] for s in np.linspace(begin, DRAWN_M, 60)]
        )
        right.plot(
            *arc.T,
            color=color,
            linewidth=1.0,
            linestyle=":" if begin else "-",
            label=words,
            zorder=3,
        )
    right.plot(0, 0, "k.", markersize=5)
    right.annotate(
        f"jump: {math.degrees(jump.dheading):.0f}°, {1e3 * jump.dy:.0f} mm",
        (0.02, 0.02),
        xycoords="axes fraction",
        fontsize=8,
    )


def main() -> None:
    """Print the table; draw the figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plot", type=Path, help="file of the figure")
    plot = parser.parse_args().plot
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
    if plot:
        name, *change = DRAWN_CASE
        runs = {plant: turned(name, plant, *change) for plant in ("analytical", "twin")}
        draw(runs, load_footprint(FOOTPRINT), plot)


if __name__ == "__main__":
    main()
