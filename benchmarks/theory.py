"""The model `complete` compared with published theory of locomotion: Hirose, Kelly and Murray, Alben.

    uv run python benchmarks/theory.py serpenoid connection rate amplitude

**serpenoid.** A snake that cannot slip sideways slides along its own curve. On a
serpenoid curve, whose heading is α sin(2π s/λ), it advances by λ J₀(α) per period, the
mean cosine of its heading (Hirose 1993).

**connection.** Without inertia the velocity of the body is linear in the bend rates
(Kelly and Murray 1995). `tests/helpers/local_connection.py` integrates it, for wheels
that do not slip and for viscous friction.

**rate.** Without inertia, the displacement under Coulomb friction does not depend on
the rate of a shape change.

**amplitude.** The amplitude of the best travelling wave decreases as μ_t^(−1/4) at
large transverse friction (Alben 2013, arXiv 1304.4479). The best wave has the least
work per distance.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import j0
from skin import MasslessCurve

from srs_twin.control.replay import HoldValves
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.plants.base import Plant
from srs_twin.robot.spec import GRAVITY, Friction, RobotSpec
from srs_twin.rollout import rollout
from srs_twin.trajectory import Trajectory

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/helpers"))
from curvature_wave import (
    CurvatureWave,
    PrescribedBends,
    continuous_snake,
)  # noqa: E402
from local_connection import displacement, loop, wheeled  # noqa: E402

PERIOD_S = 60.0
"""Period of the motions without inertia, s."""

SMALLEST_SLIP = 1e-4
"""Slip below which friction is smaller than Coulomb's, in body lengths per period."""

MEASURED = 100
"""Samples per period."""


def still(
    spec: RobotSpec, pneumatics: PrescribedBends, period: float, **settings: float | str
) -> Plant:
    """Return the model `complete` with prescribed bends that are so slow that inertia is negligible."""
    return AnalyticalSnake(
        spec,
        pneumatics=pneumatics,
        track=0.0,
        tick=period / 100,
        timestep=period / 10_000,
        slip_speed=SMALLEST_SLIP / period,
        tolerance=1e-3 / period,
        **settings,
    )


def periods(plant: Plant, period: float, count: int = 2) -> Trajectory:
    """Return a run of `count` periods."""
    return rollout(
        plant, HoldValves("vent", "vent"), count * period, record_hz=MEASURED / period
    )


def advance(run: Trajectory) -> float:
    """Return the distance of the centre of mass in the last period, m."""
    return math.hypot(*(run.com[-1] - run.com[-1 - MEASURED]))


def wave_run(
    ratio: float, winding: float, waves: int, segments: int = 32
) -> Trajectory:
    """Return a run of a snake of 1 m and 1 kg; `winding` is the largest heading, rad."""
    forward = 1.0 / ratio
    spec = continuous_snake(forward, forward, 1.0, segments=segments)
    amplitude = 2 * math.pi * waves * winding
    wave = CurvatureWave(spec, amplitude=amplitude, period=PERIOD_S, waves=waves)
    return periods(still(spec, wave, PERIOD_S), PERIOD_S)


def serpenoid() -> Iterator[str]:
    """Yield the table of distances per period and wavelength."""
    yield (
        "| winding angle α, rad | J₀(α) | 32 segments | 64 segments | ratio 1,000, 32"
        " segments |"
    )
    yield "|---|---|---|---|---|"
    for winding in (0.2, 0.4, 0.6, 0.8, 1.0, 1.2):
        fine = [
            2 * advance(wave_run(1e4, winding, 2, segments)) for segments in (32, 64)
        ]
        weak = 2 * advance(wave_run(1e3, winding, 2, 32))
        cells = [
            f"{value:.4f} ({value / j0(winding) - 1:+.2%})" for value in (*fine, weak)
        ]
        yield f"| {winding:g} | {j0(winding):.4f} | {' | '.join(cells)} |"


def moved(run: Trajectory) -> np.ndarray:
    """Return the displacement of connector 1 in the last period, in its frame at the start of this period."""
    x, y, heading = (
        run[f"{name}_1"][[-1 - MEASURED, -1]]
        for name in ("x", "y", "connector_heading")
    )
    (dx, dy), c, s = (
        (x[1] - x[0], y[1] - y[0]),
        math.cos(heading[0]),
        math.sin(heading[0]),
    )
    return np.array([c * dx + s * dy, c * dy - s * dx, heading[1] - heading[0]])


