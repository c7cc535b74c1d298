"""The `wheel` law compared with spinning wheels in an independent planar simulation.

    uv run python benchmarks/spinning_wheels.py

Every wheel has a speed and an inertia, with Coulomb friction at its rim (isotropic,
μ_n) and in its axle (μ_t). The integrator is explicit Euler with steps of 20 µs. Bends
and body kinematics are those of the analytical model.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from grid import Run, table
from numba import njit

from srs_twin import Gait
from srs_twin.comparison.metrics import plant_metrics
from srs_twin.plants.analytical import kinematics
from srs_twin.plants.analytical.kinematics import BodyParameters, pose_body
from srs_twin.pneumatics import LagPneumatics
from srs_twin.robot.spec import GRAVITY

STEP_S = 2e-5
TICK_S = 0.02
SLIP_M_S = 1e-3
DURATION_S = 6.0
LAST_S = 2.0


class Wheels(NamedTuple):
    """Wheels of all connectors.

    Attributes:
        track: distance of a wheel from the centre line, m.
        radius: radius, m.
        inertia: moment of inertia about the axle, kg·m².
        mu_t: coefficient of friction in the axle, dimensionless.
        mu_n: coefficient of friction at the rim, dimensionless.
    """

    track: float
    radius: float
    inertia: float
    mu_t: float
    mu_n: float


@njit
def advance(state, spin, bends, rates, solid, wheels):
    """Advance the pose (x, y, heading, vx, vy, angular momentum) and the wheel speeds in place."""
    n = solid.mass.shape[0]
    body = np.empty((kinematics.ROWS, n))
    for k in range(bends.shape[0]):
        turning, moment = pose_body(bends[k], rates[k], solid, body)
        omega = (state[5] - moment) / turning
        c0 = math.cos(state[2])
        s0 = math.sin(state[2])
        ux = state[3] * c0 + state[4] * s0
        uy = -state[3] * s0 + state[4] * c0
        fx = fy = torque = 0.0
        for i in range(n):
            c = body[kinematics.COS, i]
            s = body[kinematics.SIN, i]
            px = body[kinematics.X, i]
            py = body[kinematics.Y, i]
            vx = ux - omega * py + body[kinematics.VX, i]
            vy = uy + omega * px + body[kinematics.VY, i]
            along = vx * c + vy * s
            across = -vx * s + vy * c
            load = solid.mass[i] * GRAVITY / 2
            for side in range(2):
                arm = wheels.track if side == 0 else -wheels.track
                rim = spin[i, side] * wheels.radius
                slip = along - (omega + body[kinematics.SPIN, i]) * arm - rim
                speed = math.sqrt(slip * slip + across * across + SLIP_M_S * SLIP_M_S)
                f_t = -wheels.mu_n * load * slip / speed
                f_n = -wheels.mu_n * load * across / speed
                rolling = rim / math.sqrt(rim * rim + SLIP_M_S * SLIP_M_S)
                drag = wheels.mu_t * load * wheels.radius * rolling
                moment_rim = -f_t * wheels.radius
                spin[i, side] += STEP_S * (moment_rim - drag) / wheels.inertia
                fx += f_t * c - f_n * s
                fy += f_t * s + f_n * c
                torque += f_t * (-py * c + px * s - arm) + f_n * (py * s + px * c)
        state[0] += STEP_S * state[3]
        state[1] += STEP_S * state[4]
        state[2] += STEP_S * omega
        state[3] += STEP_S * (fx * c0 - fy * s0) / solid.weight
        state[4] += STEP_S * (fx * s0 + fy * c0) / solid.weight
        state[5] += STEP_S * torque


def spinning_speed(run: Run, inertia_factor: float) -> float:
    """Return the mean CoM speed over the last seconds, m/s, with scaled inertia of the wheels."""
    spec = run.spec()
    g = spec.geometry
    chambers = LagPneumatics(spec, supply_pa=run.supply_pa)
    gait = Gait(run.frequency)
    gait.reset(spec, TICK_S)
    solid = BodyParameters.of(
        spec.mass.array(), np.zeros(g.connectors), g.segment_length, g.rigid_gap
    )
    wheels = Wheels(
        track=g.half_track,
        radius=g.wheel_radius,
        inertia=inertia_factor * spec.mass.wheel * g.wheel_radius**2 / 2,
        mu_t=spec.friction.mu_t,
        mu_n=spec.friction.mu_n,
    )
    times = STEP_S * np.arange(1, round(TICK_S / STEP_S) + 1)
    state = np.zeros(6)
    spin = np.zeros((g.connectors, 2))
    path = [state[:2].copy()]
    for tick in range(round(DURATION_S / TICK_S)):
        trace = chambers.advance(
            chambers.schedule(gait.valves_at(tick * TICK_S), TICK_S), times
        )
        advance(state, spin, trace.bend, trace.bend_rate, solid, wheels)
        path.append(state[:2].copy())
    displacement = path[-1] - path[-1 - round(LAST_S / TICK_S)]
    return float(np.hypot(*displacement)) / LAST_S


def main() -> None:
    """Print the speeds with the law and with spinning wheels, for gaits whose period fits the window."""
    rows = []
    for frequency, kilopascals in ((1.0, 41.0), (1.5, 41.0), (2.0, 48.0)):
        run = Run(
            "analytical",
            frequency=frequency,
            supply_pa=1e3 * kilopascals,
            options={"friction": "wheel"},
        )
        law = plant_metrics(run.trajectory())["com_speed_m_s"]
        result = [spinning_speed(run, factor) for factor in (1.0, 3.0)]
        cells = [
            f"{1e3 * speed:.1f} ({100 * (speed / law - 1):+.1f} %)" for speed in result
        ]
        rows.append([f"{frequency:g}", f"{kilopascals:g}", f"{1e3 * law:.1f}", *cells])
    print(
        table(
            [
                "f Hz",
                "p kPa",
                "`wheel` law mm/s",
                "spinning wheels",
                "three times their inertia",
            ],
            rows,
        )
    )


if __name__ == "__main__":
    main()
