"""Torques of the segments: inverse dynamics of `complete` compared with stiff springs and by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt
from smooth import Wave
from snakes import chain, robot

from srs_twin import AnalyticalSnake, Gait, rollout
from srs_twin.plants.base import SnakeState

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