def connection() -> Iterator[str]:
    """Yield the table of displacements per loop of the shape."""
    yield (
        "| snake | friction | own solver: ahead, left, mm; turn, mrad | model | largest"
        " difference |"
    )
    yield "|---|---|---|---|---|"
    three = loop((0.7, -0.7), 0.3)
    cases = [
        ("three links", "no slip", wheeled(2, Friction(0.0001, 1.0)), three, "axis"),
        (
            "three links",
            "viscous, ratio 10",
            wheeled(2, Friction(100.0, 1000.0)),
            three,
            "viscous",
        ),
        (
            "five links",
            "viscous, ratio 10",
            wheeled(4, Friction(100.0, 1000.0)),
            loop((0,) * 4, 0.5),
            "viscous",
        ),
        (
            "nine links",
            "viscous, ratio 3",
            wheeled(8, Friction(100.0, 300.0)),
            loop((0,) * 8, 0.4),
            "viscous",
        ),
    ]
    for snake, friction, spec, path, law in cases:
        own = displacement(path, PERIOD_S, spec, slips=law == "viscous")
        model = moved(
            periods(
                still(spec, PrescribedBends(spec, path), PERIOD_S, friction=law),
                PERIOD_S,
            )
        )
        difference = np.abs(model - own).max() / np.abs(own).max()
        cells = [
            ", ".join(f"{1e3 * value:.2f}" for value in values)
            for values in (own, model)
        ]
        yield f"| {snake} | {friction} | {cells[0]} | {cells[1]} | {difference:.2%} |"


def rate() -> Iterator[str]:
    """Yield the table of distances per period for several periods."""
    yield (
        "| period, s | inertia μ g T²/L | distance per period, body lengths | change |"
    )
    yield "|---|---|---|---|"
    spec = continuous_snake(0.1, 0.1, 0.3)
    first = 0.0
    for period in (60.0, 20.0, 6.0, 2.0, 1.0):
        wave = CurvatureWave(spec, amplitude=7.0, period=period)
        distance = advance(periods(still(spec, wave, period), period, count=3))
        first = first or distance
        number = spec.friction.mu_t * GRAVITY * period**2
        yield (
            f"| {period:g} | {number:.4g} | {distance:.4f} |"
            f" {distance / first - 1:+.2%} |"
        )


def work_per_distance(ratio: float, winding: float, waves: int = 2) -> float:
    """Return the work of the bends divided by distance and forward friction, 1."""
    run = wave_run(ratio, winding, waves)
    work = run["work"]
    return float((work[-1] - work[-1 - MEASURED]) / advance(run) / (GRAVITY / ratio))


def work_of_curve(ratio: float, winding: float, waves: int = 2) -> float:
    """Return the work as in `work_per_distance`, from the independent solver of `skin.py`."""
    curve = MasslessCurve(
        (1.0, 1.0, ratio), 2 * math.pi * waves * winding, waves, points=401
    )
    distance, work = curve.period(100)
    return work / distance


def amplitude() -> Iterator[str]:
    """Yield the table of the best winding angles over the friction ratio, and the fitted exponents."""
    ratios = (10, 30, 100, 300, 1000)
    best = dict[str, list[float]]()
    yield (
        "| friction ratio | best α, own solver | model | work per distance, own solver"
        " | model |"
    )
    yield "|---|---|---|---|---|"
    for ratio in ratios:
        start = math.log(1.6 * ratio**-0.24)
        least = []
        for name, work in (("own solver", work_of_curve), ("model", work_per_distance)):
            found = minimize_scalar(
                lambda log_winding, work=work, ratio=ratio: work(
                    ratio, math.exp(log_winding)
                ),
                bounds=(start - 0.25, start + 0.25),
                method="bounded",
                options={"xatol": 0.005},
            )
            best.setdefault(name, []).append(math.exp(found.x))
            least.append(found.fun)
        angles = " | ".join(f"{values[-1]:.3f}" for values in best.values())
        yield (
            f"| {ratio} | {angles} | {' | '.join(f'{value:.3f}' for value in least)} |"
        )
    for name, values in best.items():
        for first in (0, 2):
            exponent = np.polyfit(np.log(ratios[first:]), np.log(values[first:]), 1)[0]
            yield (
                f"{name}, ratios {ratios[first]} to {ratios[-1]}: exponent"
                f" {exponent:.3f}"
            )


if __name__ == "__main__":
    tables = {
        "serpenoid": serpenoid,
        "connection": connection,
        "rate": rate,
        "amplitude": amplitude,
    }
    for name in sys.argv[1:] or tables:
        for line in tables[name]():
            print(line, flush=True)
