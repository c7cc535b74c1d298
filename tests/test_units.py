"""Units that leave the package, against a list written out here: a wrong one changes no number."""

from __future__ import annotations

import math
import re

import pytest

from srs_twin import rollout
from srs_twin.comparison.metrics import (
    COMPARISON_UNITS,
    LIST_METRIC_UNITS,
    METRIC_UNITS,
)
from srs_twin.planning.metrics import PLANNING_UNITS
from srs_twin.robot.sourced import from_si, si_unit, to_si
from srs_twin.scenario.loading import parse_scenario

pytestmark = pytest.mark.fast

PLANTS = ("analytical", "twin")
GAIT = {"kind": "gait", "frequency_hz": 2.0}
STEP = {"kind": "step", "bend_rad": 0.4}
CONTROLLERS = {
    "gait": GAIT,
    "ilc": {"kind": "ilc", "frequency_hz": 1.0},
    "direct_smc": {"kind": "direct_smc", "reference": STEP},
    "iterative_smc": {"kind": "iterative_smc", "reference": STEP},
    "hold_valves": {"kind": "hold_valves"},
    "follow": {"kind": "follow", "gait": GAIT},
}

SNAKE = {
    "time": "s",
    "com_x": "m",
    "com_y": "m",
    "heading": "rad",
    "x": "m",
    "y": "m",
    "connector_heading": "rad",
    "bend": "rad",
    "measured_bend": "rad",
    "torque": "N·m",
    "pressure_plus": "Pa",
    "pressure_minus": "Pa",
    "valve_plus": "1",
    "valve_minus": "1",
    "work": "J",
    "pneumatic_energy": "J",
}
TWIN = {"qpos": "mixed", "internal_loss": "J"}
TOUCHING = {"obstacle_force_x": "N", "obstacle_force_y": "N"}
SLIDING = {"reference": "rad", "error": "rad", "sigma": "rad/s"}
DUTIES = {"duty_plus": "1", "duty_minus": "1"}
SIGNALS = {
    "gait": {"offset": "1"},
    "ilc": {
        "offset": "1",
        "target_plus": "rad",
        "target_minus": "rad",
        "amplitude_plus": "rad",
        "amplitude_minus": "rad",
        **DUTIES,
    },
    "direct_smc": {**SLIDING, "rate": "rad/s"},
    "iterative_smc": {**SLIDING, **DUTIES, "mu": "1"},
    "hold_valves": {},
    "follow": {
        "offset": "1",
        "offset_commanded": "1",
        "cross_track": "m",
        "heading_error": "rad",
        "node": "1",
        "estimate_x": "m",
        "estimate_y": "m",
        "estimate_heading": "rad",
        "clearance": "m",
    },
}


def recorded(kind, plant):
    """Return the columns of a short run, numbers left out, with their units."""
    data = {"robot": "gen2", "duration_s": 0.1, "controller": CONTROLLERS[kind]}
    data["plants"] = {plant: {"tick_s": 0.01}}
    if kind == "follow":
        goal = {"x_m": 0.6, "y_m": 0.1}
        circle = {"x_m": 0.3, "y_m": 0.8, "radius_m": 0.05}
        data["world"] = {"goal": goal, "obstacles": [circle]}
        data["planner"] = {"kind": "best_first", "footprint": "gen2_section52"}
    scenario = parse_scenario(data, name="short")
    run = rollout(
        scenario.build_plant(plant), scenario.build_controller(), scenario.duration
    )
    return {re.sub(r"_\d+$", "", name): run.unit(name) for name in run.columns}


@pytest.mark.default_cases(2)
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("kind", CONTROLLERS)
def test_every_column_of_a_run_has_the_unit_written_here(kind, plant):
    wanted = SNAKE | SIGNALS[kind]
    if plant == "twin":
        wanted |= TWIN | (TOUCHING if kind == "follow" else {})
    assert recorded(kind, plant) == wanted


