"""Damping of the bends in robot files: both readings of the delay, and distributions with a median."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from srs_twin import (
    AnalyticalSnake,
    Gait,
    InputError,
    load_robot,
    load_scenario,
    rollout,
)
from srs_twin.identification.priors import Priors
from srs_twin.plants.twin.mjcf.numerics import MAX_STEP_RATIO, stable_step
from srs_twin.robot.file import load_robot_file

CHANGES = {"robot.bending.lead": False, "robot.bending.damping_time_s": 0.008}


def test_without_lead_the_total_delay_stays():
    own = load_scenario("gen2_straight", set=CHANGES).robot
    gen2 = load_robot("gen2")
    assert own.actuator.tau_mode == own.bending.damping_time == 0.008
    delays = [each.actuator.tau_fill + each.actuator.tau_mode for each in (own, gen2)]
    assert delays[0] == pytest.approx(delays[1])
    assert own.actuator.tau_vent < gen2.actuator.tau_vent


def test_without_lead_a_light_segment_follows_the_pressures_with_its_damping_time():
    own = load_scenario("gen2_straight", set=CHANGES).robot
    masses = {"connectors": tuple(1e-12 * m for m in own.mass.connectors), "wheel": 0.0}
    light = replace(own, mass=replace(own.mass, **masses))
    run = rollout(
        AnalyticalSnake(light, model="compliant", supply_pa=48.3e3),
        Gait(1.0),
        1.0,
        record_hz=500,
    )
    pressure = run["pressure_plus_1"] - run["pressure_minus_1"]
    bend = run["bend_1"]
    drive = own.actuator.gain * pressure
    # T q̇ + q = G (p⁺ − p⁻); differences over 4 ms, away from the switching of the
    # valves.
    rate = np.gradient(bend, run.time)
    missed = np.abs(0.008 * rate + bend - drive)
    assert np.median(missed) < 2e-3


@pytest.mark.parametrize("damping", [0.12, 1.0])
def test_without_lead_the_chambers_need_time(damping):
    changes = CHANGES | {"robot.bending.damping_time_s": damping}
    with pytest.raises(
        InputError,
        match="too long for `lead: false`; the damping time must be below 0.11284",
    ):
        load_scenario("gen2_straight", set=changes)


def test_a_lognormal_distribution_may_have_a_median_of_its_own():
    priors = Priors.from_robot(load_robot_file("gen2"))
    prior = priors.parameters[priors.paths.index("bending.damping_time_s")]
    assert prior.quantile(np.array([0.5])) == pytest.approx(0.00122)
    low, high = prior.quantile(np.array([0.158655, 0.841345]))
    assert high / low == pytest.approx(1.6**2, rel=1e-4)


@pytest.mark.default_cases(3)
@pytest.mark.parametrize("time", [3e-4, 5e-4, 6.6e-4, 7e-4, 2e-3])
def test_steps_of_the_twin_suit_the_damping(time):
    step = stable_step(0.001, time)
    assert step < MAX_STEP_RATIO * time or step == pytest.approx(MAX_STEP_RATIO * time)
    assert round(0.001 / step) == pytest.approx(0.001 / step)
