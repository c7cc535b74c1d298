"""Compliant model: Lagrange's equations of point masses, limits, order of convergence, and the twin."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from rows import newtons_matrix
from snakes import robot

from srs_twin import AnalyticalSnake, Gait, RobotSpec, Trajectory, TwinSnake, rollout
from srs_twin.plants.analytical import compliant_kernels, kernels
from srs_twin.plants.analytical.compliant_kernels import CompliantModel, WorkArrays
from srs_twin.plants.analytical.floor import FloorFriction, floor_friction
from srs_twin.plants.analytical.kinematics import BodyParameters
from srs_twin.robot.friction import FRICTION_LAWS
from srs_twin.robot.geometry import body_shape, relative_headings

LENGTH = 0.037
GAP = 0.018
SLIP = 0.02

MARKED_FRICTION_LAWS = [
    pytest.param(
        friction_law, marks=[] if friction_law == "wheel" else [pytest.mark.slow]
    )
    for friction_law in FRICTION_LAWS
]
"""Laws of friction; those whose kernels no other quick test compiles are slow."""


compliant = partial(AnalyticalSnake, model="compliant")


@dataclass(frozen=True)
class Body:
    """Masses on springs on a floor; the state has bends q and velocities u in the mean-heading frame."""

    mass: np.ndarray
    inertia: np.ndarray
    stiffness: float = 0.44
    damping: float = 1e-3
    friction_law: str = "viscous"
    track: float = 0.015
    mu_t: float = 0.5
    mu_n: float = 3.0

    @property
    def solid(self) -> BodyParameters:
        return BodyParameters.of(self.mass, self.inertia, LENGTH, GAP)

    @property
    def floor(self) -> FloorFriction:
        return floor_friction(self.friction_law, self.track, self.mu_t, self.mu_n, SLIP)

    @property
    def model(self) -> CompliantModel:
        return CompliantModel.of(self.solid, self.stiffness, self.damping, self.floor)

    def balance(self, q, u, moment) -> tuple[np.ndarray, np.ndarray]:
        """Return the kernel's momenta and their rates."""
        workspace = WorkArrays.of(len(self.mass))
        compliant_kernels.balance(q, u, moment, 0.0, self.model, self.floor, workspace)
        return workspace.momentum, workspace.force

    def newton(self, q, u, a, residual) -> np.ndarray:
        """Return the kernel's Newton step."""
        workspace = WorkArrays.of(len(self.mass))
        compliant_kernels.balance(
            q, u, np.zeros_like(q), a, self.model, self.floor, workspace
        )
        workspace.residual[:] = residual
        compliant_kernels.solve(a, self.model, workspace)
        return workspace.step

    def advance(self, bends, duration: float, step: float, start=None) -> np.ndarray:
        """Return the kernel's states after every step; `bends` maps times to free bends."""
        count = round(duration / step)
        segments = len(self.mass) - 1
        begin = step * np.arange(count)
        tiny = 1e-30
        stages = np.stack([begin + kernels.GAMMA * step, begin + step], axis=1)
        times = np.append(0.0, stages.ravel())
        free = kernels.Bends(bends(times), bends(times + 1j * tiny).imag / tiny)
        first = compliant_kernels.BENDS
        state = np.zeros(first + 2 * segments)
        u = np.zeros(3 + segments)
        if start is not None:
            q = start[0]
            u = start[1].copy()
            state[first : first + segments] = q
            momentum = self.balance(q, u, np.zeros(segments))[0]
            state[3:5] = u[:2]
            state[5] = momentum[2]
            state[first + segments :] = momentum[3:]
        states = np.empty((count, len(state)))
        marks = np.arange(1, count + 1)
        seen = kernels.Samples(states, np.empty((count, len(u))))
        workspace = WorkArrays.of(len(self.mass), len(state))
        now = compliant_kernels.CompliantState(state, u)
        steps = np.full(count, step)
        done = compliant_kernels.advance(
            now, steps, free, marks, self.model, seen, workspace
        )
        assert done == count
        return states


def draw(
    seed: int, connectors: int = 5, **options: float
) -> tuple[Body, np.ndarray, np.ndarray, np.ndarray]:
    """Return a random body, bends, velocities and moments of the air."""
    g = np.random.default_rng(seed)
    body = Body(
        g.uniform(0.02, 0.1, connectors), g.uniform(0, 1e-5, connectors), **options
    )
    return (
        body,
        g.normal(size=connectors - 1),
        g.normal(size=connectors + 2),
        g.normal(size=connectors - 1),
    )


