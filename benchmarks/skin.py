"""Snakes on skin: the models compared with published theory, and the twin with the analytical model.

    uv run python benchmarks/skin.py theory plants ellipse    # half a minute, ten minutes, ten minutes

**Theory.** Hu, Nirody, Scott and Shelley (PNAS 106, 10081, 2009) prescribe the
curvature κ = 7 cos 2π(s + t) of a snake of uniform weight under the law `cosine`, in
body lengths and periods. The solver below is independent of the package: it integrates
the curve by the trapezoidal rule, and at each time finds the three velocities with
which the friction on the whole curve has no force and no moment. It has no mass, so the
model runs so slowly that its inertia is negligible.

**Plants.** The twin and the model `compliant` at matched physics: equally many contact
points, load transfer across the belly, inertia of its width, and fine hinges and steps.
`plants` has the law `cosine`, `ellipse` the law of that name.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid, trapezoid
from scipy.optimize import root

from srs_twin.control.base import Controller
from srs_twin.control.gait import Gait
from srs_twin.control.replay import HoldValves
from srs_twin.plants.analytical import AnalyticalSnake
from srs_twin.plants.base import Plant
from srs_twin.plants.twin.snake import TwinSnake
from srs_twin.robot.file import load_robot
from srs_twin.robot.spec import RobotSpec
from srs_twin.rollout import rollout

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/helpers"))
from curvature_wave import CurvatureWave, continuous_snake  # noqa: E402

AMPLITUDE = 7.0
"""K, in radians per body length."""

CASES = {
    "snakes (Hu et al.)": (0.11, 0.14, 0.19, 0.126),
    "isotropic": (0.1, 0.1, 0.1, 0.006),
    "ratio 10": (0.1, 0.1, 1.0, 0.52),
    "ratio 100": (0.01, 0.01, 1.0, 0.69),
}
"""Coefficients forward, backward and transverse; the speed of an outside solver, body lengths per period."""

PERIOD_S = 60.0
"""Period of the model, s. The accelerations are then below 0.2 % of μ g."""

SMALLEST_SLIP = 1e-4
"""Slip below which friction is smaller than Coulomb's, in body lengths per period."""


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
        amplitude: float = AMPLITUDE,
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
        pneumatics=CurvatureWave(spec, amplitude=AMPLITUDE, period=period),
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


def theory() -> Iterator[str]:
    """Yield the table of the model against the independent solver."""
    yield (
        "| friction | forward, backward, transverse | outside | own solver | model |"
        " model/own − 1 |"
    )
    yield "|---|---|---|---|---|---|"
    for name, (*mu, outside) in CASES.items():
        own = MasslessCurve((mu[0], mu[1], mu[2])).period()[0]
        model = wave_speed(continuous_snake(*mu))
        coefficients = ", ".join(f"{value:g}" for value in mu)
        yield (
            f"| {name} | {coefficients} | {outside:g} | {own:.4f} | {model:.4f} |"
            f" {model / own - 1:+.2%} |"
        )


def matched_robot(ratio: float, waves: int, law: str) -> RobotSpec:
    """Return the example robot with a flat body, a friction ratio, and a gait with some waves along it."""
    base = load_robot("skin_example")
    height = 0.005
    assert base.skin is not None
    return replace(
        base,
        geometry=replace(base.geometry, com_height=height, wheel_radius=height),
        friction=replace(base.friction, mu_t=0.1, mu_back=0.1, mu_n=0.1 * ratio),
        skin=replace(base.skin, points=12, law=law),
        phase_step=2 * math.pi * waves / base.segments,
    )


def plants(law: str = "cosine") -> Iterator[str]:
    """Yield the table of the twin against the model `compliant`, gait at 1 Hz."""
    yield "| waves | friction ratio | model, mm/s | twin, mm/s | twin/model − 1 |"
    yield "|---|---|---|---|---|"
    for waves, ratio in product((1, 2, 3), (1, 2, 5, 10)):
        spec = matched_robot(ratio, waves, law)
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


if __name__ == "__main__":
    for table in sys.argv[1:] or ("theory", "plants"):
        for row in (
            plants(table)
            if table == "ellipse"
            else {"theory": theory, "plants": plants}[table]()
        ):
            print(row, flush=True)
