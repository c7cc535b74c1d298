"""Dynamics of the ensemble members, based on the `compliant` model."""

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
"""Maximum time step of the members, s."""
_SLIP_SPEED = 0.001
"""Speed below which friction is viscous, m/s, for a time unit of 1 s (`robot.scale`).
"""
_LARGEST_VELOCITY = 20.0, 20.0, 1000.0
"""Maximum forward and lateral velocity (m/s) and yaw rate (rad/s) of a valid member.

The limit of the yaw rate is large, because the yaw rate of generation 2 reaches 50
rad/s during oscillations after a valve has switched.
"""


class ValveInput(NamedTuple):
    """Input of the chambers, including detected faults.

    Attributes:
        duty: fraction of time in which each valve fills its chamber, for slots of equal
            duration, shape (slots, segments, 2).
        supply: gauge supply pressure of each segment, Pa.
        leak: relative rate of pressure loss of each chamber, 1/s, shape (segments, 2).
    """

    duty: np.ndarray
    supply: np.ndarray
    leak: np.ndarray


class Air(NamedTuple):
    """Chamber state of all members.

    All arrays have shape (members, segments, 2).

    Attributes:
        pressure: gauge pressures p, Pa.
        lagged: pressures p̂ after the lag between pressure and free bend, Pa.
        gain: bending gains g relative to the nominal gain, dimensionless.
        noise: standard normal random numbers for the random walk of the pressures.
    """

    pressure: np.ndarray
    lagged: np.ndarray
    gain: np.ndarray
    noise: np.ndarray


class Drive(NamedTuple):
    """Linear bends due to the pressures, at the start and at two stages per step.

    Attributes:
        bend: linear bends, shape (1 + 2 steps, members, segments), rad.
        rate: time derivatives of the linear bends, same shape as `bend`, rad/s.
        step: time step, s.
    """

    bend: np.ndarray
    rate: np.ndarray
    step: float


class MemberDynamics:
    r"""Model of the chambers and bodies of all members.

    The free bend of segment j is

    $$ q_{f,j} = b_j + \varphi(G\,(g_j^+ \hat p_j^+ - g_j^- \hat p_j^-)) + d_j , $$

    where p̂ is the pressure after a first-order lag with time constant τ₂, g is the
    gain of a chamber, b is the rest bend and d is a disturbance. The pressures are
    computed with the first-order law of `pneumatics.lag` and corrected by the learnt
    rates of `pressure_table`.

    Attributes:
        mass: lumped mass of each connector, including parts of the adjacent segments,
            kg.
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
        """Advance `air` in place by the time `dt` (s), and return the linear bends."""
        actuator = self._spec.actuator
        slots = len(valves.duty)
        steps = math.ceil(dt / slots / step - 1e-6)
        h = dt / slots / steps
        stages = (np.arange(steps)[:, None] + [kernels.GAMMA, 1.0]).ravel() * h
        after = stages[:, None, None, None]
        # The random walk is distributed over the steps, because a random step at the
        # end of the period would not affect the bends.
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
        """Advance the poses and velocities of the bodies in place.

        Args:
            pose: poses x, y (m) and heading (rad), shape (members, 3).
            bend: bends at the start, shape (members, segments), rad.
            velocity: forward and lateral velocity (m/s), yaw rate and bend rates
                (rad/s), shape (members, 3 + segments).
            drive: linear bends due to the pressures.
            bias: rest bends including disturbances, shape (members, segments), rad.

        Returns:
            Bends at the end of the period, and whether each member is valid.
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
        # Members with implausible velocities are reported as invalid, because they
        # would distort the ensemble mean.
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
    # Moments due to air do not affect the momenta, so their values are arbitrary.
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
