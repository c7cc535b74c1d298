"""Simulation of the ensemble members with the `compliant` model."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from srs_twin.compute.compiled import allocating, compiled
from srs_twin.live.pressure_table import PressureRates
from srs_twin.plants.analytical import compliant_kernels, kernels
from srs_twin.plants.analytical.compliant_kernels import CompliantModel, WorkArrays
from srs_twin.plants.analytical.floor import floor_friction
from srs_twin.plants.analytical.kinematics import BodyParameters
from srs_twin.pneumatics.chambers import apply_bend_law, bend_law_of
from srs_twin.pneumatics.lag import lag_response, relax, relaxation_of
from srs_twin.robot.spec import RobotSpec

STEP_S = 0.0025
"""Default maximum time step of the ensemble members, s."""
_SLIP_SPEED = 0.001
"""Slip speed below which friction is viscous, at a time unit of 1 (`robot.scale`), m/s.
"""
_LARGEST_VELOCITY = 20.0, 20.0, 1000.0
"""Maximum forward velocity, lateral velocity (m/s) and yaw rate (rad/s) of a member.

The maximum yaw rate is high, because generation 2 reaches 50 rad/s in oscillations
after a valve switches.
"""


class ValveInput(NamedTuple):
    """Valve duties, supply pressures and leak rates of the chambers.

    Attributes:
        duty: fraction of each time slot for which each valve fills its chamber, shape
            (slots, segments, 2). All slots have the same duration.
        supply: gauge supply pressure of each segment, shape (segments,), Pa.
        leak: rate at which each chamber loses pressure, relative to its pressure, shape
            (segments, 2), 1/s.
    """

    duty: np.ndarray
    supply: np.ndarray
    leak: np.ndarray


class Air(NamedTuple):
    """State of the chambers of all members.

    All arrays have shape (members, segments, 2).

    Attributes:
        pressure: gauge pressures p, Pa.
        lagged: pressures p̂ after the first-order lag of the free bend, Pa.
        gain: chamber gains g relative to the nominal gain, dimensionless.
        noise: standard normal random numbers for the random walk of the pressures.
    """

    pressure: np.ndarray
    lagged: np.ndarray
    gain: np.ndarray
    noise: np.ndarray


class Drive(NamedTuple):
    """Inputs of the bend law φ at the start of a period and at two stages of each step.

    Attributes:
        bend: inputs of the bend law, shape (1 + 2 steps, members, segments), rad.
        rate: time derivatives of `bend`, with the same shape, rad/s.
        step: time step, s.
    """

    bend: np.ndarray
    rate: np.ndarray
    step: float


class MemberDynamics:
    r"""Simulation model for the chambers and bodies of all members.

    The free bend of segment j is

    $$ q_{f,j} = b_j + \varphi(G\,(g_j^+ \hat p_j^+ - g_j^- \hat p_j^-)) + d_j , $$

    where p̂ is the chamber pressure after a first-order lag with time constant τ₂, and
    φ is the bend law. G is the nominal gain (rad/Pa), g is the relative gain of a
    chamber, b is the rest bend, and d is a disturbance. The pressures are computed with
    the first-order model of `pneumatics.lag`, corrected by the learnt rates of
    `pressure_table`.

    Attributes:
        mass: lumped mass of each connector, including the adjacent parts of its
            segments, shape (connectors,), kg.
    """

    def __init__(self, spec: RobotSpec) -> None:
        self._spec = spec
        g = spec.geometry
        mu = spec.friction
        solid = BodyParameters.of(
            spec.mass.array(), spec.yaw_inertia(), g.segment_length, g.rigid_gap
        )
        unit = spec.scale.time
        floor = floor_friction(
            "wheel",
            g.half_track,
            mu.mu_t,
            mu.mu_n,
            _SLIP_SPEED * unit,
            load_transfer=g.com_height / (2 * g.half_track),
        )._replace(drag=mu.drag / g.connectors, unit=unit)
        self.mass: np.ndarray = solid.mass
        self._model = CompliantModel.of(
            solid, spec.bending.stiffness, spec.bending.damping, floor
        )

    def drive(
        self,
        valves: ValveInput,
        dt: float,
        step: float,
        air: Air,
        rates: PressureRates,
    ) -> Drive:
        """Advance the chambers in place by `dt` (s), and return the bend law inputs."""
        actuator = self._spec.actuator
        slots = len(valves.duty)
        steps = math.ceil(dt / slots / step - 1e-6)
        h = dt / slots / steps
        stages = (np.arange(steps)[:, None] + [kernels.GAMMA, 1.0]).ravel() * h
        after = stages[:, None, None, None]
        # The random walk is spread over all steps, because a single random change at
        # the end of the period would not affect the bends.
        noise = air.noise / math.sqrt(dt)
        pressures = [air.pressure[None].copy()]
        lags = [air.lagged[None].copy()]
        for duty in valves.duty:
            index = rates.advance(duty, dt / slots)
            change = rates.rate[index] + noise * np.sqrt(rates.wander[index])
            fill = duty / actuator.tau_fill
            vent = (1 - duty) / actuator.tau_vent
            relaxation = relaxation_of(
                fill, vent, valves.supply[:, None], valves.leak, change
            )
            pressure = pressures[-1][-1]
            lagged = lags[-1][-1]
            pressures.append(relax(pressure, *relaxation, after))
            lags.append(
                lag_response(lagged, pressure, relaxation, actuator.tau_mode, after)
            )
        whole = np.concatenate(pressures)
        behind = np.concatenate(lags)
        air.pressure[:] = whole[-1]
        air.lagged[:] = behind[-1]
        signed = actuator.gain * air.gain * [1.0, -1.0]
        linear = (signed * behind).sum(axis=-1)
        pull = (signed * whole).sum(axis=-1)
        return Drive(linear, (pull - linear) / actuator.tau_mode, h)

    def bend(
        self,
        pose: np.ndarray,
        bend: np.ndarray,
        velocity: np.ndarray,
        drive: Drive,
        bias: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advance the bends and velocities of the bodies by one period.

        Args:
            pose: position x, y (m) and heading (rad) at the start of the period, shape
                (members, 3).
            bend: bends at the start of the period, shape (members, segments), rad.
            velocity: forward and lateral velocity (m/s), yaw rate and bend rates
                (rad/s), shape (members, 3 + segments). The array is updated in place.
            drive: inputs of the bend law, as returned by the method `drive`.
            bias: rest bends plus disturbances, shape (members, segments), rad.

        Returns:
            Bends at the end of the period (rad), and a mask of the valid members.
        """
        members, n = bend.shape
        states = np.zeros((members, kernels.STATES + 2 * n))
        states[:, [kernels.STATE_X, kernels.STATE_Y, kernels.HEADING]] = pose
        bends = states[:, compliant_kernels.BENDS :][:, :n]
        bends[:] = bend
        workspace = WorkArrays.of(n + 1, states.shape[1])
        _set_momenta(states, velocity, self._model, workspace)
        free = _free_bends(
            np.ascontiguousarray(drive.bend),
            np.ascontiguousarray(drive.rate),
            bias,
            bend_law_of(self._spec),
        )
        steps = np.full(len(drive.bend) // 2, drive.step)
        complete = _advance(states, velocity, steps, free, self._model, workspace)
        slow = (np.abs(velocity[:, :3]) <= _LARGEST_VELOCITY).all(axis=1)
        return bends, complete & slow & np.isfinite(states).all(axis=1)


@allocating
def _free_bends(linear, speed, bias, bend_law):  # type: ignore[no-untyped-def]
    times, members, segments = linear.shape
    bends = np.empty((members, times, segments))
    rates = np.empty((members, times, segments))
    for m in range(members):
        for t in range(times):
            for j in range(segments):
                free, derivative, _ = apply_bend_law(linear[t, m, j], bend_law)
                bends[m, t, j] = bias[m, j] + free
                rates[m, t, j] = derivative * speed[t, m, j]
    return kernels.Bends(bends, rates)


@allocating
def _advance(states, velocities, steps, free, model, workspace):  # type: ignore[no-untyped-def]
    complete = np.empty(states.shape[0], dtype=np.bool_)
    marks = np.empty(0, dtype=np.int64)
    seen = kernels.Samples(
        np.empty((0, states.shape[1])), np.empty((0, velocities.shape[1]))
    )
    for m in range(states.shape[0]):
        now = compliant_kernels.CompliantState(states[m], velocities[m])
        bends = kernels.Bends(free.bend[m], free.rate[m])
        done = compliant_kernels.advance(
            now, steps, bends, marks, model, seen, workspace
        )
        complete[m] = done == steps.shape[0]
    return complete


@compiled
def _set_momenta(states, velocities, model, workspace):  # type: ignore[no-untyped-def]
    segments = workspace.bend.shape[0]
    ahead = compliant_kernels.BENDS
    momentum = workspace.momentum
    # The pneumatic moments do not affect the momenta, so any values can be passed.
    moment = workspace.bend
    for m in range(states.shape[0]):
        state = states[m]
        u = velocities[m]
        c = math.cos(state[kernels.HEADING])
        s = math.sin(state[kernels.HEADING])
        state[kernels.STATE_VX] = c * u[0] - s * u[1]
        state[kernels.STATE_VY] = s * u[0] + c * u[1]
        bend = state[ahead : ahead + segments]
        compliant_kernels.balance(bend, u, moment, 0.0, model, model.floor, workspace)
        state[kernels.MOMENT] = momentum[2]
        for j in range(segments):
            state[ahead + segments + j] = momentum[3 + j]