def jacobian(mass: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the derivatives of the connectors' motion by u, shape (N, 3, 3 + segments), by complex steps."""
    n = len(mass)
    tiny = 1e-30
    place = body_shape(q, mass, LENGTH, GAP)
    result = np.zeros((n, 3, n + 2))
    result[:, 0, 0] = result[:, 1, 1] = result[:, 2, 2] = 1.0
    result[:, 0, 2] = -place[:, 1]
    result[:, 1, 2] = place[:, 0]
    for j in range(n - 1):
        step = q + 1j * tiny * np.eye(n - 1)[j]
        result[:, :2, 3 + j] = body_shape(step, mass, LENGTH, GAP).imag / tiny
        result[:, 2, 3 + j] = relative_headings(step).imag / tiny
    return result


def mass_matrix(body: Body, q: np.ndarray) -> np.ndarray:
    """Return the second derivatives of the kinetic energy by u."""
    j = jacobian(body.mass, q)
    weights = np.stack([body.mass, body.mass, body.inertia], axis=1)
    return np.einsum("ia,iaj,iak->jk", weights, j, j)


def slope_at_zero(f, h: float) -> float:
    """Return f'(0) by central differences of sixth order."""
    return (
        45 * (f(h) - f(-h)) - 9 * (f(2 * h) - f(-2 * h)) + (f(3 * h) - f(-3 * h))
    ) / (60 * h)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("connectors", [2, 3, 5, 9])
def test_momenta_equal_the_sum_over_the_masses(connectors):
    body, q, u, moment = draw(connectors, connectors)
    momentum, _ = body.balance(q, u, moment)
    expected = mass_matrix(body, q)
    assert newtons_matrix(q, u, 0.0, body.model) == pytest.approx(
        expected, rel=1e-12, abs=1e-16
    )
    assert momentum == pytest.approx(expected @ u, rel=1e-12, abs=1e-15)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("connectors", [2, 3, 5, 9])
def test_inertial_forces_are_derivatives_of_the_kinetic_energy(connectors):
    body, q, u, _ = draw(
        connectors, connectors, stiffness=0.0, damping=0.0, mu_t=0.0, mu_n=0.0
    )
    force = body.balance(q, u, np.zeros(connectors - 1))[1]
    assert np.abs(force[:3]).max() < 1e-14  # none on the body as a whole
    for j, unit in enumerate(np.eye(connectors - 1)):

        def energy(h: float, unit=unit) -> float:
            return u @ mass_matrix(body, q + h * unit) @ u / 2

        assert force[3 + j] == pytest.approx(
            slope_at_zero(energy, 5e-3), rel=1e-9, abs=1e-12
        )


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("seed", range(4))
def test_power_is_balanced(seed):
    """The energy changes by the power of the air less that of dampers and a viscous floor."""
    body, q, u, moment = draw(seed)
    momentum, force = body.balance(q, u, moment)

    def energy(h: float) -> float:
        # Momenta in the rotating frame: its rotation does not change the energy.
        p = momentum + h * force
        bends = q + h * u[3:]
        return (
            p @ np.linalg.solve(mass_matrix(body, bends), p) / 2
            + body.stiffness * bends @ bends / 2
        )

    drag = 0.0
    turn = relative_headings(q)
    for i, (vx, vy, spin) in enumerate(jacobian(body.mass, q) @ u):
        c = np.cos(turn[i])
        s = np.sin(turn[i])
        for arm in (body.track, -body.track):
            along = vx * c + vy * s - arm * spin
            across = vy * c - vx * s
            drag += (
                body.mass[i] * 9.81 / 2 * (body.mu_t * along**2 + body.mu_n * across**2)
            )
    power = moment @ u[3:] - body.damping * u[3:] @ u[3:] - drag
    scale = abs(moment @ u[3:]) + drag
    assert slope_at_zero(energy, 1e-4) == pytest.approx(power, abs=1e-9 * scale)


@pytest.mark.parametrize("friction_law", MARKED_FRICTION_LAWS)
def test_newton_matrix_is_the_stage_jacobian_up_to_second_order(friction_law):
    body, q, u, moment = draw(7, friction_law=friction_law, mu_t=0.05, mu_n=0.5)

    def missed(a: float) -> float:
        def residual(v: np.ndarray) -> np.ndarray:
            momentum, force = body.balance(q + a * (v - u)[3:], v, moment)
            return momentum - a * force

        derivatives = [
            slope_at_zero(lambda h, e=e: residual(u + h * e), 1e-5)
            for e in np.eye(len(u))
        ]
        return np.abs(newtons_matrix(q, u, a, body.model) - np.array(derivatives).T)[
            2:, 2:
        ].max()

    assert missed(1e-3) < 1e-2 * mass_matrix(body, q)[2:, 2:].max()
    assert missed(1e-2) / missed(1e-3) == pytest.approx(100, rel=0.3)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("friction_law", MARKED_FRICTION_LAWS)
@pytest.mark.parametrize("connectors", [2, 3, 5, 9, 65])
def test_linear_cost_solve_equals_dense_solve(connectors, friction_law):
    body, q, u, residual = draw(connectors, connectors, friction_law=friction_law)
    residual = np.append(residual, [0.3, -0.2, 0.1])
    for a in (1e-2, 3e-4):
        step = body.newton(q, u, a, residual)
        expected = np.linalg.solve(newtons_matrix(q, u, a, body.model), residual)
        assert step == pytest.approx(
            expected, rel=1e-7, abs=1e-9 * np.abs(expected).max()
        )


def wave(amplitude: float, omega: float = 2 * np.pi * 2):
    """Return smooth free bends of a travelling wave with a gradual start."""

    def bends(t: np.ndarray) -> np.ndarray:
        t = t[..., None]
        return (
            amplitude
            * (1 - np.exp(-((t / 0.1) ** 2)))
            * np.sin(omega * t - np.pi / 2 * np.arange(4))
        )

    return bends


MASSES = np.array([0.03, 0.05, 0.02, 0.04, 0.1])


@pytest.mark.slow
def test_time_integration_has_second_order():
    body = Body(MASSES, np.zeros(5), damping=0.44 * 0.01, mu_t=0.2, mu_n=2.0)
    steps = np.array([2e-3, 1e-3, 5e-4])
    exact = body.advance(wave(0.68), 0.6, 5e-5)[-1]
    errors = [
        np.linalg.norm(
            (body.advance(wave(0.68), 0.6, h)[-1] - exact)[
                : compliant_kernels.BENDS + 4
            ]
        )
        for h in steps
    ]
    assert np.diff(np.log(errors)) / np.diff(np.log(steps)) == pytest.approx(
        [2, 2], abs=0.2
    )


def test_massless_segments_have_their_free_bends_whatever_their_damping():
    """Eq. 14 in closed form, from the model with prescribed bends."""
    spec = robot(mu_t=1e-12, mu_n=1e-12)
    gait = Gait(1.37, 0.1)
    masses = {
        "connectors": tuple(1e-12 * m for m in spec.mass.connectors),
        "wheel": 0.0,
    }
    light = replace(spec, mass=replace(spec.mass, **masses))
    free = rollout(AnalyticalSnake(spec, supply_pa=48300.0), gait, 0.6).stack("bend")
    for time in (1e-6, 0.00214, 0.008, 0.03):
        plant = compliant(
            with_bending(light, damping_time=time), supply_pa=48300.0, timestep=0.002
        )
        assert rollout(plant, gait, 0.6).stack("bend") == pytest.approx(free, abs=1e-9)


def test_deviations_lose_energy_while_the_valves_hold():
    """½ k e² and the kinetic energy together never grow if the free bends rest."""
    spec = with_bending(robot(), damping_time=0.008)
    plant = compliant(spec, supply_pa=48300.0, layout="in_out", timestep=5e-4)
    rollout(plant, Gait(2.0, 0.2), 0.62)
    hold = np.zeros((spec.segments, 2))
    plant.play(
        plant.pneumatics.schedule(hold, 0.1), 5
    )  # the free bends come to rest within 40 τ₂
    plant.body.velocity[3:] += 3.0
    states = plant.play(plant.pneumatics.schedule(hold, 0.2), 400)
    velocity = np.gradient(states.position, 5e-4, axis=0)
    kinetic = (spec.mass.array()[:, None] * velocity**2).sum(axis=(1, 2)) / 2
    deviation = states.bend - plant.pneumatics.bend
    energy = kinetic + (spec.bending.stiffness * deviation**2).sum(axis=1) / 2
    assert np.diff(energy[2:-2]).max() < 1e-6 * energy.max()


def with_bending(spec: RobotSpec, **changes: float) -> RobotSpec:
    return replace(spec, bending=replace(spec.bending, **changes))


def mean_speed(run: Trajectory) -> float:
    """Return the mean speed over whole periods of a 2 Hz gait after the first second, m/s."""
    return float(np.hypot(*(run.com[-1] - run.com[100]))) / (run["time"][-1] - 1.0)


@pytest.mark.parametrize(("offset", "bridge"), [(0.0, 0.06), (0.2, 0.06)])
def test_compliant_model_has_the_bend_amplitudes_of_the_twin(offset, bridge):
    """`complete` deviates from the twin's bends by 7 to 10 % at the shipped stiffness, `compliant` by 2 %."""
    spec = robot()
    gait = Gait(2.0, offset)
    twin = rollout(TwinSnake(spec, supply_pa=48300.0), gait, 4.0)
    options = {"friction": "wheel", "supply_pa": 48300.0}
    rigid = rollout(AnalyticalSnake(spec, **options), gait, 4.0)
    # The twin's connectors are compact bodies with two wheels; a third of what remains
    # is their inertia.
    soft = rollout(compliant(spec, inertia="connector", **options), gait, 4.0)

    def miss(run: Trajectory) -> float:
        difference = (run.stack("bend") - twin.stack("bend"))[100:]
        return float(
            np.sqrt((difference**2).mean() / (twin.stack("bend")[100:] ** 2).mean())
        )

    assert miss(soft) < 0.025
    assert miss(soft) < 0.3 * miss(rigid)
    assert mean_speed(soft) == pytest.approx(mean_speed(twin), rel=bridge)
