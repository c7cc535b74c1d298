"""The model `complete` compared with published theory: Hirose, Kelly and Murray, Alben, Hu.

    uv run python benchmarks/theory.py serpenoid connection rate amplitude hu plants ellipse

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

**hu.** Hu, Nirody, Scott and Shelley (PNAS 106, 10081, 2009) prescribe the curvature
κ = 7 cos 2π(s + t) of a snake of uniform weight under the law `cosine`, in body lengths
and periods. The solver `MasslessCurve` is independent of the package: it integrates the
curve by the trapezoidal rule, and at each time finds the three velocities with which
the friction on the whole curve has no force and no moment. It has no mass, so the model
runs so slowly that its inertia is negligible.

**plants**, **ellipse.** The twin and the model `compliant` on skin at matched physics:
equally many contact points, load transfer across the belly, inertia of its width, and
fine hinges and steps. `plants` has the law `cosine`, `ellipse` the law of that name.
Each takes ten minutes.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid, trapezoid
from scipy.optimize import minimize_scalar, root
from scipy.special import j0

from srs_twin.control.base import Controller
from srs_twin.control.gait import Gait
from srs_twin.control.replay import HoldValves
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.plants.base import Plant
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.file import load_robot
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

HU_AMPLITUDE = 7.0
"""K, in radians per body length."""

HU_CASES = {
    "snakes (Hu et al.)": (0.11, 0.14, 0.19, 0.126),
    "isotropic": (0.1, 0.1, 0.1, 0.006),
    "ratio 10": (0.1, 0.1, 1.0, 0.52),
    "ratio 100": (0.01, 0.01, 1.0, 0.69),
}
"""Coefficients forward, backward and transverse; the speed of an outside solver, body lengths per period."""


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
    for snake, friction, spec, path, friction_law in cases:
        own = displacement(path, PERIOD_S, spec, slips=friction_law == "viscous")
        model = moved(
            periods(
                still(
                    spec, PrescribedBends(spec, path), PERIOD_S, friction=friction_law
                ),
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
    """Return the work as in `work_per_distance`, from the independent solver."""
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


class MasslessCurve:
    """Curve of prescribed curvature that slides without inertia, in body lengths and periods.

    Args:
        coefficients: friction coefficients forward, backward and transverse.
        amplitude: largest curvature, radians per body length.
        waves: number of waves along the curve.
        points: points along the curve.
    """

    def __init__(
        self,
        coefficients: tuple[float, float, float],
        amplitude: float = HU_AMPLITUDE,
        waves: int = 1,
        points: int = 801,
    ) -> None:
        self._mu = coefficients
        self._amplitude = amplitude
        self._waves = waves
        self._s = np.linspace(0.0, 1.0, points)

    def _centred(self, slope: np.ndarray) -> np.ndarray:
        """Return the integral of a slope along the curve, about its mean."""
        integral = cumulative_trapezoid(slope, self._s, axis=0, initial=0.0)
        return np.asarray(integral - trapezoid(integral, self._s, axis=0))

    def _shape(self, time: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return tangents, positions and velocities in the frame of the mean position and heading."""
        phase = 2 * math.pi * (self._waves * self._s + time)
        heading = self._centred(self._amplitude * np.cos(phase))
        spin = self._centred(-2 * math.pi * self._amplitude * np.sin(phase))
        tangent = np.stack([np.cos(heading), np.sin(heading)], axis=1)
        turned = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        return tangent, self._centred(tangent), self._centred(spin[:, None] * turned)

    def _friction(
        self,
        motion: np.ndarray,
        tangent: np.ndarray,
        place: np.ndarray,
        velocity: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return slip and force of friction per length on the curve that moves as a whole with `motion`."""
        forward, backward, transverse = self._mu
        slip = (
            velocity
            + motion[:2]
            + motion[2] * np.stack([-place[:, 1], place[:, 0]], axis=1)
        )
        direction = slip / np.sqrt((slip**2).sum(axis=1) + SMALLEST_SLIP**2)[:, None]
        normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        along = (direction * tangent).sum(axis=1)
        across = (direction * normal).sum(axis=1)
        mu = np.where(along > 0, forward, backward)
        return (
            slip,
            -(mu * along)[:, None] * tangent - (transverse * across)[:, None] * normal,
        )

    def _balance(self, motion: np.ndarray, *shape: np.ndarray) -> np.ndarray:
        """Return force and moment of friction, relative to the transverse friction."""
        place, (_, force) = shape[1], self._friction(motion, *shape)
        moment = place[:, 0] * force[:, 1] - place[:, 1] * force[:, 0]
        return (
            np.array([*trapezoid(force, self._s, axis=0), trapezoid(moment, self._s)])
            / self._mu[2]
        )

    def period(self, times: int = 400) -> tuple[float, float]:
        """Return distance and work against friction per period; no period is needed to settle."""
        motion = np.zeros(3)
        pose = np.zeros(3)
        work = 0.0
        for k in range(times):
            shape = self._shape((k + 0.5) / times)
            found = root(self._balance, motion, args=shape, tol=1e-12)
            assert np.abs(found.fun).max() < 1e-7, (
                f"no balance of forces at step {k}: {found.fun}"
            )
            motion = found.x
            slip, force = self._friction(motion, *shape)
            work -= trapezoid((slip * force).sum(axis=1), self._s) / times
            heading = pose[2] + motion[2] / times / 2
            c = math.cos(heading)
            s = math.sin(heading)
            pose += (
                np.array(
                    [
                        c * motion[0] - s * motion[1],
                        s * motion[0] + c * motion[1],
                        motion[2],
                    ]
                )
                / times
            )
        return math.hypot(pose[0], pose[1]), work


def wave_speed(spec: RobotSpec, period: float = PERIOD_S) -> float:
    """Return the speed of the model `complete` under the curvature wave, body lengths per period."""
    plant = AnalyticalSnake(
        spec,
        pneumatics=CurvatureWave(spec, amplitude=HU_AMPLITUDE, period=period),
        track=0.0,
        tick=period / 100,
        timestep=period / 10_000,
        slip_speed=SMALLEST_SLIP / period,
        tolerance=1e-3 / period,
    )
    return speed_m_s(plant, HoldValves("vent", "vent"), period, periods=2) * period


def speed_m_s(
    plant: Plant, controller: Controller, period: float, periods: int, last: int = 1
) -> float:
    """Return the speed of the centre of mass in the last periods, m/s."""
    run = rollout(plant, controller, periods * period, record_hz=100 / period)
    return math.hypot(*(run.com[-1] - run.com[-1 - 100 * last])) / period / last


def hu() -> Iterator[str]:
    """Yield the table of the model against the independent solver."""
    yield (
        "| friction | forward, backward, transverse | outside | own solver | model |"
        " model/own − 1 |"
    )
    yield "|---|---|---|---|---|---|"
    for name, (*mu, outside) in HU_CASES.items():
        own = MasslessCurve((mu[0], mu[1], mu[2])).period()[0]
        model = wave_speed(continuous_snake(*mu))
        coefficients = ", ".join(f"{value:g}" for value in mu)
        yield (
            f"| {name} | {coefficients} | {outside:g} | {own:.4f} | {model:.4f} |"
            f" {model / own - 1:+.2%} |"
        )


def matched_robot(ratio: float, waves: int, friction_law: str) -> RobotSpec:
    """Return the example robot with a flat body, a friction ratio, and a gait with some waves along it."""
    base = load_robot("skin_example")
    height = 0.005
    assert base.skin is not None
    return replace(
        base,
        geometry=replace(base.geometry, com_height=height, wheel_radius=height),
        friction=replace(base.friction, mu_t=0.1, mu_back=0.1, mu_n=0.1 * ratio),
        skin=replace(base.skin, points=12, friction_law=friction_law),
        phase_step=2 * math.pi * waves / base.segments,
    )


def plants(friction_law: str = "cosine") -> Iterator[str]:
    """Yield the table of the twin against the model `compliant`, gait at 1 Hz."""
    yield "| waves | friction ratio | model, mm/s | twin, mm/s | twin/model − 1 |"
    yield "|---|---|---|---|---|"
    for waves, ratio in product((1, 2, 3), (1, 2, 5, 10)):
        spec = matched_robot(ratio, waves, friction_law)
        model = AnalyticalSnake(
            spec,
            model="compliant",
            inertia="connector",
            load="instantaneous",
            timestep=0.001,
        )
        twin = TwinSnake(spec, hinges_per_segment=8, timestep=0.0005)
        a, b = (
            1e3 * speed_m_s(plant, Gait(1.0), 1.0, periods=6, last=3)
            for plant in (model, twin)
        )
        yield f"| {waves} | {ratio} | {a:.2f} | {b:.2f} | {b / a - 1:+.2%} |"


TABLES: dict[str, Callable[[], Iterator[str]]] = {
    "serpenoid": serpenoid,
    "connection": connection,
    "rate": rate,
    "amplitude": amplitude,
    "hu": hu,
    "plants": plants,
    "ellipse": lambda: plants("ellipse"),
}


def main() -> None:
    """Print the chosen tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "tables",
        nargs="*",
        metavar="TABLE",
        help=f"tables to compute, of {', '.join(TABLES)}; default: all",
    )
    chosen = parser.parse_args().tables or list(TABLES)
    if unknown := [name for name in chosen if name not in TABLES]:
        parser.error(f"no such table: {', '.join(unknown)}")
    for name in chosen:
        print(f"\n{name}\n")
        for line in TABLES[name]():
            print(line, flush=True)


if __name__ == "__main__":
    main()