METRICS = {
    "m": (
        """path_length_m turning_radius_m path_radius_m extent_left_m extent_right_m
        plan_length_m
        arrival_error_m cross_track_rms_m cross_track_max_m clearance_m
        measured_shape_rms_m measured_path_rms_m
        body_height_m object_moved_m"""
    ),
    "s": "rise_time_s settling_2_s settling_5_s contact_time_s following_time_s wall_s",
    "m/s": "com_speed_m_s path_speed_m_s travel_speed_m_s",
    "rad": (
        """mean_bend_amplitude_rad final_bend_rad overshoot_rad steady_error_rad steady_rms_rad
        ripple_pp_rad ripple_rms_rad measured_ripple_pp_rad error_rms_rad phase_lag_rad phase_lag_spread_rad
        fit_residual_rad amplitude_error_end_rad heading_drift_rad reading_error_rad reading_backstep_rad
        reading_backstep_at_rad plan_max_heading_jump_rad arrival_heading_error_rad measured_bend_rms_rad
        measured_heading_rms_rad travel_direction_rad"""
    ),
    "rad/s": "yaw_rate_rad_s measured_yaw_rate_abs",
    "1/m": (
        "path_curvature_before_per_m path_curvature_per_m path_bend_before_per_m"
        " path_bend_per_m"
    ),
    "W": "mechanical_power_w internal_power_w pneumatic_power_w",
    "T": "reading_range_t",
    "1": (
        """cost_of_transport pneumatic_cost_of_transport overshoot_rel amplitude_rel amplitude_spread_rel
        inlet_openings outlet_openings amplitude_growth_rel periods_to_converge amplitude_error_end_rel
        path_bend_left_rel path_radius_spread_rel duty_lowest duty_highest reading_r_squared plan_found
        plan_nodes goal_reached inside_fraction inside_50mm_fraction contacts replans measured_com_speed_rel
        realtime_factor contact_fraction supports roll_turns"""
    ),
}
LISTS = {
    "rad": (
        "bend_amplitude_rad bend_bias_rad amplitude_error_rad"
        " heading_drift_by_period_rad"
    ),
    "1": "valve_switches duty",
}
COMPARISON = {
    "m": "shape_rms_m path_rms_m",
    "rad": "bend_rms_rad heading_rms_rad travel_direction_abs",
    "rad/s": "yaw_rate_abs",
    "1": (
        "com_speed_rel gap_factor shape_rms_body bend_rms_rel travel_speed_rel"
        " contact_agreement"
    ),
}
PLANNING = {
    "m": "plan_length_m",
    "rad": "plan_max_heading_jump_rad",
    "s": "plan_s",
    "1": "plan_found plan_nodes",
}


@pytest.mark.parametrize(
    ("units", "written"),
    [
        (METRIC_UNITS, METRICS),
        (LIST_METRIC_UNITS, LISTS),
        (COMPARISON_UNITS, COMPARISON),
        (PLANNING_UNITS, PLANNING),
    ],
)
def test_every_metric_has_the_unit_written_here(units, written):
    assert units == {
        name: unit for unit, names in written.items() for name in names.split()
    }


def test_keys_convert_to_si_units():
    """Reference: the values of one unit, written out here."""
    one = {"kpa": 1e3, "m_per_kpa": 1e-3, "mm": 1e-3, "ml": 1e-6, "uv": 1e-6}
    one |= {"l_per_min": 1 / 60000, "deg": math.pi / 180, "m_s": 1, "rad": 1, "kg": 1}
    found = {suffix: to_si(f"value_{suffix}", 1.0) for suffix in one}
    assert found == pytest.approx(one)
    back = {from_si(f"value_{suffix}", value) for suffix, value in one.items()}
    assert back == {1.0}
    units = {"kpa": "Pa", "ml": "m³", "l_per_min": "m³/s", "rad_s": "rad/s"}
    assert {suffix: si_unit(f"value_{suffix}") for suffix in units} == units
