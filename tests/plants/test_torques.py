"""Torques of the segments: inverse dynamics of `complete` compared with Newton's law and stiff springs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt
from smooth import Wave
from snakes import chain, robot

from srs_twin import AnalyticalSnake, Gait, RobotSpec, rollout
from srs_twin.plants.base import SnakeState
from srs_twin.robot.friction import TWO_POINT_LAWS, wheel

MASSES = (0.03, 0.05, 0.02, 0.04, 0.1)
STEP = 1e-4
SMOOTH = {"mu_t": 1.0, "mu_n": 15.0}  # for the viscous law


def bent(plant: AnalyticalSnake, duration: float, step: float) -> SnakeState:
    """Return the motion of a plant with smooth chambers, every `step` (s)."""
    plant.reset()
    return plant.play(
        plant.pneumatics.schedule(np.full((plant.spec.segments, 2), -1), duration),
        round(duration / step),
    )


def from_the_tail(
    h: SnakeState, spec: RobotSpec, inertia: np.ndarray, yaw: np.ndarray
) -> np.ndarray:
    """Return the segments' moments from recorded places and floor forces, Newton and Euler from the tail.

    A massless arc that connectors j and j + 1 hold in F and moments does no work but T
    δq: with its chord L e along the mean of their headings, T = −L' F·e − N₁ − r × F/2,
    where F and N₁ are what it gives to the connector behind, and r = −L e.

    Args:
        h: motion at equal steps.
        spec: the robot.
        inertia: of the connectors about themselves, shape (N,), kg·m².
        yaw: moment of the floor on each connector, shape (samples, N), N·m.
    """
    needed = spec.mass.array()[:, None] * second(h.position) - h.contact_force[1:-1]
    spin = inertia * second(h.connector_heading) - yaw[1:-1]
    place = h.position[1:-1]
    mean = (h.connector_heading[1:-1, 1:] + h.connector_heading[1:-1, :-1]) / 2
    ahead = np.stack([np.cos(mean), np.sin(mean)], axis=-1)
    half = h.bend[1:-1] / 2
    length = spec.geometry.segment_length
    gap = spec.geometry.rigid_gap
    derivative = (
        length * (np.cos(half) - np.sinc(half / np.pi)) / (2 * half)
        - gap * np.sin(half) / 2
    )
    torque = np.empty_like(half)
    for j in range(spec.segments):
        force = needed[:, j + 1 :].sum(axis=1)
        arm = place[:, j + 1 :] - place[:, j + 1, None]
        behind = (cross(arm, needed[:, j + 1 :]) + spin[:, j + 1 :]).sum(axis=1)
        chord = place[:, j + 1] - place[:, j]
        torque[:, j] = (
            -derivative[:, j] * (force * ahead[:, j]).sum(axis=1)
            - behind
            - cross(chord, force) / 2
        )
    return torque


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def second(values: np.ndarray) -> np.ndarray:
    return np.diff(values, n=2, axis=0) / STEP**2


def first(values: np.ndarray) -> np.ndarray:
    return np.gradient(values, STEP, axis=0)


def yaw_of_two_wheels(h: SnakeState, spec: RobotSpec, slip: float) -> np.ndarray:
    """Return the moment of both wheels' drag on each connector, shape (samples, N), N·m."""
    along = (
        first(h.position)
        * np.stack([np.cos(h.connector_heading), np.sin(h.connector_heading)], axis=-1)
    ).sum(axis=-1)
    across = cross(
        np.stack([np.cos(h.connector_heading), np.sin(h.connector_heading)], axis=-1),
        first(h.position),
    )
    track = spec.geometry.half_track
    load = spec.mass.array() * 9.81 / 2
    left, right = (
        wheel(
            along - side * track * first(h.connector_heading),
            across,
            load,
            spec.friction.mu_t,
            spec.friction.mu_n,
            slip,
        )
        for side in (1, -1)
    )
    return track * (right[0] - left[0])


@pytest.mark.slow
@pytest.mark.parametrize("model", ["complete", "compliant"])
@pytest.mark.parametrize(
    ("friction_law", "mu", "inertia"),
    [
        ("viscous", SMOOTH, "point"),
        ("axis", {}, "point"),
        ("axis", {}, "lumped"),
        ("wheel", {}, "connector"),
    ],
)
def test_torques_satisfy_newtons_law(model, friction_law, mu, inertia):
    slip = 0.02
    spec = chain(MASSES, **mu)
    plant = AnalyticalSnake(
        spec,
        model=model,
        friction=friction_law,
        inertia=inertia,
        timestep=STEP,
        slip_speed=slip,
        pneumatics=Wave(spec, amplitude=0.8, bias=0.2),
    )
    h = bent(plant, 0.8, STEP)
    yaw = (
        yaw_of_two_wheels(h, spec, slip)
        if friction_law in TWO_POINT_LAWS
        else np.zeros_like(h.connector_heading)
    )
    lumped = spec.mass.array() * np.array([1, 2, 2, 2, 1]) * spec.geometry.pitch**2 / 3
    own = {"point": np.zeros(5), "connector": spec.yaw_inertia(), "lumped": lumped}[
        inertia
    ]
    # From 0.2 s on, where bends are large enough to divide by them.
    expected = from_the_tail(h, spec, own, yaw)[2000:]
    result = h.torque[1:-1][2000:]
    error = np.abs(result - expected) / np.sqrt((expected**2).mean())
    assert np.sqrt((error**2).mean()) < 5e-5
    assert error.max() < 5e-3  # at kinks of the wheels' law


