r"""Independent implementation of the `complete` model for SciPy's LSODA, in NumPy.

The unknowns (centre of mass, mean heading, velocity, angular momentum L), the friction
laws with ε, and the valve events are those of the compiled model. The code follows the
equations in docs/planar-models.md with complex numbers for points of the plane. It shares no
code with the compiled kernels, so it also verifies them.

Between valve events the bends are sums of exponentials whose coefficients are computed
once,

$$ q(t) = q_\infty + \sum_k c_k e^{-r_k t}, \qquad r = (1/\tau_2, a^+, a^-). $$

LSODA restarts at every event, where q̈ is discontinuous. `odeint` is used because it
has less overhead than `solve_ivp`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import odeint

from srs_twin import Gait, RobotSpec, Trajectory
from srs_twin.robot.geometry import relative_headings
from srs_twin.robot.spec import GRAVITY

TICK = 0.02  # s, the default of the plants, which sets the times of the valve events
RECORD_HZ = 100


@dataclass(frozen=True)
class BendInterval:
    """Bends between two valve events.

    Attributes:
        start, stop: times, s.
        resting: final bends, shape (segments,), rad.
        swing: coefficients c, shape (3, segments), rad.
        rate: decay rates r, shape (3, segments), 1/s.
    """

    start: float
    stop: float
    resting: np.ndarray
    swing: np.ndarray
    rate: np.ndarray


def bend_intervals(
    spec: RobotSpec, gait: Gait, duration: float, supply_pa: float
) -> list[BendInterval]:
    """Return the bends of a gait from rest, in closed form between its valve events."""
    actuator = spec.actuator
    result = []
    pressure = np.zeros((spec.segments, 2))
    bend = np.zeros(spec.segments)
    gait.reset(spec, TICK)
    script = gait.script(duration)
    for start, stop, valves in zip(
        script.starts, [*script.events, duration], script.states, strict=True
    ):
        fills = valves > 0
        rate = np.where(fills, 1 / actuator.tau_fill, 1 / actuator.tau_vent)
        target = np.where(fills, supply_pa, 0.0)
        # Exponential of each chamber, filtered by the lag τ₂; − chambers have the
        # opposite sign.
        own = (
            actuator.gain
            * np.array([1, -1])
            * (pressure - target)
            / (1 - rate * actuator.tau_mode)
        )
        resting = actuator.gain * (target[:, 0] - target[:, 1])
        swing = np.stack([bend - resting - own.sum(axis=1), *own.T])
        rates = np.stack([np.full(spec.segments, 1 / actuator.tau_mode), *rate.T])
        result.append(BendInterval(start, stop, resting, swing, rates))
        span = stop - start
        pressure = target + (pressure - target) * np.exp(-rate * span)
        bend = resting + (swing * np.exp(-rates * span)).sum(axis=0)
    return result


class CompleteModel:
    """Right-hand side of the `complete` model.

    Attributes:
        bends: bends between the present valve events.
    """

    bends: BendInterval

    def __init__(self, spec: RobotSpec, *, friction: str, slip: float) -> None:
        """Compute the constant quantities.

        Args:
            spec: robot.
            friction: "axis" or "wheel".
            slip: slip speed ε, m/s.
        """
        g = spec.geometry
        mu = spec.friction
        self.mass = spec.mass.array()
        self.total = spec.mass.total
        self.length = g.segment_length
        self.gap = g.rigid_gap
        self.slip2 = slip**2
        arms = [0.0] if friction == "axis" else [g.half_track, -g.half_track]
        self.arm = np.array(arms)[:, None]
        self.load = self.mass * GRAVITY / len(arms)
        self.mu_t = mu.mu_t
        self.mu_n = mu.mu_n
        self.rest = np.sqrt(mu.mu_n**2 - mu.mu_t**2)
        self._friction_law = {"axis": self._axis, "wheel": self._wheel}[friction]
        # Headings and link directions are linear in the bends, connector positions in
        # the links.
        self.heading = relative_headings(np.eye(spec.segments)).T
        self.direction = (self.heading[1:] + self.heading[:-1]) / 2
        behind = -np.tril(np.ones((g.connectors, spec.segments)), -1)
        self.place = behind - self.mass @ behind / self.total

    def __call__(self, time: float, state: np.ndarray) -> np.ndarray:
        """Return the rate of the state (x, y, θ, v_x, v_y, L)."""
        b = self.bends
        decay = b.swing * np.exp((b.start - time) * b.rate)
        bend = b.resting + decay.sum(axis=0)
        rate = -(decay * b.rate).sum(axis=0)
        body, rho, drift = self._shape(bend, rate)
        inertia = self.mass @ (rho.real**2 + rho.imag**2)
        moment = self.mass @ (rho.conj() * drift).imag
        spin = (state[5] - moment) / inertia
        ahead = np.exp(1j * state[2])
        velocity = complex(state[3], state[4]) * ahead.conjugate()
        local = (velocity + 1j * spin * rho + drift) * body.conj()
        along = local.real - self.arm * (spin + self.heading @ rate)
        f_t, f_lat = self._friction_law(along, local.imag)
        force = (f_t.sum(axis=0) + 1j * f_lat) * body
        turning = (rho.conj() * force).imag.sum() - (self.arm * f_t).sum()
        push = force.sum() * ahead / self.total
        return np.array([state[3], state[4], spin, push.real, push.imag, turning])

    def _shape(
        self, bend: np.ndarray, rate: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return e^{iφ}, ρ and ρ̇ of each connector in the frame of the mean heading."""
        half = 0.5 * bend + 1e-30  # avoids 0/0
        cos = np.cos(half)
        sin = np.sin(half)
        arc = sin / half
        span = self.length * arc + self.gap * cos
        interval = 0.5 * rate * (self.length * (cos - arc) / half - self.gap * sin)
        link = np.exp(1j * (self.direction @ bend))
        rho = self.place @ (span * link)
        drift = self.place @ ((interval + 1j * span * (self.direction @ rate)) * link)
        return np.exp(1j * (self.heading @ bend)), rho, drift

    def _axis(
        self, v_t: np.ndarray, v_lat: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the force along each contact, shape (contacts, N), and across each connector, (N,)."""
        f_t = -self.load * self.mu_t * v_t / np.sqrt(v_t * v_t + self.slip2)
        return f_t, -self.load * self.mu_n * v_lat / np.sqrt(v_lat * v_lat + self.slip2)

    def _wheel(
        self, v_t: np.ndarray, v_lat: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the same forces as `_axis` for the wheel law."""
        n2 = v_lat * v_lat + self.slip2
        fraction = self.mu_n / np.sqrt(v_t * v_t + n2)
        slide = fraction * v_t
        rolls = np.abs(slide) > self.mu_t
        f_t = -self.load * np.clip(slide, -self.mu_t, self.mu_t)
        f_lat = -self.load * v_lat * np.where(rolls, self.rest / np.sqrt(n2), fraction)
        return f_t, f_lat.sum(axis=0)


def solve(
    model: CompleteModel, bends: list[BendInterval], *, rtol: float, atol: float
) -> np.ndarray:
    """Integrate with LSODA from rest, with a restart at every valve event.

    Args:
        model: right-hand side.
        bends: result of `bend_intervals`.
        rtol: relative tolerance.
        atol: absolute tolerance, in the unit of each unknown (L: kg·m²/s).

    Returns:
        The states at `RECORD_HZ`, shape (samples, 6).
    """
    times = np.arange(round(bends[-1].stop * RECORD_HZ) + 1) / RECORD_HZ
    states = np.zeros((len(times), 6))
    state = np.zeros(6)
    for model.bends in bends:
        start = model.bends.start
        stop = model.bends.stop
        first, last = np.searchsorted(times, [start + 1e-9, stop + 1e-9])
        at = np.concatenate([[start], times[first:last]])
        # Samples within rounding of the end count as the end.
        if stop - at[-1] > 1e-9:
            at = np.append(at, stop)
        result = odeint(
            model, state, at, rtol=rtol, atol=atol, tfirst=True, mxstep=100_000
        )
        states[first:last] = result[1 : 1 + last - first]
        state = result[-1]
    return states


def trajectory(
    spec: RobotSpec, gait: Gait, states: np.ndarray, bends: list[BendInterval]
) -> Trajectory:
    """Return the states as a trajectory."""
    times = np.arange(len(states)) / RECORD_HZ
    angles = np.empty((len(times), spec.segments))
    for b in bends:
        inside = (times > b.start - 1e-9) & (times < b.stop + 1e-9)
        decay = np.exp(-b.rate * (times[inside] - b.start)[:, None, None])
        angles[inside] = b.resting + (b.swing * decay).sum(axis=1)
    columns = {
        "time": times,
        "com_x": states[:, 0],
        "com_y": states[:, 1],
        "heading": states[:, 2],
    }
    columns |= {f"bend_{j}": angles[:, j - 1] for j in range(1, spec.segments + 1)}
    about = {
        "gait_frequency_hz": gait.frequency,
        "body_length_m": spec.geometry.body_length,
    }
    return Trajectory(columns, metadata=about)
