"""Decays of released segments, simulated from their own equation of motion, and the true answers.

The equation is that of a body on a curve, with derivatives by complex steps. No
equation of the package is used, only its names for the parts of a robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve

from srs_twin.identification.damping import HangingBody
from srs_twin.robot.file import load_robot
from srs_twin.robot.spec import RobotSpec

AMBIENT = 101_325.0
GRAVITY = 9.81
RAMP = 0.2
"""Time within which a segment is bent, s."""


@dataclass(frozen=True)
class Swing:
    """A released segment.

    Attributes:
        length, gap, mass, inertia: of the segment and the body, m, kg, kg·m².
        stiffness: relaxed stiffness, N·m/rad.
        viscosity: viscous damping, N·m·s/rad.
        branches: stiffness (N·m/rad) and relaxation time (s) of Maxwell branches.
        rest: rest bend, rad.
        gain, dead, growth: gain of the chambers (rad/Pa), dead volume (m³), volume per
            bend (m³/rad).
        closed: whether the valves are closed.
        leak: leak rate, 1/s.
        leads: whether the viscosity opposes the deviation from the free bend instead of
            the bend.
    """

    length: float
    gap: float
    mass: float
    inertia: float
    stiffness: float
    viscosity: float
    branches: tuple[tuple[float, float], ...]
    rest: float
    gain: float
    dead: float
    growth: float
    closed: bool
    leak: float
    leads: bool

    def place(self, q: Any) -> np.ndarray:
        """Return the body's position, sideways and upwards."""
        half = q / 2
        chord = self.length * np.sin(half) / half + self.gap * np.cos(half)
        return np.array([chord * np.sin(half), -chord * np.cos(half)])

    def _tangent(self, q: float) -> np.ndarray:
        return self.place(q + 1e-30j).imag / 1e-30

    def inertial(self, q: float) -> float:
        return self.mass * float(self._tangent(q) @ self._tangent(q)) + self.inertia

    def weight(self, q: float) -> float:
        """Return the moment of the weight, N·m."""
        return -self.mass * GRAVITY * float(self._tangent(q)[1])

    def hanging(self) -> float:
        """Return the bend at rest with open valves, rad."""
        return brentq(
            lambda q: self.stiffness * (self.rest - q) + self.weight(q), -3.0, 3.0001
        )

    def volumes(self, q: float) -> np.ndarray:
        return self.dead + self.growth * np.maximum(0.0, [q, -q])

    def record(
        self, bend: float, hold: float, time: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return bends at times after the release, rad, and the amounts of air at the end, J.

        The valves are closed at rest. Then the segment is bent within `RAMP` and held.

        Args:
            bend: bend from which the segment is released.
            hold: time for which it is held bent.
            time: ascending times.
        """
        start = self.hanging()

        def held(t: Any) -> Any:
            return start + (bend - start) * np.clip((t + hold + RAMP) / RAMP, 0.0, 1.0)

        def waiting(t: float, state: np.ndarray) -> np.ndarray:
            bending = (bend - start) / RAMP if t < -hold else 0.0
            branches = [
                -g * bending - e / tau
                for (g, tau), e in zip(self.branches, state[2:], strict=True)
            ]
            return np.array(
                [
                    *(-self.leak * (state[:2] - AMBIENT * self.volumes(held(t)))),
                    *branches,
                ]
            )

        calm = [*(AMBIENT * self.volumes(start)), *np.zeros(len(self.branches))]
        wait = solve_ivp(
            waiting,
            (-hold - RAMP, 0.0),
            calm,
            "DOP853",
            rtol=1e-8,
            atol=1e-12,
            max_step=0.01,
        )
        amount = wait.y[:2, -1]
        strained = wait.y[2:, -1]

        def derivative(t: float, state: np.ndarray) -> np.ndarray:
            q, v = state[:2]
            free = self.rest
            free_rate = 0.0
            flow = np.zeros(2)
            if self.closed:
                space = self.volumes(q)
                widening = self.growth * v * np.array([q > 0, -1.0 * (q < 0)])
                flow = -self.leak * (state[2:4] - AMBIENT * space)
                pressure = state[2:4] / space
                change = (flow - pressure * widening) / space
                free += self.gain * (pressure[0] - pressure[1])
                free_rate = self.gain * (change[0] - change[1])
            deviation_rate = (free_rate if self.leads else 0.0) - v
            moment = (
                self.stiffness * (free - q)
                + self.viscosity * deviation_rate
                + state[4:].sum()
            )
            moment += self.weight(q)
            h = 1e-5
            bending = (self.inertial(q + h) - self.inertial(q - h)) / (2 * h)
            branches = [
                g * (free_rate - v) - e / tau
                for (g, tau), e in zip(self.branches, state[4:], strict=True)
            ]
            return np.array(
                [v, (moment - bending * v * v / 2) / self.inertial(q), *flow, *branches]
            )

        after = time[time >= 0]
        initial = [bend, 0.0, *amount, *strained]
        done = solve_ivp(
            derivative,
            (0.0, after[-1]),
            initial,
            "DOP853",
            after,
            rtol=1e-8,
            atol=1e-10,
            max_step=0.01,
        )
        return np.concatenate([held(time[time < 0]), done.y[0]]), done.y[2:4, -1]

    def answers(self, amount: np.ndarray | None = None) -> dict[str, float]:
        """Return frequency (Hz), storage stiffness of the material and loss factor at the frequency.

        Args:
            amount: amounts of air, J; None: those of chambers that were closed at rest.
        """
        h = 1e-5

        def free(q: float) -> float:
            if not self.closed:
                return self.rest
            pressure = amount / self.volumes(q)
            return self.rest + self.gain * (pressure[0] - pressure[1])

        if amount is None:
            amount = AMBIENT * self.volumes(self.hanging())
        q = brentq(
            lambda q: self.stiffness * (free(q) - q) + self.weight(q), -3.0, 3.0001
        )
        stiffening = -(self.weight(q + h) - self.weight(q - h)) / (2 * h)
        fraction = (free(q - h) - free(q + h)) / (2 * h)

        def parts(s: complex) -> tuple[complex, complex]:
            branched = sum(g * s * tau / (1 + s * tau) for g, tau in self.branches)
            air = fraction * s / (s + self.leak)
            material = self.stiffness + self.viscosity * s + branched
            if self.leads:
                return material, material * (1 + air)
            return material, material + (self.stiffness + branched) * air

        def root(parts_of: np.ndarray) -> list[float]:
            s = complex(*parts_of)
            left = (
                self.inertial(q) * s * s + parts(s)[1] + stiffening
            ) / self.stiffness
            return [left.real, left.imag]

        stiff = self.stiffness + sum(g for g, _ in self.branches)
        guess = math.sqrt((stiff * (1 + fraction) + stiffening) / self.inertial(q))
        found = fsolve(root, [-0.1 * guess, 0.95 * guess], xtol=1e-12)
        omega = abs(float(found[1]))
        material, total = parts(1j * omega)
        return {
            "frequency": omega / (2 * math.pi),
            "stiffness": material.real,
            "loss_factor": total.imag / total.real,
        }


DAMPING_LAWS = ("leading", "following", "maxwell")
"""Viscous damping of the deviation from the free bend, of the bend itself, and Maxwell branches."""


@dataclass(frozen=True)
class Recorded:
    """Decay of a robot that no fit was tuned on.

    Attributes:
        spec: robot with its geometry and chambers; its stiffness and damping are not
            the true ones.
        body: hanging body.
        swing: true segment.
        time: times, s.
        bend: recorded bends with noise, rad.
        answers: see `Swing.answers`, at the end of the recording.
    """

    spec: RobotSpec
    body: HangingBody
    swing: Swing
    time: np.ndarray
    bend: np.ndarray
    answers: dict[str, float]


def draw(seed: int, damping_law: str, *, closed: bool) -> Recorded:
    """Draw a robot, its material and a release.

    Args:
        seed: seed of the draw.
        damping_law: one of `LAWS`.
        closed: whether the valves are closed.
    """
    rng = np.random.default_rng(seed)

    def between(low: float, high: float) -> float:
        return math.exp(rng.uniform(math.log(low), math.log(high)))

    spec = load_robot(("gen2", "gen4")[rng.integers(2)])
    g = spec.geometry
    chamber = spec.chamber
    length = g.segment_length * rng.uniform(0.8, 1.25)
    gap = rng.uniform(0.0, 0.02)
    dead = chamber.dead_volume * rng.uniform(1, 4)
    growth = chamber.displacement * rng.uniform(0.5, 1.2)
    spec = replace(
        spec,
        geometry=replace(g, segment_length=length, rigid_gap=gap),
        chamber=replace(chamber, dead_volume=dead, displacement=growth),
    )
    stiffness = spec.bending.stiffness * between(0.5, 2.0)
    loss = between(0.04, 0.35)
    mass = between(0.08, 0.5)
    inertia = mass * rng.uniform(0.01, 0.03) ** 2
    rest = rng.normal(0.0, 0.05)
    leak = between(0.02, 2.0)
    gain = spec.actuator.gain
    swing = Swing(
        length,
        gap,
        mass,
        inertia,
        stiffness,
        0.0,
        (),
        rest,
        gain,
        dead,
        growth,
        closed,
        leak,
        damping_law != "following",
    )
    omega = 2 * math.pi * swing.answers()["frequency"]
    if damping_law == "maxwell":
        spread = rng.uniform(2.0, 6.0)
        x = np.array(
            [1 / spread, 1.0, spread]
            if rng.integers(2)
            else [spread**-0.5, spread**0.5]
        )
        strength = loss * stiffness / (x / (1 + x**2)).sum()
        relaxed = stiffness - strength * (x**2 / (1 + x**2)).sum()
        swing = replace(
            swing,
            stiffness=relaxed,
            branches=tuple((strength, tau / omega) for tau in x),
        )
    else:
        swing = replace(swing, viscosity=stiffness * loss / omega)
    frequency = swing.answers()["frequency"]
    bend = swing.hanging() + float(rng.choice([-1.0, 1.0])) * between(0.1, 0.7)
    hold = rng.uniform(0.2, 2.0)
    before = rng.uniform(0.1, 0.4)
    end = min(max(6 / (math.pi * loss), 8), 15) / frequency
    rate = max(100.0, frequency * rng.uniform(8, 20))
    time = np.arange(-hold - RAMP - before, end, 1 / rate)
    bends, amount = swing.record(bend, hold, time)
    noisy = bends + rng.normal(0.0, rng.uniform(5e-4, 4e-3), len(time))
    answers = swing.answers(amount)
    return Recorded(
        spec, HangingBody(mass, inertia), swing, time - time[0], noisy, answers
    )