def apart(
    friction_law: str,
    mu: dict[str, float],
    inertia: str,
    stiffness: tuple[float, ...],
    cut_hz: float = 20.0,
) -> list[float]:
    """Return the relative RMS difference of spring torques and `complete` torques after a low-pass filter.

    Valve events cause jumps of the bend acceleration that decay with τ₂ = 2 ms. Torques
    at 10 kHz resolve them; at 1 kHz they would be sampled at random, and the filter
    would spread them over 50 ms.
    """
    spec = robot(**mu)
    options = {
        "friction": friction_law,
        "inertia": inertia,
        "supply_pa": 48.3e3,
        "timestep": STEP,
    }
    gait = Gait(2.0, 0.2)
    length = 1.0
    complete = rollout(
        AnalyticalSnake(spec, **options), gait, length, record_hz=1 / STEP
    )
    valve = complete.stack("valve_plus")
    # A valve's state is that which led to the sample: it switched at the one before.
    switch = np.flatnonzero((valve[1:] != valve[:-1]).any(axis=1))
    away = np.abs(complete.time[:, None] - complete.time[switch]).min(axis=1) > 0.005
    away &= (complete.time > 0.4) & (
        complete.time < length - 0.1
    )  # warm up, and the filter's end
    expected = complete.stack("torque")
    expected[switch] = (
        expected[switch]
        + 3 * expected[switch + 1]
        - 3 * expected[switch + 2]
        + expected[switch + 3]
    ) / 2
    low = butter(2, cut_hz, fs=1 / STEP, output="sos")
    expected = sosfiltfilt(low, expected, axis=0)[away]
    actual = []
    for k in stiffness:
        stiff = replace(spec, bending=replace(spec.bending, stiffness=k))
        springs = rollout(
            AnalyticalSnake(stiff, model="compliant", **options),
            gait,
            length,
            record_hz=1 / STEP,
        )
        difference = sosfiltfilt(low, springs.stack("torque"), axis=0)[away] - expected
        actual.append(float(np.sqrt((difference**2).mean() / (expected**2).mean())))
    return actual


@pytest.mark.parametrize("inertia", ["point", "connector", "lumped"])
@pytest.mark.parametrize(
    ("friction_law", "mu"),
    [
        pytest.param("viscous", SMOOTH, marks=pytest.mark.slow),
        pytest.param("axis", {}, marks=pytest.mark.slow),
        ("wheel", {}),
    ],
)
def test_stiff_springs_exert_the_inverse_dynamics_torques(friction_law, mu, inertia):
    assert apart(friction_law, mu, inertia, (320.0,))[0] < 0.02


@pytest.mark.slow
def test_spring_torques_converge_with_stiffness():
    soft, middle, stiff = apart("viscous", SMOOTH, "point", (20.0, 80.0, 320.0))
    assert np.log([soft / middle, middle / stiff]) / np.log(4) == pytest.approx(
        [1, 1], abs=0.2
    )


def test_torque_of_one_segment_between_two_masses():
    """By hand: two equal masses m at the distance L without a floor, in the frame of their mean heading.

    They are on the line of that heading at ± L(q)/2, so that the kinetic energy is m
    L'² q̇²/4 and the mean heading is constant. T = (d/dt)(m L'² q̇/2) − m L' L'' q̇²/2,
    plus the inertia J/2 of both ends.
    """
    spec = chain((0.05, 0.05), mu_t=0.0, mu_n=0.0)
    wave = Wave(spec, amplitude=0.9, bias=0.3)
    h = bent(
        AnalyticalSnake(spec, timestep=STEP, inertia="connector", pneumatics=wave),
        0.5,
        STEP,
    )
    q, dq, ddq = (values[:, 0] for values in wave.free(h.time))
    length = spec.geometry.segment_length
    gap = spec.geometry.rigid_gap
    tiny = 1e-20j

    def derivative(q: np.ndarray) -> np.ndarray:
        s = np.sin(q / 2)
        c = np.cos(q / 2)
        return length * (c / q - 2 * s / q**2) - gap * s / 2

    bulge = derivative(q + tiny).imag / tiny.imag
    expected = (
        0.05 / 2 * (derivative(q) ** 2 * ddq + derivative(q) * bulge * dq**2)
        + spec.yaw_inertia()[0] / 2 * ddq
    )
    big = np.abs(q) > 0.05
    assert h.torque[big, 0] == pytest.approx(expected[big], rel=1e-6, abs=1e-9)
    assert np.abs(h.heading).max() < 1e-12
