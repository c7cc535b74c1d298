"""Gait that yields to contact: its laws from sensor readings alone."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest

from srs_twin import AnalyticalSnake, Gait, load_robot, rollout
from srs_twin.control.compliant_gait import CompliantGait
from srs_twin.errors import InputError
from srs_twin.pneumatics.chambers import air_bend
from srs_twin.robot.world import Circle, World

SNAKE = load_robot("skin_example")
FULL = SNAKE.supply.nominal
SEGMENTS = SNAKE.segments


@functools.cache
def initial_state():
    return AnalyticalSnake(SNAKE).state


def at(time, pressure, sensed):
    """Return a state with true fields of NaN."""
    nothing = {
        name: np.full_like(np.asarray(getattr(initial_state(), name), dtype=float), math.nan)
        for name in ("com", "com_velocity", "position", "theta", "bend", "bend_rate", "contact_force",
                     "obstacle_force", "torque", "work")
    }  # fmt: skip
    return replace(initial_state(), time=time, heading=math.nan, pressure=pressure, sensed=sensed, **nothing)


def wave(time):
    """Return pressures of a sine wave in phase with the gait."""
    angle = np.sin(2 * math.pi * time - SNAKE.phase_step * np.arange(SEGMENTS))
    return FULL * np.stack([np.maximum(angle, 0), np.maximum(-angle, 0)], axis=-1)


def driven(gait, follow, seconds=3.0):
    """Run a gait on given readings: `follow` maps time and free bends to the readings."""
    gait.reset(SNAKE, 0.02)
    for k in range(round(seconds / 0.02)):
        pressure = wave(0.02 * k)
        valves = gait.step(at(0.02 * k, pressure, follow(0.02 * k, air_bend(SNAKE, pressure))))
    return valves


@pytest.mark.parametrize("gain", [0.5, -0.5])
def test_amplitude_follows_the_admittance(gain):
    # The load takes a tenth of each bend: F_a = −0.1 · 2 Σ f²/(n q_m²) = −0.1 for a wave of full amplitude.
    gait = CompliantGait(1.0, gain=gain, amplitude=0.7)
    driven(gait, lambda time, free: 0.9 * free)
    assert gait.amplitude == pytest.approx(0.7 - 0.1 * gain, abs=2e-3)
    assert math.hypot(gait.amplitude, gait.rest_level) == pytest.approx(1.0)


def test_lag_follows_the_admittance():
    # The body has a longer wave than the air: its lag per segment is smaller by 0.05 rad.
    gait = CompliantGait(1.0, response="wave_number", gain=0.5, time=0.5)
    place = np.arange(SEGMENTS) - (SEGMENTS - 1) / 2
    full = SNAKE.actuator.gain * FULL
    gait.reset(SNAKE, 0.02)
    lags = []
    for k in range(300):
        time, pressure = 0.02 * k, wave(0.02 * k)
        phase = 2 * math.pi * time - gait.phase_lag - gait._delay
        shorter = full * (np.sin(phase + 0.05 * place) - np.sin(phase))
        gait.step(at(time, pressure, air_bend(SNAKE, pressure) + shorter))
        lags.append(gait.lag)
    assert np.mean(lags[-50:]) == pytest.approx(SNAKE.phase_step - 0.5 * 0.05, rel=0.01)


@pytest.mark.parametrize(("response", "relieved"), [("hold", 0), ("vent", -1)])
def test_only_the_blocked_segment_is_relieved_while_driven(response, relieved):
    gait, usual = CompliantGait(1.0, response=response, amplitude=1.0, threshold=0.3), Gait(1.0)
    for each in (gait, usual):
        each.reset(SNAKE, 0.02)
    blocked, others = 0, np.arange(SEGMENTS) != 2
    for k in range(100):
        pressure = wave(0.02 * k)
        free = air_bend(SNAKE, pressure)
        sensed = np.where(others, free, np.clip(free, -1.0, 1.0))
        valves, expected = (
            each.reshape(-1, SEGMENTS, 2)
            for each in (gait.step(at(0.02 * k, pressure, sensed)), usual.valves_at(0.02 * k))
        )
        assert (valves[:, others] == expected[:, others]).all() and not gait.blocked[others].any()
        assert (valves[:, 2] == (relieved if gait.blocked[2] else expected[:, 2])).all()
        blocked += gait.blocked[2]
    # The free bend is above 1.3 rad for 38 % of the time, and above 1.15 rad for 47 %; the wave changes its
    # sign while the lag is still above the threshold only for other phases of the air.
    assert 0.3 < blocked / 100 < 0.5


def test_lost_readings_and_pressures_leave_the_wave_finite():
    gait = CompliantGait(1.0, gain=2.0)
    valves = driven(gait, lambda time, free: np.where(np.arange(SEGMENTS) == 1, math.nan, free))
    assert math.isfinite(gait.amplitude) and np.isin(valves, (-1, 1)).all()
    gait.step(at(3.0, np.full((SEGMENTS, 2), math.nan), np.zeros(SEGMENTS)))
    assert math.isfinite(gait.amplitude)


@pytest.mark.slow
def test_gain_zero_is_the_open_loop_gait():
    world = World((Circle(0.25, 0.03, 0.02),))
    runs = [
        rollout(
            AnalyticalSnake(SNAKE, model="compliant", inertia="connector", world=world, touch=True), gait, 1.0
        )
        for gait in (
            CompliantGait(1.0, gain=0.0, amplitude=0.6),
            Gait(1.0, rest_share=2 / math.pi * math.acos(0.6)),
        )
    ]
    assert runs[0].com[-1] == pytest.approx(runs[1].com[-1], abs=1e-6)


def test_bad_settings_are_refused():
    for options, word in (
        ({"response": "hlod"}, "hold"),
        ({"amplitude": 0.1}, "amplitude"),
        ({"time": 0.0}, "time"),
        ({"threshold": -1.0}, "threshold"),
    ):
        with pytest.raises(InputError, match=word):
            CompliantGait(1.0, **options)
    with pytest.raises(InputError, match="two or more"):
        CompliantGait(1.0).reset(load_robot("gen4_module"), 0.02)
    assert CompliantGait(1.0, response="hold").layouts == ("in_out",)
